"""What the console receives from a run (time or silence, estimates, faults, links), and the texts that show it."""

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from refused import has_terms, without_tags

from zsim.contract import keys, messages
from zsim.contract.flight_messages import DroneView, EstimateView, LinkState, ViewDrones, ViewEstimates
from zsim.contract.messages import DroneInfo
from zsim.contract.run_messages import Clock, Event, Fault, Faults, Health, Waiting
from zsim.math import frames
from zsim.runtime.participant import Participant
from zsim.scenario.scenario import Environment, Obstacle, Surface
from zsim.scenario.surroundings import packed
from zsim_bridges.console import console_tables
from zsim_bridges.console.console_server import console_state
from zsim_bridges.console.console_tables import TableRows
from zsim_bridges.console.run_condition import DroneCondition, RunCondition, page_head
from zsim_bridges.console.run_monitor import (
    BEAT_S,
    FAULTS_KEPT,
    SILENT_S,
    FaultWatch,
    FlightMeter,
    RecordPlayer,
    TimeMonitor,
)
from zsim_bridges.console.view_buffer import ReceivedEstimate, ViewBuffer

S = 1_000_000_000  # ns
LEVEL = (1.0, 0.0, 0.0, 0.0)
ORIGIN = (0.0, 0.0, 0.0)
UNIT = (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)


class Link:
    """A session on which only the test publishes."""

    host = "lab"
    reads: tuple[str, ...] = ()

    def __init__(self) -> None:
        self.now: Clock | bytes | None = None
        self.asked = 0
        self.say: Callable[[Any], None] = lambda _: None
        self.tell: Callable[[Any], None] = lambda _: None
        self.last: Faults | None = None
        self.meanwhile: Faults | None = None

    def get(self, expression: str, timeout_s: float = 2.0) -> list[Any]:
        if expression == keys.FAULTS:
            if self.meanwhile:
                self.say(sample(keys.FAULTS, self.meanwhile))
            return [sample(keys.FAULTS, self.last)] if self.last else []
        self.asked += 1
        return [] if self.now is None else [sample(keys.CLOCK, self.now)]

    def declare_subscriber(self, expression: str, callback: Callable[[Any], None]) -> None:
        if expression == keys.EVENT:
            self.tell = callback
        else:
            self.say = callback


class MonitoredRun:
    """The view buffer and time monitor of a run with two drones, on a wall clock that only the test advances."""

    def __init__(self, stamp_age_s: float = 0.1) -> None:
        self.wall_s = 100.0
        self.link: Any = Link()
        self.refused: list[Event] = []
        names = ("drone1", "drone2")
        info: Any = SimpleNamespace(
            run_id="r1", drones=[DroneInfo(names[0], ""), DroneInfo(names[1], "", body="external")]
        )
        self.observer = Participant(self.link, info, "console.1")
        self.monitor = TimeMonitor(self.link, self.observer, stamp_age_s, lambda: self.wall_s)
        self.views = ViewBuffer(self.link, info, self.observer, {}, self.refused.append, lambda: self.wall_s)
        self.words = TableRows(self.views, {})
        self.views.open()

    def run_for(self, seconds: float) -> None:
        """Advance the wall clock while the console runs."""
        for _ in range(round(seconds / BEAT_S)):
            self.wall_s += BEAT_S
            self.monitor._awake.beat()

    def state(self) -> dict[str, Any]:
        return console_state("r1", self.views, self.monitor, {})

    def deliver(self, *samples: tuple[str, Any]) -> None:
        for key, message in samples:
            self.link.say(sample(key, message))
        self.views.update()


def sample(key: str, message: Any) -> Any:
    return SimpleNamespace(key=key, payload=message if isinstance(message, bytes) else messages.encode(message))


def clock(
    t_ns: int,
    rate: float = 1.0,
    run_id: str = "r1",
    state: Any = "running",
    waiting_for: tuple[Waiting, ...] = (),
) -> Clock:
    return Clock(t_ns, 0, run_id, 0, state, rate, waiting_for)


def drones(t_ns: int) -> tuple[str, ViewDrones]:
    views = tuple(DroneView(name, ORIGIN, LEVEL, (0.0, 0.0, 0.0, 0.0), "flying", 80.0) for name in ("drone1", "drone2"))
    return keys.VIEW_DRONES, ViewDrones(t_ns, 0, views)


def estimate(t_ns: int, process: str = "estimator.drone1", used: int = 7) -> tuple[str, ViewEstimates]:
    view = EstimateView("drone1", ORIGIN, UNIT, 0.0, 0.1, {"gps": (used, 0)})
    return keys.estimates_view(process), ViewEstimates(t_ns, 0, (view,))


def health(process: str = "estimator.drone1", lag_ns: int = 0) -> tuple[str, Health]:
    return keys.process(process, "health"), Health(0, 0, "estimator", "lab", 1, {}, lag_ns, 0, 0, 0)


@pytest.fixture
def monitored() -> MonitoredRun:
    return MonitoredRun()


# The time of the run


def test_a_time_stamp_is_current_at_any_rate_of_the_run(monitored: MonitoredRun):
    monitored.link.now = clock(1 * S, rate=4.0)
    assert monitored.monitor.now_ns() == 1 * S
    monitored.link.now = clock(2 * S, rate=4.0)
    monitored.wall_s += 0.02  # 80 ms of simulated time
    assert monitored.monitor.now_ns() == 1 * S
    monitored.wall_s += 0.01
    assert monitored.monitor.now_ns() == 2 * S
    assert monitored.link.asked == 2
    monitored.link.now = None  # the world does not answer
    monitored.wall_s += 60.0
    assert monitored.monitor.now_ns() == 2 * S
    careless = MonitoredRun(stamp_age_s=float("inf"))
    careless.wall_s += 1000.0
    assert (careless.monitor.now_ns(), careless.link.asked) == (0, 0)


@pytest.mark.parametrize("garbage", [b"", b"\xc1", b"\x80", messages.encode(drones(0)[1])])
def test_an_invalid_clock_is_ignored_and_counted(garbage: bytes, monitored: MonitoredRun):
    for answer, known in ((garbage, None), (clock(3 * S), clock(3 * S)), (garbage, clock(3 * S))):
        monitored.link.now = answer
        monitored.monitor.poll()
        assert monitored.monitor.clock == known
    assert monitored.observer.health.refused == 2


@pytest.mark.parametrize(
    ("now", "over"), [(clock(0, run_id="r2"), "another run"), (clock(0, state="stopped"), "the run ended")]
)
def test_the_end_of_a_run_is_noticed(now: Clock, over: str, monitored: MonitoredRun):
    monitored.link.now = now
    monitored.monitor.poll()
    assert over in monitored.observer.end_reason


def test_silence_of_the_world_is_shown_with_its_duration(monitored: MonitoredRun):
    with monitored.monitor.polling():
        monitored.run_for(SILENT_S - 0.1)
        assert monitored.monitor.silent_s == 0.0
        monitored.run_for(10.0)
        assert monitored.monitor.silent_s == pytest.approx(SILENT_S + 9.9)
        monitored.link.now = clock(1 * S)
        monitored.monitor.poll()
        assert monitored.monitor.silent_s == 0.0
        monitored.link.now = None
        monitored.monitor.poll()
        monitored.run_for(5.0)
        shown = monitored.state()
        assert (shown["clock"], shown["silent_s"]) == ("silent", pytest.approx(5.0))
    assert monitored.monitor.silent_s == 0.0  # the world is no longer polled
    assert monitored.state()["clock"] == "running"


def test_a_stall_of_the_console_is_not_taken_for_silence_of_the_world(monitored: MonitoredRun):
    with monitored.monitor.polling():
        monitored.run_for(0.5)
        assert monitored.monitor.stall is None
        monitored.wall_s += 12.0
        assert monitored.monitor.silent_s == 0.0
        monitored.run_for(0.1)
        assert monitored.monitor.silent_s == 0.0
        stall = monitored.monitor.stall
        assert stall is not None
        assert stall.lasted_s == pytest.approx(12.0, abs=2 * BEAT_S)
        monitored.run_for(SILENT_S)
        assert monitored.monitor.silent_s > SILENT_S


@pytest.mark.parametrize(
    ("run", "waiting", "level", "terms"),
    [
        (RunCondition("running", silent_s=12.3), (), "silent", ("12 s",)),
        (RunCondition("running"), (Waiting("estimator.drone1", "lab", 40.0),), "waiting", ("on lab (40.0 s)",)),
        (
            RunCondition("running"),
            (Waiting("estimator.drone1", "lab", 0.6),),
            "running",
            ("running", "estimator.drone1"),
        ),
        (RunCondition("waiting"), (Waiting("controller.main", "", 18.0),), "waiting", ("main (18.0 s) in 'lab'",)),
    ],
)
def test_only_a_world_whose_time_advances_is_called_running(
    run: RunCondition, waiting: tuple[Waiting, ...], level: str, terms: tuple[str, ...]
):
    head = page_head("step", run, clock(7 * S, state=run.clock, waiting_for=waiting), 7 * S, world="'lab'")
    assert head["level"] == level
    assert all(term in head["title"] + head["detail"] for term in terms)
    assert ("running" in head["title"]) == (level == "running")


def test_a_replay_is_labelled_as_such():
    emergency = RunCondition("paused", replayed=True, drones={"drone1": "emergency"})
    head = page_head("step", emergency, clock(15 * S), 15 * S, record_s=(10.0, 20.0))
    assert (head["level"], head["replay"]) == ("paused", True)  # no red head: a record needs no action
    assert has_terms(head["title"], "REPLAY", "15.0 of 20.0 s", "50 %")
    flight = page_head("step", emergency._replace(replayed=False), clock(S), S)
    assert (flight["level"], flight["replay"]) == ("emergency", False)


# Estimators


def test_a_dead_estimator_is_not_shown_as_healthy(monitored: MonitoredRun):
    for second in range(3):
        monitored.deliver(drones(second * S), estimate(second * S, used=5 * second), health())
        monitored.words.sensor_tables(["drone1"])
        monitored.wall_s += 1.0
    assert "5 Hz" in monitored.words.sensor_tables(["drone1"])["drone1"]
    assert monitored.words.drone_rows()[0].drone.lag_ms == 0.0
    monitored.wall_s += 8.0
    monitored.deliver(drones(10 * S))
    assert monitored.words.drone_rows()[0].drone.lag_ms == 8000.0
    shown = monitored.words.sensor_tables(["drone1"])["drone1"]
    assert has_terms(without_tags(shown), "no estimate", "2.0 s")
    assert "Hz" not in shown
    assert not monitored.views.estimates()["drone1"].is_fresh
    assert monitored.state()["drones"][0]["sigma_m"] is None


@pytest.mark.parametrize(
    ("estimated_s", "waited_s", "seen_s", "fresh"),
    [
        (1.0, 0.05, 9.0, True),  # in a fast run, views may be seconds apart in simulated time
        (1.0, 9.0, 1.5, True),  # in a slow run, a view may be seconds old in wall time
        (60.0, 5.0, 10.0, None),  # a replay has gone back
    ],
)
def test_an_estimate_is_fresh_by_its_time_or_by_its_arrival(
    monitored: MonitoredRun, estimated_s: float, waited_s: float, seen_s: float, fresh: bool | None
):
    monitored.deliver(estimate(round(estimated_s * S)), health())
    monitored.wall_s += waited_s
    monitored.deliver(drones(round(seen_s * S)))
    found = monitored.views.estimates().get("drone1")
    assert (found and found.is_fresh) == fresh
    assert monitored.words.drone_rows()[0].drone.lag_ms == (None if fresh is None else 0.0)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_later_of_two_estimates_of_a_drone_is_shown(order: tuple[int, int], monitored: MonitoredRun):
    samples = (estimate(1 * S, "estimator.old", used=1), estimate(2 * S, "estimator.new", used=2))
    healths = health("estimator.new", 3_000_000), health("estimator.old")
    monitored.deliver(drones(2 * S), *(samples[i] for i in order), *healths)
    assert monitored.views.estimates()["drone1"].process == "estimator.new"
    assert monitored.words.drone_rows()[0].gps == "2 / 0"
    assert monitored.words.drone_rows()[0].drone.lag_ms == 3.0
    assert "<td align=left>2</td>" in monitored.words.sensor_tables(["drone1"])["drone1"]


def test_an_invalid_covariance_has_no_sigma():
    estimate = EstimateView("drone1", ORIGIN, (-9.0, 0.0, 0.0, 1.0, 0.0, 1.0), 0.0, 0.1, {})
    assert ReceivedEstimate("estimator.drone1", 0, estimate, True).sigma_m == 0.0


# Faults and refusals


def test_faults_are_shown_on_a_drone_while_active(monitored: MonitoredRun):
    planned = Fault(1, "gps_bias", "drone1", {}, 20 * S)
    acting = Fault(2, "gps_dropout", "drone1", {}, 5 * S, 15 * S)
    ended = Fault(3, "motor", "drone1", {}, 0, 10 * S)
    monitored.deliver(drones(10 * S), (keys.FAULTS, Faults(0, 0, (planned, acting, ended))))
    assert [row.faults for row in monitored.words.drone_rows()] == [("gps_dropout",), ()]
    shown = monitored.state()["faults"]
    assert [(fault["from_s"], fault["until_s"]) for fault in shown] == [(20.0, None), (5.0, 15.0), (0.0, 10.0)]


def test_received_faults_are_not_replaced_by_an_older_answer(monitored: MonitoredRun):
    newer = Fault(2, "gps_dropout", "drone1", {}, 0)
    monitored.link.last, monitored.link.meanwhile = Faults(0, 0, ()), Faults(0, 1, (newer,))
    monitored.views.open()
    monitored.views.update()
    assert monitored.views.faults == (newer,)


def test_the_console_receives_only_refusals_of_its_own_commands(monitored: MonitoredRun):
    for kind, source in (("refused", "console.2"), ("command", "console.1"), ("refused", "console.1")):
        monitored.link.tell(sample(keys.EVENT, Event(0, 0, kind, source, "drone/drone1/cmd/mode", "no")))
    assert [(event.kind, event.source) for event in monitored.refused] == [("refused", "console.1")]
    assert monitored.views.answered_commands("drone1") == 2


# Links of drivers to external drones


def link(state: Any, **figures: float | None) -> tuple[str, LinkState]:
    unknown = dict.fromkeys(("age_ms", "loss_percent", "round_trip_ms", "clock_offset_ms"))
    numbers: Any = {**unknown, **figures}
    return keys.link("drone2"), LinkState(0, 0, "driver.drone2", "<10.0.0.7>", state, **numbers, refused=3)


def test_an_external_drone_shows_the_link_of_its_driver(monitored: MonitoredRun):
    monitored.deliver(drones(1 * S))
    plain, external = monitored.words.drone_rows()
    assert (plain.link, external.link[1]) == (("", ""), console_tables.AMBER)
    colours = {"connected": console_tables.BLUE, "armed": console_tables.GREEN, "lost": console_tables.RED}
    for state, colour in colours.items():
        monitored.deliver(link(state, age_ms=12.3, loss_percent=0.4))
        text, shown = monitored.words.drone_rows()[1].link
        assert shown == colour
        assert has_terms(text, state, "12 ms", "0 %", "3")
    assert "&lt;10.0.0.7&gt;" in console_tables.drone_table(monitored.words.drone_rows())
    monitored.wall_s += 10.0
    text, shown = monitored.words.drone_rows()[1].link
    assert (shown, "10 s" in text) == (console_tables.RED, True)


# Flight figures


def view(t_s: float, x_m: float, battery: float = 80.0) -> ViewDrones:
    w, x, y, z = frames.quaternion_from_heading([math.radians(90.0)])[0].tolist()
    return ViewDrones(
        int(t_s * S), 0, (DroneView("drone1", (x_m, 0.0, 2.0 + t_s), (w, x, y, z), (), "flying", battery),)
    )


def test_the_obstacle_distance_is_that_to_the_nearest_obstacle():
    poles = [
        Obstacle(name=f"p{x}", shape="cylinder", position_m=(x, 0, 0), radius_m=0.5, height_m=9) for x in (3.0, 9.0)
    ]
    wall = Surface(name="wall", triangles=packed(np.array([[4.4, -9, 0, 4.4, 9, 0, 4.4, 0, 19]], dtype=float)))
    meter = FlightMeter(Environment(obstacles=poles, surfaces=[wall]))
    meter.update(view(0.0, 5.0))
    assert meter.metrics["drone1"].obstacle_m == pytest.approx(0.6, abs=1e-6)
    meter.update(view(0.1, 5.6))
    assert meter.metrics["drone1"].obstacle_m == pytest.approx(1.2, abs=1e-6)


def test_flight_figures_are_derived_from_past_positions():
    meter = FlightMeter(Environment())
    for step in range(10):
        meter.update(view(0.1 * step, 0.2 * step))
    figures = meter.metrics["drone1"]
    assert figures.speed_m_s == pytest.approx(math.hypot(2.0, 1.0))
    assert figures.climb_m_s == pytest.approx(1.0)
    assert figures.heading_deg == pytest.approx(90.0)
    assert (figures.battery_remaining_s, figures.obstacle_m) == (None, None)
    meter.update(view(40.0, 0.0, 70.0))
    assert meter.metrics["drone1"].battery_remaining_s == pytest.approx(70.0 / 0.25)
    meter.update(view(1.0, 50.0))  # a replay that goes back restarts the figures
    assert meter.metrics["drone1"].speed_m_s == 0.0


# The time of a replay


def player(state: str, is_replay: bool = True) -> tuple[RecordPlayer, list[Any]]:
    """Return a player that has loaded its timeline, and what it requests."""
    asked: list[Any] = []
    client: Any = SimpleNamespace(
        timeline=lambda: {"from_s": 0.0, "to_s": 9.0, "marks": []},
        seek=lambda t_s, step: asked.append(("seek", t_s, step)),
        request_world=lambda op, **args: asked.append((op, args)),
    )
    monitor: Any = SimpleNamespace(clock=None)
    monitor.poll = lambda: setattr(monitor, "clock", SimpleNamespace(state=state, t_ns=8 * 10**9))
    made = RecordPlayer(client, monitor, is_replay)
    made.load()
    return made, asked


@pytest.mark.parametrize(
    ("state", "op", "value", "request_"),
    [
        ("running", "pause", 1.0, ("pause", {})),
        ("running", "resume", 1.0, ("resume", {})),
        ("running", "step", 1.0, ("step", {"gates": 1})),
        ("running", "rate", 0.5, ("rate", {"value": 0.5})),
        ("running", "seek", 4.0, ("seek", 4.0, False)),
        ("stopped", "seek", 4.0, ("seek", 4.0, False)),
        ("paused", "seek", 4.0, ("seek", 4.0, True)),  # a paused replay shows the instant it was set to
    ],
)
def test_a_replay_receives_the_requests_of_its_page(state: str, op: str, value: float, request_: Any):
    made, asked = player(state)
    assert asked == ([("seek", 8.0, True)] if state == "paused" else [])  # shows this console the current instant
    made.play(op, value)
    assert asked[-1] == request_
    flight, asked = player(state, is_replay=False)
    flight.play(op, value)
    assert (flight.timeline, flight.state(RunCondition("running")), asked) == ({}, {}, [])


@pytest.mark.parametrize(
    ("run", "refused"),
    [
        (RunCondition("running", replayed=True), {"resume", "step"}),
        (RunCondition("paused", replayed=True), {"pause"}),
        (RunCondition("paused", replayed=True, at_end=True), {"pause", "resume", "step"}),
        (RunCondition("stopped", replayed=True, ended="it is over"), {"pause", "resume", "step", "rate", "seek"}),
    ],
)
def test_the_timeline_lists_what_would_be_refused(run: RunCondition, refused: set[str]):
    refusals = player("paused")[0].state(run)["refusals"]
    assert {op for op, reason in refusals.items() if reason} == refused


def test_a_record_is_read_around_the_shown_instant_nearest_first():
    asked: list[tuple[float, float]] = []
    tasks: list[Any] = []
    client: Any = SimpleNamespace(
        timeline=lambda: {"from_s": 0.0, "to_s": 1000.0},
        past_views=lambda from_s, to_s, every_s: asked.append((from_s, to_s)) or [(from_s, to_s)],
        read=lambda act: tasks.append(act) or True,
    )
    monitor: Any = SimpleNamespace(clock=None, poll=lambda: None)
    made = RecordPlayer(client, monitor, True)
    made.load()

    def read(t_s: float) -> list[float]:
        asked.clear()
        made.fill(t_s)
        made.fill(t_s)  # no second reading while one is under way
        while tasks:
            tasks.pop()()
        return [from_s for from_s, _ in asked]

    begun = read(505.0)
    assert begun[0] == 500.0
    assert set(begun[1:3]) == {490.0, 510.0}
    assert (min(begun), max(begun)) == (320.0, 590.0)
    assert read(505.0) == []
    assert read(515.0) == [600.0]
    assert read(5.0)[0] == 0.0
    assert read(505.0)[0] == 500.0  # too far from the shown instant to be kept
    assert made.pop_instants() == [(500.0, 509.875)]


# What faults did


FIT = DroneCondition("drone1", "landed", 73.0, lag_ms=10.0, sigma_m=0.2)


class Watched:
    """A fault and two drones of a formation."""

    def __init__(self, fault: Fault) -> None:
        self.watch, self.fault = FaultWatch(), fault
        self.drones = {name: FIT._replace(name=name, state="flying") for name in ("drone1", "drone2")}

    def see(self, acts: bool = True, phase: str = "engaged", lost: tuple[str, ...] = (), wind: float = 0.5) -> str:
        active = [self.fault] if acts else []
        self.watch.update([self.fault], active, self.drones, {"main": phase}, lost, wind)
        (line,) = self.watch.lines(is_over=not acts)
        return line

    def change(self, drone: str, **change: Any) -> None:
        self.drones[drone] = self.drones[drone]._replace(**change)


def test_a_fault_of_a_drone_reports_effects_on_that_drone_only():
    of = Watched(Fault(3, "gps_dropout", "drone1", {"probability": 0.4}, 12_000_000_000, 42_000_000_000))
    assert has_terms(of.see(), "#3 gps_dropout of drone1 probability=0.4", "12.0 s to 42.0 s", "no effect seen")
    of.change("drone2", sigma_m=9.0, state="emergency")
    assert has_terms(of.see(), "no effect seen")
    of.change("drone1", sigma_m=1.4, state="landing")
    assert has_terms(of.see(phase="held"), "σ 0.20 → 1.40 m", "drone1 flying → landing", "main engaged → held")
    of.change("drone1", sigma_m=0.3)
    assert has_terms(of.see(acts=False), "σ 0.20 → 1.40 m")  # the worst value is kept
    of.change("drone1", sigma_m=5.0)
    assert has_terms(of.see(acts=False), "σ 0.20 → 1.40 m")  # the fault is over


def test_a_gust_reports_its_wind_and_a_slow_link_its_lag():
    gust = Watched(Fault(1, "gust", "world", {"velocity_m_s": [4.0, 0.0, 0.0]}, 0))
    gust.see()
    assert has_terms(gust.see(wind=4.4), "velocity_m_s=[4.0, 0.0, 0.0]", "wind 0.5 → 4.4 m/s")
    link = Watched(Fault(1, "link_delay", "world/estimator.drone2", {"delay_ms": 300.0, "one_way": False}, 0))
    link.see()
    link.change("drone2", lag_ms=310.0)
    assert has_terms(link.see(), "world/estimator.drone2", "delay_ms=300.0", "lag 10 → 310 ms")


def test_a_kill_reports_the_death_and_return_of_its_process():
    of = Watched(Fault(1, "process_kill", "estimator.drone1", {}, 0, 20_000_000))
    of.see(acts=False)
    assert has_terms(of.see(acts=False, lost=("estimator.drone1",)), "estimator.drone1 alive → dead")
    assert has_terms(of.see(acts=False), "estimator.drone1 alive → dead → alive")


def test_only_the_latest_finished_faults_are_kept():
    watch = FaultWatch()
    for number in range(3 * FAULTS_KEPT):
        fault = Fault(number, "gps_stuck", "drone1", {}, 0)
        watch.update([], [fault], {"drone1": FIT}, {}, (), 0.0)
    watch.update([], [], {"drone1": FIT}, {}, (), 0.0)
    assert len(watch.lines(is_over=True)) == FAULTS_KEPT
    assert watch.lines() == []
