"""What the web servers of console and gateway share: event loop thread, listening, and who may reach them."""

import asyncio
import errno
import hmac
import logging
import threading
from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple, TypeVar

from aiohttp import web

from zsim.errors import RunError
from zsim_bridges.web.http_connections import HttpConnections
from zsim_bridges.web.loopback import is_loopback

ANY_PORT = 0  # of the kernel's choice
BACKLOG = 128  # connections that the kernel keeps until they are accepted; aiohttp's own
READ_BYTES = 16_384  # of a body that no handler has read yet; a connection holds twice as many
Resource = TypeVar("Resource")
_NO_LOG = logging.Logger("quiet", logging.CRITICAL + 1)  # requests that are not HTTP are answered, not logged


class ServedSite(NamedTuple):
    """A web application on a port."""

    runner: web.AppRunner
    listener: asyncio.Server

    @property
    def port(self) -> int:
        """Return the port on which it is served."""
        return self.listener.sockets[0].getsockname()[1]

    async def cleanup(self) -> None:
        """Stop listening, and end what is under way."""
        self.listener.close()
        await self.runner.cleanup()


async def start_site(app: web.Application, host: str, ports: Sequence[int], shutdown_s: float) -> ServedSite:
    """Serve an application, on a bounded number of connections.

    Args:
        app: the application.
        host: on whose address.
        ports: the first of them that is not taken; ANY_PORT for one that is not.
        shutdown_s: how long what is under way may take at the end [wall].

    Raises:
        OSError: none of them can be opened.
    """
    connections = HttpConnections()
    app.middlewares.append(connections.observe)
    runner = web.AppRunner(app, access_log=None, logger=_NO_LOG, shutdown_timeout=shutdown_s, read_bufsize=READ_BYTES)
    await runner.setup()
    server = runner.server
    assert server is not None
    try:
        listener = await _listen(lambda: connections.protocol(server()), host, ports)
    except OSError:
        await runner.cleanup()
        raise
    return ServedSite(runner, listener)


async def _listen(protocol: Callable[[], asyncio.Protocol], host: str, ports: Sequence[int]) -> asyncio.Server:
    loop = asyncio.get_running_loop()
    try:
        return await loop.create_server(protocol, host, ports[0], backlog=BACKLOG)
    except OSError as error:
        if error.errno != errno.EADDRINUSE or len(ports) == 1:
            raise
    return await _listen(protocol, host, ports[1:])


def check_token(process: str, host: str, token: str | None) -> None:
    """Refuse to listen where others could connect without a token.

    Raises:
        RunError: the token is empty, or there is none and the host is not loopback.
    """
    if token == "":
        raise RunError(f"{process}: the token is empty; give it one, or leave ZSIM_TOKEN and --token away")
    if token is None and not is_loopback(host):
        remedy = "set ZSIM_TOKEN (or --token, which everybody on this machine can read), or --listen 127.0.0.1"
        raise RunError(f"{process}: {host} can be reached by others; {remedy}")


def tokens_match(received: str, token: str) -> bool:
    """Compare in constant time; what was received may hold any bytes of a header."""
    return hmac.compare_digest(received.encode(errors="surrogatepass"), token.encode(errors="surrogatepass"))


def url_host(host: str) -> str:
    """Return a host as URLs write it: an IPv6 address in brackets."""
    return f"[{host}]" if ":" in host else host


@contextmanager
def open_on_thread(
    loop: asyncio.AbstractEventLoop,
    name: str,
    enter: Callable[[], Coroutine[Any, Any, Resource]],
    leave: Callable[[Resource], Coroutine[Any, Any, None]],
) -> Iterator[None]:
    """Run an event loop on a thread of its own, open a resource on it, and close both at the end.

    Args:
        loop: is closed at the end.
        name: of the thread.
        enter, leave: open and close the resource; exceptions of `enter` are raised here.
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
    """Cancel all other tasks of the loop and wait for them: a loop that closes over a task complains of it."""
    others = asyncio.all_tasks() - {asyncio.current_task()}
    for task in others:
        task.cancel()
    await asyncio.gather(*others, return_exceptions=True)
