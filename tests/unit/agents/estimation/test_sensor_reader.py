"""Sensors read out of a gate's messages by compiled code are the readings that their messages make."""

import msgspec
import numpy as np
import pytest

from zsim.contract import keys
from zsim.contract.framing import GateMessages
from zsim.math.compiled import COMPILES
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim_agents.estimation.estimator import Estimator
from zsim_world.run.world import World

DRONES = ("d1", "d2", "d3")


def scenario() -> Scenario:
    places = [{"name": name, "position_m": [3 * i, 0, 0]} for i, name in enumerate(DRONES)]
    latency = {"gps": {"latency_ms": 35.0}, "mag": {"latency_ms": 5.0}}
    return scenario_file.resolve({"name": "reader", "drones": places, "sensors": latency, "duration_s": 5})


@pytest.fixture(scope="module")
def flight() -> tuple[World, list[GateMessages]]:
    world = World(scenario())
    gates = []
    for number in range(120):
        if number == 20:
            assert world.fleet.takeoff(0) is None
        gates.append(world._publication.gate(world.queue.commanders()))
        world.fleet.advance()
    return world, gates


def estimates(agent: Estimator, gates: list[GateMessages], whole: bool) -> list[object]:
    """Return what an estimator says of a flight, handed over as gates or as messages in the order of a runner."""
    outputs = []
    for gate in gates:
        if whole:
            agent.receive_gate(gate)
        else:
            readings = [(key, m) for key, m in gate.decoded() if keys.is_sensor(key)]
            for key, message in sorted(readings, key=lambda entry: (entry[1].t_ns, entry[0], entry[1].seq)):
                if keys.thing(key) in agent.counted:
                    agent.receive(key, message)
        outputs += agent.step(gate.t_ns)
    return outputs


@pytest.mark.skipif(not COMPILES, reason="numba is not installed: gates are taken apart")
@pytest.mark.parametrize("drones", [DRONES, ("d2",), ("d3", "d1")])
def test_a_gate_gives_the_estimates_of_its_messages(
    flight: tuple[World, list[GateMessages]], drones: tuple[str, ...]
) -> None:
    world, gates = flight
    whole, each = (Estimator(world.info(), world.scenario, drones) for _ in range(2))
    assert whole.takes_gates
    assert estimates(whole, gates, whole=True) == estimates(each, gates, whole=False)


@pytest.mark.skipif(not COMPILES, reason="numba is not installed: gates are taken apart")
def test_a_message_that_the_world_would_not_write_so_is_decoded_all_the_same(
    flight: tuple[World, list[GateMessages]],
) -> None:
    """One whose floats are whole numbers on the wire: right, but not what the compiled reader knows."""
    world, gates = flight
    gate = next(b for b in gates if any(key.endswith("mag") for key, _ in b.pairs))
    changed = [_with_whole_numbers(gate) if b is gate else b for b in gates]
    whole, each = (Estimator(world.info(), world.scenario, DRONES) for _ in range(2))
    assert estimates(whole, changed, whole=True) == estimates(each, changed, whole=False)


def test_columns_that_lead_outside_are_not_followed(flight: tuple[World, list[GateMessages]]) -> None:
    world, gates = flight
    b, agent = gates[0], Estimator(world.info(), world.scenario, DRONES)
    for which, ends in (
        (np.full(len(b), 10**9), b.ends),
        (np.full(len(b), -5), b.ends),
        (b.which, b.ends + 10**9),
        (b.which, b.ends[::-1].copy()),
        (b.which, -b.ends),
    ):
        agent.receive_gate(GateMessages(b.t_ns, b.seq, b.table, which, b.stamps, ends, bytes(b.buffer)))
    assert len(agent.step(b.t_ns)) == len(DRONES)


def _with_whole_numbers(gate: GateMessages) -> GateMessages:
    outputs = [(key, _rounded(payload) if key.endswith("/mag") else payload) for key, payload in gate.pairs]
    return GateMessages.of(gate.t_ns, gate.seq, gate.table, outputs)


def _rounded(payload: bytes) -> bytes:
    return msgspec.msgpack.encode({**msgspec.msgpack.decode(payload), "field_ut": [20, 0, -40]})
