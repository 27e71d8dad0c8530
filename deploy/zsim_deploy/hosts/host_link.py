"""The launcher's way to one host: an ssh connection that is renewed, commands on it, and its round trip.

All connections live on one event loop in a thread of its own (`EventLoopThread`), so that the supervisor of a run stays
a plain loop.
"""

import asyncio
import contextlib
import io
import tarfile
import threading
import time
from collections.abc import AsyncIterator, Coroutine, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import asyncssh

from zsim.errors import HostsError
from zsim_deploy.hosts.ssh_connection import connect, shell_word
from zsim_deploy.inventory.inventory import Host

ECHO_S = 0.5  # how often a line goes to the host and back
RETRY_S = 0.5  # between two attempts to connect again
CLOSE_S = 1.0  # how long a connection may take to close; a cut one never does
ANSWER_S = 10.0  # how long a short command may take; a host on a poor link answers within a few round trips
CHANNELS = 8  # kept open on one connection; sshd allows 10 (MaxSessions of sshd_config(5)), and a closed one goes later

Result = TypeVar("Result")


class EventLoopThread:
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
        except BaseException:
            future.cancel()  # Ctrl-C, too
            raise

    def spawn(self, work: Coroutine[Any, Any, None]) -> Future[None]:
        """Start a coroutine that nobody waits for; it can be cancelled."""
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    def call_soon(self, act: Any, *args: Any) -> None:
        """Call a plain function on the loop's thread."""
        self._loop.call_soon_threadsafe(act, *args)

    def close(self) -> None:
        """Cancel what runs, and end the thread."""
        self.call(self._cancel_all(), CLOSE_S)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(CLOSE_S)
        if not self._thread.is_alive():
            self._loop.close()

    @staticmethod
    async def _cancel_all() -> None:
        others = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
        for task in others:
            task.cancel()
        await asyncio.wait(others, timeout=CLOSE_S / 2) if others else None


@dataclass
class PooledConnection:
    """A connection, and how many of its channels are in use."""

    connection: asyncssh.SSHClientConnection
    channels: int = 0


class HostLink:
    """One host; more connections are opened to it as one has no room for another channel.

    Args:
        name: in the inventory.
        host: how to reach it.
        base: folder of the inventory, from which relative paths count.

    Attributes:
        round_trip_s: of the last line that came back.
        answered_s: monotonic time of it; 0 before the first.
    """

    def __init__(self, name: str, host: Host, base: Path) -> None:
        self.name = name
        self.host = host
        self.round_trip_s = 0.0
        self.answered_s = 0.0
        self._base = base
        self._lines: list[PooledConnection] = []
        self._lock = asyncio.Lock()

    async def open(self) -> asyncssh.SSHClientConnection:
        """Return a connection on which there is room for a short use, made anew where it is lost.

        Raises:
            HostsError: the host cannot be reached, or does not let us in.
        """
        async with self._lock:
            return (await self._with_room()).connection

    @contextlib.asynccontextmanager
    async def channel(self, retry: bool = False) -> AsyncIterator[asyncssh.SSHClientConnection]:
        """Yield a connection for one channel.

        Args:
            retry: try until the host is there.

        Raises:
            HostsError: as `open`, if not retry.
        """
        line = await self._reserved(retry)
        try:
            yield line.connection
        finally:
            line.channels -= 1

    async def _reserved(self, retry: bool) -> PooledConnection:
        while True:
            try:
                async with self._lock:
                    line = await self._with_room()
                    line.channels += 1
                    return line
            except HostsError:
                if not retry:
                    raise
            await asyncio.sleep(RETRY_S)

    async def _with_room(self) -> PooledConnection:
        self._lines = [line for line in self._lines if not line.connection.is_closed()]
        for line in self._lines:
            if line.channels < CHANNELS:
                return line
        self._lines.append(PooledConnection(await connect(self.name, self.host, self._base)))
        return self._lines[-1]

    async def run(
        self, command: str, stdin: bytes = b"", timeout_s: float = ANSWER_S, what: str = "", retry: bool = False
    ) -> bytes:
        """Return what a command prints.

        Args:
            command: line of a POSIX shell.
            stdin: its standard input.
            timeout_s: how long it may take.
            what: it does, for errors; its first word if not given.
            retry: try until the host is there; the time counts from then.

        Raises:
            HostsError: it failed, or took too long; with the last line that it printed.
        """
        async with self.channel(retry) as connection:
            try:
                done = await asyncio.wait_for(connection.run(command, input=stdin, encoding=None), timeout_s)
            except TimeoutError as error:
                act = what or repr(command[:60])
                raise HostsError(f"{self.name}: no answer within {timeout_s:g} s to {act}") from error
            except (asyncssh.Error, OSError) as error:
                raise HostsError(f"{self.name}: the connection broke ({error}); is the host up?") from error
        if done.exit_status != 0:
            lines = _text(done.stderr).strip().splitlines() or ["it printed nothing"]
            what = what or command.split(" ", 1)[0]
            raise HostsError(f"{self.name}: {what} failed ({done.exit_status}): {lines[-1][:200]}")
        return done.stdout if isinstance(done.stdout, bytes) else b""

    async def put_files(
        self, folder: str, files: Mapping[str, bytes], timeout_s: float = ANSWER_S, retry: bool = False
    ) -> None:
        """Write files below a folder of the host, readable by their owner alone: all, or none where the link breaks.

        Args:
            folder: made if it is not there.
            files: path below the folder to content.
            timeout_s: how long it may take.
            retry: as `run`.

        Raises:
            HostsError: they could not be written.
        """
        content = archive(files)
        into = shell_word(folder)
        part = f"{into}/.part.$$"  # others may be writing there at the same time
        is_whole = f"[ $(wc -c < {part}) -eq {len(content)} ] || {{ echo it came in part >&2; false; }}"
        unpack = f"cat > {part} && {{ {is_whole}; }} && tar -xof {part} -C {into}"
        script = f"umask 077; mkdir -p {into} && {{ {unpack}; code=$?; rm -f {part}; exit $code; }}"
        await self.run(script, content, timeout_s, what=f"writing into {folder}", retry=retry)

    async def measure_round_trips(self) -> None:
        """Send a line there and back for ever, so that a lost host is noticed within a second."""
        while True:
            with contextlib.suppress(HostsError, asyncssh.Error, OSError):
                async with self.channel() as connection, connection.create_process("cat", encoding="utf-8") as mirror:
                    await self._echo(mirror)
            await asyncio.sleep(RETRY_S)

    async def _echo(self, mirror: "asyncssh.SSHClientProcess[str]") -> None:
        while True:
            sent_s = time.monotonic()
            mirror.stdin.write(".\n")
            if not await mirror.stdout.readline():
                return
            self.answered_s = time.monotonic()
            self.round_trip_s = self.answered_s - sent_s
            await asyncio.sleep(ECHO_S)

    def silent_s(self) -> float:
        """Return for how long the host has not answered."""
        return max(0.0, time.monotonic() - self.answered_s - ECHO_S) if self.answered_s else 0.0

    async def close(self) -> None:
        """Close all connections; what still runs there on their pipes ends by itself."""
        for line in self._lines:
            line.connection.close()
        closed = asyncio.gather(*(line.connection.wait_closed() for line in self._lines), return_exceptions=True)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(closed, CLOSE_S)


def archive(files: Mapping[str, bytes]) -> bytes:
    """Return a tar archive of files that their owner alone may read."""
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for path, content in files.items():
            entry = tarfile.TarInfo(path)
            entry.size, entry.mode, entry.mtime = len(content), 0o600, int(time.time())
            tar.addfile(entry, io.BytesIO(content))
    return packed.getvalue()


def _text(data: Any) -> str:
    return data.decode(errors="replace") if isinstance(data, bytes) else str(data or "")
