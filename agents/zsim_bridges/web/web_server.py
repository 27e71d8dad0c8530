"""Parts shared by the console's and gateway's web servers: event loop thread, listening, access, bounded connections.

aiohttp waits indefinitely for the end of a request, and keeps the part of its body that has arrived; a thousand
connections with unfinished requests would take a gigabyte, and all file descriptors of the process. A connection is a
stranger until one of its requests has been answered without an error, except while a request is being answered. A new
connection for which there is no room displaces a stranger, or else an idle connection.
"""

import asyncio
import errno
import hmac
import logging
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Iterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from typing import Any, NamedTuple, TypeVar

from aiohttp import web

from zsim.errors import RunError
from zsim_bridges.web import is_loopback

STRANGERS_MAX = 100  # simultaneous connections of strangers; the oldest makes room for the next
REQUEST_S = 5.0  # wall time in which a request must arrive with its body; a browser on a bad link takes 1 s
SMALL_BYTES = 16_384  # size of a body that is always accepted; commands and requests have a few hundred bytes
BODY_BYTES_MAX = 16_000_000  # total size of all larger bodies at once; 16 of the largest that the gateway accepts
CONNECTIONS_MAX = 1000  # twice the gateway's maximum number of clients
ERROR_STATUS_MIN = 400  # lowest HTTP status of an error
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]
ANY_PORT = 0  # lets the kernel choose
BACKLOG = 128  # connections that the kernel queues until they are accepted; aiohttp's default
READ_BYTES = 16_384  # buffer for a body that no handler has read yet; a connection buffers up to twice as much
Resource = TypeVar("Resource")
_NO_LOG = logging.Logger("quiet", logging.CRITICAL + 1)  # requests that are not HTTP are answered, but not logged


class ServedSite(NamedTuple):
    """A web application on a port."""

    runner: web.AppRunner
    listener: asyncio.Server

    @property
    def port(self) -> int:
        return self.listener.sockets[0].getsockname()[1]

    async def cleanup(self) -> None:
        """Stop listening, and end requests in progress."""
        self.listener.close()
        await self.runner.cleanup()


async def start_site(app: web.Application, host: str, ports: Sequence[int], shutdown_s: float) -> ServedSite:
    """Serve an application on the first free port, where ANY_PORT stands for any, with a bounded number of connections.

    At shutdown, requests in progress may take `shutdown_s` of wall time. Raises an OSError if no port can be opened.
    """
    connections = HttpConnections()
    app.middlewares.append(connections.observe)
    runner = web.AppRunner(app, access_log=None, logger=_NO_LOG, shutdown_timeout=shutdown_s, read_bufsize=READ_BYTES)
    await runner.setup()
    server = runner.server
    assert server is not None

    def protocol() -> HttpConnection:
        return HttpConnection(server(), connections)

    for port in ports:
        try:
            listener = await asyncio.get_running_loop().create_server(protocol, host, port, backlog=BACKLOG)
        except OSError as error:
            if error.errno != errno.EADDRINUSE or port == ports[-1]:
                await runner.cleanup()
                raise
        else:
            return ServedSite(runner, listener)
    raise ValueError("no port is given")


@contextmanager
def open_on_thread(
    loop: asyncio.AbstractEventLoop,
    name: str,
    enter: Callable[[], Coroutine[Any, Any, Resource]],
    leave: Callable[[Resource], Coroutine[Any, Any, None]],
) -> Iterator[None]:
    """Run an event loop on a separate thread, open a resource on it, and close both on leaving the context.

    Exceptions of `enter`, which opens the resource, are raised here.
    """
    thread = threading.Thread(target=loop.run_forever, name=name, daemon=True)
    thread.start()
    try:
        resource = asyncio.run_coroutine_threadsafe(enter(), loop).result()
        try:
            yield
        finally:
            asyncio.run_coroutine_threadsafe(leave(resource), loop).result()
    finally:
        asyncio.run_coroutine_threadsafe(cancel_other_tasks(), loop).result()
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


async def cancel_other_tasks() -> None:
    """Cancel all other tasks of the loop and wait for them, since asyncio warns about tasks pending at the end."""
    others = asyncio.all_tasks() - {asyncio.current_task()}
    for task in others:
        task.cancel()
    await asyncio.gather(*others, return_exceptions=True)


def check_token(process: str, host: str, token: str | None) -> None:
    """Raise a RunError if the token is empty, or other machines could connect without one."""
    if token == "":
        raise RunError(f"{process}: the token is empty; give one, or omit ZSIM_TOKEN and --token")
    if token is None and not is_loopback(host):
        remedy = "set ZSIM_TOKEN (or --token, which every user of this machine can read), or --listen 127.0.0.1"
        raise RunError(f"{process}: {host} can be reached by others; {remedy}")


def tokens_match(received: str, token: str) -> bool:
    """Compare two tokens in constant time; the received one may contain any bytes of a header."""
    return hmac.compare_digest(received.encode(errors="surrogatepass"), token.encode(errors="surrogatepass"))


def url_host(host: str) -> str:
    """Return a host as written in URLs: an IPv6 address in brackets."""
    return f"[{host}]" if ":" in host else host


class HttpConnections:
    """Counts the connections of a server, and closes those that must make room.

    Args:
        strangers_max, connections_max: maximum numbers of simultaneous strangers, and of all connections.
        request_s: wall time for a request to arrive, from its first byte; and for a stranger's head, from the opening
            of the connection or its last answer.
        body_bytes_max: total size of all bodies above SMALL_BYTES at once; further ones wait, within `request_s`.
    """

    def __init__(
        self,
        strangers_max: int = STRANGERS_MAX,
        connections_max: int = CONNECTIONS_MAX,
        request_s: float = REQUEST_S,
        body_bytes_max: int = BODY_BYTES_MAX,
    ) -> None:
        self._strangers_max = strangers_max
        self._connections_max = connections_max
        self._request_s = request_s
        self._body_bytes_max = body_bytes_max
        self._body_bytes = 0
        self._body_released = asyncio.Condition()
        self._open: dict[asyncio.BaseTransport, HttpConnection] = {}
        self._strangers: dict[HttpConnection, None] = {}  # an ordered set, longest wait first
        self._idle: dict[HttpConnection, None] = {}  # likewise, known connections without a request

    @web.middleware
    async def observe(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Protect a connection while its request is answered; must be the innermost middleware, after access checks."""
        connection = self._open.get(request.transport) if request.transport else None
        if connection is None:
            return await handler(request)
        since_s = connection.since_s
        self._forget(connection)
        try:
            async with AsyncExitStack() as reservations:
                await self._receive(request, connection, since_s, reservations)
                connection.is_complete = True
                response = await handler(request)
            connection.is_known = connection.is_known or response.status < ERROR_STATUS_MIN
            return response
        finally:
            if connection.is_open:
                self._wait(connection)

    async def _receive(
        self, request: web.Request, connection: "HttpConnection", since_s: float | None, reservations: AsyncExitStack
    ) -> None:
        """Receive the body of a request before the handler runs; `reservations` keep its room until the handler ends.

        Raises aiohttp's errors for a body that is too long or did not arrive in time, for instance for lack of room.
        """
        if not request.can_read_body:
            return
        size_max = request.client_max_size
        size = size_max if request.content_length is None else min(request.content_length, size_max)
        deadline_s = (asyncio.get_running_loop().time() if since_s is None else since_s) + self._request_s
        try:
            async with asyncio.timeout_at(deadline_s):
                if size > SMALL_BYTES:
                    await reservations.enter_async_context(self._reserve_body(size))
                await request.read()
        except TimeoutError:
            connection.is_known = False  # its next request has a stranger's time limit
            raise web.HTTPRequestTimeout(text=f"a request must arrive in full within {self._request_s:g} s") from None

    @asynccontextmanager
    async def _reserve_body(self, size: int) -> AsyncIterator[None]:
        """Wait until there is room for a body besides the others, and reserve it."""
        async with self._body_released:
            await self._body_released.wait_for(lambda: self._body_bytes + size <= self._body_bytes_max)
            self._body_bytes += size
        try:
            yield
        finally:
            self._body_bytes -= size
            async with self._body_released:
                self._body_released.notify_all()

    def enter(self, connection: "HttpConnection", transport: asyncio.Transport) -> bool:
        """Accept a new connection; return False if there is no room because all others have requests in progress."""
        if len(self._open) >= self._connections_max and not self._make_room(self._strangers, self._idle):
            return False
        if len(self._strangers) >= self._strangers_max:
            self._make_room(self._strangers)
        self._open[transport] = connection
        self._wait(connection)
        return True

    def leave(self, connection: "HttpConnection", transport: asyncio.BaseTransport) -> None:
        """Remove a closed connection."""
        self._open.pop(transport, None)
        self._forget(connection)

    def _make_room(self, *groups: "dict[HttpConnection, None]") -> bool:
        """Close the longest-waiting connection of the first non-empty group; return False if all are empty."""
        for group in groups:
            if group:
                next(iter(group)).abort()
                return True
        return False

    def _wait(self, connection: "HttpConnection") -> None:
        """Let a connection wait for its next request; aiohttp itself closes idle known connections."""
        (self._idle if connection.is_known else self._strangers)[connection] = None
        if not connection.is_known:
            connection.timer = asyncio.get_running_loop().call_later(self._request_s, connection.abort)
        if connection.has_more:
            self.start_timer(connection)
        connection.is_complete = connection.has_more = False

    def start_timer(self, connection: "HttpConnection") -> None:
        """Start the time limit of a request when its first bytes arrive on a waiting connection."""
        if connection.since_s is not None or not (connection in self._idle or connection in self._strangers):
            return
        loop = asyncio.get_running_loop()
        connection.since_s = loop.time()
        connection.timer = connection.timer or loop.call_later(self._request_s, connection.abort)

    def _forget(self, connection: "HttpConnection") -> None:
        self._strangers.pop(connection, None)
        self._idle.pop(connection, None)
        connection.since_s = None
        if connection.timer is not None:
            connection.timer.cancel()
            connection.timer = None


class HttpConnection(asyncio.Protocol):
    """One connection, between its transport and the protocol that speaks HTTP."""

    def __init__(self, http: asyncio.Protocol, connections: HttpConnections) -> None:
        self._http = http
        self._connections = connections
        self._transport: asyncio.Transport | None = None
        self.is_known = False  # whether one of its requests was answered without an error
        self.is_complete = False  # whether the request in progress has arrived completely
        self.has_more = False  # whether part of the next request has arrived meanwhile
        self.since_s: float | None = None  # loop time at which the first byte of its next request arrived
        self.timer: asyncio.TimerHandle | None = None  # closes the connection when that request's time has run out

    @property
    def is_open(self) -> bool:
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
        if self._transport is None:
            return
        self.has_more = self.has_more or self.is_complete
        self._connections.start_timer(self)
        self._http.data_received(data)

    def eof_received(self) -> bool | None:
        return self._http.eof_received() if self._transport is not None else None

    def pause_writing(self) -> None:
        self._http.pause_writing()

    def resume_writing(self) -> None:
        self._http.resume_writing()

    def abort(self) -> None:
        """Close the connection at once, without an answer."""
        if self._transport is not None:
            transport = self._transport
            self._connections.leave(self, transport)
            transport.abort()
