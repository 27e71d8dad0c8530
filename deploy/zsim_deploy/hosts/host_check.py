"""All hosts of an inventory checked at once: the report of each, how each reaches the others, as tables."""

import asyncio
import shlex
from datetime import UTC, datetime
from typing import Any, NamedTuple

from rich.table import Table
from rich.text import Text

from zsim.errors import ZsimError
from zsim_deploy.hosts import doctor
from zsim_deploy.hosts.host_link import HostLink
from zsim_deploy.hosts.leftover_runs import leftovers
from zsim_deploy.inventory import enrolment
from zsim_deploy.inventory import inventory as inv
from zsim_deploy.inventory.inventory import InventoryFile


class CheckResult(NamedTuple):
    """What was found."""

    tables: list[Table]
    faults: list[str]
    warnings: list[str]


def check_hosts(placed: InventoryFile, places: dict[str, str] | None) -> CheckResult:
    """Check certificates and hosts; with a placement also the paths to where the world and the routers listen."""
    result = asyncio.run(_check_up(placed, places))
    lacks = enrolment.certificate_faults(placed, places, datetime.now(UTC))
    warning = enrolment.exposed_keys(placed)
    return result._replace(
        faults=[*lacks, *result.faults], warnings=[*result.warnings, *([warning] if warning else [])]
    )


async def _check_up(placed: InventoryFile, places: dict[str, str] | None) -> CheckResult:
    links = {name: HostLink(name, host, placed.folder) for name, host in placed.inventory.hosts.items()}
    pythons = {name: inv.python(host) for name, host in placed.inventory.hosts.items()}
    hosts = shlex.quote(str(placed.folder / placed.source))
    try:
        results = await asyncio.gather(
            *(doctor.host_report(link, pythons[name], hosts) for name, link in links.items()), return_exceptions=True
        )
        reports: dict[str, doctor.HostReport] = {}
        faults: list[str] = []
        for name, result in zip(links, results, strict=True):
            if isinstance(result, doctor.HostReport):
                reports[name] = result
            elif isinstance(result, ZsimError):
                faults.append(str(result))
            else:
                raise result
        wrong, warnings = doctor.compare_reports(reports)
        paths = await _paths(placed, places, links, pythons, set(reports)) if places else []
        cut, slow = doctor.path_faults(paths)
        left = await asyncio.gather(*(leftovers(links[name], placed.folder) for name in reports))
        tables = [_hosts_table(reports), *([_paths_table(paths)] if paths else [])]
        return CheckResult(
            tables, [*faults, *wrong, *cut], [*warnings, *slow, *(line for lines in left for line in lines)]
        )
    finally:
        for link in links.values():
            await link.close()


async def _paths(
    placed: InventoryFile, places: dict[str, str], links: dict[str, HostLink], pythons: dict[str, str], there: set[str]
) -> list[doctor.NetworkPath]:
    """Return how the hosts reach what their roles and routers connect to, one path after the other."""
    paths: list[doctor.NetworkPath] = []
    for (target, port), sources in inv.connections(placed, places).items():
        if target in there:
            chosen = [links[name] for name in sorted(sources & there)]
            paths += await doctor.network_paths(chosen, links[target], pythons, port)
    return paths


def _hosts_table(reports: dict[str, doctor.HostReport]) -> Table:
    shown = Table("host", "python", "zsim", "round trip", "clock", "load", "cores", "governor", "fingerprint", box=None)
    for name, report in reports.items():
        facts = report.facts
        cells = (
            name,
            facts["python"],
            facts["zsim"],
            f"{1e3 * report.round_trip_s:.1f} ms",
            f"{1e3 * report.clock_offset_s:+.1f} ms",
            f"{facts['load']:.2f}",
            str(facts["cores"]),
            ", ".join(facts["governors"]) or "-",
            facts["fingerprint"][:8],
        )
        shown.add_row(*map(Text, cells))  # a host's answer may have brackets
    return shown


def _paths_table(paths: list[doctor.NetworkPath]) -> Table:
    shown = Table("from", "to", "port", "round trip", "bandwidth", box=None)
    for path in paths:
        shown.add_row(*map(Text, (path.source, path.target, str(path.port), *_path_figures(path.figures))))
    return shown


def _path_figures(figures: dict[str, Any]) -> tuple[str, str]:
    if "error" in figures:
        return figures["error"], "-"
    return f"{1e3 * figures['round_trip_s']:.2f} ms", f"{figures['bits_per_s'] / 1e6:.0f} Mbit/s"
