"""A run flown again in this process: its world, its agents, and whatever else reached the world, from the record."""

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from zsim.contract import keys, messages
from zsim.contract.framing import GateMessages
from zsim.contract.messages import ControlRequest
from zsim.errors import DecodeError, RunError
from zsim.record import Recorded
from zsim.runtime.agent import Agent, Output
from zsim.runtime.bus import Bus
from zsim.runtime.group import AgentGroup
from zsim.scenario.scenario import Scenario
from zsim_agents.hosting import hosted
from zsim_analysis.rerun.participants import Cast
from zsim_analysis.rerun.recorded_inputs import OUTPUTS, Passage
from zsim_analysis.rerun.truth_comparison import Answers
from zsim_world.flight.world import World

STEERS = frozenset({"acquire", "release", "fault_add", "fault_clear"})  # requests that change a flight

Requests = dict[int, list[tuple[str, ControlRequest]]]


class AskedAgain(AgentGroup):
    """Agents of one process, asked at each gate what they were asked on record.

    Args:
        team: all of them as one.
        requests: by the first gate that they shape: control key, request.
    """

    def __init__(self, team: Agent, requests: Requests) -> None:
        super().__init__([team])
        self._asked = requests

    def step(self, t_ns: int) -> list[Output]:
        for key, request in self._asked.pop(t_ns, ()):
            if key in self.control_keys():
                self.control(key, request)
        return super().step(t_ns)


class RerunBus(Bus):
    """Flies a run again.

    Args:
        world: made anew.
        cast: whose agents are run again; without any, all commands come from the record.
        info, scenario: of the run.

    Attributes:
        truth: payloads at the newest gate, by drone.
        refused: requests that were done on record, and are refused now, in words.
        answers: of the agents, held against those on record.
    """

    def __init__(self, world: World, cast: Cast, info: messages.Info, scenario: Scenario) -> None:
        asked = _by_gate(cast.requests)
        teams = [AskedAgain(hosted(info, scenario, team.members), dict(asked)) for team in cast.teams]
        super().__init__(world, teams, lambda: 0, self._say, self._note)
        self._world = world
        self._played = cast.played
        self.truth: dict[str, bytes] = {}
        self.refused: list[str] = []
        self.answers = Answers(world.delay_ns + 2 * world.gate_ns)

    def pass_on(self, passage: Passage) -> None:
        """Take in what reached the world on the way to a gate, let the agents answer, and go to that gate.

        Raises:
            RunError: an agent does not answer, since what it waits for is not on record.
        """
        for recorded in passage.inputs:
            self._feed(recorded)
        while self._round():
            pass
        owing = [p.name for p in self._world.owing() if p.name in self._played]
        if owing and self._world.state != "waiting":
            at = f"before {passage.t_ns / 1e9:.2f} s"
            raise RunError(
                f"{', '.join(owing)} cannot answer {at}: what it waits for is not on record; --commands-only"
            )
        self.answers.close(passage.t_ns)
        self._world.advance(0)
        self._spread()
        if self._world.now_ns != passage.t_ns:
            reason = self._world.ended or "the gates are not those of the record"
            raise RunError(f"flown again, the run ends at {self._world.now_ns / 1e9:.2f} s: {reason}")

    def _say(self, key: str, message: Any) -> None:
        if isinstance(message, (*OUTPUTS, messages.Command)):
            self.answers.take(key, message)

    def _note(self, gate: GateMessages) -> None:
        self.truth = {keys.thing(key): payload for key, payload in gate.pairs if keys.leaf(key) == "truth"}

    def _update_faults(self, faults: messages.Faults) -> None:
        if self._played:  # alone, the world is fed with what came of them
            super()._update_faults(faults)

    # What is fed

    def _feed(self, recorded: Recorded) -> None:
        try:
            message = messages.decode(recorded.key, recorded.payload)
        except DecodeError:
            return  # the world refused it too
        key = recorded.key
        if key == keys.EVENT:
            self._feed_event(message)
        elif isinstance(message, OUTPUTS):
            self._feed_output(key, message)
        elif isinstance(message, messages.Command):
            if message.source in self._played:
                self.answers.take(key, message)
            else:
                self._world.handle(key, message, 0)
        elif keys.thing(key) not in self._played:
            self._world.handle(key, message, 0)

    def _feed_output(self, key: str, message: Any) -> None:
        """Hand what another process estimated, or said of a cluster, to the agents that read it."""
        role = "estimator" if isinstance(message, messages.Estimate) else "controller"
        asked = isinstance(message, messages.ClusterRequest)
        source = (message.controller if asked else message.source) or f"{role}.{keys.thing(key)}"
        if source in self._played:
            self.answers.take(key, message)
            return
        for inbox in self._route(key).inboxes:
            inbox.put(key, message)
        self._world.output_of(source)

    def _feed_event(self, event: messages.Event) -> None:
        """Repeat what reached the world otherwise than as a message: deaths, and requests."""
        if event.kind == "death" and event.subject not in self._played:
            self._world.died(event.subject, 0)
        elif event.kind == "control" and event.subject in STEERS and event.data.get("ok"):
            args = event.data.get("args")
            request = ControlRequest(event.subject, args if isinstance(args, dict) else {}, event.source)
            answer = self._world.control(request)
            if not answer.ok:
                self.refused.append(f"{event.subject} at {event.t_ns / 1e9:.2f} s: {answer.error}")


def _by_gate(requests: Sequence[tuple[str, messages.ClusterRequest]]) -> Requests:
    asked: defaultdict[int, list[tuple[str, ControlRequest]]] = defaultdict(list)
    for key, request in requests:
        control = keys.cluster_control(keys.thing(key))
        asked[request.t_ns].append((control, ControlRequest(request.op, request.args, request.source)))
    return dict(asked)
