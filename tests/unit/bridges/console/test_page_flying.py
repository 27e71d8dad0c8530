"""Drones and formations that fly back to where they started: when they land, and what ends a return. The view from above as plain data."""

import json
import math
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from zsim.contract.flight_messages import DroneView, ViewCluster, ViewDrones
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Surface
from zsim.scenario.surroundings import outline_of, packed
from zsim_agents.formation.spaces.scenario_space import cluster_space
from zsim_bridges.console import page_flying
from zsim_bridges.console.histories import CanvasTrails
from zsim_bridges.console.manual_flight import DronePose, DroneSight, FlightAnswer, geofence_of
from zsim_bridges.console.page_flying import ReturnFlights
from zsim_bridges.console.picture import drone_poses

SCENARIO = scenario_file.load(Path(__file__).parents[4] / "scenarios" / "step.yaml")
NAMES = ("x_c", "y_c", "z_c")


class Returns:
    """Returns in a run that only the test performs."""

    def __init__(self) -> None:
        self.said: list[Any] = []
        self.notes: list[tuple[str, str]] = []
        self.requests: Counter[str] = Counter()
        self.answer = FlightAnswer("drone1", "taking")
        self.is_sent = False
        self.sight = DroneSight("flying", "console.1", DronePose((5.0, 5.0, 10.0), 0.0))
        self.view = ViewCluster(0, 0, "engaged", NAMES, (5.0, -5.0, 15.0), (5.0, -5.0, 15.0), "")
        client: Any = SimpleNamespace(
            request_cluster=self._request, cluster_requests=self.requests,
            send_mode=lambda drones, mode: self.said.append((mode, drones)),
        )  # fmt: skip
        control: Any = SimpleNamespace(
            take=lambda page, drone, over: self.answer, steer=lambda page, stick: self.answer,
            leave=lambda page: self.said.append("leave"), go=self._go, is_on_way=lambda page: self.is_sent,
        )  # fmt: skip
        self.flights = ReturnFlights(
            SCENARIO,
            client,
            control,
            lambda _: self.sight,
            lambda: {"main": self.view},
            lambda *n: self.notes.append(n),
        )

    def _request(self, cluster: str, op: str, **args: Any) -> None:
        self.requests[cluster] += 1
        self.said.append((op, args))

    def _go(self, page: Any, x_m: float, y_m: float) -> None:
        self.is_sent = True
        self.said.append(("go", x_m, y_m))

    def tick(self) -> list[Any]:
        self.said.clear()
        self.flights.tick()
        return list(self.said)

    def fly_to(self, x_m: float, y_m: float, desired: tuple[float, float] | None = None) -> None:
        value = (x_m, y_m, 15.0)
        goal = value if desired is None else (*desired, 15.0)
        self.view = ViewCluster(0, 0, "engaged", NAMES, value, goal, "")


@pytest.fixture
def returns() -> Returns:
    return Returns()


def test_a_drone_is_sent_over_its_start_and_lands_there(returns: Returns):
    returns.flights.request_drones(["drone1"])
    assert returns.tick() == []  # it is being taken
    returns.answer = FlightAnswer("drone1", "flying")
    assert returns.tick() == [("go", 0.0, 1.5)]
    assert returns.tick() == []
    returns.sight = DroneSight("flying", "console.1", DronePose((0.2, 1.3, 10.0), 0.0))
    assert returns.tick() == ["leave", ("land", ["drone1"])]
    assert returns.tick() == []
    assert returns.notes == []


def test_a_drone_that_somebody_else_takes_does_not_land(returns: Returns):
    returns.flights.request_drones(["drone1"])
    returns.answer = FlightAnswer("drone1", "none", "drone1 is flown by driver.x now")
    assert returns.tick() == []
    assert [subject for subject, _ in returns.notes] == ["drone1"]
    returns.sight = DroneSight("flying", "driver.x", DronePose((0.0, 1.5, 10.0), 0.0))
    assert returns.tick() == []


def test_a_drone_that_may_not_be_taken_says_why(returns: Returns):
    returns.answer = FlightAnswer("drone1", "none", "drone1 is landed")
    returns.flights.request_drones(["drone1"])
    assert returns.notes == [("drone1", "drone1 is landed")]
    assert returns.tick() == []


def test_a_formation_is_led_over_the_middle_of_its_starts_and_lands_there(returns: Returns):
    returns.flights.request_formation("main")
    assert returns.said == [("target", {"values": {"x_c": 0.0, "y_c": -0.5}})]
    assert returns.tick() == []
    returns.fly_to(0.0, -0.5, desired=(2.0, -2.0))  # it happens to be there, on its way
    assert returns.tick() == []
    returns.fly_to(0.1, -0.4, desired=(0.0, -0.5))
    assert returns.tick() == [("land", {})]
    assert returns.tick() == []


@pytest.mark.parametrize("how", ["request", "elsewhere", "held", "refused"])
def test_a_formation_that_does_not_return_any_more_does_not_land(returns: Returns, how: str):
    returns.flights.request_formation("main")
    returns.fly_to(1.0, -1.0)
    assert returns.tick() == []
    if how == "request":
        returns.requests["main"] += 1
    elif how == "elsewhere":
        returns.fly_to(4.0, -4.0)
    elif how == "held":
        returns.view = ViewCluster(0, 0, "held", NAMES, (0.0, -0.5, 15.0), (0.0, -0.5, 15.0), "")
    else:
        returns.flights.refused("main")
    assert returns.tick() == []
    returns.fly_to(0.0, -0.5)
    assert returns.tick() == []
    assert bool(returns.notes) == (how in ("elsewhere", "held"))


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
    assert around["surfaces"] == []
    corners = np.array([[0, 0, 0, 2, 0, 3, 2, 1, 0], [0, 0, 0, 2, 1, 0, 0, 1, 1], [1, 0.5, 9, 0, 0, 0, 1, 0, 0]], float)
    stone = Surface(name="stone", triangles=packed(corners), position_m=(5, 6, 0), yaw_deg=90)
    outline = [[4.0, 6.0], [5.0, 6.0], [5.0, 8.0], [4.0, 8.0]]
    assert outline_of(stone) == outline


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
