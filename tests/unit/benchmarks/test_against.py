"""Comparison with another commit: its checkout, its environment, and the ratios to this one."""

import subprocess
import sys
from pathlib import Path

import pytest
from refused import refused

from benchmarks import against, table
from benchmarks.child import RefusedError
from benchmarks.run import spent
from benchmarks.sheet import Sheet

IMPORTS = "import numpy, zsim, zsim_agents; print(zsim.__file__, zsim_agents.__file__, numpy.__file__)"
GIT = ["git", "-C", str(against.ROOT)]
needs_git = pytest.mark.skipif(
    subprocess.run([*GIT, "rev-parse", "HEAD"], capture_output=True).returncode != 0, reason="no checkout of git"
)


def sheet() -> Sheet:
    made = Sheet("c-against", "", notes={"here": "b of 2026-02-02", "against": "a of 2026-01-01"})
    flown = {"here": ((60.0, 2.0, 300.0), (80.0, 1.0, 300.0)), "there": ((40.0, 4.0, 200.0), (40.0, 4.0, 200.0))}
    for side, flights in flown.items():
        for figures in flights:
            for key, value in zip(against.QUANTITIES, figures, strict=True):
                made.add(f"{side}.in_process.{key}", 3, value)
    return made


def rows(text: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()]


def test_a_ratio_above_one_means_that_this_tree_is_better() -> None:
    _, _, factor, cpu, peak = rows(against.page(sheet()))
    assert factor[1:] == ["70 (60 to 80)", "40 (40 to 40)", "1.75 (1.5 to 2)"]
    assert cpu[1:] == ["1.5 (1 to 2)", "4 (4 to 4)", "3 (2 to 4)"]
    assert peak[1:] == ["300 (300 to 300)", "200 (200 to 200)", "0.667 (0.667 to 0.667)"]


def test_a_revision_that_fails_has_a_row_with_the_reason() -> None:
    made = sheet()
    for key in against.QUANTITIES:
        del made.values[f"there.in_process.{key}"]
    made.refuse("there.in_process", 3, "exit code 2", [])
    assert {row[2] for row in rows(against.page(made))[2:]} == {"exit code 2"}
    assert "| x |" in table.replaced(table.PAGE.read_text(), "c-against", "| x |")  # the page has a section for it


@needs_git
def test_a_revision_is_checked_out_with_the_packages_of_this_one(tmp_path: Path) -> None:
    with against.checked_out("HEAD", tmp_path) as side:
        told = subprocess.run(
            [str(side.python), "-c", IMPORTS], cwd=tmp_path, capture_output=True, text=True, check=True
        )
        ours, agents, shared = map(Path, told.stdout.split())
        assert ours.is_relative_to(side.root)
        assert agents.is_relative_to(side.root)
        assert not shared.is_relative_to(tmp_path)
    assert not side.root.exists()
    assert str(side.root) not in subprocess.run([*GIT, "worktree", "list"], capture_output=True, text=True).stdout


@needs_git
def test_a_revision_unknown_to_git_is_refused(tmp_path: Path) -> None:
    with refused(RefusedError, "git", "no-such-revision"), against.checked_out("no-such-revision", tmp_path):
        pass


def test_cpu_time_includes_children_and_a_failed_process_is_refused() -> None:
    burns = "import time\nwhile time.process_time() < 0.2: pass"
    parent = f"import subprocess, sys\nsubprocess.run([sys.executable, '-c', {burns!r}])\n{burns}"
    assert 0.4 <= spent([sys.executable, "-c", parent], against.ROOT).cpu_s < 4.0
    with refused(RefusedError, "3", "no wind"):
        spent([sys.executable, "-c", "import sys; print('no wind'); sys.exit(3)"], against.ROOT)
