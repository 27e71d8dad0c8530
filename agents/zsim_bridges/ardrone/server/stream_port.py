"""A TCP port of a drone: who may connect, how many, and their end with the run."""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable

from zsim_bridges.ardrone.server.addresses import AllowedHosts

CONNECTIONS_MAX = 8  # at once, chosen: a pilot's program has one
LINE_MAX = 512  # bytes of a line that is read, chosen
BROKEN = (OSError, EOFError, TimeoutError, ValueError)  # of a connection, and of a line that is too long

Serve = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


class StreamPort:
    """A TCP port.

    Args:
        peers: who may connect.
        serve: serves one connection until it is over.
        refuse: counts what is not served, with the reason.

    Attributes:
        writers: of the connections that are served.
    """

    def __init__(self, peers: AllowedHosts, serve: Serve, refuse: Callable[[str], None]) -> None:
        self._peers = peers
        self._serve = serve
        self._refuse = refuse
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self.writers: set[asyncio.StreamWriter] = set()

    async def open(self, address: str, port: int) -> int:
        """Listen; return the port, where 0 asks for any.

        Raises:
            OSError: it is taken, or may not be had.
        """
        self._server = await asyncio.start_server(self._accept, address, port, limit=LINE_MAX)
        return self._server.sockets[0].getsockname()[1]

    async def close(self) -> None:
        """End all connections."""
        if self._server is not None:
            self._server.close()
        for task in tuple(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def broadcast(self, data: bytes) -> None:
        """Send bytes to all that are connected."""
        for writer in self.writers:
            if not writer.is_closing():
                writer.write(data)

    def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        host = (writer.get_extra_info("peername") or ("somebody",))[0]
        if not self._peers.allow(host):
            self._refuse(f"{host} connects, and is no --peer")
            writer.transport.abort()
        elif len(self._tasks) >= CONNECTIONS_MAX:
            self._refuse(f"{host} connects, and there are {CONNECTIONS_MAX} connections already")
            writer.transport.abort()
        else:
            task = asyncio.get_running_loop().create_task(self._serve_one(reader, writer))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    async def _serve_one(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.writers.add(writer)
        try:
            with contextlib.suppress(*BROKEN):
                await self._serve(reader, writer)
        finally:
            self.writers.discard(writer)
            writer.close()


async def read_until_end(reader: asyncio.StreamReader, _: asyncio.StreamWriter) -> None:
    """Serve a connection that only listens: what it sends is dropped."""
    while await reader.read(LINE_MAX):
        pass
