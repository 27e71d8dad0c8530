"""The units, signs and frames of ardrone_autonomy, by physical examples, and the meaning of cmd_vel."""

import math
from typing import Any

import numpy as np
import pytest
from refused import has_terms
from scipy.spatial.transform import Rotation

from zsim.contract import flight_messages, messages
from zsim_bridges.ros1 import node as wire
from zsim_bridges.ros1 import ros1_bridge
from zsim_bridges.ros1.ros1_bridge import REPEAT_NS, DriverCommands, DriverFrames, TiltCommand, ros1_name, tilt_of
from zsim_bridges.vehicle_links.drone_link import OnboardState

T_NS, GATE_NS = 61_040_000_000, 20_000_000
FRAMES = DriverFrames("drone1")
ZERO, STILL = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)
Vector3 = wire.message_class("geometry_msgs/Vector3")


def xyz(vector: Any) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def attitude(roll_deg: float = 0.0, pitch_deg: float = 0.0, yaw_deg: float = 0.0) -> flight_messages.Quaternion:
    w, x, y, z = Rotation.from_euler("ZYX", [yaw_deg, pitch_deg, roll_deg], degrees=True).as_quat(scalar_first=True)
    return float(w), float(x), float(y), float(z)


def estimate(q: flight_messages.Quaternion) -> flight_messages.Estimate:
    return flight_messages.Estimate(T_NS, 0, (5.0, 6.0, 7.0), ZERO, q, 0.0, (0.0,) * 36, 0.0, ZERO, {})


def aircraft(state: Any = "hovering", **angles: float) -> OnboardState:
    """Return an aircraft 1.234 m above the ground that moves forward, left and up."""
    own = OnboardState()
    own.update(estimate(attitude(**angles)))
    own.attitude = attitude()
    own.update(messages.Sonar(T_NS, 0, T_NS, 1.234, True))
    own.attitude = attitude(**angles)
    own.update(messages.Imu(T_NS, 0, T_NS, (0.0, 0.0, 9.80665), (0.1, 0.2, 0.3)))
    own.update(messages.Mag(T_NS, 0, T_NS, (3.0, 0.0, -4.0)))
    own.update(messages.Baro(T_NS, 0, T_NS, 101_325.4, 0.0))
    own.update(messages.Flow(T_NS, 0, T_NS, (1.0, 0.25, 0.5), 1.0))
    own.update(flight_messages.Status(T_NS, 0, state, 87.5, False, None, 1))
    return own


def without_sensors() -> OnboardState:
    own = OnboardState()
    own.update(flight_messages.Status(0, 0, "landed", 100.0, False, None, 1))
    return own


def on_wire(kind: str, message: Any) -> Any:
    """Return a message as a node would read it."""
    return wire.deserialize(kind, wire.serialize(kind, message))


def navdata(state: Any = "hovering", **angles: float) -> Any:
    return on_wire("ardrone_autonomy/Navdata", ros1_bridge.navdata(3, aircraft(state, **angles), FRAMES))


@pytest.mark.parametrize(("t_ns", "stamp"), [(12_340_000_005, (12, 340_000_005)), (0, (0, 0)), (-5_000_000, (0, 0))])
def test_a_time_has_seconds_and_nanoseconds_and_is_never_negative(t_ns, stamp):
    time = ros1_bridge.ros_time(t_ns)
    assert (time.sec, time.nanosec) == stamp


def test_names_are_reduced_to_letters_digits_and_underscores():
    assert ros1_name("drone-1.a") == "drone_1_a"


def test_navdata_has_the_units_of_the_driver():
    message = navdata()
    assert message.batteryPercent == 87.5
    assert message.altd == 1234  # mm
    assert (message.vx, message.vy, message.vz) == (1000.0, 250.0, 500.0)  # mm/s, forward, left, up
    assert (message.ax, message.ay, message.az) == (0.0, 0.0, 1.0)  # g
    assert message.pressure == 101_325  # Pa
    assert (message.magX, message.magY, message.magZ) == (10, 0, -13)  # in units of 0.3 uT
    assert message.tm == pytest.approx(61_040_000.0)  # us
    assert message.tags_count == 0
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (61, 40_000_000)
    assert (message.header.frame_id, message.header.seq) == ("drone1/ardrone_base_link", 3)


def test_right_down_nose_down_and_counter_clockwise_are_positive():
    assert navdata(roll_deg=10.0).rotX == pytest.approx(10.0)
    assert navdata(pitch_deg=7.0).rotY == pytest.approx(7.0)
    assert Rotation.from_euler("ZYX", [0, 7.0, 0], degrees=True).apply([1.0, 0.0, 0.0])[2] < 0  # the nose
    assert navdata(yaw_deg=90.0).rotZ == pytest.approx(90.0)


@pytest.mark.parametrize(
    ("state", "number"), [("landed", 2), ("flying", 3), ("hovering", 4), ("taking_off", 6), ("landing", 8), ("emergency", 0)]
)  # fmt: skip
def test_states_have_the_numbers_of_the_ardrone_sdk(state, number):
    assert navdata(state).state == number


def test_navdata_without_samples_is_zero():
    message = on_wire("ardrone_autonomy/Navdata", ros1_bridge.navdata(0, without_sensors(), FRAMES))
    assert (message.altd, message.vx, message.pressure, message.az) == (0, 0.0, 0, 0.0)


def test_an_imu_message_has_specific_force_rate_and_attitude():
    own = aircraft(yaw_deg=90.0)
    assert own.imu is not None
    message = on_wire("sensor_msgs/Imu", ros1_bridge.imu(0, own.imu, own.attitude, FRAMES))
    assert message.linear_acceleration.z == pytest.approx(9.80665)
    assert xyz(message.angular_velocity) == (0.1, 0.2, 0.3)
    assert (message.orientation.w, message.orientation.z) == pytest.approx((math.sqrt(0.5), math.sqrt(0.5)))


@pytest.mark.parametrize(("field", "direction"), [((3.0, 0.0, -4.0), (0.6, 0.0, -0.8)), (ZERO, ZERO)])
def test_the_magnetic_field_is_a_unit_vector(field, direction):
    message = ros1_bridge.mag(0, messages.Mag(T_NS, 0, T_NS - 5_000_000, field), FRAMES)
    assert xyz(message.vector) == pytest.approx(direction)
    assert message.header.stamp.nanosec == 35_000_000  # the time of the sample, not of its arrival


@pytest.mark.parametrize(("fix", "status"), [(3, 0), (0, -1)])
def test_a_fix_has_a_position_a_status_and_a_covariance(fix, status):
    gps = messages.Gps(T_NS, 0, T_NS - 100_000_000, -34.6, -58.4, 31.0, ZERO, ZERO, 2.0, fix, 9)
    message = on_wire("sensor_msgs/NavSatFix", ros1_bridge.fix(0, gps, FRAMES))
    assert (message.latitude, message.longitude, message.altitude) == (-34.6, -58.4, 31.0)
    assert message.status.status == status
    assert message.position_covariance.tolist() == [4.0, 0, 0, 0, 4.0, 0, 0, 0, 4.0]


def test_odometry_is_that_of_the_aircraft_itself():
    message = on_wire("nav_msgs/Odometry", ros1_bridge.odometry(0, aircraft(), FRAMES))
    assert (message.header.frame_id, message.child_frame_id) == ("drone1/odom", "drone1/ardrone_base_link")
    assert message.pose.pose.position.z == pytest.approx(1.234)
    assert (message.twist.twist.linear.x, message.twist.twist.linear.y) == (1.0, 0.25)


def test_ground_truth_is_in_the_world_frame():
    truth = flight_messages.Truth(
        T_NS, 0, (1.0, 2.0, 3.0), (0.0, 4.0, 0.0), attitude(yaw_deg=90.0), (1.0, 0.0, 0.5), ZERO, STILL
    )  # fmt: skip
    message = ros1_bridge.ground_truth(0, truth, FRAMES)
    assert message.header.frame_id == "world"
    assert xyz(message.pose.pose.position) == (1.0, 2.0, 3.0)
    assert xyz(message.twist.twist.linear) == (0.0, 4.0, 0.0)
    assert xyz(message.twist.twist.angular) == pytest.approx(
        (0.0, 1.0, 0.5)
    )  # a roll about the nose, which points north


def test_transforms_lead_from_the_world_to_the_estimated_pose():
    own = aircraft(yaw_deg=30.0)
    own.update(estimate(attitude(yaw_deg=30.0)))
    to_base, to_odom = on_wire("tf2_msgs/TFMessage", ros1_bridge.transforms(0, own, FRAMES)).transforms
    assert (to_odom.header.frame_id, to_odom.child_frame_id) == ("world", "drone1/odom")
    assert (to_base.header.frame_id, to_base.child_frame_id) == ("drone1/odom", "drone1/ardrone_base_link")
    place = [xyz(t.transform.translation) for t in (to_odom, to_base)]
    assert np.sum(place, axis=0) == pytest.approx([5.0, 6.0, 7.0])


def test_transforms_without_an_estimator_end_at_odom():
    (only,) = ros1_bridge.transforms(0, without_sensors(), FRAMES).transforms
    assert only.header.frame_id == "drone1/odom"


# Commands


def twist(*, x: float = 0.0, y: float = 0.0, z: float = 0.0, wx: float = 0.0, wy: float = 0.0, wz: float = 0.0) -> Any:
    return wire.message_class("geometry_msgs/Twist")(linear=Vector3(x, y, z), angular=Vector3(wx, wy, wz))


class Pilot:
    """The commands of a drone, and the messages that they send."""

    def __init__(self, state: Any = "flying", gate: int = 0) -> None:
        self.sent: list[tuple[str, Any]] = []
        self.commands = DriverCommands("drone1", "ros1.main", lambda key, message: self.sent.append((key, message)))
        self.gates(state, gate, 1)

    def gates(self, state: Any, first: int, count: int) -> list[Any]:
        """Let a number of gates pass; return the messages sent meanwhile."""
        self.sent.clear()
        for gate in range(first, first + count):
            self.commands.on_status(flight_messages.Status(gate * GATE_NS, gate, state, 100.0, False, None, 1))
        return [message for _, message in self.sent]


@pytest.mark.parametrize(
    ("components", "expected"),
    [
        ({"x": 0.1, "y": 0.2, "z": 0.3, "wz": 0.4}, TiltCommand(0.1, 0.2, 0.3, 0.4, False)),
        ({"x": 3.0, "y": -7.0, "z": 1.5, "wz": -1.5}, TiltCommand(1.0, -1.0, 1.0, -1.0, False)),
        ({}, TiltCommand(0.0, 0.0, 0.0, 0.0, True)),
        ({"x": 9e-7}, TiltCommand(9e-7, 0.0, 0.0, 0.0, True)),
        ({"x": 2e-6}, TiltCommand(2e-6, 0.0, 0.0, 0.0, False)),
        ({"wx": 1.0}, TiltCommand(0.0, 0.0, 0.0, 0.0, False)),  # a tilt rate does nothing but switch hovering off
        ({"wy": -0.5}, TiltCommand(0.0, 0.0, 0.0, 0.0, False)),
    ],
)
def test_a_cmd_vel_is_a_share_of_tilt_climb_and_turn_or_hovering(components, expected):
    assert tilt_of(twist(**components)) == expected


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("component", ["x", "y", "z", "wx", "wy", "wz"])
def test_a_non_finite_value_is_refused(component, number):
    pilot = Pilot()
    with pytest.raises(ValueError, match="cmd_vel"):
        pilot.commands.on_cmd_vel(twist(**{component: number}))
    assert pilot.gates("flying", 1, 50) == []


def test_a_cmd_vel_holds_until_the_next():
    pilot = Pilot()
    assert pilot.gates("flying", 0, 1) == []  # nothing is sent before a node publishes
    pilot.commands.on_cmd_vel(twist(x=0.5))
    sent = pilot.gates("flying", 1, 101)
    assert [m.t_ns // GATE_NS for m in sent] == list(range(1, 102, REPEAT_NS // GATE_NS))
    assert {(m.forward, m.hover) for m in sent} == {(0.5, False)}
    assert [m.seq for m in sent] == list(range(len(sent)))
    pilot.commands.on_cmd_vel(twist(x=0.7))
    pilot.commands.on_cmd_vel(twist())
    assert {(m.forward, m.hover) for m in pilot.gates("flying", 102, 20)} == {(0.0, True)}


def test_a_cmd_vel_during_take_off_is_flown_from_the_hover_on():
    pilot = Pilot("taking_off")
    pilot.commands.on_cmd_vel(twist(z=0.5))
    assert pilot.gates("taking_off", 1, 10) == []
    assert [m.up for m in pilot.gates("hovering", 11, 1)] == [0.5]


@pytest.mark.parametrize("state", ["landing", "landed", "emergency"])
def test_a_drone_that_has_come_down_forgets_its_cmd_vel(state):
    pilot = Pilot()
    pilot.commands.on_cmd_vel(twist(x=1.0))
    assert pilot.gates("flying", 1, 1) != []
    assert pilot.gates(state, 2, 10) == []
    pilot.commands.on_cmd_vel(twist(x=1.0))
    assert pilot.gates("hovering", 12, 10) == []


def test_modes_are_sent_in_the_name_of_the_bridge():
    pilot = Pilot("landed", 7)
    pilot.commands.send_mode("takeoff")
    pilot.commands.send_mode("land")
    assert [(key, m.mode, m.seq, m.t_ns, m.source) for key, m in pilot.sent] == [
        ("drone/drone1/cmd/mode", "takeoff", 0, 7 * GATE_NS, "ros1.main"),
        ("drone/drone1/cmd/mode", "land", 1, 7 * GATE_NS, "ros1.main"),
    ]


@pytest.mark.parametrize(("state", "mode"), [("flying", "emergency"), ("landed", "emergency"), ("emergency", "reset")])
def test_reset_toggles_the_emergency(state, mode):
    pilot = Pilot(state)
    pilot.commands.reset()
    assert pilot.sent[-1][1].mode == mode


def test_only_a_landed_drone_is_trimmed():
    assert "not there" in (DriverCommands("drone1", "ros1.main", lambda *_: None).trim_refusal() or "")
    assert has_terms(Pilot("flying").commands.trim_refusal() or "", "landed")
    assert Pilot("landed").commands.trim_refusal() is None
