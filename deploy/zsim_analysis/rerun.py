"""`zsim rerun`: flies a recorded run again from its own inputs and compares the truth with that in the record.

First, world and agents are run again, with the inputs of other participants (operators, users' programs) from the
record. If the truth differs, or the agents cannot be run again, the world is run alone, with all commands from the
record: if that reproduces the recorded truth, the difference came from the agents.
"""

import math
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from zsim import __version__
from zsim.contract import flight_messages, keys, messages, run_messages
from zsim.contract.fingerprint import fingerprint
from zsim.contract.flight_messages import Sightings
from zsim.contract.framing import GateMessages
from zsim.contract.run_messages import ADMISSIONS, ControlRequest
from zsim.errors import RecordError, RunError, RunFailedError
from zsim.record import Recorded, RecordReader
from zsim.runtime.agent import Agent, AgentGroup, Output
from zsim.runtime.bus import Bus
from zsim.runtime.inbox import output_hold_ns
from zsim.runtime.progress import PERIOD_S, Screen
from zsim.runtime.rate_limit import RateLimit
from zsim.scenario.faults import listed
from zsim.scenario.scenario import Scenario
from zsim.schema import plugin
from zsim.schema.checker import show
from zsim.schema.message import Message
from zsim_agents.hosting import hosted
from zsim_analysis.reading import recorded_run
from zsim_analysis.reading.recorded_run import OutputHashes, content_of
from zsim_world.run.coordinator import FLIGHT_REQUESTS
from zsim_world.run.world import World

Say = Callable[[str], None]
# fields hashed in truth_sha256
COMPARED_FIELDS = ("position_m", "velocity_m_s", "orientation_wxyz", "angular_velocity_rad_s")


class RerunResult(NamedTuple):
    """The result of flying a run again."""

    compared: "TruthComparison"  # comparison with the recorded truth
    sha256: str  # hash of the truth
    until: str  # why the comparison ended before the record did; empty if it did not
    refused: list[str]  # requests that were carried out in the recorded run but are refused now
    first_output: str  # the first output of an agent that differs, with its field; empty if none does
    outputs: dict[str, str]  # SHA-256 of the agents' outputs by key, as in OutputHashes
    failure: str  # failure of a user's code; empty if there was none


def rerun_record(
    run_path: Path, commands_only: bool, say: Say, note: Say, outputs: Mapping[str, str] | None = None
) -> str:
    """Fly a recorded run again; return how the truth differs from the record, empty if it is bit-identical.

    With `commands_only`, no agents are run. `say` is called with each line of the results, `note` with each warning. If
    the agents' outputs must be the same too, `outputs` has their SHA-256 by key, as in OutputHashes.

    Raises:
        RunError, RecordError: there is no record, it does not begin with the start of a flight, or the run cannot be
            flown again.
    """
    with recorded_run.open_run(run_path) as record:
        if record.info.replay_of:
            raise RunError(f"{run_path}: is the record of a replay; rerun that of run {record.info.replay_of}")
        if not plugin.may_import() and (names := record.scenario.own_code()):
            reason = f"its scenario names {listed(names)}: code that is run only with --trust"
            raise RunError(f"{run_path}: {reason}")
        if external := record.scenario.external():
            reason = f"has drones whose bodies are external ({listed(external)}); they cannot be flown again"
            raise RunError(f"{run_path}: {reason}")
        agents = recorded_run.recorded_agents(record.reader, record.info, record.scenario)
        no_agents = agents._replace(processes=(), requests=(), failure="")
        own_fingerprint, recorded_by = fingerprint(), record.info.version
        if other_fingerprints := {record.info.fingerprint, *agents.fingerprints} - {own_fingerprint}:
            fingerprints_text = f"{', '.join(sorted(other_fingerprints))}; here {own_fingerprint}"
            note(f"recorded with different code (fingerprint {fingerprints_text}): the same bits are not guaranteed")
        if recorded_by != __version__:
            note(f"recorded by zsim {recorded_by}, flown again by {__version__}: the same bits are not guaranteed")
        if commands_only or agents.why_not:
            reason_text = "as requested" if commands_only else agents.why_not
            say(f"agents are not run again: {reason_text}; the world alone, with all recorded commands")
            return _judge(record.reader, agents.truth_sha256, _fly(record, no_agents), say)
        say(f"run again: world, {', '.join(map(str, agents.processes))}")
        result = _fly(record, agents)
        fault = _judge(record.reader, agents.truth_sha256, result, say)
        if not fault and result.failure != agents.failure:
            say(f"in the record, {agents.failure or 'no class of a user failed'}")
            fault = f"flown again, {result.failure or 'it does not fail'}"
        elif not fault and result.failure:
            say(f"ended as in the record: {result.failure}")
        if outputs is not None and not fault:
            fault = _compare_outputs(outputs, result, say)
        if result.compared.first is None:
            return fault
        alone = _fly(record, no_agents)
        if alone.compared.first is not None:
            say(f"the world alone, with all recorded commands, differs too: first {alone.compared.first}")
        else:
            say("the world alone, with all recorded commands, gives the recorded truth: the agents answer differently")
        if result.first_output:
            say(f"the first answer that differs is {result.first_output}")
        return fault


def _compare_outputs(expected: Mapping[str, str], result: RerunResult, say: Say) -> str:
    """Report how the agents' outputs compare; return how they differ, empty if they do not."""
    keys_of_both = sorted({*expected, *result.outputs})
    differing = [key for key in keys_of_both if expected.get(key) != result.outputs.get(key)]
    if not differing:
        say(f"the agents' outputs are the same, on {len(expected)} keys")
        return ""
    say(f"the agents' outputs differ on {len(differing)} of {len(keys_of_both)} keys: {listed(differing)}")
    return f"outputs differ, first {result.first_output or differing[0]}"


def _fly(record: recorded_run.RecordedRun, agents: recorded_run.RecordedAgents) -> RerunResult:
    """Fly through the gates of a record, up to the first gate with missing truth."""
    reader, info, scenario = record
    world = World(scenario, info.mode, 0.0, time.monotonic_ns, info.run_id)
    bus = RerunBus(world, agents, info, scenario, OutputHashes(recorded_run.answered_until_ns(reader, info)))
    compared = TruthComparison(world.names)
    bus.join()
    until, due_ns, throttle, start_s = "", 0, RateLimit(PERIOD_S), time.monotonic()
    line = {"state": "world and agents" if agents.processes else "world alone", "phase": "", "waiting_for": []}
    with Screen(scenario.duration_s) as screen:
        for gate in recorded_run.gates(reader, world.names):
            missing = [name for name in world.names if name not in gate.truth]
            if gate.t_ns != due_ns or missing:
                missing_text = f"no truth of {missing[0]} at" if gate.t_ns == due_ns else "nothing of"
                until = f"the record has {missing_text} {due_ns / 1e9:.2f} s"
                break
            bus.fly_to(gate)
            compared.add(gate.t_ns, gate.truth, bus.truth)
            due_ns += world.clock.gate_ns
            if throttle.spend():
                rate = gate.t_ns / 1e9 / max(1e-9, time.monotonic() - start_s)
                screen.clock({"t_s": gate.t_ns / 1e9, "rate": rate, **line})
    if agents.failure and not bus.failure:
        bus.answer_all()
    if not compared.instants:
        raise RecordError(f"{reader.path}: {until or 'contains no truth'}; a run is flown again from its start")
    first, hashes = bus.outputs.first, bus.hashes.hexdigests()
    return RerunResult(compared, world.result()["truth_sha256"], until, bus.refused, first, hashes, bus.failure)


def _judge(reader: RecordReader, recorded: str | None, result: RerunResult, say: Say) -> str:
    """Report how the truth compares; return how it differs, empty if it is the same in all of an intact record."""
    compared, until = result.compared, result.until
    for refusal in result.refused:
        say(f"was carried out in the recorded run, but is refused now: {refusal}")
    if compared.first is not None:
        say(f"truth differs: first {compared.first}")
        say(f"               last  {compared.last}; {compared.instants} instants compared")
        if reader.damaged:
            say("the record is damaged: missing messages may cause the difference")
        return f"truth differs, first {compared.first}"
    if recorded == result.sha256 and not until:
        say(f"truth_sha256 is the same: {result.sha256}")
        return ""
    condition = "is damaged" if reader.damaged else "does not hold the whole run" if reader.complete else "was cut"
    missing_hash = f"{recorded} cannot be verified" if recorded else "has no truth_sha256"
    reason = f"{until}, as it {condition}" if until else f"the record {condition} and {missing_hash}"
    say(f"{reason}; truth is bit-identical at all {compared.instants} instants before")
    return "" if recorded is None and not until and not reader.damaged else reason


# Comparison


class Difference(NamedTuple):
    """A difference between two flights: when, of which drone, and how large [m, m/s, rad, rad/s]."""

    t_ns: int
    drone: str
    position_m: float
    velocity_m_s: float
    angle_rad: float
    rate_rad_s: float
    field: str = ""  # the first field that differs, with both values

    def __str__(self) -> str:
        angle_deg, rate_deg_s = math.degrees(self.angle_rad), math.degrees(self.rate_rad_s)
        size_text = f"{self.position_m:.3g} m, {self.velocity_m_s:.3g} m/s, {angle_deg:.3g} deg, {rate_deg_s:.3g} deg/s"
        field_text = f": {self.field} in {keys.truth(self.drone)}" if self.field else ""
        return f"{self.drone} at {self.t_ns / 1e9:.3f} s by {size_text}{field_text}"


def difference(t_ns: int, drone: str, recorded: bytes, repeated: bytes) -> Difference | None:
    """Return the difference between two true states; None if the COMPARED_FIELDS are bit-identical.

    Raises:
        DecodeError: one of them is not a truth message.
    """
    key = keys.truth(drone)
    a, b = messages.decode(key, recorded), messages.decode(key, repeated)
    if all(getattr(a, part) == getattr(b, part) for part in COMPARED_FIELDS):
        return None
    cosine = abs(sum(p * q for p, q in zip(a.orientation_wxyz, b.orientation_wxyz, strict=True)))
    return Difference(
        t_ns,
        drone,
        math.dist(a.position_m, b.position_m),
        math.dist(a.velocity_m_s, b.velocity_m_s),
        2 * math.acos(min(1.0, cosine)),
        math.dist(a.angular_velocity_rad_s, b.angular_velocity_rad_s),
        differing_field(a, b, COMPARED_FIELDS),
    )


def differing_field(recorded: Any, repeated: Any, fields: Sequence[str]) -> str:
    """Return the first field that differs between two messages, with its index and both values; empty if none does."""
    for name in fields:
        a, b = getattr(recorded, name), getattr(repeated, name)
        if a == b:
            continue
        if isinstance(a, tuple) and isinstance(b, tuple) and len(a) == len(b):
            index = next(i for i, (one, other) in enumerate(zip(a, b, strict=True)) if one != other)
            name, a, b = f"{name}[{index}]", a[index], b[index]
        return f"{name} is {show(a)} in the record, {show(b)} when flown again"
    return ""


class TruthComparison:
    """Compares the truth of two flights gate by gate."""

    def __init__(self, drones: Sequence[str]) -> None:
        self._drones = tuple(drones)
        self.instants = 0  # number of gates compared so far
        self.first: Difference | None = None
        self.last: Difference | None = None

    def add(self, t_ns: int, recorded: Mapping[str, bytes], repeated: Mapping[str, bytes]) -> None:
        """Compare the truth of a gate of both flights, given as payloads by drone."""
        self.instants += 1
        for drone in self._drones:
            if recorded[drone] != repeated[drone] and (
                differing := difference(t_ns, drone, recorded[drone], repeated[drone])
            ):
                self.first = self.first or differing
                self.last = differing


class OutputComparison:
    """Compares the outputs of agents with the recorded ones; either may come first, by up to `match_within_ns`."""

    def __init__(self, match_within_ns: int) -> None:
        self._match_within_ns = match_within_ns
        self._unmatched: dict[tuple[str, int, int], Message] = {}
        # of outputs with the same time, estimates sort first, since they cause the others
        self._first: tuple[int, bool, str, str] | None = None

    @property
    def first(self) -> str:
        """Key, time and field of the first output that differs or that only one side has; empty if all match."""
        if not self._first:
            return ""
        t_ns, _, key, field = self._first
        return f"{key} at {t_ns / 1e9:.2f} s" + (f": {field}" if field else "")

    def add(self, key: str, output: Any, recorded: bool = False) -> None:
        """Add an output of either side."""
        identity = (key, output.seq, output.t_ns)
        other = self._unmatched.pop(identity, None)
        if other is None:
            self._unmatched[identity] = output
        elif other != output:
            pair = (output, other) if recorded else (other, output)
            self._note(output.t_ns, key, differing_field(*pair, output.__struct_fields__))

    def expire(self, t_ns: int) -> None:
        """Treat every output from more than `match_within_ns` before `t_ns` without a counterpart as different."""
        for identity in [identity for identity in self._unmatched if identity[2] < t_ns - self._match_within_ns]:
            del self._unmatched[identity]
            self._note(identity[2], identity[0])

    def _note(self, t_ns: int, key: str, field: str = "") -> None:
        entry = (t_ns, keys.leaf(key) != "estimate", key, field)
        self._first = min(entry, self._first or entry)


# Flight

_Joined = tuple[str, int]  # name and incarnation
Requests = dict[int, list[tuple[str, ControlRequest]]]  # control key and request, by the first gate that they affect


class AgentsWithRequests(AgentGroup):
    """The agents of one process, which receive the recorded requests again."""

    def __init__(self, agents: Agent, requests: Requests, hold_ns: int) -> None:
        super().__init__([agents], hold_ns)
        self._requests = requests

    def step(self, t_ns: int) -> list[Output]:
        for key, request in self._requests.pop(t_ns, ()):
            if key in self.control_keys():
                self.control(key, request)
        return super().step(t_ns)


class RerunBus(Bus):
    """Flies a run again in a new world, with the given agents; without any, all commands come from the record."""

    def __init__(
        self,
        world: World,
        agents: recorded_run.RecordedAgents,
        info: messages.Info,
        scenario: Scenario,
        hashes: OutputHashes | None = None,
    ) -> None:
        requests: defaultdict[int, list[tuple[str, ControlRequest]]] = defaultdict(list)
        for key, request in agents.requests:
            control = ControlRequest(request.op, request.args, request.source)
            requests[request.t_ns].append((keys.control_of(key), control))
        hold_ns = output_hold_ns(info)
        groups = [
            AgentsWithRequests(hosted(info, scenario, process.members), dict(requests), hold_ns)
            for process in agents.processes
        ]

        def compare_output(key: str, message: Any) -> None:
            if isinstance(message, (*messages.RELAYED, flight_messages.Command)):
                self.outputs.add(key, message)
            if recorded_run.is_answer(key) and recorded_run.sender_of(key, message) in agents.names:
                self.hashes.add(key, message.t_ns, content_of(message))

        def keep_truth(gate: GateMessages) -> None:
            self.truth = {keys.thing(key): payload for key, payload in gate.pairs if keys.leaf(key) == "truth"}

        super().__init__(world, groups, lambda: 0, compare_output, keep_truth)
        self._world = world
        self.hashes = hashes or OutputHashes(-1)  # hashes of the outputs of agents that are run again
        self._rerun = agents.names
        self.truth: dict[str, bytes] = {}  # payloads at the newest gate, by drone
        self.refused: list[str] = []  # requests that were carried out in the recorded run but are refused now
        self._admitted: set[_Joined] | None = None  # at this gate; None before the start: all are admitted
        self._withheld: dict[_Joined, run_messages.Join] = {}
        self.outputs = OutputComparison(world.clock.delay_ns + 2 * world.clock.gate_ns)

    def fly_to(self, gate: recorded_run.GateInputs) -> None:
        """Receive the inputs of a gate, let the agents answer, and advance to that gate.

        Raises:
            RunError: an agent does not answer, as what it waits for is not in the record; or the run ends differently.
            RunFailedError: a user's code fails at this gate, where it did not fail in the record.
        """
        self._admitted = _admitted(gate.inputs) if gate.t_ns else None
        for recorded in gate.inputs:
            self._feed(recorded)
        self.answer_all()
        waiting = [p.name for p in self._world.blocking() if p.name in self._rerun]
        if self.failure and (waiting or self._world.ended is not None):
            raise RunFailedError(f"flown again, {self.failure}")
        if waiting and self._world.clock.state != "waiting":
            at = f"before {gate.t_ns / 1e9:.2f} s"
            raise RunError(
                f"{', '.join(waiting)} cannot answer {at}: what it waits for is not in the record; use --commands-only"
            )
        self.outputs.expire(gate.t_ns)
        self._world.advance(0)
        self._spread()
        if self._world.now_ns != gate.t_ns:
            reason = self._world.ended or "the gates are not those of the record"
            raise RunError(f"flown again, the run ends at {self._world.now_ns / 1e9:.2f} s: {reason}")

    @property
    def failure(self) -> str:
        """The first failure of a user's code; empty if there was none."""
        return next((str(failure) for failure in self._failures.values()), "")

    def answer_all(self) -> None:
        """Let the agents respond to everything that they have received."""
        while self._round():
            pass

    def _update_faults(self, faults: run_messages.Faults) -> None:
        if self._rerun:  # without agents, the recorded commands already contain the faults' effect
            super()._update_faults(faults)

    def _feed(self, recorded: Recorded) -> None:
        """Repeat what another process published; compare what agents that are run again published."""
        key, message = recorded.key, recorded_run.decode_or_none(recorded)
        if message is None:  # the recorded world refused it too
            return
        if key == keys.EVENT:
            self._feed_event(message)
        elif isinstance(message, messages.RELAYED):  # estimates, references, and outputs about clusters
            source = recorded_run.sender_of(key, message)
            if source in self._rerun:
                self.outputs.add(key, message, recorded=True)
            else:
                self._hand_over(key, message, source)
        elif isinstance(message, Sightings):  # detectors are not run again, since they would need the pictures
            self._hand_over(key, message, message.source)
        elif isinstance(message, flight_messages.Command):
            if message.source in self._rerun:
                self.outputs.add(key, message, recorded=True)
            else:
                self._world.handle(key, message, 0)
        elif keys.thing(key) not in self._rerun:  # a done, a bye, or a join, which is repeated when its event says so
            join_identity = (keys.thing(key), message.incarnation) if isinstance(message, run_messages.Join) else None
            if join_identity is None or self._admitted is None or join_identity in self._admitted:
                self._world.handle(key, message, 0)
            else:
                self._withheld[join_identity] = message

    def _hand_over(self, key: str, message: Any, source: str) -> None:
        """Pass what another process published to the agents that read it."""
        for inbox in self._route(key).inboxes:
            inbox.put(key, message)
        self._world.count_output(source)

    def _feed_event(self, event: run_messages.Event) -> None:
        """Repeat what did not reach the world as a message: deaths, overdue processes, requests, and withheld joins."""
        if event.kind in ADMISSIONS and event.source not in self._rerun:
            join_identity = _joined(event)
            if (join := self._withheld.pop(join_identity, None)) is not None:
                self._world.handle(keys.process(join_identity[0], "join"), join, 0)
        has_left = event.kind == "leave" and self._world.barrier.has_farewell(event.subject)
        if (event.kind == "death" or has_left) and event.subject not in self._rerun:
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
    """Return name and incarnation of the process whose join an event reports."""
    return event.subject, event.data.get("incarnation", -1)


def _admitted(inputs: Sequence[Recorded]) -> set[_Joined]:
    """Return the processes that were admitted at a gate, by the events among its inputs.

    Their joins are repeated in place. A join that was withheld for longer has its event in a later gate.
    """
    events = (recorded_run.decode_or_none(recorded) for recorded in inputs if recorded.key == keys.EVENT)
    return {_joined(event) for event in events if event is not None and event.kind in ADMISSIONS}
