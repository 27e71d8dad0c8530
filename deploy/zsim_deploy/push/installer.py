"""on_host.py as it runs on a host: asked over one ssh channel, it ends with all that it does when that closes.

Before it: which Python of a host runs it and is installed for, and which wheels fit that.
"""

import asyncio
import contextlib
import getpass
import json
import re
import socket
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import asyncssh

from zsim.errors import HostsError
from zsim_deploy.hosts.host_link import HostLink
from zsim_deploy.hosts.host_links import ProgramEndedError, RemoteProgram, open_program
from zsim_deploy.hosts.ssh_connection import shell_line
from zsim_deploy.push import on_host

START_S = 30.0  # wall time to start a Python on a small computer, over a poor link
BEAT_S = 5.0  # how often the launcher shows that it lives
SILENT_S = 60.0  # wall time without that, after which the program ends by itself; a link may be cut for shorter
WAIT_S = 1800.0  # wall time for another push to end; as long as it may take to install and to compile
OLDEST_MINOR = 11  # pyproject.toml, requires-python
NEWEST_MINOR = 14  # the last Python whose name is tried
PLAIN = "python3"
ANSWER = re.compile(r"(python3(?:\.\d+)?) (\d+)\.(\d+)\.(\d+) (/.*)")  # command, version, path
MANYLINUX_OLDEST = 5  # glibc 2.5; PEP 600
LEGACY = {
    17: "manylinux2014",
    12: "manylinux2010",
    5: "manylinux1",
}  # glibc 2.x that the older names stand for; PEP 600


class Interpreter(NamedTuple):
    """A Python of a host."""

    command: str
    version: tuple[int, int, int]
    path: str


class WheelTarget(NamedTuple):
    """What wheels must fit."""

    version: tuple[int, int]
    abi: str
    """Such as cp311; PEP 425."""
    platforms: tuple[str, ...]
    """Platform tags that run there, the best first."""

    def options(self) -> list[str]:
        """Return the options by which pip takes wheels for this target."""
        platforms = [word for name in self.platforms for word in ("--platform", name)]
        version = ".".join(map(str, self.version))
        return ["--implementation", "cp", "--python-version", version, "--abi", self.abi, *platforms]

    def __str__(self) -> str:
        return f"Python {'.'.join(map(str, self.version))} on {self.platforms[0]}"


def interpreter_query() -> str:
    """Return a line of POSIX shell that prints command, version and path of every Python of a host."""
    names = [PLAIN, *(f"python3.{minor}" for minor in range(NEWEST_MINOR, OLDEST_MINOR - 1, -1))]
    code = 'import sys; print("%d.%d.%d" % sys.version_info[:3], sys.executable)'
    return f"for p in {' '.join(names)}; do facts=$($p -c '{code}' 2>/dev/null) && echo $p $facts; done; true"


def parse_interpreters(answer: str) -> list[Interpreter]:
    """Return what `interpreter_query` printed; a greeting of the login shell is passed over."""
    matches = filter(None, map(ANSWER.fullmatch, answer.splitlines()))
    return [Interpreter(each[1], (int(each[2]), int(each[3]), int(each[4])), each[5]) for each in matches]


def choose_interpreter(name: str, interpreters: Sequence[Interpreter], here: tuple[int, int]) -> Interpreter:
    """Return the Python to install for: of the launcher's minor version, `python3` rather than another.

    Raises:
        HostsError: there is none; no run takes a host with another one, as its bits would differ.
    """
    fit = [each for each in interpreters if each.version[:2] == here]
    if fit:
        return max(fit, key=lambda each: (each.command == PLAIN, each.version))
    wanted = ".".join(map(str, here))
    if not interpreters:
        raise HostsError(f"{name}: has no python3; must be Python {wanted} as here; install python{wanted} there")
    by_version = {".".join(map(str, each.version)): each.command for each in reversed(interpreters)}
    found = ", ".join(f"{command} {version}" for version, command in by_version.items())
    raise HostsError(
        f"{name}: has {found}; must be Python {wanted} as here, for the same bits; install python{wanted} beside it, "
        "or start zsim here with a Python that it has"
    )


def wheel_target(name: str, facts: Mapping[str, Any]) -> WheelTarget:
    """Return what wheels for a host must fit.

    Args:
        name: of the host, for errors.
        facts: of the host, by on_host.py.

    Raises:
        HostsError: wheels are not made for such a system.
    """
    major, minor = facts["version"]
    if facts["implementation"] != "cpython":
        raise HostsError(f"{name}: its Python is {facts['implementation']}; must be CPython; install that there")
    platforms = _platforms(facts["platform"], facts["libc"])
    if not platforms:
        shown = " ".join(filter(None, (facts["platform"], *facts["libc"])))
        raise HostsError(f"{name}: is {shown}; must be Linux with glibc, or macOS; install zsim by hand there")
    return WheelTarget((major, minor), f"cp{major}{minor}{'t' if facts['free_threaded'] else ''}", tuple(platforms))


def _platforms(system: str, libc: Sequence[str]) -> list[str]:
    """Return the platform tags of PEP 600 (Linux) or of PEP 425 (macOS), the best first."""
    kind, _, rest = system.partition("-")
    if kind == "macosx":
        return [f"macosx_{rest}".replace(".", "_").replace("-", "_")]
    if kind != "linux" or libc[0] != "glibc":
        return []
    machine = rest.replace("-", "_")
    tags = []
    for minor in range(int(libc[1].split(".")[1]), MANYLINUX_OLDEST - 1, -1):
        tags.append(f"manylinux_2_{minor}_{machine}")
        tags += [f"{LEGACY[minor]}_{machine}"] if minor in LEGACY else []
    return [*tags, f"linux_{machine}"]


class Installer:
    """The program on a host.

    Args:
        name: of the host, for errors.
        python: that runs it, for errors.
        program: over there.
    """

    def __init__(self, name: str, python: str, program: RemoteProgram) -> None:
        self._name, self._python, self._program = name, python, program

    async def lock(self, progress: Callable[[str], None]) -> None:
        """Wait until nobody else installs there.

        Args:
            progress: takes a line on who does.

        Raises:
            HostsError: the folder cannot be used, or somebody installs for too long.
        """
        message = await self._answer(START_S)
        if holder := message.get("waits"):
            progress(f"waiting for the push of {holder}")
            message = await self._answer(WAIT_S, f"{holder} is pushing to it; wait for that to end, or end it there")
        if why := message.get("unwritable"):
            raise HostsError(
                f"{self._name}: its folder cannot be used ({why}); correct hosts.{self._name}.folder, or make it there"
            )
        if why := message.get("unlocked"):
            progress(f"its folder cannot be locked ({why}); do not let two commands push to it at a time")

    async def ask(self, act: str, timeout_s: float, **order: Any) -> dict[str, Any]:
        """Give an order and return the answer.

        Raises:
            HostsError: it failed, took longer, or the host is gone.
        """
        self._program.send(json.dumps({"act": act, **order}) + "\n")
        message = await self._answer(timeout_s, f"to {act} took longer than {timeout_s:g} s; is it busy?")
        if "error" in message:
            raise HostsError(f"{self._name}: {message['error'][:300]}")
        return message

    async def beat(self) -> None:
        """Show for ever that we live."""
        with contextlib.suppress(asyncssh.Error, OSError):
            while True:
                await asyncio.sleep(BEAT_S)
                self._program.send("\n")

    async def _answer(self, timeout_s: float, late: str = "") -> dict[str, Any]:
        try:
            return await self._program.answer(timeout_s, late)
        except ProgramEndedError as error:
            last = error.last or "printed nothing; does it run there?"
            raise HostsError(f"{self._name}: {self._python} {last}") from error


@contextlib.asynccontextmanager
async def open_installer(
    link: HostLink, python: str, folder: str, progress: Callable[[str], None]
) -> AsyncIterator[Installer]:
    """Let the program run on a host as long as the block lasts; it alone installs there.

    Args:
        python: that runs it.
        folder: of zsim over there.
        progress: takes a line on who is waited for.

    Raises:
        HostsError: the host cannot be reached, its folder not be used, or the connection breaks.
    """
    script = Path(on_host.__file__).read_bytes()
    start = f"import sys; exec(sys.stdin.buffer.read({len(script)}))"  # not to the end: that means to end
    who = f"{getpass.getuser()}@{socket.gethostname()}"
    async with open_program(link, shell_line([python, "-P", "-c", start, folder, who, f"{SILENT_S:g}"])) as program:
        program.send(script.decode())
        there = Installer(link.name, python, program)
        beats = asyncio.create_task(there.beat())
        try:
            await there.lock(progress)
            yield there
        finally:
            beats.cancel()
