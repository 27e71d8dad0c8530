"""Drones track references of their own: how closely, with the same bits however they are run, and on request."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import zsim
from zsim.errors import RequestRefusedError
from zsim_analysis.rerun import rerun_record

EXAMPLES = Path(__file__).parents[2] / "examples"
AXES = ["position_m_x", "position_m_y", "position_m_z"]
SHORT = """
name: short
duration_s: 12
drones:
  - name: d1
    model: crazyflie2
    position_m: [0, 0, 0]
    reference:
      {takeoff_s: 0.2, start_s: 6, lead_s: 0.55, land_s: 11,
       minimum_snap: [{at_s: 0, position_m: [0.5, 0, 0.7]}, {at_s: 2, position_m: [1, 0.5, 0.7]}, {at_s: 4, position_m: [1, 1, 1]}]}
  - {name: d2, model: crazyflie2, position_m: [3, 0, 0], reference: {takeoff_s: 0.2}}
"""


def off(run: zsim.Run, drone: str, phase: str = "path") -> np.ndarray:
    """Return the distances between truth and reference [m] while the reference is in a phase."""
    reference, truth = run.messages(f"drone/{drone}/reference"), run.truth(drone)
    at = reference.index[reference.phase == phase]
    return np.linalg.norm(truth.loc[at, AXES].to_numpy() - reference.loc[at, AXES].to_numpy(), axis=1)


def test_six_drones_fly_the_public_swap(tmp_path: Path) -> None:
    """Each drone keeps to its reference, no two come near each other, and each lands where another started."""
    run = zsim.run(EXAMPLES / "swap.yaml", out=tmp_path / "run", progress=False)
    assert run.as_planned, run.shortfalls
    errors = [off(run, drone) for drone in run.drones]
    tracking = [run.summary.tracking[drone].path_rms_m for drone in run.drones]
    assert tracking == pytest.approx([float(np.sqrt(np.mean(each**2))) for each in errors])
    assert all(each is not None and each < 0.12 for each in tracking)
    truth = [run.truth(drone)[AXES].to_numpy() for drone in run.drones]
    apart = [np.linalg.norm(a - b, axis=1).min() for i, a in enumerate(truth) for b in truth[:i]]
    assert min(apart) > 0.2  # two clearances; the references come within 0.305 m
    for drone, other in zip(truth, reversed(truth), strict=True):
        assert np.linalg.norm((drone[-1] - other[0])[:2]) < 0.3


def test_processes_with_killed_pilots_and_a_rerun_give_the_same_bits(tmp_path: Path, forked: None) -> None:
    """One drone follows its path, the other one a mission requested in flight; both pilots are killed."""
    (tmp_path / "short.yaml").write_text(SHORT)
    places, how = [[3, 1, 1], [4, 1, 1.2]], {"speed_m_s": 0.6, "radius_m": 0.3, "yaw_deg": 90}
    with zsim.Federation(tmp_path / "short.yaml", out=tmp_path / "many") as flight:
        flight.wait_until(6.0)
        asked = flight.ask("drone/d2/control", "goto", places_m=places, **how)
        flight.wait_until(7.0)
        flight.kill("reference.d1")
        flight.kill("reference.d2")
        run = flight.run()
    assert off(run, "d1").max() < 0.3
    assert {"reference.d1", "reference.d2"} <= {*run.events[run.events.kind == "restart"].subject}
    alone = zsim.Simulation(tmp_path / "short.yaml")
    alone.run(until_s=asked["from_s"])
    assert alone.drone("d2").goto(places, **how) == asked["until_s"] < 12
    alone.run()
    assert run.truth_sha256 == alone.truth_sha256
    assert alone.truth.position_m[1] == pytest.approx(places[-1], abs=0.15)
    truth = run.truth("d2")
    way = truth.loc[asked["from_s"] :, AXES].to_numpy()
    assert np.linalg.norm(way - places[0], axis=1).min() < 0.45  # the radius plus tracking error
    assert np.hypot(truth.velocity_m_s_x, truth.velocity_m_s_y).max() < 0.75
    said: list[str] = []
    assert rerun_record(tmp_path / "many", False, said.append, said.append) == ""


def test_a_drone_flies_as_requested_and_so_does_its_rerun(tmp_path: Path) -> None:
    (tmp_path / "short.yaml").write_text(SHORT)
    with zsim.Simulation(tmp_path / "short.yaml", duration_s=30, record=tmp_path / "run") as sim:
        with pytest.raises(RequestRefusedError):
            sim.drone("d2").goto((3, 2, 1))  # it has not taken off
        sim.run(until_s=5)
        d2 = sim.drone("d2")
        until_s = d2.goto((3, 2, 1), yaw_deg=90)
        sim.run(until_s=until_s - 1)
        before = sim.snapshot()
        sim.run(until_s=until_s + 2)
        assert sim.truth.position_m[1] == pytest.approx([3, 2, 1], abs=0.25)
        assert sim.estimates.yaw_rad[1] == pytest.approx(np.pi / 2, abs=0.15)
        d2.follow(circle={"radius_m": 0.5, "period_s": 6}, origin_m=(3, 2, 1))
        sim.run(until_s=until_s + 4)
        d2.hold()
        sim.run(until_s=until_s + 7)
        assert np.linalg.norm(sim.truth.velocity_m_s[1]) < 0.15
        d2.land()
        sim.run(until_s=29.9)
        assert sim.state("d2") == "landed"
        assert before is not None
    said: list[str] = []
    assert rerun_record(tmp_path / "run", False, said.append, said.append) == ""


def test_a_sweep_shows_that_a_slower_path_is_tracked_better(near: None, tmp_path: Path) -> None:
    (tmp_path / "short.yaml").write_text(SHORT)
    path = "drones.d1.reference.time_scale"
    options: dict[str, Any] = {"workers": 1, "progress": False, "set": {"drones.d1.reference.land_s": 17}}
    frame = zsim.sweep(tmp_path / "short.yaml", {path: [1, 2.5]}, duration_s=18, **options)
    fast, slow = frame["tracking.d1.path_rms_m"]
    assert 0.0 < slow < fast < 0.2


@pytest.mark.soak
def test_a_hosted_run_gives_the_same_bits(federation: Any, tmp_path: Path, compiled: None) -> None:
    (tmp_path / "short.yaml").write_text(SHORT)
    alone = zsim.run(tmp_path / "short.yaml", out=tmp_path / "alone", progress=False)
    federation.run(SHORT, "--hosted").ends(with_code=0)
    assert federation.record().sha256() == alone.truth_sha256


def test_resuming_from_a_snapshot_gives_the_same_bits(tmp_path: Path) -> None:
    (tmp_path / "short.yaml").write_text(SHORT)
    sim = zsim.Simulation(tmp_path / "short.yaml")
    sim.run(until_s=5)
    sim.drone("d2").goto((3, 1, 1))
    sim.run(until_s=6)
    before = sim.snapshot()
    sim.run(until_s=9)
    once = sim.truth_sha256
    sim.restore(before)
    sim.run(until_s=9)
    assert sim.truth_sha256 == once


@pytest.mark.parametrize("op", ["goto", "follow"])
def test_requests_to_a_drone_without_a_pilot_are_refused(op: str, tmp_path: Path) -> None:
    arguments: dict[str, Any] = {
        "goto": {"position_m": (0, 0, 1)},
        "follow": {"circle": {"radius_m": 1, "period_s": 9}},
    }[op]
    scenario = {"name": "one", "duration_s": 1, "drones": [{"name": "d1", "position_m": [0, 0, 0]}]}
    drone = zsim.Simulation(scenario).drone("d1")
    with pytest.raises(RequestRefusedError):
        getattr(drone, op)(**arguments)
