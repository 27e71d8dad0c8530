"""The session of an AR.Drone: configuration, flight by velocities, landing, and no command without a demand."""

import math

import numpy as np
import pytest
from fake_aircraft import FIELD_UT, STEP_NS, FakeAircraft

from zsim.math.frames import heading
from zsim_bridges.ardrone.aircraft_session import AircraftSession, NavdataReadings
from zsim_bridges.ardrone.navdata import ControlState, StateBit
from zsim_bridges.vehicle_links.vehicle_session import AircraftPose, Demand

ORIGIN = (-34.603, -58.368, 25.0)
S = 1_000_000_000


class Loop:
    """A session and its aircraft, which receives the session's datagrams after a delay."""

    def __init__(self, delay_s: float = 0.0, yaw: float = 1.0, ultrasound: int = 8) -> None:
        self.aircraft = FakeAircraft(yaw)
        readings = NavdataReadings(ORIGIN, (0.0, 0.0, 0.0), FIELD_UT)
        self.session = AircraftSession("127.0.0.2", readings, ultrasound)
        self.now_ns = 100 * S
        self._delay_ns = round(delay_s * S)
        self._under_way: list[tuple[int, int, bytes]] = []
        self.cut = False

    def run(self, seconds: float, demand: Demand = Demand("none")) -> None:  # noqa: B008
        for _ in range(round(seconds * S / STEP_NS)):
            self.now_ns += STEP_NS
            packet = self.aircraft.step(self.now_ns)
            if packet and not self.cut:
                self.session.receive(0, packet, self.now_ns)
            self._under_way += [(self.now_ns, *each) for each in self.session.advance(self.now_ns, demand)]
            while self._under_way and self._under_way[0][0] + self._delay_ns <= self.now_ns:
                _, channel, datagram = self._under_way.pop(0)
                if not self.cut:
                    self.aircraft.receive(channel, datagram)

    @property
    def pose(self) -> AircraftPose:
        assert self.session.state.pose is not None
        return self.session.state.pose

    def until(self, state: str, demand: Demand, within_s: float = 10.0) -> None:
        for _ in range(round(within_s / 0.1)):
            self.run(0.1, demand)
            if self.session.state.state == state:
                return
        pytest.fail(f"it is {self.session.state.state} after {within_s} s; must be {state}")


def test_the_aircraft_is_configured_entry_by_entry():
    loop = Loop(ultrasound=7)
    loop.run(5)
    assert loop.aircraft.config["pic:ultrasound_freq"] == "7"
    assert loop.aircraft.config["general:navdata_demo"] == "FALSE"
    assert int(loop.aircraft.config["general:navdata_options"]) >> 27 & 1
    assert list(loop.aircraft.config).index("control:outdoor") < list(loop.aircraft.config).index(
        "control:euler_angle_max"
    )
    assert len(loop.aircraft.config) == 8
    assert set(loop.aircraft.names) == {"Config", "Control", "ResetWatchdog"}  # no command that moves it


def test_the_aircraft_is_configured_again_after_a_restart():
    loop = Loop()
    loop.run(5)
    loop.until("hovering", Demand("take_off"))
    loop.aircraft, loop.aircraft.has_client = FakeAircraft(), True
    loop.run(0.1)
    assert loop.session.state.state == "landed"
    loop.run(5)
    assert len(loop.aircraft.config) == 8
    assert loop.session.state.received_ns == loop.now_ns


def test_an_aircraft_in_an_unknown_state_is_on_the_ground_only_if_it_says_so():
    loop = Loop()
    loop.run(5)
    for bits, state in ((StateBit.FLYING, "flying"), (0, "landed")):
        loop.aircraft.state, loop.aircraft.bits = ControlState.TEST, bits
        loop.run(0.1)
        assert loop.session.state.state == state


@pytest.mark.parametrize("yaw", [1.0, -2.5])
def test_a_flight_from_take_off_to_landing_follows_its_demands(yaw: float):
    loop = Loop(delay_s=0.1, yaw=yaw)
    loop.run(5)
    assert (loop.session.state.state, loop.session.state.battery_percent) == ("landed", 66)
    loop.until("hovering", Demand("take_off"))
    loop.aircraft.wind_m_s2 = (0.6, -0.4)
    demand = Demand("fly", (1.0, 0.5, 0.2), 0.3)
    loop.run(12, demand)
    speeds = []
    for _ in range(50):
        loop.run(0.1, demand)
        speeds.append(tuple(loop.aircraft.velocity))
    assert loop.session.state.state == "flying"
    assert np.mean(speeds, axis=0) == pytest.approx((1.0, 0.5, 0.2), abs=0.05)
    assert np.std(speeds, axis=0).max() < 0.05
    pose = loop.pose
    assert pose.velocity_m_s == pytest.approx(loop.aircraft.velocity, abs=0.02)
    assert pose.position_m == pytest.approx(loop.aircraft.position, abs=0.3)
    assert math.remainder(float(heading(pose.q_WB)) - loop.aircraft.yaw, 2 * math.pi) == pytest.approx(0, abs=0.02)
    loop.until("landing", Demand("land"))
    loop.until("landed", Demand("land"), 30)


def test_the_velocity_responds_with_little_overshoot():
    loop = Loop(delay_s=0.15)
    loop.run(5)
    loop.until("hovering", Demand("take_off"))
    most = 0.0
    for _ in range(400):
        loop.run(0.02, Demand("fly", (1.0, 0.0, 0.0)))
        most = max(most, loop.aircraft.velocity[0])
    assert most < 1.2
    assert loop.aircraft.velocity[0] == pytest.approx(1.0, abs=0.03)


def test_kill_stops_the_motors_and_reset_ends_the_emergency():
    loop = Loop()
    loop.run(5)
    loop.until("hovering", Demand("take_off"))
    loop.until("emergency", Demand("kill"), 1)
    loop.run(2, Demand("kill"))
    assert loop.session.state.state == "emergency"
    loop.run(1, Demand("take_off"))
    assert loop.session.state.state == "emergency"
    loop.until("landed", Demand("reset"), 1)
    loop.until("hovering", Demand("take_off"))


def test_a_repeated_kill_does_not_undo_itself_on_a_slow_link():
    loop = Loop(delay_s=0.2)
    loop.run(8)
    loop.until("hovering", Demand("take_off"))
    loop.until("emergency", Demand("kill"), 1)
    for _ in range(20):
        loop.run(0.1, Demand("kill"))
        assert loop.session.state.state == "emergency"


def test_readings_have_zsim_s_units_and_axes():
    loop = Loop(yaw=0.0)
    loop.run(6)
    newest = {reading.sensor: reading.values for reading in loop.session.readings.take()}
    accel, gyro = newest["imu"]
    assert accel == pytest.approx((0.0, 0.0, 9.80665))
    assert gyro[:2] == pytest.approx((math.radians(1), math.radians(-2)))
    assert newest["mag"][0] == pytest.approx(FIELD_UT, abs=0.2)
    assert newest["baro"] == pytest.approx((100_000, 0))
    assert newest["gps"][3] == pytest.approx((0, 0, 0), abs=1e-3)
    assert newest["gps"][5:] == (2.0, 3, 9)
    assert loop.session.readings.take() == []


def test_a_slow_sensor_is_read_only_when_its_value_changes():
    loop = Loop()
    loop.run(10)
    count = {"imu": 0, "gps": 0, "mag": 0}
    for reading in loop.session.readings.take():
        if reading.sensor in count:
            count[reading.sensor] += 1
    assert count["imu"] > 1500
    assert count["gps"] == count["mag"] == 1  # the aircraft stands still: nothing changes


def test_loss_is_measured_and_garbage_is_counted():
    loop = Loop()
    loop.run(5)
    draw = np.random.default_rng(4)
    for _ in range(1000):
        loop.now_ns += STEP_NS
        sent = loop.aircraft.step(loop.now_ns)
        if sent and draw.random() > 0.05:
            loop.session.receive(0, sent, loop.now_ns)
    before = loop.session.state
    packet = loop.aircraft.step(loop.now_ns) or b""
    for _ in range(300):
        cut = packet[: draw.integers(1, len(packet))]
        flipped = bytearray(packet)
        flipped[draw.integers(4, len(packet) - 8)] ^= 1 << draw.integers(8)
        loop.session.receive(0, cut, loop.now_ns)
        loop.session.receive(0, bytes(flipped), loop.now_ns)
        loop.session.receive(0, draw.bytes(50), loop.now_ns)
    quality = loop.session.link_quality()
    assert quality.loss_percent == pytest.approx(5, abs=2)
    assert quality.refused == 900
    assert quality.clock_offset_ms == pytest.approx(3000, abs=10)
    assert loop.session.state == before
