"""Floods of requests, commands and joins: all are counted, but events are limited, and no change goes unpublished."""

from collections import Counter

import pytest
from continued import continue_from
from msgspec import UNSET
from msgspec.structs import replace
from refused import has_terms
from small_world import GATE_NS, small_world

from zsim.contract import keys
from zsim.contract.flight_messages import Mode, Velocity
from zsim.contract.run_messages import Bye, ControlAnswer, ControlRequest, Done, Event, Join
from zsim_world.run.outbox import CHANGES_MAX, EVENTS_MAX, REASONS_MAX, REFUSED_MAX, STRANGERS_MAX, UNJOINED, RefusalLog
from zsim_world.run.world import World

FLOOD = 5000  # number of requests, several times what is published


@pytest.fixture
def world() -> World:
    world = small_world(duration_s=1000)
    world.advance(0)
    return world


def ask(world: World, op: str, source: str = "me.x", **args: object) -> ControlAnswer:
    return world.control(ControlRequest(op, args, source))


def join(world: World, name: str, period_ns: int = 0, run_id: str = "run1", incarnation: int = 1) -> None:
    message = Join(0, 0, run_id, incarnation, name.split(".")[0], "here", 1, period_ns)
    world.handle(keys.process(name, "join"), message, 0)


def leave(world: World, name: str, incarnation: int = 1) -> None:
    world.handle(keys.process(name, "bye"), Bye(0, 0, "over", UNSET, "run1", incarnation), 0)


def command(world: World, source: str, seq: int) -> None:
    world.handle(keys.command("d1", "velocity"), Velocity(0, seq, source, (0.0, 0.0, 0.0), 0.0), 0)


def events(world: World) -> list[Event]:
    return [message for _, message in world.take_outbox() if isinstance(message, Event)]


def kinds(world: World) -> dict[str, int]:
    return Counter(event.kind for event in events(world))


def test_refused_requests_are_limited_like_other_refusals(world: World) -> None:
    for _ in range(FLOOD):
        assert not ask(world, "resume").ok
    assert len(events(world)) == EVENTS_MAX
    assert (world.result()["requests"], world.result()["requests_refused"]) == (FLOOD, FLOOD)
    assert not ask(world, "release", drone="d1").ok
    assert [event.subject for event in events(world)] == ["release"]


def test_clock_requests_are_carried_out_beyond_the_limit_of_events(world: World) -> None:
    for number in range(FLOOD):
        assert ask(world, "rate", value=number % 7).ok
    assert len(events(world)) == CHANGES_MAX
    assert world.clock.rate == (FLOOD - 1) % 7


def test_flight_changes_are_limited_with_one_more_allowed_per_gate(world: World) -> None:
    answers = [ask(world, op, drone="d1") for _ in range(FLOOD // 2) for op in ("acquire", "release")]
    done = [event for event in events(world) if event.data["ok"]]
    assert sum(answer.ok for answer in answers) == len(done) == CHANGES_MAX
    assert has_terms(answers[-1].error, "me.x", str(CHANGES_MAX), "<=", str(CHANGES_MAX), "one", "gate")
    assert ask(world, "acquire", "other.x", drone="d1").ok
    assert ask(world, "release", "other.x", drone="d1").ok
    for _ in range(3):
        world.advance(0)
    assert [ask(world, "acquire", drone="d1").ok for _ in range(4)] == [True, True, True, False]


@pytest.mark.parametrize("period_ns", [0, GATE_NS])
def test_joins_and_leaves_of_a_process_are_limited(world: World, period_ns: int) -> None:
    for number in range(FLOOD):
        join(world, "console.x", period_ns, incarnation=number)
        leave(world, "console.x", number)
    assert kinds(world) == {"join": CHANGES_MAX, "leave": CHANGES_MAX, "refused": EVENTS_MAX}
    assert world.result()["refused"] == FLOOD - CHANGES_MAX


def test_superseding_oneself_is_limited_but_not_a_restart_after_a_death(world: World) -> None:
    first = Join(0, 0, "run1", 1, "estimator", "here", 1, GATE_NS)
    for number in range(FLOOD):
        world.handle(keys.process("estimator.d1", "join"), replace(first, incarnation=1 + number), 0)
    assert kinds(world) == {"join": 1, "superseded": CHANGES_MAX - 1, "refused": EVENTS_MAX}
    world.died("estimator.d1", 0)
    world.handle(keys.process("estimator.d1", "join"), replace(first, incarnation=2 * FLOOD), 0)
    assert kinds(world) == {"death": 1, "restart": 1}


def test_mode_commands_of_a_gating_process_are_all_carried_out(world: World) -> None:
    join(world, "me.x", GATE_NS)
    events(world)
    for number in range(FLOOD):
        mode = Mode(0, number, "me.x", "emergency" if number % 2 else "reset")
        world.handle(keys.command("d1", "mode"), mode, 0)
    for _ in range(2):  # they take effect a gate later
        world.advance(0)
    assert kinds(world)["mode"] == CHANGES_MAX
    refused, left_out = world.outbox.refusals.count, world.result()["events_left_out"]
    assert CHANGES_MAX + refused + left_out == FLOOD
    assert world.fleet.status(0)[0] == "emergency"


def test_events_about_outputs_never_published_are_limited(world: World) -> None:
    join(world, "me.x", GATE_NS)
    events(world)
    for number in range(2 * CHANGES_MAX):
        world.handle(keys.process("me.x", "done"), Done(0, number, "run1", 1, 0, 1), 0)
        world.give_up_outputs("me.x")
    assert kinds(world) == {"outputs_missing": CHANGES_MAX}
    assert world.result()["events_left_out"] == CHANGES_MAX


def test_a_command_of_a_process_that_does_not_gate_is_an_event_or_refused(world: World) -> None:
    for seq in range(FLOOD):
        command(world, "me.x", seq)
    assert kinds(world) == {"command": CHANGES_MAX, "refused": EVENTS_MAX}
    assert world.result()["refused"] == FLOOD - CHANGES_MAX
    command(world, "other.x", 0)
    assert kinds(world) == {"command": 1}
    world.advance(0)
    events(world)
    command(world, "me.x", FLOOD)
    assert kinds(world) == {"command": 1}


def test_commands_under_new_names_that_have_not_joined_are_limited(world: World) -> None:
    join(world, "me.x")
    events(world)
    for number in range(4 * UNJOINED * CHANGES_MAX):
        command(world, f"s.{number}", 0)
    assert kinds(world) == {"command": UNJOINED * CHANGES_MAX, "refused": REFUSED_MAX}
    command(world, "me.x", 0)
    assert kinds(world) == {"command": 1}


@pytest.mark.parametrize("period_ns", [0, GATE_NS])
def test_joins_of_newcomers_are_limited_over_all_names(world: World, period_ns: int) -> None:
    for number in range(FLOOD):
        join(world, f"console.{number}", run_id="another")
        join(world, f"console.{number}", period_ns)
    assert kinds(world) == {"join": STRANGERS_MAX, "refused": REFUSED_MAX}
    assert len(world.barrier.participants) == STRANGERS_MAX
    assert world.result()["refused"] == 2 * FLOOD - STRANGERS_MAX
    join(world, "estimator.d1", period_ns)
    join(world, "console.0", period_ns)
    leave(world, "console.0")
    join(world, "console.0", period_ns)
    assert kinds(world) == {"join": 3, "leave": 1}


def test_the_refusal_of_a_newcomer_names_count_and_limit(world: World) -> None:
    for number in range(STRANGERS_MAX + 1):
        join(world, f"console.{number}")
    last = events(world)[-1].text
    assert has_terms(last, "number", "new", "processes", str(STRANGERS_MAX), "<=", str(STRANGERS_MAX), "one", "second")


def test_one_more_newcomer_per_second_is_allowed_also_in_a_continued_run(world: World) -> None:
    for number in range(FLOOD):
        join(world, f"console.{number}")
    events(world)
    again = World(world.scenario, run_id="run1")
    continue_from(world, again)
    join(again, "late.1")
    assert kinds(again) == {}  # not even a refusal
    for _ in range(50):
        world.advance(0)
    events(world)
    join(world, "late.1")
    join(world, "late.2")
    assert kinds(world) == {"join": 1, "refused": 1}


def test_refusals_and_forged_joins_are_limited_over_all_sources(world: World) -> None:
    for number in range(FLOOD):
        world.falsely_joined(f"x.{number}", Join(0, 0, "run1", 1, "x", "here", 1, GATE_NS), "no token")
    assert kinds(world) == {"no_show": STRANGERS_MAX}
    assert world.result()["refused"] == FLOOD - STRANGERS_MAX
    for number in range(FLOOD):
        world.outbox.refuse(f"s.{number}", "clock", "no")
    assert kinds(world) == {"refused": REFUSED_MAX}
    assert world.result()["refused"] == 2 * FLOOD - STRANGERS_MAX


MODE = "drone/d1/cmd/mode"


@pytest.fixture
def refusals() -> RefusalLog:
    return RefusalLog(lambda: 0)


def test_the_first_refusals_of_a_source_are_events_and_all_are_counted(refusals: RefusalLog):
    texts = [refusals.add("a.one", MODE, "too late") for _ in range(EVENTS_MAX + 5)]
    assert texts[0] == f"{MODE}: too late"
    assert (texts[EVENTS_MAX - 1] or "").endswith("counted only)")  # as reports look for it
    assert texts[EVENTS_MAX:] == [None] * 5
    assert refusals.add("b.two", MODE, "too late") == texts[0]
    assert refusals.count == EVENTS_MAX + 6


def test_a_new_reason_is_an_event_even_after_many_of_another(refusals: RefusalLog):
    ages = [refusals.add("a.one", MODE, f"age is {500.5 + age} ms; must be <= 500 ms") for age in range(2 * EVENTS_MAX)]
    assert len([text for text in ages if text]) == EVENTS_MAX
    assert refusals.add("a.one", MODE, "landed") == f"{MODE}: landed"


def test_events_about_ever_new_reasons_are_limited(refusals: RefusalLog):
    texts = [refusals.add("a.one", MODE, "x" * length) for length in range(1, 1 + 100 * EVENTS_MAX)]
    assert len([text for text in texts if text]) == REASONS_MAX + EVENTS_MAX
    assert refusals.count == 100 * EVENTS_MAX
