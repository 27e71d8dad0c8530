"""Clients on TCP: a JSON object a line, both ways."""

import asyncio
import socket
from collections.abc import Callable
from contextlib import suppress

from zsim_bridges.gateway.lines.duplex import run_duplex
from zsim_bridges.gateway.lines.outbox import Outbox
from zsim_bridges.gateway.lines.stream_client import Client, lost_line

LINES_PER_TURN = 100  # lines after which the others have a turn
LINE_MAX = 1_000_000  # bytes of a request
ClientFactory = Callable[[Outbox, bool], Client]
"""Makes the client of a connection from its outbox and whether it has shown the token; it may be refused already."""


class LineServer:
    """The door.

    Args:
        meet: see Meet.
        trusted: whether no token is asked for.
    """

    def __init__(self, meet: ClientFactory, trusted: bool) -> None:
        self._new_client = meet
        self._trusted = trusted

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve a connection until it ends."""
        outbox = Outbox(writer.transport.abort, lost_line)
        _set_socket_options(writer)
        client = self._new_client(outbox, self._trusted)
        with suppress(asyncio.CancelledError):  # the gateway ends
            await run_duplex(_read(client, reader), _send(outbox, writer), client.close, writer.transport.abort)
        writer.close()


async def _read(client: Client, reader: asyncio.StreamReader) -> None:
    """Hand over line by line; a page that makes a browser send its request here is no client."""
    is_first, lines = True, 0
    while line := await _next_line(client, reader):
        if is_first and not line.lstrip().startswith(b"{"):
            client.send({"op": "error", "error": "request: is no JSON object a line; see docs/gateway.md"})
            return
        is_first = False
        await client.handle_line(line)
        lines += 1
        if lines % LINES_PER_TURN == 0:
            await asyncio.sleep(0)


async def _next_line(client: Client, reader: asyncio.StreamReader) -> bytes:
    """Return the next line, empty at the end."""
    try:
        return await reader.readuntil(b"\n")
    except ConnectionError:
        return b""
    except asyncio.IncompleteReadError as error:
        return error.partial
    except asyncio.LimitOverrunError:
        client.send({"op": "error", "error": f"request: is longer than {LINE_MAX} bytes; the connection ends"})
        return b""


async def _send(outbox: Outbox, writer: asyncio.StreamWriter) -> None:
    try:
        while lines := await outbox.take():
            writer.write(b"".join(lines))
            await writer.drain()
    except ConnectionError:
        return


def _set_socket_options(writer: asyncio.StreamWriter) -> None:
    """Send every line when it is written, since an answer that waits for more is late; notice hosts that are gone."""
    raw = writer.get_extra_info("socket")
    for level, name, value in _OPTIONS:
        if raw is not None and hasattr(socket, name):
            raw.setsockopt(level, getattr(socket, name), value)


_OPTIONS = (
    (socket.IPPROTO_TCP, "TCP_NODELAY", 1),
    (socket.SOL_SOCKET, "SO_KEEPALIVE", 1),
    (socket.IPPROTO_TCP, "TCP_KEEPIDLE", 5),  # s of silence until the other host is asked whether it is there
    (socket.IPPROTO_TCP, "TCP_KEEPINTVL", 2),  # s between two questions
    (socket.IPPROTO_TCP, "TCP_KEEPCNT", 3),  # questions without an answer that end a connection
    (socket.IPPROTO_TCP, "TCP_USER_TIMEOUT", 15_000),  # ms without a receipt that end one to which something is sent
)
