"""Sensors of a user's own, out of examples/, however a scenario is flown: a line of the scenario, and a module."""

import csv
import shutil

import numpy as np
import pytest
from federation import PAIR, Federation, Record
from forked_commands import ROOT, refusal, run_here

from zsim.record import RecordReader

EXAMPLES = str(ROOT / "examples")
SENSORS = (
    "sensors.my_uwb={module: uwb_range, anchor_m: [0, 0, 2], range_m: {noise: 0.05}}",
    "sensors.pitot={module: airspeed, latency_ms: 30, mount: {position_m: [0.15, 0, 0]}}",
)
DURATION_S = 4.0
KEYS = ("drone/drone1/sensor/my_uwb", "drone/drone2/sensor/my_uwb", "drone/drone1/sensor/pitot")


def options(*fields: str) -> list[str]:
    return ["--duration", str(DURATION_S), *(word for field in (*SENSORS, *fields) for word in ("--set", field))]


@pytest.fixture
def examples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let modules of examples/ be found, here and in what is started from here."""
    monkeypatch.setenv("PYTHONPATH", EXAMPLES)
    monkeypatch.syspath_prepend(EXAMPLES)


def check_ranges(record: Record) -> None:
    """Hold the ranges on record against the truth."""
    truths = {truth["t_ns"]: truth["position_m"] for truth in record.all("drone/drone1/truth")}
    ranges = [m for m in record.all(KEYS[0]) if m["t_sample_ns"] in truths]
    off = [m["range_m"] - np.linalg.norm(np.subtract(truths[m["t_sample_ns"]], (0, 0, 2))) for m in ranges]
    assert len(off) >= 10 * DURATION_S
    assert 0.03 < np.std(off) < 0.08


def same_samples(first: Record, second: Record) -> bool:
    return all(first.all(key) and first.all(key) == second.all(key) for key in KEYS)


@pytest.mark.soak
def test_processes_give_the_samples_of_one_process(federation: Federation) -> None:
    """With modules beside the scenario; exported and flown again where only Python's path has them, or none."""
    for name in ("uwb_range.py", "airspeed.py"):
        shutil.copy(ROOT / "examples" / name, federation.folder)
    federation.run(PAIR, *options()).ends(with_code=0)
    record = federation.record()
    check_ranges(record)
    one = federation.folder / "one"
    path = federation.write(PAIR)
    federation.start("run", path, *options(), "--in-process", "--no-report", "--out", str(one)).ends(with_code=0)
    with RecordReader(one / "run.mcap") as reader:
        assert same_samples(record, Record(reader))
        assert Record(reader).sha256() == record.sha256()
    tables = federation.folder / "tables"
    federation.start("export", str(one), "--format", "csv", "--out", str(tables)).ends(with_code=0)
    with (tables / "sensor_my_uwb.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == sum(len(record.all(key)) for key in KEYS if key.endswith("my_uwb"))
    assert float(rows[0]["range_m"]) > 0


RANGED = """
from my_estimator import MyEstimator


class Ranged(MyEstimator):
    def __init__(self, *settings):
        super().__init__(*settings)
        self._used["my_uwb"] = 0

    def _on_my_uwb(self, m):
        self._p[2] += 1e-3 * (m.range_m - 2.0)
"""


def test_an_estimator_of_the_user_s_own_receives_it(federation: Federation) -> None:
    for name in ("uwb_range.py", "airspeed.py", "my_estimator.py"):
        shutil.copy(ROOT / "examples" / name, federation.folder)
    (federation.folder / "ranged.py").write_text(RANGED)
    chosen = options("estimation.algorithm=ranged:Ranged")
    federation.run(PAIR, *chosen).ends(with_code=0)
    record, one = federation.record(), federation.folder / "one"
    estimates = record.all("drone/drone1/estimate")
    assert estimates[-1]["sensors"]["my_uwb"][0] >= 10 * DURATION_S - 2  # Hz; the last ones are on their way
    path = federation.write(PAIR)
    federation.start("run", path, *chosen, "--in-process", "--no-report", "--out", str(one)).ends(with_code=0)
    with RecordReader(one / "run.mcap") as reader:
        alone = Record(reader)
        assert [e["position_m"] for e in alone.all("drone/drone1/estimate")] == [e["position_m"] for e in estimates]
        assert alone.sha256() == record.sha256()


@pytest.mark.usefixtures("examples")
def test_a_record_is_flown_again(federation: Federation) -> None:
    out = federation.folder / "one"
    path = federation.write(PAIR)
    flown = run_here("run", path, *options(), "--in-process", "--no-report", "--out", str(out))
    assert flown.code == 0, flown
    again = run_here("rerun", str(out), "--trust")
    assert again.code == 0, again


@pytest.mark.parametrize(
    ("field", "where"),
    [
        ("sensors.my_uwb.module=nowhere.at_all", "sensors.my_uwb.module"),
        ("sensors.my_uwb.rate_hz=5000", "sensors.my_uwb.rate_hz"),
    ],
)
@pytest.mark.usefixtures("examples")
def test_a_faulty_one_is_a_line(federation: Federation, field: str, where: str) -> None:
    line = refusal("validate", "--trust", federation.write(PAIR, "pair.yaml"), *options(field)[2:])
    assert f"pair.yaml: {where} is" in line
