"""`zsim doctor`: checks whether the hosts of an inventory can fly together, without starting a run.

`zsim up` makes the same checks, but instead of measuring network paths it checks whether the ports are free.
"""

import asyncio
import shlex
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from zsim import __version__
from zsim.errors import HostsError, ZsimError
from zsim.output_folder import RECORD
from zsim.presentation import Column, FittedTable
from zsim.transport.tls import KEY
from zsim_deploy import SAFE_PATH, certificates
from zsim_deploy import inventory as inv
from zsim_deploy.hosts.host_link import (
    HostLink,
    ProgramEndedError,
    RemoteProgram,
    json_answer,
    open_program,
    shell_line,
    shell_word,
)
from zsim_deploy.inventory import SSH_PORT, Host, InventoryFile
from zsim_deploy.roles.stop_channel import FOLDER

CLOCK_OFFSET_MAX_S = 1.0  # logs stay comparable; certificates are back-dated by a day, messages carry simulated time
LOAD_MAX = 0.5  # load average per core; in lockstep a busy host slows down all others
FREE_MIN_BYTES = 1_000_000_000  # about the size of a record of an hour with three drones
BITS_PER_S_MIN = 10e6  # three drones in realtime send 2 Mbit/s to a recorder; lockstep runs as fast as the link allows
PERFORMANCE = {"performance"}  # CPU governors that cause no warning
ABOUT_S = 20.0  # wall time for a probe to report; a small computer takes 5 s to import numpy
READY_S = 20.0  # wall time for a probe to listen, which includes importing numpy
REACH_S = 60.0  # wall time to measure a path; 9 pings and at most 9 bulk transfers take 40 s at a round trip of 2 s
NO_MODULE = "no module named"  # part of Python's error, in lower case
NO_PROGRAM = ("not found", "no such file")  # parts of shells' errors for a missing program, in lower case
NO_PROGRAM_CODES = (126, 127)  # shells' exit codes for a program that cannot be run or is missing; POSIX, 2.8.2
NEEDED_TO_COMPUTE = "scipy"  # a host without it runs only routers and recorders; world and agents need it
OFFSET_SAMPLES = 3  # clock readings; the one with the shortest round trip gives the best estimate of the offset
HOST_COLUMNS = (
    Column("host", "name"),
    Column("python", worth=3),
    Column("zsim"),
    Column("round\ntrip", worth=6, right=True),
    Column("clock", worth=7, right=True),
    Column("load", worth=5, right=True),
    Column("cores", worth=4, right=True),
    Column("governor", "text", worth=2),
    Column("finger\nprint"),
)
PATH_COLUMNS = (
    Column("from", "name"),
    Column("to", "name"),
    Column("port", right=True),
    Column("round trip", "text"),
    Column("bandwidth", worth=1, right=True),
)
RUNS = "runs"  # folder in zsim's folder on a host, with a folder for each run
# A run whose processes are still alive is not listed; without ps, all runs are.
LIST_RUNS = f"""
alive=$(ps -A -ww -o args 2>/dev/null || ps -A -o args 2>/dev/null)
for run in *; do
  case "$alive" in *"--launched $run "*) continue;; esac
  [ -f "$run/{RECORD}" ] && echo "{RECORD} $run"
  [ -n "$(find "$run/{FOLDER}" -name {KEY} 2>/dev/null)" ] && echo "{KEY} $run"
done
true
"""
# Program for the host's Python, run as `python - ADDRESS PORT...`. It reports only ports in use; any other
# fault of a port appears in the log of its process.
TRY_PORTS = """
import errno, json, socket, sys
address, taken = sys.argv[1], []
for port in map(int, sys.argv[2:]):
    family, kind, _, _, target = socket.getaddrinfo(address, port, type=socket.SOCK_STREAM)[0]
    with socket.socket(family, kind) as tried:
        tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            tried.bind(target)
            tried.listen()
        except OSError as error:
            taken += [port] if error.errno == errno.EADDRINUSE else []
print(json.dumps({"taken": taken}))
"""
TRY_PORTS_S = 20.0  # wall time for TRY_PORTS, enough to start Python on a small computer


class HostReport(NamedTuple):
    """The facts that a host's probe reports, and measurements of the link to it."""

    facts: dict[str, Any]
    round_trip_s: float
    clock_offset_s: float  # the host's wall clock minus that of this machine, accurate to half the round trip
    remedy: str = "run `zsim push --hosts FILE`"  # how to install the right zsim there


class NetworkPath(NamedTuple):
    source: str
    target: str
    port: int
    measured: dict[str, Any]  # answer of `probe reach`: round_trip_s and bits_per_s, or error


class CheckResult(NamedTuple):
    """Tables of the hosts and the network paths; faults and warnings, one line each."""

    tables: list[FittedTable]
    faults: list[str]
    warnings: list[str]


def check_hosts(inventory_file: InventoryFile, hosts_by_process: dict[str, str] | None) -> CheckResult:
    """Check the certificates and the hosts; with a placement, also the network paths to the world and the routers.

    `hosts_by_process`: host of each process; None: no network paths.
    """

    async def check() -> tuple[list[FittedTable], list[str], list[str]]:
        links = {
            name: HostLink(name, host, inventory_file.folder) for name, host in inventory_file.inventory.hosts.items()
        }
        pythons = {name: inv.python(host) for name, host in inventory_file.inventory.hosts.items()}
        try:
            work = (host_report(link, pythons[name], inventory_file.shell_path) for name, link in links.items())
            results = await asyncio.gather(*work, return_exceptions=True)
            reports = {name: each for name, each in zip(links, results, strict=True) if isinstance(each, HostReport)}
            for result in results:
                if isinstance(result, BaseException) and not isinstance(result, ZsimError):
                    raise result
            faults = [str(result) for result in results if isinstance(result, ZsimError)]
            differences, warnings = compare_reports(reports)
            paths: list[NetworkPath] = []  # measured one after another
            for (target, port), sources in (
                inv.connections(inventory_file, hosts_by_process).items() if hosts_by_process else ()
            ):
                if target in reports:
                    source_links = [links[name] for name in sorted(sources & set(reports))]
                    paths += await network_paths(source_links, links[target], pythons, port)
            blocked, slow = path_faults(paths)
            leftover_lines = await asyncio.gather(*(leftovers(links[name], inventory_file.folder) for name in reports))
            tables = [hosts_table(reports), *([paths_table(paths)] if paths else [])]
            return (
                tables,
                [*faults, *differences, *blocked],
                [*warnings, *slow, *(line for lines in leftover_lines for line in lines)],
            )
        finally:
            for link in links.values():
                await link.close()

    tables, faults, warnings = asyncio.run(check())
    certificate_lines = certificates.certificate_faults(inventory_file, hosts_by_process, datetime.now(UTC))
    exposed = certificates.exposed_keys(inventory_file)
    return CheckResult(tables, [*certificate_lines, *faults], [*warnings, *([exposed] if exposed else [])])


async def host_report(link: HostLink, python: str, hosts: str = "FILE") -> HostReport:
    """Run a probe on a host; raise HostsError if the host has no zsim or cannot be reached.

    `python`: the host's interpreter; `hosts`: path of the inventory, for remedies.
    """
    push = f"run `zsim push --hosts {hosts}`"  # has no effect on a host with a `python` of its own
    remedy = f"install it there, or leave hosts.{link.name}.python out and {push}" if link.host.python else push
    answers: list[tuple[float, float]] = []  # round trip of a line, and clock offset [s]
    try:
        async with _probe(link, python, "about", link.host.folder) as probe:
            facts = await probe.answer(ABOUT_S)
            for _ in range(OFFSET_SAMPLES):
                start_s, sent_s = time.time(), time.monotonic()
                probe.send("\n")
                host_s = (await probe.answer(ABOUT_S))["time_ns"] / 1e9
                took_s = time.monotonic() - sent_s
                answers.append((took_s, host_s - (start_s + took_s / 2)))
    except ProgramEndedError as error:
        raise HostsError(f"{link.name}: {_probe_fault(link, python, remedy, error)}") from error
    return HostReport(facts, *min(answers), remedy)


def _probe_fault(link: HostLink, python: str, remedy: str, error: ProgramEndedError) -> str:
    text, reason = error.last.lower(), error.last or "it printed nothing"
    if NO_MODULE in text:
        return f"{python} has no zsim {__version__}; {remedy}"
    if error.status not in NO_PROGRAM_CODES and not any(sign in text for sign in NO_PROGRAM):
        return f"{python}: the probe ended with code {error.status} ({reason}); is it a Python that has zsim?"
    if link.host.python:
        return f"python {python} is not a program there ({reason}); correct hosts.{link.name}.python, or {remedy}"
    return f"has no zsim in {link.host.folder}; {remedy}"


def _probe(link: HostLink, python: str, *words: str) -> AbstractAsyncContextManager[RemoteProgram]:
    return open_program(link, f"{shell_word(python)} {SAFE_PATH} -m zsim_deploy.hosts.probe {shell_line(words)}")


def compare_reports(reports: dict[str, HostReport]) -> tuple[list[str], list[str]]:
    """Return the faults that keep hosts from flying together, and warnings, one line each."""
    faults, warnings = [], []
    for name, report in reports.items():
        facts = report.facts
        if facts["zsim"] != __version__:
            faults.append(f"{name}: zsim is {facts['zsim']}; must be {__version__} as here; {report.remedy}")
        if reason := facts["unwritable"]:
            remedy = f"correct hosts.{name}.folder, or create the folder there"
            faults.append(f"{name}: its folder cannot be used ({reason}); {remedy}")
        if abs(report.clock_offset_s) > CLOCK_OFFSET_MAX_S + report.round_trip_s:
            warnings.append(f"{name}: its clock is {report.clock_offset_s:+.1f} s off; set it with chrony or ntp")
        if facts["load"] > LOAD_MAX * facts["cores"]:
            load = f"load is {facts['load']:.1f} on {facts['cores']} cores"
            warnings.append(f"{name}: {load}; lockstep runs at the pace of the slowest host")
        if slow := set(facts["governors"]) - PERFORMANCE:
            governors = f"the CPU governor is {', '.join(sorted(slow))}"
            warnings.append(f"{name}: {governors}; the governor performance is steadier (cpupower frequency-set)")
        if facts["free_bytes"] < FREE_MIN_BYTES:
            free = f"{facts['free_bytes'] / 1e9:.1f} GB are free on its disk"
            warnings.append(f"{name}: {free}; a record of an hour takes about 1 GB")
    computing = {name: report for name, report in reports.items() if NEEDED_TO_COMPUTE in report.facts["machine"]}
    return faults, [*warnings, *_different_fingerprints(computing), *_missing_packages(computing)]


def _different_fingerprints(reports: dict[str, HostReport]) -> Iterator[str]:
    """Yield a warning if the fingerprints differ, naming the parts that do."""
    fingerprints = {name: report.facts["fingerprint"] for name, report in reports.items()}
    if len(set(fingerprints.values())) < 2:
        return
    listed = ", ".join(f"{name} {text[:8]}" for name, text in fingerprints.items())
    parts = {name: report.facts["parts"] for name, report in reports.items()}
    names = dict.fromkeys(part for each in parts.values() for part in each)
    differing = [part for part in names if len({each.get(part) for each in parts.values()}) > 1]
    values = {part: [f"{name} {each.get(part, 'none')}" for name, each in parts.items()] for part in differing}
    causes = "; ".join(f"{part}: {', '.join(host_values)}" for part, host_values in values.items())
    yield f"the hosts have different code, so identical results are not guaranteed (fingerprints {listed}); {causes}"


def _missing_packages(reports: dict[str, HostReport]) -> Iterator[str]:
    """Yield a warning for each host without a package that others compute with: it is slower, with the same results."""
    for name, report in reports.items():
        all_parts = {part for each in reports.values() for part in each.facts["machine"]}
        if lacking := " and ".join(sorted(all_parts - set(report.facts["machine"]))):
            yield f"{name}: has no {lacking}, which other hosts compute with; {report.remedy}"


def hosts_table(reports: Mapping[str, HostReport]) -> FittedTable:
    rows = []
    for name, report in reports.items():
        facts, shown_s = report.facts, (f"{1e3 * report.round_trip_s:.1f} ms", f"{1e3 * report.clock_offset_s:+.1f} ms")
        computer = (f"{facts['load']:.2f}", str(facts["cores"]), ", ".join(facts["governors"]) or "-")
        rows.append((name, facts["python"], facts["zsim"], *shown_s, *computer, facts["fingerprint"][:8]))
    return FittedTable(HOST_COLUMNS, rows)


async def network_paths(
    links: Sequence[HostLink], target: HostLink, python: dict[str, str], port: int
) -> list[NetworkPath]:
    """Measure the network paths from hosts to a port of another host; no other program may listen on that port."""

    async def reach(link: HostLink) -> dict[str, Any]:
        try:
            async with _probe(link, python[link.name], "reach", target.host.address, str(port)) as client:
                return await client.answer(REACH_S)
        except HostsError as error:
            return {"error": str(error)}

    try:
        async with _probe(target, python[target.name], "serve", str(port)) as server:
            message = await server.answer(READY_S)
            if "error" in message:
                return [NetworkPath(target.name, target.name, port, message)]
            return [NetworkPath(link.name, target.name, port, await reach(link)) for link in links]
    except HostsError as error:
        return [NetworkPath(target.name, target.name, port, {"error": str(error)})]


def path_faults(paths: Sequence[NetworkPath]) -> tuple[list[str], list[str]]:
    """Return a fault for each blocked path and a warning for each slow one, one line each."""
    faults, slow = [], []
    for path in paths:
        reason, is_taken = path.measured.get("error"), path.measured.get("taken")
        if reason is None:
            if path.measured["bits_per_s"] < BITS_PER_S_MIN:
                bandwidth = f"{path.measured['bits_per_s'] / 1e6:.1f} Mbit/s"
                slow.append(f"{path.source} reaches {path.target} at only {bandwidth}")
        elif is_taken:
            faults.append(port_in_use(path.target, path.port))
        elif is_taken is False:
            fault = f"cannot listen on port {path.port} there ({reason}); give another port in the inventory"
            faults.append(f"{path.target}: {fault}")
        else:
            fault = f"port {path.port} of {path.target} cannot be reached ({reason}); is it open in the firewall?"
            faults.append(f"{path.source}: {fault}")
    return faults, slow


def paths_table(paths: Sequence[NetworkPath]) -> FittedTable:
    rows = []
    for path in paths:
        measured, cells = path.measured, (path.measured.get("error", ""), "-")
        if "error" not in measured:
            cells = (f"{1e3 * measured['round_trip_s']:.2f} ms", f"{measured['bits_per_s'] / 1e6:.0f} Mbit/s")
        rows.append((path.source, path.target, str(path.port), *cells))
    return FittedTable(PATH_COLUMNS, rows)


def runs_folder(host: Host) -> str:
    """Return the folder of runs on a host, absolute or relative to the home folder (~/)."""
    return f"{inv.below_home(host.folder)}/{RUNS}"


async def leftovers(link: HostLink, base: Path) -> list[str]:
    """Return warnings about leftovers of earlier runs on a host: at most one about records and one about private keys.

    A greeting of the login shell is skipped. Raise HostsError if the host cannot be reached.
    """
    name, folder = link.name, runs_folder(link.host)
    script = f"cd {shell_word(folder)} 2>/dev/null || exit 0{LIST_RUNS}"
    output = (await link.run(script, what=f"looking into {folder}")).decode(errors="replace")
    entries = [line.split(" ", 1) for line in output.splitlines()]
    runs = {kind: [entry[1] for entry in entries if entry[0] == kind and len(entry) > 1] for kind in (RECORD, KEY)}
    lines = []
    if records := [f"{folder}/{run}/{RECORD}" for run in runs[RECORD]]:
        lines.append(
            f"{name}: records of earlier runs were not fetched: {', '.join(f'{name}:{path}' for path in records)}; "
            f"fetch with `{scp(link.host, base, records[0])}`, then remove the folder of the run there"
        )
    if keys := [f"{folder}/{run}/{FOLDER}" for run in runs[KEY]]:
        lines.append(
            f"{name}: private keys of earlier runs remain: {', '.join(f'{name}:{path}' for path in keys)}; "
            f"remove them there with `rm -r {shell_line(keys)}`"
        )
    return lines


def scp(host: Host, base: Path, path: str) -> str:
    """Return the scp command that copies a file from a host to here, with the ssh settings of `zsim up`."""
    address = host.ssh or host.address
    host_text = f"[{address}]" if ":" in address else address
    command = ["scp", *(["-P", str(host.port)] if host.port != SSH_PORT else [])]
    command += ["-i", str(base / Path(host.key).expanduser())] if host.key else []
    if host.known_hosts:
        command += ["-o", f"UserKnownHostsFile={base / Path(host.known_hosts).expanduser()}"]
    user = f"{host.user}@" if host.user else ""
    return shlex.join([*command, f"{user}{host_text}:{path.removeprefix('~/')}", "."])


async def port_faults(link: HostLink, python: str, ports: Sequence[int]) -> list[str]:
    """Return a line for each port of a host that is in use; raise HostsError if the host cannot be reached."""
    if not ports:
        return []
    command = f"{shell_word(python)} - {shell_line([link.host.address, *map(str, ports)])}"
    output = await link.run(command, TRY_PORTS.encode(), TRY_PORTS_S, "looking for free ports")
    occupied = (json_answer(output.decode(errors="replace").splitlines()) or {}).get("taken", [])
    return [port_in_use(link.name, port) for port in occupied]


def port_in_use(host: str, port: int) -> str:
    remedy = "end that program (`ss -ltnp` there shows it), or give another port in the inventory"
    return f"{host}: port {port} is in use there, perhaps by another run; {remedy}"
