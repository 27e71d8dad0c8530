"""`zsim push`: installs zsim on the hosts of an inventory over ssh; the hosts need no internet access."""

import asyncio
import contextlib
import getpass
import importlib.metadata
import json
import re
import socket
import sys
from collections.abc import AsyncIterator, Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import asyncssh
from rich.console import Console
from rich.live import Live
from rich.table import Table

from zsim import __version__
from zsim.errors import HostsError, InventoryError
from zsim.runtime.progress import cell
from zsim_deploy.hosts import on_host
from zsim_deploy.hosts.host_link import (
    HostLink,
    ProgramEndedError,
    RemoteProgram,
    open_program,
    raise_faults,
    shell_line,
    start_sftp,
)
from zsim_deploy.hosts.wheelhouse import Wheel, Wheelhouse, WheelSet, wheel_target
from zsim_deploy.inventory import MODULES, Host, InventoryFile, needed_extras
from zsim_deploy.roles import warm_up

LAUNCHER = "launcher"  # name of this machine in progress lines
ASK_S = 30.0  # wall time for a host to start a few Pythons; a small computer takes seconds
INSTALL_S = 900.0  # wall time to unpack 100 MB of wheels on a slow memory card
COMPILE_S = 900.0  # wall time to compile the kernels; a laptop takes half a minute
COPIES = 4  # number of files copied to a host at a time
START_S = 30.0  # wall time to start a Python on a small computer, over a poor link
BEAT_S = 5.0  # interval of the launcher's heartbeat, wall time
SILENT_S = 60.0  # without a heartbeat for this long, on_host.py ends itself; shorter link outages are survived
WAIT_S = 1800.0  # wall time for another push to end; the sum of INSTALL_S and COMPILE_S
OLDEST_MINOR = 11  # the oldest Python 3 to look for; requires-python in pyproject.toml
NEWEST_MINOR = 14  # the newest Python 3 to look for
PLAIN = "python3"  # preferred name of the interpreter
ANSWER = re.compile(r"(python3(?:\.\d+)?) (\d+)\.(\d+)\.(\d+) (/.*)")  # command, version, path of an interpreter

Progress = Callable[[str, str], None]  # host, current step


async def push(
    inventory_file: InventoryFile, names: Sequence[str], extra_names: Iterable[str], progress: Progress, cache: Path
) -> dict[str, bool]:
    """Install on hosts, by default on all, what their roles need; return whether anything was installed, by host.

    `names`: the hosts; `extra_names`: extras besides those of the roles; `cache`: folder of the wheelhouse. Raise
    InventoryError if a host or an extra is unknown, and HostsError with a line for each host that failed, once the
    others are done.
    """
    hosts = inventory_file.inventory.hosts
    extra_names = list(extra_names)
    unknown = [f"--host {name}: must be one of {', '.join(hosts)}" for name in names if name not in hosts]
    available = sorted(importlib.metadata.metadata("zsim").get_all("Provides-Extra") or [])
    unknown += [
        f"--extra {name}: must be one of {', '.join(available)}" for name in extra_names if name not in available
    ]
    if unknown:
        raise InventoryError(unknown)
    extras_by_host = needed_extras(inventory_file.inventory, extra_names)
    wheelhouse = Wheelhouse(cache, lambda text: progress(LAUNCHER, text))
    selected = list(dict.fromkeys(names)) or list(hosts)
    work = [
        _push_to(name, hosts[name], inventory_file.folder, extras_by_host[name], wheelhouse, progress)
        for name in selected
    ]
    results = raise_faults(await asyncio.gather(*work, return_exceptions=True))
    return dict(zip(selected, results, strict=True))


async def _push_to(
    name: str, host: Host, base: Path, extras: frozenset[str], wheelhouse: Wheelhouse, progress: Progress
) -> bool:
    if host.python:
        progress(name, f"uses its own zsim, that of {host.python}")
        return False
    link = HostLink(name, host, base)
    try:
        progress(name, "looking for Python")
        output = await link.run(shell_line(["sh", "-c", interpreter_query()]), timeout_s=ASK_S)
        interpreters = parse_interpreters(output.decode(errors="replace"))
        python = choose_interpreter(name, interpreters, sys.version_info[:2]).path
        async with open_installer(link, python, host.folder, partial(progress, name)) as installer:
            return await _install(link, installer, extras, wheelhouse, partial(progress, name))
    except HostsError:
        progress(name, "failed")
        raise
    finally:
        await link.close()


async def _install(
    link: HostLink,
    installer: "Installer",
    extras: frozenset[str],
    wheelhouse: Wheelhouse,
    progress: Callable[[str], None],
) -> bool:
    """Install zsim with the wanted extras; return whether anything was installed."""
    facts = await installer.ask("look", ASK_S)
    needed = await wheelhouse.wheel_set(link.name, wheel_target(link.name, facts), extras)
    description = " ".join(("zsim", __version__, *(f"+{extra}" for extra in needed.extras)))
    if is_installed(needed, facts["installed"]):
        progress(f"{description} is already installed")
        return False
    await _copy(link, f"{facts['folder']}/wheels", missing(needed, facts), progress)
    progress("installing")
    order = {
        "project": needed.project.path.name,
        "pip": needed.pip.path.name,
        "wheels": [wheel.path.name for wheel in _new(needed, facts["installed"])],
        "extras": needed.extras,
        "modules": [MODULES[extra] for extra in ("", *needed.extras) if extra in MODULES],
        "note": needed.manifest(),
    }
    await installer.ask("install", INSTALL_S, **order)
    if any(wheel.path.name.startswith("numba-") for wheel in needed.others):
        progress("compiling the kernels")
        await installer.ask("warm_up", COMPILE_S, module=warm_up.__name__, extras=needed.extras)
    progress(f"{description} installed")
    return True


def is_installed(wheels: WheelSet, installed: dict[str, Any] | None) -> bool:
    """Return whether the wanted wheels are installed on a host, according to the last push's note (`installed`)."""
    if installed is None or installed["project"] != wheels.project.sha256:
        return False
    return set(wheels.extras) <= set(installed["extras"]) and not _new(wheels, installed)


def _new(wheels: WheelSet, installed: dict[str, Any] | None) -> list[Wheel]:
    """Return the wheels of other projects that are not installed yet."""
    installed_hashes = installed["wheels"] if installed else {}
    return [wheel for wheel in wheels.others if installed_hashes.get(wheel.path.name) != wheel.sha256]


def missing(wheels: WheelSet, facts: dict[str, Any]) -> list[Wheel]:
    """Return the wheels that must be copied to a host, the largest first, so that progress is smooth at the end."""
    needed = [wheels.project, wheels.pip, *_new(wheels, facts["installed"])]
    lacking = [wheel for wheel in needed if facts["wheels"].get(wheel.path.name) != wheel.sha256]
    return sorted(lacking, key=lambda wheel: -wheel.size_bytes)


async def _copy(link: HostLink, folder: str, wheels: Sequence[Wheel], progress: Callable[[str], None]) -> None:
    """Copy wheels into a folder of a host; incomplete copies end in .part."""
    total, done = sum(wheel.size_bytes for wheel in wheels), 0
    gate = asyncio.Semaphore(COPIES)

    async def one(sftp: asyncssh.SFTPClient, wheel: Wheel) -> None:
        part, copied_before = f"{folder}/{wheel.path.name}.part", 0

        def on_copied(_source: bytes, _target: bytes, copied: int, _size: int) -> None:
            nonlocal done, copied_before
            done, copied_before = done + copied - copied_before, copied
            progress(f"copying {done / 1e6:.0f} of {total / 1e6:.0f} MB")

        async with gate:
            await sftp.put(str(wheel.path), part, progress_handler=on_copied)
            await sftp.posix_rename(part, part.removesuffix(".part"))

    try:
        async with await start_sftp(link.name, await link.open()) as sftp:
            await sftp.makedirs(folder, exist_ok=True)
            await asyncio.gather(*(one(sftp, wheel) for wheel in wheels))
    except (asyncssh.Error, OSError) as error:
        reason = f"copying to {folder} failed ({error}); is there space, and is the link up?"
        raise HostsError(f"{link.name}: {reason}") from error


class Interpreter(NamedTuple):
    command: str
    version: tuple[int, int, int]
    path: str


def interpreter_query() -> str:
    """Return a POSIX shell command that prints the command, version and path of each Python on a host."""
    names = [PLAIN, *(f"python3.{minor}" for minor in range(NEWEST_MINOR, OLDEST_MINOR - 1, -1))]
    code = 'import sys; print("%d.%d.%d" % sys.version_info[:3], sys.executable)'
    return f"for p in {' '.join(names)}; do facts=$($p -c '{code}' 2>/dev/null) && echo $p $facts; done; true"


def parse_interpreters(answer: str) -> list[Interpreter]:
    """Parse the output of `interpreter_query`, skipping any greeting of the login shell."""
    matches = filter(None, map(ANSWER.fullmatch, answer.splitlines()))
    return [Interpreter(each[1], (int(each[2]), int(each[3]), int(each[4])), each[5]) for each in matches]


def choose_interpreter(name: str, interpreters: Sequence[Interpreter], local: tuple[int, int]) -> Interpreter:
    """Return the Python to install for: one with the launcher's minor version (`local`), preferably called `python3`.

    Raise HostsError if the host has none, because runs with different Pythons would not be identical.
    """
    matching = [each for each in interpreters if each.version[:2] == local]
    if matching:
        return max(matching, key=lambda each: (each.command == PLAIN, each.version))
    needed = ".".join(map(str, local))
    if not interpreters:
        raise HostsError(f"{name}: has no python3; must be Python {needed} as here; install python{needed} there")
    by_version = {".".join(map(str, each.version)): each.command for each in reversed(interpreters)}
    available = ", ".join(f"{command} {version}" for version, command in by_version.items())
    raise HostsError(
        f"{name}: has {available}; must be Python {needed} as here, for identical results; install python{needed} too, "
        "or run zsim here with a Python that the host has"
    )


class Installer:
    """on_host.py running on a host, over one ssh channel; when the channel closes, the program and its children end."""

    def __init__(self, name: str, python: str, program: RemoteProgram) -> None:
        self._name, self._python, self._program = name, python, program

    async def ask(self, action: str, timeout_s: float, **order: Any) -> dict[str, Any]:
        """Send an order and return the answer; raise HostsError if it fails, takes too long, or the host is lost."""
        self._program.send(json.dumps({"act": action, **order}) + "\n")
        message = await self.answer(timeout_s, f"{action} took longer than {timeout_s:g} s; is the host busy?")
        if "error" in message:
            raise HostsError(f"{self._name}: {message['error'][:300]}")
        return message

    async def answer(self, timeout_s: float, late: str = "") -> dict[str, Any]:
        try:
            return await self._program.answer(timeout_s, late)
        except ProgramEndedError as error:
            last = error.last or "printed nothing; does it run there?"
            raise HostsError(f"{self._name}: {self._python} {last}") from error


@contextlib.asynccontextmanager
async def open_installer(
    link: HostLink, python: str, folder: str, progress: Callable[[str], None]
) -> AsyncIterator[Installer]:
    """Run on_host.py with a Python of a host for the duration of the block, after any other push there has ended.

    `folder`: zsim's folder on the host; `progress` takes a line about a push that is awaited. Raise HostsError if the
    host cannot be reached, its folder cannot be used, or the other push takes too long.
    """
    script = Path(on_host.__file__).read_bytes()
    start = f"import sys; exec(sys.stdin.buffer.read({len(script)}))"  # the orders follow in the same stream
    user = f"{getpass.getuser()}@{socket.gethostname()}"
    async with open_program(link, shell_line([python, "-P", "-c", start, folder, user, f"{SILENT_S:g}"])) as program:

        async def beat() -> None:
            with contextlib.suppress(asyncssh.Error, OSError):
                while True:
                    await asyncio.sleep(BEAT_S)
                    program.send("\n")

        program.send(script.decode())
        installer = Installer(link.name, python, program)
        beats = asyncio.create_task(beat())
        try:
            message = await installer.answer(START_S)
            if holder := message.get("waits"):
                progress(f"waiting for the push of {holder}")
                timeout_text = f"{holder} is pushing to it; wait for that push to end, or end it there"
                message = await installer.answer(WAIT_S, timeout_text)
            if reason := message.get("unwritable"):
                remedy = f"correct hosts.{link.name}.folder, or create the folder there"
                raise HostsError(f"{link.name}: its folder cannot be used ({reason}); {remedy}")
            if reason := message.get("unlocked"):
                progress(f"its folder cannot be locked ({reason}); do not run two pushes to it at a time")
            yield installer
        finally:
            beats.cancel()


class PushProgress:
    """Context manager that shows the current step of each host."""

    def __init__(self, console: Console | None = None) -> None:
        self._console = console or Console(stderr=True)
        self._now: dict[str, str] = {}
        self._live = Live(console=self._console, get_renderable=self._table, refresh_per_second=5)

    def __enter__(self) -> "PushProgress":
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._console.is_terminal:
            self._live.stop()

    def update(self, host: str, text: str) -> None:
        kind, last = (re.sub(r"\d+ of", "", each) for each in (text, self._now.get(host, "")))
        self._now[host] = text
        if not self._console.is_terminal and kind != last:
            self._console.print(cell(f"{host}: {text}"), soft_wrap=True)

    def _table(self) -> Table:
        table = Table.grid(padding=(0, 2))
        for host, text in self._now.items():
            table.add_row(cell(host), cell(text))
        return table
