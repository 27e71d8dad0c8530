"""Byte streams to clients: lines of JSON on TCP, text messages on a WebSocket, server-sent events, and pictures.

Each client has a bounded outbox, so that a client that stops reading does not affect the others.
"""

import asyncio
import socket
from collections import deque
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple, Protocol

import msgspec
from aiohttp import WSMsgType, web

from zsim.contract import messages
from zsim.contract.flight_messages import CameraImage
from zsim.errors import DecodeError
from zsim.transport.session import RawSample
from zsim_bridges.gateway.run_access import SharedSubscriptions

OUTBOX_BYTES_MAX = 4_000_000  # about 20 s of a drone's sensors as JSON
FLUSH_S = 2.0  # time limit for sending the remaining lines once a connection ends
LINES_PER_TURN = 100  # consecutive lines of one client after which other tasks of the loop may run
LINE_MAX = 1_000_000  # size limit of a request [bytes]
HEARTBEAT_S = 20.0  # wall; period of the pings that detect a WebSocket whose client is gone
KEEPALIVE_S = 10.0  # wall; silence after which a stream sends a keepalive, to detect a client that is gone
LINGER_S = 10.0  # wall; how long a camera's subscription outlives its last client: some clients request single pictures
BOUNDARY = "zsim-picture"
PICTURE_HEADERS = {"Cache-Control": "no-store", "Access-Control-Allow-Origin": "*"}
_SOCKET_OPTIONS = (
    (socket.IPPROTO_TCP, "TCP_NODELAY", 1),  # send a line at once, without waiting for more
    (socket.SOL_SOCKET, "SO_KEEPALIVE", 1),  # detect hosts that are gone
    (socket.IPPROTO_TCP, "TCP_KEEPIDLE", 5),  # s of silence before the first keepalive probe
    (socket.IPPROTO_TCP, "TCP_KEEPINTVL", 2),  # s between probes
    (socket.IPPROTO_TCP, "TCP_KEEPCNT", 3),  # unanswered probes that end a connection
    (socket.IPPROTO_TCP, "TCP_USER_TIMEOUT", 15_000),  # ms without an acknowledgement of sent data
)

StreamCoroutine = Coroutine[Any, Any, None]


class Outbox:
    """A queue of lines for one client. When full, it drops the oldest lines; dropping an answer ends the connection.

    Args:
        abort: ends the connection at once.
        lost_line: returns the line that reports how many values were dropped.
        bytes_max: limit of the total size of the waiting lines.
    """

    def __init__(
        self, abort: Callable[[], None], lost_line: Callable[[int], bytes], bytes_max: int = OUTBOX_BYTES_MAX
    ) -> None:
        self._abort = abort
        self._lost_line = lost_line
        self._lines: deque[tuple[bytes, bool]] = deque()
        self._bytes = 0
        self._bytes_max = bytes_max
        self._filled = asyncio.Event()
        self._lost_count = 0
        self._closed = False

    def put(self, line: bytes, droppable: bool = False) -> None:
        """Add a line with its newline; call on the loop. A line is droppable if a newer one of its kind replaces it."""
        if self._closed:
            return
        self._lines.append((line, droppable))
        self._bytes += len(line)
        while self._bytes > self._bytes_max and len(self._lines) > 1:
            oldest, was_droppable = self._lines.popleft()
            self._bytes -= len(oldest)
            self._lost_count += 1
            if not was_droppable:
                self._closed = True
                self._abort()
        self._filled.set()

    def close(self) -> None:
        """Let `take` end once the queue is empty."""
        self._closed = True
        self._filled.set()

    async def take(self) -> list[bytes]:
        """Return all waiting lines, as soon as there are any; nothing once the queue is closed and empty."""
        while not self._lines and not self._closed:
            await self._filled.wait()
            self._filled.clear()
        lines = [self._lost_line(self._lost_count)] if self._lost_count else []
        lines += [line for line, _ in self._lines]
        self._lost_count = 0
        self._lines.clear()
        self._bytes = 0
        return lines


class StreamHandler(Protocol):
    """The client behind a stream."""

    async def handle_line(self, line: bytes) -> None: ...
    def refuse_line(self, error: str) -> None: ...
    def close(self) -> None: ...


ClientFactory = Callable[[Outbox, bool], StreamHandler]
"""Creates the client of a connection from its outbox and whether it is authenticated; may refuse it."""


async def run_duplex(
    reading: StreamCoroutine, sending: StreamCoroutine, finish: Callable[[], None], abort: Callable[[], None]
) -> None:
    """Read and send concurrently until either ends; then send the rest.

    Args:
        reading: ends with the client's last request.
        sending: ends when nothing remains to be sent.
        finish: ends the client, so that sending ends.
        abort: ends the connection at once if the client does not receive the rest in time.
    """
    reader, sender = asyncio.create_task(reading), asyncio.create_task(sending)
    try:
        await asyncio.wait({reader, sender}, return_when=asyncio.FIRST_COMPLETED)
        finish()
        await asyncio.wait({sender}, timeout=FLUSH_S)
    finally:
        finish()
        if not sender.done():
            abort()
        for task in (reader, sender):
            task.cancel()
        await asyncio.gather(reader, sender, return_exceptions=True)


def _lost_line(count: int) -> bytes:
    return msgspec.json.encode({"op": "lost", "lines": count}) + b"\n"


# Lines on TCP


async def serve_lines(
    new_client: ClientFactory, authenticated: bool, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
) -> None:
    """Serve a TCP connection until it ends; if `authenticated`, the client needs no token."""
    abort = writer.transport.abort
    outbox = Outbox(abort, _lost_line)
    raw = writer.get_extra_info("socket")
    for level, name, value in _SOCKET_OPTIONS:
        if raw is not None and hasattr(socket, name):
            raw.setsockopt(level, getattr(socket, name), value)
    client = new_client(outbox, authenticated)

    async def send() -> None:
        with suppress(ConnectionError):
            while lines := await outbox.take():
                writer.write(b"".join(lines))
                await writer.drain()

    with suppress(asyncio.CancelledError):  # the gateway exits
        await run_duplex(_read_lines(client, reader), send(), client.close, abort)
    writer.close()


async def _read_lines(client: StreamHandler, reader: asyncio.StreamReader) -> None:
    """Process the lines; refuse an HTTP request, which a malicious web page may make a browser send here."""
    count = 0
    while True:
        try:
            line = await reader.readuntil(b"\n")
        except ConnectionError:
            return
        except asyncio.IncompleteReadError as error:
            line = error.partial
        except asyncio.LimitOverrunError:
            client.refuse_line(f"request: is longer than {LINE_MAX} bytes; the connection ends")
            return
        if not line:
            return
        if count == 0 and not line.lstrip().startswith(b"{"):
            client.refuse_line("request: is not one JSON object per line; see docs/gateway.md")
            return
        await client.handle_line(line)
        count += 1
        if count % LINES_PER_TURN == 0:
            await asyncio.sleep(0)


# Text messages on a WebSocket


async def serve_websocket(request: web.Request, new_client: ClientFactory) -> web.WebSocketResponse:
    """Serve a WebSocket until it ends: each message is a line. The request has already been authenticated."""
    websocket = web.WebSocketResponse(max_msg_size=LINE_MAX, heartbeat=HEARTBEAT_S)
    await websocket.prepare(request)
    abort = _abort_of(request)
    outbox = Outbox(abort, _lost_line)
    client = new_client(outbox, True)

    async def read() -> None:
        async for message in websocket:
            if message.type in (WSMsgType.TEXT, WSMsgType.BINARY):
                data = message.data
                await client.handle_line(data.encode() if isinstance(data, str) else data)

    async def send() -> None:
        with suppress(ConnectionError):
            while lines := await outbox.take():
                for line in lines:
                    await websocket.send_str(line[:-1].decode())

    await run_duplex(read(), send(), client.close, abort)
    return websocket


def _abort_of(request: web.Request) -> Callable[[], None]:
    return request.transport.abort if request.transport is not None else lambda: None


# Server-sent events


async def stream_events(
    request: web.Request,
    subscriptions: SharedSubscriptions,
    expression: str,
    event_of: Callable[[RawSample], bytes],
) -> web.StreamResponse:
    """Send every publication on an expression, as `event_of` formats it, until the client is gone; skip empty events.

    For errors see `SharedSubscriptions.subscribe_stream`.
    """
    comment = b": %d events were lost, since they came faster than they were read\n\n"
    outbox = Outbox(_abort_of(request), lambda count: comment % count)

    def put(sample: RawSample) -> None:
        if event := event_of(sample):
            outbox.put(event, droppable=True)

    unsubscribe = subscriptions.subscribe_stream(expression, put)
    headers = {"Content-Type": "text/event-stream", "Cache-Control": "no-cache", "Access-Control-Allow-Origin": "*"}
    response = web.StreamResponse(headers=headers)
    try:
        await response.prepare(request)
        while True:
            try:
                async with asyncio.timeout(KEEPALIVE_S):
                    chunk = b"".join(await outbox.take())
            except TimeoutError:
                chunk = b": still here\n\n"
            await response.write(chunk)
    except ConnectionError:
        return response
    finally:
        unsubscribe()


# Camera pictures, with one subscription per camera for all its clients. A slow client misses pictures: each time, it is
# sent the newest one.


class NumberedPicture(NamedTuple):
    """A picture, and the number of pictures before it."""

    number: int
    image: CameraImage


class PictureFeed:
    """The newest picture of a camera, for all its clients on one loop.

    `refuse` is called with the reason for each message that is not a picture; `stop` ends the camera's subscription.
    """

    def __init__(self, key: str, refuse: Callable[[str], None]) -> None:
        self._key = key
        self._refuse = refuse
        self._arrived = asyncio.Event()
        self._count = 0
        self.newest: NumberedPicture | None = None
        self.watchers = 0  # number of clients
        self.stop: Callable[[], None] = lambda: None

    def receive(self, sample: RawSample) -> None:
        try:
            image: CameraImage = messages.decode(self._key, sample.payload)
        except DecodeError as error:
            self._refuse(str(error))
            return
        self.newest = NumberedPicture(self._count, image)
        self._count += 1
        arrived, self._arrived = self._arrived, asyncio.Event()
        arrived.set()

    async def wait_after(self, number: int, timeout_s: float) -> NumberedPicture | None:
        """Return the newest picture if it comes after `number`, otherwise the next; None if none arrives in time."""
        if self.newest is None or self.newest.number <= number:
            try:
                async with asyncio.timeout(timeout_s):
                    await self._arrived.wait()
            except TimeoutError:
                return None
        return self.newest


class PictureFeeds:
    """The feeds of cameras that have, or recently had, clients; `subscribe` returns a function to unsubscribe."""

    def __init__(
        self,
        subscribe: Callable[[str, Callable[[RawSample], None]], Callable[[], None]],
        refuse: Callable[[str], None],
    ) -> None:
        self._subscribe = subscribe
        self._refuse = refuse
        self._feeds: dict[str, PictureFeed] = {}

    @contextmanager
    def watched(self, key: str) -> Iterator[PictureFeed]:
        """Yield the feed of a key; call on the loop."""
        feed = self._feeds.get(key)
        if feed is None:
            feed = PictureFeed(key, self._refuse)
            feed.stop = self._subscribe(key, feed.receive)
            self._feeds[key] = feed
        feed.watchers += 1
        try:
            yield feed
        finally:
            feed.watchers -= 1
            if not feed.watchers:
                asyncio.get_running_loop().call_later(LINGER_S, self._close_unwatched, key)

    def _close_unwatched(self, key: str) -> None:
        feed = self._feeds.get(key)
        if feed is not None and not feed.watchers:
            del self._feeds[key]
            feed.stop()

    def clear_pictures(self) -> None:
        """Drop the newest pictures, as another run begins."""
        for feed in self._feeds.values():
            feed.newest = None


async def stream_pictures(request: web.Request, feed: PictureFeed) -> web.StreamResponse:
    """Send pictures as multipart/x-mixed-replace, as fast as the client reads, until it is gone."""
    kind = f"multipart/x-mixed-replace; boundary={BOUNDARY}"
    response = web.StreamResponse(headers={**PICTURE_HEADERS, "Content-Type": kind})
    try:
        await response.prepare(request)
        await response.write(b"--%b\r\n" % BOUNDARY.encode())
        number = -1
        while request.transport is not None and not request.transport.is_closing():
            # The newest picture is repeated, to detect a client that is gone.
            picture = await feed.wait_after(number, KEEPALIVE_S) or feed.newest
            if picture is not None:
                number = picture.number
                await response.write(picture_part(picture.image))
    except ConnectionError:
        return response  # the client is gone
    return response


def picture_part(image: CameraImage) -> bytes:
    """Return a picture as a part with the boundary after it, for which browsers wait before they show the part."""
    headers = f"Content-Type: image/jpeg\r\nContent-Length: {len(image.data)}\r\n"
    head = f"{headers}X-Timestamp: {exposure_s(image)}\r\n\r\n"
    return b"%b%b\r\n--%b\r\n" % (head.encode(), image.data, BOUNDARY.encode())


def exposure_s(image: CameraImage) -> str:
    """Return the simulated time [s] of a picture's exposure as the text of a header."""
    return f"{image.t_sample_ns / 1e9:.6f}"
