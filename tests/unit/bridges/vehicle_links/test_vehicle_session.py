"""The failsafe: nothing moves unasked, silence holds and lands, a fence is kept; the aircraft's clock, loss, readings."""

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
    """A failsafe, its aircraft, and the time."""

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
        """Let time pass; return what is asked of the aircraft then."""
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


def test_nothing_is_asked_before_it_is_armed():
    flight = Flight(armed=False)
    assert "arm" in (flight.mode("takeoff") or "")
    assert "arm" in (flight.fly(1, 0, 0) or "")
    assert flight.after(1) == "none"
    flight.state = "flying"  # by its own pilot
    assert flight.after(1) == "none"
    assert flight.failsafe.arm(flight.now_ns, flight.vehicle) is None
    assert flight.after(0.1) == "hold"


def test_it_is_not_armed_without_a_link():
    flight = Flight(armed=False)
    assert flight.failsafe.arm(flight.now_ns, AircraftState())
    assert flight.failsafe.arm(flight.now_ns, flight.vehicle._replace(received_ns=flight.now_ns - 2 * S))
    assert not flight.failsafe.armed


def test_a_flight():
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


def test_the_heading_frame_is_turned_by_the_aircrafts_own_yaw():
    flight = Flight().takes_off()
    flight.yaw = math.pi / 2
    flight.fly(1, 0, 0.2, frame="heading")
    assert flight.failsafe.demand(flight.now_ns, flight.vehicle).velocity_m_s == pytest.approx((0, 1, 0.2))


def test_a_silent_commander_holds_and_then_lands():
    flight = Flight().takes_off()
    flight.fly(1, 0, 0)
    assert flight.after(0.4) == "fly"
    assert flight.after(0.3) == "hold"
    flight.fly(1, 0, 0)
    assert flight.after(0.1) == "fly"
    assert flight.after(2.0) == "hold"
    assert flight.after(0.6) == "land"
    assert "controller.main" in flight.failsafe.reason


def test_a_drone_that_nobody_flies_holds_for_ever():
    assert Flight().takes_off().after(60) == "hold"


def test_a_silent_world_is_a_landing():
    flight = Flight().takes_off()
    flight.hears_clock = False
    assert flight.after(2.0) == "hold"
    assert flight.after(1.0) == "land"
    assert "world" in flight.failsafe.reason


@pytest.mark.parametrize("landing", ["its own", "the driver's"])
def test_who_came_down_without_a_command_is_not_started_by_one_until_it_is_armed_again(landing: str):
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


def test_outside_the_fence_it_lands():
    flight = Flight().takes_off()
    flight.position = (9.99, 0, 1)
    flight.fly(1, 0, 0)
    assert flight.failsafe.demand(flight.now_ns, flight.vehicle).velocity_m_s[0] < 0.2
    flight.position = (11.5, 0, 1)
    assert flight.after(0.1) == "land"


def test_a_takeoff_is_watched_as_a_flight():
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
def test_an_aircraft_in_an_emergency_of_its_own_is_sent_nothing_more(airborne: bool):
    """Else the repeated take-off would start it again as soon as the emergency is over."""
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


def test_an_emergency_of_its_own_is_left_by_reset_which_is_given_up():
    flight = Flight(armed=False, state="emergency")
    assert flight.mode("reset") is None
    assert flight.after(RESET_S - 0.1) == "reset"
    assert flight.after(0.2) == "none"


def test_an_aircraft_that_lands_by_itself_is_landed_and_disarmed():
    flight = Flight().takes_off()
    flight.fly(1, 0, 0)
    flight.state = "landing"
    assert flight.after(0.1) == "land"
    flight.state = "landed"
    assert flight.after(2) == "none"
    assert not flight.failsafe.armed


def test_to_a_silent_aircraft_nothing_but_a_landing_or_a_stop_is_sent():
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


def test_a_driver_that_begins_in_flight_holds():
    flight = Flight(state="flying")
    assert flight.after(0.1) == "hold"
    flight.fly(0, 1, 0)
    assert flight.after(0.1) == "fly"


def test_kill_stops_the_motors_armed_or_not_until_it_is_armed_again():
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
def test_an_accepted_emergency_stops_the_motors_armed_or_not_and_disarms(armed: bool):
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


def test_it_is_disarmed_on_the_ground_alone():
    flight = Flight().takes_off()
    assert "land" in (flight.failsafe.disarm(flight.vehicle) or "")
    flight.state = "landed"
    assert flight.failsafe.disarm(flight.vehicle) is None
    assert flight.after(1) == "none"


def test_a_takeoff_that_does_not_succeed_is_given_up():
    flight = Flight()
    flight.mode("takeoff")
    assert flight.after(TAKEOFF_S - 1) == "take_off"
    assert flight.after(1.5) == "land"
    assert flight.after(2) == "none"


def test_a_drone_that_is_released_holds():
    flight = Flight().takes_off()
    flight.fly(1, 0, 0)
    hover = Ardrone(0, 0, "world", 0, 0, 0, 0, hover=True)
    assert flight.failsafe.on_command(hover, flight.now_ns, flight.vehicle) is None
    assert flight.after(60) == "hold"
    assert flight.failsafe.commander is None


def test_what_a_driver_does_not_take_is_refused_with_what_it_does():
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


MS = 1_000_000


def test_the_least_delayed_message_counts():
    offset, draw = ClockOffset(), random.Random(1)
    for k in range(500):
        sent_ns = k * 20 * MS
        offset.add(sent_ns - 7_000 * MS, sent_ns + round(draw.expovariate(1 / (5 * MS))))
    assert 0 <= offset.offset_ns - 7_000 * MS < 0.2 * MS
    assert offset.to_remote(123 + offset.offset_ns) == 123


def test_a_clock_that_is_set_is_followed_within_a_window():
    offset = ClockOffset()
    offset.add(0, 10 * MS)
    offset.add(100 * MS, 10_110 * MS)
    assert offset.offset_ns == 10_010 * MS


def test_half_a_round_trip_is_the_way_of_the_fastest():
    offset = ClockOffset()
    offset.add(0, 30 * MS)
    for duration_ms in (50, 20, 40):
        offset.add_round_trip(duration_ms * MS, 100 * MS)
    assert offset.round_trip_ms == 20
    assert offset.offset_ns == 20 * MS


@pytest.mark.parametrize("known", [False, True])
def test_it_is_known_from_the_first_message_on(known: bool):
    offset = ClockOffset()
    if known:
        offset.add(5, 5)
    assert (offset.ahead_ms is not None) is known
    assert offset.offset_ns == 0


def test_the_share_that_is_lost_is_counted_over_the_wrap():
    draw, loss = random.Random(3), StreamLoss(256)
    for number in range(4000):
        if draw.random() > 0.1:
            loss.add(number % 256)
    assert loss.percent == pytest.approx(10, abs=2.5)
    assert not loss.add(3999 % 256)
