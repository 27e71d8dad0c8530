"""What hosts say is shown as it is in the tables of `zsim doctor`."""

import io

import pytest
from refused import has_terms
from rich.console import Console

from zsim_deploy.hosts.doctor_tables import hosts_table, paths_table
from zsim_deploy.hosts.host_report import HostReport, NetworkPath

SAID = {"python": "3.11.2", "zsim": "1", "fingerprint": "abc", "cores": 2, "load": 0.1, "governors": ["[/x]"]}


@pytest.mark.parametrize(
    ("table", "terms"),
    [
        (paths_table([NetworkPath("h2", "h1", 7447, {"error": "cannot open [/tmp/x]"})]), ("open [/tmp/x]",)),
        (hosts_table({"h1": HostReport(SAID, 0.001, 0.0)}), ("[/x]",)),
    ],
)
def test_brackets_are_no_markup(table, terms):
    console = Console(file=io.StringIO(), width=200)
    console.print(table)
    assert has_terms(console.file.getvalue(), *terms)  # type: ignore[attr-defined]
