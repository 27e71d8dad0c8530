"""What `zsim doctor` shows of the hosts and of the network between them."""

from collections.abc import Mapping, Sequence
from typing import Any

from zsim.presentation import Column, FittedTable
from zsim_deploy.hosts.host_report import HostReport, NetworkPath

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


def hosts_table(reports: Mapping[str, HostReport]) -> FittedTable:
    """Return what each host has and how it answers."""
    return FittedTable(HOST_COLUMNS, [_host_cells(name, report) for name, report in reports.items()])


def _host_cells(name: str, report: HostReport) -> tuple[str, ...]:
    facts = report.facts
    return (
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


def paths_table(paths: Sequence[NetworkPath]) -> FittedTable:
    """Return how hosts reach the ports that they will connect to."""
    rows = [(path.source, path.target, str(path.port), *_path_cells(path.figures)) for path in paths]
    return FittedTable(PATH_COLUMNS, rows)


def _path_cells(figures: Mapping[str, Any]) -> tuple[str, str]:
    if "error" in figures:
        return figures["error"], "-"
    return f"{1e3 * figures['round_trip_s']:.2f} ms", f"{figures['bits_per_s'] / 1e6:.0f} Mbit/s"
