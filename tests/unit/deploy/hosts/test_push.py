"""What a push skips, what it copies, and how the failures of several hosts are shown."""

import asyncio
import errno
import getpass
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from local_host import Text
from refused import has_terms, refused

from zsim.errors import HostsError, InventoryError
from zsim_deploy.hosts import on_host
from zsim_deploy.hosts.host_link import HostLink
from zsim_deploy.hosts.push import (
    ASK_S,
    Installer,
    Interpreter,
    choose_interpreter,
    interpreter_query,
    is_installed,
    missing,
    open_installer,
    parse_interpreters,
    push,
)
from zsim_deploy.hosts.wheelhouse import Wheel, WheelSet
from zsim_deploy.inventory import Host, Inventory, InventoryFile


def wheel(name: str, size_bytes: int = 1, sha256: str | None = None) -> Wheel:
    return Wheel(Path(f"/cache/{name}.whl"), sha256 or f"sha of {name}", size_bytes)


HOUSE = WheelSet(wheel("zsim-1"), wheel("pip-26"), (wheel("numpy-2", 9), wheel("scipy-1", 5)), ("agents",))
NOTE = HOUSE.manifest()


def test_the_manifest_of_the_last_push_tells_what_is_installed() -> None:
    """A host may have more installed than is needed."""
    there = [HOUSE, HOUSE._replace(extras=(), others=(wheel("numpy-2"),)), HOUSE._replace(pip=wheel("pip-27"))]
    assert all(is_installed(wanted, NOTE) for wanted in there)
    assert not is_installed(HOUSE, None)
    others = [
        HOUSE._replace(project=wheel("zsim-1", sha256="changed")),
        HOUSE._replace(extras=("agents", "world")),
        HOUSE._replace(others=(wheel("numpy-3"), wheel("scipy-1"))),
    ]
    assert not any(is_installed(wanted, NOTE) for wanted in others)


@pytest.mark.parametrize(
    ("installed", "copied", "lacking"),
    [
        (None, {}, ["numpy-2", "scipy-1", "zsim-1", "pip-26"]),  # large files first
        (NOTE, {}, ["zsim-1", "pip-26"]),
        (None, {"numpy-2.whl": "sha of numpy-2", "scipy-1.whl": "cut short"}, ["scipy-1", "zsim-1", "pip-26"]),
    ],
)
def test_installed_or_copied_wheels_are_not_copied_again(
    installed: Any, copied: dict[str, str], lacking: list[str]
) -> None:
    found = missing(HOUSE, {"installed": installed, "wheels": copied})
    assert [each.path.stem for each in found] == lacking


class Local:
    """A local process with the interface of asyncssh's remote one."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.process = process
        self.beaten = asyncio.Event()
        self.stdin, self.stdout, self.stderr = self, Text(process.stdout), Text(process.stderr)

    def write(self, text: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(text.encode())
        if text == "\n":
            self.beaten.set()

    def close(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()

    async def wait_closed(self) -> None:
        await self.process.wait()

    @property
    def exit_status(self) -> int | None:
        return self.process.returncode


class Greeting(HostLink):
    """This machine as a host whose login shell prints a greeting."""

    def __init__(self) -> None:
        super().__init__("h1", Host(address="192.0.2.1"), Path())
        self.processes: list[Local] = []

    @asynccontextmanager
    async def channel(self, retry: bool = False) -> AsyncIterator[Any]:
        try:
            yield self
        finally:
            for each in self.processes:
                each.close()
                await each.process.wait()  # a process that does not end hangs the test

    async def create_process(self, command: str, **_: Any) -> Local:
        pipe = asyncio.subprocess.PIPE
        greeting = f"echo Welcome to lab; echo 17; exec {command}"
        started = await asyncio.create_subprocess_exec("sh", "-c", greeting, stdin=pipe, stdout=pipe, stderr=pipe)
        self.processes.append(Local(started))
        return self.processes[-1]


@asynccontextmanager
async def installer(
    folder: Path, host: Greeting | None = None, python: str = sys.executable, tell: Any = lambda _: None
) -> AsyncIterator[Installer]:
    async with open_installer(host or Greeting(), python, str(folder), tell) as program:
        yield program


def ask(folder: Path, act: str, **order: Any) -> dict[str, Any]:
    async def work() -> dict[str, Any]:
        async with installer(folder) as program:
            return await program.ask(act, ASK_S, **order)

    return asyncio.run(work())


def start_refusal(python: str, folder: Path) -> str:
    """Return the error with which an installer fails to start."""

    async def work() -> None:
        async with installer(folder, python=python):
            pass

    with pytest.raises(HostsError) as caught:
        asyncio.run(work())
    return str(caught.value)


def test_an_installer_that_cannot_start_is_reported(tmp_path: Path) -> None:
    """A greeting of the login shell does no harm."""
    assert ask(tmp_path, "look")["folder"] == str(tmp_path)
    silent = shutil.which("true") or ""
    assert has_terms(start_refusal(silent, tmp_path), "h1", str(silent), "nothing")
    (tmp_path / "file").touch()
    wrong, why = f"{tmp_path}/file/zsim", os.strerror(errno.ENOTDIR)
    assert has_terms(start_refusal(sys.executable, Path(wrong)), "h1", wrong, why, "hosts.h1.folder")


def write_pip(folder: Path, text: str) -> dict[str, Any]:
    """Write a stand-in for pip and return an order that runs it first."""
    script = folder / "wheels/pip-1.whl/pip/__main__.py"
    script.parent.mkdir(parents=True)
    script.write_text(text)
    return {"project": "zsim-1.whl", "pip": "pip-1.whl", "wheels": [], "extras": [], "modules": [], "note": {}}


def test_an_installation_ends_with_its_channel(tmp_path: Path) -> None:
    """Only pip holds the writing end of the pipe, so reading meets the end of file once pip is gone."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    order = write_pip(tmp_path, f"import signal; held = open({str(pipe)!r}, 'w'); signal.pause()")

    async def work() -> None:
        async with installer(tmp_path) as program:
            asked = asyncio.create_task(program.ask("install", ASK_S, **order))
            reading = await asyncio.to_thread(open, pipe)
            asked.cancel()
            await asyncio.wait([asked])
        stream = asyncio.StreamReader()
        loop = asyncio.get_running_loop()
        way, _ = await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(stream), reading)
        assert await asyncio.wait_for(stream.read(), ASK_S) == b""
        way.close()

    asyncio.run(work())


def test_the_program_on_the_host_ends_when_its_launcher_falls_silent(tmp_path: Path) -> None:
    command = [sys.executable, "-P", on_host.__file__, str(tmp_path), "anna", "0.1"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL) as program:
        assert program.wait(ASK_S) == 0  # its standard input is still open


def test_a_running_launcher_sends_heartbeats(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zsim_deploy.hosts.push.BEAT_S", 0.01)

    async def work() -> dict[str, Any]:
        host = Greeting()
        async with installer(tmp_path, host) as program:
            await host.processes[0].beaten.wait()
            return await program.ask("look", ASK_S)

    assert asyncio.run(work())["installed"] is None


def test_an_error_of_pip_is_reported_in_one_line(tmp_path: Path) -> None:
    order = write_pip(tmp_path, "import sys; sys.exit('ERROR: No space left on device\\nnote: more')")
    with refused(HostsError, "h1", "ERROR", os.strerror(errno.ENOSPC)) as raised:
        ask(tmp_path, "install", **order)
    assert "\n" not in str(raised.value)


def test_a_second_push_reports_the_process_that_it_waits_for(tmp_path: Path) -> None:
    steps: list[str] = []

    async def second(waits: asyncio.Event) -> dict[str, Any]:
        def tell(text: str) -> None:
            steps.append(text)
            waits.set()

        async with installer(tmp_path, tell=tell) as program:
            return await program.ask("look", ASK_S)

    async def work() -> int:
        waits, first = asyncio.Event(), Greeting()
        async with installer(tmp_path, first):
            waiting = asyncio.create_task(second(waits))
            await waits.wait()
        assert (await waiting)["folder"] == str(tmp_path)
        return first.processes[0].process.pid

    pid = asyncio.run(work())
    (line,) = steps
    assert has_terms(line, f"{getpass.getuser()}@{socket.gethostname()}", f"process {pid}")


def test_a_push_that_takes_too_long_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zsim_deploy.hosts.push.WAIT_S", 0.01)

    async def work() -> str:
        async with installer(tmp_path):
            return await asyncio.to_thread(start_refusal, sys.executable, tmp_path)

    refusal = asyncio.run(work())
    assert has_terms(refusal, "h1", f"{getpass.getuser()}@{socket.gethostname()}", "process", "pushing")


def pushed(cache: Path, names: list[str], extras: list[str], progress: Any = print, **hosts: Host) -> dict[str, bool]:
    where = InventoryFile(Inventory(hosts=dict(hosts), roles={}), Path("/nowhere"), "hosts.yaml")
    return asyncio.run(push(where, names, extras, progress, cache))


def test_a_host_with_its_own_interpreter_is_skipped(tmp_path: Path) -> None:
    own = Host(address="192.0.2.1", python="/opt/zsim/bin/python")
    assert pushed(tmp_path, [], [], a=own) == {"a": False}


@pytest.mark.parametrize(
    ("names", "extras", "terms"),
    [
        (["c"], [], ("--host c", "a", "b")),
        ([], ["agents", "nonsense"], ("--extra nonsense", "agents", "all", "world")),
    ],
)
def test_an_unknown_host_or_extra_is_refused_with_the_known_ones(
    tmp_path: Path, names: list[str], extras: list[str], terms: tuple[str, ...]
) -> None:
    with refused(InventoryError, *terms):
        pushed(tmp_path, names, extras, a=Host(address="192.0.2.1"), b=Host(address="192.0.2.2"))


def test_every_failed_host_is_reported_in_a_line(tmp_path: Path) -> None:
    closed = Host(address="127.0.0.1", port=1)  # tcpmux, on which nothing listens
    steps: list[tuple[str, ...]] = []
    with pytest.raises(HostsError) as caught:
        pushed(tmp_path, [], [], lambda *step: steps.append(step), a=closed, b=closed, c=Host(address="h", python="/p"))
    assert {("a", "failed"), ("b", "failed")} <= set(steps)  # the reason is given once, at the end
    lines = str(caught.value).splitlines()
    assert [line.partition(": ")[0] for line in lines] == ["a", "b"]
    assert all(has_terms(line, os.strerror(errno.ECONNREFUSED)) for line in lines)


HERE = (3, 11)


def found(**versions: str) -> list[Interpreter]:
    """Return interpreters; python3_12="3.12.1" stands for the command python3.12."""
    lines = (f"{name.replace('_', '.')} {version} /usr/bin/{name}" for name, version in versions.items())
    return parse_interpreters("\n".join(lines))


def test_python3_is_preferred_if_it_has_the_minor_version_of_the_launcher() -> None:
    several = found(python3="3.13.2", python3_12="3.12.1", python3_11="3.11.9")
    assert choose_interpreter("h", several, HERE).command == "python3.11"
    assert choose_interpreter("h", found(python3="3.11.2", python3_11="3.11.9"), HERE).command == "python3"


@pytest.mark.parametrize(
    ("there", "terms"),
    [
        (found(python3="3.9.2"), ("python3 3.9.2", "3.11", "python3.11")),
        (found(python3="3.13.2", python3_13="3.13.2", python3_12="3.12.1"), ("python3.12 3.12.1", "python3 3.13.2", "3.11")),
        ([], ("python3", "3.11", "python3.11")),
    ],
)  # fmt: skip
def test_another_minor_version_of_python_is_refused(there: list[Interpreter], terms: tuple[str, ...]) -> None:
    """A run does not accept a host with another minor version."""
    with refused(HostsError, "onboard1", *terms):
        choose_interpreter("onboard1", there, HERE)


def test_the_query_finds_interpreters_and_ignores_a_greeting() -> None:
    answer = subprocess.run(["sh", "-c", interpreter_query()], capture_output=True, text=True, check=True).stdout
    assert parse_interpreters(answer)
    for each in parse_interpreters(answer):
        version = subprocess.run([each.path, "--version"], capture_output=True, text=True, check=True).stdout
        assert version.strip() == f"Python {'.'.join(map(str, each.version))}"
    output = "Welcome to lab\nlast login 3.11.2 today\n\npython3 3.11.2 /usr/bin/python3\npython3.12 is here\n"
    assert parse_interpreters(output) == [Interpreter("python3", (3, 11, 2), "/usr/bin/python3")]
