"""The pictures of cameras as HTTP streams: one subscription a camera, however many look at it. Imports aiohttp.

A client that does not read is behind by pictures that it never gets: for each there is the newest picture, and what
its connection holds.
"""

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

from aiohttp import web

from zsim.contract import messages
from zsim.contract.flight_messages import CameraImage
from zsim.errors import DecodeError
from zsim.transport.session import RawSample

ALIVE_S = 10.0  # wall time after which a picture is sent again: time stands, and the client may be gone
LINGER_S = 10.0  # wall time that a subscription outlives its last client: some ask for one picture after the other
BOUNDARY = "zsim-picture"
HEADERS = {"Cache-Control": "no-store", "Access-Control-Allow-Origin": "*"}
Unsubscribe = Callable[[], None]
Subscribe = Callable[[str, Callable[[RawSample], None]], Unsubscribe]


class NumberedPicture(NamedTuple):
    """A picture, and how many came before it."""

    number: int
    image: CameraImage


class PictureFeed:
    """The newest picture of a camera; all on one loop.

    Args:
        key: of its pictures.
        refuse: called with the reason for each message that is no picture.

    Attributes:
        newest: None before the first.
        watchers: who look at it now.
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
        """Take what was published on the key."""
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
        """Return the newest picture if it is later than a number, otherwise the next; None where none comes in time."""
        if self.newest is None or self.newest.number <= number:
            try:
                await asyncio.wait_for(self._arrived.wait(), within_s)
            except TimeoutError:
                return None
        return self.newest


class PictureFeeds:
    """The cameras at which somebody looks, or did until LINGER_S ago.

    Args:
        subscribe: subscribes to a key.
        refuse: see PictureFeed.
    """

    def __init__(self, subscribe: Subscribe, refuse: Callable[[str], None]) -> None:
        self._subscribe = subscribe
        self._refuse = refuse
        self._feeds: dict[str, PictureFeed] = {}

    @contextmanager
    def watched(self, key: str) -> Iterator[PictureFeed]:
        """Yield the feed of a key; to be called on the loop."""
        feed = self._feeds.get(key) or self._open(key)
        feed.watchers += 1
        try:
            yield feed
        finally:
            feed.watchers -= 1
            if not feed.watchers:
                asyncio.get_running_loop().call_later(LINGER_S, self._close_unwatched, key)

    def forget(self) -> None:
        """Forget the newest pictures: another run begins."""
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
    """Send every picture that the client has the time for, until it leaves: multipart/x-mixed-replace."""
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
    """Return a picture as a part with the boundary behind it: browsers show a part only when they have read that."""
    head = f"Content-Type: image/jpeg\r\nContent-Length: {len(image.data)}\r\nX-Timestamp: {_seconds(image)}\r\n\r\n"
    return b"%b%b\r\n--%b\r\n" % (head.encode(), image.data, BOUNDARY.encode())


def as_file(image: CameraImage) -> web.Response:
    """Return one picture."""
    headers = {**HEADERS, "X-Timestamp": _seconds(image)}
    return web.Response(body=image.data, content_type="image/jpeg", headers=headers)


def _seconds(image: CameraImage) -> str:
    """Return the simulated time of a picture's exposure, as a header says it [s]."""
    return f"{image.t_sample_ns / 1e9:.6f}"
