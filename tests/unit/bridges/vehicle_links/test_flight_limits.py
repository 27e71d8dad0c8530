"""No velocity leads through a fence, whatever is asked for."""

import math
import random

import pytest

from zsim_bridges.vehicle_links.flight_limits import BRAKING_M_S2, FlightLimits

FENCED = FlightLimits(speed_m_s=3.0, climb_m_s=1.0, radius_m=20.0, ceiling_m=10.0)


@pytest.mark.parametrize(
    ("asked", "expected"),
    [((6, 8, 0), (1.8, 2.4, 0)), ((0, 0, 9), (0, 0, 1)), ((0, 0, -9), (0, 0, -1)), ((1, 0, 0.5), (1, 0, 0.5))],
)
def test_speeds_are_cut_in_their_direction(asked, expected):
    assert FENCED.limited(asked, (0, 0, 2)) == pytest.approx(expected)
    assert FENCED.limited(asked, None) == pytest.approx(expected)


def test_who_flies_at_the_fence_stays_inside_and_may_come_back():
    draw = random.Random(2)
    position = [0.0, 0.0, 1.0]
    course = 0.0
    for _ in range(20_000):
        course += draw.gauss(0, 0.05)
        asked = (9 * math.cos(course), 9 * math.sin(course), draw.uniform(-1, 3))
        velocity = FENCED.limited(asked, position)
        position = [p + 0.02 * v for p, v in zip(position, velocity, strict=True)]
        position[2] = max(0.0, position[2])
        assert math.hypot(*position[:2]) < 20.2
        assert position[2] < 10.2
    assert FENCED.limited((-3, 0, 0), (25, 0, 2)) == pytest.approx((-3, 0, 0))


def test_along_the_fence_nothing_is_taken_away():
    assert FENCED.limited((0, 2, 0), (20, 0, 2)) == pytest.approx((0, 2, 0))


def test_it_is_slow_enough_to_stop():
    for distance in (0.5, 2.0, 4.0):
        x, *_ = FENCED.limited((3, 0, 0), (20 - distance, 0, 2))
        assert x * x / (2 * BRAKING_M_S2) <= distance + 1e-9


def test_breaches():
    assert not FENCED.is_breached((20.5, 0, 5))
    assert FENCED.is_breached((0, 21.5, 5))
    assert FENCED.is_breached((0, 0, 11.5))
    assert not FlightLimits().is_breached((1e6, 0, 1e6))
    assert FENCED.yaw_rate(-9) == -FENCED.yaw_rate_rad_s
