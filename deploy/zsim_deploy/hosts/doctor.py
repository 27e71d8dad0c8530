"""`zsim doctor`: whether the hosts of an inventory can fly together, before anything is started on them."""

import asyncio
import platform
import time
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any, NamedTuple

import asyncssh

from zsim import __version__
from zsim.errors import HostsError
from zsim_deploy.hosts.host_link import HostLink
from zsim_deploy.hosts.ssh_connection import json_answer, shell_line, shell_word

CLOCK_OFFSET_MAX_S = 1.0  # certificates are back-dated by a day and logs are compared; time on the wire is simulated
LOAD_MAX = 0.5  # of the cores; what is busy already slows everybody in lockstep
FREE_MIN_BYTES = 1_000_000_000  # a run of an hour with three drones records about this
BITS_PER_S_MIN = 10e6  # three drones in realtime send 2 Mbit/s to a recorder; lockstep goes as fast as the link
PERFORMANCE = {"performance"}
ABOUT_S = 20.0  # wall time to say everything; a small computer takes 5 s to import numpy
READY_S = 20.0  # wall time to listen; as long as to import numpy
REACH_S = 60.0  # wall time to measure a path; 9 pings and at most 9 bulks take 40 s at a round trip of 2 s
NO_MODULE = "no module named"  # in Python's error, in lower case
NO_PROGRAM = ("not found", "no such file")  # what shells say, in lower case …
NO_PROGRAM_CODES = (126, 127)  # … and the codes with which they end; POSIX, 2.8.2
OFFSET_ASKS = 3  # the answer with the shortest round trip gives the clock's offset best


class HostReport(NamedTuple):
    """The facts of a host by its own probe, and what asking it showed."""

    facts: dict[str, Any]
    round_trip_s: float
    clock_offset_s: float
    """Its wall clock minus ours, good to half the round trip."""
    remedy: str = "run `zsim push --hosts FILE`"
    """How it gets another zsim."""


class NetworkPath(NamedTuple):
    """How a host reaches the port on which another listens."""

    source: str
    target: str
    port: int
    figures: dict[str, Any]


async def host_report(link: HostLink, python: str, hosts: str = "FILE") -> HostReport:
    """Ask a host about itself.

    Args:
        python: interpreter there that has zsim.
        hosts: the inventory's path, for remedies.

    Raises:
        HostsError: it has no zsim, or cannot be asked.
    """
    remedy = _remedy(link, hosts)
    try:
        async with _within(link, ABOUT_S), _probe(link, python, "about", link.host.folder) as there:
            facts = await there.answer()
            round_trip_s, offset_s = min([await _offset(there) for _ in range(OFFSET_ASKS)])
    except _EndedError as error:
        fault = _no_zsim(link, python, remedy, error) or f"{python}: {error}; is it a Python that has zsim?"
        raise HostsError(f"{link.name}: {fault}") from error
    return HostReport(facts, round_trip_s, offset_s, remedy)


def _remedy(link: HostLink, hosts: str) -> str:
    """Return how a host gets another zsim; `zsim push` leaves one with a Python of its own alone."""
    push = f"run `zsim push --hosts {hosts}`"
    return f"install it there, or leave hosts.{link.name}.python out and {push}" if link.host.python else push


def _no_zsim(link: HostLink, python: str, remedy: str, error: "_EndedError") -> str:
    """Return what a host lacks, from how its probe ended; empty if it is something else."""
    text = error.last.lower()
    if NO_MODULE in text:
        return f"{python} has no zsim {__version__}; {remedy}"
    if error.status not in NO_PROGRAM_CODES and not any(sign in text for sign in NO_PROGRAM):
        return ""
    if link.host.python:
        return f"python {python} is no program there ({error.last}); correct hosts.{link.name}.python, or {remedy}"
    return f"has no zsim in {link.host.folder}; {remedy}"


class _EndedError(HostsError):
    """A probe has ended without an answer.

    Attributes:
        status: exit code.
        last: line that it printed.
    """

    def __init__(self, status: int | None, last: str) -> None:
        super().__init__(f"the probe ended with code {status} ({last})")
        self.status, self.last = status, last


class _Probe:
    """A probe that runs on a host, as a process there."""

    def __init__(self, process: "asyncssh.SSHClientProcess[str]") -> None:
        self._process = process

    async def answer(self) -> dict[str, Any]:
        """Return its next message; a greeting of the login shell is passed over.

        Raises:
            _EndedError: it has ended.
        """
        while line := await self._process.stdout.readline():
            if message := json_answer([line]):
                return message
        last = (await self._process.stderr.read()).strip().splitlines() or ["it printed nothing"]
        await self._process.wait_closed()
        raise _EndedError(self._process.exit_status, last[-1][:200])

    async def ask(self) -> dict[str, Any]:
        """Send it a line and return its answer."""
        self._process.stdin.write("\n")
        return await self.answer()


@asynccontextmanager
async def _within(link: HostLink, limit_s: float) -> AsyncIterator[None]:
    """Bound the time of a block in which a host is asked.

    Raises:
        HostsError: it took longer.
    """
    try:
        async with asyncio.timeout(limit_s):
            yield
    except TimeoutError as error:
        raise HostsError(f"{link.name}: no answer within {limit_s:g} s; is the link slow, the host busy?") from error


@asynccontextmanager
async def _probe(link: HostLink, python: str, *words: str) -> AsyncIterator[_Probe]:
    """Run a probe on a host as long as the block lasts.

    Raises:
        HostsError: the host cannot be reached, or the connection breaks.
    """
    command = f"{shell_word(python)} -m zsim_deploy.hosts.probe {shell_line(words)}"
    try:
        process = await (await link.open()).create_process(command, encoding="utf-8", errors="replace")
        try:
            yield _Probe(process)
        finally:
            process.close()  # not waited for: on a link that is cut it would take a minute
    except (asyncssh.Error, OSError) as error:
        raise HostsError(f"{link.name}: the connection broke ({error}); is the host up?") from error


async def _offset(probe: _Probe) -> tuple[float, float]:
    """Return the round trip of a word and the clock's offset, in seconds."""
    start_s, sent_s = time.time(), time.monotonic()
    there_s = (await probe.ask())["time_ns"] / 1e9
    took_s = time.monotonic() - sent_s
    return took_s, there_s - (start_s + took_s / 2)


def compare_reports(reports: dict[str, HostReport]) -> tuple[list[str], list[str]]:
    """Return what keeps the hosts from flying together, and what is only worth knowing, a line each."""
    faults = [line for name, report in reports.items() for line in _faults(name, report)]
    warnings = [line for name, report in reports.items() for line in _warnings(name, report)]
    prints = {name: report.facts["fingerprint"] for name, report in reports.items()}
    if len(set(prints.values())) > 1:
        shown = ", ".join(f"{name} {text[:8]}" for name, text in prints.items())
        warnings.append(f"the hosts compute with different numeric fingerprints ({shown}); same bits are not promised")
    return faults, warnings


def _faults(name: str, report: HostReport) -> Iterator[str]:
    facts = report.facts
    if facts["zsim"] != __version__:
        yield f"{name}: zsim is {facts['zsim']}; must be {__version__} as here; {report.remedy}"
    ours = platform.python_version_tuple()[:2]
    if tuple(facts["python"].split(".")[:2]) != ours:
        yield f"{name}: Python is {facts['python']}; must be {'.'.join(ours)} as here, for the same bits"
    if facts["unwritable"]:
        why = facts["unwritable"]
        yield f"{name}: its folder cannot be used ({why}); correct hosts.{name}.folder, or make it there"


def _warnings(name: str, report: HostReport) -> Iterator[str]:
    facts = report.facts
    if abs(report.clock_offset_s) > CLOCK_OFFSET_MAX_S + report.round_trip_s:
        yield f"{name}: its clock is {report.clock_offset_s:+.1f} s off; set it with chrony or ntp"
    if facts["load"] > LOAD_MAX * facts["cores"]:
        yield f"{name}: load is {facts['load']:.1f} on {facts['cores']} cores; lockstep goes at the pace of the slowest"
    slow = set(facts["governors"]) - PERFORMANCE
    if slow:
        yield f"{name}: the CPU governor is {', '.join(sorted(slow))}; performance is steadier (cpupower frequency-set)"
    if facts["free_bytes"] < FREE_MIN_BYTES:
        yield f"{name}: {facts['free_bytes'] / 1e9:.1f} GB are free on its disk; a record of an hour takes about 1 GB"


async def network_paths(
    links: Sequence[HostLink], target: HostLink, python: dict[str, str], port: int
) -> list[NetworkPath]:
    """Return how the hosts reach a port of another, on which nothing else may listen."""
    try:
        async with AsyncExitStack() as stack:
            async with _within(target, READY_S):
                server = await stack.enter_async_context(_probe(target, python[target.name], "serve", str(port)))
                message = await server.answer()
            if "error" in message:
                return [NetworkPath(target.name, target.name, port, message)]
            return [
                NetworkPath(link.name, target.name, port, await _reach(link, target, python, port)) for link in links
            ]
    except HostsError as error:
        return [NetworkPath(target.name, target.name, port, {"error": str(error)})]


async def _reach(link: HostLink, target: HostLink, python: dict[str, str], port: int) -> dict[str, Any]:
    words = ("reach", target.host.address, str(port))
    try:
        async with _within(link, REACH_S), _probe(link, python[link.name], *words) as client:
            return await client.answer()
    except HostsError as error:
        return {"error": str(error)}


def path_faults(paths: Sequence[NetworkPath]) -> tuple[list[str], list[str]]:
    """Return the paths that do not exist, and those that are slow, a line each."""
    faults = [_path_fault(path) for path in paths if "error" in path.figures]
    slow = [
        f"{path.source} reaches {path.target} at {path.figures['bits_per_s'] / 1e6:.1f} Mbit/s only"
        for path in paths
        if path.figures.get("bits_per_s", BITS_PER_S_MIN) < BITS_PER_S_MIN
    ]
    return faults, slow


def _path_fault(path: NetworkPath) -> str:
    why = path.figures["error"]
    another = "give another port in the inventory"
    match path.figures.get("taken"):
        case True:
            what = f"in use there, perhaps by another run; end that (`ss -ltnp` there shows it), or {another}"
            return f"{path.target}: port {path.port} is {what}"
        case False:
            return f"{path.target}: nothing may listen on port {path.port} there ({why}); {another}"
        case _:
            what = f"cannot be reached ({why}); is it open in the firewall?"
            return f"{path.source}: port {path.port} of {path.target} {what}"
