"""How old a command may be: in realtime an older one is refused; in lockstep none is too old."""

from typing import Any

import pytest
from refused import has_terms

from zsim.contract import keys
from zsim.contract.flight_messages import Mode, Velocity
from zsim.contract.run_messages import Event
from zsim.scenario import scenario_file
from zsim_world.flight.world import World

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
