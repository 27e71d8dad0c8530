"""Each sensor's truth to measurement, with lever arms and turned mounts."""

import math

import numpy as np
import pytest

from zsim.math.frames import quaternion_from_rpy
from zsim_world.sensors import measurement

NOWHERE, STILL = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
STRAIGHT = (1.0, 0.0, 0.0, 0.0)


def turn(roll=0.0, pitch=0.0, yaw=0.0):
    return tuple(quaternion_from_rpy((roll, pitch, yaw)).tolist())


def test_imu_at_rest_feels_gravity_upwards():
    f, w = measurement.imu(STILL, STRAIGHT, STILL, STILL, 9.8, (0.1, 0.2, 0.3), STRAIGHT)
    np.testing.assert_allclose(f, (0, 0, 9.8))
    np.testing.assert_allclose(w, 0)


def test_imu_signs_as_on_the_aircraft():
    """Nose up: specific force along the nose (a real landed packet: theta +2.97 deg, accel x +80 mg)."""
    f, _ = measurement.imu(STILL, turn(pitch=-0.1), STILL, STILL, 9.8, NOWHERE, STRAIGHT)
    assert f[0] == pytest.approx(9.8 * math.sin(0.1))


def test_imu_lever_arm_by_hand():
    """Spinning at 3 rad/s about z, speeding up by 2 rad/s^2, 0.1 m ahead: -0.9 m/s^2 along x, +0.2 along y."""
    f, _ = measurement.imu((0, 0, -9.8), STRAIGHT, (0, 0, 3.0), (0, 0, 2.0), 9.8, (0.1, 0, 0), STRAIGHT)
    np.testing.assert_allclose(f, (-0.9, 0.2, 0.0), atol=1e-12)


def test_imu_mount_turned_by_a_quarter():
    """A board turned a quarter to the left: what is forward for the body is to the board's right."""
    f, w = measurement.imu((1.0, 0, -9.8), STRAIGHT, (0.5, 0, 0), STILL, 9.8, NOWHERE, turn(yaw=math.pi / 2))
    np.testing.assert_allclose(f, (0, -1, 0), atol=1e-12)
    np.testing.assert_allclose(w, (0, -0.5, 0), atol=1e-12)


def test_gps_is_that_of_the_antenna():
    p, v = measurement.gps((1, 2, 3), (1, 0, 0), turn(yaw=math.pi / 2), (0, 0, 2.0), (0.1, 0, 0.05))
    np.testing.assert_allclose(p, (1.0, 2.1, 3.05))
    np.testing.assert_allclose(v, (1 - 0.2, 0, 0), atol=1e-12)


def test_mag_turns_against_body_and_mount():
    field = (0.0, 20.0, -10.0)
    np.testing.assert_allclose(measurement.mag(turn(yaw=math.pi / 2), STRAIGHT, field), (20, 0, -10), atol=1e-12)
    turned = measurement.mag(turn(yaw=math.pi / 2), turn(yaw=math.pi / 2), field)
    np.testing.assert_allclose(turned, (0, -20, -10), atol=1e-12)


def test_barometer_height_is_that_of_its_mount():
    assert measurement.height((0, 0, 5.0), turn(pitch=-math.pi / 2), (0.2, 0, 0)) == pytest.approx(5.2)


@pytest.mark.parametrize(
    ("altitude", "pressure"),
    # ISO 2533, table of the standard atmosphere (geopotential heights)
    [(0, 101325.0), (1000, 89874.6), (2000, 79495.2), (5000, 54019.9), (11000, 22632.0)],
)
def test_pressure_of_the_standard_atmosphere(altitude, pressure):
    assert measurement.pressure(altitude) == pytest.approx(pressure, rel=2e-4)


def test_pressure_is_finite_at_any_height():
    pressures = [measurement.pressure(z) for z in (-1e6, -1e4, 2e4, 44_330.0, 44_331.0, 1e6, 1e9)]
    assert all(map(math.isfinite, pressures))
    assert pressures == sorted(pressures, reverse=True)


def test_sonar_measures_along_its_beam():
    level = measurement.sonar((0, 0, 2.0), STRAIGHT, (0, 0, -0.05), STRAIGHT, 6.0)
    assert level == (pytest.approx(1.95), True)
    tilted = measurement.sonar((0, 0, 2.0), turn(roll=0.3), NOWHERE, STRAIGHT, 6.0)
    assert tilted == (pytest.approx(2.0 / math.cos(0.3)), True)
    mounted = measurement.sonar((0, 0, 2.0), turn(roll=0.3), NOWHERE, turn(roll=-0.3), 6.0)
    assert mounted == (pytest.approx(2.0), True)


def test_sonar_has_no_echo_from_afar_or_aside():
    assert measurement.sonar((0, 0, 6.1), STRAIGHT, NOWHERE, STRAIGHT, 6.0) == (6.0, False)
    assert measurement.sonar((0, 0, 1.0), turn(roll=1.2), NOWHERE, STRAIGHT, 6.0) == (6.0, False)
    assert measurement.sonar((0, 0, 1.0), turn(roll=3.0), NOWHERE, STRAIGHT, 6.0) == (6.0, False)


def test_flow_is_in_the_heading_frame():
    q = turn(roll=0.2, pitch=-0.1, yaw=math.pi / 2)
    v, quality = measurement.flow((1.0, 2.0, 0.5), q, STILL, NOWHERE)
    np.testing.assert_allclose(v, (2.0, -1.0, 0.5), atol=1e-12)
    assert quality == pytest.approx(math.cos(0.2) * math.cos(0.1))
    moved, _ = measurement.flow(STILL, turn(yaw=math.pi / 2), (0, 0, 2.0), (0.1, 0, 0))
    np.testing.assert_allclose(moved, (0, 0.2, 0), atol=1e-12)


def test_flow_upside_down_sees_nothing():
    assert measurement.flow(STILL, turn(roll=3.0), STILL, NOWHERE)[1] == 0.0


@pytest.mark.parametrize(
    ("value", "quantum", "shown"), [(1.26, 0.5, 1.5), (-1.26, 0.5, -1.5), (1.24, 0.5, 1.0), (1.26, 0.0, 1.26)]
)
def test_reading_rounds_to_the_quantum(value, quantum, shown):
    assert measurement.reading(value, 0.0, 0.0, quantum) == shown


def test_reading_adds_bias_and_noise_before_rounding():
    assert measurement.reading(1.0, 0.2, 0.1, 0.5) == 1.5
