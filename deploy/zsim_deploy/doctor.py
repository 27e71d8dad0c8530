"""`zsim doctor`: whether the hosts of an inventory can fly together, before anything is started on them."""

import asyncio
import contextlib
import json
import platform
import time
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import asyncssh

from zsim import __version__
from zsim.errors import HostsError
from zsim_deploy import shell
from zsim_deploy.host_link import HostLink

CLOCK_OFFSET_MAX_S = 1.0  # certificates are back-dated by a day and logs are compared; time on the wire is simulated
LOAD_MAX = 0.5  # of the cores; what is busy already slows everybody in lockstep
FREE_MIN_BYTES = 1_000_000_000  # a run of an hour with three drones records about this
BITS_PER_S_MIN = 10e6  # three drones in realtime send 2 Mbit/s to a recorder; lockstep goes as fast as the link
PERFORMANCE = {"performance"}
REACH_S = 30.0  # a bulk of 4 MB at 1 Mbit/s
OFFSET_ASKS = 3  # the answer with the shortest round trip says the clock's offset best


class Report(NamedTuple):
    """What a host says of itself, and what asking it showed."""

    said: dict[str, Any]
    round_trip_s: float
    clock_offset_s: float
    """Its wall clock minus ours, good to half the round trip."""


class Path(NamedTuple):
    """How a host reaches the port on which another listens."""

    source: str
    target: str
    port: int
    found: dict[str, Any]


async def about(link: HostLink, python: str) -> Report:
    """Ask a host about itself.

    Raises:
        HostsError: it has no zsim, or cannot be asked.
    """
    try:
        said = json.loads(await link.run(f"{shell.word(python)} -m zsim_deploy.probe about", timeout_s=20.0))
    except (HostsError, ValueError) as error:
        if isinstance(error, HostsError) and "No module" not in str(error) and "not found" not in str(error).lower():
            raise
        raise HostsError(
            f"{link.name}: {python} has no zsim {__version__}; install it with `zsim push`, or correct python"
        ) from error
    asked = [await _offset(link) for _ in range(OFFSET_ASKS)]
    round_trip_s, offset_s = min(asked)
    return Report(said, round_trip_s, offset_s)


async def _offset(link: HostLink) -> tuple[float, float]:
    """Return the round trip of a short command and the clock's offset, in seconds."""
    start_s, sent_s = time.time(), time.monotonic()
    there_s = float(await link.run("date +%s.%N"))
    took_s = time.monotonic() - sent_s
    return took_s, there_s - (start_s + took_s / 2)


def compared(reports: dict[str, Report]) -> tuple[list[str], list[str]]:
    """Return what keeps the hosts from flying together, and what is only worth knowing, a line each."""
    faults = [line for name, report in reports.items() for line in _version_faults(name, report.said)]
    warnings = [line for name, report in reports.items() for line in _warnings(name, report)]
    prints = {name: report.said["fingerprint"] for name, report in reports.items()}
    if len(set(prints.values())) > 1:
        shown = ", ".join(f"{name} {text[:8]}" for name, text in prints.items())
        warnings.append(f"the hosts compute with different numeric fingerprints ({shown}); same bits are not promised")
    return faults, warnings


def _version_faults(name: str, said: dict[str, Any]) -> Iterator[str]:
    if said["zsim"] != __version__:
        yield f"{name}: zsim is {said['zsim']}; must be {__version__} as here; run `zsim push`"
    ours = platform.python_version_tuple()[:2]
    if tuple(said["python"].split(".")[:2]) != ours:
        yield f"{name}: Python is {said['python']}; must be {'.'.join(ours)} as here, for the same bits"


def _warnings(name: str, report: Report) -> Iterator[str]:
    said = report.said
    if abs(report.clock_offset_s) > CLOCK_OFFSET_MAX_S + report.round_trip_s:
        yield f"{name}: its clock is {report.clock_offset_s:+.1f} s off; set it with chrony or ntp"
    if said["load"] > LOAD_MAX * said["cores"]:
        yield f"{name}: load is {said['load']:.1f} on {said['cores']} cores; lockstep goes at the pace of the slowest"
    slow = set(said["governors"]) - PERFORMANCE
    if slow:
        yield f"{name}: the CPU governor is {', '.join(sorted(slow))}; performance is steadier (cpupower frequency-set)"
    if said["free_bytes"] < FREE_MIN_BYTES:
        yield f"{name}: {said['free_bytes'] / 1e9:.1f} GB are free on its disk; a record of an hour takes about 1 GB"


async def reached(links: Sequence[HostLink], target: HostLink, python: dict[str, str], port: int) -> list[Path]:
    """Return how the hosts reach a port of another, on which nothing else may listen."""
    connection = await target.open()
    command = f"{shell.word(python[target.name])} -m zsim_deploy.probe serve {port}"
    async with connection.create_process(command, encoding="utf-8") as server:
        ready = await asyncio.wait_for(server.stdout.readline(), 10.0)
        if not ready:
            last = (await server.stderr.read()).strip().splitlines() or ["it said nothing"]
            return [Path(target.name, target.name, port, {"error": last[-1]})]
        found = [Path(link.name, target.name, port, await _reach(link, target, python, port)) for link in links]
        with contextlib.suppress(OSError, asyncssh.Error):
            server.stdin.write_eof()
    return found


async def _reach(link: HostLink, target: HostLink, python: dict[str, str], port: int) -> dict[str, Any]:
    address = shell.word(target.host.address)
    try:
        said = await link.run(
            f"{shell.word(python[link.name])} -m zsim_deploy.probe reach {address} {port}", timeout_s=30.0
        )
    except HostsError as error:
        return {"error": str(error)}
    return json.loads(said)


def path_faults(paths: Sequence[Path]) -> tuple[list[str], list[str]]:
    """Return the paths that do not exist, and those that are slow, a line each."""
    faults = [
        f"{path.source}: port {path.port} of {path.target} cannot be reached ({path.found['error']}); "
        f"is it open in the firewall, and does nothing else listen there?"
        for path in paths
        if "error" in path.found
    ]
    slow = [
        f"{path.source} reaches {path.target} at {path.found['bits_per_s'] / 1e6:.1f} Mbit/s only"
        for path in paths
        if path.found.get("bits_per_s", BITS_PER_S_MIN) < BITS_PER_S_MIN
    ]
    return faults, slow
