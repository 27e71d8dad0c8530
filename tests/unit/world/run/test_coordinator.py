"""How a run reacts to processes that die, stay away, fail or leave early."""

from typing import Any

import pytest
import yaml
from continued import continue_from
from msgspec import UNSET
from refused import has_terms
from small_world import GATE_NS, events_of, small_world

from zsim.contract import keys
from zsim.contract.run_messages import Bye, ControlRequest, Done, Join
from zsim.errors import RunFailedError, ScenarioError
from zsim.runtime.membership import HealthMeter
from zsim_world.run import inputs
from zsim_world.run.coordinator import DataFlow
from zsim_world.run.inputs import Called, Run
from zsim_world.run.world import World

ME, OWN = "estimator.d1", "fence.main"
RETURN_NS = 2_000_000_000


def join(made: World, name: str, incarnation: int = 1, period_ns: int = GATE_NS, **more: Any) -> None:
    message = Join(0, 0, "run1", incarnation, name.split(".")[0], "h", 7, period_ns, **more)
    made.handle(keys.process(name, "join"), message, 0)


def say_bye(made: World, name: str = ME, reason: str = "enough", **of: Any) -> None:
    made.handle(keys.process(name, "bye"), Bye(0, 0, reason, **of), 5)


def world(processes: str = "on_death: {}", mode: str = "lockstep") -> World:
    """Return a world that ME joined at wall time 0 and that now waits for ME."""
    made = small_world(mode, processes=yaml.safe_load(f"{{{processes}}}"))
    join(made, ME)
    while made.may_advance():
        made.advance(0)
    made.take_outbox()
    return made


def events(made: World) -> list[tuple[str, str]]:
    """Return the kinds and subjects of the events since the last call."""
    return [(event.kind, event.subject) for event in events_of(made)]


def test_a_dead_process_is_overdue_exactly_after_its_return_time() -> None:
    made = world("return_s: 2")
    assert made.overdue(10 * RETURN_NS) is None
    made.died(ME, 1)
    assert (made.overdue(RETURN_NS + 1), made.overdue(RETURN_NS + 2)) == (None, ME)
    made.expired(ME)
    assert events(made) == [("death", ME), ("overdue", ME)]
    assert has_terms(made.ended or "", ME, "2")


@pytest.mark.parametrize(("processes", "changes"), [("on_death: {}", ["death"]), ("return_s: 2", ["silence", "back"])])
def test_no_process_is_overdue_without_a_return_time_or_once_it_is_back(processes: str, changes: list[str]) -> None:
    made = world(processes)
    for change in changes:
        made.died(ME, 1) if change == "death" else made.silence_changed(ME, 5 if change == "silence" else None)
    assert made.overdue(10**18) is None


@pytest.mark.parametrize("whose", ["estimator", ME])
def test_a_run_continues_without_an_overdue_process_if_configured(whose: str) -> None:
    made = world(f"return_s: 2, on_overdue: {{{whose}: drop}}")
    made.died(ME, 1)
    assert not made.may_advance()
    made.expired(ME)
    assert events(made) == [("death", ME), ("overdue", ME), ("drop", ME)]
    assert made.ended is None
    assert made.may_advance()


@pytest.mark.parametrize("name", ["camera.main", "detector.d1"])
def test_an_overdue_process_that_does_not_gate_does_not_end_the_run(name: str) -> None:
    made = world("return_s: 2")
    join(made, name, 2, period_ns=0)
    made.died(name, 1)
    made.expired(name)
    assert events(made)[-3:] == [("death", name), ("overdue", name), ("drop", name)]
    assert made.ended is None


@pytest.mark.parametrize(("on_death", "ends"), [("wait", True), ("restart", True), ("end", True), ("drop", False)])
def test_a_silent_process_is_overdue_too_and_handled_by_on_death(on_death: str, ends: bool) -> None:
    made = world(f"return_s: 2, on_death: {{estimator: {on_death}}}")
    made.silence_changed(ME, 5)
    assert (made.overdue(RETURN_NS + 5), made.overdue(RETURN_NS + 6)) == (None, ME)
    made.expired(ME)
    assert (made.ended is not None) is ends


def test_on_overdue_cannot_be_wait() -> None:
    with pytest.raises(ScenarioError, match=r"processes\.on_overdue\.estimator"):
        small_world(processes={"return_s": 1, "on_overdue": {"estimator": "wait"}})


@pytest.mark.parametrize(
    ("method", "args"),
    [
        ("await_return", (5, True)),
        ("control", (ControlRequest("acquire", {"drone": "d1"}, "me.x"),)),
        ("died", (ME, 1)),
        ("expired", (ME,)),
        ("falsely_joined", (ME, Join(0, 0, "run1", 2, "estimator", "h", 8, GATE_NS), "no token")),
        ("give_up_outputs", (ME,)),
        ("join", (ME, Join(0, 0, "run1", 2, "estimator", "h", 8, GATE_NS), 5)),
        ("not_shown", (ME, "no token", 5)),
        ("reader_closed", ("text", {"address": "a", "names": ["b"]})),
        ("silence_changed", (ME, 5)),
    ],
)
def test_calls_replayed_from_the_journal_have_the_same_effect(method: str, args: tuple[Any, ...]) -> None:
    assert method in inputs.CALLS
    (entry,) = inputs.decode(inputs.encode([Called(method, args)]))
    made, again = world("return_s: 2"), world("return_s: 2")
    assert getattr(made, method)(*args) == Run(again, HealthMeter("world")).enter(entry)
    assert events_of(made) == events_of(again)
    assert made.barrier.participants == again.barrier.participants


# A process that never joins


def waiting(processes: str, is_launched: bool = True) -> World:
    """Return a world that waits for OWN, and for the estimator that its launcher starts."""
    made = small_world(processes={"expect": [OWN, ME], **yaml.safe_load(f"{{{processes}}}")})
    made.is_launched = is_launched
    return made


@pytest.mark.parametrize(
    ("processes", "is_launched", "after_s", "name"),
    [
        ("on_death: {}", True, 59.9, None),
        ("on_death: {}", True, 60.1, OWN),
        ("on_death: {}", False, 10_000.0, None),
        ("start_timeout_s: 5", False, 5.1, OWN),
        ("start_timeout_s: 500", True, 400.0, None),
    ],
)
def test_a_process_that_never_joins_is_overdue_after_the_timeout(
    processes: str, is_launched: bool, after_s: float, name: str | None
) -> None:
    assert waiting(processes, is_launched).overdue(round(after_s * 1e9)) == name


def test_a_process_started_by_the_launcher_has_time_to_compile() -> None:
    made = waiting("on_death: {}")
    join(made, OWN)
    assert (made.overdue(61 * 10**9), made.overdue(601 * 10**9)) == (None, ME)


def test_a_run_fails_if_an_expected_process_never_joins() -> None:
    made = waiting("start_timeout_s: 5")
    made.expired(OWN)
    assert events(made) == [("overdue", OWN)]
    assert isinstance(made.failure, RunFailedError)
    assert has_terms(str(made.failure), OWN, "5", "processes.start_timeout_s")
    assert made.ended == str(made.failure)


def test_a_run_starts_without_an_overdue_process_if_configured() -> None:
    made = waiting("start_timeout_s: 5, on_overdue: {fence: drop}")
    join(made, ME)
    assert not made.may_advance()
    made.expired(OWN)
    assert [kind for kind, name in events(made) if name == OWN] == ["overdue", "drop"]
    assert made.may_advance()
    assert made.failure is None


# Processes that fail or leave


@pytest.mark.parametrize(
    ("on_death", "kinds", "ends", "waits"),
    [
        ("restart", ["failure"], True, False),
        ("end", ["failure"], True, False),
        ("wait", ["failure"], False, True),
        ("drop", ["failure", "drop"], False, False),
    ],
)
def test_a_failed_process_is_reported_and_handled_by_on_death(
    on_death: str, kinds: list[str], ends: bool, waits: bool
) -> None:
    made = world(f"on_death: {{estimator: {on_death}}}")
    say_bye(made, reason="mine:Law.rates raised", failed=True, run_id="run1", incarnation=1)
    assert [kind for kind, name in events(made) if name == ME] == kinds
    assert made.ended == ("mine:Law.rates raised" if ends else None)
    assert (made.failure is not None) is ends
    assert made.may_advance() is not (ends or waits)


@pytest.mark.parametrize(
    ("of", "wrong"),
    [
        ({"run_id": "run1", "incarnation": 2}, ("incarnation", "2", "1")),
        ({"run_id": "run0", "incarnation": 1}, ("run_id", "'run0'", "'run1'")),
        ({"incarnation": 2}, ("incarnation", "2", "1")),
        ({"run_id": "run0"}, ("run_id", "'run0'", "'run1'")),
    ],
)
@pytest.mark.parametrize("failed", [UNSET, True])
def test_a_bye_of_another_incarnation_or_run_is_refused(
    of: dict[str, Any], wrong: tuple[str, ...], failed: Any
) -> None:
    made = world()
    say_bye(made, failed=failed, **of)
    (event,) = events_of(made)
    assert event.kind == "refused"
    assert has_terms(event.text, f"process/{ME}/bye", *wrong)
    assert made.barrier.participants[ME].alive
    assert made.ended is None


def test_a_late_bye_of_a_former_incarnation_ends_nothing() -> None:
    made = world()
    made.died(ME, 1)
    join(made, ME, 2)
    say_bye(made, run_id="run1", incarnation=1)
    assert [kind for kind, _ in events(made)] == ["death", "restart", "refused"]
    assert made.barrier.participants[ME].join.incarnation == 2


@pytest.mark.parametrize("failed", [UNSET, True])
def test_a_bye_without_an_incarnation_counts_once_the_token_is_gone(failed: Any) -> None:
    made = world("on_death: {estimator: drop}")
    say_bye(made, failed=failed)
    assert events(made) == []
    made.died(ME, 6)
    assert [kind for kind, _ in events(made)] == (["failure", "drop"] if failed is True else ["leave"])
    assert ME not in made.barrier.participants


@pytest.mark.parametrize("is_over", [False, True])
def test_a_bye_without_an_incarnation_counts_without_a_token_or_at_the_end(is_over: bool) -> None:
    made = world()
    say_bye(made)
    made.publish_end() if is_over else made.not_shown(ME, "has no liveliness token", 6)
    assert events(made) == [("leave", ME), *[("end", "world")] * is_over]
    assert not made.waiting_to_leave()
    assert (made.left_early == []) is is_over


def test_a_done_after_a_bye_without_an_incarnation_refutes_the_bye() -> None:
    """A living estimator for which another process says bye takes part as before, and its death counts as a death."""
    made = world()
    say_bye(made)
    made.handle(keys.process(ME, "done"), Done(0, 0, "run1", 1, 0, 0), 6)
    (event,) = events_of(made)
    assert event.kind == "refused"
    assert has_terms(event.text, f"process/{ME}/bye", "incarnation", "missing", "1")
    made.died(ME, 7)
    assert events(made) == [("death", ME)]


@pytest.mark.parametrize(
    ("processes", "serves", "fails"),
    [
        ("on_death: {}", (), True),
        ("on_death: {estimator: drop}", (), False),
        ("on_death: {estimator.d1: drop}", (), False),
        ("on_death: {}", (ME,), False),
    ],
)
def test_an_early_leaver_is_reported_and_fails_the_run_unless_allowed(
    processes: str, serves: tuple[str, ...], fails: bool
) -> None:
    made = world(processes)
    if serves:
        join(made, "host.b", 9, period_ns=0, serves=serves)
    made.take_outbox()
    say_bye(made, run_id="run1", incarnation=1)
    (event,) = events_of(made)
    assert event.data == {"reason": "enough", "run_id": "run1", "incarnation": 1, **({"fails": True} if fails else {})}
    assert [has_terms(line, ME, "0.02 s", "enough") for line in made.left_early] == [True] * fails
    assert made.ended is None
    restored = world(processes)
    continue_from(made, restored)
    assert restored.left_early == made.left_early


@pytest.mark.parametrize("name", ["console.1", "recorder"])
def test_an_unneeded_process_may_leave_but_a_recorder_ends_the_run(name: str) -> None:
    made = world()
    join(made, name, 4, period_ns=0)
    say_bye(made, name, run_id="run1", incarnation=4)
    assert made.left_early == []
    assert (made.ended is not None) is (name == "recorder")


# Which processes hold up which

PAIR: dict[str, Any] = {"drones": 2, "clusters": [{"name": "main", "drones": ["d1", "d2"]}]}
ESTIMATORS, CONTROLLER = ("estimator.d1", "estimator.d2"), "controller.main"


def test_only_estimators_feed_the_controller_and_the_planner():
    flow = DataFlow(small_world(**PAIR).scenario)
    names = (*ESTIMATORS, CONTROLLER, "planner.main", "tester.one")
    pairs = {(writer, reader) for writer in names for reader in names if flow.feeds(writer, reader)}
    assert pairs == {(e, reader) for e in ESTIMATORS for reader in (CONTROLLER, "planner.main")}


@pytest.mark.parametrize(
    ("done", "held_by"),
    [
        (["estimator.d1"], {"estimator.d2": (), CONTROLLER: ("estimator.d2",)}),  # the controller is held up
        (ESTIMATORS, {CONTROLLER: ()}),  # the controller is the cause
    ],
)
def test_a_process_that_lacks_an_estimate_is_reported_as_held_up(done: list[str], held_by: dict[str, tuple[str, ...]]):
    made = small_world(**PAIR)
    for name in (*ESTIMATORS, CONTROLLER):
        join(made, name)
    while made.may_advance():
        made.advance(0)
    for name in done:
        made.handle(keys.process(name, "done"), Done(0, 0, "run1", 1, 0, 0), 0)
    assert {waiting.name: waiting.held_by for waiting in made.waiting_for(10**9)} == held_by
