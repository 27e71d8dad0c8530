"""Terms of our own are defined where they first appear, on the pages and in the output of a run."""

import re
from pathlib import Path

import pytest

from zsim_deploy.cli import run_commands

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("page", ["README.md", "docs/walkthrough.md"])
def test_the_term_gate_is_defined_at_its_first_occurrence(page: str) -> None:
    first = re.search(r"\*?\bgates?\b\*?", (ROOT / page).read_text())
    assert first is not None
    assert first[0] == "*gate*"


def test_a_run_that_counts_gates_explains_the_term(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_commands._fault_of(True, "complete: 10 gates", []) == ""
    assert "gate: a time step" in capsys.readouterr().out
