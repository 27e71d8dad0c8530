"""Feeds of pictures: the newest one for each who looks, by one subscription a camera."""

import asyncio
from collections.abc import Callable

import pytest
from synthetic_pictures import NO_JPEG, image, jpeg

from zsim.contract import keys, messages
from zsim.transport.session import RawSample
from zsim_bridges.gateway import client_streams
from zsim_bridges.gateway.client_streams import BOUNDARY, PictureFeed, PictureFeeds, picture_part

FRONT = keys.camera("d1", "front")
MS = 1_000_000


def sample(number: int, data: bytes | None = None) -> RawSample:
    return RawSample("PUT", FRONT, messages.encode(image(number * 20 * MS, number, data)), "", None)


class Publisher:
    """Counts subscriptions, and publishes to those that are there."""

    def __init__(self) -> None:
        self.subscribers: list[Callable[[RawSample], None]] = []
        self.made = 0

    def subscribe(self, key: str, subscriber: Callable[[RawSample], None]) -> Callable[[], None]:
        assert key == FRONT
        self.made += 1
        self.subscribers.append(subscriber)
        return lambda: self.subscribers.remove(subscriber)

    def publish(self, published: RawSample) -> None:
        for subscriber in self.subscribers:
            subscriber(published)


def test_who_comes_late_gets_the_newest_and_nothing_twice() -> None:
    async def look() -> list[int | None]:
        feed = PictureFeed(FRONT, lambda reason: None)
        for number in range(5):
            feed.take(sample(number))
        late = await feed.after(-1, 1.0)
        assert late is not None
        again = await feed.after(late.number, 0.0)
        feed.take(sample(9))
        next_one = await feed.after(late.number, 1.0)
        return [picture and picture.image.seq for picture in (late, again, next_one)]

    assert asyncio.run(look()) == [4, None, 9]


def test_who_waits_gets_the_next_picture() -> None:
    async def look() -> int:
        feed = PictureFeed(FRONT, lambda reason: None)
        waiting = asyncio.create_task(feed.after(-1, 60.0))
        await asyncio.sleep(0)
        feed.take(sample(7))
        picture = await waiting
        assert picture is not None
        return picture.image.seq

    assert asyncio.run(look()) == 7


@pytest.mark.parametrize("payload", [b"\xc1", messages.encode(image(0, 0, NO_JPEG)), b""])
def test_what_is_no_picture_is_refused_and_not_shown(payload: bytes) -> None:
    refused: list[str] = []

    async def look() -> PictureFeed:
        feed = PictureFeed(FRONT, refused.append)
        feed.take(sample(3))
        feed.take(RawSample("PUT", FRONT, payload, "", None))
        return feed

    newest = asyncio.run(look()).newest
    assert newest is not None
    assert newest.image.seq == 3
    assert len(refused) == 1
    assert refused[0].startswith(FRONT)


def test_a_hundred_who_look_cost_one_subscription_and_it_ends_after_the_last(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_streams, "LINGER_S", 0.0)
    publisher = Publisher()

    async def look() -> list[int]:
        feeds = PictureFeeds(publisher.subscribe, lambda reason: None)
        counts = []

        async def watch() -> None:
            with feeds.watched(FRONT) as feed:
                assert await feed.after(-1, 60.0)

        watchers = [asyncio.create_task(watch()) for _ in range(100)]
        await asyncio.sleep(0)
        counts.append(publisher.made)
        publisher.publish(sample(0))
        await asyncio.gather(*watchers)
        closed = asyncio.Event()
        asyncio.get_running_loop().call_later(0.0, closed.set)  # after what the watchers had called later
        await closed.wait()
        return [*counts, len(publisher.subscribers)]

    assert asyncio.run(look()) == [1, 0]


def test_pictures_of_another_run_are_forgotten() -> None:
    async def look() -> bool:
        publisher = Publisher()
        feeds = PictureFeeds(publisher.subscribe, lambda reason: None)
        with feeds.watched(FRONT) as feed:
            publisher.publish(sample(0))
            assert feed.newest
            feeds.forget()
            return feed.newest is None

    assert asyncio.run(look())


def test_a_part_ends_with_the_boundary() -> None:
    head, _, rest = picture_part(image(20 * MS)).partition(b"\r\n\r\n")
    assert rest == jpeg() + f"\r\n--{BOUNDARY}\r\n".encode()
    assert b"Content-Length: %d" % len(jpeg()) in head
    assert b"X-Timestamp: 0.016000" in head
