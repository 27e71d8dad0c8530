"""Drones cross a forest by lidar: none touches a trunk, and the bits are the same however the drones are flown."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import zsim
from zsim.errors import ScenarioError
from zsim.scenario import scenario_file
from zsim.scenario.surroundings import nearest, row_of
from zsim.vehicles.ardrone2 import VEHICLE
from zsim_agents.hosting import hosted
from zsim_world.run.world import World

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(autouse=True)
def module(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(EXAMPLES))


def test_five_drones_fly_among_the_trunks_and_touch_none(tmp_path: Path, compiled: None) -> None:
    """Each hull keeps clear of every trunk and of every other hull; all drones get well into the forest."""
    run = zsim.run(EXAMPLES / "forest.yaml", duration_s=18, out=tmp_path / "run", progress=False)
    rows = [row_of(each) for each in scenario_file.load(EXAMPLES / "forest.yaml").environment.obstacles]
    hull_m = VEHICLE.airframe.hull_radius_m
    tracks = []
    for drone in run.drones:
        truth = run.truth(drone)
        track = truth[["position_m_x", "position_m_y", "position_m_z"]].to_numpy()
        assert track[-1, 0] > 5.0
        least = min(nearest(row, *place)[0] for place in track[::10].tolist() for row in rows)
        assert hull_m < run.summary.obstacle_distance_m[drone] <= least
        tracks.append(track)
    for i, track in enumerate(tracks):
        for other in tracks[:i]:
            assert np.linalg.norm(track - other, axis=1).min() > 2.0 * hull_m
    assert run.events[run.events.kind == "collision"].empty


def test_processes_give_the_same_bits_even_after_a_pilot_is_killed(tmp_path: Path, forked: None) -> None:
    document = yaml.safe_load((EXAMPLES / "forest.yaml").read_text())
    (tmp_path / "forest.yaml").write_text(yaml.safe_dump({**document, "drones": document["drones"][:3]}))
    alone = zsim.run(tmp_path / "forest.yaml", duration_s=7, out=tmp_path / "alone", progress=False)
    with zsim.Federation(tmp_path / "forest.yaml", duration=7, out=tmp_path / "many") as flight:
        flight.wait_until(5.5)
        flight.kill("pilot.drone3")
        run = flight.run()
    assert run.truth_sha256 == alone.truth_sha256
    assert "pilot.drone3" in [*run.events[run.events.kind == "restart"].subject]
    scans = [(each.messages("drone/drone3/sensor/lidar")).ranges_m.tolist() for each in (alone, run)]
    assert len(scans[0]) == 71
    assert scans[0] == scans[1]


MAPPERS = """
import zsim


class Mapper(zsim.Agent):
    def __init__(self, info, scenario):
        super().__init__()
        self.seen = len(scenario.environment.obstacles), "tree1" in info.scenario

    def receive(self, key, message): ...

    def step(self, t_ns):
        return []
"""


@pytest.mark.parametrize(("given", "seen"), [({}, (3, True)), ({"map": True}, (3, True)), ({"map": False}, (0, False))])
def test_an_agent_has_the_map_unless_the_scenario_withholds_it(
    given: dict[str, bool], seen: tuple[int, bool], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mappers.py").write_text(MAPPERS)
    monkeypatch.syspath_prepend(str(tmp_path))
    document = {
        "name": "map",
        "duration_s": 1,
        "environment": {"forest": {"trees": 3, "area_m": [5, 5, 15, 15]}},
        "drones": [{"name": "d1", "position_m": [0, 0, 0]}],
        "agents": {"mapper": {"class": "mappers:Mapper", **given}},
    }
    scenario = scenario_file.resolve(document)
    agent: Any = hosted(World(scenario).info(), scenario, ["mapper.d1"])
    assert agent.seen == seen


def test_a_map_grant_that_is_not_a_boolean_is_refused() -> None:
    with pytest.raises(ScenarioError) as refused:
        scenario_file.load(EXAMPLES / "forest.yaml", ["agents.pilot.map=maybe"])
    assert [line.split(" ")[1] for line in refused.value.faults] == ["agents.pilot.map"]
