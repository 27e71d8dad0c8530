"""What threads of Zenoh hand to the bridge's own: acts, none of which is lost, and samples, the newest of them.

What is read of the run for whom in ROS: each key once, while somebody subscribes to a topic that is made of it.
"""

import struct
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from zsim.contract import keys, messages
from zsim.errors import DecodeError
from zsim.transport.session import Heard, Mailbox, Sample, Session
from zsim_bridges.ros2.ros_context import Publisher
from zsim_bridges.ros2.topics import Topic

QueuedTask = Callable[[], object]


class QueuedWork(NamedTuple):
    """What has come since the last time: acts, and samples as (key, payload)."""

    tasks: list[QueuedTask]
    samples: list[tuple[str, bytes]]


class CallbackQueue:
    """A queue that never holds up who fills it: beyond `limit` samples the oldest go.

    Attributes:
        dropped: how many went.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._tasks: list[QueuedTask] = []
        self._samples: deque[tuple[str, bytes]] = deque()
        self._arrived = threading.Condition()
        self.dropped = 0

    def add_task(self, act: QueuedTask) -> None:
        """Have something done in the bridge's thread."""
        with self._arrived:
            self._tasks.append(act)
            self._arrived.notify()

    def add_sample(self, key: str, payload: bytes) -> None:
        """Have a sample passed on."""
        with self._arrived:
            if len(self._samples) >= self._limit:
                self._samples.popleft()
                self.dropped += 1
            self._samples.append((key, payload))
            self._arrived.notify()

    def pop_all(self, within_s: float) -> QueuedWork:
        """Return what there is, waiting for something."""
        with self._arrived:
            if not self._tasks and not self._samples:
                self._arrived.wait(within_s)
            taken = QueuedWork(self._tasks, list(self._samples))
            self._tasks = []
            self._samples.clear()
        return taken


SAMPLES_MAX = 2000  # of a key that wait to be converted: about a tenth of a second of work


class BridgedTopic:
    """A topic of ours, and the tokens of who subscribes to it."""

    def __init__(self, topic: Topic, publisher: Publisher) -> None:
        self.topic = topic
        self.publisher = publisher
        self.readers: set[str] = set()


class SourceSubscription(NamedTuple):
    """A key that is read, for whom, and what ends it; `box` is emptied at each turn, without one it makes turns."""

    readers: list[BridgedTopic]
    close: Callable[[], None]
    mailbox: Mailbox | None = None


class SourceSubscriptions:
    """All that is read.

    Args:
        link: to the world.
        inbox: where samples wait that have no box.
        refuse: told (name, why) of what cannot be converted.
        prompt: whether estimates and cluster states are passed on as they come, rather than with the next clock: a
            turn for each of them costs more than to convert it, and only in realtime is a gate a long time.

    Attributes:
        dropped: how many samples were too many.
    """

    def __init__(self, link: Session, inbox: CallbackQueue, refuse: Callable[[str, str], None], prompt: bool) -> None:
        self._link = link
        self._inbox = inbox
        self._refuse = refuse
        self._prompt = prompt
        self._by_key: dict[str, SourceSubscription] = {}
        self.dropped = 0

    def add(self, publication: BridgedTopic) -> None:
        """Read what a topic is made of."""
        for key in publication.topic.sources:
            if key not in self._by_key:
                self._by_key[key] = self._open_source(key)
            self._by_key[key].readers.append(publication)

    def _open_source(self, key: str) -> SourceSubscription:
        """Read a key: what the world says of a drone is there when its clock comes, others say theirs at any time."""
        if self._prompt and keys.leaf(key) in ("estimate", "state"):
            return SourceSubscription([], self._link.hear(key, self._on_sample))
        box = self._link.subscribe(key)
        return SourceSubscription([], box.close, box)

    def _on_sample(self, heard: Heard) -> None:
        if heard.payload:
            self._inbox.add_sample(heard.key, heard.payload)

    def remove(self, publication: BridgedTopic) -> None:
        """Read no more what only this topic is made of."""
        for key in publication.topic.sources:
            feed = self._by_key[key]
            feed.readers.remove(publication)
            if not feed.readers:
                feed.close()
                del self._by_key[key]

    def close(self) -> None:
        """Read nothing any more."""
        for feed in self._by_key.values():
            feed.close()

    def convert_all(self, samples: Sequence[tuple[str, bytes]]) -> int:
        """Publish what samples, and those in the boxes, mean in ROS, in order of time; return how many they were."""
        boxes = [feed.mailbox for feed in self._by_key.values() if feed.mailbox]
        taken = [*samples, *(sample for box in boxes for sample in self._newest(box))]
        for key, message in sorted(self._decoded(taken), key=_gate_order):
            for publication in self._by_key[key].readers:
                self._publish(publication, key, message)
        return len(taken)

    def _newest(self, box: Mailbox) -> list[Sample]:
        """Return what is in a box, the newest of it if that is too much."""
        samples = list(box.drain())
        self.dropped += max(0, len(samples) - SAMPLES_MAX)
        return samples[-SAMPLES_MAX:]

    def _decoded(self, samples: Iterable[tuple[str, bytes]]) -> Iterator[tuple[str, Any]]:
        """Yield the messages in samples, of keys that are read still."""
        for key, payload in samples:
            if key in self._by_key:
                try:
                    yield key, messages.decode(key, payload)
                except DecodeError as error:
                    self._refuse(key, str(error))

    def _publish(self, publication: BridgedTopic, key: str, message: Any) -> None:
        try:
            converted = publication.topic.convert(key, message)
            if converted is not None:
                publication.publisher.publish(converted)
        except (ValueError, OverflowError, struct.error) as error:  # numbers beyond what the ROS type holds
            self._refuse(publication.topic.name, f"{key} does not fit it ({error})")


def _gate_order(told: tuple[str, Any]) -> tuple[int, bool]:
    """Return what puts messages in the order in which the world tells them: status last of a gate."""
    key, message = told
    return message.t_ns, keys.is_status(key)
