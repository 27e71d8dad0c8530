"""User parts from examples/ in runs of every kind: estimator, sensors, vehicle, cluster space and control law."""

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from deployment import STEP, in_process
from federation import PAIR, Federation, Record
from forked_commands import ROOT, refusal, run_here

import zsim
from zsim.record import RecordReader
from zsim.vehicles.vehicle import vehicle_of
from zsim_api.pytest_plugin import Federations

EXAMPLES = str(ROOT / "examples")
MINE = "my_estimator:MyEstimator"
SPACE = "clusters.main.space=leader_cluster:LeaderCluster"
LAW = "clusters.main.law=potential_field:PotentialField"
FLIGHT = ("clusters.main.plan.takeoff_s=1", "drones.drone1.battery_percent=90")
FORMED_S = 10.0  # the formation engages at 6 s
SENSORS = (
    "sensors.my_uwb={module: uwb_range, anchor_m: [0, 0, 2], range_m: {noise: 0.05}}",
    "sensors.pitot={module: airspeed, latency_ms: 30, mount: {position_m: [0.15, 0, 0]}}",
)
SENSED_S = 4.0
KEYS = ("drone/drone1/sensor/my_uwb", "drone/drone2/sensor/my_uwb", "drone/drone1/sensor/pitot")


@pytest.fixture
def examples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put examples/ on the module path of this process and its children."""
    monkeypatch.setenv("PYTHONPATH", EXAMPLES)
    monkeypatch.syspath_prepend(EXAMPLES)


# Estimator


@pytest.fixture
def beside(federation: Federation) -> Path:
    """The example estimator, copied next to the scenario."""
    return Path(shutil.copy(ROOT / "examples/my_estimator.py", federation.folder))


def test_a_user_estimator_gives_the_same_bits_in_several_processes(
    flights: Federations, federation: Federation, beside: Path
) -> None:
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
def test_a_bad_estimator_name_is_reported(federation: Federation, beside: Path, name: str, wrong: str) -> None:
    path = federation.write(PAIR, "pair.yaml")
    for command in (("validate", "--trust"), ("run",)):
        line = refusal(*command, path, "--set", f"estimation.algorithm={name}")
        assert "pair.yaml: estimation.algorithm" in line
        assert wrong in line


# Sensors


def of_sensors(*fields: str) -> list[str]:
    return ["--duration", str(SENSED_S), *(word for field in (*SENSORS, *fields) for word in ("--set", field))]


def check_ranges(record: Record) -> None:
    """Check the recorded ranges against the truth."""
    truths = {truth["t_ns"]: truth["position_m"] for truth in record.all("drone/drone1/truth")}
    ranges = [m for m in record.all(KEYS[0]) if m["t_sample_ns"] in truths]
    off = [m["range_m"] - np.linalg.norm(np.subtract(truths[m["t_sample_ns"]], (0, 0, 2))) for m in ranges]
    assert len(off) >= 10 * SENSED_S
    assert 0.03 < np.std(off) < 0.08


def same_samples(first: Record, second: Record) -> bool:
    return all(first.all(key) and first.all(key) == second.all(key) for key in KEYS)


@pytest.mark.soak
def test_user_sensors_give_the_same_samples_in_several_processes(federation: Federation) -> None:
    """The modules are next to the scenario, and the record can be exported without them."""
    for name in ("uwb_range.py", "airspeed.py"):
        shutil.copy(ROOT / "examples" / name, federation.folder)
    federation.run(PAIR, *of_sensors()).ends(with_code=0)
    record = federation.record()
    check_ranges(record)
    one = federation.folder / "one"
    path = federation.write(PAIR)
    federation.start("run", path, *of_sensors(), "--in-process", "--no-report", "--out", str(one)).ends(with_code=0)
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


def test_a_user_estimator_receives_a_user_sensor(federation: Federation) -> None:
    for name in ("uwb_range.py", "airspeed.py", "my_estimator.py"):
        shutil.copy(ROOT / "examples" / name, federation.folder)
    (federation.folder / "ranged.py").write_text(RANGED)
    chosen = of_sensors("estimation.algorithm=ranged:Ranged")
    federation.run(PAIR, *chosen).ends(with_code=0)
    record, one = federation.record(), federation.folder / "one"
    estimates = record.all("drone/drone1/estimate")
    assert estimates[-1]["sensors"]["my_uwb"][0] >= 10 * SENSED_S - 2  # 10 Hz, less those in transit
    path = federation.write(PAIR)
    federation.start("run", path, *chosen, "--in-process", "--no-report", "--out", str(one)).ends(with_code=0)
    with RecordReader(one / "run.mcap") as reader:
        alone = Record(reader)
        assert [e["position_m"] for e in alone.all("drone/drone1/estimate")] == [e["position_m"] for e in estimates]
        assert alone.sha256() == record.sha256()


@pytest.mark.usefixtures("examples")
def test_a_run_with_user_sensors_can_be_rerun(federation: Federation) -> None:
    out = federation.folder / "one"
    path = federation.write(PAIR)
    flown = run_here("run", path, *of_sensors(), "--in-process", "--no-report", "--out", str(out))
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
def test_a_faulty_user_sensor_is_reported(federation: Federation, field: str, where: str) -> None:
    line = refusal("validate", "--trust", federation.write(PAIR, "pair.yaml"), *of_sensors(field)[2:])
    assert f"pair.yaml: {where} is" in line


# Vehicle


@pytest.mark.usefixtures("examples")
def test_a_sweep_compares_vehicles(tmp_path: Path, near: None) -> None:
    path, out = tmp_path / "pair.yaml", tmp_path / "sweep"
    path.write_text(PAIR)
    vary = ("--vary", "drones.drone1.model=ardrone2,crazyflie2,larger_battery", "--workers", "1", "--no-report")
    done = run_here("sweep", str(path), *vary, "--duration", "4", "--out", str(out))
    assert done.code == 0, done
    rows = pq.read_table(out / "sweep.parquet").to_pylist()
    assert [row["failure"] for row in rows] == [None] * 3
    assert len({row["truth_sha256"] for row in rows}) == 3


@pytest.mark.soak
def test_crazyflies_fly_test_1_at_room_scale(federation: Federation) -> None:
    """In the window of the report, the triangle's errors are as small as a positioning accuracy of 10 cm allows."""
    path = str(ROOT / "scenarios/crazyflie.yaml")
    out = federation.folder / "crazyflie"
    federation.start("run", path, "--in-process", "--out", str(out)).ends(with_code=0)
    errors = json.loads((out / "summary.json").read_text())["errors"]
    for name, limit in {"x_c": 0.06, "y_c": 0.06, "z_c": 0.03, "p": 0.15, "q": 0.15, "beta": 0.1}.items():  # m, rad
        assert errors[name]["true_rms"] < limit, name


@pytest.mark.usefixtures("examples")
@pytest.mark.parametrize(("model", "rotor"), [("larger_battery", "rotor7"), ("hexacopter", "front_left")])
def test_a_fault_of_a_missing_rotor_is_reported(federation: Federation, model: str, rotor: str) -> None:
    fault = f"faults=[{{kind: rotor_stuck, target: drone1, at_s: 1, rotor: {rotor}}}]"
    chosen = ("--set", f"drones.drone1.model={model}", "--set", fault)
    line = refusal("validate", "--trust", federation.write(PAIR), *chosen)
    for part in ("faults[0].rotor", repr(rotor), *vehicle_of(model).rotor_names):
        assert part in line


# Cluster space and control law


def of_formation(*fields: str) -> list[str]:
    settings = [word for field in (*FLIGHT, *fields) for word in ("--set", field)]
    return ["--duration", str(FORMED_S), *settings]


def truth_near(record: Any, drone: str, t_ns: int) -> np.ndarray:
    return np.array(next(t["position_m"] for t in record.all(f"drone/{drone}/truth") if t["t_ns"] >= t_ns))


def test_a_user_space_and_law_give_the_same_bits_in_several_processes(
    federation: Federation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The modules are next to the scenario or imported; the leader space puts its origin at drone1."""
    for name in ("leader_cluster.py", "potential_field.py"):
        (federation.folder / name).write_text((ROOT / "examples" / name).read_text())
    federation.run(STEP.read_text(), *of_formation(SPACE, LAW)).ends(with_code=0)
    record = federation.record()
    state = record.all("cluster/main/state")[-1]
    assert state["phase"] == "engaged"
    assert np.abs(np.array(state["value"][:3]) - truth_near(record, "drone1", state["t_ns"])).max() < 1.0
    monkeypatch.syspath_prepend(EXAMPLES)
    assert record.sha256() == in_process(tmp_path, FORMED_S, [*FLIGHT, SPACE, LAW])


@pytest.mark.parametrize(("field", "how"), [("space", ["--in-process"]), ("law", [])])
def test_a_missing_space_or_law_class_is_reported(federation: Federation, field: str, how: list[str]) -> None:
    run = federation.run(STEP.read_text(), *how, *of_formation(f"clusters.main.{field}=nowhere.at_all:Missing"))
    run.ends(with_code=2)
    assert "cluster 'main'" in run.line("nowhere.at_all:Missing").text
    assert "Traceback" not in run.text()


DYING = """
import os

import numpy as np
from zsim_agents.formation.control_law import ControlLaw


class Dies(ControlLaw):
    calls = 0

    def rates(self, c, p_W, v_W, c_des, c_dot_des):
        self.calls += 1
        if self.calls > 100:
            os._exit(0) if DIES_WELL else os.kill(os.getpid(), 9)
        return np.zeros(self.space.size)
"""
DIES = "clusters.main.law=dying:Dies"


@pytest.mark.parametrize(("dies_well", "code"), [(False, -9), (True, 0)])
def test_a_law_that_ends_its_process_leaves_a_record_without_an_end(
    federation: Federation, dies_well: bool, code: int
) -> None:
    """In one process nothing can catch this; the record up to that moment is readable."""
    (federation.folder / "dying.py").write_text(DYING.replace("DIES_WELL", str(dies_well)))
    federation.run(PAIR, "--in-process", "--set", DIES).ends(with_code=code)
    record = federation.record()
    assert record.events("end") == []
    assert record.all("drone/drone1/truth")[-1]["t_ns"] > 2e9


def test_a_law_that_exits_with_0_counts_as_a_death(federation: Federation) -> None:
    (federation.folder / "dying.py").write_text(DYING.replace("DIES_WELL", "True"))
    run = federation.run(PAIR, "--set", DIES, "--set", "processes.on_death={controller: end}")
    run.ends(with_code=1)
    assert "controller.main" in run.text().splitlines()[-1]
