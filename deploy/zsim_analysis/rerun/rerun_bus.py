"""A run flown again in this process: its world, its agents, and from the record all else that reached the world."""

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from zsim.contract import flight_messages, keys, messages, run_messages
from zsim.contract.framing import GateMessages
from zsim.contract.run_messages import ControlRequest
from zsim.errors import RunError
from zsim.record import Recorded
from zsim.runtime.agent import Agent, Output
from zsim.runtime.bus import Bus
from zsim.runtime.group import AgentGroup
from zsim.scenario.scenario import Scenario
from zsim_agents.hosting import hosted
from zsim_analysis.reading.recorded_run import decode_or_none
from zsim_analysis.rerun.recorded_inputs import OUTPUTS, GateInputs, RecordedAgents
from zsim_analysis.rerun.truth_comparison import OutputComparison
from zsim_world.flight.world import World

FLIGHT_REQUESTS = frozenset({"acquire", "release", "fault_add", "fault_clear"})  # requests that change a flight

Requests = dict[int, list[tuple[str, ControlRequest]]]


class AgentsWithRequests(AgentGroup):
    """Agents of one process that receive the recorded requests again.

    Args:
        agents: all of them as one.
        requests: by the first gate that they affect: control key, request.
    """

    def __init__(self, agents: Agent, requests: Requests) -> None:
        super().__init__([agents])
        self._requests = requests

    def step(self, t_ns: int) -> list[Output]:
        for key, request in self._requests.pop(t_ns, ()):
            if key in self.control_keys():
                self.control(key, request)
        return super().step(t_ns)


class RerunBus(Bus):
    """Flies a run again.

    Args:
        world: made anew.
        agents: those that are run again; without any, all commands come from the record.
        info, scenario: of the run.

    Attributes:
        truth: payloads at the newest gate, by drone.
        refused: requests that were carried out on record and are refused now, as text.
        outputs: of the agents, compared with those on record.
    """

    def __init__(self, world: World, agents: RecordedAgents, info: messages.Info, scenario: Scenario) -> None:
        requests = _by_gate(agents.requests)
        groups = [
            AgentsWithRequests(hosted(info, scenario, process.members), dict(requests)) for process in agents.processes
        ]
        super().__init__(world, groups, lambda: 0, self._compare_output, self._keep_truth)
        self._world = world
        self._rerun = agents.names
        self.truth: dict[str, bytes] = {}
        self.refused: list[str] = []
        self.outputs = OutputComparison(world.clock.delay_ns + 2 * world.clock.gate_ns)

    def fly_to(self, gate: GateInputs) -> None:
        """Receive the inputs of a gate, let the agents answer, and go to that gate.

        Raises:
            RunError: an agent does not answer, since what it waits for is not on record.
        """
        for recorded in gate.inputs:
            self._feed(recorded)
        while self._round():
            pass
        waiting = [p.name for p in self._world.blocking() if p.name in self._rerun]
        if waiting and self._world.clock.state != "waiting":
            at = f"before {gate.t_ns / 1e9:.2f} s"
            raise RunError(
                f"{', '.join(waiting)} cannot answer {at}: what it waits for is not on record; --commands-only"
            )
        self.outputs.expire(gate.t_ns)
        self._world.advance(0)
        self._spread()
        if self._world.now_ns != gate.t_ns:
            reason = self._world.ended or "the gates are not those of the record"
            raise RunError(f"flown again, the run ends at {self._world.now_ns / 1e9:.2f} s: {reason}")

    def _compare_output(self, key: str, message: Any) -> None:
        if isinstance(message, (*OUTPUTS, flight_messages.Command)):
            self.outputs.add(key, message)

    def _keep_truth(self, gate: GateMessages) -> None:
        self.truth = {keys.thing(key): payload for key, payload in gate.pairs if keys.leaf(key) == "truth"}

    def _update_faults(self, faults: run_messages.Faults) -> None:
        if self._rerun:  # alone, the world receives the commands that resulted from them
            super()._update_faults(faults)

    def _feed(self, recorded: Recorded) -> None:
        key, message = recorded.key, decode_or_none(recorded)
        if message is None:  # the world refused it too
            return
        if key == keys.EVENT:
            self._feed_event(message)
        elif isinstance(message, OUTPUTS):
            self._feed_output(key, message)
        elif isinstance(message, flight_messages.Command):
            if message.source in self._rerun:
                self.outputs.add(key, message)
            else:
                self._world.handle(key, message, 0)
        elif keys.thing(key) not in self._rerun:
            self._world.handle(key, message, 0)

    def _feed_output(self, key: str, message: Any) -> None:
        """Pass the estimate, or the output about a cluster, of another process to the agents that read it."""
        role = "estimator" if isinstance(message, flight_messages.Estimate) else "controller"
        is_request = isinstance(message, run_messages.ClusterRequest)
        source = (message.controller if is_request else message.source) or f"{role}.{keys.thing(key)}"
        if source in self._rerun:
            self.outputs.add(key, message)
            return
        for inbox in self._route(key).inboxes:
            inbox.put(key, message)
        self._world.count_output(source)

    def _feed_event(self, event: run_messages.Event) -> None:
        """Repeat what reached the world other than as a message: deaths, and requests."""
        if event.kind == "death" and event.subject not in self._rerun:
            self._world.handle_death(event.subject, 0)
        elif event.kind == "control" and event.subject in FLIGHT_REQUESTS and event.data.get("ok"):
            args = event.data.get("args")
            request = ControlRequest(event.subject, args if isinstance(args, dict) else {}, event.source)
            answer = self._world.control(request)
            if not answer.ok:
                self.refused.append(f"{event.subject} at {event.t_ns / 1e9:.2f} s: {answer.error}")


def _by_gate(requests: Sequence[tuple[str, run_messages.ClusterRequest]]) -> Requests:
    by_gate: defaultdict[int, list[tuple[str, ControlRequest]]] = defaultdict(list)
    for key, request in requests:
        control = keys.cluster_control(keys.thing(key))
        by_gate[request.t_ns].append((control, ControlRequest(request.op, request.args, request.source)))
    return dict(by_gate)
