"""Drones that start anywhere assemble at assigned places, and assemble anew, without coming near each other."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from refused import has_terms

import zsim
from zsim.contract import keys
from zsim.errors import ScenarioError
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Cluster
from zsim.sensors.scanner import Range
from zsim_agents.formation.control_law import Grants
from zsim_agents.hosting import check_plans

PENTAGON = [[4, 0, 0], [1.2, 3.8, 0], [-3.2, 2.4, 0], [-3.2, -2.4, 0], [1.2, -3.8, 0]]
LINE: dict[str, Any] = {
    "name": "line",
    "seed": 1,
    "duration_s": 38,
    "sensors": {"preset": "paper"},
    "drones": [{"name": f"d{k}", "position_m": [0, 9 - 3 * k, 0]} for k in range(1, 6)],
    "clusters": [
        {
            "name": "main",
            "drones": ["d5", "d3", "d1", "d4", "d2"],
            "template_m": PENTAGON,
            "plan": {
                "takeoff_s": 1,
                "assemblies": [
                    {"values": {"x_c": 0, "y_c": 0, "z_c": 3, "yaw": 0}},
                    {"at_s": 22, "values": {"yaw_deg": 180}},
                ],
                "target": {"z_c": 4},
            },
        }
    ],
}


def changed(**plan: Any) -> dict[str, Any]:
    (cluster,) = LINE["clusters"]
    return {**LINE, "clusters": [{**cluster, "plan": {**cluster["plan"], **plan}}]}


def written(document: dict[str, Any], tmp_path: Path) -> Path:
    (tmp_path / "line.yaml").write_text(yaml.safe_dump(document))
    return tmp_path / "line.yaml"


def places(run: Any, at_s: float) -> np.ndarray:
    columns = ["position_m_x", "position_m_y", "position_m_z"]
    return np.array([run.truth(f"d{k}")[columns].to_numpy()[round(at_s * 50)] for k in range(1, 6)])


def test_a_line_becomes_a_pentagon_with_the_same_bits_after_a_kill(tmp_path: Path, forked: None) -> None:
    """The initial line is no formation. When the pentagon makes half a turn, each drone flies to the nearest place.

    Expected: each place of the pentagon is filled within 0.9 m; from 21 s to 32 s each drone moves by
    2 * 4 m * sin(18 deg).
    """
    path = written(LINE, tmp_path)
    alone = zsim.run(path, out=tmp_path / "alone", progress=False)
    assert alone.summary.as_planned
    assert (alone.summary.min_separation_m or 0.0) > 1.9
    for at_s, yaw in ((21.0, 0.0), (32.0, math.pi)):
        where = places(alone, at_s)
        turned = np.array(PENTAGON)[:, :2] @ [[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]]
        away = np.linalg.norm(where[:, None, :2] - turned, axis=2)
        assert sorted(away.argmin(axis=1)) == [*range(5)]
        assert away.min(axis=1).max() < 0.9
    moved = np.linalg.norm((places(alone, 32.0) - places(alone, 21.0))[:, :2], axis=1)
    assert moved == pytest.approx(2 * 4 * math.sin(math.radians(18)), abs=0.9)
    assert (alone.summary.errors["x_c"].true_rms or 9.0) < 0.3  # by robot, whichever drone
    with zsim.Federation(path, duration=26, out=tmp_path / "many") as flight:
        flight.wait_until(23.5)
        flight.kill("controller.main")
        run = flight.run()
    for k in range(1, 6):
        truth = run.truth(f"d{k}")
        assert truth.equals(alone.truth(f"d{k}").iloc[: len(truth)])
    states = run.messages("cluster/main/state")
    orders = [*dict.fromkeys(map(str, states.drones))]
    assert len(orders) == 3


@pytest.mark.soak
@pytest.mark.parametrize("kill_s", [8.0, 23.5, 30.0])
def test_without_snapshots_a_killed_controller_repeats_its_step(kill_s: float, tmp_path: Path, forked: None) -> None:
    path = written({**LINE, "processes": {"snapshot_s": 0}}, tmp_path)
    with zsim.Federation(path, out=tmp_path / "many") as flight:
        flight.wait_until(kill_s)
        flight.kill("controller.main")
        run = flight.run()
    assert run.summary.as_planned, run.summary.shortfalls
    assert (run.summary.min_separation_m or 0.0) > 1.9


def test_a_requested_assembly_is_flown_or_refused(tmp_path: Path) -> None:
    sim = zsim.Simulation(written(changed(assemblies=LINE["clusters"][0]["plan"]["assemblies"][:1]), tmp_path))
    sim.run(until_s=3)
    with pytest.raises(zsim.ZsimError):
        sim.ask("cluster/main/control", "assemble", values={"yaw": 1.0})  # it is taking off
    sim.run(until_s=20)
    before = sim.snapshot()
    with pytest.raises(zsim.ZsimError):
        sim.ask("cluster/main/control", "assemble", values={"z_c": 0.2})
    sim.ask("cluster/main/control", "assemble", values={"x_c": 3.0})
    sim.run(until_s=21)
    with pytest.raises(zsim.ZsimError):
        sim.ask("cluster/main/control", "engage")  # still assembling
    sim.run(until_s=26)
    sim.ask("cluster/main/control", "engage")
    sim.run(until_s=30)
    assert sim.truth.position_m.mean(axis=0)[:2] == pytest.approx([3.0, 0.0], abs=0.4)
    once = sim.truth_sha256
    sim.restore(before)
    sim.ask("cluster/main/control", "assemble", values={"x_c": 3.0})
    sim.run(until_s=26)
    sim.ask("cluster/main/control", "engage")
    sim.run(until_s=30)
    assert sim.truth_sha256 == once


def test_samples_come_in_the_order_of_the_robots() -> None:
    grants = Grants("main", ["a", "b", "c"], ["range"])
    sample = Range(t_ns=0, seq=0, t_sample_ns=0, beams=(), ranges_m=(), max_m=4.0)
    grants.put(keys.sensor("c", "range"), sample)
    assert grants.samples(Cluster, "range", Range) == (None, None, sample)
    grants.reorder(["c", "a", "b"])
    assert grants.samples(Cluster, "range", Range) == (sample, None, None)
    grants.put(keys.sensor("a", "range"), sample)
    assert grants.samples(Cluster, "range", Range) == (sample, sample, None)


@pytest.mark.parametrize(
    ("assemblies", "path"),
    [
        ([], "clusters[0].plan.assemblies"),
        ([{"at_s": -1}], "clusters[0].plan.assemblies[0].at_s"),
        ([{"at_s": 9}, {"at_s": 9}], "clusters[0].plan.assemblies[1].at_s"),
        ([{"values": {"nowhere": 1}}], "clusters[0].plan.assemblies[0].values:"),
        ([{"values": {"z_c": "t"}}], "clusters[0].plan.assemblies[0].values.z_c"),
        ([{"values": {"z_c": "1/"}}], "clusters[0].plan.assemblies[0].values.z_c:"),
        ([{"values": {"z_c": 0.1}}], "clusters[0].plan.assemblies[0]:"),
        ([{"values": {"w_1": -3}}], "clusters[0].plan.assemblies[0]:"),
    ],
)
def test_an_invalid_assembly_is_refused_before_the_flight(assemblies: Any, path: str) -> None:
    with pytest.raises(ScenarioError) as refused:
        check_plans(scenario_file.resolve(changed(assemblies=assemblies)), "line.yaml")
    assert [line.split(" ")[1] for line in refused.value.faults] == [path]


def test_paths_that_come_too_close_are_refused_with_the_distance() -> None:
    """Two drones in a row along x that must form a row along y pass each other at 2.5 m / sqrt(2)."""
    starts, template = [[0, 0, 0], [2.5, 0, 0], [8, 1.25, 0]], [[0, 0, 0], [0, 2.5, 0], [8, 1.25, 0]]
    drones = [{"name": f"e{k}", "position_m": place} for k, place in enumerate(starts)]
    plan = {"takeoff_s": 1, "assemblies": [{"values": {"x_c": 8 / 3, "y_c": 1.25, "z_c": 1.5, "yaw": 0}}]}
    cluster = {"name": "main", "drones": ["e0", "e1", "e2"], "space": "template", "template_m": template, "plan": plan}
    with pytest.raises(ScenarioError) as refused:
        check_plans(scenario_file.resolve({**LINE, "drones": drones, "clusters": [cluster]}), "line.yaml")
    (line,) = refused.value.faults
    assert has_terms(line, "clusters[0].plan.assemblies[0]:", "1.77", "1.8")


def test_an_assembly_of_a_triad_must_give_all_shape_variables(tmp_path: Path) -> None:
    drones = [{"name": f"e{k}", "position_m": [3 * k, 0, 0]} for k in range(3)]
    plan = {"takeoff_s": 1, "assemblies": [{"values": {"p": 4, "q": 4}}]}
    cluster = {"name": "main", "drones": ["e0", "e1", "e2"], "space": "triad", "plan": plan}
    with pytest.raises(ScenarioError) as refused:
        check_plans(scenario_file.resolve({**LINE, "drones": drones, "clusters": [cluster]}), "line.yaml")
    (line,) = refused.value.faults
    assert line.split(" ")[1] == "clusters[0].plan.assemblies[0]:"
    assert "beta" in line
