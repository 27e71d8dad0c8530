"""Pictures for the pages that are open: each is sent what it asks for, when it has shown what it was sent before."""

import asyncio
from collections.abc import Callable
from typing import Annotated, Any

import msgspec
from aiohttp import WSMsgType, web
from msgspec import Meta, Struct

from zsim_bridges.console.cameras.camera_feed import CameraFeed
from zsim_bridges.console.scene.camera_frustums import CameraFrustums
from zsim_bridges.console.server.http_proxy import HEARTBEAT_S
from zsim_bridges.console.server.page_actions import Name

PERIOD_S = 0.1  # wall, from a picture of a camera to the next, at least
WANTED_MAX = 16  # pictures on one page
REQUEST_MAX = 10_000  # bytes


class PicturesRequest(Struct, frozen=True, forbid_unknown_fields=True):
    """What a page asks for; each request is also the word that it has shown what it was sent before."""

    page: Name = ""
    want: Annotated[tuple[Name, ...], Meta(max_length=WANTED_MAX)] = ()
    frustum: Name = ""
    """The camera whose frustum is shown in the page's scene; empty for none."""


_DECODER = msgspec.json.Decoder(PicturesRequest)
NOTHING = PicturesRequest()


class PageBatches:
    """What one page is sent: of each camera what has changed since, all in one message.

    A message is the length of its header (4 bytes, big-endian), the header as JSON, and the JPEGs one after the other.
    The header has `cameras` (name, width, height; null if they are as before) and `pictures` (camera, size [bytes; 0:
    the picture is as before], t_s, marks), and `clicked` where a drone was clicked in the scene.
    """

    def __init__(self) -> None:
        self._cameras: list[dict[str, Any]] = []
        self._shown: dict[str, tuple[Any, ...]] = {}

    def next(self, feed: CameraFeed | None, want: tuple[str, ...], clicked: str = "") -> bytes | None:
        """Return the next message, None while nothing has changed and no drone was clicked."""
        listed = self._listed(feed)
        pictures = [] if feed is None else [self._picture(feed, camera) for camera in dict.fromkeys(want)]
        changed = [each for each in pictures if each is not None]
        if listed is None and not changed and not clicked:
            return None
        told = {"cameras": listed, "pictures": [entry for entry, _ in changed]}
        header = msgspec.json.encode({**told, "clicked": clicked} if clicked else told)
        return b"".join((len(header).to_bytes(4, "big"), header, *(data for _, data in changed)))

    def _listed(self, feed: CameraFeed | None) -> list[dict[str, Any]] | None:
        """Return the cameras that there are, None if they are as before."""
        found = [] if feed is None else feed.cameras()
        cameras = [{"name": name, "width": info.width, "height": info.height} for name, info in found]
        if cameras == self._cameras:
            return None
        self._cameras, self._shown = cameras, {}
        return cameras

    def _picture(self, feed: CameraFeed, camera: str) -> tuple[dict[str, Any], bytes] | None:
        """Return what has changed of a picture, None if nothing has."""
        picture = feed.picture(camera)
        if picture is None:
            return None
        shown, marks = self._shown.get(camera), feed.marks(camera)
        now = (feed, picture.number, marks)
        if shown == now:
            return None
        self._shown[camera] = now
        data = b"" if shown is not None and shown[:2] == now[:2] else picture.image.data
        t_s = picture.image.t_sample_ns / 1e9
        return {"camera": camera, "size": len(data), "t_s": t_s, "marks": marks}, data


class CameraSockets:
    """The sockets of all pages.

    Args:
        feed: returns the cameras of the run that is shown, None without one.
        frustums: in the scenes of the pages.
    """

    def __init__(self, feed: Callable[[], CameraFeed | None], frustums: CameraFrustums) -> None:
        self._feed = feed
        self._frustums = frustums

    async def respond(self, request: web.Request) -> web.StreamResponse:
        """Answer a request for a socket; return when it has closed."""
        socket = web.WebSocketResponse(compress=False, max_msg_size=REQUEST_MAX, heartbeat=HEARTBEAT_S)
        await socket.prepare(request)
        await self.serve(socket)
        await socket.close()
        return socket

    async def serve(self, socket: web.WebSocketResponse) -> None:
        """Send pictures until the page closes its socket."""
        page = _Page(socket, self._feed, self._frustums)
        sending = asyncio.ensure_future(page.send())
        try:
            await page.receive()
        finally:
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)
            page.leave()


class _Page:
    """One page and its socket."""

    def __init__(
        self,
        socket: web.WebSocketResponse,
        feed: Callable[[], CameraFeed | None],
        frustums: CameraFrustums,
    ) -> None:
        self._socket = socket
        self._feed = feed
        self._frustums = frustums
        self._request = NOTHING
        self._ready = asyncio.Event()

    async def receive(self) -> None:
        """Take requests until the socket closes, or says what is none."""
        async for message in self._socket:
            if message.type is not WSMsgType.TEXT:
                return
            try:
                self._request = _DECODER.decode(message.data)
            except (msgspec.MsgspecError, ValueError, RecursionError):
                return
            self._frustums.choose(self._request.page, self._request.frustum)
            self._ready.set()

    async def send(self) -> None:
        """Send what has changed, no oftener than PERIOD_S, and nothing before the page has shown the last."""
        batches = PageBatches()
        while True:
            await self._ready.wait()
            feed, want = self._feed(), self._request.want
            if feed is not None:
                feed.ask(self, (*want, self._request.frustum) if self._request.frustum else want)
            batch = batches.next(feed, want, self._frustums.take_click(self._request.page))
            if batch is not None:
                self._ready.clear()
                await self._socket.send_bytes(batch)
            await asyncio.sleep(PERIOD_S)

    def leave(self) -> None:
        """Show and ask for nothing any more."""
        self._frustums.choose(self._request.page, "")
        feed = self._feed()
        if feed is not None:
            feed.release(self)
