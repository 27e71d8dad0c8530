"""Vehicles by their model: a user's own out of examples/, and the Crazyflie, however a scenario is flown."""

import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from federation import PAIR, Federation
from forked_commands import ROOT, run_here

from zsim.vehicles.vehicle import vehicle_of

EXAMPLES = str(ROOT / "examples")


@pytest.fixture
def examples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let modules of examples/ be found, here and in what is started from here."""
    monkeypatch.setenv("PYTHONPATH", EXAMPLES)
    monkeypatch.syspath_prepend(EXAMPLES)


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
def test_crazyflies_fly_test_1_at_the_size_of_a_room(federation: Federation) -> None:
    """In the window of its report the triangle stands where it is to, as well as its positioning of 10 cm allows."""
    path = str(ROOT / "scenarios/crazyflie.yaml")
    out = federation.folder / "crazyflie"
    federation.start("run", path, "--in-process", "--out", str(out)).ends(with_code=0)
    errors = json.loads((out / "summary.json").read_text())["errors"]
    for name, limit in {"x_c": 0.06, "y_c": 0.06, "z_c": 0.03, "p": 0.15, "q": 0.15, "beta": 0.1}.items():  # m, rad
        assert errors[name]["true_rms"] < limit, name


@pytest.mark.usefixtures("examples")
@pytest.mark.parametrize(("model", "rotor"), [("larger_battery", "rotor7"), ("hexacopter", "front_left")])
def test_a_fault_of_a_rotor_that_is_not_there_is_one_line(federation: Federation, model: str, rotor: str) -> None:
    fault = f"faults=[{{kind: rotor_stuck, target: drone1, at_s: 1, rotor: {rotor}}}]"
    role = federation.start(
        "validate", "--trust", federation.write(PAIR), "--set", f"drones.drone1.model={model}", "--set", fault
    )
    role.ends(with_code=2)
    (line,) = [line.text for line in role.lines if line.text.strip()]
    for part in ("faults[0].rotor", repr(rotor), *vehicle_of(model).rotor_names):
        assert part in line
