"""A run flown again in this process: its world, its agents, and from the record all else that reached the world.

Before it, the comparison of two flights of one run, instant by instant.
"""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from zsim.contract import flight_messages, keys, messages, run_messages
from zsim.contract.camera_messages import Sightings
from zsim.contract.framing import GateMessages
from zsim.contract.run_messages import ControlRequest
from zsim.errors import RunError, RunFailedError
from zsim.record import Recorded
from zsim.runtime.agent import Agent, AgentGroup, Output
from zsim.runtime.bus import Bus
from zsim.runtime.inbox import NEVER_NS, Inbox, output_hold_ns
from zsim.scenario.scenario import Scenario
from zsim.schema.message import Message
from zsim_agents.hosting import hosted
from zsim_analysis.reading.recorded_run import GateInputs, RecordedAgents, decode_or_none
from zsim_world.run.coordinator import FLIGHT_REQUESTS
from zsim_world.run.world import World

COUNTED = ("position_m", "velocity_m_s", "orientation_wxyz", "angular_velocity_rad_s")  # of truth_sha256


class Difference(NamedTuple):
    """How two flights differ: when, which drone, and by how much [m, m/s, rad, rad/s]."""

    t_ns: int
    drone: str
    position_m: float
    velocity_m_s: float
    angle_rad: float
    rate_rad_s: float

    def __str__(self) -> str:
        angle_deg, rate_deg_s = math.degrees(self.angle_rad), math.degrees(self.rate_rad_s)
        by = f"{self.position_m:.3g} m, {self.velocity_m_s:.3g} m/s, {angle_deg:.3g} deg, {rate_deg_s:.3g} deg/s"
        return f"{self.drone} at {self.t_ns / 1e9:.3f} s by {by}"


class TruthComparison:
    """Compares the truth of two flights gate by gate.

    Args:
        drones: in scenario order.

    Attributes:
        instants: compared so far.
        first, last: the first difference, and the last.
    """

    def __init__(self, drones: Sequence[str]) -> None:
        self._drones = tuple(drones)
        self.instants = 0
        self.first: Difference | None = None
        self.last: Difference | None = None

    def add(self, t_ns: int, recorded: Mapping[str, bytes], flown: Mapping[str, bytes]) -> None:
        """Compare the truth of a gate of both, by drone."""
        self.instants += 1
        for drone in self._drones:
            if recorded[drone] != flown[drone] and (
                differing := difference(t_ns, drone, recorded[drone], flown[drone])
            ):
                self.first = self.first or differing
                self.last = differing


class OutputComparison:
    """Compares what agents put out with what they put out on record; each may come before the other.

    Args:
        match_within_ns: simulated time after which the other comes no more.
    """

    def __init__(self, match_within_ns: int) -> None:
        self._match_within_ns = match_within_ns
        self._unmatched: dict[tuple[str, int, int], Message] = {}
        self._different: list[tuple[int, str]] = []

    @property
    def first(self) -> str:
        """Return the first output that differs, or that only one of the two has, and when; empty if there is none."""
        if not self._different:
            return ""
        t_ns, key = min(self._different)
        return f"{key} at {t_ns / 1e9:.2f} s"

    def add(self, key: str, output: Any) -> None:
        """Add an output of either."""
        identity = (key, output.seq, output.t_ns)
        other = self._unmatched.pop(identity, None)
        if other is None:
            self._unmatched[identity] = output
        elif other != output:
            self._note(key, output.t_ns)

    def expire(self, t_ns: int) -> None:
        """Count those as different whose counterpart has not come within the patience before t_ns."""
        for identity in [identity for identity in self._unmatched if identity[2] < t_ns - self._match_within_ns]:
            del self._unmatched[identity]
            self._note(identity[0], identity[2])

    def _note(self, key: str, t_ns: int) -> None:
        if not self._different or t_ns <= min(self._different)[0]:
            self._different.append((t_ns, key))


def difference(t_ns: int, drone: str, recorded: bytes, flown: bytes) -> Difference | None:
    """Return the difference of two true states; None if the COUNTED fields are the same to the bit.

    Raises:
        DecodeError: one of them is no truth.
    """
    key = keys.truth(drone)
    a, b = messages.decode(key, recorded), messages.decode(key, flown)
    if all(getattr(a, part) == getattr(b, part) for part in COUNTED):
        return None
    cosine = abs(sum(p * q for p, q in zip(a.orientation_wxyz, b.orientation_wxyz, strict=True)))
    return Difference(
        t_ns,
        drone,
        math.dist(a.position_m, b.position_m),
        math.dist(a.velocity_m_s, b.velocity_m_s),
        2 * math.acos(min(1.0, cosine)),
        math.dist(a.angular_velocity_rad_s, b.angular_velocity_rad_s),
    )


_Joined = tuple[str, int]  # name and incarnation
JOINED = ("join", "restart", "superseded")  # events of joins that were let in
Requests = dict[int, list[tuple[str, ControlRequest]]]


class AgentsWithRequests(AgentGroup):
    """Agents of one process that receive the recorded requests again.

    Args:
        agents: all of them as one.
        requests: by the first gate that they affect: control key, request.
        hold_ns: as of a group.
    """

    def __init__(self, agents: Agent, requests: Requests, hold_ns: int) -> None:
        super().__init__([agents], hold_ns)
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
        hold_ns = output_hold_ns(info)
        groups = [
            AgentsWithRequests(hosted(info, scenario, process.members), dict(requests), hold_ns)
            for process in agents.processes
        ]
        super().__init__(world, groups, lambda: 0, self._compare_output, self._keep_truth)
        self._world = world
        self._rerun = agents.names
        self.truth: dict[str, bytes] = {}
        self.refused: list[str] = []
        self._admitted: set[_Joined] | None = None  # in this gate; None before the start, when nothing hangs on it
        self._withheld: dict[_Joined, run_messages.Join] = {}
        self.outputs = OutputComparison(world.clock.delay_ns + 2 * world.clock.gate_ns)

    def fly_to(self, gate: GateInputs) -> None:
        """Receive the inputs of a gate, let the agents answer, and go to that gate.

        Raises:
            RunError: an agent does not answer, since what it waits for is not on record.
            RunFailedError: or since a user's code fails, which at this gate it did not on record.
        """
        self._admitted = _admitted(gate.inputs) if gate.t_ns else None
        for recorded in gate.inputs:
            self._feed(recorded)
        while self._round():
            pass
        waiting = [p.name for p in self._world.blocking() if p.name in self._rerun]
        if waiting and self.failure:
            raise RunFailedError(f"flown again, {self.failure}")
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

    @property
    def failure(self) -> str:
        """Return how a user's code has failed first, empty if none has."""
        return next((str(failure) for failure in self._failures.values()), "")

    def answer_last(self) -> None:
        """Let the agents answer the last gate of the record, to which nothing answers there."""
        while self._round():
            pass

    def _leave_failed(self, agent: Agent, inbox: Inbox) -> None:
        """Hand an agent nothing any more; the world goes on as far as it went on record."""
        inbox.start_after(NEVER_NS)

    def _compare_output(self, key: str, message: Any) -> None:
        if isinstance(message, (*messages.RELAYED, flight_messages.Command)):
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
        elif isinstance(message, messages.RELAYED):
            self._feed_output(key, message)
        elif isinstance(message, Sightings):  # no detector is run again: it would need the pictures
            self._hand_over(key, message, message.source)
        elif isinstance(message, flight_messages.Command):
            if message.source in self._rerun:
                self.outputs.add(key, message)
            else:
                self._world.handle(key, message, 0)
        elif keys.thing(key) not in self._rerun:
            self._feed_process(key, message)

    def _feed_process(self, key: str, message: Any) -> None:
        """Repeat a join, done or bye of another process; a join only when it was let in, as its event says."""
        joined = (keys.thing(key), message.incarnation) if isinstance(message, run_messages.Join) else None
        if joined is None or self._admitted is None or joined in self._admitted:
            self._world.handle(key, message, 0)
        else:
            self._withheld[joined] = message

    def _admit(self, joined: _Joined) -> None:
        join = self._withheld.pop(joined, None)
        if join is not None:
            self._world.handle(keys.process(joined[0], "join"), join, 0)

    def _feed_output(self, key: str, message: Any) -> None:
        """Pass the estimate, or the output about a cluster, of another process to the agents that read it."""
        role = "estimator" if isinstance(message, flight_messages.Estimate) else "controller"
        is_request = isinstance(message, run_messages.ClusterRequest)
        source = (message.controller if is_request else message.source) or f"{role}.{keys.thing(key)}"
        if source in self._rerun:
            self.outputs.add(key, message)
        else:
            self._hand_over(key, message, source)

    def _hand_over(self, key: str, message: Any, source: str) -> None:
        """Pass what another process published to the agents that read it."""
        for inbox in self._route(key).inboxes:
            inbox.put(key, message)
        self._world.count_output(source)

    def _feed_event(self, event: run_messages.Event) -> None:
        """Repeat what reached the world other than as a message: deaths, requests, and joins that were withheld."""
        if event.kind in JOINED and event.source not in self._rerun:
            self._admit(_joined(event))
        left = event.kind == "leave" and self._world.barrier.has_farewell(event.subject)
        if (event.kind == "death" or left) and event.subject not in self._rerun:
            self._world.died(event.subject, 0)
        elif event.kind == "overdue" and event.subject not in self._rerun:
            self._world.expired(event.subject)
        elif event.kind == "control" and event.subject in FLIGHT_REQUESTS and event.data.get("ok"):
            args = event.data.get("args")
            request = ControlRequest(event.subject, args if isinstance(args, dict) else {}, event.source)
            answer = self._world.control(request)
            if not answer.ok:
                self.refused.append(f"{event.subject} at {event.t_ns / 1e9:.2f} s: {answer.error}")


def _joined(event: run_messages.Event) -> _Joined:
    """Return whom the event of a join is about."""
    return event.subject, event.data.get("incarnation", -1)


def _admitted(inputs: Sequence[Recorded]) -> set[_Joined]:
    """Return who was let in before a gate and had published its join in that gate, too: its place is that of its join.

    A join that was withheld longer has its event in a later gate.
    """
    events = (decode_or_none(recorded) for recorded in inputs if recorded.key == keys.EVENT)
    return {_joined(event) for event in events if event is not None and event.kind in JOINED}


def _by_gate(requests: Sequence[tuple[str, run_messages.ClusterRequest]]) -> Requests:
    by_gate: defaultdict[int, list[tuple[str, ControlRequest]]] = defaultdict(list)
    for key, request in requests:
        control = keys.cluster_control(keys.thing(key))
        by_gate[request.t_ns].append((control, ControlRequest(request.op, request.args, request.source)))
    return dict(by_gate)
