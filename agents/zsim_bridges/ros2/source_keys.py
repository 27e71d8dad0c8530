"""The run's keys that are read for ROS: each once, while a ROS node subscribes to a topic that is made of it."""

import struct
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from zsim.contract import keys, messages
from zsim.contract.flight_messages import CameraInfo
from zsim.errors import DecodeError
from zsim.transport.session import RawSample, ReceivedSample, Session, Subscription
from zsim_bridges.ros2.rmw_zenoh import Publisher
from zsim_bridges.ros2.topics import Topic

QueuedTask = Callable[[], object]


class QueuedWork(NamedTuple):
    """Contents of the queue: tasks, and samples as (key, payload)."""

    tasks: list[QueuedTask]
    samples: list[tuple[str, bytes]]


class CallbackQueue:
    """From Zenoh's threads to the bridge's: all tasks, and the newest `limit` samples; filling it never waits.

    Attributes:
        dropped: samples that were lost.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._tasks: list[QueuedTask] = []
        self._samples: deque[tuple[str, bytes]] = deque()
        self._arrived = threading.Condition()
        self.dropped = 0

    def add_task(self, act: QueuedTask) -> None:
        """Queue a task for the bridge's thread."""
        with self._arrived:
            self._tasks.append(act)
            self._arrived.notify()

    def add_sample(self, key: str, payload: bytes) -> None:
        """Queue a sample."""
        with self._arrived:
            if len(self._samples) >= self._limit:
                self._samples.popleft()
                self.dropped += 1
            self._samples.append((key, payload))
            self._arrived.notify()

    def pop_all(self, within_s: float) -> QueuedWork:
        """Return the contents, waiting for some."""
        with self._arrived:
            if not self._tasks and not self._samples:
                self._arrived.wait(within_s)
            work = QueuedWork(self._tasks, list(self._samples))
            self._tasks = []
            self._samples.clear()
        return work


LAST_S = 1.0  # how long a last value is waited for; the world answers within milliseconds
SAMPLES_MAX = 2000  # of a key that wait to be converted: about a tenth of a second of work


class BridgedTopic:
    """A topic of the bridge, and the tokens of its subscribers."""

    def __init__(self, topic: Topic, publisher: Publisher) -> None:
        self.topic = topic
        self.publisher = publisher
        self.readers: set[str] = set()


class SourceSubscription(NamedTuple):
    """The subscription to a key, and its topics; samples are queued unless they are polled."""

    readers: list[BridgedTopic]
    close: Callable[[], None]
    polled: Subscription | None = None


class SourceSubscriptions:
    """All subscriptions to the run's keys.

    Args:
        link: to the world.
        queue: of samples that are not polled.
        refuse: called with (name, reason) of a message that cannot be converted.
        prompt: whether estimates and cluster states are converted as they come, rather than with the next clock: a
            turn for each of them costs more than to convert it, and only in realtime is a gate a long time.

    Attributes:
        dropped: samples that were lost.
    """

    def __init__(self, link: Session, queue: CallbackQueue, refuse: Callable[[str, str], None], prompt: bool) -> None:
        self._link = link
        self._queue = queue
        self._refuse = refuse
        self._prompt = prompt
        self._by_key: dict[str, SourceSubscription] = {}
        self.dropped = 0

    def add(self, publication: BridgedTopic) -> None:
        """Subscribe to a topic's source keys."""
        for key in publication.topic.sources:
            if key not in self._by_key:
                self._by_key[key] = self._open_source(key)
            self._by_key[key].readers.append(publication)

    def _open_source(self, key: str) -> SourceSubscription:
        """Subscribe to a key: the world's messages are there when its clock comes, those of others come at any time."""
        if self._prompt and keys.leaf(key) in ("estimate", "state"):
            return SourceSubscription([], self._link.declare_subscriber(key, self._on_sample))
        subscription = self._link.subscribe(key)
        if messages.type_of(key) is CameraInfo:  # said once, before anybody here read it
            for sample in self._link.get(key, timeout_s=LAST_S):
                self._queue.add_sample(sample.key, sample.payload)
        return SourceSubscription([], subscription.undeclare, subscription)

    def _on_sample(self, sample: RawSample) -> None:
        if sample.payload:
            self._queue.add_sample(sample.key, sample.payload)

    def remove(self, publication: BridgedTopic) -> None:
        """Unsubscribe from keys that only this topic is made of."""
        for key in publication.topic.sources:
            source = self._by_key[key]
            source.readers.remove(publication)
            if not source.readers:
                source.close()
                del self._by_key[key]

    def close(self) -> None:
        """Close all subscriptions."""
        for source in self._by_key.values():
            source.close()

    def convert_all(self, samples: Sequence[tuple[str, bytes]]) -> int:
        """Convert and publish queued and polled samples in order of time; return how many they were."""
        polled = [source.polled for source in self._by_key.values() if source.polled]
        arrived = [*samples, *(sample for subscription in polled for sample in self._newest(subscription))]
        for key, message in sorted(self._decoded(arrived), key=_gate_order):
            for publication in self._by_key[key].readers:
                self._publish(publication, key, message)
        return len(arrived)

    def _newest(self, subscription: Subscription) -> list[ReceivedSample]:
        """Return the samples that have arrived, the newest of them if there are too many."""
        samples = list(subscription.drain())
        self.dropped += max(0, len(samples) - SAMPLES_MAX)
        return samples[-SAMPLES_MAX:]

    def _decoded(self, samples: Iterable[tuple[str, bytes]]) -> Iterator[tuple[str, Any]]:
        """Yield the messages in samples, of keys that are still subscribed to."""
        for key, payload in samples:
            if key in self._by_key:
                try:
                    yield key, messages.decode(key, payload)
                except DecodeError as error:
                    self._refuse(key, messages.fault_at(key, error))

    def _publish(self, publication: BridgedTopic, key: str, message: Any) -> None:
        try:
            converted = publication.topic.convert(key, message)
            if converted is not None:
                publication.publisher.publish(converted)
        except (ValueError, OverflowError, struct.error) as error:  # numbers beyond what the ROS type holds
            self._refuse(publication.topic.name, f"{key} does not fit it ({error})")


def _gate_order(entry: tuple[str, Any]) -> tuple[int, bool]:
    """Return the sorting key for the order in which the world publishes: status last of a gate."""
    key, message = entry
    return message.t_ns, keys.is_status(key)
