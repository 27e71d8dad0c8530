"""Pictures of cameras as HTTP streams, with one subscription for all clients of a camera.

A client that reads slowly misses pictures: it is sent the newest one each time, beside what its connection holds.
"""

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

from aiohttp import web

from zsim.contract import messages
from zsim.contract.camera_messages import CameraImage
from zsim.errors import DecodeError
from zsim.transport.session import RawSample

ALIVE_S = 10.0  # wall time after which a picture is sent again: in a paused run the client may have gone
LINGER_S = 10.0  # wall time that a subscription outlives its last client: some request single pictures
BOUNDARY = "zsim-picture"
HEADERS = {"Cache-Control": "no-store", "Access-Control-Allow-Origin": "*"}
Unsubscribe = Callable[[], None]
Subscribe = Callable[[str, Callable[[RawSample], None]], Unsubscribe]


class NumberedPicture(NamedTuple):
    """A picture, and the number of those before it."""

    number: int
    image: CameraImage


class PictureFeed:
    """The newest picture of a camera, for clients on one loop.

    Args:
        key: of its pictures.
        refuse: called with the reason for each message that is no picture.

    Attributes:
        newest: None before the first.
        watchers: number of clients.
        stop: ends its subscription.
    """

    def __init__(self, key: str, refuse: Callable[[str], None]) -> None:
        self._key = key
        self._refuse = refuse
        self._arrived = asyncio.Event()
        self._count = 0
        self.newest: NumberedPicture | None = None
        self.watchers = 0
        self.stop: Unsubscribe = lambda: None

    def take(self, sample: RawSample) -> None:
        """Take a sample of the key."""
        try:
            image: CameraImage = messages.decode(self._key, sample.payload)
        except DecodeError as error:
            self._refuse(str(error))
            return
        self.newest = NumberedPicture(self._count, image)
        self._count += 1
        arrived, self._arrived = self._arrived, asyncio.Event()
        arrived.set()

    async def after(self, number: int, within_s: float) -> NumberedPicture | None:
        """Return the newest picture if its number is greater, otherwise the next; None if none arrives in time."""
        if self.newest is None or self.newest.number <= number:
            try:
                await asyncio.wait_for(self._arrived.wait(), within_s)
            except TimeoutError:
                return None
        return self.newest


class PictureFeeds:
    """The feeds of all cameras with clients, at present or within LINGER_S."""

    def __init__(self, subscribe: Subscribe, refuse: Callable[[str], None]) -> None:
        self._subscribe = subscribe
        self._refuse = refuse
        self._feeds: dict[str, PictureFeed] = {}

    @contextmanager
    def watched(self, key: str) -> Iterator[PictureFeed]:
        """Yield the feed of a key, on the loop."""
        feed = self._feeds.get(key) or self._open(key)
        feed.watchers += 1
        try:
            yield feed
        finally:
            feed.watchers -= 1
            if not feed.watchers:
                asyncio.get_running_loop().call_later(LINGER_S, self._close_unwatched, key)

    def forget(self) -> None:
        """Drop the newest pictures: another run begins."""
        for feed in self._feeds.values():
            feed.newest = None

    def _open(self, key: str) -> PictureFeed:
        feed = PictureFeed(key, self._refuse)
        feed.stop = self._subscribe(key, feed.take)
        self._feeds[key] = feed
        return feed

    def _close_unwatched(self, key: str) -> None:
        feed = self._feeds.get(key)
        if feed is not None and not feed.watchers:
            del self._feeds[key]
            feed.stop()


async def stream_pictures(request: web.Request, feed: PictureFeed) -> web.StreamResponse:
    """Send pictures as multipart/x-mixed-replace, as fast as the client reads, until it leaves."""
    kind = f"multipart/x-mixed-replace; boundary={BOUNDARY}"
    response = web.StreamResponse(headers={**HEADERS, "Content-Type": kind})
    try:
        await response.prepare(request)
        await response.write(b"--%b\r\n" % BOUNDARY.encode())
        number = -1
        while request.transport is not None and not request.transport.is_closing():
            picture = await feed.after(number, ALIVE_S) or feed.newest
            if picture is not None:
                number = picture.number
                await response.write(part(picture.image))
    except ConnectionError:
        return response  # the client is gone
    return response


def part(image: CameraImage) -> bytes:
    """Return a picture as a part followed by the boundary, which browsers read before they show the part."""
    head = f"Content-Type: image/jpeg\r\nContent-Length: {len(image.data)}\r\nX-Timestamp: {_seconds(image)}\r\n\r\n"
    return b"%b%b\r\n--%b\r\n" % (head.encode(), image.data, BOUNDARY.encode())


def as_file(image: CameraImage) -> web.Response:
    """Return one picture."""
    headers = {**HEADERS, "X-Timestamp": _seconds(image)}
    return web.Response(body=image.data, content_type="image/jpeg", headers=headers)


def _seconds(image: CameraImage) -> str:
    """Return the simulated time of a picture's exposure for a header [s]."""
    return f"{image.t_sample_ns / 1e9:.6f}"
