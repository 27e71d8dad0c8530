"""A replay: publishes the record of a run on its keys in place of a world.

Otherwise it behaves like a world: it keeps time, waits for its participants, answers queries for last values, and can
be paused, stepped and stopped. No drone can be flown.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import defaultdict, deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import pairwise
from typing import Any, NamedTuple

import msgspec
import numpy as np

from zsim.contract import flight_messages, keys, messages, run_messages
from zsim.contract.flight_messages import CameraImage, CameraInfo, Sightings, ViewDrones, ViewEstimates
from zsim.contract.framing import KINDS, GateMessages, run_key_table
from zsim.contract.messages import REFUSALS
from zsim.contract.run_messages import ControlAnswer, ControlRequest
from zsim.errors import DecodeError, RecordError
from zsim.record import Recorded, RecordReader
from zsim.record.record_reader import OVERLAP_NS
from zsim.runtime.agent import Output
from zsim.scenario import roles
from zsim.scenario.faults import PROCESS_KILL
from zsim.scenario.scenario import Scenario
from zsim_world.run.coordinator import FLIGHT_REQUESTS, Coordinator
from zsim_world.run.outbox import Refusal
from zsim_world.run.run_clock import number, refused_argument

RECORD_ENDED = "the record is over"  # why a replay of the whole record ended

NOT_FLYABLE = "a replay: no drone can be flown"
SEEK_MAX_S = 1e9  # limit that keeps nanoseconds within an int64
VIEWED_MAX = 10_000  # drones times time steps in one answer to `views`: 2 MB
VIEWED_MAX_S = 60.0  # simulated time in one answer to `views`; design choice: the replay stands still while reading
LOOKBACK_NS = 1_000_000_000  # time within which every source of a view is published at least once
CAMERA_ROLES = {CameraImage: "camera", CameraInfo: "camera", Sightings: "detector"}  # roles that publish them
MARKS_MAX = 400  # marks on a timeline; more would be narrower than a pixel
UNMARKED_EVENTS = frozenset({"command", "end"})  # kinds of events without a mark; commands are too many
TEXT_MAX = 120  # maximum length of a mark's text, characters
SOURCED_TYPES = (flight_messages.Command, CameraImage, CameraInfo, Sightings)  # messages that name their publisher


class PlaybackRange(NamedTuple):
    """The part of a record that is played."""

    from_ns: int = 0  # first gate
    to_ns: int | None = None  # last gate; None: that of the record
    keys: tuple[str, ...] = ("**",)  # expressions; keys that match none are not played
    paused: bool = False  # stand still after the first gate
    holds: bool = False  # pause after the last gate instead of ending, so that users can seek back


class _Live(NamedTuple):
    """Names of all processes whose work participants do at a gate; their recorded outputs are not played."""

    names: set[str]
    by_name: set[str]  # names of participants that declare no camera and no detector of a drone


class Playback(Coordinator):
    """Plays a record.

    Outputs that a participant publishes itself are not played. A participant is recognised by its name
    (`estimator.drone1`); a camera or detector by the drones that it declares, or by its name if it declares none.

    Args:
        reader: reader of the record; it stays open.
        scenario, info: scenario and `world/info` of the recorded run.
        rate: simulated seconds per wall second; 0: as fast as possible.
        run_id: set by tests that compare records.

    Raises:
        RecordError: there is nothing to play.
    """

    needs_participants = False

    def __init__(
        self,
        reader: RecordReader,
        scenario: Scenario,
        info: messages.Info,
        played: PlaybackRange = PlaybackRange(),  # noqa: B008 - immutable
        rate: float = 1.0,
        wall_ns: Callable[[], int] = lambda: 0,
        run_id: str | None = None,
    ) -> None:
        super().__init__(scenario, "lockstep", rate, wall_ns, run_id, [])
        self._recorded = info
        self._played = played
        self._operations |= {"seek": self._seek, "timeline": self._timeline, "views": self._past_views}
        self.refused_queries = (
            *(keys.cluster_control(cluster.name) for cluster in scenario.clusters),
            *(keys.drone_control(drone) for drone in scenario.piloted()),
        )
        self._cameras = {drone.name: drone.sensors.cameras() for drone in scenario.drones}
        self._table = run_key_table(info)
        self._kinds = len(self._table) // len(self.names)  # number of kinds of messages about a drone
        self._indices = {key: index for index, key in enumerate(self._table)}
        drone_keys = (key for name in self.names for key in (keys.truth(name), keys.status(name), keys.estimate(name)))
        cluster_keys = (keys.cluster_state(cluster.name) for cluster in scenario.clusters)
        self._view_sources = {*drone_keys, keys.VIEW_DRONES, *cluster_keys}
        self._last: dict[str, bytes] = {}
        topics = reader.topics()
        wanted = {key for key in topics if _is_played(key) and roles.permits(played.keys, key)}
        self._viewed = self._view_sources & wanted
        self._recounts = any(keys.is_sensor(key) and key not in wanted for key in topics)
        self._reader = reader
        # Published only on change: the last ones before the first gate are played with it.
        self._latched = {key for key in wanted if key == keys.FAULTS or messages.type_of(key) is CameraInfo}
        gate_keys = wanted | ({keys.VIEW_DRONES} & topics.keys())
        self._recorded_gates = RecordedGates(reader, self.clock.gate_ns, self.clock.delay_ns, gate_keys)
        self._continue_from(played.from_ns)
        if self._coming is None or (played.to_ns is not None and self._coming.t_ns > played.to_ns):
            until = "on" if played.to_ns is None else f"to {played.to_ns / 1e9:.12g} s"
            window = f"from {played.from_ns / 1e9:.12g} s {until}"
            raise RecordError(f"{reader.path}: contains no gate {window}; nothing can be played")

    def info(self) -> messages.Info:
        """Return the recorded `world/info`, adapted to the replay."""
        return msgspec.structs.replace(
            self._recorded,
            federation=self.scenario.federation,
            run_id=self.run_id,
            mode="lockstep",
            rate=self.clock.rate,
            replay_of=self._recorded.run_id,
        )

    # Time

    def advance(self, wall_ns: int) -> None:
        """Play the next gate, if there is one; pause or end after the last one."""
        gate = self._coming
        if gate is not None and not self._end_reason():
            if self.clock.state == "waiting":
                self.clock.start(gate.t_ns, self._played.paused)
            else:
                self.clock.advance(gate.t_ns)
            self._play(gate, wall_ns)
            self._read_next()
        if end_reason := self._end_reason():
            if self._played.holds:
                self.clock.hold()
            else:
                self.clock.stop(end_reason)

    def _end_reason(self) -> str:
        """Return why nothing remains to be played; empty while something does."""
        to_ns = self._played.to_ns
        if self._coming is None:
            return RECORD_ENDED
        return f"played to {to_ns / 1e9:g} s" if to_ns is not None and self._coming.t_ns > to_ns else ""

    def _continue_from(self, from_ns: int) -> None:
        """Continue with the first gate at or after a time."""
        self._gates = self._recorded_gates.gates(from_ns)
        self._read_next()
        before: list[Recorded] = []
        if self._latched and from_ns > 0:
            before = [m for m in self._reader.messages(self._latched, by_time=False) if m.t_ns < from_ns]
        self._pending = list({m.key: m for m in sorted(before, key=lambda m: m.t_ns)}.values())

    def _read_next(self) -> None:
        self._coming: Gate | None = next(self._gates, None)
        if self._coming is not None:
            self.clock.next_ns = self._coming.t_ns

    # What is played

    def _live(self) -> _Live:
        served = [each.served_names for each in self.barrier.participants.values()]

        def is_camera_process(name: str) -> bool:
            role, _, drone = name.partition(".")
            return role in CAMERA_ROLES.values() and drone in self._cameras

        by_name = {name for names in served if not any(map(is_camera_process, names)) for name in names}
        return _Live({name for names in served for name in names}, by_name)

    def _is_replaced(self, recorded: Recorded, live: _Live) -> bool:
        """Return whether a participant publishes a message in place of the recorded one."""
        role = CAMERA_ROLES.get(messages.type_of(recorded.key))
        if role is None:
            return bool(live.names) and _author(recorded) in live.names
        _, drone, topic = keys.parts(recorded.key)
        if f"{role}.{drone}" in live.names:  # replaces the scenario's cameras of that drone, or any if it has none
            cameras, camera = self._cameras.get(drone), topic.removeprefix("camera/").removesuffix("/info")
            if not cameras or camera == topic or camera in cameras:
                return True
        return bool(live.by_name) and _author(recorded) in live.by_name

    def _play(self, gate: Gate, wall_ns: int) -> None:
        live, played = self._live(), [*self._pending, *gate.messages]
        self._pending = []
        self._last.update((m.key, m.payload) for m in gate.messages if m.key in self._view_sources)
        for recorded in played:
            if recorded.key == keys.FAULTS:  # must be known before the gate
                self._publish(recorded)
        if drone_messages := [m for m in gate.messages if m.key in self._indices]:
            self.outbox.put(keys.GATE, self._gate_messages(gate.t_ns, drone_messages))
        self.statistics.gate(gate.t_ns, wall_ns)
        self.outbox.put(keys.CLOCK, self.clock_message(self.missed(wall_ns)))
        for recorded in played:
            if recorded.key in self._indices or recorded.key == keys.FAULTS or self._is_replaced(recorded, live):
                continue
            self._publish(recorded)

    def _publish(self, recorded: Recorded) -> None:
        """Publish a recorded message unchanged, except that events are renumbered and kills of processes left out.

        The event `end` and `view/drones` are not published: the replay has its own.
        """
        key, payload = recorded.key, recorded.payload
        if key == keys.EVENT:
            with suppress(DecodeError):
                event: run_messages.Event = messages.decode(keys.EVENT, payload)
                if event.kind != "end":  # the replay has an end of its own
                    self.outbox.put(key, msgspec.structs.replace(event, seq=self.outbox.next_seq(key)))
        elif key == keys.FAULTS:
            self.outbox.put(key, msgspec.Raw(_without_kills(payload)))
        elif key != keys.VIEW_DRONES:
            self.outbox.put(key, msgspec.Raw(payload))

    def _gate_messages(self, t_ns: int, drone_messages: list[Recorded]) -> GateMessages:
        """Return the world's messages about its drones in the order of publication: drone by drone, status last.

        The count in each status is corrected to the sensor messages played, because agents would wait for the others.
        """
        drone_messages.sort(key=lambda m: self._indices[m.key] // self._kinds)
        indices = np.array([self._indices[m.key] for m in drone_messages])
        first = np.searchsorted(indices // self._kinds, np.arange(len(self.names) + 1)).tolist()
        payloads = [m.payload for m in drone_messages]
        if self._recounts:
            kinds, truth, status = (indices % self._kinds).tolist(), KINDS.index("truth"), KINDS.index("status")
            for begin, end in pairwise(first):
                count = sum(kind != truth for kind in kinds[begin:end])
                for m in range(begin, end):
                    if kinds[m] == status:
                        message = messages.decode_as(flight_messages.Status, payloads[m], "status")
                        payloads[m] = messages.encode(msgspec.structs.replace(message, count=count))
        pairs = list(zip([m.key for m in drone_messages], payloads, strict=True))
        stamps = [m.t_ns for m in drone_messages]
        return GateMessages.of(t_ns, t_ns // self.clock.gate_ns, self._table, pairs, stamps, first)

    def views(self, seq: int) -> Sequence[Output]:
        """Return the views, except those that a participant publishes itself."""
        live = self._live().names
        own = {keys.estimates_view(name) for name in live}
        own |= {keys.cluster_view(name.removeprefix("controller.")) for name in live if name.startswith("controller.")}
        return [output for output in self._build_views(self._last, self.now_ns, seq) if output.key not in own]

    def _build_views(self, last: Mapping[str, bytes], t_ns: int, seq: int) -> Iterator[Output]:
        """Yield the views at the gate t_ns for which the last values of the sources are known."""
        drones = []
        estimates: defaultdict[str, list[flight_messages.EstimateView]] = defaultdict(list)
        for drone in self.names:
            truth, status = _read(last, keys.truth(drone)), _read(last, keys.status(drone))
            if truth is not None and status is not None:
                pose = (truth.position_m, truth.orientation_wxyz, truth.rotor_rad_s)
                condition = (status.state, status.battery_percent, status.commander)
                drones.append(flight_messages.DroneView(drone, *pose, *condition))
            estimate = _read(last, keys.estimate(drone))
            if estimate is not None:
                estimates[f"estimator.{drone}"].append(flight_messages.estimate_view(drone, estimate))
        if drones:
            wind = _read(last, keys.VIEW_DRONES)
            wind_m_s = wind.wind_m_s if wind is not None and len(wind.wind_m_s) == len(drones) else ()
            yield Output(keys.VIEW_DRONES, ViewDrones(t_ns, seq, tuple(drones), wind_m_s))
        for cluster in self.scenario.clusters:
            state = _read(last, keys.cluster_state(cluster.name))
            if state is not None:
                yield Output(keys.cluster_view(cluster.name), flight_messages.cluster_view(state, t_ns, seq))
        for process, of_process in estimates.items():
            yield Output(keys.estimates_view(process), ViewEstimates(t_ns, seq, tuple(of_process)))

    def result(self) -> dict[str, Any]:
        """Return the statistics of the replay so far."""
        statistics = self.statistics.result(self.barrier.participants.values())
        replay_values = {"replay_of": self._recorded.run_id, "refused": self.outbox.refusals.count}
        return {"reason": self.ended, "last_ns": self.now_ns, **statistics, **replay_values}

    # Commands and requests

    def _handle_command(self, drone: str, kind: str, message: Any) -> bool:
        source = message.source if keys.PROCESS_NAME.fullmatch(message.source) else "somebody"
        self.outbox.refuse(source, f"drone/{drone[:40]}/cmd/{kind}", NOT_FLYABLE)
        return True

    def refusal_at(self, key: str) -> str | None:
        return None if f"controller.{keys.thing(key)}" in self._live().names else NOT_FLYABLE

    def control(self, request: ControlRequest) -> ControlAnswer:
        """Answer a request; `views` is requested repeatedly and does not become an event."""
        return self._answer(request) if request.op == "views" else super().control(request)

    def _answer(self, request: ControlRequest) -> ControlAnswer:
        return ControlAnswer(False, NOT_FLYABLE) if request.op in FLIGHT_REQUESTS else super()._answer(request)

    def _seek(self, request: ControlRequest) -> Refusal | None:
        """Continue from another gate. Refused while a participant gates: it would miss the gates in between."""
        t_s = number(request.args.get("t_s"))
        if t_s is None or not 0 <= t_s < SEEK_MAX_S:
            return refused_argument(request, "t_s", "a time within the record [s]")
        gating = [p.name for p in self.barrier.participants.values() if p.gating]
        if gating:
            return Refusal(", ".join(gating), "in the lockstep", "seek is possible only while no process is waited for")
        former = self._gates, self._coming, self._pending
        self._continue_from(round(t_s * 1e9))
        if self._coming is None:
            self._gates, self._coming, self._pending = former
            return refused_argument(request, "t_s", "a time within the record [s]")
        self._last.clear()
        self.statistics.rate.jump()
        if keys.FAULTS in self._latched and not any(m.key == keys.FAULTS for m in self._pending):
            t_ns = self._coming.t_ns
            self._pending.append(Recorded(keys.FAULTS, messages.encode(run_messages.Faults(t_ns, 0, ())), t_ns, 0))
        self.clock.jumps += 1
        return None

    def _timeline(self, _: ControlRequest) -> ControlAnswer:
        """Answer with the record's time range [s] and its events except commands, thinned out evenly if many."""
        last = self._reader.last(keys.CLOCK)
        first = next(self._reader.messages([keys.CLOCK]), last)
        span = {"from_s": first.t_ns / 1e9, "to_s": last.t_ns / 1e9} if first and last else {}
        marks = []
        for recorded in self._reader.messages([keys.EVENT]):
            with suppress(DecodeError):
                event: run_messages.Event = messages.decode(keys.EVENT, recorded.payload)
                if event.kind not in UNMARKED_EVENTS:
                    text = f"{event.subject}: {event.text}" if event.subject else event.text
                    marks.append({"t_s": event.t_ns / 1e9, "kind": event.kind, "text": text[:TEXT_MAX]})
        return ControlAnswer(True, result={**span, "marks": marks[:: -(-len(marks) // MARKS_MAX) or 1]})

    def _past_views(self, request: ControlRequest) -> Refusal | ControlAnswer:
        """Answer with the views at recorded instants, `every_s` apart, for curves and trails."""
        from_s, to_s, every_s = (number(request.args.get(name)) for name in ("from_s", "to_s", "every_s"))
        if from_s is None or not 0.0 <= from_s < SEEK_MAX_S:
            return refused_argument(request, "from_s", "a time within the record [s]")
        if to_s is None or not from_s <= to_s <= from_s + VIEWED_MAX_S:
            return refused_argument(request, "to_s", f"from from_s to {VIEWED_MAX_S:g} s after it")
        count_max = max(1, VIEWED_MAX // len(self.names))
        if every_s is None or not every_s > 0.0 or (to_s - from_s) / every_s >= count_max:
            return refused_argument(request, "every_s", f"above 0, with at most {count_max} instants in total")
        instants = [round((from_s + k * every_s) * 1e9) for k in range(int((to_s - from_s) / every_s) + 1)]
        last: dict[str, bytes] = {}
        views: list[tuple[str, bytes]] = []
        for seq, (t_ns, passed) in enumerate(self._recorded_gates.latest_before(instants, self._viewed, LOOKBACK_NS)):
            last |= passed
            if any(key.endswith("/truth") for key in passed):  # otherwise a gap in the record, or its end
                views += [(key, messages.encode(message)) for key, message in self._build_views(last, t_ns, seq)]
        return ControlAnswer(True, result=views)


class Gate(NamedTuple):
    """The messages stamped after the previous gate and up to this one, in order of writing."""

    t_ns: int
    messages: list[Recorded]


class _Clock(msgspec.Struct):
    state: str


class _Sourced(msgspec.Struct):
    source: str = ""


_decode_clock = msgspec.msgpack.Decoder(_Clock).decode
_decode_sourced = msgspec.msgpack.Decoder(_Sourced).decode


class RecordedGates:
    """Reads a record gate by gate, starting anywhere.

    An answer to a gate is written a few gates later, since the world runs ahead of the agents; it is played at the gate
    of its stamp. A message whose stamp is further from its position in the record (from a program that does not stamp,
    or in realtime) is played at that position.

    Args:
        delay_ns: command delay of the run, by which the world may be ahead [ns].
        wanted: keys to read.
    """

    def __init__(self, reader: RecordReader, gate_ns: int, delay_ns: int, wanted: Collection[str]) -> None:
        self._reader = reader
        self._gate_ns = gate_ns
        self._slack_ns = delay_ns + gate_ns
        self._keys = {*wanted, keys.CLOCK}

    def gates(self, from_ns: int = 0) -> Iterator[Gate]:
        """Yield the recorded gates at or after `from_ns`."""
        for gate in self._all(from_ns):
            if gate.t_ns >= from_ns:
                yield gate

    def _all(self, from_ns: int) -> Iterator[Gate]:
        waiting: dict[int, list[Recorded]] = {}
        gates: deque[int] = deque()
        newest = None

        def pop_gate(t_ns: int) -> Gate:
            """Return a gate, including the messages due at earlier gates that are missing from the record."""
            due = sorted(gate_ns for gate_ns in waiting if gate_ns <= t_ns)
            return Gate(t_ns, [recorded for gate_ns in due for recorded in waiting.pop(gate_ns)])

        # Answers to the first gate and samples for it may be in a chunk that begins before it.
        for recorded in self._reader.messages(self._keys, by_time=False, from_ns=max(0, from_ns - self._slack_ns)):
            if recorded.key != keys.CLOCK:
                due_ns = -(-recorded.t_ns // self._gate_ns) * self._gate_ns
                if newest is not None:
                    writing_ns = newest + self._gate_ns
                    due_ns = due_ns if newest - self._slack_ns < due_ns <= writing_ns else writing_ns
                waiting.setdefault(due_ns, []).append(recorded)
            elif (newest is None or recorded.t_ns > newest) and _is_gate(recorded.payload):
                newest = recorded.t_ns
                gates.append(newest)
                while gates[0] + self._slack_ns <= newest:
                    yield pop_gate(gates.popleft())
        for t_ns in gates:
            yield pop_gate(t_ns)

    def latest_before(
        self, instants_ns: Sequence[int], wanted: Collection[str], back_ns: int
    ) -> Iterator[tuple[int, dict[str, bytes]]]:
        """Yield each instant with the last payload by key since the previous instant.

        Args:
            instants_ns: instants in ascending order [ns].
            wanted: keys to read.
            back_ns: time before the first instant from which to read [ns].
        """
        first_ns, last_ns = instants_ns[0] - back_ns, instants_ns[-1]
        newest: list[dict[str, Recorded]] = [{} for _ in instants_ns]
        for recorded in self._reader.messages(wanted, by_time=False, from_ns=max(0, first_ns)):
            if recorded.t_ns > last_ns + OVERLAP_NS:
                break
            if first_ns <= recorded.t_ns <= last_ns:
                of_instant = newest[bisect_left(instants_ns, recorded.t_ns)]
                previous = of_instant.get(recorded.key)
                if previous is None or previous.t_ns <= recorded.t_ns:
                    of_instant[recorded.key] = recorded
        for t_ns, of_instant in zip(instants_ns, newest, strict=True):
            yield t_ns, {key: recorded.payload for key, recorded in of_instant.items()}


def _is_gate(payload: bytes) -> bool:
    """Return whether a clock message belongs to a gate; those published before the start do not."""
    try:
        return _decode_clock(payload).state != "waiting"
    except REFUSALS:
        return False  # not published by the world


def _is_played(key: str) -> bool:
    """Return whether the messages of a key may be played.

    A replay publishes its own info, clock and views, and omits messages about the recorded processes.
    """
    views = (ViewDrones, flight_messages.ViewCluster, ViewEstimates)
    is_republished = key in (keys.INFO, keys.CLOCK) or messages.type_of(key) in views
    return not is_republished and not key.startswith("process/")


def _author(recorded: Recorded) -> str:
    """Return the name of the process that published a message; empty for the world and unknown roles."""
    kind = messages.type_of(recorded.key)
    if kind is flight_messages.Estimate:
        return f"estimator.{keys.thing(recorded.key)}"
    if recorded.key.startswith("drone/") and kind in (flight_messages.Reference, run_messages.ClusterRequest):
        return f"{roles.PILOT}.{keys.thing(recorded.key)}"
    if kind in (flight_messages.ClusterState, run_messages.ClusterRequest):
        return f"controller.{keys.thing(recorded.key)}"
    if kind is None or not issubclass(kind, SOURCED_TYPES):
        return ""
    try:
        return _decode_sourced(recorded.payload).source
    except REFUSALS:
        return ""


def _without_kills(payload: bytes) -> bytes:
    """Return a list of faults without those that kill a process, which must not kill participants of the replay."""
    try:
        listed: run_messages.Faults = messages.decode(keys.FAULTS, payload)
    except DecodeError:
        return payload
    others = tuple(fault for fault in listed.faults if fault.kind != PROCESS_KILL)
    return payload if others == listed.faults else messages.encode(msgspec.structs.replace(listed, faults=others))


def _read(last: Mapping[str, bytes], key: str) -> Any:
    """Return the last message on a key; None if there is none, or if it cannot be decoded."""
    payload = last.get(key)
    try:
        return messages.decode(key, payload) if payload is not None else None
    except DecodeError:
        return None
