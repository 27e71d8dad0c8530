"""`zsim push`: install zsim on the hosts of an inventory, over ssh alone; the hosts need no internet."""

import asyncio
import os
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import asyncssh
from rich.console import Console
from rich.live import Live
from rich.table import Table

from zsim import __version__
from zsim.errors import HostsError, InventoryError
from zsim.runtime.progress import cell
from zsim_deploy.hosts.host_link import HostLink
from zsim_deploy.hosts.ssh_connection import shell_line, start_sftp
from zsim_deploy.inventory.inventory import Host, InventoryFile
from zsim_deploy.inventory.processes import MODULES, known_extras, needed_extras
from zsim_deploy.push.installer import (
    Installer,
    choose_interpreter,
    interpreter_query,
    open_installer,
    parse_interpreters,
    wheel_target,
)
from zsim_deploy.push.wheelhouse import Wheel, Wheelhouse, WheelSet
from zsim_deploy.roles import warm_up

LAUNCHER = "launcher"  # name of this machine among the hosts, in progress lines
ASK_S = 30.0  # wall time for a host to start a few Pythons; a small computer takes seconds
INSTALL_S = 900.0  # wall time to unpack 100 MB of wheels on a slow memory card
COMPILE_S = 900.0  # wall time to compile what flies; half a minute on a laptop's core
COPIES = 4  # files under way to one host at a time

Progress = Callable[[str, str], None]  # host, what is being done there


async def push(
    placed: InventoryFile, names: Sequence[str], more: Iterable[str], progress: Progress, cache: Path
) -> dict[str, bool]:
    """Install on hosts what their roles need.

    Args:
        names: of the hosts; all of the inventory if empty.
        more: extras for each of them beside those of its roles.
        progress: takes a host and what is being done there.
        cache: folder of the wheelhouse.

    Returns:
        For each host whether anything had to be done there.

    Raises:
        InventoryError: a host is not in the inventory, or there is no such extra.
        HostsError: with a line for each host at which it failed; the others are done.
    """
    hosts = placed.inventory.hosts
    more = list(more)
    unknown = [f"--host {name}: must be one of {', '.join(hosts)}" for name in names if name not in hosts]
    known = known_extras()
    unknown += [f"--extra {name}: must be one of {', '.join(known)}" for name in more if name not in known]
    if unknown:
        raise InventoryError(unknown)
    wanted = needed_extras(placed.inventory, more)
    wheelhouse = Wheelhouse(cache, lambda text: progress(LAUNCHER, text))
    chosen_names = list(dict.fromkeys(names)) or list(hosts)
    work = [_one(name, hosts[name], placed.folder, wanted[name], wheelhouse, progress) for name in chosen_names]
    results = await asyncio.gather(*work, return_exceptions=True)
    _raise_all(results)
    return {name: result is True for name, result in zip(chosen_names, results, strict=True)}


def _raise_all(results: Sequence[Any]) -> None:
    """Raise what failed, as lines of one error; anything that is no host's fault as it is."""
    for result in results:
        if isinstance(result, BaseException) and not isinstance(result, HostsError):
            raise result
    if lines := list(dict.fromkeys(str(result) for result in results if isinstance(result, HostsError))):
        raise HostsError("\n".join(lines))


async def _one(
    name: str, host: Host, base: Path, wanted: frozenset[str], wheelhouse: Wheelhouse, progress: Progress
) -> bool:
    """Install on one host; return whether anything had to be done."""
    if host.python:
        progress(name, f"has zsim of its own in {host.python}")
        return False
    link = HostLink(name, host, base)
    try:
        progress(name, "looking what is there")
        python = await _python(link)
        async with open_installer(link, python, host.folder, partial(progress, name)) as program:
            return await _install(HostInstallation(link, program), wanted, wheelhouse, partial(progress, name))
    except HostsError:
        progress(name, "failed")
        raise
    finally:
        await link.close()


async def _python(link: HostLink) -> str:
    """Return the Python of a host to install for."""
    output = await link.run(shell_line(["sh", "-c", interpreter_query()]), timeout_s=ASK_S)
    return choose_interpreter(link.name, parse_interpreters(output.decode(errors="replace")), sys.version_info[:2]).path


async def _install(
    there: "HostInstallation", wanted: frozenset[str], wheelhouse: Wheelhouse, progress: Callable[[str], None]
) -> bool:
    """Install what is wanted; return whether anything had to be done."""
    await there.look()
    needed = await wheelhouse.wheel_set(there.name, wheel_target(there.name, there.facts), wanted)
    described = " ".join(("zsim", __version__, *(f"+{extra}" for extra in needed.extras)))
    if is_installed(needed, there.facts["installed"]):
        progress(f"{described} is there")
        return False
    await there.copy(missing(needed, there.facts), progress)
    progress("installing")
    await there.install(needed)
    if any(wheel.path.name.startswith("numba-") for wheel in needed.others):
        progress("compiling what flies")
        await there.warm_up(needed.extras)
    progress(f"{described} installed")
    return True


def is_installed(wanted: WheelSet, installed: dict[str, Any] | None) -> bool:
    """Return whether a host has what it needs, by the note of the last push: perhaps more, but nothing else."""
    if installed is None or installed["project"] != wanted.project.sha256:
        return False
    return set(wanted.extras) <= set(installed["extras"]) and not _new(wanted, installed)


def _new(wanted: WheelSet, installed: dict[str, Any] | None) -> list[Wheel]:
    """Return the wheels of other projects that are not installed yet."""
    known = installed["wheels"] if installed else {}
    return [wheel for wheel in wanted.others if known.get(wheel.path.name) != wheel.sha256]


def missing(wanted: WheelSet, facts: dict[str, Any]) -> list[Wheel]:
    """Return the wheels that must be copied to a host, small ones last so that progress is smooth."""
    needed = [wanted.project, wanted.pip, *_new(wanted, facts["installed"])]
    lacking = [wheel for wheel in needed if facts["wheels"].get(wheel.path.name) != wheel.sha256]
    return sorted(lacking, key=lambda wheel: -wheel.size_bytes)


class HostInstallation:
    """What is on a host, and what is done to it."""

    def __init__(self, link: HostLink, program: Installer) -> None:
        self.name = link.name
        self._link, self._program = link, program
        self.facts: dict[str, Any] = {}

    async def look(self) -> None:
        """Find what is installed."""
        self.facts = await self._program.ask("look", ASK_S)

    async def install(self, wanted: WheelSet) -> None:
        order = {
            "project": wanted.project.path.name,
            "pip": wanted.pip.path.name,
            "wheels": [wheel.path.name for wheel in _new(wanted, self.facts["installed"])],
            "extras": wanted.extras,
            "modules": [MODULES[extra] for extra in ("", *wanted.extras) if extra in MODULES],
            "note": wanted.manifest(),
        }
        await self._program.ask("install", INSTALL_S, **order)

    async def warm_up(self, extras: Sequence[str]) -> None:
        """Compile what the roles run that need these extras."""
        await self._program.ask("warm_up", COMPILE_S, module=warm_up.__name__, extras=extras)

    async def copy(self, wheels: Sequence[Wheel], progress: Callable[[str], None]) -> None:
        """Copy wheels to the host; what broke off is not mistaken for a wheel."""
        folder = f"{self.facts['folder']}/wheels"
        total, done = sum(wheel.size_bytes for wheel in wheels), 0
        gate = asyncio.Semaphore(COPIES)

        async def one(sftp: asyncssh.SFTPClient, wheel: Wheel) -> None:
            nonlocal done
            part, seen = f"{folder}/{wheel.path.name}.part", 0

            def on_copied(_source: bytes, _target: bytes, copied: int, _size: int) -> None:
                nonlocal done, seen
                done, seen = done + copied - seen, copied
                progress(f"copying {done / 1e6:.0f} of {total / 1e6:.0f} MB")

            async with gate:
                await sftp.put(str(wheel.path), part, progress_handler=on_copied)
                await sftp.posix_rename(part, part.removesuffix(".part"))

        try:
            async with await start_sftp(self.name, await self._link.open()) as sftp:
                await sftp.makedirs(folder, exist_ok=True)
                await asyncio.gather(*(one(sftp, wheel) for wheel in wheels))
        except (asyncssh.Error, OSError) as error:
            raise HostsError(
                f"{self.name}: copying to {folder} failed ({error}); is there space, is the link up?"
            ) from error


def default_cache() -> Path:
    """Return the folder of the wheelhouse on this machine (XDG Base Directory Specification)."""
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "zsim"
    except RuntimeError as error:  # HOME is not set, and the system does not know the user
        raise HostsError(
            "push: this user has no home for what is downloaded; set XDG_CACHE_HOME to a folder"
        ) from error


class PushProgress:
    """Shows the stage of each host while it is entered."""

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
        """Show what is being done at a host."""
        kind, last = (re.sub(r"\d+ of", "", each) for each in (text, self._now.get(host, "")))
        self._now[host] = text
        if not self._console.is_terminal and kind != last:
            self._console.print(cell(f"{host}: {text}"), soft_wrap=True)

    def _table(self) -> Table:
        table = Table.grid(padding=(0, 2))
        for host, text in self._now.items():
            table.add_row(cell(host), cell(text))
        return table
