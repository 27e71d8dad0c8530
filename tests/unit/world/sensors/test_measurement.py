"""Each sensor's truth to measurement, with lever arms and turned mounts."""

import math
from typing import Any

import numpy as np
import pytest

from zsim.math.frames import quaternion_from_rpy
from zsim_world.sensors.equations import (
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


def body(p=NOWHERE, v=STILL, q=STRAIGHT, w=STILL, a=STILL, alpha=STILL):
    """Return the truth of a drone; whole numbers as floats, as compiled code has them."""
    vectors: Any = [tuple(map(float, each)) for each in (p, v, q, w, a, alpha)]
    return BodyTruth(*vectors)


def mounted(p=NOWHERE, q=STRAIGHT, range_max=6.0):
    return MountedSensor((float(p[0]), float(p[1]), float(p[2])), q, range_max)


SITE = Site(9.8, (0.0, 20.0, -10.0))


def turn(roll=0.0, pitch=0.0, yaw=0.0):
    return tuple(quaternion_from_rpy((roll, pitch, yaw)).tolist())


def test_imu_at_rest_feels_gravity_upwards():
    f, w = imu(body(), mounted((0.1, 0.2, 0.3)), SITE)
    np.testing.assert_allclose(f, (0, 0, 9.8))
    np.testing.assert_allclose(w, 0)


def test_imu_signs_as_on_the_aircraft():
    """Nose up: specific force along the nose (a real landed packet: theta +2.97 deg, accel x +80 mg)."""
    f, _ = imu(body(q=turn(pitch=-0.1)), mounted(), SITE)
    assert f[0] == pytest.approx(9.8 * math.sin(0.1))


def test_imu_lever_arm_by_hand():
    """Spinning at 3 rad/s about z, speeding up by 2 rad/s^2, 0.1 m ahead: -0.9 m/s^2 along x, +0.2 along y."""
    f, _ = imu(body(a=(0, 0, -9.8), w=(0, 0, 3), alpha=(0, 0, 2)), mounted((0.1, 0, 0)), SITE)
    np.testing.assert_allclose(f, (-0.9, 0.2, 0.0), atol=1e-12)


def test_imu_mount_turned_by_a_quarter():
    """A board turned a quarter to the left: what is forward for the body is to the board's right."""
    f, w = imu(body(a=(1, 0, -9.8), w=(0.5, 0, 0)), mounted(q=turn(yaw=math.pi / 2)), SITE)
    np.testing.assert_allclose(f, (0, -1, 0), atol=1e-12)
    np.testing.assert_allclose(w, (0, -0.5, 0), atol=1e-12)


def test_gps_is_that_of_the_antenna():
    p, v = gps(body((1, 2, 3), (1, 0, 0), turn(yaw=math.pi / 2), (0, 0, 2)), mounted((0.1, 0, 0.05)), SITE)
    np.testing.assert_allclose(p, (1.0, 2.1, 3.05))
    np.testing.assert_allclose(v, (1 - 0.2, 0, 0), atol=1e-12)


def test_mag_turns_against_body_and_mount():
    x = body(q=turn(yaw=math.pi / 2))
    np.testing.assert_allclose(mag(x, mounted(), SITE)[0], (20, 0, -10), atol=1e-12)
    turned, _ = mag(x, mounted(q=turn(yaw=math.pi / 2)), SITE)
    np.testing.assert_allclose(turned, (0, -20, -10), atol=1e-12)


def test_barometer_height_is_that_of_its_mount():
    height, _ = baro(body((0, 0, 5), q=turn(pitch=-math.pi / 2)), mounted((0.2, 0, 0)), SITE)
    assert height[0] == pytest.approx(5.2)


@pytest.mark.parametrize(
    ("altitude", "pascals"),
    # ISO 2533, table of the standard atmosphere (geopotential heights)
    [(0, 101325.0), (1000, 89874.6), (2000, 79495.2), (5000, 54019.9), (11000, 22632.0)],
)
def test_pressure_of_the_standard_atmosphere(altitude, pascals):
    assert pressure(altitude) == pytest.approx(pascals, rel=2e-4)


def test_pressure_is_finite_at_any_height():
    pressures = [pressure(z) for z in (-1e6, -1e4, 2e4, 44_330.0, 44_331.0, 1e6, 1e9)]
    assert all(map(math.isfinite, pressures))
    assert pressures == sorted(pressures, reverse=True)


def beam(p, q=STRAIGHT, p_BS=NOWHERE, q_BS=STRAIGHT):
    """Return distance and echo of a sonar with a range of 6 m."""
    (distance, echo, _), _ = sonar(body(p, q=q), mounted(p_BS, q_BS), SITE)
    return distance, echo


def test_sonar_measures_along_its_beam():
    assert beam((0, 0, 2), p_BS=(0, 0, -0.05)) == (pytest.approx(1.95), 1.0)
    assert beam((0, 0, 2), turn(roll=0.3)) == (pytest.approx(2.0 / math.cos(0.3)), 1.0)
    assert beam((0, 0, 2), turn(roll=0.3), q_BS=turn(roll=-0.3)) == (pytest.approx(2.0), 1.0)


def test_sonar_has_no_echo_from_afar_or_aside():
    assert beam((0, 0, 6.1)) == (6.0, 0.0)
    assert beam((0, 0, 1), turn(roll=1.2)) == (6.0, 0.0)
    assert beam((0, 0, 1), turn(roll=3.0)) == (6.0, 0.0)


def test_flow_is_in_the_heading_frame():
    q = turn(roll=0.2, pitch=-0.1, yaw=math.pi / 2)
    v, (quality, _, _) = flow(body(v=(1, 2, 0.5), q=q), mounted(), SITE)
    np.testing.assert_allclose(v, (2.0, -1.0, 0.5), atol=1e-12)
    assert quality == pytest.approx(math.cos(0.2) * math.cos(0.1))
    moved, _ = flow(body(q=turn(yaw=math.pi / 2), w=(0, 0, 2)), mounted((0.1, 0, 0)), SITE)
    np.testing.assert_allclose(moved, (0, 0.2, 0), atol=1e-12)


def test_flow_upside_down_sees_nothing():
    _, (quality, _, _) = flow(body(q=turn(roll=3.0)), mounted(), SITE)
    assert quality == 0.0


@pytest.mark.parametrize(
    ("value", "quantum", "shown"), [(1.26, 0.5, 1.5), (-1.26, 0.5, -1.5), (1.24, 0.5, 1.0), (1.26, 0.0, 1.26)]
)
def test_reading_rounds_to_the_quantum(value, quantum, shown):
    assert rounded(value, 0.0, 0.0, quantum) == shown


def test_reading_adds_bias_and_noise_before_rounding():
    assert rounded(1.0, 0.2, 0.1, 0.5) == 1.5
