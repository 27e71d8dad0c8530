"""Names in narrow tables: their end is kept, since it tells them apart."""

import io

import pytest
from rich.console import Console

from zsim.presentation import FittedTable, shortened
from zsim_deploy.hosts.doctor_tables import hosts_table, paths_table
from zsim_deploy.hosts.host_report import HostReport, NetworkPath
from zsim_deploy.hosts.status_table import table

COLUMNS = 80  # of a terminal, by default
ROLES = [f"estimator.formation-alpha-drone-{i:04}" for i in range(200)]
HOST = "onboard-computer-of-drone-0012"
FIGURES = {"pid": 123456, "lag_ms": 1234.0, "messages_per_s": 12345.0, "round_trip_ms": 123.4, "restarts": 3}
FACTS = {"python": "3.11.2", "zsim": "0.1.0", "fingerprint": "0123456789", "cores": 128, "load": 100.1, "governors": []}


def lines(shown: FittedTable) -> list[str]:
    console = Console(file=io.StringIO(), width=COLUMNS)
    console.print(shown)
    return console.file.getvalue().splitlines()  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("name", "width", "text"),
    [("estimator.drone2", 16, "estimator.drone2"), ("estimator.drone2", 7, "…drone2"), ("d1", 1, "…")],
)
def test_the_beginning_of_a_name_is_left_out(name: str, width: int, text: str) -> None:
    assert shortened(name, width) == text


def test_processes_are_told_apart_in_a_terminal_of_80_columns() -> None:
    rows = [{"role": role, "host": HOST, "state": "host silent 12 s", **FIGURES} for role in ROLES]
    shown = lines(table(rows))[-len(ROLES) :]
    ends = [line.split()[0].removeprefix("…") for line in shown]
    assert len(set(ends)) == len(ROLES)
    assert all(role.endswith(end) for role, end in zip(ROLES, ends, strict=True))
    assert all(HOST[-4:] in line and "host silent 12 s" in line and "1234 ms" in line for line in shown)


def test_a_table_with_room_shows_whole_names() -> None:
    *_, row = lines(table([{"role": "estimator.drone2", "host": "lab-pc", "state": "running", **FIGURES}]))
    assert row.split()[:2] == ["estimator.drone2", "lab-pc"]


def test_hosts_are_told_apart_in_a_terminal_of_80_columns() -> None:
    hosts = [f"onboard-computer-of-drone-{i:04}" for i in range(3)]
    checked = lines(hosts_table({name: HostReport(FACTS, 0.001, 0.0) for name in hosts}))
    paths = lines(paths_table([NetworkPath(name, HOST, 7447, {"error": "no route " * 9}) for name in hosts]))
    for shown in (checked, paths):
        assert all(any(line.split() and line.split()[0].endswith(name[-6:]) for line in shown) for name in hosts)
