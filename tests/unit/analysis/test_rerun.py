"""Rerun of a recorded run: repeated joins, and differences of truth and outputs."""

import math
from typing import Any

import msgspec
import pytest
from refused import has_terms

from zsim.contract import keys, messages
from zsim.contract.flight_messages import Mode, Truth
from zsim.contract.run_messages import Event, Join
from zsim.record import Recorded
from zsim.scenario import scenario_file
from zsim.schema.message import Message
from zsim_analysis.reading.recorded_run import GateInputs, RecordedAgents
from zsim_analysis.rerun import OutputComparison, RerunBus, TruthComparison, difference
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
def test_a_join_is_repeated_at_the_gate_of_its_admission(gates: list[list[Recorded]], taking_part: list[bool]) -> None:
    world = World(SCENARIO, run_id="run1")
    bus = RerunBus(world, ALONE, world.info(), SCENARIO)
    found: list[bool] = []
    for step, inputs in enumerate(gates):
        bus.fly_to(GateInputs(step * GATE_NS, inputs, {}))
        found.append(VISITOR in world.barrier.participants)
    assert found == taking_part


ZEROS = (0.0, 0.0, 0.0)


def truth(gate: int, drone: str, x: float = 0.0) -> tuple[str, Message]:
    message = Truth(gate * GATE_NS, gate, (x, 0.0, 1.0), ZEROS, (1.0, *ZEROS), ZEROS, ZEROS, (9.0, 9.0, 9.0, 9.0))
    return keys.truth(drone), message


def encoded(**changes: Any) -> bytes:
    return messages.encode(msgspec.structs.replace(truth(3, "d1")[1], **changes))


def test_the_difference_of_two_states_is_computed():
    c, s = math.cos(0.05), math.sin(0.05)
    other = encoded(
        position_m=(3.0, 4.0, 1.0),
        velocity_m_s=(0.0, 0.0, 2.0),
        orientation_wxyz=(-c, 0.0, 0.0, -s),
        angular_velocity_rad_s=(0.0, 0.3, 0.4),
    )
    found = difference(3 * GATE_NS, "d1", encoded(), other)
    assert found is not None
    assert found[:5] == (3 * GATE_NS, "d1", 5.0, 2.0, pytest.approx(0.1))
    assert found.rate_rad_s == pytest.approx(0.5)
    assert has_terms(str(found), "d1", "0.060 s", "5 m", "2 m/s", "5.73 deg", "28.6 deg/s")
    not_hashed = encoded(accel_m_s2=(1.0, 0.0, 0.0), rotor_rad_s=(1.0, 2.0, 3.0, 4.0))
    assert difference(0, "d1", encoded(), not_hashed) is None
    assert difference(0, "d1", encoded(position_m=(1.0, 0.0, 1.0)), encoded(position_m=(1.0 + 2**-52, 0.0, 1.0)))


def test_the_first_and_the_last_difference_are_kept():
    compared = TruthComparison(["d1", "d2"])
    same = {"d1": encoded(), "d2": encoded()}
    for t_ns, flown in enumerate([same, {**same, "d2": encoded(position_m=(1.0, 0.0, 1.0))}, same]):
        compared.add(t_ns, same, flown)
    compared.add(3, same, dict.fromkeys(same, encoded(position_m=(2.0, 0.0, 1.0))))
    assert compared.first is not None
    assert compared.last is not None
    assert (compared.instants, compared.first.t_ns, compared.first.drone) == (4, 1, "d2")
    assert (compared.last.t_ns, compared.last.drone, compared.last.position_m) == (3, "d2", 2.0)


def command(gate: int, mode: Any = "land", seq: int | None = None) -> Mode:
    return Mode(gate * GATE_NS, gate if seq is None else seq, "controller.main", mode)


def test_equal_outputs_in_another_order_are_not_a_difference():
    outputs = OutputComparison(2 * GATE_NS)
    for gate in range(10):
        outputs.add("a", command(gate))
        if gate:
            outputs.add("a", command(gate - 1))
        outputs.expire(gate * GATE_NS)
    assert outputs.first == ""


def test_the_earliest_different_or_missing_output_is_reported():
    outputs = OutputComparison(2 * GATE_NS)
    outputs.add("missing", command(3))
    for mode in ("land", "takeoff"):
        outputs.add("later", command(4, mode))
    assert has_terms(outputs.first, "later", "0.08")
    outputs.expire(5 * GATE_NS)
    assert has_terms(outputs.first, "later", "0.08")
    outputs.expire(6 * GATE_NS)
    assert has_terms(outputs.first, "missing", "0.06")
