"""Ideal measurements of each sensor with lever arms and turned mounts; sonar and flow over a table or a drone."""

import math
from typing import Any

import numpy as np
import pytest

from zsim.math.frames import quaternion_from_rpy
from zsim.math.rotation import add, rotate, z_axis
from zsim.scenario.scenario_file import resolve
from zsim.scenario.surroundings import packed
from zsim_world.fleet.fleet import Fleet
from zsim_world.physics.fleet_arrays import STATE, VEHICLE
from zsim_world.physics.rays import cast_hull
from zsim_world.sensors.sampler import WHOSE
from zsim_world.sensors.sensor_set import (
    FLOW,
    SONAR,
    SONAR_COSINE_MIN,
    BodyTruth,
    MountedSensor,
    Site,
    baro,
    flow,
    gps,
    imu,
    mag,
    pressure,
    rounded,
    sonar,
)

NOWHERE, STILL = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
STRAIGHT = (1.0, 0.0, 0.0, 0.0)
SITE = Site(9.8, (0.0, 20.0, -10.0))


def body(p=NOWHERE, v=STILL, q=STRAIGHT, w=STILL, a=STILL, alpha=STILL):
    """Return the truth of a drone, with whole numbers as floats, which compiled code requires."""
    vectors: Any = [tuple(map(float, each)) for each in (p, v, q, w, a, alpha)]
    return BodyTruth(*vectors)


def mounted(p=NOWHERE, q=STRAIGHT, range_max=6.0):
    return MountedSensor((float(p[0]), float(p[1]), float(p[2])), q, range_max)


def turn(roll=0.0, pitch=0.0, yaw=0.0):
    return tuple(quaternion_from_rpy((roll, pitch, yaw)).tolist())


LEFT = turn(yaw=math.pi / 2)
SINE, COSINE = 9.8 * math.sin(0.1), 9.8 * math.cos(0.1)
# name: (sensor, truth, mount, values calculated by hand)
CASES: dict[str, tuple[Any, BodyTruth, MountedSensor, Any]] = {
    "at rest, gravity is felt upwards": (imu, body(), mounted((0.1, 0.2, 0.3)), ((0, 0, 9.8), STILL)),
    # packet of a real landed drone: theta +2.97 deg, accel x +80 mg
    "nose up: specific force along the nose": (imu, body(q=turn(pitch=-0.1)), mounted(), ((SINE, 0, COSINE), STILL)),
    "spinning at 3 rad/s about z, faster by 2 rad/s^2, 0.1 m ahead": (
        imu, body(a=(0, 0, -9.8), w=(0, 0, 3), alpha=(0, 0, 2)), mounted((0.1, 0, 0)), ((-0.9, 0.2, 0), (0, 0, 3)),
    ),
    "a board turned a quarter to the left: ahead is to its right": (
        imu, body(a=(1, 0, -9.8), w=(0.5, 0, 0)), mounted(q=LEFT), ((0, -1, 0), (0, -0.5, 0)),
    ),
    "an antenna off the centre": (
        gps, body((1, 2, 3), (1, 0, 0), LEFT, (0, 0, 2)), mounted((0.1, 0, 0.05)), ((1.0, 2.1, 3.05), (0.8, 0, 0)),
    ),
    "the field turns against the body": (mag, body(q=LEFT), mounted(), ((20, 0, -10), STILL)),
    "and against the mount": (mag, body(q=LEFT), mounted(q=LEFT), ((0, -20, -10), STILL)),
    "the barometer's height is that of its mount": (
        baro, body((0, 0, 5), q=turn(pitch=-math.pi / 2)), mounted((0.2, 0, 0)), ((5.2, 0, 0), STILL),
    ),
    "a beam from its mount": (sonar, body((0, 0, 2)), mounted((0, 0, -0.05)), ((1.95, 1, 0), STILL)),
    "a slanted beam": (sonar, body((0, 0, 2), q=turn(0.3)), mounted(), ((2 / math.cos(0.3), 1, 0), STILL)),
    "an upright beam of a slanted body": (
        sonar, body((0, 0, 2), q=turn(0.3)), mounted(q=turn(-0.3)), ((2.0, 1, 0), STILL),
    ),
    "no echo from afar": (sonar, body((0, 0, 6.1)), mounted(), ((6.0, 0, 0), STILL)),
    "no echo from aside": (sonar, body((0, 0, 1), q=turn(1.2)), mounted(), ((6.0, 0, 0), STILL)),
    "no echo from above": (sonar, body((0, 0, 1), q=turn(3.0)), mounted(), ((6.0, 0, 0), STILL)),
    "flow is in the heading frame": (
        flow, body(v=(1, 2, 0.5), q=turn(0.2, -0.1, math.pi / 2)), mounted(),
        ((2.0, -1.0, 0.5), (math.cos(0.2) * math.cos(0.1), 0, 0)),
    ),
    "flow of a turning sensor": (flow, body(q=LEFT, w=(0, 0, 2)), mounted((0.1, 0, 0)), ((0, 0.2, 0), (1, 0, 0))),
    "upside down flow sees nothing": (flow, body(q=turn(roll=3.0)), mounted(), (STILL, STILL)),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_a_sensor_measures_what_its_mount_is_exposed_to(name: str):
    sensor, truth, mount, expected = CASES[name]
    np.testing.assert_allclose(sensor(truth, mount, SITE), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("altitude", "pascals"),
    # ISO 2533, table of the standard atmosphere (geopotential heights)
    [(0, 101325.0), (1000, 89874.6), (2000, 79495.2), (5000, 54019.9), (11000, 22632.0)],
)
def test_pressure_follows_the_standard_atmosphere(altitude, pascals):
    assert pressure(altitude) == pytest.approx(pascals, rel=2e-4)


def test_pressure_is_finite_at_any_height():
    pressures = [pressure(z) for z in (-1e6, -1e4, 2e4, 44_330.0, 44_331.0, 1e6, 1e9)]
    assert all(map(math.isfinite, pressures))
    assert pressures == sorted(pressures, reverse=True)


@pytest.mark.parametrize(
    ("value", "bias", "white", "quantum", "shown"),
    [
        (1.26, 0.0, 0.0, 0.5, 1.5),
        (-1.26, 0.0, 0.0, 0.5, -1.5),
        (1.24, 0.0, 0.0, 0.5, 1.0),
        (1.26, 0.0, 0.0, 0.0, 1.26),
        (1.0, 0.2, 0.1, 0.5, 1.5),
    ],
)
def test_a_reading_is_rounded_to_the_quantum_after_bias_and_noise(value, bias, white, quantum, shown):
    assert rounded(value, bias, white, quantum) == shown


EXACT = {"noise": 0.0}
TABLE = {"name": "table", "shape": "box", "position_m": [0, 0, 0], "size_m": [2, 2, 1]}
BALL = {"name": "ball", "shape": "sphere", "position_m": [5, 0, 1], "radius_m": 0.5}
HEIGHT_M, SPEED_M_S = 2.5, 1.0


def samples(sensor: int, x_m: float, obstacles: Any = (TABLE, BALL), surfaces: Any = (), **sensors: Any) -> np.ndarray:
    """Return a noise-free sample of a level drone 2.5 m above the ground at x_m that moves east."""
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
def test_a_sonar_measures_the_distance_to_the_surface_below(x_m: float, top_m: float):
    """Within 3 cm: until the sample, at most 40 ms later, the drone falls 8 mm and moves 4 cm."""
    distance, valid = samples(SONAR, x_m)[:2]
    assert distance == pytest.approx(HEIGHT_M - top_m, abs=0.03)
    assert valid == 1.0


def test_a_sonar_detects_a_table_in_range_above_ground_out_of_range():
    low = samples(SONAR, 0.0, sonar={"max_m": 2.0})[:2]
    assert low[0] == pytest.approx(1.5, abs=0.03)
    assert low[1] == 1.0
    assert samples(SONAR, 3.0, sonar={"max_m": 2.0})[1] == 0.0


def test_obstacles_elsewhere_do_not_change_the_bits_over_bare_ground():
    for sensor in (SONAR, FLOW):
        np.testing.assert_array_equal(samples(sensor, 3.0), samples(sensor, 3.0, obstacles=[]))


@pytest.mark.parametrize(
    ("camera_m", "sonar_m", "ratio"),
    [(0.0, 0.0, 1.0), (0.0, 1.3, 2.5 / 1.5), (1.3, 0.0, 1.5 / 2.5)],
    ids=["both over the table", "sonar beside it", "camera beside it"],
)
def test_flow_is_right_where_camera_and_sonar_see_the_same_surface(camera_m: float, sonar_m: float, ratio: float):
    mounts = {"flow": {"mount": {"position_m": [camera_m, 0, 0]}}, "sonar": {"mount": {"position_m": [sonar_m, 0, 0]}}}
    ahead = samples(FLOW, 0.0, **mounts)[0]
    level = samples(FLOW, 0.0, obstacles=[], **mounts)[0]
    assert ahead / level == pytest.approx(ratio, rel=0.01)


def test_a_sonar_detects_a_surface():
    plane = packed(np.array([[-9.0, -9.0, 1.2, 9.0, -9.0, 1.2, 0.0, 9.0, 1.2]]))
    surface = {"name": "deck", "triangles": plane}
    assert samples(SONAR, 3.0, surfaces=[surface])[0] == pytest.approx(HEIGHT_M - 1.2, abs=0.03)


def hull(fleet: Fleet, i: int, o: Any, d: Any) -> float:
    """Return the distance at which a ray meets a drone other than i."""
    state, radius = fleet.bodies.state, fleet.bodies.vehicle[0, VEHICLE.hull_radius]
    others = (row for j, row in enumerate(state.tolist()) if j != i)
    poses = ((row[STATE.p_WB : STATE.p_WB + 3], row[STATE.q_WB : STATE.q_WB + 4]) for row in others)
    return min(float(cast_hull(tuple(p), tuple(q), radius, o, d, np.inf)) for p, q in poses)


BELOW = {"sonar": {"range_m": EXACT}, "flow": {"velocity_m_s": EXACT}}


def over_a_drone(
    sensor: int, height_m: float, aside_m: float = 0.0, speed_m_s: float = 0.0, yaw_deg: float = 0.0, **more: Any
) -> np.ndarray:
    """Return a sample of a level drone that moves east at 1 m/s, 4 m above the ground, near another that moves east.

    Args:
        height_m: height of the other drone, which moves at `speed_m_s` and is `aside_m` further north.
        yaw_deg: heading of the first drone.
    """
    document: dict[str, Any] = {
        "name": "below",
        "duration_s": 1,
        "sensors": BELOW,
        "drones": [{"name": f"d{i}", "position_m": [9 * i, 0, 0], "yaw_deg": yaw_deg * (1 - i)} for i in range(2)],
    } | more
    fleet, state = Fleet(resolve(document)), STATE.p_WB
    for i, (y_m, z_m, v_m_s) in enumerate([(0.0, 4.0, SPEED_M_S), (aside_m, height_m, speed_m_s)]):
        fleet.bodies.state[i, state : state + 3] = 0.0, y_m, z_m
        fleet.bodies.state[i, STATE.v_WB] = v_m_s
        fleet.bodies.state[i, STATE.size :] = 0.0
    found: list[np.ndarray] = []
    while not found:
        fleet.advance()
        mine = (fleet.sampled.whose[:, WHOSE.sensor] == sensor) & (fleet.sampled.whose[:, WHOSE.drone] == 0)
        found = [*fleet.sampled.values[mine]]
    return found[0]


@pytest.mark.parametrize(
    ("height_m", "aside_m", "range_m"),
    [(2.0, 0.0, 2.0 - 0.065), (2.0, 0.24, 2.0 - 0.025), (2.0, 0.28, 4.0), (5.0, 0.0, 4.0)],
    ids=["middle", "near its edge", "beside", "above"],
)
def test_a_sonar_detects_the_hull_of_a_drone_below(height_m: float, aside_m: float, range_m: float):
    """A hull has a radius of 0.26 m and a quarter of that as half height; both drones fall alike."""
    assert over_a_drone(SONAR, height_m, aside_m)[0] == pytest.approx(range_m, abs=0.01)


def test_flow_is_relative_to_a_hull_filling_the_picture_or_to_the_ground():
    """At 0.6 m a hull covers most of the picture, at 1.2 m a quarter; the sonar measures to the hull in both cases."""
    alone = over_a_drone(FLOW, 4.0, aside_m=3.0)[0]
    assert over_a_drone(FLOW, 3.4, speed_m_s=0.25)[0] == pytest.approx(alone - 0.25, abs=0.01)
    north = over_a_drone(FLOW, 3.4, speed_m_s=0.25, yaw_deg=90.0)
    assert north[1] == pytest.approx(-(alone - 0.25), abs=0.01)  # east is to the right of a drone that faces north
    share = (1.2 - 0.065) / 3.975  # they fall for 70 ms
    assert over_a_drone(FLOW, 2.8, speed_m_s=0.25)[0] == pytest.approx(alone * share, abs=0.01)


def test_every_drone_that_has_another_in_its_beam_is_flagged():
    """30 drones in a cube of 5 m, tilted by up to 60 deg, move by less than triggers a new search for neighbours."""
    rng, names = np.random.default_rng(1), [f"d{i}" for i in range(30)]
    mount = {"mount": {"position_m": [0.3, 0, -0.1]}}
    document: dict[str, Any] = {
        "name": "cube",
        "duration_s": 1,
        "sensors": {"sonar": BELOW["sonar"] | mount, "flow": BELOW["flow"] | mount},
        "drones": [{"name": name, "position_m": [9 * i, 0, 0]} for i, name in enumerate(names)],
    }
    fleet, met, noted = Fleet(resolve(document)), 0, 0
    near, state = fleet.bodies.near, fleet.bodies.state
    for _ in range(40):
        state[:, STATE.p_WB : STATE.p_WB + 3] = rng.uniform(1.0, 6.0, (30, 3))
        fleet.restored()
        fleet.advance()
        turns = rng.uniform(-1.0, 1.0, (30, 3)) * [60.0, 60.0, 180.0]
        state[:, STATE.q_WB : STATE.q_WB + 4] = [quaternion_from_rpy(np.radians(turn)) for turn in turns]
        steps = rng.standard_normal((30, 3))
        state[:, STATE.p_WB : STATE.p_WB + 3] = near.origin + 0.24 * steps / np.linalg.norm(steps, axis=1)[:, None]
        for i in range(30):
            q, p = tuple(state[i, STATE.q_WB : STATE.q_WB + 4]), tuple(state[i, STATE.p_WB : STATE.p_WB + 3])
            down = tuple(-z for z in z_axis(q))
            if -down[2] >= SONAR_COSINE_MIN and hull(fleet, i, add(p, rotate(q, (0.3, 0.0, -0.1))), down) < 6.0:
                assert near.above[i] == 1
                met += 1
        noted += near.above.sum()
    assert 20 < met < noted < 1200
    state[:, STATE.p_WB : STATE.p_WB + 3] = [(3.0 * i, 0.0, 4.0) for i in range(30)]
    state[:, STATE.q_WB : STATE.q_WB + 4] = (1.0, 0.0, 0.0, 0.0)
    fleet.advance()
    assert near.above.sum() == 0
