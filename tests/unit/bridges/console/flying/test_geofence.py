"""The geofence of drones that are flown from a page, and velocities within it."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from refused import has_terms

from zsim.math.frames import turned_about_up
from zsim.scenario import scenario_file
from zsim.vehicles.vehicle import Limits
from zsim_bridges.console.manual_flight import (
    DronePose,
    Geofence,
    Stick,
    geofence_of,
    stick_velocity,
    velocity_to,
)

FENCE = Geofence((-50.0, -50.0, 1.0), (50.0, 50.0, 30.0))
LIMITS = Limits(horizontal_speed_m_s=2.0, vertical_speed_m_s=0.5, yaw_rate_deg_s=30.0)
MIDDLE = DronePose((0.0, 0.0, 5.0), math.pi / 2)
deflections = st.floats(-1.0, 1.0)


def test_the_fence_is_around_all_starts_and_below_the_lowest_ceiling():
    drones = [
        {"name": "one", "position_m": [0, 10, 0]},
        {"name": "two", "position_m": [-20, 0, 0], "limits": {"altitude_m": 12}},
    ]
    fence = geofence_of(scenario_file.resolve({"name": "t", "duration_s": 1, "drones": drones}, "t.yaml"))
    assert fence == Geofence((-70.0, -50.0, 1.0), (50.0, 60.0, 12.0))


def test_a_place_outside_is_refused_with_its_axis_and_the_limits():
    assert FENCE.refusal(50.0, -50.0) == ""
    assert has_terms(FENCE.refusal(50.1, 0.0), "x", "50.1", "-50", "50")
    assert has_terms(FENCE.refusal(0.0, -60.0), "y", "-60.0", "-50", "50")


def test_a_drone_slows_down_before_the_fence_and_comes_back_from_beyond_it():
    assert FENCE.within((2.0, -2.0, 1.0), (49.5, 0.0, 30.0)) == (0.5, -2.0, 0.0)
    assert FENCE.within((2.0, 0.0, -1.0), (60.0, 0.0, 0.5)) == (0.0, 0.0, 0.0)
    assert FENCE.within((-2.0, 0.0, 1.0), (60.0, 0.0, 0.5)) == (-2.0, 0.0, 1.0)


@given(deflections, deflections, deflections, deflections, st.floats(0.0, 100.0), st.floats(-4.0, 4.0))
def test_a_stick_never_asks_for_more_than_the_drone_s_limits(
    forward: float, left: float, up: float, turn: float, speed: float, yaw: float
):
    pose = DronePose((0.0, 0.0, 15.0), yaw)
    flown = stick_velocity(Stick(forward, left, up, turn, speed), pose, LIMITS, FENCE)
    x, y, z = flown.velocity_m_s
    assert math.hypot(x, y) <= min(speed, 2.0) + 1e-9
    assert abs(z) <= 0.5
    assert abs(flown.yaw_rate_rad_s) <= math.radians(30.0)


def test_a_stick_is_in_the_heading_frame():
    flown = stick_velocity(Stick(1.0, 0.0, 0.0, 0.5, 1.5), MIDDLE, LIMITS, FENCE)
    assert flown.velocity_m_s == pytest.approx((1.5, 0.0, 0.0))
    assert flown.yaw_rate_rad_s == pytest.approx(math.radians(15.0))


def test_the_fence_holds_whatever_the_heading():
    """It looks north at the fence in the north: nothing is left of forward, all of left."""
    flown = stick_velocity(Stick(1.0, 1.0, 0.0, 0.0, 1.0), DronePose((0.0, 50.0, 5.0), math.pi / 2), LIMITS, FENCE)
    assert flown.velocity_m_s == pytest.approx((0.0, math.sqrt(0.5), 0.0), abs=1e-9)


def test_to_a_place_a_drone_flies_straight_and_slows_down_there():
    far = velocity_to((30.0, 40.0, 5.0), MIDDLE, LIMITS, FENCE)
    assert turned_about_up(far.velocity_m_s, MIDDLE.yaw_rad) == pytest.approx((0.9, 1.2, 0.0))
    near = velocity_to((0.5, 0.0, 5.5), MIDDLE, LIMITS, FENCE)
    assert turned_about_up(near.velocity_m_s, MIDDLE.yaw_rad) == pytest.approx((0.3, 0.0, 0.3))
    assert far.yaw_rate_rad_s == near.yaw_rate_rad_s == 0.0
