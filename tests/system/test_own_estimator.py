"""An estimator of the user's own in the place of the stock one: one line of the scenario, and a file beside it."""

import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from federation import PAIR, Federation, Record
from forked_commands import ROOT

from zsim.record import RecordReader

MINE = "my_estimator:MyEstimator"
CHOSEN = ("--set", f"estimation.algorithm={MINE}")


@pytest.fixture
def beside(federation: Federation) -> Path:
    """The example beside the scenario's file."""
    return Path(shutil.copy(ROOT / "examples/my_estimator.py", federation.folder))


def test_it_flies_in_processes_of_its_own_as_in_one(federation: Federation, beside: Path) -> None:
    federation.run(PAIR, *CHOSEN).ends(with_code=0)
    record = federation.record()
    estimates = record.all("drone/drone1/estimate")
    assert len(estimates) > 500
    assert all(estimate["source"] == "estimator.drone1" for estimate in estimates)
    assert estimates[-1]["sensors"]["gps"][0] > 50
    off = np.subtract(estimates[-1]["position_m"], record.all("drone/drone1/truth")[-1]["position_m"])
    assert math.hypot(*off) < 3.0
    options = (*CHOSEN, "--in-process", "--no-report", "--out", str(federation.folder / "one"))
    federation.start("run", federation.write(PAIR), *options).ends(with_code=0)
    with RecordReader(federation.folder / "one" / "run.mcap") as reader:
        assert Record(reader).sha256() == record.sha256()


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("nowhere:MyEstimator", "ModuleNotFoundError"),
        ("my_estimator:Other", "MyEstimator"),
        ("my_estimator:StateEstimate", "receive"),
        ("kalman", "package.module:Class"),
    ],
)
def test_a_wrong_name_is_a_line(federation: Federation, beside: Path, name: str, wrong: str) -> None:
    path = federation.write(PAIR, "pair.yaml")
    for command in (("validate", "--trust"), ("run",)):
        role = federation.start(*command, path, "--set", f"estimation.algorithm={name}")
        role.ends(with_code=2)
        (line,) = [line.text for line in role.lines if line.text.strip()]
        assert "pair.yaml: estimation.algorithm" in line
        assert wrong in line
