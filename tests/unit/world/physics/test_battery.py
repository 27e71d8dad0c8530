"""The battery: endurance and bookkeeping."""

import math

import numpy as np
import pytest
from vehicle_rows import one_drone, per_rotor

from zsim.vehicles.ardrone2 import VEHICLE as ARDRONE2
from zsim_world.physics import rigid_body
from zsim_world.physics.fleet_arrays import VEHICLE


@pytest.fixture(scope="module")
def row():
    return one_drone()[0]


def hover(row):
    speed = math.sqrt(row[VEHICLE.mass] * row[VEHICLE.gravity] / (4 * row[VEHICLE.thrust]))
    return per_rotor([speed] * 4)


def test_a_full_battery_hovers_for_twelve_minutes(row):
    minutes = row[VEHICLE.capacity] / rigid_body.power(row, hover(row)) / 60.0
    assert abs(minutes - 12.0) < 0.2


def test_power_is_torque_times_speed_over_efficiency_and_the_board(row):
    speeds = (200.0, 300.0, 400.0, 500.0)
    shaft = sum(row[VEHICLE.torque] * s**2 * s for s in speeds)
    assert math.isclose(
        rigid_body.power(row, per_rotor(speeds)),
        shaft / ARDRONE2.battery.efficiency + ARDRONE2.battery.electronics_w,
        rel_tol=1e-12,
    )


def test_energy_is_drained_and_ends_at_zero(row):
    full = row[VEHICLE.capacity]
    assert math.isclose(full, 1.0 * 3600 * 11.1, rel_tol=1e-12)  # 1 Ah at 11.1 V
    left = rigid_body.drained(row, full, per_rotor([0.0] * 4), 100.0)
    assert math.isclose(left, full - 100.0 * ARDRONE2.battery.electronics_w, rel_tol=1e-12)
    assert rigid_body.drained(row, 1.0, hover(row), 1.0) == 0.0
    np.testing.assert_allclose(rigid_body.charge_percent(row, full / 4), 25.0)
