"""Rotors and mixer: speeds for a requested wrench, limits, and what is given up first."""

import math
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from vehicle_rows import one_drone, per_rotor

from zsim.scenario.scenario_file import resolve
from zsim.vehicles.ardrone2 import VEHICLE as ARDRONE2
from zsim.vehicles.vehicle import MODELS, Rotor, Vehicle, vehicle_of
from zsim_world.physics import rigid_body
from zsim_world.physics.fleet_arrays import (
    CROSS_ROTORS,
    ROTOR,
    VEHICLE,
    PerRotor,
    mixed,
    rotor_layout,
    rotor_row,
    rotor_slots,
    value_of,
    vehicle_row,
)
from zsim_world.physics.rigid_body import ground_effect, lagged

pytestmark = pytest.mark.usefixtures("interpreted")
LEVEL, STILL = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
HIGH = 1000.0  # m, out of ground effect
ROW, ROTORS = one_drone()


@pytest.fixture(scope="module")
def row():
    return ROW


def wrench(row, q_WB, height_m, w_WB_B, speeds, slew=(0.0, 0.0, 0.0, 0.0)):
    """Return the thrust and moment of rotors at these speeds, which change at the rate `slew` [rad/s^2]."""
    commands = np.array(speeds) + row[VEHICLE.rotor_lag] * np.array(slew)
    return rigid_body.wrench(row, ROTORS, q_WB, height_m, w_WB_B, per_rotor(speeds), per_rotor(commands), None)


def mix(row, thrust_n, moment):
    speeds = per_rotor([0.0] * 4)
    rigid_body.mix(row, ROTORS, thrust_n, moment, speeds)
    return tuple(speeds.numbers)


def test_mixed_speeds_give_the_requested_wrench(row):
    asked = (0.05, -0.04, 0.006)
    thrust, moment = wrench(row, LEVEL, HIGH, STILL, mix(row, 4.2, asked))
    assert math.isclose(thrust, 4.2, rel_tol=1e-6)
    np.testing.assert_allclose(moment, asked, rtol=1e-6)


@settings(max_examples=200, deadline=None)
@given(
    st.floats(-20.0, 40.0),
    st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(-0.5, 0.5)),
)
def test_the_mixer_keeps_the_limits_and_gives_up_yaw_then_thrust_then_tilt(thrust, asked):
    row = ROW
    speeds = mix(row, thrust, asked)
    low, high = row[VEHICLE.rotor_min], row[VEHICLE.rotor_max]
    assert all(low - 1e-9 <= speed <= high + 1e-9 for speed in speeds)
    total, moment = wrench(row, LEVEL, HIGH, STILL, speeds)
    span = row[VEHICLE.thrust] * (high**2 - low**2)
    needed = (abs(asked[0]) + abs(asked[1])) / (2 * row[VEHICLE.rotor_unit])
    if needed <= span:  # the tilt is feasible, so it takes precedence over thrust and yaw
        np.testing.assert_allclose(moment[:2], asked[:2], atol=1e-5)
        tilt_reach = needed / 2
        bounds = [4 * (row[VEHICLE.thrust] * low**2 + tilt_reach), 4 * (row[VEHICLE.thrust] * high**2 - tilt_reach)]
        assert math.isclose(total, min(max(thrust, bounds[0]), bounds[1]), rel_tol=1e-4)
    else:  # scaled down in the same direction
        assert abs(moment[0] * asked[1] - moment[1] * asked[0]) < 1e-4
    assert moment[2] * asked[2] >= -1e-12
    assert abs(moment[2]) <= abs(asked[2]) + 1e-5


def test_moments_have_the_signs_of_the_layout(row):
    base = np.full(4, 360.0)

    def moment_of(changes):
        return wrench(row, LEVEL, HIGH, STILL, tuple(base + changes))[1]

    assert moment_of((10, -10, -10, 10))[0] > 0  # left side up: roll to the right
    assert moment_of((-10, -10, 10, 10))[1] > 0  # rear up: nose down
    assert moment_of((10, -10, 10, -10))[2] > 0  # clockwise pair faster: body turns counter-clockwise


def test_reaction_and_gyroscopic_moments_match_their_formulas(row):
    speeds, jerk = (400.0, 300.0, 400.0, 300.0), (1000.0, 0.0, 0.0, 0.0)
    plain = wrench(row, LEVEL, HIGH, STILL, speeds)[1]
    jerked = wrench(row, LEVEL, HIGH, STILL, speeds, jerk)[1]
    assert math.isclose(jerked[2] - plain[2], ARDRONE2.rotor_inertia_kg_m2 * 1000.0, rel_tol=1e-9)
    # angular momentum of the spin: that of clockwise rotors is down, so h = 2 J (300 - 400) along z; moment = -w × h
    w = (1.0, 2.0, 0.0)
    turned = wrench(row, LEVEL, HIGH, w, speeds)[1]
    h = np.array([0.0, 0.0, 2 * ARDRONE2.rotor_inertia_kg_m2 * (300.0 - 400.0)])
    np.testing.assert_allclose(np.array(turned) - plain, -np.cross(w, h), rtol=1e-9)


def test_ground_effect_lifts_the_lower_side_of_a_drone(row):
    speeds = (360.0, 360.0, 360.0, 360.0)
    rolled = (math.cos(0.1), math.sin(0.1), 0.0, 0.0)  # right side down
    moment = wrench(row, rolled, 0.15, STILL, speeds)[1]
    assert moment[0] < -1e-4


@pytest.mark.parametrize(("height", "factor"), [(0.1, 16 / 15), (0.05, 4 / 3), (0.0, 4 / 3), (1.0, 1 / (1 - 0.025**2))])
def test_the_ground_effect_matches_its_formula(height, factor):
    assert math.isclose(ground_effect(height, 0.1), factor, rel_tol=1e-12)


def test_the_rotor_lag_is_exponential():
    assert lagged(100.0, 200.0, math.exp(-1.0)) == pytest.approx(200 - 100 / math.e)
    assert lagged(300.0, 300.0, math.exp(-1.0)) == 300.0


@settings(max_examples=100, deadline=None)
@given(
    st.floats(-20.0, 40.0),
    st.tuples(st.floats(-4.0, 4.0), st.floats(-4.0, 4.0), st.floats(-0.5, 0.5)),
)
def test_the_mixer_of_off_centre_rotors_keeps_limits_and_tilt_direction(thrust, asked):
    """On the Iris, whose rear rotors carry more, thrust alone exerts no moment, and a feasible request is met."""
    drones = [{"name": "a", "model": "iris", "position_m": [0, 0, 0]}]
    scenario = resolve({"name": "t", "duration_s": 1, "drones": drones})
    vehicle, drone = vehicle_of("iris"), scenario.drones[0]
    slots = rotor_slots([vehicle])
    row = vehicle_row(vehicle, drone, scenario.environment)
    known = PerRotor(rotor_row(vehicle, drone, slots), 0, 1, tuple(range(slots)))
    speeds = per_rotor([0.0] * slots)
    rigid_body.mix(row, known, thrust, asked, speeds)
    low, high = row[VEHICLE.rotor_min], row[VEHICLE.rotor_max]
    flown = speeds.numbers[:4]
    speeds.numbers[4:] = 0.0  # slots without a rotor, whose command is clipped to zero
    assert all(low - 1e-9 <= speed <= high + 1e-9 for speed in flown)
    total, moment = rigid_body.wrench(row, known, LEVEL, HIGH, STILL, speeds, speeds, None)
    assert abs(moment[0] * asked[1] - moment[1] * asked[0]) < 1e-4  # in the same direction
    if 8.0 < thrust < 16.0 and max(map(abs, asked)) < 0.1:
        assert math.isclose(total, thrust, rel_tol=1e-4)
        np.testing.assert_allclose(moment[:2], asked[:2], atol=1e-4)


def plus() -> Vehicle:
    """Return a vehicle with rotors ahead, on the right, behind and on the left."""
    ends: tuple[tuple[str, float, float, Literal[-1, 1]], ...] = (
        ("ahead", 1.0, 0.0, 1), ("right", 0.0, -1.0, -1), ("behind", -1.0, 0.0, 1), ("left", 0.0, 1.0, -1)
    )  # fmt: skip
    vehicle = vehicle_of("ardrone2")
    arm_m = vehicle.arm_m
    rotors = tuple(Rotor(name=name, x_m=arm_m * x, y_m=arm_m * y, turn=turn) for name, x, y, turn in ends)
    return replace(vehicle, rotors=rotors)


@pytest.mark.parametrize("model", MODELS)
def test_the_compiled_constants_are_those_of_the_stock_vehicles(model: str):
    _, rotors = one_drone(model=model)
    assert len(rotors.each) == CROSS_ROTORS
    for r in rotors.each:
        assert rotor_layout(rotors, r) == tuple(value_of(rotors, group, r) for group in (ROTOR.x, ROTOR.y, ROTOR.turn))
        groups = (ROTOR.roll, ROTOR.pitch, ROTOR.yaw, ROTOR.yaw_inverse)
        assert mixed(rotors, r) == tuple(value_of(rotors, group, r) for group in groups)


def test_other_vehicles_have_rotor_positions_of_their_own():
    stock = [*map(vehicle_of, MODELS)]
    assert rotor_slots(stock) == CROSS_ROTORS
    assert rotor_slots([*stock, plus()]) == CROSS_ROTORS + 1
    assert rotor_slots([*stock, vehicle_of("hexacopter")]) == 6
    _, rotors = one_drone(model="hexacopter")
    assert np.array(rotor_layout(rotors, 0)).tolist() == [
        value_of(rotors, group, 0) for group in (ROTOR.x, ROTOR.y, ROTOR.turn)
    ]


def hover(row):
    speed = math.sqrt(row[VEHICLE.mass] * row[VEHICLE.gravity] / (4 * row[VEHICLE.thrust]))
    return per_rotor([speed] * 4)


def test_a_full_battery_hovers_for_twelve_minutes(row):
    minutes = row[VEHICLE.capacity] / rigid_body.power(row, hover(row)) / 60.0
    assert abs(minutes - 12.0) < 0.2


def test_power_is_torque_times_speed_over_efficiency_plus_the_board(row):
    speeds = (200.0, 300.0, 400.0, 500.0)
    shaft = sum(row[VEHICLE.torque] * s**2 * s for s in speeds)
    assert math.isclose(
        rigid_body.power(row, per_rotor(speeds)),
        shaft / ARDRONE2.battery.efficiency + ARDRONE2.battery.electronics_w,
        rel_tol=1e-12,
    )


def test_the_battery_is_drained_down_to_zero(row):
    full = row[VEHICLE.capacity]
    assert math.isclose(full, 1.0 * 3600 * 11.1, rel_tol=1e-12)  # 1 Ah at 11.1 V
    left = rigid_body.drained(row, full, per_rotor([0.0] * 4), 100.0)
    assert math.isclose(left, full - 100.0 * ARDRONE2.battery.electronics_w, rel_tol=1e-12)
    assert rigid_body.drained(row, 1.0, hover(row), 1.0) == 0.0
    np.testing.assert_allclose(rigid_body.charge_percent(row, full / 4), 25.0)
