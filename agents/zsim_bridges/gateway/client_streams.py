"""Byte streams to clients: lines of JSON on TCP, text messages on a WebSocket, server-sent events.

Each client has a bounded outbox, so that one that does not read costs the others nothing.
"""

import asyncio
import socket
from collections import deque
from collections.abc import Callable, Coroutine
from contextlib import suppress
from typing import Any, Protocol

import msgspec
from aiohttp import WSMsgType, web

from zsim.transport.session import RawSample
from zsim_bridges.gateway.publications import SharedSubscriptions

OUTBOX_BYTES_MAX = 4_000_000  # about 20 s of a drone's sensors as JSON
FLUSH_S = 2.0  # how long the rest may take to be sent to a client that closes its connection
LINES_PER_TURN = 100  # lines of one client after which the other tasks of the loop run
LINE_MAX = 1_000_000  # bytes of a request
HEARTBEAT_S = 20.0  # wall time after which a WebSocket whose client is gone is noticed
ALIVE_S = 10.0  # wall time after which a comment shows that a stream of events still lives
_SOCKET_OPTIONS = (
    (socket.IPPROTO_TCP, "TCP_NODELAY", 1),
    (socket.SOL_SOCKET, "SO_KEEPALIVE", 1),
    (socket.IPPROTO_TCP, "TCP_KEEPIDLE", 5),  # s of silence before the first keepalive probe
    (socket.IPPROTO_TCP, "TCP_KEEPINTVL", 2),  # s between two probes
    (socket.IPPROTO_TCP, "TCP_KEEPCNT", 3),  # probes without an answer that end a connection
    (socket.IPPROTO_TCP, "TCP_USER_TIMEOUT", 15_000),  # ms without an acknowledgement of sent data
)

Half = Coroutine[Any, Any, None]
EventOf = Callable[[RawSample], bytes]
"""Makes the event of a publication; an empty one is not sent."""


class Outbox:
    """Lines for one client. When it is full the oldest values are lost; losing an answer ends the connection.

    Args:
        cut: ends the connection at once.
        lost_line: makes the line that reports how many values were lost.
        bytes_max: of the lines that wait.
    """

    def __init__(
        self, cut: Callable[[], None], lost_line: Callable[[int], bytes], bytes_max: int = OUTBOX_BYTES_MAX
    ) -> None:
        self._cut = cut
        self._lost_line = lost_line
        self._lines: deque[tuple[bytes, bool]] = deque()
        self._bytes = 0
        self._bytes_max = bytes_max
        self._filled = asyncio.Event()
        self._lost = 0
        self._closed = False

    def put(self, line: bytes, droppable: bool = False) -> None:
        """Add a line; to be called on the loop.

        Args:
            line: with its end.
            droppable: whether it may be lost: a newer one of its kind replaces it.
        """
        if self._closed:
            return
        self._lines.append((line, droppable))
        self._bytes += len(line)
        while self._bytes > self._bytes_max and len(self._lines) > 1:
            oldest, was_droppable = self._lines.popleft()
            self._bytes -= len(oldest)
            self._lost += 1
            if not was_droppable:
                self._closed = True
                self._cut()
        self._filled.set()

    def close(self) -> None:
        """Let `take` end once nothing waits any more."""
        self._closed = True
        self._filled.set()

    async def take(self) -> list[bytes]:
        """Return all lines that wait, as soon as there are any; nothing once it is closed and empty."""
        while not self._lines and not self._closed:
            await self._filled.wait()
            self._filled.clear()
        taken = [self._lost_line(self._lost)] if self._lost else []
        taken += [line for line, _ in self._lines]
        self._lost = 0
        self._lines.clear()
        self._bytes = 0
        return taken


class StreamHandler(Protocol):
    """The client behind a stream."""

    async def handle_line(self, line: bytes) -> None:
        """Execute the request in a line."""
        ...

    def refuse_line(self, error: str) -> None:
        """Answer a line that cannot be read."""
        ...

    def close(self) -> None:
        """End everything that the client has."""
        ...


ClientFactory = Callable[[Outbox, bool], StreamHandler]
"""Makes the client of a connection from its outbox and whether it is authenticated; it may be refused already."""


async def run_duplex(reading: Half, sending: Half, finish: Callable[[], None], cut: Callable[[], None]) -> None:
    """Read and send until one of the two ends; then send the rest.

    Args:
        reading: ends with the client's last request.
        sending: ends when nothing is to be sent any more.
        finish: ends the client, so that sending ends.
        cut: ends the connection at once, for a client that does not take the rest.
    """
    reader, sender = asyncio.create_task(reading), asyncio.create_task(sending)
    try:
        await asyncio.wait({reader, sender}, return_when=asyncio.FIRST_COMPLETED)
        finish()
        await asyncio.wait({sender}, timeout=FLUSH_S)
    finally:
        finish()
        if not sender.done():
            cut()
        for half in (reader, sender):
            half.cancel()
        await asyncio.gather(reader, sender, return_exceptions=True)


# Lines on TCP


class LineServer:
    """Serves connections of lines.

    Args:
        new_client: see ClientFactory.
        authenticated: whether no token is needed.
    """

    def __init__(self, new_client: ClientFactory, authenticated: bool) -> None:
        self._new_client = new_client
        self._authenticated = authenticated

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve a connection until it ends."""
        cut = writer.transport.abort
        outbox = Outbox(cut, _lost_line)
        _set_socket_options(writer)
        client = self._new_client(outbox, self._authenticated)
        with suppress(asyncio.CancelledError):  # the gateway ends
            await run_duplex(_read_lines(client, reader), _send_lines(outbox, writer), client.close, cut)
        writer.close()


async def _read_lines(client: StreamHandler, reader: asyncio.StreamReader) -> None:
    """Handle line by line; a browser whose page makes it send an HTTP request here is refused."""
    count = 0
    while line := await _next_line(client, reader):
        if count == 0 and not line.lstrip().startswith(b"{"):
            client.refuse_line("request: is no JSON object a line; see docs/gateway.md")
            return
        await client.handle_line(line)
        count += 1
        if count % LINES_PER_TURN == 0:
            await asyncio.sleep(0)


async def _next_line(client: StreamHandler, reader: asyncio.StreamReader) -> bytes:
    """Return the next line, empty at the end."""
    try:
        return await reader.readuntil(b"\n")
    except ConnectionError:
        return b""
    except asyncio.IncompleteReadError as error:
        return error.partial
    except asyncio.LimitOverrunError:
        client.refuse_line(f"request: is longer than {LINE_MAX} bytes; the connection ends")
        return b""


async def _send_lines(outbox: Outbox, writer: asyncio.StreamWriter) -> None:
    with suppress(ConnectionError):
        while lines := await outbox.take():
            writer.write(b"".join(lines))
            await writer.drain()


def _set_socket_options(writer: asyncio.StreamWriter) -> None:
    """Send every line at once, since one that waits for more is late; notice hosts that are gone."""
    raw = writer.get_extra_info("socket")
    for level, name, value in _SOCKET_OPTIONS:
        if raw is not None and hasattr(socket, name):
            raw.setsockopt(level, getattr(socket, name), value)


def _lost_line(lost: int) -> bytes:
    """Return the line that reports how many values were lost."""
    return msgspec.json.encode({"op": "lost", "lines": lost}) + b"\n"


# Text messages on a WebSocket


async def serve_websocket(request: web.Request, new_client: ClientFactory) -> web.WebSocketResponse:
    """Serve a WebSocket, whose request has been authenticated, until it ends: a text message is a line."""
    websocket = web.WebSocketResponse(max_msg_size=LINE_MAX, heartbeat=HEARTBEAT_S)
    await websocket.prepare(request)
    cut = _cutter(request)
    outbox = Outbox(cut, _lost_line)
    client = new_client(outbox, True)
    await run_duplex(_read_messages(client, websocket), _send_messages(outbox, websocket), client.close, cut)
    return websocket


def _cutter(request: web.Request) -> Callable[[], None]:
    return request.transport.abort if request.transport is not None else lambda: None


async def _read_messages(client: StreamHandler, websocket: web.WebSocketResponse) -> None:
    async for message in websocket:
        if message.type in (WSMsgType.TEXT, WSMsgType.BINARY):
            data = message.data
            await client.handle_line(data.encode() if isinstance(data, str) else data)


async def _send_messages(outbox: Outbox, websocket: web.WebSocketResponse) -> None:
    with suppress(ConnectionError):
        while lines := await outbox.take():
            for line in lines:
                await websocket.send_str(line[:-1].decode())


# Server-sent events


async def stream_events(
    request: web.Request, subscriptions: SharedSubscriptions, expression: str, event_of: EventOf
) -> web.StreamResponse:
    """Send every publication on an expression until the client leaves.

    Args:
        request: to be answered.
        subscriptions: to the keys of the expression.
        expression: what to subscribe to.
        event_of: see EventOf.

    Raises:
        SessionError: it is no key expression.
        TooManyError: the limit of streams is reached.
    """
    outbox = Outbox(_cutter(request), _lost_comment)

    def put(sample: RawSample) -> None:
        if event := event_of(sample):
            outbox.put(event, droppable=True)

    unsubscribe = subscriptions.subscribe_stream(expression, put)
    headers = {"Content-Type": "text/event-stream", "Cache-Control": "no-cache", "Access-Control-Allow-Origin": "*"}
    response = web.StreamResponse(headers=headers)
    try:
        await response.prepare(request)
        while True:
            await response.write(await _next_chunk(outbox))
    except ConnectionError:
        return response
    finally:
        unsubscribe()


async def _next_chunk(outbox: Outbox) -> bytes:
    try:
        return b"".join(await asyncio.wait_for(outbox.take(), ALIVE_S))
    except TimeoutError:
        return b": still here\n\n"


def _lost_comment(lost: int) -> bytes:
    return b": %d events were lost, they came faster than they were read\n\n" % lost


def event_bytes(kind: str, data: bytes) -> bytes:
    """Return a server-sent event."""
    return b"event: %b\ndata: %b\n\n" % (kind.encode(), data)
