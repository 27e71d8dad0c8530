"""The ssh links to all hosts of a run, a program of ours that runs on a host, and a file copied from there."""

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine, Iterable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import asyncssh

from zsim.errors import HostsError, ZsimError
from zsim_deploy.hosts.host_link import CLOSE_S, EventLoopThread, HostLink
from zsim_deploy.hosts.ssh_connection import json_answer, start_sftp
from zsim_deploy.inventory.inventory import InventoryFile

OPEN_S = 10.0  # until the host lets us read; a few round trips of a poor link
STALL_S = 20.0  # without anything more the host is taken for lost; TCP repeats within that what a poor link loses
BLOCK_BYTES = 32_768  # asked for at once; even at 100 kbit/s one comes within 3 s


class HostLinks:
    """A link to each host that takes part.

    Args:
        placed: the inventory.
        names: of the hosts.
        loop: on which the links live.

    Attributes:
        by_name: the links; a new dictionary when there is one more, for others look at it meanwhile.
    """

    def __init__(self, placed: InventoryFile, names: Iterable[str], loop: EventLoopThread) -> None:
        self._placed = placed
        self._loop = loop
        self.by_name = {name: self.to(name) for name in names}

    def to(self, name: str) -> HostLink:
        """Return a new link to a host of the inventory, which is not kept."""
        return HostLink(name, self._placed.inventory.hosts[name], self._placed.folder)

    def add(self, link: HostLink) -> None:
        """Keep one more link."""
        self.by_name = {**self.by_name, link.name: link}
        self._loop.spawn(link.measure_round_trips())

    def listen(self) -> None:
        """Measure from now on whether each host answers."""
        for link in self.by_name.values():
            self._loop.spawn(link.measure_round_trips())

    def on_all(self, work: Callable[[HostLink], Coroutine[Any, Any, Any]], within_s: float) -> dict[str, Any]:
        """Do the same on all hosts at once, and return what comes of it.

        Raises:
            HostsError: it failed, or took longer, with a line for every such host.
        """

        async def gathered() -> list[Any]:
            bounded = (_bounded(link, work, within_s) for link in self.by_name.values())
            return await asyncio.gather(*bounded, return_exceptions=True)

        results = self._loop.call(gathered())
        faults = [str(result) for result in results if isinstance(result, ZsimError)]
        if faults:
            raise HostsError("\n".join(faults))
        for result in results:
            if isinstance(result, BaseException):
                raise result
        return dict(zip(self.by_name, results, strict=True))

    def close(self) -> None:
        """Close all of them at once."""
        self.on_all(HostLink.close, 2 * CLOSE_S)


async def _bounded(link: HostLink, work: Callable[[HostLink], Coroutine[Any, Any, Any]], within_s: float) -> Any:
    try:
        return await asyncio.wait_for(work(link), within_s)
    except TimeoutError as error:
        raise HostsError(f"{link.name}: not done within {within_s:g} s; is the link slow, the host busy?") from error


class ProgramEndedError(HostsError):
    """A program on a host has ended without an answer.

    Attributes:
        status: exit code.
        last: line that it printed on standard error; empty if it printed nothing.
    """

    def __init__(self, name: str, status: int | None, last: str) -> None:
        super().__init__(f"{name}: it ended with code {status} ({last or 'it printed nothing'})")
        self.status, self.last = status, last


class RemoteProgram:
    """A program of ours on a host, which reads lines and answers each with a line of JSON.

    Args:
        name: of the host, for errors.
        process: over there.
    """

    def __init__(self, name: str, process: "asyncssh.SSHClientProcess[str]") -> None:
        self._name = name
        self._process = process

    def send(self, text: str) -> None:
        """Write to its standard input."""
        self._process.stdin.write(text)

    async def answer(self, within_s: float, late: str = "") -> dict[str, Any]:
        """Return its next answer; a greeting of the login shell is passed over.

        Args:
            within_s: wall time that it may take.
            late: text of the error if it takes longer; empty for the usual one.

        Raises:
            ProgramEndedError: it has ended.
            HostsError: it took longer.
        """
        try:
            async with asyncio.timeout(within_s):
                while line := await self._process.stdout.readline():
                    if message := json_answer([line]):
                        return message
                lines = (await self._process.stderr.read()).strip().splitlines()
                await self._process.wait_closed()
        except TimeoutError as error:
            slow = f"no answer within {within_s:g} s; is the link slow, the host busy?"
            raise HostsError(f"{self._name}: {late or slow}") from error
        raise ProgramEndedError(self._name, self._process.exit_status, lines[-1][:200] if lines else "")


@asynccontextmanager
async def open_program(link: HostLink, command: str) -> AsyncIterator[RemoteProgram]:
    """Run a program on a host as long as the block lasts.

    Raises:
        HostsError: the host cannot be reached, or the connection breaks.
    """
    try:
        async with link.channel() as connection:
            process = await connection.create_process(command, encoding="utf-8", errors="replace")
            try:
                yield RemoteProgram(link.name, process)
            finally:
                process.close()  # not waited for: on a link that is cut it would take a minute
    except (asyncssh.Error, OSError) as error:
        raise HostsError(f"{link.name}: the connection broke ({error}); is the host up?") from error


async def fetch(link: HostLink, source: str, into: Path) -> bool:
    """Copy a file from a host, under its name only when it is whole; return False if there is none.

    Args:
        link: to the host.
        source: path there; a leading ~/ is the home.
        into: path here; beside it lies what has come, with .part at the end.

    Raises:
        HostsError: it cannot be read, the host has no SFTP or does not answer, or nothing came any more.
        OSError: it cannot be written here.
    """
    part = into.with_name(f"{into.name}.part")
    try:
        async with link.channel() as connection:
            sftp = await asyncio.wait_for(start_sftp(link.name, connection), OPEN_S)
            try:
                await _copy(sftp, source.removeprefix("~/"), part)
            finally:
                sftp.exit()  # not waited for: a link that is cut does not say that it has closed
    except TimeoutError as error:
        raise HostsError(f"{link.name}: no answer within {OPEN_S:g} s") from error
    except asyncssh.SFTPNoSuchFile:
        return False
    except asyncssh.Error as error:
        raise HostsError(f"{link.name}: {error}") from error
    part.replace(into)
    return True


async def _copy(sftp: asyncssh.SFTPClient, source: str, into: Path) -> None:
    moved = asyncio.Event()
    copy = asyncio.create_task(
        sftp.get(source, into, block_size=BLOCK_BYTES, progress_handler=lambda *_: moved.set()),
    )
    copy.add_done_callback(lambda task: task.cancelled() or task.exception())  # nobody else may ask for it
    try:
        while not (await asyncio.wait([copy], timeout=STALL_S))[0]:
            if not moved.is_set():
                raise HostsError(f"nothing came for {STALL_S:g} s; what did is {into}")
            moved.clear()
    finally:
        copy.cancel()
    copy.result()
