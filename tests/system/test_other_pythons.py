"""Test 1 of the paper on another processor, on another version of Python, and on two processors at once."""

from contextlib import ExitStack
from pathlib import Path

import golden_flights
import other_pythons
import pytest
import yaml
from federation import COMPILES_S, Federation, Record
from other_pythons import AARCH64, NEWEST, Kind, LackingError, OtherPython

from zsim.record import RecordReader
from zsim.scenario import scenario_file
from zsim_analysis.in_process import fly

STEP = golden_flights.scenarios()["step"]
EMULATED_S = 7200.0  # wall time for an emulator to compile everything and complete a run
FORMED_S = 22.0  # simulated; the formation takes off at 1 s and keeps its shape from 18 s

pytestmark = pytest.mark.soak


def made(kind: Kind) -> OtherPython:
    try:
        return other_pythons.other_python(kind)
    except LackingError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("kind", [NEWEST, AARCH64], ids=["python3.14", "aarch64"])
def test_another_python_reproduces_the_golden_hash(kind: Kind, tmp_path: Path) -> None:
    with made(kind).start([golden_flights.__file__, "step"], tmp_path / "output") as process:
        try:
            code = process.wait(EMULATED_S)
        finally:
            process.kill()
    said = (tmp_path / "output").read_text()
    assert code == 0, said
    golden = yaml.safe_load(golden_flights.GOLDEN.read_text())
    assert yaml.safe_load(said) == {"step": golden["step"]}


def test_an_estimator_on_another_processor_changes_no_bit(federation: Federation, tmp_path: Path) -> None:
    """The world, controller and two estimators run on x86-64, the third estimator on aarch64, over Zenoh."""
    fields = ["processes.start_timeout_s=3600", "clusters.main.plan.takeoff_s=1"]
    options = [word for field in fields for word in ("--set", field)]
    fly(scenario_file.load(STEP, fields, duration_s=FORMED_S), tmp_path / "alone.mcap")
    text = STEP.read_text()
    with ExitStack() as stack:
        other = made(AARCH64).start(
            ["-m", "zsim_deploy", "estimator", "drone3", "--connect", federation.endpoint], tmp_path / "other"
        )
        stack.callback(other.wait)
        stack.callback(other.kill)
        world = federation.world(text, "--duration", str(FORMED_S), "--expect", "recorder", *options)
        for role in (
            ("record", "--out", str(federation.out)),
            ("controller", "main"),
            ("estimator", "drone1", "drone2"),
        ):
            federation.role(*role)
        try:
            world.ends(with_code=0, within_s=EMULATED_S)
        except BaseException:
            print((tmp_path / "other").read_text())
            raise
        assert other.wait(COMPILES_S) == 0, (tmp_path / "other").read_text()
    with RecordReader(tmp_path / "alone.mcap") as reader:
        one, several = Record(reader), federation.record()
        for key in ("drone/drone3/estimate", "cluster/main/state", "drone/drone3/cmd/velocity"):
            sent = [[{**message, "source": ""} for message in each.all(key)] for each in (one, several)]
            assert sent[0] == sent[1] != [], key
        assert several.sha256() == one.sha256()
