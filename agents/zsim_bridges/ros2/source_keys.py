"""What is read of the run for whom in ROS: each key once, while somebody subscribes to a topic that is made of it."""

import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from zsim.contract import keys, messages
from zsim.errors import DecodeError
from zsim.transport.session import Heard, Mailbox, Sample, Session
from zsim_bridges.ros2.callback_queue import Inbox
from zsim_bridges.ros2.participant import Publisher
from zsim_bridges.ros2.topics import Topic

SAMPLES_MAX = 2000  # of a key that wait to be converted: about a tenth of a second of work


class Publication:
    """A topic of ours, and the tokens of who subscribes to it."""

    def __init__(self, topic: Topic, publisher: Publisher) -> None:
        self.topic = topic
        self.publisher = publisher
        self.readers: set[str] = set()


class Feed(NamedTuple):
    """A key that is read, for whom, and what ends it; `box` is emptied at each turn, without one it makes turns."""

    readers: list[Publication]
    end: Callable[[], None]
    box: Mailbox | None = None


class Feeds:
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

    def __init__(self, link: Session, inbox: Inbox, refuse: Callable[[str, str], None], prompt: bool) -> None:
        self._link = link
        self._inbox = inbox
        self._refuse = refuse
        self._prompt = prompt
        self._feeds: dict[str, Feed] = {}
        self.dropped = 0

    def start(self, publication: Publication) -> None:
        """Read what a topic is made of."""
        for key in publication.topic.sources:
            if key not in self._feeds:
                self._feeds[key] = self._feed(key)
            self._feeds[key].readers.append(publication)

    def _feed(self, key: str) -> Feed:
        """Read a key: what the world says of a drone is there when its clock comes, others say theirs at any time."""
        if self._prompt and keys.leaf(key) in ("estimate", "state"):
            return Feed([], self._link.hear(key, self._on_sample))
        box = self._link.subscribe(key)
        return Feed([], box.close, box)

    def _on_sample(self, heard: Heard) -> None:
        if heard.payload:
            self._inbox.sample(heard.key, heard.payload)

    def end(self, publication: Publication) -> None:
        """Read no more what only this topic is made of."""
        for key in publication.topic.sources:
            feed = self._feeds[key]
            feed.readers.remove(publication)
            if not feed.readers:
                feed.end()
                del self._feeds[key]

    def close(self) -> None:
        """Read nothing any more."""
        for feed in self._feeds.values():
            feed.end()

    def pass_on(self, samples: Sequence[tuple[str, bytes]]) -> int:
        """Publish what samples, and those in the boxes, mean in ROS, in order of time; return how many they were."""
        boxes = [feed.box for feed in self._feeds.values() if feed.box]
        taken = [*samples, *(sample for box in boxes for sample in self._newest(box))]
        for key, message in sorted(self._decoded(taken), key=_when):
            for publication in self._feeds[key].readers:
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
            if key in self._feeds:
                try:
                    yield key, messages.decode(key, payload)
                except DecodeError as error:
                    self._refuse(key, str(error))

    def _publish(self, publication: Publication, key: str, message: Any) -> None:
        try:
            converted = publication.topic.convert(key, message)
            if converted is not None:
                publication.publisher.publish(converted)
        except (ValueError, OverflowError, struct.error) as error:  # numbers beyond what the ROS type holds
            self._refuse(publication.topic.name, f"{key} does not fit it ({error})")


def _when(told: tuple[str, Any]) -> tuple[int, bool]:
    """Return what puts messages in the order in which the world tells them: status last of a gate."""
    key, message = told
    return message.t_ns, keys.is_status(key)
