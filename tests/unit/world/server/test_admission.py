"""Whose join counts: a join that nobody is behind costs nobody his place, and time for a while only."""

import pytest
from fake_link import FakeLink

from zsim.contract import keys
from zsim.contract.run_messages import ControlRequest, Done, Event, Join
from zsim.runtime.membership import HealthMeter
from zsim.scenario import scenario_file
from zsim.scenario.roles import WORLD
from zsim.transport.link_watch import SessionTokens
from zsim_world.run.inputs import Run
from zsim_world.run.outbox import STRANGERS_MAX
from zsim_world.run.world import World
from zsim_world.server.liveliness import DONE_NS, HELD_NS, LOOK_NS, SHOWN_NS, TOKEN_NS, WITHHELD_MAX, Admission

GATE_NS = 20_000_000
ME = "estimator.d1"
VISITOR = "tester.one"
SCENARIO = """
name: one
duration_s: 1
drones: [{name: d1, position_m: [0, 0, 0]}]
processes: {expect: [estimator.d1]}
"""
KINDS = {"join", "restart", "superseded", "no_show", "death", "drop"}


class Case:
    """A world, who holds which token, and a wall clock that a test turns."""

    def __init__(self, trusts: bool = False, mode: str = "lockstep") -> None:
        self.link = FakeLink()
        self.world = World(scenario_file.from_text(SCENARIO), mode, run_id="run1")
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
        """Let a token of a process appear, or go, and that of its session unless it is a program of somebody's own."""
        self.link.show(keys.token(name), alive)
        if session:
            self.link.show(keys.session_token(name, session), alive)

    def done(self, name: str, t_ns: int, incarnation: int) -> None:
        self.admission.done_received(name, incarnation, self.wall_ns)
        done = Done(t_ns, self._dones, "run1", incarnation, t_ns, 0)
        self._dones += 1
        self.world.handle(keys.process(name, "done"), done, self.wall_ns)

    def passes(self, wall_ns: int) -> None:
        """Let wall time pass, look by look."""
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
        """Go on for a few gates, as far as others than ME allow it."""
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
def case() -> Case:
    """A run in which ME takes part, with a token, and has published a done."""
    made = Case()
    made.show(ME, "a")
    made.join(ME, pid=7, incarnation=1)
    made.advance()
    made.done(ME, 0, incarnation=1)
    made.passes(LOOK_NS)
    return made


@pytest.mark.parametrize("forged", [{"pid": 8}, {"pid": 7, "host": "elsewhere"}, {"pid": 7, "period_ns": 0}])
def test_a_join_that_nobody_is_behind_takes_nobody_s_place(case: Case, forged: dict[str, int]) -> None:
    case.join(ME, incarnation=2, **forged)  # type: ignore[arg-type]
    case.flies_for(SHOWN_NS)
    assert case.kinds() == ["join", "no_show"]
    assert (case.incarnation(), case.world.barrier.participants[ME].gating) == (1, True)


def test_one_that_is_repeated_is_named_as_soon(case: Case) -> None:
    for incarnation in range(2, 2 + SHOWN_NS // LOOK_NS):
        case.join(ME, pid=8, incarnation=incarnation)
        case.flies_for(0)
    case.flies_for(LOOK_NS)
    assert case.kinds() == ["join", "no_show"]


def test_one_with_a_token_of_its_own_session_takes_over_at_once(case: Case) -> None:
    case.show(ME, "b")
    case.join(ME, pid=8, incarnation=2)
    assert case.kinds() == ["join", "superseded"]
    case.join(ME, pid=9, incarnation=3)  # of nobody, while both tokens are there
    case.show(ME, "a", alive=False)
    case.show(ME)
    case.flies_for(TOKEN_NS, incarnation=2)
    assert case.incarnation() == 2


def test_one_whose_token_comes_late_over_a_router_takes_over_then(case: Case) -> None:
    case.join(ME, pid=8, incarnation=2)
    case.flies_for(TOKEN_NS // 2)
    case.show(ME, "b")
    case.passes(LOOK_NS)
    assert case.kinds() == ["join", "superseded"]


def test_a_program_without_such_a_token_takes_over_with_its_first_done(case: Case) -> None:
    case.join(ME, pid=8, incarnation=2)
    case.flies_for(TOKEN_NS)
    case.done(ME, case.world.now_ns, incarnation=2)
    assert (case.kinds(), case.incarnation()) == (["join", "superseded"], 2)
    assert case.world.barrier.participants[ME].done_ns == case.world.now_ns


@pytest.mark.parametrize("how", ["held_up", "silent"])
def test_or_as_soon_as_the_one_that_lives_is_not_there(case: Case, how: str) -> None:
    case.join(ME, pid=8, incarnation=2)
    if how == "silent":
        case.world.silence_changed(ME, case.wall_ns)
        case.passes(LOOK_NS)
    else:
        case.advance()
        case.passes(HELD_NS)
    assert case.kinds() == ["join", "superseded"]


def test_the_same_process_rejoins_without_another_token(case: Case) -> None:
    case.join(ME, pid=7, incarnation=2)
    assert case.kinds() == ["join", "superseded"]


@pytest.mark.parametrize("session", ["b", ""])
def test_nobody_restarts_the_dead_without_a_token(case: Case, session: str) -> None:
    case.world.died(ME, case.wall_ns)
    case.show(ME, "a", alive=False)
    case.join(ME, pid=8, incarnation=2)
    case.passes(TOKEN_NS)
    assert case.kinds() == ["join", "death", "no_show"]
    case.show(ME, session)
    case.join(ME, pid=9, incarnation=3)
    assert case.kinds()[-1] == "restart"


def test_access_control_is_trusted() -> None:
    case = Case(trusts=True)
    case.join(ME, pid=7, incarnation=1)
    case.join(ME, pid=8, incarnation=2)
    case.passes(TOKEN_NS)
    assert case.kinds() == ["join", "superseded"]


@pytest.mark.parametrize("name", [VISITOR, "recorder"])
def test_who_joins_without_a_token_is_not_waited_for(case: Case, name: str) -> None:
    case.join(name, pid=9, incarnation=1)
    case.done(name, 0, incarnation=1)
    case.flies_for(TOKEN_NS)
    assert case.kinds(name) == ["no_show"]
    assert name not in case.world.barrier.participants


def test_a_visitor_joins_as_soon_as_its_token_is_there(case: Case) -> None:
    case.join(VISITOR, pid=9, incarnation=1)
    case.fly()
    assert case.world.waiting_for(case.wall_ns) == ()
    case.show(VISITOR)
    case.passes(LOOK_NS)
    assert case.kinds(VISITOR) == ["join"]
    assert case.world.barrier.participants[VISITOR].from_ns > 0


def test_strangers_under_fresh_names_stop_no_time_and_fill_no_memory(case: Case) -> None:
    for number in range(3 * WITHHELD_MAX):
        case.join(f"x.{number}", pid=9, incarnation=1)
    before_ns = case.world.now_ns
    case.flies_for(TOKEN_NS)
    assert case.world.now_ns > before_ns
    assert list(case.world.barrier.participants) == [ME]
    assert len([event for event in case.events() if event.kind == "no_show"]) == STRANGERS_MAX
    assert case.world.outbox.refusals.count >= 3 * WITHHELD_MAX - STRANGERS_MAX


def test_one_that_does_not_fit_the_run_is_refused_at_once_token_or_not(case: Case) -> None:
    case.join(VISITOR, 2, 2, period_ns=GATE_NS + 1)
    case.passes(TOKEN_NS)
    assert [(e.kind, e.subject) for e in case.events()[1:]] == [("refused", keys.process(VISITOR, "join"))]


def test_one_that_does_not_gate_joins_at_once(case: Case) -> None:
    case.join(VISITOR, pid=9, incarnation=1, period_ns=0)
    assert case.kinds(VISITOR) == ["join"]
    case.flies_for(TOKEN_NS)
    assert case.kinds(VISITOR) == ["join", "no_show", "drop"]


@pytest.mark.parametrize("keeps_up", [True, False])
def test_who_never_publishes_a_done_is_dropped_but_not_while_time_stands_for_another_too(
    case: Case, keeps_up: bool
) -> None:
    """Where ME does not keep up, that may be why the visitor has published nothing."""
    case.show(VISITOR, "v")
    case.join(VISITOR, pid=9, incarnation=1)
    case.fly() if keeps_up else case.advance()
    case.passes(DONE_NS // 2)
    assert case.kinds(VISITOR) == ["join"]
    case.passes(DONE_NS // 2 if keeps_up else 2 * DONE_NS)
    assert case.kinds(VISITOR) == ["join", *(["no_show", "drop"] if keeps_up else [])]


def test_nor_one_of_the_scenario_however_long_its_first_step_takes() -> None:
    case = Case()
    case.show(ME, "a")
    case.join(ME, pid=7, incarnation=1)
    case.advance()
    case.passes(2 * DONE_NS)
    assert case.kinds() == ["join"]


def test_a_successor_that_publishes_nothing_is_dead(case: Case) -> None:
    case.show(ME, "b")
    case.join(ME, pid=8, incarnation=2)
    case.advance()
    case.passes(DONE_NS + LOOK_NS)
    assert case.kinds() == ["join", "superseded", "no_show", "death"]
    assert [waiting.name for waiting in case.world.waiting_for(case.wall_ns)] == [ME]


def test_before_the_start_the_scenario_s_process_is_waited_for_again() -> None:
    case = Case()
    case.world.barrier.expect("recorder")
    case.join(ME, pid=8, incarnation=2)  # by nobody
    case.passes(TOKEN_NS)
    assert case.kinds() == ["join", "no_show", "drop"]
    assert set(case.world.barrier.absent()) == {ME, "recorder"}


@pytest.fixture
def realtime() -> Case:
    """A realtime run in which ME takes part, with a token, and has published a done."""
    made = Case(mode="realtime")
    made.show(ME, "a")
    made.join(ME, pid=7, incarnation=1)
    made.gates(2)
    made.done(ME, 0, incarnation=1)
    made.passes(LOOK_NS)
    return made


@pytest.mark.parametrize("publishes", [True, False])
def test_in_realtime_a_successor_that_publishes_nothing_is_dead_too(realtime: Case, publishes: bool) -> None:
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


def test_in_realtime_no_done_is_due_while_the_run_is_paused_or_before_a_period_is_over(realtime: Case) -> None:
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
