"""Liveliness: dead, silent and slow processes, and which joins are admitted.

A forged join, with no process behind it, replaces no process and holds up the run only briefly.
"""

from collections.abc import Callable
from typing import Any

import pytest
from fake_link import FakeLink
from small_world import GATE_NS, small_world

from zsim.contract import keys, messages
from zsim.contract.run_messages import ControlRequest, Done, Event, Health, Join
from zsim.runtime.membership import HealthMeter
from zsim.scenario.roles import WORLD
from zsim.transport.link_watch import ClosedLink, SessionTokens
from zsim_world.run.inputs import Run
from zsim_world.run.outbox import STRANGERS_MAX
from zsim_world.server.liveliness import (
    BLOCKED_MIN_NS,
    DEAD_NS,
    DONE_NS,
    FIRST_DONE_NS,
    LOOK_NS,
    SILENT_NS,
    TOKEN_NS,
    WITHHELD_MAX,
    Admission,
    HealthWatch,
    LivelinessMonitor,
    SlowReaders,
)

ME = "estimator.d1"
VISITOR = "tester.one"
KINDS = {"join", "restart", "superseded", "no_show", "death", "drop"}
S = 1_000_000_000
STEP_NS = S // 10


class Case:
    """A world, one participant, and the monitor of its liveliness."""

    def __init__(self, name: str, period_ns: int = 0) -> None:
        self.name, self.period_ns = name, period_ns
        self.take_in: Callable[[], None] = lambda: None
        self.world = small_world(processes={"on_death": {"recorder": "end"}})
        run, link = Run(self.world, HealthMeter(WORLD)), FakeLink()
        self.liveliness = LivelinessMonitor(link, run, lambda: self.take_in())  # type: ignore[arg-type]
        self.wall_ns = 10 * S
        self.join(incarnation=1, pid=7)

    def join(self, incarnation: int, pid: int) -> None:
        join = Join(0, 0, "run1", incarnation, self.name.split(".")[0], "h", pid, self.period_ns)
        self.liveliness.before_join(self.name, join)
        self.world.handle(keys.process(self.name, "join"), join, 0)

    def events(self) -> list[str]:
        """Return the kinds of the events about the participant."""
        pending = self.world.outbox.pending
        return [message.kind for key, message in pending if key == keys.EVENT and message.subject == self.name]

    def passes(self, wall_ns: int) -> None:
        """Let wall time pass in steps, with a check after each."""
        for _ in range(wall_ns // STEP_NS):
            self.wall_ns += STEP_NS
            self.liveliness.check_due()


@pytest.fixture
def case_of(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Case]:
    """Return a function that creates a Case whose wall clock only the test advances."""

    def made(*arguments: Any) -> Case:
        case = Case(*arguments)
        monkeypatch.setattr("zsim_world.server.liveliness.time.monotonic_ns", lambda: case.wall_ns)
        case.passes(STEP_NS)
        return case

    return made


@pytest.mark.parametrize(
    ("name", "period_ns", "publisher", "dies"),
    [
        ("recorder", 0, "recorder", True),
        ("console.1", 0, "console.1", True),
        ("recorder", 0, None, False),  # it never published its health
        ("estimator.d1", GATE_NS, "estimator.d1", False),  # the run waits for it
        ("recorder", 0, "somebody", False),
    ],
)
def test_a_reader_that_falls_silent_is_declared_dead(
    case_of: Callable[..., Case], name: str, period_ns: int, publisher: str | None, dies: bool
) -> None:
    case = case_of(name, period_ns)
    if publisher:
        case.liveliness.health_received(publisher)
    case.passes(DEAD_NS)
    assert "death" not in case.events()
    case.wall_ns += 60 * S  # during which the world itself stood still
    case.passes(STEP_NS)
    assert "death" not in case.events()
    case.passes(2 * STEP_NS)
    assert ("death" in case.events()) == dies
    assert (case.world.ended is not None) == (dies and name == "recorder")


def test_a_reader_that_publishes_its_health_is_not_declared_dead(case_of: Callable[..., Case]) -> None:
    case = case_of("recorder")
    for _ in range(3):
        case.liveliness.health_received("recorder")
        case.passes(DEAD_NS)
    assert "death" not in case.events()


@pytest.mark.parametrize(
    ("is_lost", "pid", "kinds"),
    [(True, 8, ["death", "restart"]), (True, 7, ["superseded"]), (False, 8, ["superseded"])],
)
def test_a_join_of_another_process_after_a_lost_token_is_a_restart(is_lost: bool, pid: int, kinds: list[str]) -> None:
    case = Case("estimator.d1", GATE_NS)
    if is_lost:
        case.liveliness.token_lost(case.name)
    case.join(incarnation=2, pid=pid)
    assert case.events()[1:] == kinds


def test_a_join_during_the_check_of_a_lost_token_settles_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zsim_world.server.liveliness.BYE_NS", 0)
    case = Case("estimator.d1", GATE_NS)
    case.take_in = lambda: case.join(incarnation=2, pid=8)
    case.liveliness.token_lost(case.name)
    case.liveliness.check_due()
    assert case.events()[1:] == ["death", "restart"]


class Watched:
    """A health watch and its reports."""

    def __init__(self) -> None:
        self.reports: list[tuple[str, int | None]] = []
        self.watch = HealthWatch(lambda name, since_ns: self.reports.append((name, since_ns)))

    def looks(self, from_ns: int, to_ns: int) -> None:
        for wall_ns in range(from_ns, to_ns + 1, STEP_NS):
            self.watch.look(wall_ns)


def test_silence_is_reported_once_within_two_seconds_and_so_is_its_end():
    case = Watched()
    case.watch.look(10 * S)
    case.watch.received(ME, 10 * S)
    case.looks(10 * S, 10 * S + SILENT_NS - STEP_NS)
    assert case.reports == []
    case.looks(10 * S + SILENT_NS, 15 * S)
    assert case.reports == [(ME, 10 * S)]
    assert SILENT_NS + STEP_NS < 2 * S
    case.watch.received(ME, 15 * S)
    assert case.reports[1:] == [(ME, None)]


def test_silence_while_the_world_was_held_up_is_not_reported():
    case = Watched()
    case.watch.look(10 * S)
    case.watch.received(ME, 10 * S)
    case.watch.look(15 * S)
    case.watch.forget(ME)  # nothing is expected of a process that has left
    case.looks(15 * S, 20 * S)
    assert case.reports == []


CONSOLE = ClosedLink("192.0.2.7:4000", "", ("console.1",), 400_000, 1)
STRANGER = ClosedLink("127.0.0.1:4000", "pid 7 (python reader.py)", (), 70_000, 2)


@pytest.fixture
def readers() -> SlowReaders:
    """The slow readers of a run in which console.1 has published its health."""
    link = FakeLink()
    health = Health(0, 0, "console", "desk", 9, {}, 0, 0, 0, 0, reads=("view/**", "world/event"))
    run = Run(small_world(), HealthMeter(WORLD))
    run.history.add(keys.process("console.1", "health"), messages.encode(health), 0)
    return SlowReaders(link, SessionTokens(link), run)  # type: ignore[arg-type]


def reported(readers: SlowReaders, closed: ClosedLink) -> dict[str, object]:
    """Return the data of the event of a closed link."""
    readers.watch.closed.append(closed)
    readers.report()
    events = [message for key, message in readers._run.world.take_outbox() if key == keys.EVENT]
    (event,) = [event for event in events if event.kind == "slow_reader"]
    assert all(str(name) in event.text for name in (closed.address, *closed.names))
    return event.data


@pytest.mark.parametrize(
    ("closed", "host", "reads"), [(CONSOLE, "192.0.2.7", ["view/**", "world/event"]), (STRANGER, "laptop", [])]
)
def test_a_slow_reader_is_reported_with_what_is_known_of_it(
    readers: SlowReaders, closed: ClosedLink, host: str, reads: list[str]
) -> None:
    data = reported(readers, closed)
    found = (data["host"], data["process"], data["names"], data["reads"], data["times"])
    assert found == (host, closed.process, closed.names, reads, closed.times)


def test_the_number_of_events_about_unknown_sessions_is_limited(readers: SlowReaders) -> None:
    readers.watch.closed.extend(STRANGER._replace(address=f"127.0.0.1:{port}") for port in range(3 * STRANGERS_MAX))
    readers.report()
    events = [message for key, message in readers._run.world.take_outbox() if key == keys.EVENT]
    assert [event.kind for event in events] == ["slow_reader"] * STRANGERS_MAX


class Door:
    """A world, the tokens that processes hold, and a wall clock that a test advances."""

    def __init__(self, trusts: bool = False, mode: str = "lockstep") -> None:
        self.link = FakeLink()
        self.world = small_world(mode, processes={"expect": [ME]})
        tokens = SessionTokens(self.link)  # type: ignore[arg-type]
        tokens.watch()
        run = Run(self.world, HealthMeter(WORLD))
        self.admission = Admission(tokens, run, trusts)
        self.wall_ns = TOKEN_NS
        self._dones = 0

    def join(self, name: str, pid: int, incarnation: int, host: str = "h", period_ns: int = GATE_NS) -> None:
        role = name.split(".")[0]
        join = Join(0, 0, "run1", incarnation, role, host, pid, period_ns)
        self.admission.take(name, join, self.wall_ns)

    def show(self, name: str, session: str = "", alive: bool = True) -> None:
        """Show or remove the token of a process, and that of its session, which a user's own program lacks."""
        self.link.show(keys.token(name), alive)
        if session:
            self.link.show(keys.session_token(name, session), alive)

    def done(self, name: str, t_ns: int, incarnation: int) -> None:
        self.admission.done_received(name, incarnation, self.wall_ns)
        done = Done(t_ns, self._dones, "run1", incarnation, t_ns, 0)
        self._dones += 1
        self.world.handle(keys.process(name, "done"), done, self.wall_ns)

    def passes(self, wall_ns: int) -> None:
        """Let wall time pass in steps, with a check after each."""
        for _ in range(wall_ns // LOOK_NS + 1):
            self.wall_ns += LOOK_NS
            self.admission.check_due(self.wall_ns)

    def flies_for(self, wall_ns: int, incarnation: int = 1) -> None:
        """Let wall time pass while ME keeps up with the world."""
        for _ in range(wall_ns // LOOK_NS + 1):
            self.done(ME, self.world.now_ns, incarnation)
            self.advance()
            self.done(ME, self.world.now_ns, incarnation)
            self.passes(0)

    def gates(self, count: int) -> None:
        for _ in range(count):
            self.world.advance(self.wall_ns)

    def advance(self) -> None:
        while self.world.may_advance():
            self.world.advance(self.wall_ns)

    def fly(self) -> None:
        """Advance a few gates, as far as participants other than ME allow."""
        for _ in range(3):
            self.done(ME, self.world.now_ns, incarnation=1)
            self.advance()
        self.done(ME, self.world.now_ns, incarnation=1)

    def events(self) -> list[Event]:
        return [message for key, message in self.world.outbox.pending if key == keys.EVENT]

    def kinds(self, name: str = ME) -> list[str]:
        return [event.kind for event in self.events() if event.subject == name and event.kind in KINDS]

    def incarnation(self, name: str = ME) -> int:
        return self.world.barrier.participants[name].join.incarnation


@pytest.fixture
def case() -> Door:
    """A run in which ME takes part, with a token, and has published a done."""
    made = Door()
    made.show(ME, "a")
    made.join(ME, pid=7, incarnation=1)
    made.advance()
    made.done(ME, 0, incarnation=1)
    made.passes(LOOK_NS)
    return made


@pytest.mark.parametrize("forged", [{"pid": 8}, {"pid": 7, "host": "elsewhere"}, {"pid": 7, "period_ns": 0}])
def test_a_forged_join_takes_nobody_s_place(case: Door, forged: dict[str, int]) -> None:
    case.join(ME, incarnation=2, **forged)  # type: ignore[arg-type]
    case.flies_for(FIRST_DONE_NS)
    assert case.kinds() == ["join", "no_show"]
    assert (case.incarnation(), case.world.barrier.participants[ME].gating) == (1, True)


def test_a_repeated_forged_join_is_reported_just_as_soon(case: Door) -> None:
    for incarnation in range(2, 2 + FIRST_DONE_NS // LOOK_NS):
        case.join(ME, pid=8, incarnation=incarnation)
        case.flies_for(0)
    case.flies_for(LOOK_NS)
    assert case.kinds() == ["join", "no_show"]


def test_a_join_with_its_own_session_token_takes_over_at_once(case: Door) -> None:
    case.show(ME, "b")
    case.join(ME, pid=8, incarnation=2)
    assert case.kinds() == ["join", "superseded"]
    case.join(ME, pid=9, incarnation=3)  # forged, while both tokens are there
    case.show(ME, "a", alive=False)
    case.show(ME)
    case.flies_for(TOKEN_NS, incarnation=2)
    assert case.incarnation() == 2


def test_a_join_whose_token_arrives_late_takes_over_then(case: Door) -> None:
    case.join(ME, pid=8, incarnation=2)
    case.flies_for(TOKEN_NS // 2)
    case.show(ME, "b")
    case.passes(LOOK_NS)
    assert case.kinds() == ["join", "superseded"]


def test_a_join_without_a_session_token_takes_over_with_its_first_done(case: Door) -> None:
    case.join(ME, pid=8, incarnation=2)
    case.flies_for(TOKEN_NS)
    case.done(ME, case.world.now_ns, incarnation=2)
    assert (case.kinds(), case.incarnation()) == (["join", "superseded"], 2)
    assert case.world.barrier.participants[ME].done_ns == case.world.now_ns


@pytest.mark.parametrize("how", ["held_up", "silent"])
def test_a_join_without_a_token_takes_over_from_an_unresponsive_process(case: Door, how: str) -> None:
    case.join(ME, pid=8, incarnation=2)
    if how == "silent":
        case.world.silence_changed(ME, case.wall_ns)
        case.passes(LOOK_NS)
    else:
        case.advance()
        case.passes(BLOCKED_MIN_NS)
    assert case.kinds() == ["join", "superseded"]


def test_the_same_process_rejoins_without_a_new_token(case: Door) -> None:
    case.join(ME, pid=7, incarnation=2)
    assert case.kinds() == ["join", "superseded"]


@pytest.mark.parametrize("session", ["b", ""])
def test_a_dead_process_is_restarted_only_with_a_token(case: Door, session: str) -> None:
    case.world.died(ME, case.wall_ns)
    case.show(ME, "a", alive=False)
    case.join(ME, pid=8, incarnation=2)
    case.passes(TOKEN_NS)
    assert case.kinds() == ["join", "death", "no_show"]
    case.show(ME, session)
    case.join(ME, pid=9, incarnation=3)
    assert case.kinds()[-1] == "restart"


def test_joins_need_no_token_under_access_control() -> None:
    case = Door(trusts=True)
    case.join(ME, pid=7, incarnation=1)
    case.join(ME, pid=8, incarnation=2)
    case.passes(TOKEN_NS)
    assert case.kinds() == ["join", "superseded"]


@pytest.mark.parametrize("name", [VISITOR, "recorder"])
def test_a_process_that_joins_without_a_token_is_not_waited_for(case: Door, name: str) -> None:
    case.join(name, pid=9, incarnation=1)
    case.done(name, 0, incarnation=1)
    case.flies_for(TOKEN_NS)
    assert case.kinds(name) == ["no_show"]
    assert name not in case.world.barrier.participants


def test_a_visitor_joins_as_soon_as_its_token_is_there(case: Door) -> None:
    case.join(VISITOR, pid=9, incarnation=1)
    case.fly()
    assert case.world.waiting_for(case.wall_ns) == ()
    case.show(VISITOR)
    case.passes(LOOK_NS)
    assert case.kinds(VISITOR) == ["join"]
    assert case.world.barrier.participants[VISITOR].from_ns > 0


def test_strangers_with_new_names_neither_stop_time_nor_fill_memory(case: Door) -> None:
    for number in range(3 * WITHHELD_MAX):
        case.join(f"x.{number}", pid=9, incarnation=1)
    before_ns = case.world.now_ns
    case.flies_for(TOKEN_NS)
    assert case.world.now_ns > before_ns
    assert list(case.world.barrier.participants) == [ME]
    assert len([event for event in case.events() if event.kind == "no_show"]) == STRANGERS_MAX
    assert case.world.outbox.refusals.count >= 3 * WITHHELD_MAX - STRANGERS_MAX


def test_an_unsuitable_join_is_refused_at_once_even_without_a_token(case: Door) -> None:
    case.join(VISITOR, 2, 2, period_ns=GATE_NS + 1)
    case.passes(TOKEN_NS)
    assert [(e.kind, e.subject) for e in case.events()[1:]] == [("refused", keys.process(VISITOR, "join"))]


def test_a_process_that_does_not_gate_joins_at_once(case: Door) -> None:
    case.join(VISITOR, pid=9, incarnation=1, period_ns=0)
    assert case.kinds(VISITOR) == ["join"]
    case.flies_for(TOKEN_NS)
    assert case.kinds(VISITOR) == ["join", "no_show", "drop"]


@pytest.mark.parametrize("keeps_up", [True, False])
def test_a_visitor_without_a_done_is_dropped_unless_another_is_late_too(case: Door, keeps_up: bool) -> None:
    """If ME does not keep up, that may be why the visitor has published nothing."""
    case.show(VISITOR, "v")
    case.join(VISITOR, pid=9, incarnation=1)
    case.fly() if keeps_up else case.advance()
    case.passes(DONE_NS // 2)
    assert case.kinds(VISITOR) == ["join"]
    case.passes(DONE_NS // 2 if keeps_up else 2 * DONE_NS)
    assert case.kinds(VISITOR) == ["join", *(["no_show", "drop"] if keeps_up else [])]


def test_an_expected_process_may_take_any_time_for_its_first_step() -> None:
    case = Door()
    case.show(ME, "a")
    case.join(ME, pid=7, incarnation=1)
    case.advance()
    case.passes(2 * DONE_NS)
    assert case.kinds() == ["join"]


def test_a_successor_that_publishes_nothing_is_declared_dead(case: Door) -> None:
    case.show(ME, "b")
    case.join(ME, pid=8, incarnation=2)
    case.advance()
    case.passes(DONE_NS + LOOK_NS)
    assert case.kinds() == ["join", "superseded", "no_show", "death"]
    assert [waiting.name for waiting in case.world.waiting_for(case.wall_ns)] == [ME]


def test_an_expected_process_is_waited_for_again_after_a_forged_join() -> None:
    case = Door()
    case.world.barrier.expect("recorder")
    case.join(ME, pid=8, incarnation=2)  # forged
    case.passes(TOKEN_NS)
    assert case.kinds() == ["join", "no_show", "drop"]
    assert set(case.world.barrier.absent()) == {ME, "recorder"}


@pytest.fixture
def realtime() -> Door:
    """A realtime run in which ME takes part, with a token, and has published a done."""
    made = Door(mode="realtime")
    made.show(ME, "a")
    made.join(ME, pid=7, incarnation=1)
    made.gates(2)
    made.done(ME, 0, incarnation=1)
    made.passes(LOOK_NS)
    return made


@pytest.mark.parametrize("publishes", [True, False])
def test_a_silent_successor_is_declared_dead_in_realtime_too(realtime: Door, publishes: bool) -> None:
    realtime.show(ME, "b")
    realtime.join(ME, pid=8, incarnation=2)
    realtime.gates(1)
    realtime.passes(DONE_NS // 2)
    assert realtime.kinds() == ["join", "superseded"]
    if publishes:
        realtime.done(ME, realtime.world.now_ns, incarnation=2)
        realtime.gates(3)
        realtime.passes(DONE_NS)
    realtime.passes(DONE_NS // 2)
    assert realtime.kinds() == ["join", "superseded", *([] if publishes else ["no_show", "death"])]


def test_no_done_is_due_in_realtime_when_paused_or_within_a_period(realtime: Door) -> None:
    realtime.show(VISITOR, "v")
    realtime.join(VISITOR, pid=9, incarnation=1, period_ns=100 * GATE_NS)
    realtime.gates(3)
    realtime.passes(2 * DONE_NS)
    assert realtime.kinds(VISITOR) == ["join"]
    realtime.show(ME, "b")
    realtime.join(ME, pid=8, incarnation=2)
    realtime.world.control(ControlRequest("pause", {}, "me.x"))
    realtime.passes(2 * DONE_NS)
    assert realtime.kinds() == ["join", "superseded"]
