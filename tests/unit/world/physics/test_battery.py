"""The battery: endurance and bookkeeping."""

import math

import numpy as np
import pytest

from zsim.scenario.scenario_file import resolve
from zsim_world.physics import battery
from zsim_world.state import vehicle


@pytest.fixture(scope="module")
def row():
    scenario = resolve({"name": "t", "duration_s": 1, "drones": [{"name": "a", "position_m": [0, 0, 0]}]})
    return vehicle.parameters(scenario.drones[0], scenario.environment)


def hover(row):
    speed = math.sqrt(row[vehicle.MASS] * row[vehicle.GRAVITY] / (4 * row[vehicle.THRUST]))
    return (speed, speed, speed, speed)


def test_a_full_battery_hovers_for_twelve_minutes(row):
    minutes = row[vehicle.CAPACITY] / battery.power(row, hover(row)) / 60.0
    assert abs(minutes - 12.0) < 0.2


def test_power_is_torque_times_speed_over_efficiency_and_the_board(row):
    speeds = (200.0, 300.0, 400.0, 500.0)
    shaft = sum(row[vehicle.TORQUE] * s**2 * s for s in speeds)
    assert math.isclose(battery.power(row, speeds), shaft / vehicle.EFFICIENCY + vehicle.BOARD_W, rel_tol=1e-12)


def test_energy_is_drained_and_ends_at_zero(row):
    full = row[vehicle.CAPACITY]
    assert math.isclose(full, 1.0 * 3600 * 11.1, rel_tol=1e-12)  # 1 Ah at 11.1 V
    left = battery.drained(row, full, (0.0, 0.0, 0.0, 0.0), 100.0)
    assert math.isclose(left, full - 100.0 * vehicle.BOARD_W, rel_tol=1e-12)
    assert battery.drained(row, 1.0, hover(row), 1.0) == 0.0
    np.testing.assert_allclose(battery.percent(row, full / 4), 25.0)
