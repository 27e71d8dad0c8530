"""The in-memory bus: agents receive each gate once and in full; the world receives their outputs, then their dones."""

import math
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from msgspec import Struct
from plain_messages import GATE_NS, estimate, imu, status
from refused import refused

from zsim.contract import keys
from zsim.contract.flight_messages import ClusterState, Estimate, Status, Velocity, ViewCluster
from zsim.contract.messages import Imu, Info
from zsim.contract.run_messages import Bye, Done, Join, Waiting
from zsim.errors import RunError, UserCodeError
from zsim.runtime.agent import Agent, Output
from zsim.runtime.bus import Bus

DRONES = ("d1", "d2")
KeyedMessages = list[tuple[str, Any]]


class Timing(Struct):
    """The fields of `world/info` that the bus needs."""

    command_delay_ns: int
    gate_ns: int
    mode: str = "lockstep"
    own_messages: tuple[Any, ...] = ()


class Hub:
    """A world of two drones that publishes an IMU sample and a status per gate, and waits for the given processes."""

    run_id = "run1"

    def __init__(self, gates: int, waits_for: Sequence[str] = ()) -> None:
        self.handled: KeyedMessages = []
        self.outputs: list[str] = []
        self._gates = gates
        self._waits_for = tuple(Waiting(name, "", 1.0) for name in waits_for)
        self._gate = 0
        self._periods: dict[str, int] = {}
        self._done: dict[str, int] = {}
        self._outbox: list[Output] = []
        self.ended: str | None = None

    def handle(self, key: str, message: Any, wall_ns: int) -> None:
        self.handled.append((key, message))
        if isinstance(message, Join):
            self._periods[keys.thing(key)] = message.period_ns
        elif isinstance(message, Done):
            self._done[keys.thing(key)] = message.done_ns

    def count_output(self, source: str) -> None:
        self.outputs.append(source)

    def info(self) -> Info:
        return Timing(command_delay_ns=0, gate_ns=GATE_NS)  # type: ignore[return-value]

    def may_advance(self) -> bool:
        last_ns = (self._gate - 1) * GATE_NS
        owed = [name for name, period in self._periods.items() if self._done.get(name, -1) < last_ns // period * period]
        return self.ended is None and not self._waits_for and (self._gate == 0 or not owed)

    def waiting_for(self, wall_ns: int) -> Sequence[Waiting]:
        return self._waits_for

    def advance(self, wall_ns: int) -> None:
        t_ns = self._gate * GATE_NS
        for drone in DRONES:
            self._outbox.append(Output(keys.sensor(drone, "imu"), imu(t_ns, self._gate)))
            self._outbox.append(Output(keys.status(drone), status(t_ns, self._gate, 2)))
        self._gate += 1
        if self._gate == self._gates:
            self.ended = "over"

    def publish_end(self) -> None:
        self._outbox.append(Output(keys.EVENT, _event_end()))

    def take_outbox(self) -> list[Output]:
        outbox, self._outbox = self._outbox, []
        return outbox


def _event_end() -> Struct:
    return Status(0, 0, "landed", 0.0, False, None, 0)


class Notes(Agent):
    """Base of the fake agents: notes what it receives."""

    def __init__(self) -> None:
        super().__init__()
        self.notes: list[Any] = []

    def receive(self, key: str, message: Any) -> None:
        self.notes.append((key, message.t_ns))


class FakeEstimator(Notes):
    def __init__(self, drone: str, period_ns: int = GATE_NS) -> None:
        super().__init__()
        self.name, self.period_ns = f"estimator.{drone}", period_ns
        self.reads, self.gate_keys, self.counted = (keys.sensors(drone),), (keys.status(drone),), (drone,)
        self._key = keys.estimate(drone)

    def step(self, t_ns: int) -> list[Output]:
        self.notes.append(("step", t_ns))
        return [Output(self._key, estimate(t_ns, self.next_seq(self._key)))]


class FakeController(Notes):
    def __init__(self) -> None:
        super().__init__()
        self.name, self.period_ns = "controller.main", GATE_NS
        self.gate_keys = tuple(keys.estimate(drone) for drone in DRONES)
        self.reads = (keys.estimate("*"),)

    def step(self, t_ns: int) -> list[Output]:
        self.notes.append(("step", t_ns))
        command, state = keys.command("d1", "velocity"), keys.cluster_state("main")
        return [
            Output(command, Velocity(t_ns, self.next_seq(command), self.name, (0.0, 0.0, 0.0), 0.0)),
            Output(state, ClusterState(t_ns, self.next_seq(state), "idle", (), (), (), (), (), None, 0.0, "")),
        ]

    def views(self, t_ns: int) -> list[Output]:
        return [Output("view/cluster/main", ViewCluster(t_ns, 0, "idle", (), (), (), ""))]


def fly(gates: int, agents: list[Agent]) -> tuple[Hub, KeyedMessages]:
    hub, published = Hub(gates), []
    bus = Bus(hub, agents, lambda: 0, lambda key, message: published.append((key, message)))
    bus.join()
    while bus.turn():
        pass
    bus.end()
    return hub, published


def team() -> list[Agent]:
    return [FakeEstimator("d1"), FakeEstimator("d2"), FakeController()]


def of(published: KeyedMessages, kind: type) -> list[Any]:
    return [message for _, message in published if type(message) is kind]


def test_every_agent_joins_with_the_fields_the_contract_requires():
    hub, _ = fly(1, team())
    joins = {keys.thing(key): message for key, message in hub.handled if isinstance(message, Join)}
    assert list(joins) == ["estimator.d1", "estimator.d2", "controller.main"]
    join = joins["estimator.d1"]
    assert (join.run_id, join.role, join.pid, join.period_ns) == ("run1", "estimator", os.getpid(), GATE_NS)


def test_an_agent_receives_each_gate_in_full_before_it_steps():
    agents = team()
    fly(3, agents)
    assert isinstance(agents[0], Notes)
    wanted = []
    for t_ns in (0, GATE_NS, 2 * GATE_NS):
        wanted += [("drone/d1/sensor/imu", t_ns), ("drone/d1/sensor/status", t_ns), ("step", t_ns)]
    assert agents[0].notes == wanted


def test_outputs_reach_the_agents_that_read_them_within_the_gate():
    agents = team()
    fly(2, agents)
    assert isinstance(agents[2], Notes)
    wanted = []
    for t_ns in (0, GATE_NS):
        wanted += [("drone/d1/estimate", t_ns), ("drone/d2/estimate", t_ns), ("step", t_ns)]
    assert agents[2].notes == wanted


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
def test_the_order_of_the_agents_does_not_matter(order: tuple[int, int, int]):
    by_default, _ = fly(4, team())
    hub, _ = fly(4, [team()[i] for i in order])
    assert of(hub.handled, Velocity) == of(by_default.handled, Velocity)
    assert of(hub.handled, ClusterState) == of(by_default.handled, ClusterState)


def test_a_done_follows_its_outputs_and_counts_them_without_views():
    hub, published = fly(2, team())
    mine = [message for _, message in published if isinstance(message, Velocity | ClusterState | ViewCluster)]
    assert [type(message) for message in mine] == [Velocity, ClusterState] * 2
    dones = [m for key, m in hub.handled if isinstance(m, Done) and keys.thing(key) == "controller.main"]
    assert [(done.done_ns, done.sent, done.seq) for done in dones] == [(0, 2, 0), (GATE_NS, 2, 1)]
    for done in dones:
        place = published.index(("process/controller.main/done", done))
        assert [type(message) for _, message in published[place - 2 : place]] == [Velocity, ClusterState]


def test_outputs_that_the_world_only_relays_are_counted():
    hub, _ = fly(1, team())
    assert hub.outputs == ["estimator.d1", "estimator.d2", "controller.main"]


def test_an_agent_with_a_longer_period_reads_all_gates_but_steps_rarely():
    agent = FakeEstimator("d1", 2 * GATE_NS)
    hub, _ = fly(5, [agent])
    assert [t_ns // GATE_NS for what, t_ns in agent.notes if what == "step"] == [0, 2, 4]
    assert [t_ns // GATE_NS for what, t_ns in agent.notes if what.endswith("status")] == [0, 1, 2, 3, 4]
    assert [done.done_ns // GATE_NS for done in of(hub.handled, Done)] == [0, 2, 4]


def test_the_sink_receives_everything_but_views_in_order():
    _, published = fly(2, team())
    assert not [key for key, _ in published if key.startswith("view/")]
    assert len(of(published, Imu)) == 4
    assert len(of(published, Estimate)) == 4
    first = [key for key, _ in published if keys.thing(f"{key}/") in ("d1", "estimator.d1")][:5]
    assert first == [
        "process/estimator.d1/join",
        "drone/d1/sensor/imu",
        "drone/d1/sensor/status",
        "drone/d1/estimate",
        "process/estimator.d1/done",
    ]


def test_every_agent_says_bye_after_the_world_s_end_event():
    hub, published = fly(3, team())
    byes = [(key, message) for key, message in published if isinstance(message, Bye)]
    assert published[-3:] == byes
    assert published[-4][0] == keys.EVENT
    assert [(message.t_ns, message.seq) for _, message in byes] == [(2 * GATE_NS, 0)] * 3
    assert hub.handled[-3:] == byes


def test_waiting_for_an_absent_process_is_an_error_not_an_endless_loop():
    bus = Bus(Hub(3, waits_for=["estimator.d9", "console.1"]), team(), lambda: 0)
    with refused(RunError, "waits", "estimator.d9", "console.1"):
        bus.turn()


# A user's own agents


class Chatter(Agent):
    """Publishes a cluster state under its own name at every gate, and notes all such states that it receives."""

    def __init__(self, name: str, returns: Any = None) -> None:
        super().__init__()
        self.name, self.period_ns = f"talk.{name}", GATE_NS
        self.gate_keys = (keys.status("d1"),)
        self.reads = (keys.status("d1"), keys.cluster_state("*"))
        self.heard: list[tuple[int, str, int]] = []  # gate of delivery, key and time stamp
        self._now: list[tuple[str, int]] = []
        self._returns = returns
        self._key = keys.cluster_state(name)

    def receive(self, key: str, message: Any) -> None:
        if key != keys.status("d1"):
            self._now.append((key, message.t_ns))

    def step(self, t_ns: int) -> list[Output]:
        self.heard += [(t_ns, *each) for each in self._now]
        self._now = []
        if self._returns is not None:
            return self._returns(t_ns)
        state = ClusterState(t_ns, self.next_seq(self._key), "idle", (), (), (), (), (), None, 0.0, "")
        return [Output(self._key, state)]


class AheadHub(Hub):
    """A world with a command delay of `delay` gates, by which it runs ahead of the dones."""

    delay = 1

    def info(self) -> Info:
        return Timing(command_delay_ns=self.delay * GATE_NS, gate_ns=GATE_NS)  # type: ignore[return-value]

    def may_advance(self) -> bool:
        need_ns = (self._gate - 1 - self.delay) * GATE_NS
        return self.ended is None and all(self._done.get(name, -GATE_NS) >= need_ns for name in self._periods)


def talk(names: Sequence[str], delay: int = 1) -> dict[str, list[tuple[int, str, int]]]:
    hub, team = AheadHub(40), [Chatter(name) for name in names]
    hub.delay = delay
    bus = Bus(hub, team, lambda: 0)
    bus.join()
    while bus.turn():
        pass
    bus.end()
    return {agent.name: agent.heard for agent in team}


def test_what_agents_receive_does_not_depend_on_their_order():
    forth, back = talk("abcde"), talk("edcba")
    assert forth == back
    assert len({tuple(heard) for heard in forth.values()}) == 1
    assert {stamp for _, key, stamp in forth["talk.a"] if key == keys.cluster_state("e")} == {
        gate * GATE_NS for gate in range(38)
    }


@pytest.mark.parametrize("delay", [1, 3, 12])
@pytest.mark.parametrize("gates_max", [1, 2, 10])
def test_delivery_does_not_depend_on_the_batch_size_of_the_bus(
    monkeypatch: pytest.MonkeyPatch, delay: int, gates_max: int
):
    monkeypatch.setattr("zsim.runtime.bus.GATES_MAX", gates_max)
    for heard in talk("abc", delay).values():
        assert {t_ns - stamp for t_ns, _, stamp in heard} == {(delay + 1) * GATE_NS}
        assert len(heard) == 3 * (40 - delay - 1)


def velocity(t_ns: int, **fields: Any) -> list[Output]:
    made: dict[str, Any] = {"velocity_m_s": (0.0, 0.0, 0.0), "yaw_rate_rad_s": 0.0, **fields}
    return [Output(keys.command("d1", "velocity"), Velocity(t_ns, t_ns // GATE_NS, made.pop("source", ""), **made))]


def failed(returns: Any) -> tuple[Hub, KeyedMessages, str]:
    hub, published = Hub(5), []
    bus = Bus(hub, [Chatter("a", returns)], lambda: 0, lambda key, message: published.append((key, message)))
    bus.join()
    while bus.turn() and not any(isinstance(message, Bye) for _, message in hub.handled):
        pass
    with pytest.raises(UserCodeError) as raised:
        bus.end()
    return hub, published, str(raised.value)


def test_numpy_values_reach_the_world_as_plain_floats():
    def returns(t_ns: int) -> list[Output]:
        return velocity(t_ns, velocity_m_s=np.array([1.0, 2.0, 3.0]), yaw_rate_rad_s=np.float32(0.5))

    hub, agent = Hub(1), Chatter("a", returns)
    bus = Bus(hub, [agent], lambda: 0)
    bus.join()
    bus.turn()
    sent = next(message for _, message in hub.handled if isinstance(message, Velocity))
    assert (sent.velocity_m_s, sent.yaw_rate_rad_s, sent.source) == ((1.0, 2.0, 3.0), 0.5, "talk.a")
    assert [type(number) for number in (*sent.velocity_m_s, sent.yaw_rate_rad_s)] == [float] * 4


@pytest.mark.parametrize(
    ("returns", "terms"),
    [
        (lambda t_ns: velocity(t_ns, velocity_m_s=(0.0, math.nan, 0.0)), ("drone/d1/cmd/velocity", "[1]", "nan")),
        (lambda t_ns: velocity(t_ns, source="talk.b"), ("source", "'talk.b'", "'talk.a'")),
        (lambda t_ns: [Output("swarm/d1/state", Bye(t_ns, 0, ""))], ("swarm/d1/state", "not a key of the contract")),
        (lambda t_ns: [Output("view/cluster/a", ViewCluster(t_ns, 0, "idle", (), (), (), ""))], ("view", "`views`")),
        (lambda t_ns: [Output(keys.status("d1"), Bye(t_ns, 0, ""))], ("drone/d1/sensor/status",)),
        (lambda t_ns: [Output(keys.estimate("d1"), Bye(t_ns, 0, ""))], ("drone/d1/estimate", "Bye", "Estimate")),
        (lambda t_ns: 1 / (t_ns - t_ns), ("Chatter", "ZeroDivisionError", "test_bus.py:")),
    ],
)
def test_an_invalid_output_or_an_error_ends_the_agent_with_the_reason(returns: Any, terms: tuple[str, ...]):
    hub, _, line = failed(lambda t_ns: velocity(t_ns) if t_ns < 2 * GATE_NS else returns(t_ns))
    assert line.startswith("talk.a at 0.04 s: ")
    assert all(term in line for term in terms), line
    (bye,) = [message for _, message in hub.handled if isinstance(message, Bye)]
    assert (bye.failed, bye.reason) == (True, line)
    assert [message.done_ns for _, message in hub.handled if isinstance(message, Done)] == [0, GATE_NS]
