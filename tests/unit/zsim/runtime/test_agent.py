"""Agents that share a process: each receives and publishes what it would in a process of its own."""

from collections.abc import Sequence
from typing import Any

import pytest
from plain_messages import GATE_NS, estimate, run_info, status
from refused import refused

from zsim.contract import keys
from zsim.contract.run_messages import Bye, ControlAnswer, ControlRequest
from zsim.contract.snapshot import pack, unpack
from zsim.errors import RunError
from zsim.runtime.agent import Agent, AgentGroup, Output

HOLD_NS = 2 * GATE_NS  # for a command delay of one gate
CLUSTER = keys.cluster_control("main")


class Member(Agent):
    """Publishes one message per gate on its own key, of a type that is not the key's, and notes what it receives."""

    _is_own = False  # type: ignore[assignment]

    def __init__(self, name: str, reads: Sequence[str], writes: str, period_ns: int = GATE_NS) -> None:
        super().__init__()
        self.name, self.period_ns = name, period_ns
        self.reads = self.gate_keys = tuple(reads)
        self.writes = (writes,)
        self.notes: list[Any] = []
        self.rehearsed = False

    def receive(self, key: str, message: Any) -> None:
        self.notes.append((key, message.t_ns, message.seq))

    def step(self, t_ns: int) -> list[Output]:
        self.notes.append(t_ns)
        key = self.writes[0]
        return [Output(key, Bye(t_ns, self.next_seq(key), f"{self.source} of {self.name}"))]

    def rehearse(self) -> None:
        self.rehearsed = True

    def warm_start_keys(self) -> tuple[str, ...]:
        return self.writes

    def warm_start(self, key: str, message: Any) -> None:
        self.notes.append(("warm", key))


class Overhearing(Member):
    """A member that reads all estimates, and whose gate is closed by the status of the drone."""

    def __init__(self, name: str, writes: str) -> None:
        super().__init__(name, [keys.status("d1")], writes)
        self.reads = (*self.reads, keys.estimate("*"))

    def snapshot(self) -> dict[str, Any]:
        return {}


class Asked(Member):
    """A member that answers requests."""

    def control_keys(self) -> tuple[str, ...]:
        return (CLUSTER,)

    def control(self, key: str, request: ControlRequest) -> ControlAnswer:
        return ControlAnswer(ok=True, result=request.op)


def team() -> tuple[Member, Member, AgentGroup]:
    first = Member("estimator.d1", [keys.status("d1")], keys.estimate("d1"))
    first.serves = ("estimator.d2",)
    first.counted = ("d1",)
    last = Asked("controller.main", [keys.status("d1"), keys.estimate("d1")], keys.cluster_state("main"))
    return first, last, AgentGroup([first, last], HOLD_NS)


def test_a_group_reads_external_inputs_and_has_the_name_of_its_last_member():
    _, _, group = team()
    assert group.reads == group.gate_keys == (keys.status("d1"),)
    assert group.counted == ("d1",)
    assert group.writes == (keys.estimate("d1"), keys.cluster_state("main"))
    assert (group.name, group.role, group.period_ns) == ("controller.main", "controller", GATE_NS)
    assert group.serves == ("estimator.d1", "estimator.d2")


def test_a_member_receives_outputs_of_earlier_members_in_the_same_gate():
    first, last, group = team()
    group.receive(keys.status("d1"), status(GATE_NS))
    outputs = group.step(GATE_NS)
    assert first.notes == [(keys.status("d1"), GATE_NS, 0), GATE_NS]
    assert last.notes == [(keys.estimate("d1"), GATE_NS, 0), (keys.status("d1"), GATE_NS, 0), GATE_NS]
    assert [output.key for output in outputs] == [keys.estimate("d1"), keys.cluster_state("main")]
    decisions: list[Any] = [message for _, message in outputs]
    assert [message.reason for message in decisions] == [
        "controller.main of estimator.d1",
        "controller.main of controller.main",
    ]


@pytest.mark.parametrize("resumed", [False, True])
def test_an_input_closing_one_member_s_gate_is_held_for_other_readers(resumed: bool):
    """This also holds if the group resumes from a snapshot in between."""

    def made() -> tuple[Overhearing, AgentGroup]:
        waiting = Member("controller.main", [keys.estimate("d2")], keys.cluster_state("main"))
        waiting.snapshot = dict
        overhearing = Overhearing("talk.a", keys.cluster_state("a"))
        return overhearing, AgentGroup([overhearing, waiting], HOLD_NS)

    overhearing, group = made()
    info = run_info()
    for gate in range(4):
        group.receive(keys.status("d1"), status(gate * GATE_NS, gate))
        group.receive(keys.estimate("d2"), estimate(gate * GATE_NS, gate))
        group.step(gate * GATE_NS)
        if resumed and gate == 1:
            assert [note for note in overhearing.notes if keys.estimate("d2") in str(note)] == []
            state = unpack(pack(group.checkpoint() or {}))
            overhearing, group = made()
            group.resume(info, state)
    heard = overhearing.notes[-6:]
    assert heard == [
        *((keys.estimate("d2"), 0, 0), (keys.status("d1"), 2 * GATE_NS, 2), 2 * GATE_NS),
        *((keys.estimate("d2"), GATE_NS, 1), (keys.status("d1"), 3 * GATE_NS, 3), 3 * GATE_NS),
    ]


def test_inputs_are_ordered_by_time_key_and_number():
    _, last, group = team()
    for t_ns, seq in ((2 * GATE_NS, 3), (GATE_NS, 2), (GATE_NS, 1)):
        group.receive(keys.status("d1"), status(t_ns, seq))
    group.step(2 * GATE_NS)
    statuses = [note[1:] for note in last.notes if isinstance(note, tuple) and note[0] == keys.status("d1")]
    assert statuses == [(GATE_NS, 1), (GATE_NS, 2), (2 * GATE_NS, 3)]


def test_requests_and_last_values_go_to_the_right_member():
    first, last, group = team()
    group.rehearse()
    assert (first.rehearsed, last.rehearsed) == (True, True)
    assert group.control_keys() == (CLUSTER,)
    assert group.control(CLUSTER, ControlRequest("hold", {}, "console.1")).result == "hold"
    assert group.warm_start_keys() == (keys.estimate("d1"), keys.cluster_state("main"))
    group.warm_start(keys.estimate("d1"), None)
    group.resume_seq(keys.estimate("d1"), 41)
    assert first.notes == [("warm", keys.estimate("d1"))]
    assert last.notes == []
    assert [message.seq for _, message in group.step(GATE_NS)] == [42, 0]  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("members", "terms"),
    [
        ([], ("group", "members", "one")),
        (
            [
                Member("talk.a", [keys.cluster_state("b")], keys.cluster_state("a")),
                Member("talk.b", [keys.cluster_state("a")], keys.cluster_state("b")),
            ],
            ("gate_keys", "talk.a", "talk.b", "each other"),
        ),
    ],
    ids=["nobody", "waiting for each other"],
)
def test_an_impossible_group_is_refused(members: list[Member], terms: tuple[str, ...]):
    with refused(RunError, *terms):
        AgentGroup(members, HOLD_NS)


def test_each_member_steps_at_its_own_period():
    slow, slower = Member("slow.a", [], "a", 2 * GATE_NS), Member("slower.b", [], "b", 3 * GATE_NS)
    group = AgentGroup([slow, slower], HOLD_NS)
    assert group.period_ns == GATE_NS
    published = {gate: [output.key for output in group.answer(gate * GATE_NS, []) or ()] for gate in range(7)}
    assert published == {0: ["a", "b"], 1: [], 2: ["a"], 3: ["b"], 4: ["a"], 5: [], 6: ["a", "b"]}
