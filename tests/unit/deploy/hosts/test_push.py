"""What a push leaves alone, what it copies, and how the failures of several hosts are shown."""

import asyncio
import contextlib
import errno
import getpass
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from refused import has_terms, refused

from zsim.errors import HostsError, InventoryError
from zsim_deploy import inventory
from zsim_deploy.hosts import on_host
from zsim_deploy.hosts.host_link import HostLink
from zsim_deploy.hosts.push import (
    ASK_S,
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


def test_what_was_installed_last_is_there() -> None:
    assert is_installed(HOUSE, NOTE)
    assert not is_installed(HOUSE, None)


def test_another_build_an_extra_or_another_version_of_a_package_is_not_there() -> None:
    assert not is_installed(HOUSE._replace(project=wheel("zsim-1", sha256="changed")), NOTE)
    assert not is_installed(HOUSE._replace(extras=("agents", "world")), NOTE)
    assert not is_installed(HOUSE._replace(others=(wheel("numpy-3"), wheel("scipy-1"))), NOTE)


def test_more_than_is_needed_may_be_there() -> None:
    assert is_installed(HOUSE._replace(extras=(), others=(wheel("numpy-2"),)), NOTE)
    assert is_installed(HOUSE._replace(pip=wheel("pip-27")), NOTE)


def names(wheels: list[Wheel]) -> list[str]:
    return [each.path.stem for each in wheels]


def test_a_fresh_host_gets_everything_and_large_files_first() -> None:
    assert names(missing(HOUSE, {"installed": None, "wheels": {}})) == ["numpy-2", "scipy-1", "zsim-1", "pip-26"]


def test_what_is_installed_or_was_copied_before_is_not_copied_again() -> None:
    assert names(missing(HOUSE, {"installed": NOTE, "wheels": {}})) == ["zsim-1", "pip-26"]
    copied = {"numpy-2.whl": "sha of numpy-2", "scipy-1.whl": "cut short"}
    assert names(missing(HOUSE, {"installed": None, "wheels": copied})) == ["scipy-1", "zsim-1", "pip-26"]


class Local:
    """A process of this machine, as asyncssh gives one of another."""

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


class Text:
    """The text of a stream of bytes."""

    def __init__(self, stream: asyncio.StreamReader | None) -> None:
        assert stream is not None
        self._stream = stream

    async def readline(self) -> str:
        return (await self._stream.readline()).decode()

    async def read(self) -> str:
        return (await self._stream.read()).decode()


class Greeting(HostLink):
    """This machine, as a host whose login shell greets."""

    def __init__(self) -> None:
        super().__init__("h1", Host(address="192.0.2.1"), Path())
        self.processes: list[Local] = []

    @contextlib.asynccontextmanager
    async def channel(self, retry: bool = False) -> AsyncIterator[Any]:
        try:
            yield self
        finally:
            for each in self.processes:
                each.close()
                await each.process.wait()  # whoever is asked to end and does not, hangs the test

    async def create_process(self, command: str, **_: Any) -> Local:
        pipe = asyncio.subprocess.PIPE
        greeting = f"echo Welcome to lab; echo 17; exec {command}"
        started = await asyncio.create_subprocess_exec("sh", "-c", greeting, stdin=pipe, stdout=pipe, stderr=pipe)
        self.processes.append(Local(started))
        return self.processes[-1]


def hush(_text: str) -> None:
    """Hear what is being done."""


def test_a_greeting_of_the_login_shell_is_passed_over(tmp_path: Path) -> None:
    async def work() -> dict[str, Any]:
        async with open_installer(Greeting(), sys.executable, str(tmp_path), hush) as program:
            return await program.ask("look", ASK_S)

    assert asyncio.run(work())["folder"] == str(tmp_path)


def start_refusal(python: str, folder: Path) -> str:
    """Return what keeps an installer from starting."""

    async def work() -> None:
        async with open_installer(Greeting(), python, str(folder), hush):
            pass

    with pytest.raises(HostsError) as caught:
        asyncio.run(work())
    return str(caught.value)


def test_a_python_that_says_nothing_is_a_line(tmp_path: Path) -> None:
    silent = shutil.which("true") or ""
    assert has_terms(start_refusal(silent, tmp_path), "h1", str(silent), "nothing")


def test_a_folder_that_cannot_be_used_is_a_line_that_says_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert has_terms(
        start_refusal(sys.executable, tmp_path / "file" / "zsim"),
        "h1",
        f"{tmp_path}/file/zsim",
        os.strerror(errno.ENOTDIR),
        "hosts.h1.folder",
    )


def write_pip(folder: Path, text: str) -> dict[str, Any]:
    """Write what stands for pip, and return an order that runs it first."""
    script = folder / "wheels/pip-1.whl/pip/__main__.py"
    script.parent.mkdir(parents=True)
    script.write_text(text)
    return {"project": "zsim-1.whl", "pip": "pip-1.whl", "wheels": [], "extras": [], "modules": [], "note": {}}


def test_what_is_being_installed_ends_with_the_channel(tmp_path: Path) -> None:
    """Nobody but pip holds the writing end of the pipe; it is at its end when pip is gone."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    order = write_pip(tmp_path, f"import signal; held = open({str(pipe)!r}, 'w'); signal.pause()")

    async def work() -> None:
        async with open_installer(Greeting(), sys.executable, str(tmp_path), hush) as program:
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


def test_a_program_ends_whose_launcher_fell_silent(tmp_path: Path) -> None:
    command = [sys.executable, "-P", on_host.__file__, str(tmp_path), "anna", "0.1"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL) as program:
        assert program.wait(ASK_S) == 0  # its standard input is still open


def test_a_launcher_that_lives_shows_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zsim_deploy.hosts.push.BEAT_S", 0.01)

    async def work() -> dict[str, Any]:
        host = Greeting()
        async with open_installer(host, sys.executable, str(tmp_path), hush) as program:
            await host.processes[0].beaten.wait()
            return await program.ask("look", ASK_S)

    assert asyncio.run(work())["installed"] is None


def test_what_pip_says_is_a_line(tmp_path: Path) -> None:
    order = write_pip(tmp_path, "import sys; sys.exit('ERROR: No space left on device\\nnote: more')")

    async def work() -> None:
        async with open_installer(Greeting(), sys.executable, str(tmp_path), hush) as program:
            await program.ask("install", ASK_S, **order)

    with refused(HostsError, "h1", "ERROR", os.strerror(errno.ENOSPC)) as raised:
        asyncio.run(work())
    assert "\n" not in str(raised.value)


def test_a_second_push_says_whom_it_waits_for(tmp_path: Path) -> None:
    async def second(waits: asyncio.Event, steps: list[str]) -> dict[str, Any]:
        def tell(text: str) -> None:
            steps.append(text)
            waits.set()

        async with open_installer(Greeting(), sys.executable, str(tmp_path), tell) as program:
            return await program.ask("look", ASK_S)

    async def work() -> list[str]:
        steps: list[str] = []
        waits = asyncio.Event()
        first = Greeting()
        async with open_installer(first, sys.executable, str(tmp_path), hush):
            waiting = asyncio.create_task(second(waits, steps))
            await waits.wait()
            pid = first.processes[0].process.pid
        assert (await waiting)["folder"] == str(tmp_path)
        (line,) = steps
        assert has_terms(line, f"{getpass.getuser()}@{socket.gethostname()}", f"process {pid}")
        return steps

    assert asyncio.run(work())


def test_who_pushes_for_too_long_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zsim_deploy.hosts.push.WAIT_S", 0.01)

    async def work() -> str:
        async with open_installer(Greeting(), sys.executable, str(tmp_path), hush):
            return await asyncio.to_thread(start_refusal, sys.executable, tmp_path)

    refusal = asyncio.run(work())
    assert has_terms(refusal, "h1", f"{getpass.getuser()}@{socket.gethostname()}", "process", "pushing")


def placed(**hosts: Host) -> InventoryFile:
    return InventoryFile(Inventory(hosts=dict(hosts), roles={}), Path("/nowhere"), "hosts.yaml")


def pushed(where: InventoryFile, names: list[str], cache: Path) -> dict[str, bool]:
    return asyncio.run(push(where, names, [], lambda host, text: None, cache))


def test_a_host_with_an_interpreter_of_its_own_is_left_alone(tmp_path: Path) -> None:
    assert pushed(placed(a=Host(address="192.0.2.1", python="/opt/zsim/bin/python")), [], tmp_path) == {"a": False}


def test_a_host_that_is_not_in_the_inventory_is_a_line(tmp_path: Path) -> None:
    with refused(InventoryError, "--host c", "a", "b"):
        pushed(placed(a=Host(address="192.0.2.1"), b=Host(address="192.0.2.2")), ["c"], tmp_path)


def test_an_extra_that_is_none_is_a_line_with_those_that_are(tmp_path: Path) -> None:
    where = placed(a=Host(address="192.0.2.1"))
    with refused(InventoryError, "--extra nonsense", "agents", "all", "world"):
        asyncio.run(push(where, [], ["agents", "nonsense"], lambda host, text: None, tmp_path))


def test_every_host_that_fails_has_its_line(tmp_path: Path) -> None:
    port = inventory.SSH_PORT - 21  # tcpmux; nobody has it
    closed = Host(address="127.0.0.1", port=port)
    where = placed(a=closed, b=closed, c=Host(address="127.0.0.1", python="/opt/python"))
    steps: list[tuple[str, str]] = []
    with pytest.raises(HostsError) as caught:
        asyncio.run(push(where, [], [], lambda host, text: steps.append((host, text)), tmp_path))
    assert {("a", "failed"), ("b", "failed")} <= set(steps)  # why is said once, in the end
    lines = str(caught.value).splitlines()
    assert [line.partition(": ")[0] for line in lines] == ["a", "b"]
    assert all(has_terms(line, os.strerror(errno.ECONNREFUSED)) for line in lines)


HERE = (3, 11)


def found(**versions: str) -> list[Interpreter]:
    """Return interpreters: python3_12="3.12.1" is the command python3.12."""
    lines = (f"{name.replace('_', '.')} {version} /usr/bin/{name}" for name, version in versions.items())
    return parse_interpreters("\n".join(lines))


def test_the_launchers_minor_version_is_taken_as_python3_where_it_is_that() -> None:
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
def test_a_python_of_another_minor_version_is_a_line_before_anything_is_copied(
    there: list[Interpreter], terms: tuple[str, ...]
) -> None:
    """No run takes a host with another one."""
    with refused(HostsError, "onboard1", *terms):
        choose_interpreter("onboard1", there, HERE)


def test_the_question_finds_the_pythons_of_a_machine() -> None:
    answer = subprocess.run(["sh", "-c", interpreter_query()], capture_output=True, text=True, check=True).stdout
    assert parse_interpreters(answer)
    for each in parse_interpreters(answer):
        version = subprocess.run([each.path, "--version"], capture_output=True, text=True, check=True).stdout
        assert version.strip() == f"Python {'.'.join(map(str, each.version))}"


def test_a_greeting_of_the_login_shell_is_no_python() -> None:
    output = "Welcome to lab\nlast login 3.11.2 today\n\npython3 3.11.2 /usr/bin/python3\npython3.12 is here\n"
    assert parse_interpreters(output) == [Interpreter("python3", (3, 11, 2), "/usr/bin/python3")]
