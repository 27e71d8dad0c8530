"""A process as a participant in a run: unanswered requests are repeated, and a successor ends the process."""

import os
from typing import Any

import pytest
from fake_link import FakeLink
from msgspec.structs import replace
from plain_messages import GATE_NS, run_info

from zsim.contract import keys, messages
from zsim.contract.messages import ProcessEntry
from zsim.contract.run_messages import Clock, ControlAnswer, Event, Snapshot
from zsim.contract.snapshot import VERSION, pack
from zsim.runtime import participant
from zsim.runtime.agent import Agent, Output
from zsim.runtime.participant import RETRY_S, AgentParticipant, Participant
from zsim.transport.session import ReceivedSample

INFO = run_info()


class Quiet(Agent):
    name, period_ns, reads, gate_keys = "quiet.one", GATE_NS, ("drone/d1/truth",), ("drone/d1/truth",)

    def receive(self, key: str, message: Any) -> None:
        return

    def step(self, t_ns: int) -> list[Output]:
        return []


class Wall:
    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_an_unanswered_request_is_repeated_after_a_while():
    link, wall, came = FakeLink(), Wall(), []
    member = AgentParticipant(link, INFO, Quiet(), came.append, lambda text: None, wall)  # type: ignore[arg-type]
    for turns in (1, 2, 3):
        for _ in range(5):
            member.ask_again(3 * GATE_NS, "drone/d1/truth")
            member.settle()
        assert len(link.requests) == turns
        assert member.owes
        wall.now_s += RETRY_S
    link.on_request = lambda key, args: ControlAnswer(True, result=[["drone/d1/truth", b"x"]])
    member.settle()
    assert came == [ReceivedSample("drone/d1/truth", b"x")]
    assert not member.owes


def test_another_gate_is_requested_at_once():
    link = FakeLink()
    member = AgentParticipant(link, INFO, Quiet(), lambda sample: None, lambda text: None, Wall())  # type: ignore[arg-type]
    for gate in (3, 4):
        member.ask_again(gate * GATE_NS, "drone/d1/truth")
    assert [args["from_ns"] // GATE_NS for _, args in link.requests] == [2, 3]


@pytest.mark.parametrize(("mode", "from_gate"), [("lockstep", 0), ("realtime", 2)])
def test_a_replay_request_includes_gates_held_back_in_lockstep(mode: Any, from_gate: int) -> None:
    """From the command delay and one gate before; in realtime nothing is held, and the agent would get duplicates."""
    link, agent = FakeLink(), Quiet()
    agent.reads = (*Quiet.reads, "drone/d2/estimate")
    info = replace(INFO, mode=mode)
    member = AgentParticipant(link, info, agent, lambda sample: None, lambda text: None, Wall())  # type: ignore[arg-type]
    member.ask_again(3 * GATE_NS, "drone/d1/truth")
    assert [args["from_ns"] // GATE_NS for _, args in link.requests] == [from_gate]


def test_a_process_rejoins_if_its_entry_shows_an_unknown_incarnation():
    link = FakeLink()
    link.last = {keys.INFO: messages.encode(INFO)}
    member = AgentParticipant(link, INFO, Quiet(), lambda sample: None, lambda text: None, Wall())  # type: ignore[arg-type]
    member.enter()
    (own,) = link.published_on("process/*/join")
    for incarnation in (own.incarnation, 7):
        member.take_entry(ProcessEntry(incarnation, link.host, os.getpid(), 0, former_pid=os.getpid()))
    first, second = link.published_on("process/*/join")
    assert second.incarnation not in {first.incarnation, 7}
    for own in (first, second):
        member.take_entry(ProcessEntry(own.incarnation, link.host, os.getpid(), 0, former_pid=os.getpid()))
    assert len(link.published_on("process/*/join")) == 2
    assert member.failure is None


# A world that is not available yet, for example while it restarts


def test_a_join_is_repeated_until_the_world_admits_the_process():
    link, wall = FakeLink(), Wall()
    link.admits, link.last = False, {keys.INFO: messages.encode(INFO)}
    member = AgentParticipant(link, INFO, Quiet(), lambda sample: None, lambda text: None, wall)  # type: ignore[arg-type]
    member.enter()
    for _ in range(3):
        wall.now_s += RETRY_S
        member.settle()
    joins = link.published_on("process/*/join")
    assert len(joins) == 4
    assert len({join.incarnation for join in joins}) == 1
    assert member.awaited
    member.take_entry(ProcessEntry(joins[0].incarnation, link.host, os.getpid(), 0))
    wall.now_s += RETRY_S
    member.settle()
    assert (member.awaited, len(link.published_on("process/*/join"))) == (False, 4)


def test_a_snapshot_is_requested_until_a_world_answers(monkeypatch: pytest.MonkeyPatch):
    link, states = FakeLink(), []
    agent = Quiet()
    monkeypatch.setattr(agent, "snapshot", lambda: {"count": 3})
    monkeypatch.setattr(agent, "restore", states.append)
    state = agent.checkpoint()
    assert state is not None
    key = keys.process(agent.name, "snapshot")
    kept = {
        key: messages.encode(Snapshot(GATE_NS, 0, agent.name, VERSION, pack(state))),
        keys.CLOCK: messages.encode(Clock(2 * GATE_NS, 0, "r", 2, "running", 1.0)),
        keys.INFO: messages.encode(INFO),
    }
    monkeypatch.setattr(
        participant.time, "sleep", lambda wall_s: link.last.update(kept)
    )  # available at the next request
    member = AgentParticipant(link, INFO, agent, lambda sample: None, lambda text: None, Wall())  # type: ignore[arg-type]
    assert (member.resume(), states) == (GATE_NS, [{"count": 3}])


def test_a_process_that_is_to_end_does_not_wait_for_a_world():
    link = FakeLink()
    settings = (lambda sample: None, lambda text: None, Wall(), lambda: True)
    member = AgentParticipant(link, INFO, Quiet(), *settings)  # type: ignore[arg-type]
    assert member.resume() is None


# A process that only displays and never gates


ME = "console.1"


def console(link: FakeLink) -> Participant:
    """Return a participant that the fake link has admitted."""
    participant = Participant(link, INFO, ME)  # type: ignore[arg-type]
    participant.announce()
    assert participant.admitted
    return participant


def tell(link: FakeLink, kind: str, incarnation: int, pid: int) -> None:
    data = {"incarnation": incarnation, "host": link.host, "pid": pid, "from_ns": 0}
    link.deliver(keys.EVENT, Event(0, 0, kind, ME, ME, "", data))


@pytest.mark.parametrize("kind", ["join", "restart", "superseded"])
def test_a_process_is_superseded_by_another_of_its_name(kind: str):
    link = FakeLink()
    shown = console(link)
    tell(link, kind, 7, os.getpid() + 1)
    assert shown.superseded
    shown.leave("closed")
    assert not link.published_on("process/*/bye")  # which would count as a bye of the other process


def test_a_process_not_yet_admitted_is_not_superseded():
    link = FakeLink()
    link.admits = False
    shown = Participant(link, INFO, ME)  # type: ignore[arg-type]
    shown.announce()
    tell(link, "superseded", 7, os.getpid() + 1)
    assert not shown.superseded


def test_a_forged_join_of_its_own_process_is_answered_by_a_newer_one():
    link = FakeLink()
    shown = console(link)
    tell(link, "superseded", 7, os.getpid())
    shown.tick()
    first, second = link.published_on("process/*/join")
    assert not shown.superseded
    assert second.incarnation not in {first.incarnation, 7}


@pytest.mark.parametrize("slack_ns", [0, GATE_NS])
def test_after_a_lost_link_a_participant_rejoins_and_repeats_its_done(slack_ns: int):
    link = FakeLink()
    shown = Participant(link, INFO, ME, slack_ns=slack_ns)  # type: ignore[arg-type]
    shown.announce()
    shown.done(3)
    link.cut(True)
    shown.tick()
    link.cut(False)
    link.cut(True)
    shown.tick()
    first, second = link.published_on("process/*/join")
    assert (first.seq, second.seq) == (0, 1)
    dones = link.published_on("process/*/done")
    assert [(done.done_ns, done.incarnation) for done in dones] == (
        [(3, first.incarnation), (3, second.incarnation)] if slack_ns else []
    )


def test_a_participant_leaves_only_once():
    link = FakeLink()
    shown = console(link)
    for _ in range(2):
        shown.leave("closed")
    assert len(link.published_on("process/*/bye")) == 1
