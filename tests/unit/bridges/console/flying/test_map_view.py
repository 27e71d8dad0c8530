"""The view from above as plain data."""

import json
import math
from typing import Any

import numpy as np

from zsim.contract.views import DroneView, ViewCluster, ViewDrones
from zsim.scenario import scenario_file
from zsim_agents.formation.spaces.scenario_space import cluster_space
from zsim_bridges.console import page_flying
from zsim_bridges.console.histories import CanvasTrails
from zsim_bridges.console.manual_flight import geofence_of
from zsim_bridges.console.picture import drone_poses

FIELD = """
name: field
duration_s: 1
drones: [{name: drone1, position_m: [0, 0, 0]}, {name: drone2, position_m: [3, 0, 0]}]
environment:
  obstacles:
    - {name: wall, shape: box, position_m: [5, 1, 0], size_m: [1, 4, 3], yaw_deg: 30}
    - {name: mast, shape: cylinder, position_m: [9, 0, 0], radius_m: 0.2, height_m: 6}
"""
NORTH = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))


def drone(name: str, x: float = 0.0) -> DroneView:
    return DroneView(name, (x, 2.0, 5.0), NORTH, (0.0,) * 4, "flying", 90.0)


def test_what_stands_around_the_drones():
    scenario = scenario_file.from_text(FIELD)
    around = page_flying.surroundings(scenario, geofence_of(scenario))
    assert around["names"] == around["labels"] == ["drone1", "drone2"]
    assert len(set(around["colours"])) == 2
    assert around["fence"] == {"low_m": (-50.0, -50.0, 1.0), "high_m": (53.0, 50.0, 30.0)}
    wall, mast = around["obstacles"]
    assert wall == {"name": "wall", "x_m": 5.0, "y_m": 1.0, "yaw_deg": 30.0, "radius_m": None, "size_m": [1.0, 4.0]}
    assert (mast["x_m"], mast["radius_m"], mast["size_m"]) == (9.0, 0.2, None)


def test_drones_by_place_heading_and_state_and_none_where_one_is_not_seen():
    poses = drone_poses(ViewDrones(0, 0, (drone("drone2", 3.456),), ()), ("drone1", "drone2"))
    nobody, seen = page_flying.positions(poses, {"drone2": "flying"})
    assert nobody is None
    assert seen == [3.46, 2.0, 5.0, 1.571, "flying"]


def test_a_formation_has_its_places_while_it_has_somewhere_to_be():
    space = cluster_space(3)
    p_W = np.array([(0.0, 1.5, 5.0), (-1.5, -1.5, 5.0), (1.5, -1.5, 5.0)])
    c = tuple(space.forward(p_W, np.zeros(3)).tolist())
    views = {phase: ViewCluster(0, 0, phase, space.names, c, c, "") for phase in ("idle", "engaged")}
    shown: list[dict[str, Any]] = page_flying.formations(
        {"idle": space, "engaged": space}, {"idle": [0, 1, 2], "engaged": [0, 1, 2]}, views
    )
    assert [each["phase"] for each in shown] == ["idle", "engaged"]
    assert shown[0]["places"] == []
    assert np.allclose(shown[1]["places"], p_W[:, :2])


def test_trails_are_the_last_stretch_of_each_way():
    names, trails = ("drone1", "drone2"), CanvasTrails(2)
    poses = drone_poses(ViewDrones(0, 0, (drone("drone1"),), ()), names)
    for x in range(4):
        poses = drone_poses(ViewDrones(x * 10**9, 0, (drone("drone1", float(x)),), ()), names)
        trails.add(float(x), poses.p_W)
    way, nothing = page_flying.trail_lines(trails, poses)
    assert way == [[0.0, 2.0, 0.0], [1.0, 2.0, 1.0], [2.0, 2.0, 2.0]]  # and from there to where it is
    assert nothing == []


def test_a_look_at_a_hundred_drones_is_small():
    """Ten looks a second of a page: a few kilobytes each."""
    names = tuple(f"drone{i}" for i in range(1, 101))
    poses = drone_poses(ViewDrones(0, 0, tuple(drone(name, 123.456) for name in names), ()), names)
    assert len(json.dumps(page_flying.positions(poses, dict.fromkeys(names, "flying")))) < 6_000
