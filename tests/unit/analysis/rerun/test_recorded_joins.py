"""Joins on record: repeated when they were let in, not when they were published, and never if they were not."""

from typing import Any

import pytest

from zsim.contract import keys, messages
from zsim.contract.run_messages import Event, Join
from zsim.record import Recorded
from zsim.scenario import scenario_file
from zsim_analysis.reading.recorded_run import GateInputs, RecordedAgents
from zsim_analysis.rerun_bus import RerunBus
from zsim_world.run.world import World

GATE_NS = 20_000_000
VISITOR = "tester.one"
SCENARIO = scenario_file.from_text(
    "{name: one, duration_s: 1, drones: [{name: d1, position_m: [0, 0, 0]}], processes: {expect: []}}"
)
ALONE = RecordedAgents((), "none", (), frozenset(), None, "")


def recorded(key: str, message: Any) -> Recorded:
    return Recorded(key, messages.encode(message), message.t_ns, 0)


JOIN = recorded(keys.process(VISITOR, "join"), Join(0, 0, "run1", 7, "tester", "h", 1, GATE_NS))
EVENT = recorded(keys.EVENT, Event(0, 0, "join", VISITOR, VISITOR, "", {"incarnation": 7}))
OTHER = recorded(keys.EVENT, Event(0, 0, "join", VISITOR, VISITOR, "", {"incarnation": 8}))


@pytest.mark.parametrize(
    ("gates", "taking_part"),
    [
        ([[JOIN]], [True]),
        ([[], [JOIN, EVENT]], [False, True]),
        ([[], [JOIN], [EVENT]], [False, False, True]),
        ([[], [JOIN], [OTHER]], [False, False, False]),
    ],
)
def test_a_join_is_repeated_when_it_was_let_in(gates: list[list[Recorded]], taking_part: list[bool]) -> None:
    world = World(SCENARIO, run_id="run1")
    bus = RerunBus(world, ALONE, world.info(), SCENARIO)
    found: list[bool] = []
    for step, inputs in enumerate(gates):
        bus.fly_to(GateInputs(step * GATE_NS, inputs, {}))
        found.append(VISITOR in world.barrier.participants)
    assert found == taking_part
