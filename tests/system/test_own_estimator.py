"""An estimator of the user's own in the place of the stock one: one line of the scenario, and a file beside it."""

import shutil
from pathlib import Path

import pytest
from federation import PAIR, Federation, Record
from forked_commands import ROOT

import zsim
from zsim.record import RecordReader
from zsim_api.pytest_plugin import Federations

MINE = "my_estimator:MyEstimator"


@pytest.fixture
def beside(federation: Federation) -> Path:
    """The example beside the scenario's file."""
    return Path(shutil.copy(ROOT / "examples/my_estimator.py", federation.folder))


def test_it_flies_in_processes_of_its_own_as_in_one(flights: Federations, federation: Federation, beside: Path) -> None:
    flown = {"scenario": federation.write(PAIR), "set": {"estimation.algorithm": MINE}}
    flight = flights(**flown)
    run = flight.run()
    estimates = run.estimate("drone1")
    assert len(estimates) > 500
    assert set(estimates["source"]) == {"estimator.drone1"}
    assert run.estimate_errors("drone1").filter(like="position_m").iloc[-1].abs().max() < 3.0
    with RecordReader(run.record) as reader:
        assert Record(reader).all("drone/drone1/estimate")[-1]["sensors"]["gps"][0] > 50
    flight.assert_same_bits(zsim.run(**flown, out=federation.folder / "one", progress=False))


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
