"""What the aircraft derives from its sensors: altitude, integrated position and attitude."""

import math

import msgspec
import pytest

from zsim.contract import flight_messages, messages
from zsim.math.frames import heading, rpy_from_quaternion
from zsim.sensors.sensor import Mount
from zsim_bridges.vehicle_links.drone_link import OnboardState

S = 1_000_000_000
REST = (0.0, 0.0, 9.80665)


def imu(t_s: float, gyro: tuple[float, float, float] = (0.0, 0.0, 0.0), accel=REST) -> messages.Imu:
    return messages.Imu(round(t_s * S), 0, round(t_s * S), accel, gyro)


def flow(t_s: float, x: float, y: float, z: float = 0.0) -> messages.Flow:
    return messages.Flow(round(t_s * S), 0, round(t_s * S), (x, y, z), 1.0)


def sonar(range_m: float, valid: bool = True) -> messages.Sonar:
    return messages.Sonar(0, 0, 0, range_m, valid)


def baro(altitude_m: float) -> messages.Baro:
    return messages.Baro(0, 0, 0, 101_325.0, altitude_m)


def estimate(t_ns: int, position, yaw_rad: float = 0.0) -> flight_messages.Estimate:
    q = (math.cos(yaw_rad / 2), 0.0, 0.0, math.sin(yaw_rad / 2))
    return flight_messages.Estimate(
        t_ns, 0, position, (0.0, 0.0, 0.0), q, yaw_rad, (0.0,) * 36, 0.01, (0.0, 0.0, 0.0), {}
    )  # fmt: skip


def status(t_ns: int) -> flight_messages.Status:
    return flight_messages.Status(t_ns, 0, "flying", 90.0, False, None, 1)


def test_the_measured_velocity_is_integrated_along_the_heading():
    own = OnboardState()
    own.update(estimate(0, (0.0, 0.0, 0.0), yaw_rad=math.pi / 2))  # the nose points north
    for n in range(11):
        own.update(flow(0.1 * n, x=2.0, y=0.5))
    assert own.position_m == pytest.approx((-0.5, 2.0, 0.0))  # 2 m north; left is west


def test_a_left_turn_leads_to_the_left():
    """The integration in ardrone_autonomy has the wrong sign of yaw, which mirrors its positions."""
    own = OnboardState()
    for n in range(101):
        own.update(estimate(0, (0.0, 0.0, 0.0), yaw_rad=0.01 * n * math.pi / 2))
        own.update(flow(0.01 * n, x=1.0, y=0.0))
    quarter = 2 / math.pi  # the radius of a quarter circle whose arc is 1 m long
    assert own.position_m == pytest.approx((quarter, quarter, 0.0), abs=0.01)


def test_altitude_comes_from_the_sonar_or_beyond_its_range_the_barometer():
    own = OnboardState()
    own.update(baro(100.0))
    own.update(sonar(2.0))
    assert own.altitude_m == pytest.approx(2.0)
    own.update(sonar(0.0, valid=False))
    own.update(baro(103.0))
    assert own.altitude_m == pytest.approx(5.0)
    own.update(sonar(4.9))
    assert own.altitude_m == pytest.approx(4.9)
    own.update(baro(200.0))
    assert own.altitude_m == pytest.approx(4.9)


def test_a_tilted_beam_is_longer_than_the_altitude():
    own = OnboardState()
    tilt = math.radians(20)
    rolled = (math.cos(tilt / 2), math.sin(tilt / 2), 0.0, 0.0)
    own.update(msgspec.structs.replace(estimate(0, (0.0, 0.0, 0.0)), orientation_wxyz=rolled))
    own.update(sonar(1.0))
    assert own.altitude_m == pytest.approx(math.cos(tilt))


def test_without_an_estimator_the_gyroscope_gives_the_heading():
    own = OnboardState()
    for n in range(401):
        own.update(imu(0.005 * n, gyro=(0.0, 0.0, 0.5)))
    assert heading(own.attitude) == pytest.approx(1.0, abs=0.01)


def test_without_an_estimator_the_accelerometer_gives_the_tilt():
    own = OnboardState()
    roll = math.radians(5)
    for n in range(2000):
        own.update(imu(0.005 * n, accel=(0.0, 9.81 * math.sin(roll), 9.81 * math.cos(roll))))
    assert rpy_from_quaternion(own.attitude)[0] == pytest.approx(roll, abs=0.002)


def test_an_estimator_is_trusted_from_its_first_estimate_on():
    own = OnboardState()
    own.update(imu(0.0))
    own.update(estimate(0, (0.0, 0.0, 0.0), yaw_rad=1.0))
    own.update(imu(0.005, gyro=(0.0, 0.0, 3.0)))
    assert heading(own.attitude) == pytest.approx(1.0)


def test_an_estimate_without_an_attitude_is_used_for_position_only():
    own = OnboardState()
    own.update(status(S))
    own.update(msgspec.structs.replace(estimate(S, (1.0, 2.0, 3.0)), orientation_wxyz=(0.0, 0.0, 0.0, 0.0)))
    own.update(imu(1.0))
    own.update(imu(1.05, gyro=(0.0, 0.0, 2.0)))
    assert heading(own.attitude) == pytest.approx(0.1, abs=1e-3)
    assert own.origin_m == pytest.approx((1.0, 2.0, 3.0))


def test_samples_of_a_rotated_sensor_are_converted_to_body_axes():
    own = OnboardState(imu=Mount(rpy_deg=(0.0, 0.0, 90.0)), mag=Mount(rpy_deg=(180.0, 0.0, 0.0)))
    sample = own.update(imu(0.0, gyro=(1.0, 0.0, 0.0)))  # about the sensor's x axis, which is the body's y axis
    assert sample.gyro_rad_s == pytest.approx((0.0, 1.0, 0.0))
    assert own.imu is not None
    assert own.imu.gyro_rad_s == pytest.approx((0.0, 1.0, 0.0))
    assert own.update(messages.Mag(0, 0, 0, (1.0, 2.0, 3.0))).field_ut == pytest.approx((1.0, -2.0, -3.0))


def test_the_origin_of_odometry_follows_from_an_estimate_of_the_same_gate():
    own = OnboardState()
    for gate in range(5):
        own.update(flow(float(gate), x=1.0, y=0.0))
        own.update(status(gate * S))
    assert own.origin_m is None
    own.update(estimate(2 * S, (12.0, 5.0, 1.0)))  # of two gates ago, when the aircraft had moved 2 m
    assert own.origin_m == pytest.approx((10.0, 5.0, 1.0))
