"""Rules that every agent must satisfy; adding an agent to AGENTS tests it.

The inputs are synthetic: drones stand on the ground, take off and hover, as noisy sensors measure them.
"""

import random
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import Struct
from msgspec.structs import replace
from plain_messages import run_info
from refused import refused

from zsim.contract import flight_messages, keys, messages, run_messages
from zsim.contract.flight_messages import ViewCluster, ViewEstimates
from zsim.contract.messages import Info
from zsim.contract.run_messages import ControlAnswer, ControlRequest
from zsim.contract.snapshot import State, pack, unpack
from zsim.errors import RunError
from zsim.runtime.agent import Agent, Output
from zsim.runtime.inbox import Inbox
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim.sensors.sensor_catalogue import STOCK
from zsim_agents.estimation.estimator import Estimator
from zsim_agents.formation.controller import Controller
from zsim_agents.hosting import hosted

STEP = Path(__file__).parents[2] / "scenarios" / "step.yaml"
EXAMPLES = Path(__file__).parents[2] / "examples"
GATE_NS = 20_000_000
IMU_NS = 5_000_000  # 200 Hz
GATES = 150
TAKEOFF_S = 0.5
LIFTOFF_S = 0.6  # when the drones of the synthetic flight leave the ground
AIRBORNE_S = 1.0  # when they reach HEIGHT_M
HEIGHT_M = 2.0
GRAVITY_M_S2 = 9.80665

KeyedMessages = list[tuple[str, Any]]
Make = Callable[[Info, Scenario], Agent]

AGENTS: dict[str, Make] = {
    "estimator.drone1": lambda info, scenario: Estimator(info, scenario, "drone1"),
    "estimator.drone3": lambda info, scenario: Estimator(info, scenario, "drone3"),
    "controller.main": lambda info, scenario: Controller(info, scenario, "main"),
    "estimator.drone2": lambda info, scenario: Estimator(info, scenario, SEVERAL["estimator.drone2"]),
}
SEVERAL = {"estimator.drone2": ["drone2", "drone3"]}
MAY_WRITE = {
    "estimator": ("drone/{thing}/estimate",),
    "controller": (
        "cluster/{thing}/state",
        "cluster/{thing}/request",
        "drone/{drone}/cmd/velocity",
        "drone/{drone}/cmd/mode",
    ),
}
every_agent = pytest.mark.parametrize("name", sorted(AGENTS))


@cache
def scenario() -> Scenario:
    return scenario_file.load(STEP, [f"clusters.main.plan.takeoff_s={TAKEOFF_S}"])


@cache
def info() -> Info:
    """Return the Info that a world would publish, with the text of the scenario."""
    it = scenario()
    text = scenario_file.to_text(it)
    return run_info(
        [drone.name for drone in it.drones],
        [messages.ClusterInfo(cluster.name, tuple(cluster.drones)) for cluster in it.clusters],
        federation=it.federation,
        physics_dt_ns=2_500_000,
        origin=messages.Origin(-34.603, -58.368, 25.0),
        scenario=text,
        scenario_sha256=scenario_file.sha256(text),
    )


@cache
def told() -> Scenario:
    """Return the scenario as an agent reads it from the text in `info`."""
    return scenario_file.from_text(info().scenario)


def make(name: str) -> Agent:
    agent = AGENTS[name](info(), told())
    assert agent.name == name
    return agent


# The synthetic flight


class Flight:
    """Generates, gate by gate, the messages of a world and of the estimators."""

    def __init__(self) -> None:
        self._rng = np.random.default_rng(1)
        self._seq: defaultdict[str, int] = defaultdict(int)

    def gate(self, gate: int) -> KeyedMessages:
        sent: KeyedMessages = []
        for drone in scenario().drones:
            mine = list(self._sensors(drone.name, gate, drone.position_m))
            mine.append(self._status(drone.name, gate, len(mine) + 1))
            sent += [*mine, self._estimate(drone.name, gate, drone.position_m)]
        return sent

    def _next(self, key: str) -> int:
        self._seq[key] += 1
        return self._seq[key] - 1

    def _noise(self, sigma: float) -> tuple[float, float, float]:
        x, y, z = self._rng.normal(0.0, sigma, 3).tolist()
        return (x, y, z)

    def _sensors(self, drone: str, gate: int, start_m: tuple[float, float, float]) -> KeyedMessages:
        t_ns = gate * GATE_NS
        sent = [self._imu(drone, at) for at in range(t_ns - GATE_NS + IMU_NS, t_ns + 1, IMU_NS) if at >= 0]
        z = self._height_m(t_ns)
        if gate % 2 == 0:
            mag = tuple(np.add((17.8, 2.8, 14.0), self._noise(0.3)).tolist())
            sent += [
                self._sample(drone, "mag", t_ns, mag),
                self._sample(drone, "baro", t_ns, 101_000.0, z + self._noise(0.1)[0]),
                self._sample(drone, "sonar", t_ns, z, z > 0.03),
            ]
        if gate % 3 == 0:
            sent.append(self._sample(drone, "flow", t_ns, self._noise(0.1), 1.0))
        if gate % 10 == 0:
            sent.append(self._gps(drone, t_ns, (start_m[0], start_m[1], z)))
        return sent

    def _height_m(self, t_ns: int) -> float:
        return HEIGHT_M * min(1.0, max(0.0, (t_ns * 1e-9 - LIFTOFF_S) / (AIRBORNE_S - LIFTOFF_S)))

    def _imu(self, drone: str, t_ns: int) -> tuple[str, Any]:
        x, y, z = self._noise(0.1)
        return self._sample(drone, "imu", t_ns, (x, y, z + GRAVITY_M_S2), self._noise(0.001))

    def _gps(self, drone: str, t_ns: int, p_m: tuple[float, float, float]) -> tuple[str, Any]:
        x, y, z = np.add(p_m, self._noise(0.5)).tolist()
        return self._sample(drone, "gps", t_ns, -34.603, -58.368, 25.0 + z, (x, y, z), self._noise(0.1), 0.5, 3, 9)

    def _sample(self, drone: str, kind: str, t_ns: int, *measured: Any) -> tuple[str, Any]:
        key = keys.sensor(drone, kind)
        return key, STOCK[kind].message(t_ns, self._next(key), t_ns, *measured)

    def _status(self, drone: str, gate: int, count: int) -> tuple[str, Any]:
        t_s = gate * GATE_NS * 1e-9
        state = "landed" if t_s < LIFTOFF_S else "taking_off" if t_s < AIRBORNE_S else "flying"
        key = keys.status(drone)
        return key, flight_messages.Status(gate * GATE_NS, self._next(key), state, 90.0, False, None, count)

    def _estimate(self, drone: str, gate: int, start_m: tuple[float, float, float]) -> tuple[str, Any]:
        t_ns, key = gate * GATE_NS, keys.estimate(drone)
        x, y, z = self._noise(0.02)
        position = (start_m[0] + x, start_m[1] + y, self._height_m(t_ns) + z)
        yaw = float(np.pi / 2 + self._noise(0.01)[0])
        turn = (float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2)))
        covariance = tuple((0.01 * np.eye(6)).ravel().tolist())
        seq = self._next(key)
        velocity, zeros = self._noise(0.02), (0.0, 0.0, 0.0)
        return key, flight_messages.Estimate(
            t_ns, seq, position, velocity, turn, yaw, covariance, 0.02, zeros, {"gps": (1, 0)}
        )


@cache
def flight() -> tuple[tuple[tuple[str, Any], ...], ...]:
    sent = Flight()
    return tuple(tuple(sent.gate(gate)) for gate in range(GATES))


def inputs(agent: Agent) -> list[KeyedMessages]:
    """Return, by gate, the messages of the flight that the agent reads."""
    return [[(key, m) for key, m in gate if any(keys.matches(e, key) for e in agent.reads)] for gate in flight()]


Stepped = tuple[int, list[Output]]  # the instant of a gate [ns], and the agent's outputs in it


def stepped(
    agent: Agent, gates: list[KeyedMessages], inbox: Inbox | None = None, before: Callable[[], None] = lambda: None
) -> Iterator[Stepped]:
    """Drive an agent as the runners do; `before` is called before each gate."""
    inbox = inbox or Inbox(agent.gate_keys, agent.counted)
    for sent in gates:
        before()
        for key, message in sent:
            assert inbox.put(key, message)
        while (t_ns := inbox.next_gate_ns()) is not None and inbox.missing(t_ns) is None:
            for key, message in inbox.take(t_ns):
                agent.receive(key, message)
            if t_ns % agent.period_ns == 0:
                yield t_ns, list(agent.step(t_ns))


def run(agent: Agent, gates: list[KeyedMessages], inbox: Inbox | None = None) -> list[Stepped]:
    return list(stepped(agent, gates, inbox))


@cache
def flown(name: str) -> list[Stepped]:
    agent = make(name)
    return run(agent, inputs(agent))


def wire(outputs: list[Stepped]) -> list[tuple[int, str, bytes]]:
    return [(t_ns, key, messages.encode(message)) for t_ns, gate in outputs for key, message in gate]


# What an agent declares


@every_agent
def test_the_name_is_role_and_thing_and_the_period_whole_gates(name: str):
    agent = make(name)
    role, dot, thing = agent.name.partition(".")
    assert (dot, agent.role) == (".", role)
    assert keys.name(agent.name) == name
    assert thing in {drone.name for drone in scenario().drones} | {cluster.name for cluster in scenario().clusters}
    assert agent.period_ns > 0
    assert agent.period_ns % GATE_NS == 0


@every_agent
def test_an_agent_reads_every_key_that_its_gates_wait_for(name: str):
    agent = make(name)
    assert agent.gate_keys
    assert {keys.status(drone) for drone in agent.counted} <= set(agent.gate_keys)
    counted = [keys.sensor(drone, kind) for drone in agent.counted for kind in keys.SENSORS]
    for key in (*agent.gate_keys, *counted):
        assert any(keys.matches(expression, key) for expression in agent.reads)


@every_agent
def test_no_agent_reads_the_truth(name: str):
    agent = make(name)
    truths = [keys.truth(drone.name) for drone in scenario().drones]
    assert not [e for e in agent.reads for key in [*truths, keys.VIEW_DRONES] if keys.matches(e, key)]


# What an agent does


@every_agent
def test_an_agent_steps_once_per_period(name: str):
    assert [t_ns for t_ns, _ in flown(name)] == list(range(0, GATES * GATE_NS, make(name).period_ns))


@every_agent
def test_a_view_shows_the_latest_output(name: str):
    agent = make(name)
    outputs = run(agent, inputs(agent))
    t_ns, sent = outputs[-1]
    (shown,) = agent.views(t_ns)
    assert messages.type_of(shown.key) is type(shown.message)
    assert messages.decode(shown.key, messages.encode(shown.message)) == shown.message
    if isinstance(shown.message, ViewCluster):
        state = next(message for key, message in sent if key.endswith("/state"))
        assert isinstance(state, flight_messages.ClusterState)
        assert shown.key == f"view/cluster/{name.partition('.')[2]}"
        assert (shown.message.value, shown.message.desired) == (state.value, state.desired)
    else:
        assert isinstance(shown.message, ViewEstimates)
        assert shown.key == f"view/estimates/{name}"
        estimates_sent: dict[str, Any] = {keys.thing(key): message for key, message in sent}
        assert [e.name for e in shown.message.estimates] == list(estimates_sent)
        for estimate in shown.message.estimates:
            P = np.reshape(estimates_sent[estimate.name].covariance, (6, 6))[:3, :3]
            assert estimate.position_m == estimates_sent[estimate.name].position_m
            assert estimate.covariance_m2 == tuple(P[np.triu_indices(3)])


@every_agent
def test_an_agent_writes_only_to_permitted_keys(name: str):
    role, _, thing = name.partition(".")
    drones = SEVERAL.get(name, [thing]) if role == "estimator" else scenario().cluster(thing).drones
    things = drones if role == "estimator" else [thing]
    allowed = {key.format(thing=t, drone=drone) for key in MAY_WRITE[role] for t in things for drone in drones}
    written = {key for _, gate in flown(name) for key, _ in gate}
    assert written <= allowed
    assert written


def test_the_flight_makes_the_controller_send_states_and_commands():
    """Otherwise, the rules above would hold for messages that were never sent."""
    written = {keys.leaf(key) for _, gate in flown("controller.main") for key, _ in gate}
    assert written == {"state", "velocity", "mode"}


@every_agent
def test_outputs_carry_time_sequence_number_type_and_source(name: str):
    """Each is stamped with its gate, numbered per key without gaps, and unchanged by a round trip."""
    numbers: defaultdict[str, list[int]] = defaultdict(list)
    for t_ns, gate in flown(name):
        for key, message in gate:
            said: Any = message
            assert (said.t_ns, type(said), getattr(said, "source", name)) == (t_ns, messages.type_of(key), name)
            assert messages.decode(key, messages.encode(message)) == message
            numbers[key].append(said.seq)
    for found in numbers.values():
        assert found == list(range(len(found)))


# Bit-identical outputs


@every_agent
def test_arrival_order_and_encoding_change_no_bit(name: str):
    """Messages are shuffled within each gate; the inbox restores their order."""
    agent, rng = make(name), random.Random(1)
    gates = [[(key, _again(key, message)) for key, message in sent] for sent in inputs(agent)]
    for sent in gates:
        rng.shuffle(sent)
    assert wire(run(agent, gates)) == wire(flown(name))


def with_algorithm(algorithm: str) -> Make:
    """Return a factory for the estimator of drone1 with another algorithm."""

    def build(info: Info, scenario: Scenario) -> Agent:
        estimation = replace(scenario.estimation, algorithm=algorithm)
        return Estimator(info, replace(scenario, estimation=estimation), "drone1")

    return build


GOES_ON: dict[str, Make] = {
    **AGENTS,
    "paper": with_algorithm("paper"),
    "of a user's own": with_algorithm("my_estimator:MyEstimator"),
    "all in one": lambda info, scenario: hosted(info, scenario, ["*"]),
}


@pytest.mark.parametrize("make_one", GOES_ON.values(), ids=GOES_ON)
def test_resuming_from_a_snapshot_gives_the_same_bits(make_one: Make, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    first, *others, last = (make_one(info(), scenario()) for _ in range(5))
    gates = inputs(first)
    wanted, inbox = wire(run(last, gates)), Inbox(first.gate_keys, first.counted)
    done, taken_at = 0, (0, 40, 77)
    for gate, other in zip(taken_at, others, strict=True):
        run(first, gates[done : gate + 1], inbox)
        other.resume(info(), taken(first))
        done = gate + 1
    run(first, gates[done : done + 2], inbox)  # this must not alter the snapshots taken
    for gate, other in zip(taken_at, others, strict=True):
        inbox = Inbox(other.gate_keys, other.counted)
        inbox.start_after(gate * GATE_NS)
        after = wire(run(other, gates[gate + 1 :], inbox))
        assert after
        assert after == [each for each in wanted if each[0] > gate * GATE_NS]


@every_agent
def test_a_resumed_agent_has_the_same_snapshot(name: str):
    agent, other = make(name), make(name)
    run(agent, inputs(agent)[:50])
    state = taken(agent)
    other.resume(info(), state)
    assert pack(other.checkpoint() or {}) == pack(state)


def taken(agent: Agent) -> State:
    """Return an agent's checkpoint after a round trip through its encoding."""
    state = agent.checkpoint()
    assert state is not None
    return unpack(pack(state))


def _again(key: str, message: Struct) -> Any:
    return messages.decode(key, messages.encode(message))


@every_agent
def test_two_agents_in_one_process_do_not_affect_each_other(name: str):
    first, second = make(name), make(name)
    gates = inputs(first)
    by_turns = list(zip(stepped(first, gates), stepped(second, gates), strict=True))
    assert wire([one for one, _ in by_turns]) == wire([other for _, other in by_turns])


# Restart


@every_agent
def test_a_new_incarnation_continues_from_the_last_outputs(name: str):
    """As in the runner, the last values come first, then the missed gates; sequence numbers continue."""
    former, agent = make(name), make(name)
    gates = inputs(former)
    before = run(former, gates[: GATES - 20])
    last = {key: message for _, gate in before for key, message in gate}
    assert agent.warm_start_keys()
    for key in agent.warm_start_keys():
        agent.warm_start(key, last[key])
        agent.resume_seq(key, last[key].seq)  # type: ignore[attr-defined]
    after = run(agent, gates[GATES - 20 :])
    assert len(after) == 20
    for key in agent.warm_start_keys():
        numbers = [m.seq for _, gate in after for k, m in gate if k == key]  # type: ignore[attr-defined]
        first = last[key].seq + 1  # type: ignore[attr-defined]
        assert numbers == list(range(first, first + len(numbers)))
    for _, gate in after:
        for key, message in gate:
            assert messages.decode(key, messages.encode(message)) == message


def test_a_restarted_estimator_continues_from_its_last_estimate():
    former, agent = make("estimator.drone1"), make("estimator.drone1")
    gates = inputs(former)
    ((_, ((key, last),)),) = run(former, gates)[-21:-20]
    agent.warm_start(key, last)
    ((_, ((_, first),)), *_) = run(agent, gates[GATES - 20 :])
    jump = np.subtract(first.position_m, last.position_m)  # type: ignore[attr-defined]
    assert np.abs(jump).max() < 0.1  # m; one gate of readings moves an estimate by less


# Requests


@every_agent
@pytest.mark.parametrize(
    "request_",
    [
        ControlRequest("no-such-thing"),
        ControlRequest(""),
        ControlRequest("target", {"values": 5}),
        ControlRequest("target", {"values": {"z_c": "high"}}),
        ControlRequest("trajectory", {"expressions": {"z_c": "__import__('os')"}}),
        ControlRequest("takeoff", {"unknown": 1}),
        ControlRequest("x" * 10_000, {"y" * 10_000: [[]]}),
    ],
    ids=lambda request: request.op[:12] or "empty",
)
def test_an_invalid_request_is_refused_in_one_line(name: str, request_: ControlRequest):
    agent = make(name)
    for key in agent.control_keys() or ("nothing",):
        answer = agent.control(key, request_)
        assert isinstance(answer, ControlAnswer)
        assert not answer.ok
        assert answer.error.isprintable()
        assert 0 < len(answer.error) < 500
        assert messages.decode_as(ControlAnswer, messages.encode(answer), key) == answer


@every_agent
def test_a_refused_request_changes_no_bit(name: str):
    agent = make(name)

    def ask() -> None:
        for key in agent.control_keys():
            agent.control(key, ControlRequest("target", {"values": {"no_such_variable": 1.0}}))

    outputs = []
    for t_ns, said in stepped(agent, inputs(agent), before=ask):
        asked = [output.message for output in said if isinstance(output.message, run_messages.ClusterRequest)]
        assert [(a.t_ns, a.op, a.ok, a.controller) for a in asked] == [
            (t_ns, "target", False, name) for _ in agent.control_keys()
        ]
        outputs.append((t_ns, [output for output in said if output.message not in asked]))
    assert wire(outputs) == wire(flown(name))


@pytest.mark.parametrize("kind", [Estimator, Controller])
def test_a_drone_or_cluster_outside_the_scenario_is_refused(kind: Callable[..., Agent]):
    with refused(RunError, "'nobody'", scenario().drones[0].name if kind is Estimator else scenario().clusters[0].name):
        kind(info(), scenario(), "nobody")
