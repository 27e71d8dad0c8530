"""Requests and joins that repeat without end: counted to the last, published up to a bound, never done unpublished."""

from typing import Any

import pytest
from refused import has_terms

from zsim.contract import keys
from zsim.contract.run_messages import Bye, ControlAnswer, ControlRequest, Event, Join
from zsim.scenario import scenario_file
from zsim_world.flight.run_outbox import CHANGES_MAX, EVENTS_MAX
from zsim_world.flight.world import World

FLOOD = 5000  # requests, several times what is published
SCENARIO = """
name: one
duration_s: 1000
drones: [{name: d1, position_m: [0, 0, 0]}]
processes: {expect: []}
"""


@pytest.fixture
def world() -> World:
    world = World(scenario_file.from_text(SCENARIO), run_id="run1")
    world.advance(0)
    return world


def ask(world: World, op: str, source: str = "me.x", **args: Any) -> ControlAnswer:
    return world.control(ControlRequest(op, args, source))


def events(world: World) -> list[Event]:
    return [message for _, message in world.outbox.take() if isinstance(message, Event)]


def test_refused_requests_are_events_as_often_as_other_refusals(world: World) -> None:
    for _ in range(FLOOD):
        assert not ask(world, "resume").ok
    assert len(events(world)) == EVENTS_MAX
    assert (world.result()["requests"], world.result()["requests_refused"]) == (FLOOD, FLOOD)
    assert not ask(world, "release", drone="d1").ok
    assert [event.subject for event in events(world)] == ["release"]


def test_requests_about_time_are_done_when_they_are_events_no_more(world: World) -> None:
    for number in range(FLOOD):
        assert ask(world, "rate", value=number % 7).ok
    assert len(events(world)) == CHANGES_MAX
    assert world.clock.rate == (FLOOD - 1) % 7


def test_what_changes_the_flight_is_an_event_or_is_refused(world: World) -> None:
    answers = [ask(world, op, drone="d1") for _ in range(FLOOD // 2) for op in ("acquire", "release")]
    done = [event for event in events(world) if event.data["ok"]]
    assert sum(answer.ok for answer in answers) == len(done) == CHANGES_MAX
    assert has_terms(answers[-1].error, "me.x", str(CHANGES_MAX), "one", "gate")
    assert ask(world, "acquire", "other.x", drone="d1").ok
    assert ask(world, "release", "other.x", drone="d1").ok


def test_every_gate_allows_one_change_more(world: World) -> None:
    while ask(world, "acquire", drone="d1").ok:
        pass
    for _ in range(3):
        world.advance(0)
    assert [ask(world, "acquire", drone="d1").ok for _ in range(4)] == [True, True, True, False]


def test_a_process_that_gates_nobody_joins_and_leaves_so_often_only(world: World) -> None:
    for number in range(FLOOD):
        join = Join(0, number, "run1", number, "console", "here", 1, 0)
        world.handle(keys.process("console.x", "join"), join, 0)
        world.handle(keys.process("console.x", "bye"), Bye(0, number, "flood"), 0)
    kinds = [event.kind for event in events(world)]
    assert {kind: kinds.count(kind) for kind in set(kinds)} == {
        "join": CHANGES_MAX,
        "leave": CHANGES_MAX,
        "refused": EVENTS_MAX,
    }
    assert world.result()["refused"] == FLOOD - CHANGES_MAX
