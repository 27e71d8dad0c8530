"""A process on another host, over a link that a test makes: whatever happens, its end is noticed."""

import asyncio
import errno
import os
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from refused import has_terms

from zsim.errors import HostsError
from zsim_deploy.hosts.host_link import EventLoopThread
from zsim_deploy.hosts.host_run import LOST, ProcessLog, RemoteProcess

FILES = {"identity/estimator.d1/key.pem": b"secret"}
PATIENCE_S = 120.0  # after which a test that waits for ever fails


class Stream:
    """What a process says."""

    def __init__(self, *lines: str) -> None:
        self._lines = list(lines)

    def __aiter__(self) -> "Stream":
        return self

    async def __anext__(self) -> str:
        if not self._lines:
            raise StopAsyncIteration
        return self._lines.pop(0)

    def write(self, _: str) -> None: ...


class Process:
    """A process that says some lines and ends."""

    exit_signal, exit_status = None, 0

    def __init__(self, *output: str, complains: tuple[str, ...] = ()) -> None:
        self.stdin, self.stdout, self.stderr = Stream(), Stream(*output), Stream(*complains)

    async def wait(self) -> "Process":
        return self

    async def __aenter__(self) -> "Process":
        return self

    async def __aexit__(self, *_: object) -> None: ...


class Link:
    """A link to a host on which every command is the process given, a fault, or never comes to be."""

    name = "h1"

    def __init__(self, then: Process | Exception | None) -> None:
        self._then = then
        self.brought: list[tuple[str, dict[str, bytes]]] = []

    async def put_files(self, folder: str, files: dict[str, bytes], *_: Any, retry: bool) -> None:
        assert retry
        self.brought.append((folder, files))

    @asynccontextmanager
    async def channel(self, retry: bool = False) -> AsyncIterator["Link"]:
        assert retry
        yield self

    def create_process(self, *_: Any, **__: Any) -> Process:
        assert isinstance(self._then, Process)
        return self._then


class Absent(Link):
    """A link to a host that is not there."""

    @asynccontextmanager
    async def channel(self, retry: bool = False) -> AsyncIterator[Link]:
        if isinstance(self._then, Exception):
            raise self._then
        await asyncio.Event().wait()
        yield self


Start = Callable[..., RemoteProcess]


@pytest.fixture
def started(tmp_path: Path) -> Iterator[Start]:
    loop = EventLoopThread()

    def start(link: Any, on_line: Any = None, log: ProcessLog | None = None) -> RemoteProcess:
        log = log or ProcessLog(tmp_path / "estimator.d1.log", lambda text: None)
        remote = RemoteProcess("estimator.d1", ["python3", "estimator"], link, loop, log, on_line, ("/z/runs/1", FILES))
        remote.start()
        return remote

    yield start
    loop.close()


def test_what_a_process_says_is_kept_and_a_greeting_of_the_shell_is_not_its_id(started: Start, tmp_path: Path) -> None:
    output: list[str] = []
    link = Link(Process("Welcome to h1\n", "zsim-pid 77\n", '{"say": 1}\n', complains=("here\n", "\n")))
    remote = started(link, output.append)
    assert remote.wait(PATIENCE_S)
    assert (remote.pid, remote.code, output) == (77, 0, ['{"say": 1}\n'])
    assert remote.last_log_line() == "here"
    assert (tmp_path / "estimator.d1.log").read_text() == "here\n\n"


def test_a_link_that_breaks_or_a_fault_of_whoever_takes_its_lines_ends_it(started: Start) -> None:
    def fail(line: str) -> None:
        raise TypeError("not iterable")

    for link, on_line, terms in (
        (Link(Process("zsim-pid 77\n", "1234\n")), fail, ("launcher", "TypeError('not iterable')")),
        (Absent(HostsError("h1: gone")), None, ("connection", "h1", "h1: gone")),
    ):
        remote = started(link, on_line)
        assert remote.wait(PATIENCE_S)
        assert (remote.code, remote.outcome()) == (LOST, remote.last_log_line())
        assert has_terms(remote.outcome(), *terms)


def test_a_log_that_cannot_be_written_is_said_once_and_the_process_goes_on(started: Start, tmp_path: Path) -> None:
    output: list[str] = []
    log = ProcessLog(tmp_path / "gone" / "estimator.d1.log", output.append)
    remote = started(Link(Process("zsim-pid 77\n", complains=("one\n", "two\n"))), log=log)
    assert remote.wait(PATIENCE_S)
    assert (remote.code, remote.last_log_line()) == (0, "two")
    (line,) = output
    assert has_terms(line, "gone/estimator.d1.log", "written", os.strerror(errno.ENOENT))


def test_one_that_waits_for_its_host_can_be_given_up(started: Start) -> None:
    remote = started(Absent(None))
    assert remote.state == "starting"
    remote.kill()
    assert remote.wait(PATIENCE_S)
    assert remote.code == LOST


def test_one_that_is_started_again_gets_its_key_again_which_it_has_taken_away(started: Start) -> None:
    link = Link(Process("zsim-pid 77\n"))
    remote = started(link)
    assert remote.wait(PATIENCE_S)
    assert link.brought == []
    remote.start()
    assert remote.wait(PATIENCE_S)
    assert link.brought == [("/z/runs/1", FILES)]
