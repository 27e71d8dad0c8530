"""The runner: the estimates that a gate waits for, invalid events, restarts, and a world that answers late."""

import os
from collections.abc import Callable
from typing import Any

import numpy as np
import plain_messages
import pytest
from fake_link import UNANSWERED, FakeLink
from msgspec.structs import replace
from plain_messages import GATE_NS, run_info
from refused import has_terms, refused

from zsim.contract import keys, messages
from zsim.contract.flight_messages import Estimate, Status
from zsim.contract.framing import GateMessages, key_table
from zsim.contract.messages import Info, Mag, encode
from zsim.contract.run_messages import (
    RUN_ENDED,
    Clock,
    ClusterRequest,
    ControlAnswer,
    Done,
    Event,
    Fault,
    Faults,
    Snapshot,
)
from zsim.contract.snapshot import VERSION, State, pack, unpack
from zsim.errors import BehindError, RunError, SupersededError, UserCodeError
from zsim.runtime import participant
from zsim.runtime.agent import Agent, Output
from zsim.runtime.runner import Runner

DRONES = "d1", "d2", "d3"
END = 6  # last gate of the test runs
ME = "judge.main"
REPLAY = keys.replay(ME)


class Judge(Agent):
    """Closes a gate on the status and the estimate of one drone, and publishes nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.name, self.period_ns = ME, GATE_NS
        self.gate_keys = self.reads = (keys.status("d1"), keys.estimate("d1"))
        self.received: list[tuple[str, int]] = []

    def receive(self, key: str, message: Any) -> None:
        self.received.append((keys.leaf(key), message.t_ns // GATE_NS))

    def step(self, t_ns: int) -> list[Output]:
        return []


def info(run_id: str = "run1") -> Info:
    return run_info(DRONES, run_id=run_id)


def status(gate: int) -> Status:
    return plain_messages.status(gate * GATE_NS, gate)


def estimate(gate: int, source: str = "my.d1") -> Estimate:
    return plain_messages.estimate(gate * GATE_NS, gate, source=source)


def event(kind: str, subject: str, **data: Any) -> Event:
    return Event(0, 0, kind, "world", subject, "", data)


class World(FakeLink):
    """Publishes a status per gate, each when the judge is done with the one before, and the end of the run.

    Args:
        at: actions taken just before the status of a gate, by gate.
    """

    def __init__(self, at: dict[int, Callable[["World"], None]]) -> None:
        super().__init__()
        self.last = {keys.INFO: messages.encode(info())}
        self.on_publish = self._answer
        self._at = at
        self._next = 0
        self._gate(0)

    def _answer(self, key: str, payload: bytes) -> None:
        if key == keys.process(ME, "done"):
            gate = messages.decode(key, payload).done_ns // GATE_NS
            if gate < self._next:
                return
            self._next = gate + 1
            if gate == END:
                self.deliver(keys.EVENT, event("end", "world", last_ns=END * GATE_NS))
            else:
                self._gate(gate + 1)

    def _gate(self, gate: int) -> None:
        self._at.get(gate, lambda world: None)(self)
        self.deliver(keys.status("d1"), status(gate))

    def gates_done(self) -> list[int]:
        return [m.done_ns // GATE_NS for m in self.published_on(keys.process(ME, "done"))]


def run(world: World, stopped: Callable[[], bool] = lambda: False) -> Judge:
    judge = Judge()
    said: list[str] = []
    Runner(world, info(), judge, stopped, said.append).run()  # type: ignore[arg-type]
    return judge


def estimates(gates: range, source: str = "my.d1") -> dict[int, Callable[[World], None]]:
    return {gate: lambda world, g=gate: world.deliver(keys.estimate("d1"), estimate(g, source)) for gate in gates}


def tells(*said: Event | Estimate) -> Callable[[World], None]:
    def tell(world: World) -> None:
        for each in said:
            world.deliver(keys.EVENT if isinstance(each, Event) else keys.estimate("d1"), each)

    return tell


@pytest.mark.parametrize("kind", ["drop", "leave"])
@pytest.mark.parametrize("source", ["my.d1", "estimator.d1", ""])
def test_estimates_of_a_lost_source_are_no_longer_waited_for(kind: str, source: str):
    world = World({**estimates(range(2), source), 2: tells(event(kind, source or "estimator.d1"))})
    run(world)
    assert world.gates_done() == list(range(END + 1))


@pytest.mark.parametrize("subject", ["range.d1", "estimator.d1"])
def test_the_loss_of_another_process_changes_nothing(subject: str):
    world = World({**estimates(range(2)), 2: tells(event("drop", subject))})
    ticks = iter(range(10))
    run(world, stopped=lambda: next(ticks, None) is None)
    assert world.gates_done() == [0, 1]


@pytest.mark.parametrize("successor", ["my.d1", "estimator.d1"])
def test_a_successor_is_waited_for_from_its_own_first_gate(successor: str):
    joins = event("join", successor, incarnation=1, host="x", pid=1, from_ns=4 * GATE_NS)
    world = World({**estimates(range(2)), 2: tells(event("drop", "my.d1")), 3: tells(joins)})
    ticks = iter(range(10))
    run(world, stopped=lambda: next(ticks, None) is None)
    assert world.gates_done() == [0, 1, 2, 3]


GARBAGE = [
    event("end", "world", last_ns="soon"),
    event("end", "world", last_ns=None),
    event("end", "world"),
    event("join", "my.d1", from_ns="soon"),
    event("join", "my.d1"),
    event("restart", ME),
    event("superseded", ME, incarnation="mine", pid=None, host=3, from_ns=0.5),
]


def test_invalid_events_are_refused_and_change_nothing():
    world = World({**estimates(range(END + 1)), 2: tells(*GARBAGE, estimate(2))})
    runner = Runner(world, info(), Judge())  # type: ignore[arg-type]
    assert runner.run() == RUN_ENDED
    assert world.gates_done() == list(range(END + 1))
    assert runner.health.refused == len(GARBAGE)


def test_a_superseded_process_ends():
    entry = {"incarnation": 1, "host": "other", "pid": os.getpid() + 1, "from_ns": 0, "former_pid": os.getpid()}
    world = World({**estimates(range(3)), 2: tells(event("superseded", ME, **entry))})
    with refused(SupersededError, ME, "other", f"pid {os.getpid() + 1}"):
        run(world)


# Several drones


class Swarm(Judge):
    """Reads all sensors of two drones, and an estimate of a third."""

    def __init__(self) -> None:
        super().__init__()
        self.gate_keys = (keys.status("d1"), keys.status("d2"))
        self.reads = (keys.sensors("d1"), keys.sensors("d2"), keys.estimate("d3"))
        self.counted = ("d1", "d2")


def bundle_of(t_ns: int, seq: int, entries: list[tuple[str, Any]]) -> GateMessages:
    """Return messages about drones d1 to d3, bundled as by the world."""
    table = key_table(DRONES)
    return GateMessages.of(t_ns, seq, table, [(key, messages.encode(message)) for key, message in entries])


class InOne(World):
    """Publishes all of a gate in one message."""

    def _gate(self, gate: int) -> None:
        t_ns, still = gate * GATE_NS, (0.0, 0.0, 0.0)
        entries = [
            (keys.sensor("d1", "mag"), Mag(t_ns, gate, t_ns, still)),
            (keys.status("d1"), replace(status(gate), count=2)),
            (keys.status("d2"), status(gate)),
            (keys.status("d3"), status(gate)),
        ]
        self._at.get(gate, lambda world: None)(self)
        self.deliver(keys.GATE, bundle_of(t_ns, gate, entries).pack())


def test_a_reader_of_several_drones_receives_a_gate_in_one_message():
    swarm, world = Swarm(), InOne({3: lambda world: world.deliver(keys.estimate("d3"), estimate(3))})
    Runner(world, info(), swarm).run()  # type: ignore[arg-type]
    assert world.gates_done() == list(range(END + 1))
    assert swarm.received[:3] == [("mag", 0), ("status", 0), ("status", 0)]
    assert len([leaf for leaf, _ in swarm.received if leaf == "status"]) == 2 * (END + 1)  # those of d3 are not read
    assert ("estimate", 3) in swarm.received


def test_garbage_in_place_of_a_gate_is_refused_and_changes_nothing():
    runner = Runner(InOne({2: lambda world: world.deliver(keys.GATE, b"\xc1")}), info(), Swarm())  # type: ignore[arg-type]
    assert runner.run() == RUN_ENDED
    assert runner.health.refused == 1


# A world that answers late


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Retry pending requests at every tick."""
    monkeypatch.setattr(participant, "RETRY_S", 0.0)


def answers(*given: ControlAnswer) -> Callable[[str, dict[str, Any]], ControlAnswer]:
    """Return a handler that gives these answers in turn."""
    left = iter(given)
    return lambda key, args: next(left)


def replayed(*gates: int) -> ControlAnswer:
    pairs = [[keys.estimate("d1"), messages.encode(estimate(gate))] for gate in gates]
    pairs += [[keys.status("d1"), messages.encode(status(gate))] for gate in gates]
    return ControlAnswer(True, result=pairs)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("before", [[], [UNANSWERED], [UNANSWERED, ControlAnswer(True, result=7), replayed()]])
def test_a_lost_gate_is_requested_until_it_arrives(before: list[ControlAnswer]):
    """The estimate of gate 2 is lost, which that of gate 3 reveals; from then on only answers arrive."""

    def loses(world: World) -> None:
        world.deliver(keys.estimate("d1"), estimate(3))

    rest = {gate: each for gate, each in estimates(range(END + 1)).items() if gate not in (2, 3)}
    world = World({**rest, 2: loses})
    world.on_request = answers(*before, replayed(2))
    judge = run(world)
    assert world.gates_done() == list(range(END + 1))
    assert [gate for kind, gate in judge.received if kind == "estimate"] == list(range(END + 1))
    assert world.requests[0] == (REPLAY, {"from_ns": GATE_NS, "keys": [*judge.reads, keys.FAULTS], "page": 0})


@pytest.mark.usefixtures("quick")
def test_a_process_ends_if_a_lost_message_is_no_longer_kept():
    """Estimate 2 is lost, and the world, which went on without this process, no longer has it."""
    rest = {gate: each for gate, each in estimates(range(END + 1)).items() if gate not in (2, 3)}
    world = World({**rest, 2: tells(estimate(3))})
    world.on_request = lambda key, args: replayed()
    with refused(BehindError, ME, "drone/d1/estimate", "0.04"):
        run(world)
    assert not world.published_on(keys.process(ME, "bye"))


@pytest.mark.parametrize("deserted", [False, True])
def test_a_process_that_lost_its_launcher_ends_without_a_bye(deserted: bool):
    world = World(estimates(range(END + 1)))
    reason = Runner(world, info(), Judge(), lambda: True, deserted=lambda: deserted).run()  # type: ignore[arg-type]
    assert reason == "stopped"
    assert len(world.published_on(keys.process(ME, "bye"))) == (not deserted)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("hears", [True, False])
def test_a_process_rejoins_after_a_lost_link_once_the_world_answers(hears: bool):
    """The link drops and recovers at gate 2, which is lost; the world answers late.

    A process that does not hear of its readmission repeats its join several times.
    """
    asked = iter(range(3))

    def cut(world: World) -> None:
        world.last, world.admits = {}, False
        world.cut(False)
        world.cut(True)

    class Slow(World):
        def get(self, expression: str, timeout_s: float = 2.0) -> list[Any]:
            if expression == keys.INFO and next(asked, None) is None:
                self.last = {keys.INFO: messages.encode(info())}
            return super().get(expression, timeout_s)

        def _answer(self, key: str, payload: bytes) -> None:
            if key == keys.process(ME, "join") and hears and len(self.published_on(key)) > 1:
                said = messages.decode(key, payload)
                entry = {"incarnation": said.incarnation, "host": "h", "pid": said.pid, "from_ns": 0, "done_ns": 0}
                self.deliver(keys.EVENT, event("restart", ME, **entry, former_pid=said.pid))
            super()._answer(key, payload)

        def _gate(self, gate: int) -> None:
            if gate == 2:
                cut(self)
            else:
                super()._gate(gate)

    world = Slow(estimates(range(END + 1)))
    world.on_request = answers(UNANSWERED, UNANSWERED, replayed(2), *[replayed()] * 9)
    run(world)
    dones: list[Done] = world.published_on(keys.process(ME, "done"))
    joins = world.published_on(keys.process(ME, "join"))
    again = 1 if hears else len(joins) - 1
    assert (again > 1) != hears
    assert again <= 1 + participant.REJOINS_MAX
    assert [done.done_ns // GATE_NS for done in dones[:4]] == [0, 1, 0, 1]
    assert {done.done_ns // GATE_NS for done in dones[4:]} >= set(range(2, END + 1))
    assert len(dones) == END + 3 or not hears
    assert {done.incarnation for done in dones[2:]} == {joins[1].incarnation} != {joins[0].incarnation}


@pytest.mark.usefixtures("quick")
def test_a_process_does_not_rejoin_another_run_after_a_lost_link():
    def cut(world: World) -> None:
        world.last = {keys.INFO: messages.encode(info("run2"))}
        world.cut(False)
        world.cut(True)

    with refused(RunError, ME, "another"):
        run(World({**estimates(range(END + 1)), 2: cut}))


# A process killed by a fault dies once, however late it steps and in whatever order the fault lists arrive.

KILL = Fault(1, "process_kill", ME, {}, 2 * GATE_NS, 3 * GATE_NS, "tester.one")


def entries(gate: int, seq: int, *faults: Fault) -> Faults:
    return Faults(gate * GATE_NS, seq, faults)


def last_gate(before_gate: int, *lists: Faults) -> int:
    """Return the last gate of a judge that receives these fault lists together, before a gate."""

    def tell(world: World) -> None:
        for each in lists:
            world.deliver(keys.FAULTS, each)
        world.deliver(keys.estimate("d1"), estimate(before_gate))

    world = World({**estimates(range(END + 1)), before_gate: tell})
    runner = Runner(world, info(), Judge())  # type: ignore[arg-type]
    runner.run()
    said_bye = len(world.published_on(keys.process(ME, "bye")))
    assert said_bye == (0 if runner.killed else 1)
    return world.gates_done()[-1]


@pytest.mark.parametrize(
    ("before_gate", "lists", "last"),
    [
        pytest.param(1, [entries(0, 0, KILL)], 3, id="at the first gate in which it acts"),
        pytest.param(2, [entries(2, 0, KILL), entries(4, 1)], 3, id="heard of late, with the list that forgets it"),
        pytest.param(2, [entries(4, 1), entries(2, 0, KILL)], 3, id="heard of after the list that forgets it"),
        pytest.param(5, [entries(2, 0, KILL)], 5, id="heard of too late"),
        pytest.param(1, [entries(0, 0, KILL), entries(1, 1)], END, id="cleared"),
        pytest.param(1, [entries(1, 1, KILL), entries(0, 0)], 3, id="an older list comes later"),
    ],
)
def test_a_kill_ends_a_process_at_the_gate_at_which_it_acts(before_gate: int, lists: list[Faults], last: int):
    assert last_gate(before_gate, *lists) == last


class Second(Judge):
    """A judge that starts from the estimate that the world holds for it."""

    def warm_start_keys(self) -> tuple[str, ...]:
        return (keys.estimate("d1"),)


@pytest.mark.parametrize(("former_gate", "killed"), [(2, True), (3, False), (4, False)])
def test_a_restarted_process_is_killed_only_if_its_predecessor_was_not(former_gate: int, killed: bool):
    """Its predecessor got as far as the given gate; the kill acts at gate 3."""
    world = World(estimates(range(END + 1)))
    world.last[keys.estimate("d1")] = encode(estimate(former_gate))
    world.last[keys.FAULTS] = encode(entries(0, 0, KILL))
    runner = Runner(world, info(), Second())  # type: ignore[arg-type]
    runner.run()
    assert runner.killed == killed
    assert world.gates_done()[-1] == (3 if killed else END)


# A process that continues from the snapshot of its predecessor


class Counter(Judge):
    """A judge that publishes, as its estimate of d2, how many gates it and its predecessors have stepped."""

    repeats = (keys.cluster_request("main"),)

    def __init__(self) -> None:
        super().__init__()
        self.count = 0
        self.repeated: list[tuple[int, int]] = []  # count at the time of the request, gate of the request

    def step(self, t_ns: int) -> list[Output]:
        self.count += 1
        key = keys.estimate("d2")
        return [Output(key, replace(estimate(t_ns // GATE_NS, ME), seq=self.next_seq(key), yaw_rad=float(self.count)))]

    def repeat(self, key: str, message: Any) -> None:
        self.repeated.append((self.count, message.t_ns // GATE_NS))

    def snapshot(self) -> State:
        return {"count": self.count}

    def restore(self, state: State) -> None:
        self.count = state["count"]
        if state.get("raises"):
            raise ZeroDivisionError

    def warm_start_keys(self) -> tuple[str, ...]:
        return (keys.estimate("d2"),)


def snapshot_of(gate: int, version: int = VERSION, **checkpoint: Any) -> Snapshot:
    """Return the snapshot of a Counter that has just stepped this gate."""
    seq = {keys.estimate("d2"): gate + 1, "done": gate + 1}
    state = {"own": {"count": gate + 1}, "seq": seq, "links": None} | checkpoint
    return Snapshot(gate * GATE_NS, 0, ME, version, pack(state))


class Restarting(World):
    """A world whose judge died after publishing its results up to gate DIED; its history starts at a given gate."""

    DIED = 3

    def __init__(self, snapshot: Snapshot, first_kept: int = 0) -> None:
        self._joined = False
        super().__init__(estimates(range(END + 1)))
        self.admits = False
        self.last[keys.process(ME, "snapshot")] = messages.encode(snapshot)
        self.last[keys.CLOCK] = messages.encode(Clock(self.DIED * GATE_NS, 0, "run1", self.DIED, "running", 1.0))
        self.last[keys.estimate("d2")] = messages.encode(estimate(self.DIED, ME))
        self._kept = range(first_kept, self.DIED + 2)
        self.on_request = self._replay

    def _replay(self, key: str, args: dict[str, Any]) -> ControlAnswer:
        gates = [gate for gate in self._kept if gate * GATE_NS > args["from_ns"]]
        request = ClusterRequest(3 * GATE_NS, 0, "hold", {}, "me.main", True)
        answer = replayed(*gates)
        return replace(answer, result=[*answer.result, [keys.cluster_request("main"), messages.encode(request)]])

    def _answer(self, key: str, payload: bytes) -> None:
        if key == keys.process(ME, "join"):
            said, done_ns = messages.decode(key, payload), self.DIED * GATE_NS
            entry = {"incarnation": said.incarnation, "host": "h", "pid": 1, "from_ns": 0, "done_ns": done_ns}
            self._joined, self._next = True, self.DIED + 1
            self.deliver(keys.EVENT, event("restart", ME, **entry, former_pid=2))
        super()._answer(key, payload)

    def _gate(self, gate: int) -> None:
        if self._joined:
            super()._gate(gate)


def counts(world: World) -> list[tuple[int, float, int]]:
    """Return the gate, count and sequence number of each estimate that a Counter has published."""
    return [(each.t_ns // GATE_NS, each.yaw_rad, each.seq) for each in world.published_on(keys.estimate("d2"))]


@pytest.mark.parametrize("gate", [0, 1, 3])
def test_a_restart_redoes_gates_since_its_snapshot_and_publishes_new_ones(gate: int):
    world, judge = Restarting(snapshot_of(gate)), Counter()
    Runner(world, info(), judge).run()  # type: ignore[arg-type]
    assert counts(world) == [(g, g + 1.0, g) for g in range(4, END + 1)]
    assert world.gates_done() == list(range(4, END + 1))
    assert [done.seq for done in world.published_on(keys.process(ME, "done"))] == list(range(4, END + 1))
    assert judge.repeated == ([(3, 3)] if gate < 3 else [])
    assert [g for kind, g in judge.received if kind == "status"] == list(range(gate + 1, END + 1))


@pytest.mark.parametrize(
    "useless",
    [
        snapshot_of(1, version=VERSION + 1),
        snapshot_of(1, own={"counts": 2}),
        snapshot_of(1, own={"count": 7, "raises": True}),
        snapshot_of(Restarting.DIED + 1),
        Snapshot(GATE_NS, 0, ME, VERSION, b"\xc1"),
        replace(snapshot_of(1), t_ns=-2 * participant.RESUME_NS),
    ],
    ids=["other version", "other state", "half of it", "of the future", "garbage", "old"],
)
def test_without_a_usable_snapshot_a_process_starts_from_its_last_output(useless: Snapshot):
    world, judge = Restarting(useless), Counter()
    said: list[str] = []
    Runner(world, info(), judge, say=said.append).run()  # type: ignore[arg-type]
    assert [gate for gate, _, _ in counts(world)] == list(range(4, END + 1))
    assert counts(world)[0][1] == 1.0
    assert any(has_terms(line, ME, "snapshot") for line in said)


def test_a_process_ends_if_the_gates_since_its_snapshot_are_forgotten():
    with refused(BehindError, ME, "snapshot", "0.00"):
        Runner(Restarting(snapshot_of(0), first_kept=3), info(), Counter()).run()  # type: ignore[arg-type]


def test_snapshots_are_published_at_intervals_after_the_done():
    world = World(estimates(range(END + 1)))
    Runner(world, info(), Counter(), snapshot_ns=3 * GATE_NS).run()  # type: ignore[arg-type]
    taken: list[Snapshot] = world.published_on(keys.process(ME, "snapshot"))
    assert [each.t_ns // GATE_NS for each in taken] == [0, 3, 6]
    assert [each.seq for each in taken] == [0, 1, 2]
    assert [unpack(each.state)["own"]["count"] for each in taken] == [1, 4, 7]
    keys_of = [key for key, _ in world.published]
    assert keys_of.index(keys.process(ME, "snapshot")) > keys_of.index(keys.process(ME, "done"))


class Opaque(Counter):
    """A counter whose state does not consist of plain values."""

    def __init__(self, state: Any) -> None:
        super().__init__()
        self.state = state

    def snapshot(self) -> Any:
        return self.state


def tree_within_itself() -> dict[str, Any]:
    tree: dict[str, Any] = {}
    tree["parent"] = [tree]
    return tree


@pytest.mark.parametrize(
    ("state", "terms"),
    [
        ({"count": object()}, ("count", "object")),
        ({"a": {"b": [1, {"c": 1j}]}}, ("a.b[1].c", "complex")),
        ({3: 1}, ("map", "name")),
        ({"seen": np.array(["x"])}, ("seen", "<U1")),
        ({"big": 1 << 70}, ("big", "int", "64 bits")),
        ({"a": {1 << 70: 1}}, ("a", "key", "int", "64 bits")),
        ({"count": 1, "tree": tree_within_itself()}, ("tree", "nested")),
        ([1, 2], ("[1, 2]",)),
    ],
)
def test_an_unsupported_user_state_is_reported_with_class_field_and_time(state: Any, terms: Any) -> None:
    world = World(estimates(range(END + 1)))
    with pytest.raises(UserCodeError) as raised:
        Runner(world, info(), Opaque(state), snapshot_ns=3 * GATE_NS).run()  # type: ignore[arg-type]
    line = str(raised.value)
    assert has_terms(line, ME, "0.00", f"{Opaque.__module__}:Opaque.snapshot", *terms), line
    (bye,) = world.published_on(keys.process(ME, "bye"))
    assert (bye.reason, bye.failed) == (line, True)


class Failing(Judge):
    """Divides by zero in gate 3."""

    def step(self, t_ns: int) -> list[Output]:
        return [] if t_ns < 3 * GATE_NS else [1 / 0]  # type: ignore[list-item]


def test_an_exception_in_user_code_is_reported_to_world_and_caller():
    world = World(estimates(range(END + 1)))
    with pytest.raises(UserCodeError) as raised:
        Runner(world, info(), Failing(), lambda: False).run()  # type: ignore[arg-type]
    line = str(raised.value)
    assert line.startswith(f"{ME} at 0.06 s: ")
    assert all(term in line for term in ("Failing.step", "ZeroDivisionError", "test_runner.py:")), line
    (bye,) = world.published_on(keys.process(ME, "bye"))
    assert (bye.reason, bye.failed) == (line, True)
    assert world.gates_done() == [0, 1, 2]
