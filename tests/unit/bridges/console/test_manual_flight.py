"""Drones flown from pages: permission, commands and their timing, the geofence, lost pages, and return flights."""

import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from refused import has_terms

from zsim.contract.flight_messages import ViewCluster
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Piloted
from zsim.vehicles.vehicle import Limits
from zsim_agents.references.cruise import Course
from zsim_agents.references.path import SHARE, PathLimits
from zsim_bridges.console.manual_flight import (
    PAGE_TIMEOUT_S,
    PERIOD_S,
    RATE_MAX,
    SETTLED_S,
    STALE_S,
    DronePose,
    DroneStatus,
    FlightAnswer,
    Geofence,
    ManualFlight,
    ReturnFlights,
    RunStatus,
    Stick,
    geofence_of,
    stick_velocity,
)
from zsim_bridges.console.orders import NoAnswer

NAME = "console.1"
ACCEL_M_S2, LAW = 2.5, Piloted()
FORWARD = Stick(1.0, 0.0, 0.0, 0.0, 1.0)
STILL = (0.0, 0.0, 0.0)
PAGE, OTHER = "page", "other"


class Client:
    """A command client that records what is sent, and answers at once unless the test holds the answers back."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, tuple[float, float, float]]] = []
        self.taken: list[str] = []
        self.released: list[str] = []
        self.refusal = ""
        self.waiting: list[Callable[[str], None]] | None = None
        self.modes = 0

    def take(self, drone: str, done: Callable[[str], None]) -> None:
        self.taken.append(drone)
        if self.waiting is None:
            done(self.refusal)
        else:
            self.waiting.append(done)

    def release_drone(self, drone: str) -> None:
        self.released.append(drone)

    def send_velocity(self, drone: str, velocity_m_s: tuple[float, float, float], yaw_rate_rad_s: float) -> None:
        self.sent.append((drone, velocity_m_s))

    def modes_requested(self, drone: str) -> int:
        return self.modes


class Cockpit:
    """Two hovering drones, seen and flown from pages, on a clock that only the test advances."""

    def __init__(self) -> None:
        self.client = Client()
        self.now_s = 100.0
        self.run = RunStatus()
        pose = DronePose((0.0, 0.0, 5.0), 0.0)
        self.sights = {name: DroneStatus("hovering", None, pose) for name in ("drone1", "drone2")}
        limits = dict.fromkeys(self.sights, Limits())
        fence = Geofence((-50.0, -50.0, 1.0), (50.0, 50.0, 30.0))
        client: Any = self.client
        courses = {drone: Course(PathLimits(5.0, 1.0, 1.0, ACCEL_M_S2 / SHARE), LAW) for drone in self.sights}
        self.control = ManualFlight(
            client, NAME, limits, courses, fence, 0.02, self.sight, lambda: self.run, lambda: self.now_s
        )

    def sight(self, drone: str) -> DroneStatus:
        """Return the current sight of a drone."""
        seen = self.sights[drone]
        return seen if seen.pose is None else seen._replace(pose=seen.pose._replace(t_s=self.now_s))

    def see(self, drone: str, **changes: Any) -> None:
        self.sights[drone] = self.sights[drone]._replace(**changes)

    def after(self, seconds: float) -> list[tuple[float, float, float]]:
        """Advance the time period by period and return the velocities sent meanwhile."""
        before = len(self.client.sent)
        for _ in range(round(seconds / PERIOD_S)):
            self.now_s += PERIOD_S
            self.control.tick()
        return [velocity for _, velocity in self.client.sent[before:]]

    def flying(self) -> "Cockpit":
        assert self.control.take(PAGE, "drone2", take_over=False).state == "flying"
        self.see("drone2", commander=NAME)
        return self


@pytest.fixture
def cockpit() -> Cockpit:
    return Cockpit()


@pytest.fixture
def flown() -> Cockpit:
    return Cockpit().flying()


def test_a_free_drone_is_flown_while_the_stick_is_held(flown: Cockpit):
    assert flown.client.taken == ["drone2"]
    flown.control.steer(PAGE, FORWARD)
    assert flown.after(STALE_S / 2) == [pytest.approx((1.0, 0.0, 0.0))] * 5
    assert flown.control.steer(PAGE, None).text == "hovers"
    flown.control.tick()
    assert flown.client.sent[-1] == ("drone2", STILL)  # at once, not with the next command
    assert flown.after(1.0) == [STILL] * 20  # and repeatedly, because firmware that receives nothing lands
    assert {drone for drone, _ in flown.client.sent} == {"drone2"}


def test_the_drone_of_a_silent_page_hovers_and_is_released(flown: Cockpit):
    flown.control.steer(PAGE, FORWARD)
    velocities = flown.after(STALE_S + 0.5)
    assert velocities[-1] == STILL
    assert velocities.count(STILL) == pytest.approx(10, abs=1)
    flown.after(PAGE_TIMEOUT_S)
    assert flown.client.released == ["drone2"]
    assert flown.control.answer(PAGE).state == "none"
    assert flown.after(1.0) == []


def test_after_a_lost_connection_the_same_request_regains_the_drone(cockpit: Cockpit):
    assert cockpit.control.take(PAGE, "drone2", False, "one").state == "flying"
    cockpit.see("drone2", commander=NAME)
    cockpit.control.steer(PAGE, FORWARD)
    cockpit.after(0.1)
    cockpit.control.lose(PAGE)
    cockpit.control.tick()
    assert cockpit.client.sent[-1] == ("drone2", STILL)
    assert cockpit.control.take(OTHER, "drone2", False, "one").state == "flying"
    assert cockpit.control.answer(PAGE).state == "none"
    cockpit.control.lose(OTHER)
    assert set(cockpit.after(PAGE_TIMEOUT_S + 1.0)) == {STILL}
    assert cockpit.client.released == ["drone2"]


def test_a_drone_of_a_formation_must_be_taken_over_to_be_flown(cockpit: Cockpit):
    cockpit.see("drone2", commander="controller.main")
    refused = cockpit.control.take(PAGE, "drone2", take_over=False)
    assert (refused.state, refused.over) == ("none", True)
    assert has_terms(refused.text, "drone2", "controller.main")
    assert cockpit.client.taken == []
    assert cockpit.control.steer(PAGE, FORWARD).state == "none"
    assert cockpit.after(1.0) == []
    cockpit.client.refusal = "drone2: flown by 'console.2' with priority 10"
    answer = cockpit.control.take(PAGE, "drone2", take_over=True)  # the world refuses it
    assert (answer.state, answer.text) == ("none", cockpit.client.refusal)
    assert cockpit.after(1.0) == []
    cockpit.client.refusal = ""
    assert cockpit.control.take(PAGE, "drone2", take_over=True).state == "flying"


@pytest.mark.parametrize(
    ("sight", "run", "terms"),
    [
        ({"state": "landed"}, {}, ("drone2", "landed", "hovering")),
        ({"state": ""}, {}, ("drone2",)),
        ({}, {"refusal": "a record is played back"}, ("record",)),
        ({}, {"rate": 12.0}, ("12.0", "5")),
    ],
    ids=["landed", "unseen", "replay", "too fast"],
)
def test_a_drone_that_cannot_be_flown_is_refused_with_the_reason(
    sight: dict, run: dict, terms: tuple[str, ...], cockpit: Cockpit
):
    cockpit.see("drone2", **sight)
    cockpit.run = RunStatus(**run)
    answer = cockpit.control.take(PAGE, "drone2", take_over=True)
    assert (answer.state, answer.over) == ("none", False)
    assert has_terms(answer.text, *terms)
    assert cockpit.client.taken == []


def test_a_repeated_request_is_carried_out_once(cockpit: Cockpit):
    cockpit.client.waiting = []
    for _ in range(3):
        assert cockpit.control.take(PAGE, "drone2", True, "one").state == "taking"
    assert cockpit.client.taken == ["drone2"]
    cockpit.client.waiting[0]("")
    cockpit.see("drone2", commander=NAME)
    assert cockpit.control.take(PAGE, "drone2", True, "one").state == "flying"
    cockpit.control.leave(PAGE)
    again = cockpit.control.take(PAGE, "drone2", True, "one")  # a late repetition has no effect
    assert (again.state, again.id) == ("none", "one")
    assert cockpit.client.taken == ["drone2"]


def test_a_request_is_repeated_once_a_silent_world_returns(cockpit: Cockpit):
    cockpit.client.waiting = []
    cockpit.control.take(PAGE, "drone2", True, "one")
    cockpit.run = RunStatus(silence="the world has not answered for 5 s")
    cockpit.client.waiting.pop()(NoAnswer("no answer came within 5 s"))
    for _ in range(3):
        cockpit.after(2.0)
        cockpit.control.take(PAGE, "drone2", True, "one")  # the page is still connected
    waits = cockpit.control.answer(PAGE)
    assert waits.state == "taking"
    assert has_terms(waits.text, "6.0 s", "not confirmed", "world", "5 s")
    assert cockpit.client.taken == ["drone2"]
    cockpit.run = RunStatus()
    cockpit.after(PERIOD_S)
    assert cockpit.client.taken == ["drone2"] * 2
    cockpit.client.waiting.pop()("")
    assert cockpit.control.answer(PAGE).state == "flying"


def test_a_stall_of_the_console_is_given_as_the_reason_for_a_release(flown: Cockpit):
    flown.control.steer(PAGE, FORWARD)
    flown.after(0.5)
    flown.now_s += 29.0
    flown.control.tick()
    assert has_terms(flown.control.answer(PAGE).text, "console", "29 s")


def test_a_drone_is_flown_from_one_page_and_a_page_flies_one_drone(flown: Cockpit):
    assert has_terms(flown.control.take(OTHER, "drone2", take_over=True).text, "drone2", "another page")
    assert flown.control.take(PAGE, "drone1", take_over=False).state == "flying"
    flown.control.tick()
    assert flown.client.released == ["drone2"]


def test_a_drone_left_before_the_answer_is_released_again_after_it(cockpit: Cockpit):
    cockpit.client.waiting = []
    assert cockpit.control.take(PAGE, "drone2", take_over=False).state == "taking"
    assert cockpit.after(0.5) == []
    cockpit.control.leave(PAGE)
    cockpit.control.tick()
    cockpit.client.waiting[0]("")
    cockpit.control.tick()
    assert cockpit.client.released == ["drone2"] * 2
    assert cockpit.control.answer(PAGE).state == "none"


@pytest.mark.parametrize("end", ["landing", "mode", "commander", "silent"])
def test_the_end_of_a_flight_releases_the_drone_and_gives_the_reason(end: str, flown: Cockpit):
    flown.control.steer(PAGE, None)
    flown.after(SETTLED_S + PERIOD_S)
    flown.control.steer(PAGE, FORWARD)
    if end == "landing":
        flown.see("drone2", state="landing")
    elif end == "mode":
        flown.client.modes += 1
    elif end == "commander":
        flown.see("drone2", commander="console.2")
    else:
        flown.run = RunStatus(refusal="the world has not answered for 2 s")
    assert flown.after(2 * PERIOD_S) == []
    assert flown.client.released == ["drone2"]
    answer = flown.control.answer(PAGE)
    assert answer.state == "none"
    assert answer.text


def test_a_flight_ends_above_twice_the_limit_of_the_rate_and_states_the_true_rate(flown: Cockpit):
    flown.run = RunStatus(rate=2.0 * RATE_MAX)
    flown.after(PERIOD_S)
    assert flown.control.answer(PAGE).state == "flying"
    flown.run = RunStatus(rate=12.0)
    flown.after(PERIOD_S)
    assert has_terms(flown.control.answer(PAGE).text, "12.0 ×", f"{RATE_MAX:g} or less")


def test_a_command_that_arrives_after_the_release_causes_another_release(flown: Cockpit):
    """Commanding a free drone makes the sender its commander, and the world lands the drone of a silent commander."""
    flown.control.leave(PAGE)
    flown.after(PERIOD_S)
    assert flown.client.released == ["drone2"]
    flown.after(SETTLED_S + PERIOD_S)
    assert flown.client.released == ["drone2"] * 2
    flown.see("drone2", commander=None)
    flown.after(3 * SETTLED_S)
    assert flown.client.released == ["drone2"] * 2


def test_a_paused_run_gets_no_commands_and_a_slow_one_a_command_per_gate(flown: Cockpit):
    flown.run = RunStatus(is_paused=True)
    assert flown.after(1.0) == []
    flown.run = RunStatus(rate=0.1)  # one gate of 20 ms every 0.2 s
    flown.control.steer(PAGE, None)
    assert 7 <= len(flown.after(2.0)) <= 10


def test_a_drone_flies_to_a_place_until_the_stick_is_used(flown: Cockpit):
    flown.see("drone2", pose=DronePose((0.0, 0.0, 4.0), math.pi / 2))
    assert flown.control.go(PAGE, 3.0, 0.0, 7.0).goal == (3.0, 0.0, 7.0)  # a confirmed altitude
    assert flown.after(PERIOD_S)[0][2] > 0.0
    answer = flown.control.go(PAGE, 0.0, 20.0)
    assert answer.state == "flying"
    assert has_terms(answer.text, "0.0", "20.0", "4.0")
    first = flown.after(PERIOD_S)[0]
    for _ in range(3):
        flown.control.steer(PAGE, None)
        flown.after(0.4)
    flown.control.steer(PAGE, None)
    last = flown.after(PERIOD_S)[0]
    # From rest, the path's velocity one lead of the law ahead; as the drone does not move, it rises to the cruise.
    assert first == pytest.approx((ACCEL_M_S2 * LAW.lead_s, 0.0, 0.0), abs=0.05)
    assert last == pytest.approx((1.5, 0.0, 0.0), abs=0.02)
    flown.control.steer(PAGE, None)  # the page is alive but its dead-man key is not held
    assert flown.after(0.1)[-1] != STILL
    flown.control.steer(PAGE, FORWARD)
    flown.control.steer(PAGE, None)
    assert set(flown.after(0.2)) == {STILL}


def test_places_are_visited_in_order_and_a_repeated_one_counts_once(flown: Cockpit):
    flown.control.go(PAGE, 10.0, 0.0, 5.0)
    flown.control.go(PAGE, 10.0, 10.0, 5.0, append=True)
    answer = flown.control.go(PAGE, 10.0, 10.0, 5.0, append=True)
    assert (answer.goal, answer.then) == ((10.0, 0.0, 5.0), ((10.0, 10.0, 5.0),))
    assert flown.after(PERIOD_S)[0][1] == pytest.approx(0.0, abs=1e-9)
    flown.see("drone2", pose=DronePose((9.7, 0.0, 5.0), 0.0))
    assert flown.after(2 * PERIOD_S)[-1][1] > 0.5
    answer = flown.control.answer(PAGE)
    assert (answer.goal, answer.then) == ((10.0, 10.0, 5.0), ())
    flown.see("drone2", pose=DronePose((10.0, 10.0, 5.0), 0.0))
    flown.after(PERIOD_S)
    assert flown.control.answer(PAGE).goal == (10.0, 10.0, 5.0)  # the drone stays there
    flown.control.steer(PAGE, FORWARD)
    assert flown.control.answer(PAGE).goal is None


def test_a_place_outside_the_geofence_or_without_an_estimate_is_refused(flown: Cockpit):
    assert has_terms(flown.control.go(PAGE, 80.0, 0.0).text, "x", "80.0", "50")
    flown.see("drone2", pose=None)
    assert has_terms(flown.control.go(PAGE, 8.0, 0.0).text, "drone2")
    flown.control.steer(PAGE, FORWARD)
    assert set(flown.after(0.2)) == {STILL}


def test_drones_are_released_when_the_run_is_left(flown: Cockpit):
    with flown.control.running():
        pass
    assert flown.client.released == ["drone2"]


FENCE = Geofence((-50.0, -50.0, 1.0), (50.0, 50.0, 30.0))
LIMITS = Limits(horizontal_speed_m_s=2.0, vertical_speed_m_s=0.5, yaw_rate_deg_s=30.0)
MIDDLE = DronePose((0.0, 0.0, 5.0), math.pi / 2)
deflections = st.floats(-1.0, 1.0)


def test_the_geofence_surrounds_all_starts_and_confines_drones():
    drones = [
        {"name": "one", "position_m": [0, 10, 0]},
        {"name": "two", "position_m": [-20, 0, 0], "limits": {"altitude_m": 12}},
    ]
    fence = geofence_of(scenario_file.resolve({"name": "t", "duration_s": 1, "drones": drones}, "t.yaml"))
    assert fence == Geofence((-70.0, -50.0, 1.0), (50.0, 60.0, 12.0))

    assert FENCE.refusal(50.0, -50.0) == ""
    assert has_terms(FENCE.refusal(50.1, 0.0), "x", "50.1", "-50", "50")
    assert has_terms(FENCE.refusal(0.0, -60.0), "y", "-60.0", "-50", "50")

    assert FENCE.limit_velocity((2.0, -2.0, 1.0), (49.5, 0.0, 30.0)) == (0.5, -2.0, 0.0)
    assert FENCE.limit_velocity((2.0, 0.0, -1.0), (60.0, 0.0, 0.5)) == (0.0, 0.0, 0.0)
    assert FENCE.limit_velocity((-2.0, 0.0, 1.0), (60.0, 0.0, 0.5)) == (-2.0, 0.0, 1.0)


@given(deflections, deflections, deflections, deflections, st.floats(0.0, 100.0), st.floats(-4.0, 4.0))
def test_a_stick_never_exceeds_the_limits_of_the_drone(
    forward: float, left: float, up: float, turn: float, speed: float, yaw: float
):
    pose = DronePose((0.0, 0.0, 15.0), yaw)
    flown = stick_velocity(Stick(forward, left, up, turn, speed), pose, LIMITS, FENCE)
    x, y, z = flown.velocity_m_s
    assert math.hypot(x, y) <= min(speed, 2.0) + 1e-9
    assert abs(z) <= 0.5
    assert abs(flown.yaw_rate_rad_s) <= math.radians(30.0)


def test_a_velocity_is_in_the_heading_frame_and_within_the_geofence():
    flown = stick_velocity(Stick(1.0, 0.0, 0.0, 0.5, 1.5), MIDDLE, LIMITS, FENCE)
    assert flown.velocity_m_s == pytest.approx((1.5, 0.0, 0.0))
    assert flown.yaw_rate_rad_s == pytest.approx(math.radians(15.0))

    # The drone faces north at the northern fence: nothing remains of forward, all of left.
    flown = stick_velocity(Stick(1.0, 1.0, 0.0, 0.0, 1.0), DronePose((0.0, 50.0, 5.0), math.pi / 2), LIMITS, FENCE)
    assert flown.velocity_m_s == pytest.approx((0.0, math.sqrt(0.5), 0.0), abs=1e-9)


SCENARIO = scenario_file.load(Path(__file__).parents[4] / "scenarios" / "step.yaml")
NAMES = ("x_c", "y_c", "z_c")


class Returns:
    """Return flights in a run that the test simulates."""

    def __init__(self) -> None:
        self.said: list[Any] = []
        self.notes: list[tuple[str, str]] = []
        self.requests: Counter[str] = Counter()
        self.answer = FlightAnswer("drone1", "taking")
        self.is_sent = False
        self.sight = DroneStatus("flying", "console.1", DronePose((5.0, 5.0, 10.0), 0.0))
        self.view = ViewCluster(0, 0, "engaged", NAMES, (5.0, -5.0, 15.0), (5.0, -5.0, 15.0), "")
        client: Any = SimpleNamespace(
            request_cluster=self._request, cluster_requests=self.requests,
            send_mode=lambda drones, mode: self.said.append((mode, drones)),
        )  # fmt: skip
        control: Any = SimpleNamespace(
            take=lambda page, drone, take_over: self.answer, steer=lambda page, stick: self.answer,
            leave=lambda page: self.said.append("leave"), go=self._go, has_waypoints=lambda page: self.is_sent,
        )  # fmt: skip
        self.flights = ReturnFlights(
            SCENARIO,
            client,
            control,
            lambda _: self.sight,
            lambda: {"main": self.view},
            lambda *n: self.notes.append(n),
        )

    def _request(self, cluster: str, op: str, **args: Any) -> None:
        self.requests[cluster] += 1
        self.said.append((op, args))

    def _go(self, page: Any, x_m: float, y_m: float) -> None:
        self.is_sent = True
        self.said.append(("go", x_m, y_m))

    def tick(self) -> list[Any]:
        self.said.clear()
        self.flights.tick()
        return list(self.said)

    def fly_to(self, x_m: float, y_m: float, desired: tuple[float, float] | None = None) -> None:
        value = (x_m, y_m, 15.0)
        goal = value if desired is None else (*desired, 15.0)
        self.view = ViewCluster(0, 0, "engaged", NAMES, value, goal, "")


@pytest.fixture
def returns() -> Returns:
    return Returns()


def test_a_returning_drone_flies_above_its_start_and_lands_there(returns: Returns):
    returns.flights.request_drones(["drone1"])
    assert returns.tick() == []  # the drone is still being acquired
    returns.answer = FlightAnswer("drone1", "flying")
    assert returns.tick() == [("go", 0.0, 1.5)]
    assert returns.tick() == []
    returns.sight = DroneStatus("flying", "console.1", DronePose((0.2, 1.3, 10.0), 0.0))
    assert returns.tick() == ["leave", ("land", ["drone1"])]
    assert returns.tick() == []
    assert returns.notes == []


def test_a_returning_drone_taken_by_another_process_does_not_land(returns: Returns):
    returns.flights.request_drones(["drone1"])
    returns.answer = FlightAnswer("drone1", "none", "drone1 is flown by driver.x now")
    assert returns.tick() == []
    assert [subject for subject, _ in returns.notes] == ["drone1"]
    returns.sight = DroneStatus("flying", "driver.x", DronePose((0.0, 1.5, 10.0), 0.0))
    assert returns.tick() == []


def test_a_refused_return_is_reported_with_the_reason(returns: Returns):
    returns.answer = FlightAnswer("drone1", "none", "drone1 is landed")
    returns.flights.request_drones(["drone1"])
    assert returns.notes == [("drone1", "drone1 is landed")]
    assert returns.tick() == []


def test_a_returning_formation_lands_at_the_centre_of_its_starts(returns: Returns):
    returns.flights.request_formation("main")
    assert returns.said == [("target", {"values": {"x_c": 0.0, "y_c": -0.5}})]
    assert returns.tick() == []
    returns.fly_to(0.0, -0.5, desired=(2.0, -2.0))  # it only passes through
    assert returns.tick() == []
    returns.fly_to(0.1, -0.4, desired=(0.0, -0.5))
    assert returns.tick() == [("land", {})]
    assert returns.tick() == []


@pytest.mark.parametrize("how", ["request", "elsewhere", "held", "refused"])
def test_a_formation_that_no_longer_returns_does_not_land(returns: Returns, how: str):
    returns.flights.request_formation("main")
    returns.fly_to(1.0, -1.0)
    assert returns.tick() == []
    if how == "request":
        returns.requests["main"] += 1
    elif how == "elsewhere":
        returns.fly_to(4.0, -4.0)
    elif how == "held":
        returns.view = ViewCluster(0, 0, "held", NAMES, (0.0, -0.5, 15.0), (0.0, -0.5, 15.0), "")
    else:
        returns.flights.refused("main")
    assert returns.tick() == []
    returns.fly_to(0.0, -0.5)
    assert returns.tick() == []
    assert bool(returns.notes) == (how in ("elsewhere", "held"))
