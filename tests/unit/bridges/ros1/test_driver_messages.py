"""Units, signs and frames of ardrone_autonomy, by physical examples."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from zsim.contract import flight_messages, messages, run_messages
from zsim_bridges.ros1 import driver_messages, tcpros
from zsim_bridges.ros1.driver_messages import DriverFrames
from zsim_bridges.vehicle_links.drone_link import OnboardState

T_NS = 61_040_000_000
FRAMES = DriverFrames("drone1")
ZERO, STILL = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)


def attitude(roll_deg: float = 0.0, pitch_deg: float = 0.0, yaw_deg: float = 0.0) -> flight_messages.Quaternion:
    w, x, y, z = Rotation.from_euler("ZYX", [yaw_deg, pitch_deg, roll_deg], degrees=True).as_quat(scalar_first=True)
    return float(w), float(x), float(y), float(z)


def aircraft(state: Any = "hovering", **angles: float) -> OnboardState:
    """An aircraft 1.234 m over the ground, on its way forward, left and up."""
    own = OnboardState()
    own.update(
        flight_messages.Estimate(
            T_NS, 0, (5.0, 6.0, 7.0), ZERO, attitude(**angles), 0.0, (0.0,) * 36, 0.0, ZERO, {}
        )
    )  # fmt: skip
    own.attitude = attitude()
    own.update(messages.Sonar(T_NS, 0, T_NS, 1.234, True))
    own.attitude = attitude(**angles)
    own.update(messages.Imu(T_NS, 0, T_NS, (0.0, 0.0, 9.80665), (0.1, 0.2, 0.3)))
    own.update(messages.Mag(T_NS, 0, T_NS, (3.0, 0.0, -4.0)))
    own.update(messages.Baro(T_NS, 0, T_NS, 101_325.4, 0.0))
    own.update(messages.Flow(T_NS, 0, T_NS, (1.0, 0.25, 0.5), 1.0))
    own.update(flight_messages.Status(T_NS, 0, state, 87.5, False, None, 1))
    return own


def navdata(state: Any = "hovering", **angles: float) -> Any:
    """Navdata as a node reads it, bytes in between."""
    made = driver_messages.navdata(3, aircraft(state, **angles), FRAMES)
    kind = "ardrone_autonomy/Navdata"
    return tcpros.deserialize(kind, tcpros.serialize(kind, made))


def test_navdata_has_the_units_of_the_driver():
    message = navdata()
    assert message.batteryPercent == 87.5
    assert message.altd == 1234  # mm
    assert (message.vx, message.vy, message.vz) == (1000.0, 250.0, 500.0)  # mm/s, forward, left, up
    assert (message.ax, message.ay, message.az) == (0.0, 0.0, 1.0)  # g
    assert message.pressure == 101_325  # Pa
    assert (message.magX, message.magY, message.magZ) == (10, 0, -13)  # 0.3 uT each
    assert message.tm == pytest.approx(61_040_000.0)  # us
    assert message.tags_count == 0
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (61, 40_000_000)
    assert message.header.frame_id == "drone1/ardrone_base_link"
    assert message.header.seq == 3


def test_rolling_to_the_right_is_positive():
    assert navdata(roll_deg=10.0).rotX == pytest.approx(10.0)


def test_a_nose_down_is_positive():
    assert navdata(pitch_deg=7.0).rotY == pytest.approx(7.0)
    nose = Rotation.from_euler("ZYX", [0, 7.0, 0], degrees=True).apply([1.0, 0.0, 0.0])
    assert nose[2] < 0  # what a positive pitch does to the nose


def test_turning_to_the_left_is_positive():
    assert navdata(yaw_deg=90.0).rotZ == pytest.approx(90.0)


@pytest.mark.parametrize(
    ("state", "number"), [("landed", 2), ("flying", 3), ("hovering", 4), ("taking_off", 6), ("landing", 8), ("emergency", 0)]
)  # fmt: skip
def test_states_have_the_numbers_of_the_sdk(state, number):
    assert navdata(state).state == number


def test_an_aircraft_that_has_said_little_has_navdata_too():
    own = OnboardState()
    own.update(flight_messages.Status(0, 0, "landed", 100.0, False, None, 1))
    message = driver_messages.navdata(0, own, FRAMES)
    assert (message.altd, message.vx, message.pressure, message.az) == (0, 0.0, 0, 0.0)
    tcpros.serialize("ardrone_autonomy/Navdata", message)


def test_an_imu_tells_specific_force_rate_and_attitude():
    own = aircraft(yaw_deg=90.0)
    assert own.imu is not None
    message = driver_messages.imu(0, own.imu, own.attitude, FRAMES)
    assert message.linear_acceleration.z == pytest.approx(9.80665)
    assert (message.angular_velocity.x, message.angular_velocity.y, message.angular_velocity.z) == (0.1, 0.2, 0.3)
    assert (message.orientation.w, message.orientation.z) == pytest.approx((math.sqrt(0.5), math.sqrt(0.5)))
    assert tcpros.serialize("sensor_msgs/Imu", message)


def test_the_magnetic_field_is_a_direction():
    message = driver_messages.mag(0, messages.Mag(T_NS, 0, T_NS - 5_000_000, (3.0, 0.0, -4.0)), FRAMES)
    assert (message.vector.x, message.vector.y, message.vector.z) == pytest.approx((0.6, 0.0, -0.8))
    assert message.header.stamp.nanosec == 35_000_000  # of the sample, not of its arrival


def test_no_magnetic_field_is_no_direction():
    message = driver_messages.mag(0, messages.Mag(0, 0, 0, (0.0, 0.0, 0.0)), FRAMES)
    assert (message.vector.x, message.vector.y, message.vector.z) == (0.0, 0.0, 0.0)


def gps(fix: int) -> messages.Gps:
    return messages.Gps(
        T_NS, 0, T_NS - 100_000_000, -34.6, -58.4, 31.0, ZERO, ZERO, 2.0, fix, 9
    )  # fmt: skip


def test_a_fix_is_where_and_how_well():
    message = driver_messages.fix(0, gps(3), FRAMES)
    assert (message.latitude, message.longitude, message.altitude) == (-34.6, -58.4, 31.0)
    assert message.status.status == 0
    assert message.position_covariance.tolist() == [4.0, 0, 0, 0, 4.0, 0, 0, 0, 4.0]
    assert tcpros.serialize("sensor_msgs/NavSatFix", message)


def test_no_fix_is_said():
    assert driver_messages.fix(0, gps(0), FRAMES).status.status == -1


def test_odometry_is_the_aircraft_s_own():
    message = driver_messages.odometry(0, aircraft(), FRAMES)
    assert (message.header.frame_id, message.child_frame_id) == ("drone1/odom", "drone1/ardrone_base_link")
    assert message.pose.pose.position.z == pytest.approx(1.234)
    assert (message.twist.twist.linear.x, message.twist.twist.linear.y) == (1.0, 0.25)
    assert tcpros.serialize("nav_msgs/Odometry", message)


def test_ground_truth_is_in_the_world():
    truth = flight_messages.Truth(
        T_NS, 0, (1.0, 2.0, 3.0), (0.0, 4.0, 0.0), attitude(yaw_deg=90.0), (1.0, 0.0, 0.5), ZERO, STILL
    )  # fmt: skip
    message = driver_messages.ground_truth(0, truth, FRAMES)
    assert message.header.frame_id == "world"
    assert (message.pose.pose.position.x, message.pose.pose.position.y, message.pose.pose.position.z) == (1.0, 2.0, 3.0)
    assert (message.twist.twist.linear.x, message.twist.twist.linear.y) == (0.0, 4.0)
    rate = message.twist.twist.angular  # rolling about the nose, which points north
    assert (rate.x, rate.y, rate.z) == pytest.approx((0.0, 1.0, 0.5))


def test_transforms_lead_from_the_world_to_where_the_estimator_believes_it_to_be():
    own = aircraft(yaw_deg=30.0)
    own.update(flight_messages.Estimate(T_NS, 1, (5.0, 6.0, 7.0), ZERO, attitude(yaw_deg=30.0), 0.0, (0.0,) * 36, 0.0, ZERO, {}))  # fmt: skip
    to_base, to_odom = driver_messages.transforms(0, own, FRAMES).transforms
    assert (to_odom.header.frame_id, to_odom.child_frame_id) == ("world", "drone1/odom")
    assert (to_base.header.frame_id, to_base.child_frame_id) == ("drone1/odom", "drone1/ardrone_base_link")
    place = [[getattr(t.transform.translation, axis) for axis in "xyz"] for t in (to_odom, to_base)]
    assert np.sum(place, axis=0) == pytest.approx([5.0, 6.0, 7.0])
    assert tcpros.serialize("tf2_msgs/TFMessage", driver_messages.transforms(0, own, FRAMES))


def test_transforms_without_an_estimator_end_at_odom():
    own = OnboardState()
    own.update(flight_messages.Status(0, 0, "landed", 100.0, False, None, 1))
    (only,) = driver_messages.transforms(0, own, FRAMES).transforms
    assert only.header.frame_id == "drone1/odom"


def test_the_clock_is_simulated_time():
    message = driver_messages.clock(run_messages.Clock(T_NS, 0, "run", 3052, "running", 1.0))
    assert (message.clock.sec, message.clock.nanosec) == (61, 40_000_000)
