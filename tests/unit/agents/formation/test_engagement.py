"""The phase machine of the engagement with ideal drones: phases, refusals, faults in flight, plans."""

import copy
import math
from functools import cache

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refused import has_terms, refused

from zsim.contract.snapshot import pack, unpack
from zsim_agents.formation import guidance
from zsim_agents.formation.control_law import ProportionalLaw
from zsim_agents.formation.engagement import Engagement
from zsim_agents.formation.flight_check import GateInput, GateOutput
from zsim_agents.formation.flight_plan import Follow, MoveTo, Order, RequestError, Scheduled, read_request
from zsim_agents.formation.spaces.cluster_space import closest_pair
from zsim_agents.formation.spaces.scenario_space import cluster_space
from zsim_agents.formation.spaces.template_cluster import TemplateCluster

SPACE = cluster_space(3)
DRONES = ("drone1", "drone2", "drone3")
GROUND = np.array([(0.0, 1.5, 0.0), (-1.5, -1.5, 0.0), (1.5, -1.5, 0.0)])  # take-off positions, m
GATE_S = 0.02
PAPER_3 = {
    "x_c": 5, "y_c": -5, "z_c": 15, "roll": 0, "pitch": 0, "yaw": math.pi / 2,
    "phi_1": 0, "phi_2": 0, "phi_3": 0, "p": 4, "q": 4, "beta": math.pi / 4,
}  # fmt: skip
PAPER_4 = {
    "x_c": "5*cos(2*pi*f*t)", "y_c": "-5*(1 + 1/2*sin(4*pi*f*t))", "z_c": "15 + 5/2*(1 - cos(3*pi*f*t))",
    "yaw": "0.1*t", "p": "4", "q": "4", "beta": "pi/4",
}  # fmt: skip


class Fleet:
    """Drones that follow velocity commands one gate late, take off in 2 s and land at 1 m/s."""

    def __init__(self, engagement, noise_m=0.0, p_W=GROUND):
        self.engagement = engagement
        self.rng = np.random.default_rng(7)
        self.noise_m = noise_m
        self.p_W, self.yaw = p_W.copy(), np.zeros(len(p_W))
        self.v_W, self.yaw_rate = np.zeros_like(p_W), np.zeros(len(p_W))
        self.states = ["landed"] * len(p_W)
        self.gate = 0
        self.spoil = {}  # fields that replace those of the next inputs, to inject faults
        self.modes, self.closest_m, self._output = [], math.inf, None

    @property
    def t_s(self):
        return self.gate * GATE_S

    @property
    def output(self) -> GateOutput:
        assert self._output is not None, "no gate was flown yet"
        return self._output

    def fly(self, seconds):
        """Advance and return the outputs of all gates."""
        return [self.step() for _ in range(round(seconds / GATE_S))]

    def fly_until(self, phase, limit_s=60.0):
        for _ in range(round(limit_s / GATE_S)):
            if self.step().phase == phase:
                return self.output
        raise AssertionError(f"phase {phase} not reached: {self.output.phase}, {self.output.reason}")

    def step(self):
        output = self._output = self.engagement.step(self._input())
        self._move()
        for drone, mode in output.modes:
            self.modes.append((self.t_s, drone, mode))
            self.states[self.engagement.drones.index(drone)] = "taking_off" if mode == "takeoff" else "landing"
        for i, setpoint in enumerate(output.setpoints):
            self.v_W[i], self.yaw_rate[i] = (setpoint.v_W, setpoint.yaw_rate) if setpoint else (0.0, 0.0)
        self.gate += 1
        return output

    def _input(self):
        n = len(self.p_W)
        gate = GateInput(
            t_s=self.t_s,
            p_W=self.p_W + self.rng.normal(scale=self.noise_m, size=(n, 3)) if self.noise_m else self.p_W.copy(),
            yaw=self.yaw.copy(),
            v_W=self.v_W.copy(),
            sigma_m=np.full((n, 3), 0.2),
            yaw_sigma=np.full(n, 0.05),
            age_s=np.zeros(n),
            states=tuple(self.states),
        )
        return msgspec.structs.replace(gate, **self.spoil)

    def _move(self):
        for i, state in enumerate(self.states):
            if state == "taking_off":
                self.p_W[i, 2] += 0.4 * GATE_S
                if self.p_W[i, 2] >= 0.8:
                    self.states[i] = "hovering"
            elif state == "landing":
                self.p_W[i, 2] = max(self.p_W[i, 2] - GATE_S, 0.0)
                if self.p_W[i, 2] == 0.0:
                    self.states[i] = "landed"
            elif state in ("hovering", "flying"):
                self.p_W[i] += self.v_W[i] * GATE_S
                self.yaw[i] += self.yaw_rate[i] * GATE_S
        if "landed" not in self.states:
            self.closest_m = min(self.closest_m, closest_pair(self.p_W)[0])


def rising_fleet(noise_m=0.0):
    """Return a fleet that has just been commanded to take off."""
    fleet = Fleet(Engagement(SPACE, DRONES), noise_m)
    fleet.fly(0.1)
    assert fleet.engagement.request(Order.TAKE_OFF) is None
    return fleet


def engaged_fleet(noise_m=0.0):
    return copy.deepcopy(engaged(noise_m))


@cache
def engaged(noise_m):
    fleet = rising_fleet(noise_m)
    fleet.fly_until("assembling")
    while fleet.engagement.request(Order.ENGAGE):
        fleet.fly(0.1)
        assert fleet.t_s < 20.0, fleet.output.reason
    fleet.fly(0.1)
    assert fleet.output.phase == "engaged"
    return fleet


def assert_refused(fleet, request, *terms):
    """Assert that the request is refused and changes nothing."""
    before = fleet.engagement.guidance.value(fleet.t_s)
    reason = fleet.engagement.request(request)
    assert reason is not None
    assert has_terms(reason, *terms)
    assert "\n" not in reason
    after = fleet.engagement.guidance.value(fleet.t_s)
    assert np.array_equal(before, after)


# The flight from the ground to the paper's formation


def test_the_paper_s_first_test_reaches_its_target_from_the_ground():
    plan = [Scheduled(20.0, Order.TAKE_OFF), Scheduled(20.0, Order.ENGAGE), Scheduled(20.0, MoveTo(PAPER_3))]
    fleet = Fleet(Engagement(SPACE, DRONES, plan=plan))
    outputs = fleet.fly(120.0)
    phases = list(dict.fromkeys(output.phase for output in outputs))
    assert phases == ["idle", "taking_off", "assembling", "engaged"]
    assert fleet.modes[0][0] == 20.0
    assert [drone for _, drone, mode in fleet.modes if mode == "takeoff"] == list(DRONES)
    assert fleet.closest_m > 2.0
    expected = [(5.0, -2.536, 15.0), (3.469, -6.232, 15.0), (6.531, -6.232, 15.0)]
    assert fleet.p_W == pytest.approx(np.array(expected), abs=2e-3)
    assert fleet.yaw == pytest.approx(np.full(3, math.pi / 2), abs=1e-3)
    assert fleet.output.desired == pytest.approx(list(PAPER_3.values()), abs=1e-9)
    assert fleet.output.margin == pytest.approx(4 * math.sin(math.pi / 4), abs=0.01)
    assert fleet.output.reason == ""


def test_drones_climb_straight_up_until_they_are_engaged():
    fleet = rising_fleet()
    while fleet.engagement.phase != "assembling":
        states = tuple(fleet.states)
        for state, setpoint in zip(states, fleet.step().setpoints, strict=True):
            assert (setpoint is None) == (state in ("landed", "taking_off"))
    fleet.fly(10.0)
    assert fleet.output.phase == "assembling"
    assert has_terms(fleet.output.reason, "ready")
    assert np.array_equal(fleet.p_W[:, :2], GROUND[:, :2])
    assert fleet.p_W[:, 2] == pytest.approx(np.full(3, 1.5), abs=0.01)


def test_engagement_and_requests_in_flight_are_bumpless():
    fleet = engaged_fleet()
    outputs = [fleet.output]
    plan = (
        MoveTo({"z_c": 6.0, "yaw": 2.0}), MoveTo({"x_c": 4.0}), Follow(PAPER_4, {"f": 0.01}),
        Order.PAUSE, Order.ENGAGE, MoveTo({"z_c": 9.0}),
    )  # fmt: skip
    for request in plan:
        assert fleet.engagement.request(request) is None
        outputs += fleet.fly(7.0)
    desired = np.array([output.desired for output in outputs])
    rates = np.array([output.desired_rate for output in outputs])
    steps = SPACE.wrapped(np.diff(desired, axis=0))
    assert np.abs(steps - (rates[1:] + rates[:-1]) / 2 * GATE_S).max() < 1e-3
    assert np.abs(np.diff(rates, axis=0)).max() < 0.05
    assert fleet.closest_m > 2.0


def test_the_reference_starts_at_the_estimate_when_engaged():
    fleet = rising_fleet(noise_m=0.1)
    fleet.fly(12.0)
    estimate = fleet.output.value
    assert fleet.engagement.request(Order.ENGAGE) is None
    output = fleet.step()
    assert output.phase == "engaged"
    assert np.array_equal(output.desired, estimate)
    assert not output.desired_rate.any()


def test_the_start_of_a_trajectory_is_reached_before_its_start_time():
    fleet = engaged_fleet()
    start_s = fleet.t_s + 60.0
    assert fleet.engagement.request(Follow(PAPER_4, {"f": 0.01}, start_s=start_s)) is None
    outputs = fleet.fly(59.0)
    assert all(output.trajectory_t_s is None for output in outputs)
    at_start = [5, -5, 15, 0, 0, 0, 0, 0, 0, 4, 4, math.pi / 4]
    assert fleet.output.value == pytest.approx(at_start, abs=0.02)
    fleet.fly(2.0)
    assert fleet.output.trajectory_t_s == pytest.approx(fleet.t_s - GATE_S - start_s)
    outputs = fleet.fly(100.0)
    assert max(np.abs(SPACE.difference(o.desired, o.value)).max() for o in outputs[500:]) < 0.05


def test_the_formation_stays_at_the_last_waypoint():
    fleet = engaged_fleet()
    points = [{"at_s": 0.0, "values": {"z_c": 3.0}}, {"at_s": 10.0, "values": {"z_c": 6.0}}]
    assert fleet.engagement.request(Follow(waypoints=points)) is None
    outputs = fleet.fly(40.0)
    assert max(output.trajectory_t_s or 0.0 for output in outputs) == pytest.approx(10.0, abs=GATE_S)
    assert fleet.output.trajectory_t_s is None
    assert fleet.output.value[2] == pytest.approx(6.0, abs=0.02)


# Refusals


@pytest.mark.parametrize(
    ("request_", "terms"),
    [
        (MoveTo({"x": 3.0}), ("'x'", "unknown", "x_c", "y_c")),
        (MoveTo({}), ("no values",)),
        (MoveTo({"x_c": math.nan}), ("x_c", "nan", "finite")),
        (MoveTo({"beta": 0.05}), ("sin(beta)", "min(p, q)", "0.1…", "above", "1")),
        (MoveTo({"p": 2.0, "q": 2.0, "beta": 0.9}), ("robots", "2", "3", "1.740", "2")),
        (MoveTo({"p": 20.0, "q": 20.0, "beta": 3.0}), ("J^-1", "1…", "below", "20")),
        (MoveTo({"pitch": 1.0}), ("pitch", "57.3", "below", "30")),
        (MoveTo({"z_c": -2.0}), ("z", "-2.00")),
        (MoveTo({"z_c": 10.0}, over_s=1.0), ("over_s", "1", "allowed")),
        (MoveTo({"x_c": 1e7}), ("x_c", "1e+07")),
        (MoveTo({"x_c": 9e5}), ("reached", "3600")),
        (Follow({"x_c": "foo(t)"}), ("x_c", "'foo'", "sin")),
        (Follow({"x_c": "1/t"}), ("x_c", "value", "0")),
        (Follow({"x_c": "30*sin(t)"}), ("limits",)),
        (Follow({"beta": "0.9 - 0.01*t"}), ("apart",)),
        (Follow({"x_c": "t/10"}, start_s=math.inf), ("start_s", "inf")),
        (Follow(), ("neither",)),
        (Follow({"x_c": "t"}, waypoints=[{"at_s": 0, "values": {}}]), ("both",)),
        (Follow(waypoints=[{"at_s": 0, "values": {"u": 1}}]), ("'u'", "unknown")),
        (Order.TAKE_OFF, ("phase", "engaged")),
        (Order.ENGAGE, ("phase", "engaged")),
    ],
)
def test_bad_requests_are_refused_with_a_reason_and_change_nothing(request_, terms):
    assert_refused(engaged_fleet(), request_, *terms)


def test_requests_that_do_not_fit_the_phase_are_refused():
    fleet = Fleet(Engagement(SPACE, DRONES))
    assert "no gate" in (fleet.engagement.request(Order.TAKE_OFF) or "")
    fleet.fly(0.1)
    assert_refused(fleet, Order.ENGAGE, "phase", "idle")
    assert_refused(fleet, MoveTo({"z_c": 5.0}), "phase", "idle", "engaged")
    assert_refused(fleet, Order.PAUSE, "phase", "idle")
    assert_refused(fleet, Order.LAND, "ground")


@pytest.mark.parametrize(
    ("spoil", "terms"),
    [
        ({"sigma_m": np.full((3, 3), 1.5)}, ("drone1", "sigma", "1.50", "1")),
        ({"yaw_sigma": np.radians([5.0, 16.0, 5.0])}, ("heading", "drone2", "sigma", "16.0 deg", "15 deg")),
        ({"age_s": np.array([0.0, 0.6, 0.0])}, ("drone2", "0.60", "old", "0.5")),
        ({"age_s": np.array([0.0, 0.0, math.inf])}, ("drone3", "inf", "old")),
        ({"p_W": np.full((3, 3), math.nan)}, ("drone1", "finite")),
        ({"states": ("landed", "landed", "emergency")}, ("drone3", "emergency")),
        ({"p_W": GROUND[[0, 2, 1]]}, ("roll", "180.0")),
        ({"p_W": GROUND * (1.0, 0.0, 1.0)}, ("robots 1, 2 and 3", "frame")),
        ({"p_W": GROUND * 0.6}, ("1.80", "apart")),
        ({"p_W": GROUND * (0.2, 1.0, 1.0)}, ("sin(beta)", "min(p, q)", "0.60", "above", "1")),
    ],
    ids=["sigma", "heading", "old", "none", "nan", "emergency", "mirrored", "line", "near", "narrow"],
)
def test_take_off_is_refused_from_a_bad_initial_state(spoil, terms):
    fleet = Fleet(Engagement(SPACE, DRONES))
    fleet.spoil = spoil
    fleet.fly(0.1)
    assert_refused(fleet, Order.TAKE_OFF, *terms)
    fleet.spoil = {}
    fleet.fly(0.1)
    assert fleet.engagement.request(Order.TAKE_OFF) is None


def test_a_lost_take_off_is_repeated_and_engaging_too_low_is_refused():
    fleet = rising_fleet()
    fleet.spoil = {"states": ("landed",) * 3}
    fleet.fly(2.5)
    assert [(drone, mode) for _, drone, mode in fleet.modes] == [(d, "takeoff") for d in DRONES] * 3
    fleet = rising_fleet()
    output = fleet.fly_until("assembling")
    assert has_terms(output.reason, "drone1", "z", "0.8…")
    assert_refused(fleet, Order.ENGAGE, "drone1", "z", "0.8…", "1.20")


# Faults in flight


@pytest.mark.parametrize(
    ("spoil", "terms"),
    [
        ({"age_s": np.array([0.0, 0.0, 0.52])}, ("drone3", "0.52", "old")),
        ({"p_W": np.full((3, 3), math.nan)}, ("drone1", "finite")),
        ({"yaw": np.array([0.0, math.inf, 0.0])}, ("drone2", "finite")),
        ({"sigma_m": np.full((3, 3), 2.5)}, ("drone1", "sigma", "2.50")),
        ({"yaw_sigma": np.radians([5.0, 5.0, 31.0])}, ("heading", "drone3", "sigma", "31.0 deg", "30 deg")),
        ({"states": ("flying", "emergency", "flying")}, ("drone2", "emergency")),
        ({"p_W": GROUND * (1.0, 0.0, 1.0) + (0, 0, 5.0)}, ("robots 1, 2 and 3", "frame")),
        ({"p_W": GROUND * (0.2, 1.0, 1.0) + (0, 0, 5.0)}, ("sin(beta)", "min(p, q)", "0.60")),
    ],
    ids=["old", "nan", "inf", "sigma", "heading", "emergency", "line", "narrow"],
)
def test_a_fault_in_flight_holds_the_formation_which_resumes_bumplessly(spoil, terms):
    fleet = engaged_fleet()
    assert fleet.engagement.request(MoveTo({"z_c": 6.0, "x_c": 5.0})) is None
    fleet.fly(5.0)
    fleet.spoil = spoil
    held = fleet.fly(3.0)
    for output in held:
        assert output.phase == "held"
        assert has_terms(output.reason, *terms)
        moving = [s for s in output.setpoints if s is not None and np.linalg.norm(s.v_W) > 0.9]
        assert not moving
        assert np.isfinite(output.value).all()
        assert np.isfinite(output.desired).all()
    if "p_W" not in spoil:
        assert all(not any(s.v_W) and s.yaw_rate == 0.0 for s in held[-1].setpoints if s is not None)
    fleet.spoil = {}
    fleet.fly(0.4)
    assert fleet.output.phase == "held"
    resumed = fleet.fly_until("engaged", limit_s=1.0)
    assert np.abs(SPACE.difference(resumed.desired, resumed.value)).max() < 1e-9
    assert all(np.linalg.norm(s.v_W) < 1e-6 for s in resumed.setpoints if s is not None)
    fleet.fly(30.0)
    assert fleet.output.value[[0, 2]] == pytest.approx([5.0, 6.0], abs=0.02)


def test_a_formation_recovers_from_shapes_unfit_for_engagement():
    fleet = engaged_fleet()
    fleet.p_W[1:, 0] *= 0.7 / 3.354  # robots 2 and 3 are much too close: the guard parts them
    fleet.fly(1.0)
    assert fleet.output.phase == "held"
    fleet.fly(40.0)
    assert fleet.output.phase == "engaged"
    assert closest_pair(fleet.p_W)[0] == pytest.approx(3.0, abs=0.05)
    fleet.spoil = {"age_s": np.full(3, 1.0)}
    # almost in line: a spread of 0.8 m is between the limits for flight and for engagement
    fleet.p_W[:, :2] = (0.0, 0.4), (-2.47, 0.0), (2.47, 0.0)
    fleet.fly(1.0)
    fleet.spoil = {}
    fleet.fly(40.0)
    assert fleet.output.phase == "engaged"
    assert fleet.output.margin > 2.5


def test_a_running_trajectory_is_joined_in_motion_even_after_a_fault():
    fleet = engaged_fleet()
    start_s = fleet.t_s - 30.0
    assert fleet.engagement.request(Follow(PAPER_4, {"f": 0.01}, start_s=start_s)) is None
    fleet.fly(60.0)
    t = fleet.output.trajectory_t_s or math.nan
    assert t == pytest.approx(fleet.t_s - GATE_S - start_s)
    assert fleet.output.desired[0] == pytest.approx(5 * math.cos(0.02 * math.pi * t))
    fleet.spoil = {"age_s": np.full(3, 9.0)}
    fleet.fly(5.0)
    fleet.spoil = {}
    fleet.fly(40.0)
    assert fleet.output.phase == "engaged"
    assert fleet.output.trajectory_t_s == pytest.approx(fleet.t_s - GATE_S - start_s)
    assert np.abs(SPACE.difference(fleet.output.desired, fleet.output.value)).max() < 0.05
    assert fleet.closest_m > 2.0


def test_robots_that_are_too_close_are_parted_and_reported():
    fleet = engaged_fleet()
    fleet.fly(1.0)
    fleet.p_W[2] = fleet.p_W[1] + (1.3, 0.0, 0.0)
    output = fleet.step()
    assert has_terms(output.reason, "ALARM", "drone2", "drone3")
    assert "drone1" not in output.reason
    fleet.fly(8.0)
    assert closest_pair(fleet.p_W)[0] > 2.0
    assert fleet.output.phase == "engaged"


def test_a_reference_that_becomes_infeasible_holds_the_formation(monkeypatch):
    """Endless trajectories are checked over a finite horizon; this one closes in after it."""
    monkeypatch.setattr(guidance, "HORIZON_S", 30.0)
    fleet = engaged_fleet()
    shape = {"z_c": "5", "beta": "0.93 - max(0, t - 40)/50"}
    assert fleet.engagement.request(Follow(shape)) is None
    fleet.fly(40.0)
    assert fleet.output.phase == "engaged"
    assert has_terms(fleet.fly_until("held").reason, "reference", "robots", "2", "3", "1.99…")
    fleet.fly(20.0)
    assert has_terms(fleet.output.reason, "reference", "allowed")
    assert fleet.closest_m > 1.9


# A drone that landed and hovers again far below its formation


def fleet_out_of_step(height_m=8.0, away_m=(0.0, 0.0)):
    """Return a fleet whose drone2 landed in formation flight, was moved on the ground and took off again."""
    fleet = engaged_fleet()
    assert fleet.engagement.request(MoveTo({"z_c": height_m})) is None
    fleet.fly(40.0)
    fleet.states[1] = "landing"
    fleet.fly(20.0)
    assert fleet.states[1] == "landed"
    fleet.p_W[1, :2] += away_m
    fleet.states[1] = "taking_off"
    fleet.fly(10.0)
    assert fleet.states[1] == "hovering"
    assert fleet.output.phase == "held"
    return fleet


@pytest.mark.parametrize("away_m", [(0.0, 0.0), (6.0, 5.0)], ids=["beneath", "beyond the others"])
def test_a_drone_far_below_its_formation_hovers_until_rejoin_is_requested(away_m):
    fleet = fleet_out_of_step(away_m=away_m)
    fleet.fly(10.0)
    assert has_terms(fleet.output.reason, "roll")
    assert fleet.p_W[1, 2] == pytest.approx(0.8, abs=0.1)
    assert fleet.engagement.request(Order.REJOIN) is None
    assert has_terms(fleet.step().reason, "drone2", "1")
    outputs, low_m = [], fleet.p_W[1, 2]
    place = fleet.engagement.space.inverse(fleet.engagement.guidance.value(fleet.t_s)[0])[0][1]
    while np.linalg.norm(fleet.p_W[1, :2] - place[:2]) > 1.0:  # first horizontally, then straight up
        outputs.append(fleet.step())
        assert fleet.t_s < 200.0
        assert fleet.p_W[1, 2] == pytest.approx(low_m, abs=0.05)
    outputs += fleet.fly(60.0)
    assert fleet.output.phase == "engaged"
    assert fleet.output.value[2] == pytest.approx(8.0, abs=0.02)
    assert fleet.closest_m > 2.0
    speeds = [np.linalg.norm(s.v_W[:2]) for o in outputs for s in o.setpoints if s is not None]
    assert max(speeds) <= 2.0


def test_rejoin_is_refused_unless_a_fault_holds_a_flying_formation():
    fleet = engaged_fleet()
    assert_refused(fleet, Order.REJOIN, "phase", "engaged", "held")
    fleet.engagement.request(Order.PAUSE)
    assert_refused(fleet, Order.REJOIN, "phase", "held", "fault")
    fleet.states[1] = "landed"
    fleet.fly(0.1)
    assert_refused(fleet, Order.REJOIN, "drone2", "landed")
    fleet.states[1] = "hovering"
    fleet.spoil = {"age_s": np.full(3, 2.0)}
    fleet.fly(0.1)
    for request in (Order.REJOIN, MoveTo({"z_c": 5.0})):
        assert_refused(fleet, request, "drone1", "2.00", "old")
    assert_refused(fleet, Order.ENGAGE, "phase", "held")
    assert fleet.engagement.request(Order.LAND) is None


@pytest.mark.parametrize("end", [Order.PAUSE, "landing", "stale"])
def test_a_hold_a_landing_and_a_lost_estimate_end_the_rejoin(end):
    fleet = fleet_out_of_step(away_m=(6.0, 5.0))
    assert fleet.engagement.request(Order.REJOIN) is None
    fleet.fly(1.0)
    if end is Order.PAUSE:
        assert fleet.engagement.request(end) is None
    elif end == "landing":
        fleet.states[1] = "landing"
        fleet.fly(2.0)
        fleet.states[1] = "taking_off"
    else:
        fleet.spoil = {"age_s": np.full(3, 2.0)}
        fleet.fly(0.1)
        fleet.spoil = {}
    fleet.fly(3.0)
    here = fleet.p_W.copy()
    fleet.fly(3.0)
    assert fleet.output.phase == "held"
    assert np.array_equal(fleet.p_W, here)
    assert fleet.engagement.request(Order.REJOIN) is None


# Hold, resume, land


def test_a_hold_persists_through_a_fault_until_engage_is_requested():
    fleet = engaged_fleet()
    assert fleet.engagement.request(MoveTo({"z_c": 12.0})) is None
    fleet.fly(8.0)
    assert fleet.engagement.request(Order.PAUSE) is None
    fleet.fly(6.0)
    height = fleet.p_W[0, 2]
    assert fleet.output.phase == "held"
    assert has_terms(fleet.output.reason, "held", "request")
    fleet.p_W += (0.5, 0.0, 0.0)  # a push: a held formation returns to its place
    fleet.fly(15.0)
    assert fleet.p_W[:, 0].mean() == pytest.approx(0.0, abs=0.05)
    fleet.spoil = {"age_s": np.full(3, 2.0)}  # the hold persists through a fault
    fleet.fly(2.0)
    fleet.spoil = {}
    fleet.fly(5.0)
    assert fleet.output.phase == "held"
    assert has_terms(fleet.output.reason, "held", "request")
    assert fleet.p_W[0, 2] == pytest.approx(height, abs=0.02)
    assert height < 11.0
    assert fleet.engagement.request(Order.ENGAGE) is None
    fleet.fly(40.0)
    assert fleet.output.phase == "engaged"
    assert fleet.output.value[2] == pytest.approx(12.0, abs=0.02)


def test_a_second_flight_after_landing_starts_with_a_zero_integral():
    fleet = engaged_fleet()
    fleet.p_W += (1.0, 0.0, 0.0)
    fleet.fly(3.0)
    assert isinstance(fleet.engagement.law, ProportionalLaw)
    assert np.abs(fleet.engagement.law.integral).max() > 0.01
    assert fleet.engagement.request(Order.LAND) is None
    assert fleet.step().phase == "landing"
    assert all(setpoint is None for setpoint in fleet.output.setpoints)
    assert (fleet.step().reason, fleet.states) == ("", ["landing"] * 3)
    fleet.fly_until("idle")
    assert fleet.states == ["landed"] * 3
    fleet.modes.clear()
    assert fleet.engagement.request(Order.TAKE_OFF) is None
    fleet.fly_until("assembling")
    assert len(fleet.modes) == 3
    fleet.fly(5.0)
    assert fleet.engagement.request(Order.ENGAGE) is None
    assert not fleet.engagement.law.integral.any()


def test_a_drone_that_takes_off_after_a_landing_request_is_landed():
    fleet = rising_fleet()
    fleet.spoil = {"states": ("landed",) * 3}  # the command has not arrived yet
    fleet.step()
    assert fleet.engagement.request(Order.LAND) is None
    fleet.fly(0.2)
    assert fleet.output.phase == "landing"
    fleet.spoil = {}
    fleet.fly(0.1)
    assert [mode for _, _, mode in fleet.modes] == ["takeoff"] * 3 + ["land"] * 3
    fleet.fly_until("idle")
    assert fleet.states == ["landed"] * 3


# Plans

FLIGHT = [Scheduled(1.0, Order.TAKE_OFF), Scheduled(1.0, Order.ENGAGE), Scheduled(1.0, MoveTo({"z_c": 8.0}))]


def test_a_landing_in_the_plan_drops_pending_steps():
    plan = [*FLIGHT[:2], Scheduled(2.0, MoveTo({"beta": 0.1})), Scheduled(15.0, Order.LAND)]
    fleet = Fleet(Engagement(SPACE, DRONES, plan=plan))
    fleet.fly(14.0)
    assert fleet.output.phase == "engaged"
    assert has_terms(fleet.output.reason, "target", "plan", "sin(beta)")
    fleet.fly(2.0)
    assert fleet.output.phase == "landing"
    fleet.fly_until("idle")


def test_a_requested_landing_drops_the_plan():
    fleet = Fleet(Engagement(SPACE, DRONES, plan=[Scheduled(1.0, Order.TAKE_OFF), Scheduled(30.0, Order.TAKE_OFF)]))
    fleet.fly(5.0)
    assert fleet.engagement.request(Order.LAND) is None
    fleet.fly(40.0)
    assert fleet.output.phase == "idle"


def test_a_controller_restarted_in_flight_takes_over_the_formation():
    fleet = Fleet(Engagement(SPACE, DRONES, plan=FLIGHT))
    fleet.fly(20.0)
    modes = len(fleet.modes)
    fleet.engagement = Engagement(SPACE, DRONES, plan=FLIGHT)
    fleet.fly(40.0)
    assert len(fleet.modes) == modes
    assert fleet.output.phase == "engaged"
    assert fleet.output.value[2] == pytest.approx(8.0, abs=0.02)


def restarted(fleet, plan):
    """Replace the fleet's engagement by a new one, as a restarting controller does."""
    last = fleet.output
    fleet.engagement = Engagement(SPACE, DRONES, plan=plan)
    fleet.engagement.warm_start(last.phase, last.desired, last.plan_step)


def assert_the_same_from_here(fleet, plan, seconds=13.0):
    """Assert that the fleet and a copy whose engagement is restored from a snapshot fly identically."""
    copied = copy.deepcopy(fleet)
    copied.engagement = Engagement(SPACE, DRONES, plan=plan)
    copied.gate -= 1
    last = copied._input()
    copied.gate += 1
    copied.engagement.restore(unpack(pack(fleet.engagement.snapshot())), last)
    assert [*map(exact, copied.fly(seconds))] == [*map(exact, fleet.fly(seconds))]
    assert fleet.modes == copied.modes


def exact(output: GateOutput):
    numbers = [array.tobytes() for array in (output.value, output.desired, output.desired_rate)]
    setpoints = [setpoint and (tuple(setpoint.v_W), setpoint.yaw_rate) for setpoint in output.setpoints]
    state = output.phase, output.trajectory_t_s, output.margin, output.reason, output.factor, output.plan_step
    return *numbers, setpoints, output.modes, state


WAYPOINTS = [{"at_s": 0.0, "values": {"z_c": 8.0}}, {"at_s": 20.0, "values": {"z_c": 6.0, "x_c": 3.0}}]
ALL_PHASES = [*FLIGHT, Scheduled(12.0, Follow(expressions=PAPER_4, constants={"f": 0.01}, duration_s=15.0))]


@pytest.mark.parametrize(
    ("request_", "at_s"),
    [
        *[(None, at_s) for at_s in (0.2, 1.5, 3.0, 5.0, 9.0, 14.0, 20.0, 35.0)],
        (Follow(waypoints=WAYPOINTS), 16.0),
        (Order.PAUSE, 16.0),
        (MoveTo({"z_c": 5.0}), 12.0),
        (Order.LAND, 12.0),
    ],
)
def test_a_restored_engagement_continues_bit_for_bit(request_, at_s):
    fleet = Fleet(Engagement(SPACE, DRONES, plan=ALL_PHASES))
    fleet.fly(at_s - 1.0 if request_ else at_s)
    if request_:
        assert fleet.engagement.request(request_) is None
        fleet.fly(1.0)
    assert_the_same_from_here(fleet, ALL_PHASES)


def test_an_engagement_restored_during_a_rejoin_continues_bit_for_bit():
    fleet = fleet_out_of_step(away_m=(3.0, 0.0))
    assert fleet.engagement.request(Order.REJOIN) is None
    fleet.fly(2.0)
    assert_the_same_from_here(fleet, ())
    assert fleet.output.phase == "engaged"


@pytest.mark.parametrize(
    ("spoil", "at_s", "phase"),
    [
        ({"age_s": np.array([0.0, 5.0, 0.0])}, 15.0, "held"),
        ({"states": ("landed",) * 3}, 0.9, "taking_off"),  # no drone obeys, so the command is repeated
    ],
)
def test_an_engagement_restored_during_a_fault_continues_bit_for_bit(spoil, at_s, phase):
    fleet = Fleet(Engagement(SPACE, DRONES, plan=FLIGHT))
    fleet.fly(at_s)
    fleet.spoil = spoil
    fleet.fly(0.5)
    assert fleet.output.phase == phase
    assert_the_same_from_here(fleet, FLIGHT, 3.0)
    fleet.spoil = {}
    assert_the_same_from_here(fleet, FLIGHT)


@pytest.mark.parametrize("gate", [10, 100, 300, 400, 700])
def test_a_controller_restarted_in_any_phase_continues_the_plan(gate):
    fleet = Fleet(Engagement(SPACE, DRONES, plan=FLIGHT))
    fleet.fly(gate * GATE_S)
    restarted(fleet, FLIGHT)
    fleet.fly(50.0)
    assert fleet.output.phase == "engaged"
    assert fleet.output.reason == ""
    assert fleet.output.value[2] == pytest.approx(8.0, abs=0.02)


@pytest.mark.parametrize("by_plan", [False, True])
def test_a_controller_restarted_after_landing_stays_idle(by_plan):
    plan = [*FLIGHT, Scheduled(15.0, Order.LAND)] if by_plan else FLIGHT
    fleet = Fleet(Engagement(SPACE, DRONES, plan=plan))
    fleet.fly(16.0 if by_plan else 5.0)
    assert by_plan or fleet.engagement.request(Order.LAND) is None
    fleet.fly_until("idle")
    modes = len(fleet.modes)
    restarted(fleet, plan)
    fleet.fly(5.0)
    assert (fleet.output.phase, fleet.output.reason) == ("idle", "")
    assert len(fleet.modes) == modes


@pytest.mark.parametrize(("request_", "height_m"), [(MoveTo({"z_c": 4.0}), 4.0), (Order.PAUSE, None)])
def test_a_restart_preserves_requests_made_after_the_plan(request_, height_m):
    fleet = Fleet(Engagement(SPACE, DRONES, plan=FLIGHT))
    fleet.fly(12.0)
    assert fleet.engagement.request(request_) is None
    fleet.fly(20.0)
    before = fleet.output.desired
    restarted(fleet, FLIGHT)
    fleet.fly(20.0)
    assert np.array_equal(fleet.output.desired, before)
    assert height_m is None or before[2] == height_m


@pytest.mark.parametrize(
    ("plan", "terms"),
    [
        ([Scheduled(1.0, MoveTo({"u": 1.0}), "plan.target")], ("plan.target", "'u'")),
        ([Scheduled(1.0, Order.TAKE_OFF), Scheduled(1.0, Follow({"x_c": "u"}))], ("plan.x_c", "'u'")),
        (
            [Scheduled(2.0, Order.TAKE_OFF), Scheduled(1.0, Order.ENGAGE, "plan.takeoff_s")],
            ("plan.takeoff_s", "1", "2"),
        ),
        ([Scheduled(math.nan, Order.TAKE_OFF, "plan.takeoff_s")], ("plan.takeoff_s", "nan")),
    ],
)
def test_plans_that_can_never_be_flown_are_refused_at_once(plan, terms):
    with refused(ValueError, *terms):
        Engagement(SPACE, DRONES, plan=plan)
    with refused(ValueError, "2", "drones", "3"):
        Engagement(SPACE, DRONES[:2])


# Two and four drones


@pytest.mark.parametrize("n", [2, 4])
def test_formations_of_two_and_four_drones_reach_their_targets(n):
    p_W = np.array([(0.0, 1.5, 0), (0.0, -1.5, 0)] if n == 2 else [*GROUND, (0.0, -4.5, 0)])
    plan = [*FLIGHT[:2], Scheduled(1.0, MoveTo({"z_c": 6.0, "p": 4.0}))]
    space = cluster_space(n)
    fleet = Fleet(Engagement(space, [f"d{i}" for i in range(n)], plan=plan), p_W=p_W)
    fleet.fly(60.0)
    assert fleet.output.phase == "engaged"
    assert fleet.output.value[[2, space.index("p")]] == pytest.approx([6.0, 4.0], abs=0.02)
    assert fleet.closest_m > 2.0


def test_a_large_cluster_forms_its_template():
    ring = np.array([(4 * np.cos(k * np.pi / 3), 4 * np.sin(k * np.pi / 3), 0.0) for k in range(6)])
    space = TemplateCluster(ring)
    plan = [*FLIGHT[:2], Scheduled(1.0, MoveTo({"z_c": 4.0, "w_1": 0.5}))]
    fleet = Fleet(Engagement(space, [f"d{i}" for i in range(6)], plan=plan), p_W=ring * (1.2, 0.9, 1.0) + (1, 2, 0))
    fleet.fly(60.0)
    assert fleet.output.phase == "engaged"
    arms = np.linalg.norm(fleet.p_W - fleet.p_W.mean(axis=0), axis=1)
    assert arms == pytest.approx(np.full(6, 4.5), abs=0.02)
    assert fleet.p_W.mean(axis=0) == pytest.approx([1.0, 2.0, 4.0], abs=0.02)
    assert fleet.closest_m > 2.0


# Requests on the wire


def test_requests_are_read_from_the_wire():
    assert [read_request(op, args) for op, args in (("takeoff", None), ("hold", {}))] == [Order.TAKE_OFF, Order.PAUSE]
    assert read_request("target", {"values": {"z_c": 3}, "over_s": 5}) == MoveTo({"z_c": 3}, 5)
    assert read_request("target", {"values": {"z_c": 3}, "over_s": None}) == MoveTo({"z_c": 3})
    follow = read_request("trajectory", {"expressions": {"x_c": "f*t"}, "constants": {"f": 0.1}, "start_s": 9.0})
    assert follow == Follow({"x_c": "f*t"}, {"f": 0.1}, start_s=9.0)


@pytest.mark.parametrize(
    ("op", "args", "terms"),
    [
        ("fly", {}, ("op", "'fly'", "unknown", "takeoff", "engage")),
        (["land"], {}, ("op", "unknown")),
        (None, {}, ("op", "'None'", "unknown")),
        ("land", {"now": True}, ("land", "'now'", "unknown", "none")),
        ("land", [1], ("land", "args", "list")),
        ("target", {"values": [1]}, ("target", "values", "'[1]'")),
        ("target", {"values": {}, "over_s": "5"}, ("target", "over_s", "'5'", "seconds")),
        ("trajectory", {"waypoints": "x"}, ("trajectory", "waypoints", "'x'")),
        ("trajectory", {"duration_s": math.inf}, ("trajectory", "duration_s", "'inf'")),
    ],
)
def test_requests_that_cannot_be_read_are_refused(op, args, terms):
    with refused(RequestError, *terms):
        read_request(op, args)


# Arbitrary inputs


@settings(deadline=None, max_examples=60, derandomize=True)
@given(st.integers(0, 2**32 - 1))
def test_outputs_are_finite_for_any_estimates_states_and_requests(seed):
    rng = np.random.default_rng(seed)
    fleet = engaged_fleet()
    bad = [math.nan, math.inf, -math.inf, 1e300, -1e300, 0.0, 1e6]
    wanted = [MoveTo({"z_c": 6.0}), Follow(PAPER_4, {"f": 0.01}), Order.PAUSE, Order.ENGAGE, Order.LAND, Order.TAKE_OFF]
    states = ["landed", "taking_off", "hovering", "flying", "landing", "emergency", "unknown"]
    for _ in range(40):
        spoil = {}
        shapes = {"p_W": (3, 3), "v_W": (3, 3), "yaw": 3, "sigma_m": (3, 3), "yaw_sigma": 3, "age_s": 3}
        for field, shape in shapes.items():
            if rng.random() < 0.3:
                values = rng.normal(scale=3.0, size=shape)
                values[rng.random(shape) < 0.2] = rng.choice(bad)
                spoil[field] = values
        if rng.random() < 0.3:
            spoil["states"] = tuple(rng.choice(states, 3).tolist())
        fleet.spoil = spoil
        fleet.engagement.request(wanted[rng.integers(len(wanted))])
        output = fleet.step()
        fleet.v_W[:], fleet.yaw_rate[:] = 0.0, 0.0
        for values in (output.value, output.desired, output.desired_rate, [output.margin, output.factor]):
            assert np.isfinite(values).all()
        for setpoint in output.setpoints:
            assert setpoint is None or np.isfinite([*setpoint.v_W, setpoint.yaw_rate]).all()
            assert setpoint is None or np.linalg.norm(setpoint.v_W) < 3.0
