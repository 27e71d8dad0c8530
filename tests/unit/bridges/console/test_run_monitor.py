"""Figures of flight, from views."""

import math

import pytest

from zsim.contract.views import DroneView, ViewDrones
from zsim.math import frames
from zsim_bridges.console.run_monitor import FlightMeter

S = 1_000_000_000


def view(t_s: float, x_m: float, battery: float = 80.0, heading_deg: float = 90.0) -> ViewDrones:
    w, x, y, z = frames.quaternion_from_heading([math.radians(heading_deg)])[0].tolist()
    drone = DroneView("drone1", (x_m, 0.0, 2.0 + t_s), (w, x, y, z), (), "flying", battery)
    return ViewDrones(int(t_s * S), 0, (drone,))


def test_speed_climb_and_heading_come_from_where_a_drone_was():
    meter = FlightMeter()
    for step in range(10):
        meter.update(view(0.1 * step, 0.2 * step))
    figures = meter.figures["drone1"]
    assert figures.speed_m_s == pytest.approx(math.hypot(2.0, 1.0))
    assert figures.climb_m_s == pytest.approx(1.0)
    assert figures.heading_deg == pytest.approx(90.0)


def test_a_battery_lasts_as_long_as_it_drains_now():
    meter = FlightMeter()
    meter.update(view(0.0, 0.0, 80.0))
    assert meter.figures["drone1"].battery_left_s is None
    meter.update(view(40.0, 0.0, 70.0))
    assert meter.figures["drone1"].battery_left_s == pytest.approx(70.0 / 0.25)


def test_a_replay_that_goes_back_begins_anew():
    meter = FlightMeter()
    meter.update(view(40.0, 0.0))
    meter.update(view(1.0, 50.0))
    assert meter.figures["drone1"].speed_m_s == 0.0
