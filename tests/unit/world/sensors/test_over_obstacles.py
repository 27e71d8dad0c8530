"""Sonar and flow above a table: distances to its top, and the velocity where an edge is between the two."""

from typing import Any

import numpy as np
import pytest

from zsim.scenario.scenario_file import resolve
from zsim.scenario.surface_file import packed
from zsim_world.fleet.fleet import Fleet
from zsim_world.physics.fleet_arrays import STATE
from zsim_world.sensors.sampler import WHOSE
from zsim_world.sensors.sensor_set import FLOW, SONAR

EXACT = {"noise": 0.0}
TABLE = {"name": "table", "shape": "box", "position_m": [0, 0, 0], "size_m": [2, 2, 1]}
BALL = {"name": "ball", "shape": "sphere", "position_m": [5, 0, 1], "radius_m": 0.5}
HEIGHT_M, SPEED_M_S = 2.5, 1.0


def samples(sensor: int, x_m: float, obstacles: Any = (TABLE, BALL), surfaces: Any = (), **sensors: Any) -> np.ndarray:
    """Return what a sensor says of a drone that is level 2.5 m over x_m and moves east, without noise."""
    sections = {"sonar": {"range_m": EXACT}, "flow": {"velocity_m_s": EXACT}}
    document: dict[str, Any] = {
        "name": "over",
        "duration_s": 1,
        "environment": {"obstacles": [*obstacles], "surfaces": [*surfaces]},
        "sensors": {name: {**each, **sensors.get(name, {})} for name, each in sections.items()},
        "drones": [{"name": "d1", "position_m": [20, 0, 0]}],
    }
    fleet = Fleet(resolve(document))
    fleet.bodies.state[0, STATE.p_WB : STATE.p_WB + 3] = x_m, 0.0, HEIGHT_M
    fleet.bodies.state[0, STATE.v_WB] = SPEED_M_S
    fleet.bodies.state[0, STATE.size :] = 0.0
    found: list[np.ndarray] = []
    while not found:
        fleet.advance()
        found = [*fleet.sampled.values[fleet.sampled.whose[:, WHOSE.sensor] == sensor]]
    return found[0]


@pytest.mark.parametrize(
    ("x_m", "top_m"),
    [(0.0, 1.0), (0.9, 1.0), (1.1, 0.0), (5.0, 1.5), (-5.0, 0.0)],
    ids=["middle", "inside", "beside", "ball", "far"],
)
def test_a_sonar_measures_to_what_is_below(x_m: float, top_m: float):
    """Within 3 cm: it falls and moves for at most 40 ms until the sample, 8 mm and 4 cm."""
    distance, valid = samples(SONAR, x_m)[:2]
    assert distance == pytest.approx(HEIGHT_M - top_m, abs=0.03)
    assert valid == 1.0


def test_a_sonar_hears_a_table_that_is_nearer_than_its_range_though_the_ground_is_not():
    low = samples(SONAR, 0.0, sonar={"max_m": 2.0})[:2]
    assert low[0] == pytest.approx(1.5, abs=0.03)
    assert low[1] == 1.0
    assert samples(SONAR, 3.0, sonar={"max_m": 2.0})[1] == 0.0


def test_over_the_bare_ground_the_bits_are_those_without_obstacles():
    for sensor in (SONAR, FLOW):
        np.testing.assert_array_equal(samples(sensor, 3.0), samples(sensor, 3.0, obstacles=[]))


@pytest.mark.parametrize(
    ("camera_m", "sonar_m", "ratio"),
    [(0.0, 0.0, 1.0), (0.0, 1.3, 2.5 / 1.5), (1.3, 0.0, 1.5 / 2.5)],
    ids=["both over the table", "sonar beside it", "camera beside it"],
)
def test_flow_is_right_where_both_see_one_surface(camera_m: float, sonar_m: float, ratio: float):
    mounts = {"flow": {"mount": {"position_m": [camera_m, 0, 0]}}, "sonar": {"mount": {"position_m": [sonar_m, 0, 0]}}}
    ahead = samples(FLOW, 0.0, **mounts)[0]
    level = samples(FLOW, 0.0, obstacles=[], **mounts)[0]
    assert ahead / level == pytest.approx(ratio, rel=0.01)


def test_a_sonar_measures_to_a_surface_too():
    plane = packed(np.array([[-9.0, -9.0, 1.2, 9.0, -9.0, 1.2, 0.0, 9.0, 1.2]]))
    surface = {"name": "deck", "triangles": plane}
    assert samples(SONAR, 3.0, surfaces=[surface])[0] == pytest.approx(HEIGHT_M - 1.2, abs=0.03)
