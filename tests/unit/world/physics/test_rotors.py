"""Rotors and mixer: speeds for a wanted wrench, limits, and what is given up first."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zsim.scenario.scenario import Drone, Environment
from zsim.scenario.scenario_file import resolve
from zsim_world.physics.rotors import ground_effect, lagged, mix, wrench
from zsim_world.state import vehicle

LEVEL, STILL, NO_SLEW = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)
HIGH = 1000.0  # m, out of ground effect


def ardrone() -> tuple[Drone, Environment]:
    scenario = resolve({"name": "t", "duration_s": 1, "drones": [{"name": "a", "position_m": [0, 0, 0]}]})
    return scenario.drones[0], scenario.environment


@pytest.fixture(scope="module")
def row():
    return vehicle.parameters(*ardrone())


def test_mixed_speeds_give_the_wrench_that_was_asked(row):
    asked = (0.05, -0.04, 0.006)
    thrust, moment = wrench(row, LEVEL, HIGH, STILL, mix(row, 4.2, asked), NO_SLEW)
    assert math.isclose(thrust, 4.2, rel_tol=1e-6)
    np.testing.assert_allclose(moment, asked, rtol=1e-6)


@settings(max_examples=200, deadline=None)
@given(
    st.floats(-20.0, 40.0),
    st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(-0.5, 0.5)),
)
def test_mixer_keeps_the_limits_and_gives_up_yaw_then_thrust_then_tilt(thrust, asked):
    row = vehicle.parameters(*ardrone())
    speeds = mix(row, thrust, asked)
    low, high = row[vehicle.ROTOR_MIN], row[vehicle.ROTOR_MAX]
    assert all(low - 1e-9 <= speed <= high + 1e-9 for speed in speeds)
    total, moment = wrench(row, LEVEL, HIGH, STILL, speeds, NO_SLEW)
    span = row[vehicle.THRUST] * (high**2 - low**2)
    needed = (abs(asked[0]) + abs(asked[1])) / (2 * row[vehicle.ROTOR_XY])
    if needed <= span:  # tilt can be had, so it is had whatever thrust and yaw
        np.testing.assert_allclose(moment[:2], asked[:2], atol=1e-5)
        tilt_reach = needed / 2
        bounds = [4 * (row[vehicle.THRUST] * low**2 + tilt_reach), 4 * (row[vehicle.THRUST] * high**2 - tilt_reach)]
        assert math.isclose(total, min(max(thrust, bounds[0]), bounds[1]), rel_tol=1e-4)
    else:  # scaled down, its direction kept
        assert abs(moment[0] * asked[1] - moment[1] * asked[0]) < 1e-4
    assert moment[2] * asked[2] >= -1e-12
    assert abs(moment[2]) <= abs(asked[2]) + 1e-5


def test_moments_have_the_signs_of_the_layout(row):
    base = np.full(4, 360.0)

    def moment_of(changes):
        return wrench(row, LEVEL, HIGH, STILL, tuple(base + changes), NO_SLEW)[1]

    assert moment_of((10, -10, -10, 10))[0] > 0  # left side up: roll to the right
    assert moment_of((-10, -10, 10, 10))[1] > 0  # rear up: nose down
    assert moment_of((10, -10, 10, -10))[2] > 0  # the clockwise pair faster: body turns counter-clockwise


def test_reaction_and_gyroscopic_moments(row):
    speeds, jerk = (400.0, 300.0, 400.0, 300.0), (1000.0, 0.0, 0.0, 0.0)
    plain = wrench(row, LEVEL, HIGH, STILL, speeds, NO_SLEW)[1]
    jerked = wrench(row, LEVEL, HIGH, STILL, speeds, jerk)[1]
    assert math.isclose(jerked[2] - plain[2], vehicle.ROTOR_INERTIA_KG_M2 * 1000.0, rel_tol=1e-9)
    # spin angular momentum: the clockwise rotors' is down, 2 J (300 - 400) along z; moment = -w × h
    w = (1.0, 2.0, 0.0)
    turned = wrench(row, LEVEL, HIGH, w, speeds, NO_SLEW)[1]
    h = np.array([0.0, 0.0, 2 * vehicle.ROTOR_INERTIA_KG_M2 * (300.0 - 400.0)])
    np.testing.assert_allclose(np.array(turned) - plain, -np.cross(w, h), rtol=1e-9)


def test_ground_effect_tilts_a_drone_away_from_the_nearer_rotor(row):
    speeds = (360.0, 360.0, 360.0, 360.0)
    rolled = (math.cos(0.1), math.sin(0.1), 0.0, 0.0)  # right side down
    moment = wrench(row, rolled, 0.15, STILL, speeds, NO_SLEW)[1]
    assert moment[0] < -1e-4


@pytest.mark.parametrize(("height", "factor"), [(0.1, 16 / 15), (0.05, 4 / 3), (0.0, 4 / 3), (1.0, 1 / (1 - 0.025**2))])
def test_ground_effect_values(height, factor):
    assert math.isclose(ground_effect(height, 0.1), factor, rel_tol=1e-12)


def test_lag_is_exponential():
    speeds = lagged((100.0, 0.0, 300.0, 200.0), (200.0, 50.0, 300.0, 0.0), math.exp(-1.0))
    np.testing.assert_allclose(speeds, (200 - 100 / math.e, 50 - 50 / math.e, 300.0, 200 / math.e))
