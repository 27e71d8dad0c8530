"""A session with a fake PX4 or ArduPilot autopilot: flights, take-overs, link figures, axes and units of readings."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
from fake_autopilot import ARDUPILOT, HOLD, IN_AIR, LAND, LANDING, PX4, STEP_NS, FakeAutopilot
from scipy.spatial.transform import Rotation

from zsim.math.frames import heading
from zsim_bridges.mavlink import dialect
from zsim_bridges.mavlink.autopilot_session import AutopilotSession, TelemetryReadings
from zsim_bridges.mavlink.dialect import Link, Parser, Signing
from zsim_bridges.vehicle_links.vehicle_session import AircraftPose, Demand, UdpChannel

ORIGIN = (-34.603, -58.368, 25.0)
S = 1_000_000_000
KEY = bytes(range(32))
AUTOPILOTS = pytest.mark.parametrize("autopilot", [PX4, ARDUPILOT])


class Loop:
    """A session and its vehicle, connected without delay."""

    def __init__(self, autopilot: int, height_m: float = 2.0) -> None:
        self.vehicle = FakeAutopilot(autopilot)
        self.session = AutopilotSession(UdpChannel("127.0.0.1", 1), ORIGIN, height_m)
        self.now_ns = 100 * S
        self.sent: list[Any] = []
        self.cut = False
        self._parser = Parser()

    def run(self, seconds: float, demand: Demand = Demand("none")) -> None:  # noqa: B008
        for _ in range(round(seconds * S / STEP_NS)):
            self.now_ns += STEP_NS
            for datagram in self.vehicle.step(self.now_ns):
                if not self.cut:
                    self.session.receive(0, datagram, self.now_ns)
            for _, datagram in self.session.advance(self.now_ns, demand):
                self.sent += [received.message for received in self._parser.feed(datagram)]
                if not self.cut:
                    self.vehicle.receive(datagram, self.now_ns)

    @property
    def pose(self) -> AircraftPose:
        assert self.session.state.pose is not None
        return self.session.state.pose

    def until(self, state: str, demand: Demand, within_s: float = 20.0) -> None:
        for _ in range(round(within_s / 0.1)):
            self.run(0.1, demand)
            if self.session.state.state == state:
                return
        pytest.fail(f"it is {self.session.state.state} after {within_s} s; must be {state}")


@AUTOPILOTS
def test_a_flight_runs_from_take_off_to_landing(autopilot: int):
    loop = Loop(autopilot)
    loop.run(1)
    assert loop.session.state.state == "landed"
    assert loop.session.state.battery_percent == 77
    loop.until("taking_off", Demand("take_off"))
    loop.until("hovering", Demand("take_off"))
    assert loop.pose.position_m[2] > 1.6
    loop.run(2, Demand("hold"))
    assert loop.session.state.state == "hovering"
    loop.run(4, Demand("fly", (1.0, 0.5, 0.25), 0.3))
    assert loop.session.state.state == "flying"
    assert loop.pose.velocity_m_s == pytest.approx((1.0, 0.5, 0.25), abs=0.01)
    last = loop.vehicle.setpoints[-1]
    assert (last.vx, last.vy, last.vz, last.yaw_rate) == pytest.approx((0.5, 1.0, -0.25, -0.3))
    loop.until("landing", Demand("land"))
    loop.until("landed", Demand("land"))


@AUTOPILOTS
def test_nothing_that_moves_the_vehicle_is_sent_without_a_demand(autopilot: int):
    loop = Loop(autopilot)
    loop.run(20)
    kinds = {type(message) for message in loop.sent}
    assert kinds <= {dialect.Heartbeat, dialect.Timesync, dialect.CommandLong}
    assert {m.command for m in loop.sent if isinstance(m, dialect.CommandLong)} <= {511, 512}


@AUTOPILOTS
def test_a_lost_command_is_sent_again(autopilot: int):
    loop = Loop(autopilot)
    loop.run(1)
    loop.cut = True
    loop.run(2, Demand("take_off"))
    loop.cut = False
    loop.until("hovering", Demand("take_off"))


@AUTOPILOTS
def test_after_a_pilot_takes_over_nothing_is_sent_until_the_next_take_off(autopilot: int):
    loop = Loop(autopilot)
    loop.until("hovering", Demand("take_off"))
    loop.run(2, Demand("hold"))
    loop.vehicle.mode = 3 << 16 if autopilot == PX4 else 5  # the modes POSITION and LOITER
    loop.run(1, Demand("hold"))
    loop.sent.clear()
    loop.run(5, Demand("fly", (1.0, 0.0, 0.0)))
    loop.run(5, Demand("land"))
    assert not any(isinstance(message, dialect.SetPositionTargetLocalNed) for message in loop.sent)
    assert {m.command for m in loop.sent if isinstance(m, dialect.CommandLong)} <= {511, 512}
    assert sum("control" in text for text in loop.session.texts) == 1
    loop.run(1, Demand("kill"))
    assert not loop.vehicle.armed
    loop.vehicle.position[2] = 0.0
    loop.until("hovering", Demand("take_off"))
    loop.run(3, Demand("fly", (1.0, 0.0, 0.0)))
    assert loop.pose.velocity_m_s[0] == pytest.approx(1.0, abs=0.01)


@AUTOPILOTS
@pytest.mark.parametrize("landed", [IN_AIR, LANDING])
def test_a_landing_commanded_elsewhere_is_not_overridden(autopilot: int, landed: int):
    """This holds even before the landed state shows the landing."""
    loop = Loop(autopilot)
    loop.until("hovering", Demand("take_off"))
    loop.run(2, Demand("hold"))
    loop.vehicle.mode, loop.vehicle.landed = LAND if autopilot == PX4 else 9, landed
    loop.run(0.3, Demand("hold"))
    loop.sent.clear()
    loop.run(2, Demand("fly", (1.0, 0.0, 0.0)))
    assert loop.vehicle.mode in (LAND, 9)
    assert not any(isinstance(message, dialect.SetPositionTargetLocalNed) for message in loop.sent)
    assert sum("control" in text for text in loop.session.texts) == 1


@AUTOPILOTS
def test_a_demanded_landing_is_not_a_take_over(autopilot: int):
    loop = Loop(autopilot)
    loop.until("hovering", Demand("take_off"))
    loop.run(2, Demand("hold"))
    loop.run(0.1, Demand("land"))
    loop.vehicle.mode = LAND if autopilot == PX4 else 9
    loop.until("landed", Demand("land"))
    assert not any("control" in text for text in loop.session.texts)


def test_an_autopilot_that_fell_back_to_hold_returns_to_offboard():
    loop = Loop(PX4)
    loop.until("hovering", Demand("take_off"))
    loop.run(2, Demand("hold"))
    loop.cut = True
    loop.vehicle.mode = HOLD
    loop.run(2, Demand("fly", (1.0, 0.0, 0.0)))
    loop.cut = False
    loop.run(3, Demand("fly", (1.0, 0.0, 0.0)))
    assert loop.pose.velocity_m_s[0] == pytest.approx(1.0, abs=0.01)


def test_kill_is_repeated_until_the_motors_stop():
    loop = Loop(PX4)
    loop.until("hovering", Demand("take_off"))
    loop.sent.clear()
    loop.cut = True
    loop.run(1, Demand("kill"))
    kills = [m for m in loop.sent if isinstance(m, dialect.CommandLong) and m.command == 400]
    assert len(kills) == 5
    assert {(m.param1, m.param2) for m in kills} == {(0, 21196)}
    loop.cut = False
    loop.run(1, Demand("kill"))
    assert not loop.vehicle.armed


def test_a_changed_setpoint_is_sent_at_once_and_the_current_one_repeated():
    loop = Loop(PX4)
    loop.until("hovering", Demand("take_off"))
    loop.run(1, Demand("hold"))
    first, second = Demand("fly", (1.0, 0.0, 0.0)), Demand("fly", (1.1, 0.0, 0.0))
    sent = [list(loop.session.advance(loop.now_ns + k * STEP_NS, demand)) for k, demand in ((1, first), (2, second))]
    assert [len(datagrams) for datagrams in sent] == [1, 1]
    assert list(loop.session.advance(loop.now_ns + 2 * STEP_NS + 5_000_000, second)) == []
    count = len(loop.vehicle.setpoints)
    loop.run(2, first)
    assert len(loop.vehicle.setpoints) - count >= 49


def test_the_first_or_the_requested_autopilot_is_accepted_and_no_other():
    loop = Loop(PX4)
    loop.run(1)
    stranger = Link(9, 1)
    loop.session.receive(0, stranger.pack(dialect.Heartbeat(2, PX4, 128, 0, 4, 3)), loop.now_ns)
    loop.session.receive(0, stranger.pack(dialect.LocalPositionNed(0, 50.0)), loop.now_ns)
    assert loop.session.link_quality().refused == 2
    assert loop.pose.position_m[1] == pytest.approx(0.0)
    assert sum("system 9" in text for text in loop.session.texts) == 1
    session = AutopilotSession(UdpChannel("127.0.0.1", 1), ORIGIN, 2.0, system=3)
    for system in (1, 3):
        session.receive(0, Link(system, 1).pack(dialect.Heartbeat(2, PX4, 0, 0, 3, 3)), 0)
    assert session.link_quality().refused == 1
    assert session.state.received_ns == 0


@pytest.mark.parametrize(("key", "flies"), [(KEY, True), (bytes(32), False)], ids=["the same key", "another"])
def test_with_a_key_both_sides_must_sign(key: bytes, flies: bool):
    now_s = 1.8e9
    signing = Signing(KEY)
    signing.advance(now_s)
    loop = Loop(PX4)
    loop.vehicle = FakeAutopilot(PX4, signing=signing)
    loop.session = AutopilotSession(UdpChannel("127.0.0.1", 1), ORIGIN, 2.0, key=key, unix_s=lambda: now_s)
    loop._parser = Parser(Signing(key))
    loop.run(8, Demand("take_off"))
    assert (loop.session.state.state == "hovering") is flies
    assert (loop.session.link_quality().refused > 100) is not flies


def test_message_loss_round_trip_and_clock_offset_are_measured():
    loop = Loop(PX4)
    loop.run(5)
    quality = loop.session.link_quality()
    assert quality.loss_percent == 0
    assert quality.round_trip_ms == pytest.approx(20, abs=1)
    assert quality.clock_offset_ms == pytest.approx(7000, abs=11)
    draw = np.random.default_rng(1)
    for _ in range(200):
        loop.now_ns += STEP_NS
        for datagram in loop.vehicle.step(loop.now_ns):
            if draw.random() > 0.1:
                loop.session.receive(0, datagram, loop.now_ns)
    assert loop.session.link_quality().loss_percent == pytest.approx(10, abs=4)


def test_garbage_is_counted_and_changes_nothing():
    loop = Loop(PX4)
    loop.run(1)
    before, draw = loop.session.state, np.random.default_rng(2)
    for length in itertools.islice(itertools.cycle((1, 8, 40, 300)), 400):
        loop.session.receive(0, b"\xfd" + draw.bytes(length), loop.now_ns)
    assert loop.session.state == before
    assert loop.session.link_quality().refused >= 400


# Axes and units


def telemetry(*messages: Any) -> TelemetryReadings:
    made = TelemetryReadings(ORIGIN)
    for message in messages:
        made.receive(message, 50 * S)
    return made


@pytest.mark.parametrize("seed", range(5))
def test_attitudes_agree_with_the_rotations_of_scipy(seed: int):
    q_NF = Rotation.random(rng=np.random.default_rng(seed))
    x, y, z, w = q_NF.as_quat()
    ned_to_enu = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    flu_to_frd = Rotation.from_matrix(np.diag([1, -1, -1]))
    expected = (ned_to_enu * q_NF * flu_to_frd).as_matrix()
    turned = dialect.attitude_ned((w, x, y, z))
    found = Rotation.from_quat([*turned[1:], turned[0]]).as_matrix()
    assert found == pytest.approx(expected, abs=1e-12)
    assert np.abs(dialect.attitude_ned(turned)) == pytest.approx(np.abs([w, x, y, z]), abs=1e-12)


def test_vectors_and_headings_are_converted_between_frames():
    assert dialect.ned((1, 2, 3)) == (2, 1, -3)
    assert dialect.frd((1, 2, 3)) == (1, -2, -3)
    assert dialect.yaw_ned(math.pi / 2) == pytest.approx(0.0)
    assert dialect.yaw_ned(dialect.yaw_ned(0.7)) == pytest.approx(0.7)


def test_a_pose_in_w_accounts_for_the_origin_of_the_vehicle():
    origin = dialect.GpsGlobalOrigin(-345930000, -583680000, 35000)  # 0.01 deg north, 10 m higher
    north = dialect.AttitudeQuaternion(0, 1.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3)
    made = telemetry(origin, north, dialect.LocalPositionNed(0, 1.0, 2.0, -3.0, 0.5, 0.25, -0.125)).pose
    assert made is not None
    assert made.position_m == pytest.approx((2.0, 1 + 1109.4, 13.0), abs=0.3)
    assert made.velocity_m_s == (0.25, 0.5, 0.125)
    assert float(heading(made.q_WB)) == pytest.approx(math.pi / 2)
    assert made.w_WB_B == pytest.approx((0.1, -0.2, -0.3))


READINGS: dict[str, tuple[Any, str, tuple]] = {
    "imu": (
        dialect.HighresImu(5, 1, 2, -9.8, 0.1, 0.2, 0.3, fields_updated=0x3F),
        "imu",
        ((1, -2, 9.8), (0.1, -0.2, -0.3)),
    ),
    "mag": (dialect.HighresImu(5, xmag=0.1, ymag=0.2, zmag=0.3, fields_updated=0x1C0), "mag", ((10, -20, -30),)),
    "baro": (dialect.ScaledPressure(5, 1013.25), "baro", (101325, 0)),
    "imu of ArduPilot": (dialect.ScaledImu(5, 0, 0, -1000, 100, 0, 0), "imu", ((0, 0, 9.80665), (0.1, 0, 0))),
    "flow": (dialect.OpticalFlow(5, flow_comp_m_x=1, flow_comp_m_y=2, quality=255), "flow", ((1, -2, 0), 1)),
    "sonar": (dialect.DistanceSensor(5, 20, 600, 150, orientation=25), "sonar", (1.5, True)),
    "sonar too far": (dialect.DistanceSensor(5, 20, 600, 700, orientation=25), "sonar", (7.0, False)),
    "gps": (
        dialect.GpsRawInt(5, 3, -346030000, -583680000, 25000, 0, 0, 200, 9000, 8, 25000, h_acc=1500),
        "gps",
        (-34.603, -58.368, 25.0, (0, 0, 0), (2, 0, 0), 1.5, 3, 8),
    ),
}


@pytest.mark.parametrize("name", READINGS)
def test_readings_are_converted_to_si_units_and_body_axes(name: str):
    message, sensor, expected = READINGS[name]
    (reading,) = telemetry(message).readings
    assert reading.sensor == sensor
    for found, wanted in zip(reading.values, expected, strict=True):
        assert found == pytest.approx(wanted, abs=1e-4)


@pytest.mark.parametrize(
    "message",
    [
        dialect.LocalPositionNed(0, math.nan),
        dialect.HighresImu(5, xacc=math.inf, fields_updated=0x3F),
        dialect.VfrHud(),  # a message that is not used
    ],
)
def test_invalid_and_unused_messages_give_no_reading(message: Any):
    made = TelemetryReadings(ORIGIN)
    made.receive(message, 0)
    assert made.readings == []
    assert made.pose is None
