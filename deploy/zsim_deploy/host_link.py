"""The launcher's way to one host: an ssh connection that comes back, commands on it, and how long a word takes.

All connections live on one event loop in a thread of its own (`Loop`), so that the watch over a run stays a plain loop.
"""

import asyncio
import contextlib
import threading
import time
from collections.abc import Coroutine
from pathlib import Path
from typing import Any, TypeVar

import asyncssh

from zsim.errors import HostsError
from zsim_deploy import shell
from zsim_deploy.inventory import Host
from zsim_deploy.ssh import connect

ECHO_S = 0.5  # how often a word goes to the host and back
RETRY_S = 0.5  # between two attempts to connect again
CLOSE_S = 1.0  # how long a connection may take to close; a cut one never does

Result = TypeVar("Result")


class Loop:
    """An event loop in a thread."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="ssh", daemon=True)
        self._thread.start()

    def call(self, work: Coroutine[Any, Any, Result], timeout_s: float | None = None) -> Result:
        """Run a coroutine to its end and return its result.

        Raises:
            TimeoutError: it took longer; it is cancelled.
        """
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result(timeout_s)
        except TimeoutError:
            future.cancel()
            raise

    def spawn(self, work: Coroutine[Any, Any, None]) -> None:
        """Start a coroutine that nobody waits for."""
        asyncio.run_coroutine_threadsafe(work, self._loop)

    def tell(self, act: Any, *args: Any) -> None:
        """Call a plain function on the loop's thread."""
        self._loop.call_soon_threadsafe(act, *args)

    def close(self) -> None:
        """Cancel what runs, and end the thread."""
        self.call(self._cancel_all(), CLOSE_S)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(CLOSE_S)

    @staticmethod
    async def _cancel_all() -> None:
        others = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
        for task in others:
            task.cancel()
        await asyncio.wait(others, timeout=CLOSE_S / 2) if others else None


class HostLink:
    """One host.

    Args:
        name: in the inventory.
        host: how to reach it.
        base: folder of the inventory, from which relative paths count.

    Attributes:
        round_trip_s: of the last word that came back.
        heard_s: monotonic time of it; 0 before the first.
    """

    def __init__(self, name: str, host: Host, base: Path) -> None:
        self.name = name
        self.host = host
        self.round_trip_s = 0.0
        self.heard_s = 0.0
        self._base = base
        self._connection: asyncssh.SSHClientConnection | None = None
        self._lock = asyncio.Lock()

    async def open(self) -> asyncssh.SSHClientConnection:
        """Return the connection, made anew where it is lost.

        Raises:
            HostsError: the host cannot be reached, or does not let us in.
        """
        async with self._lock:
            if self._connection is None or self._connection.is_closed():
                self._connection = await connect(self.name, self.host, self._base)
            return self._connection

    async def insist(self) -> asyncssh.SSHClientConnection:
        """Return the connection; try until the host is there."""
        while True:
            try:
                return await self.open()
            except HostsError:
                await asyncio.sleep(RETRY_S)

    async def run(self, command: str, given: bytes = b"", timeout_s: float = 10.0) -> bytes:
        """Return what a command prints.

        Raises:
            HostsError: it failed, or took too long; with the last line that it said.
        """
        connection = await self.open()
        try:
            done = await asyncio.wait_for(connection.run(command, input=given, encoding=None), timeout_s)
        except TimeoutError as error:
            raise HostsError(f"{self.name}: no answer within {timeout_s:g} s to {command[:60]!r}") from error
        except (asyncssh.Error, OSError) as error:
            raise HostsError(f"{self.name}: the connection broke ({error}); is the host up?") from error
        if done.exit_status != 0:
            lines = _text(done.stderr).strip().splitlines() or ["it said nothing"]
            raise HostsError(f"{self.name}: {command.split(' ', 1)[0]} failed ({done.exit_status}): {lines[-1][:200]}")
        return done.stdout if isinstance(done.stdout, bytes) else b""

    async def put_file(self, path: str, content: bytes, mode: int = 0o644) -> None:
        """Write a file on the host; its folder is made, and a half-written file is never seen."""
        folder, part = path.rpartition("/")[0], f"{path}.part"
        into, new, old = shell.word(folder), shell.word(part), shell.word(path)
        script = f"umask 077; mkdir -p {into} && cat > {new} && chmod {mode:o} {new} && mv {new} {old}"
        await self.run(script, content)

    async def echo(self) -> None:
        """Send a word there and back for ever, so that a lost host is noticed within a second."""
        while True:
            with contextlib.suppress(HostsError, asyncssh.Error, OSError):
                connection = await self.open()
                async with connection.create_process("cat", encoding="utf-8") as mirror:
                    await self._echo(mirror)
            await asyncio.sleep(RETRY_S)

    async def _echo(self, mirror: "asyncssh.SSHClientProcess[str]") -> None:
        while True:
            sent_s = time.monotonic()
            mirror.stdin.write(".\n")
            if not await mirror.stdout.readline():
                return
            self.heard_s = time.monotonic()
            self.round_trip_s = self.heard_s - sent_s
            await asyncio.sleep(ECHO_S)

    def silent_s(self) -> float:
        """Return for how long the host has not answered."""
        return max(0.0, time.monotonic() - self.heard_s - ECHO_S) if self.heard_s else 0.0

    async def close(self) -> None:
        """Close the connection; what still runs there on its pipes ends by itself."""
        if self._connection is not None:
            self._connection.close()
            with contextlib.suppress(TimeoutError, asyncssh.Error, OSError):
                await asyncio.wait_for(self._connection.wait_closed(), CLOSE_S)


def _text(data: Any) -> str:
    return data.decode(errors="replace") if isinstance(data, bytes) else str(data or "")
