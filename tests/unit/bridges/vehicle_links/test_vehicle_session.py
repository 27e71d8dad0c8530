"""The failsafe (arming, silence, the geofence), and the measurement of the aircraft's clock and of message loss."""

import math
import random
from typing import Any

import pytest

from zsim.contract.flight_messages import Ardrone, Mode, Velocity
from zsim.math.frames import quaternion_from_heading
from zsim.scenario.scenario import Silence
from zsim_bridges.vehicle_links.vehicle_session import (
    BRAKING_M_S2,
    RESET_S,
    TAKEOFF_S,
    AircraftPose,
    AircraftState,
    ClockOffset,
    Failsafe,
    FlightLimits,
    StreamLoss,
)

S = 1_000_000_000
LIMITS = FlightLimits(speed_m_s=2.0, radius_m=10.0)


class Flight:
    """A failsafe and its aircraft, with the time."""

    def __init__(self, armed: bool = True, state: Any = "landed") -> None:
        self.failsafe = Failsafe(Silence(), LIMITS, armed)
        self.now_ns = 100 * S
        self.position, self.yaw = (0.0, 0.0, 1.0), 0.0
        self.state: Any = state
        self.hears_clock = True
        self.received_ns: int | None = None  # None: now

    @property
    def vehicle(self) -> AircraftState:
        w, x, y, z = quaternion_from_heading(self.yaw).tolist()
        pose = AircraftPose(self.now_ns, self.position, q_WB=(w, x, y, z))
        return AircraftState(self.state, 90.0, pose, self.received_ns or self.now_ns)

    def after(self, seconds: float) -> str:
        """Advance the time and return the action then demanded of the aircraft."""
        until_ns = self.now_ns + round(seconds * S)
        action = ""
        while self.now_ns < until_ns:
            self.now_ns += S // 50
            if self.hears_clock:
                self.failsafe.on_clock(self.now_ns)
            action = self.failsafe.demand(self.now_ns, self.vehicle).action
        return action

    def mode(self, mode: Any) -> str | None:
        return self.failsafe.on_command(Mode(0, 0, "controller.main", mode), self.now_ns, self.vehicle)

    def fly(self, *velocity: float, yaw_rate: float = 0.0, frame: Any = "world") -> str | None:
        x, y, z = velocity
        command = Velocity(0, 0, "controller.main", (x, y, z), yaw_rate, frame)
        return self.failsafe.on_command(command, self.now_ns, self.vehicle)

    def takes_off(self) -> "Flight":
        assert self.mode("takeoff") is None
        assert self.after(1) == "take_off"
        self.state = "hovering"
        assert self.after(0.1) == "hold"
        return self


def test_nothing_is_demanded_before_arming():
    flight = Flight(armed=False)
    assert "arm" in (flight.mode("takeoff") or "")
    assert "arm" in (flight.fly(1, 0, 0) or "")
    assert flight.after(1) == "none"
    flight.state = "flying"  # flown by its own pilot
    assert flight.after(1) == "none"
    assert flight.failsafe.arm(flight.now_ns, flight.vehicle) is None
    assert flight.after(0.1) == "hold"


def test_arming_is_refused_without_a_link():
    flight = Flight(armed=False)
    assert flight.failsafe.arm(flight.now_ns, AircraftState())
    assert flight.failsafe.arm(flight.now_ns, flight.vehicle._replace(received_ns=flight.now_ns - 2 * S))
    assert not flight.failsafe.armed


def test_a_commanded_flight_runs_from_take_off_to_landing():
    flight = Flight().takes_off()
    flight.fly(1, 0, 0, yaw_rate=0.5)
    demand = flight.failsafe.demand(flight.now_ns, flight.vehicle)
    assert (demand.action, demand.velocity_m_s, demand.yaw_rate_rad_s) == ("fly", (1, 0, 0), 0.5)
    assert flight.failsafe.commander == "controller.main"
    flight.mode("land")
    assert flight.after(2) == "land"
    flight.fly(1, 0, 0)
    assert flight.after(0.1) == "land"
    flight.state = "landed"
    assert flight.after(2) == "none"
    assert flight.failsafe.armed


def test_the_heading_frame_is_turned_by_the_yaw_of_the_aircraft():
    flight = Flight().takes_off()
    flight.yaw = math.pi / 2
    flight.fly(1, 0, 0.2, frame="heading")
    assert flight.failsafe.demand(flight.now_ns, flight.vehicle).velocity_m_s == pytest.approx((0, 1, 0.2))


def test_a_drone_with_a_silent_commander_holds_and_then_lands():
    flight = Flight().takes_off()
    flight.fly(1, 0, 0)
    assert flight.after(0.4) == "fly"
    assert flight.after(0.3) == "hold"
    flight.fly(1, 0, 0)
    assert flight.after(0.1) == "fly"
    assert flight.after(2.0) == "hold"
    assert flight.after(0.6) == "land"
    assert "controller.main" in flight.failsafe.reason


def test_an_uncommanded_drone_holds_indefinitely():
    assert Flight().takes_off().after(60) == "hold"


def test_a_silent_world_causes_a_landing():
    flight = Flight().takes_off()
    flight.hears_clock = False
    assert flight.after(2.0) == "hold"
    assert flight.after(1.0) == "land"
    assert "world" in flight.failsafe.reason


@pytest.mark.parametrize("landing", ["its own", "the driver's"])
def test_after_an_uncommanded_landing_take_off_needs_arming_again(landing: str):
    flight = Flight().takes_off()
    flight.after(2)
    flight.fly(1, 0, 0)
    if landing == "the driver's":
        assert flight.after(3) == "land"
    flight.state = "landed"
    assert flight.after(2) == "none"
    assert not flight.failsafe.armed
    assert flight.mode("takeoff")
    assert flight.after(1) == "none"
    assert flight.failsafe.arm(flight.now_ns, flight.vehicle) is None
    flight.takes_off()
    flight.mode("land")
    flight.after(2)
    flight.state = "landed"
    assert flight.after(2) == "none"
    assert flight.failsafe.armed


def test_an_aircraft_outside_the_geofence_is_landed():
    flight = Flight().takes_off()
    flight.position = (9.99, 0, 1)
    flight.fly(1, 0, 0)
    assert flight.failsafe.demand(flight.now_ns, flight.vehicle).velocity_m_s[0] < 0.2
    flight.position = (11.5, 0, 1)
    assert flight.after(0.1) == "land"


def test_a_take_off_is_monitored_like_a_flight():
    flight = Flight()
    flight.position = (11.5, 0, 0)
    assert flight.mode("takeoff")
    flight.position = (0, 0, 0)
    assert flight.mode("takeoff") is None
    assert flight.after(1) == "take_off"
    flight.position = (11.5, 0, 1)
    assert flight.after(0.1) == "land"
    other = Flight()
    other.mode("takeoff")
    other.hears_clock = False
    assert other.after(2.0) == "take_off"
    assert other.after(1.0) == "land"


@pytest.mark.parametrize("airborne", [True, False])
def test_an_aircraft_in_its_own_emergency_is_sent_nothing_more(airborne: bool):
    """Otherwise the repeated take-off would restart the aircraft as soon as its emergency is over."""
    flight = Flight()
    flight.mode("takeoff")
    flight.state = "hovering" if airborne else "taking_off"
    flight.after(0.1)
    flight.state = "emergency"
    assert flight.after(0.1) == "none"
    flight.state = "landed"
    assert flight.mode("takeoff")
    assert flight.after(1) == "none"
    assert not flight.failsafe.armed


def test_a_reset_of_an_own_emergency_is_repeated_until_given_up():
    flight = Flight(armed=False, state="emergency")
    assert flight.mode("reset") is None
    assert flight.after(RESET_S - 0.1) == "reset"
    assert flight.after(0.2) == "none"


def test_an_aircraft_that_lands_by_itself_is_told_to_land_and_disarmed():
    flight = Flight().takes_off()
    flight.fly(1, 0, 0)
    flight.state = "landing"
    assert flight.after(0.1) == "land"
    flight.state = "landed"
    assert flight.after(2) == "none"
    assert not flight.failsafe.armed


def test_a_silent_aircraft_is_sent_only_land_or_kill():
    flight = Flight().takes_off()
    flight.fly(1, 0, 0)
    flight.received_ns = flight.now_ns
    assert flight.after(0.4) == "fly"
    assert flight.after(0.8) == "none"
    flight.received_ns = None
    flight.fly(1, 0, 0)
    assert flight.after(0.1) == "fly"
    flight.received_ns = flight.now_ns
    flight.mode("land")
    assert flight.after(2) == "land"
    flight.mode("emergency")
    assert flight.after(2) == "kill"


def test_a_driver_that_starts_in_flight_holds():
    flight = Flight(state="flying")
    assert flight.after(0.1) == "hold"
    flight.fly(0, 1, 0)
    assert flight.after(0.1) == "fly"


def test_kill_stops_the_motors_until_the_driver_is_armed_again():
    for armed in (True, False):
        flight = Flight(armed=armed, state="flying")
        flight.failsafe.kill(flight.now_ns, "operator")
        assert flight.after(5) == "kill"
        flight.state = "landed"
        assert flight.after(5) == "kill"
        assert flight.mode("takeoff")
        assert flight.failsafe.arm(flight.now_ns, flight.vehicle) is None
        assert flight.after(0.1) == "none"


@pytest.mark.parametrize("armed", [True, False])
def test_an_accepted_emergency_stops_the_motors_and_disarms(armed: bool):
    flight = Flight(armed=armed, state="flying")
    assert flight.mode("emergency") is None
    assert flight.after(1) == "kill"
    assert "controller.main" in flight.failsafe.reason
    assert flight.mode("reset")  # its motors still turn
    assert flight.after(0.1) == "kill"
    flight.state = "emergency"
    assert flight.mode("reset") is None
    assert flight.after(0.1) == "reset"
    flight.state = "landed"
    assert flight.after(0.1) == "none"
    assert flight.mode("takeoff")
    assert flight.failsafe.arm(flight.now_ns, flight.vehicle) is None
    flight.takes_off()


def test_disarming_is_possible_only_on_the_ground():
    flight = Flight().takes_off()
    assert "land" in (flight.failsafe.disarm(flight.vehicle) or "")
    flight.state = "landed"
    assert flight.failsafe.disarm(flight.vehicle) is None
    assert flight.after(1) == "none"


def test_a_take_off_that_does_not_succeed_is_abandoned():
    flight = Flight()
    flight.mode("takeoff")
    assert flight.after(TAKEOFF_S - 1) == "take_off"
    assert flight.after(1.5) == "land"
    assert flight.after(2) == "none"


def test_a_released_drone_holds():
    flight = Flight().takes_off()
    flight.fly(1, 0, 0)
    hover = Ardrone(0, 0, "world", 0, 0, 0, 0, hover=True)
    assert flight.failsafe.on_command(hover, flight.now_ns, flight.vehicle) is None
    assert flight.after(60) == "hold"
    assert flight.failsafe.commander is None


def test_unsupported_commands_are_refused_with_the_supported_ones():
    flight = Flight().takes_off()
    command = Ardrone(0, 0, "controller.main", 0, 0, 0, 0)
    assert "velocity" in (flight.failsafe.on_command(command, flight.now_ns, flight.vehicle) or "")
    assert "landed" in (flight.mode("takeoff") or "")


# Limits

FENCED = FlightLimits(speed_m_s=3.0, climb_m_s=1.0, radius_m=20.0, ceiling_m=10.0)


@pytest.mark.parametrize(
    ("asked", "expected"),
    [((6, 8, 0), (1.8, 2.4, 0)), ((0, 0, 9), (0, 0, 1)), ((0, 0, -9), (0, 0, -1)), ((1, 0, 0.5), (1, 0, 0.5))],
)
def test_speeds_are_limited_without_changing_direction(asked, expected):
    assert FENCED.limited(asked, (0, 0, 2)) == pytest.approx(expected)
    assert FENCED.limited(asked, None) == pytest.approx(expected)


def test_the_limits_keep_an_aircraft_inside_the_geofence_and_let_it_return():
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


def test_motion_along_the_geofence_is_not_limited():
    assert FENCED.limited((0, 2, 0), (20, 0, 2)) == pytest.approx((0, 2, 0))


def test_the_speed_allows_stopping_before_the_geofence():
    for distance in (0.5, 2.0, 4.0):
        x, *_ = FENCED.limited((3, 0, 0), (20 - distance, 0, 2))
        assert x * x / (2 * BRAKING_M_S2) <= distance + 1e-9


def test_a_geofence_breach_has_a_tolerance():
    assert not FENCED.is_breached((20.5, 0, 5))
    assert FENCED.is_breached((0, 21.5, 5))
    assert FENCED.is_breached((0, 0, 11.5))
    assert not FlightLimits().is_breached((1e6, 0, 1e6))
    assert FENCED.yaw_rate(-9) == -FENCED.yaw_rate_rad_s


MS = 1_000_000


def test_the_clock_offset_follows_the_least_delayed_message():
    offset, draw = ClockOffset(), random.Random(1)
    for k in range(500):
        sent_ns = k * 20 * MS
        offset.add(sent_ns - 7_000 * MS, sent_ns + round(draw.expovariate(1 / (5 * MS))))
    assert 0 <= offset.offset_ns - 7_000 * MS < 0.2 * MS
    assert offset.to_remote(123 + offset.offset_ns) == 123


def test_a_step_of_the_remote_clock_is_followed_within_a_window():
    offset = ClockOffset()
    offset.add(0, 10 * MS)
    offset.add(100 * MS, 10_110 * MS)
    assert offset.offset_ns == 10_010 * MS


def test_the_latency_is_half_the_shortest_round_trip():
    offset = ClockOffset()
    offset.add(0, 30 * MS)
    for duration_ms in (50, 20, 40):
        offset.add_round_trip(duration_ms * MS, 100 * MS)
    assert offset.round_trip_ms == 20
    assert offset.offset_ns == 20 * MS


@pytest.mark.parametrize("known", [False, True])
def test_the_clock_offset_is_known_from_the_first_message(known: bool):
    offset = ClockOffset()
    if known:
        offset.add(5, 5)
    assert (offset.ahead_ms is not None) is known
    assert offset.offset_ns == 0


def test_message_loss_is_measured_across_the_sequence_wrap():
    draw, loss = random.Random(3), StreamLoss(256)
    for number in range(4000):
        if draw.random() > 0.1:
            loss.add(number % 256)
    assert loss.percent == pytest.approx(10, abs=2.5)
    assert not loss.add(3999 % 256)
