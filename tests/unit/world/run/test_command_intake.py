"""How old a command may be: in realtime older ones are refused; and what a bridge reports of a mission is an event."""

from typing import Any

import pytest
from refused import has_terms

from zsim.contract import keys
from zsim.contract.flight_messages import Mode, Velocity
from zsim.contract.run_messages import ControlRequest, Event
from zsim.scenario import scenario_file
from zsim_world.run.world import World

GATE_MS = 20
AGE_MAX_MS = 400
SCENARIO = f"""
name: one
duration_s: 10
time: {{max_command_age_ms: {AGE_MAX_MS}}}
drones: [{{name: d1, position_m: [0, 0, 0]}}]
processes: {{expect: []}}
"""


def refusals(mode: str, age_ms: int, kind: str = "velocity") -> list[dict[str, Any]]:
    """Return the refusals of a command of gate 0 that comes so much later."""
    world = World(scenario_file.from_text(SCENARIO), mode, run_id="run1")
    for _ in range(1 + age_ms // GATE_MS):
        world.advance(0)
    command = Mode(0, 0, "me.x", "land") if kind == "mode" else Velocity(0, 0, "me.x", (0.0, 0.0, 0.0), 0.0)
    world.handle(keys.command("d1", kind), command, 0)
    events = [message for _, message in world.outbox.take() if isinstance(message, Event)]
    return [event.data for event in events if event.kind == "refused"]


@pytest.mark.parametrize("kind", ["velocity", "mode"])
def test_an_old_command_is_refused_in_realtime(kind: str):
    (refusal,) = refusals("realtime", AGE_MAX_MS + GATE_MS, kind)
    assert has_terms(refusal["reason"], "age", "420 ms", "400 ms")


def test_the_greatest_age_is_allowed():
    assert refusals("realtime", AGE_MAX_MS) == []


def test_lockstep_judges_no_age():
    assert refusals("lockstep", 10 * AGE_MAX_MS) == []


MISSION = {"drone": "d1", "state": "aborted", "items": 5, "done": 3, "reason": "it left its geofence", "failsafe": True}


def reported(**changed: Any) -> tuple[str, list[Event]]:
    """Report a mission; return the refusal and the events of missions."""
    world = World(scenario_file.from_text(SCENARIO), "realtime", run_id="run1")
    world.advance(0)
    answer = world.control(ControlRequest("mission", MISSION | changed, "mavlink.main"))
    events = [message for _, message in world.outbox.take() if isinstance(message, Event)]
    return answer.error, [event for event in events if event.kind == "mission"]


def test_a_mission_that_is_reported_is_an_event_of_its_drone():
    error, (event,) = reported()
    assert (error, event.subject, event.source) == ("", "d1", "mavlink.main")
    assert event.data == {name: value for name, value in MISSION.items() if name != "drone"}
    assert has_terms(event.text, "3 of 5 items", "geofence")


@pytest.mark.parametrize(
    "changed", [{"drone": "d9"}, {"state": "lost"}, {"items": -1}, {"done": "3"}, {"done": 10**9}, {"items": True}]
)
def test_a_report_of_a_mission_that_is_none_is_refused_and_is_no_event(changed: dict[str, Any]):
    error, events = reported(**changed)
    ((name, value),) = changed.items()
    assert error.startswith(f"{name} is {value!r}; must be ")
    assert events == []
