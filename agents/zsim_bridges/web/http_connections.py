"""The connections of an HTTP server: so many at once, and none that is open for long and sends no request.

aiohttp waits for the end of a request's head without a limit; a thousand connections that never end theirs would take
all the files that a process may open. A connection is a stranger until one of its requests has been answered without
an error, or is being answered; strangers never take the places of others.
"""

import asyncio
from collections.abc import Awaitable, Callable

from aiohttp import web

STRANGERS_MAX = 100  # connections at once; the oldest makes room for the next
HEAD_S = 5.0  # wall time in which a stranger has to send the head of a request; a browser on a bad link takes 1 s
CONNECTIONS_MAX = 1000  # twice the gateway's clients
REFUSED_FROM = 400  # HTTP status
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class HttpConnections:
    """Counts the connections of a server, and closes those that have to make room.

    Args:
        strangers_max, connections_max: at once.
        head_s: wall time in which a stranger has to send the head of a request.
    """

    def __init__(
        self, strangers_max: int = STRANGERS_MAX, connections_max: int = CONNECTIONS_MAX, head_s: float = HEAD_S
    ) -> None:
        self._strangers_max = strangers_max
        self._connections_max = connections_max
        self._head_s = head_s
        self._open: dict[asyncio.BaseTransport, HttpConnection] = {}
        self._strangers: dict[HttpConnection, None] = {}  # in the order in which they began to wait
        self._idle: dict[HttpConnection, None] = {}  # known, without a request now; in that order

    def protocol(self, http: asyncio.Protocol) -> "HttpConnection":
        """Return the protocol of a new connection; `http` speaks HTTP on it."""
        return HttpConnection(http, self)

    @web.middleware
    async def observe(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Keep a connection while its request is answered; to be the innermost, behind any check of access."""
        connection = self._open.get(request.transport) if request.transport else None
        if connection is None:
            return await handler(request)
        self._forget(connection)
        try:
            response = await handler(request)
            connection.known = connection.known or response.status < REFUSED_FROM
            return response
        finally:
            if connection.is_open:
                self._wait(connection)

    def enter(self, connection: "HttpConnection", transport: asyncio.Transport) -> bool:
        """Take a new connection; False where there is no room, as all others have a request under way."""
        if len(self._open) >= self._connections_max and not self._make_room(self._strangers, self._idle):
            return False
        if len(self._strangers) >= self._strangers_max:
            self._make_room(self._strangers)
        self._open[transport] = connection
        self._wait(connection)
        return True

    def leave(self, connection: "HttpConnection", transport: asyncio.BaseTransport) -> None:
        """Forget a connection that is closed."""
        self._open.pop(transport, None)
        self._forget(connection)

    def _make_room(self, *groups: "dict[HttpConnection, None]") -> bool:
        """Close the connection that has waited longest, of the first group that has one."""
        for group in groups:
            if group:
                next(iter(group)).cut()
                return True
        return False

    def _wait(self, connection: "HttpConnection") -> None:
        """Let a connection wait for its next request; aiohttp ends the wait of one that is known."""
        if connection.known:
            self._idle[connection] = None
            return
        self._strangers[connection] = None
        connection.timer = asyncio.get_running_loop().call_later(self._head_s, connection.cut)

    def _forget(self, connection: "HttpConnection") -> None:
        self._strangers.pop(connection, None)
        self._idle.pop(connection, None)
        if connection.timer is not None:
            connection.timer.cancel()
            connection.timer = None


class HttpConnection(asyncio.Protocol):
    """One connection: what comes is handed on to who speaks HTTP.

    Attributes:
        known: whether one of its requests was answered without an error.
        timer: cuts a stranger.
    """

    def __init__(self, http: asyncio.Protocol, connections: HttpConnections) -> None:
        self._http = http
        self._connections = connections
        self._transport: asyncio.Transport | None = None
        self.known = False
        self.timer: asyncio.TimerHandle | None = None

    @property
    def is_open(self) -> bool:
        """Whether it was let in and is not closed yet."""
        return self._transport is not None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        if not self._connections.enter(self, transport):
            transport.abort()
            return
        self._transport = transport
        self._http.connection_made(transport)

    def connection_lost(self, exc: Exception | None) -> None:
        if self._transport is not None:
            self._connections.leave(self, self._transport)
            self._transport = None
            self._http.connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        if self._transport is not None:
            self._http.data_received(data)

    def eof_received(self) -> bool | None:
        return self._http.eof_received() if self._transport is not None else None

    def pause_writing(self) -> None:
        self._http.pause_writing()

    def resume_writing(self) -> None:
        self._http.resume_writing()

    def cut(self) -> None:
        """Close it at once; what it has sent is not answered."""
        if self._transport is not None:
            transport = self._transport
            self._connections.leave(self, transport)
            transport.abort()
