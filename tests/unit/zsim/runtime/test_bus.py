"""The in-memory bus: agents get each gate once and whole, the world their outputs and then their dones."""

import os
from collections.abc import Sequence
from typing import Any

import pytest
from msgspec import Struct
from refused import refused

from zsim.contract import keys
from zsim.contract.flight_messages import ClusterState, Estimate, Status, Velocity
from zsim.contract.messages import Imu, Info
from zsim.contract.run_messages import Bye, Done, Join, Waiting
from zsim.contract.views import ViewCluster
from zsim.errors import RunError
from zsim.runtime.agent import Agent, Output
from zsim.runtime.bus import Bus

GATE_NS = 20_000_000
DRONES = ("d1", "d2")
KeyedMessages = list[tuple[str, Any]]


class Hub:
    """A world of two drones that says one IMU sample and a status per gate, and waits for whom it is told to."""

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
        raise AssertionError("nobody asks where there are no faults")

    def may_advance(self) -> bool:
        last_ns = (self._gate - 1) * GATE_NS
        owed = [name for name, period in self._periods.items() if self._done.get(name, -1) < last_ns // period * period]
        return self.ended is None and not self._waits_for and (self._gate == 0 or not owed)

    def waiting_for(self, wall_ns: int) -> Sequence[Waiting]:
        return self._waits_for

    def advance(self, wall_ns: int) -> None:
        t_ns = self._gate * GATE_NS
        for drone in DRONES:
            sample = Imu(t_ns, self._gate, t_ns, (0.0, 0.0, 9.8), (0.0, 0.0, 0.0))
            self._outbox.append(Output(keys.sensor(drone, "imu"), sample))
            status = Status(t_ns, self._gate, "flying", 50.0, False, None, 2)
            self._outbox.append(Output(keys.status(drone), status))
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
    """Base of the agents here: notes what it is handed."""

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
        zeros = (0.0, 0.0, 0.0)
        seq = self.next_seq(self._key)
        estimate = Estimate(t_ns, seq, zeros, zeros, (1.0, *zeros), 0.0, (0.0,) * 36, 0.1, zeros, {})
        return [Output(self._key, estimate)]


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


def test_everybody_joins_with_what_the_contract_asks_for():
    hub, _ = fly(1, team())
    joins = {keys.thing(key): message for key, message in hub.handled if isinstance(message, Join)}
    assert list(joins) == ["estimator.d1", "estimator.d2", "controller.main"]
    join = joins["estimator.d1"]
    assert (join.run_id, join.role, join.pid, join.period_ns) == ("run1", "estimator", os.getpid(), GATE_NS)


def test_an_agent_gets_each_gate_whole_and_is_then_asked():
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


def test_outputs_that_the_world_only_relays_are_counted_for_it():
    hub, _ = fly(1, team())
    assert hub.outputs == ["estimator.d1", "estimator.d2", "controller.main"]


def test_an_agent_of_a_longer_period_reads_every_gate_and_answers_its_own():
    agent = FakeEstimator("d1", 2 * GATE_NS)
    hub, _ = fly(5, [agent])
    assert [t_ns // GATE_NS for what, t_ns in agent.notes if what == "step"] == [0, 2, 4]
    assert [t_ns // GATE_NS for what, t_ns in agent.notes if what.endswith("status")] == [0, 1, 2, 3, 4]
    assert [done.done_ns // GATE_NS for done in of(hub.handled, Done)] == [0, 2, 4]


def test_the_sink_takes_everything_but_views_in_order():
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


def test_everybody_says_bye_after_the_world_s_last_words():
    hub, published = fly(3, team())
    byes = [(key, message) for key, message in published if isinstance(message, Bye)]
    assert published[-3:] == byes
    assert published[-4][0] == keys.EVENT
    assert [(message.t_ns, message.seq) for _, message in byes] == [(2 * GATE_NS, 0)] * 3
    assert hub.handled[-3:] == byes


def test_waiting_for_somebody_who_is_not_there_is_an_error_and_no_endless_loop():
    bus = Bus(Hub(3, waits_for=["estimator.d9", "console.1"]), team(), lambda: 0)
    with refused(RunError, "waits", "estimator.d9", "console.1"):
        bus.turn()
