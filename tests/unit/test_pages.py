"""Words of our own are defined on the pages, and in what a run prints, where they are first read."""

import re
from pathlib import Path

import pytest

from zsim_deploy.cli import run_commands

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("page", ["README.md", "docs/walkthrough.md"])
def test_a_gate_is_defined_where_it_is_first_read(page: str) -> None:
    first = re.search(r"\*?\bgates?\b\*?", (ROOT / page).read_text())
    assert first is not None
    assert first[0] == "*gate*"


def test_a_run_that_counts_gates_says_what_one_is(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_commands._fault_of(True, "complete: 10 gates", []) == ""
    assert "gate: a time step" in capsys.readouterr().out
