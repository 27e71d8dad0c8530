"""pytest accepts the commands of the Makefile."""

import shlex
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MARKED = "tests/system/test_sweep.py"  # contains a group, soak tests and others


@pytest.mark.parametrize("target", ["test", pytest.param("soak", marks=pytest.mark.soak)])
def test_make_targets_find_their_tests(target: str) -> None:
    printed = subprocess.run(
        ["make", "-n", "--no-print-directory", target], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    command = [*shlex.split(printed.splitlines()[-1]), "--collect-only", "-q", "-n", "0", MARKED]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert found.returncode == 0, found.stdout[-2000:]
    assert f"{MARKED}::" in found.stdout
