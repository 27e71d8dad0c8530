"""A record as the gates of a run, a few of them in memory at a time; which messages a replay plays, and its views."""

from bisect import bisect_left
from collections import defaultdict, deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import msgspec

from zsim.contract import flight_messages, keys, messages, run_messages
from zsim.contract.flight_messages import (
    CameraImage,
    CameraInfo,
    DroneView,
    EstimateView,
    Sightings,
    ViewCluster,
    ViewDrones,
    ViewEstimates,
    cluster_view,
    estimate_view,
)
from zsim.contract.messages import REFUSALS
from zsim.errors import DecodeError
from zsim.record import Recorded, RecordReader
from zsim.record.record_reader import OVERLAP_NS
from zsim.runtime.agent import Output
from zsim.scenario import roles
from zsim.scenario.faults import PROCESS_KILL

SOURCED = (flight_messages.Command, CameraImage, CameraInfo, Sightings)  # say who published them
VIEWS = (ViewDrones, ViewCluster, ViewEstimates)  # a replay makes its own


class Gate(NamedTuple):
    """The messages of a gate: stamped after the gate before, up to this one; in order of writing."""

    t_ns: int
    messages: list[Recorded]


class _Clock(msgspec.Struct):
    state: str


class _Sourced(msgspec.Struct):
    source: str = ""


_decode_clock = msgspec.msgpack.Decoder(_Clock).decode
_decode_sourced = msgspec.msgpack.Decoder(_Sourced).decode


class RecordedGates:
    """Reads a record from any gate on.

    An answer to a gate is written a few gates later, since the world runs ahead of the agents; it is played with the
    gate of its stamp. A message whose stamp is further from where it was written (of a program that stamps nothing, or
    in realtime) is played where it was written.

    Args:
        delay_ns: of the run's commands, by which the world may be ahead.
        wanted: keys.
    """

    def __init__(self, reader: RecordReader, gate_ns: int, delay_ns: int, wanted: Collection[str]) -> None:
        self._reader = reader
        self._gate_ns = gate_ns
        self._slack_ns = delay_ns + gate_ns
        self._keys = {*wanted, keys.CLOCK}

    def gates(self, from_ns: int = 0) -> Iterator[Gate]:
        """Yield the gates from the first one at or after `from_ns` on; a gate that the record lacks is left out."""
        for gate in self._all(from_ns):
            if gate.t_ns >= from_ns:
                yield gate

    def _all(self, from_ns: int) -> Iterator[Gate]:
        held: dict[int, list[Recorded]] = {}
        gates: deque[int] = deque()
        newest = None

        def take(t_ns: int) -> Gate:
            """Return a gate, with the messages of gates before it that the record lacks."""
            due = sorted(gate_ns for gate_ns in held if gate_ns <= t_ns)
            return Gate(t_ns, [recorded for gate_ns in due for recorded in held.pop(gate_ns)])

        # What answers the first gate, or was sampled for it, may stand in a chunk that begins before it.
        for recorded in self._reader.messages(self._keys, by_time=False, from_ns=max(0, from_ns - self._slack_ns)):
            if recorded.key != keys.CLOCK:
                due_ns = -(-recorded.t_ns // self._gate_ns) * self._gate_ns
                if newest is not None:
                    writing_ns = newest + self._gate_ns
                    due_ns = due_ns if newest - self._slack_ns < due_ns <= writing_ns else writing_ns
                held.setdefault(due_ns, []).append(recorded)
            elif (newest is None or recorded.t_ns > newest) and _is_gate(recorded.payload):
                newest = recorded.t_ns
                gates.append(newest)
                while gates[0] + self._slack_ns <= newest:
                    yield take(gates.popleft())
        for t_ns in gates:
            yield take(t_ns)

    def before(
        self, instants_ns: Sequence[int], wanted: Collection[str], back_ns: int
    ) -> Iterator[tuple[int, dict[str, bytes]]]:
        """Yield each instant with the last payload by key since the instant before; for the first one since back_ns.

        Args:
            instants_ns: ascending.
            wanted: keys.
            back_ns: how far before the first instant is looked.
        """
        first_ns, last_ns = instants_ns[0] - back_ns, instants_ns[-1]
        newest: list[dict[str, Recorded]] = [{} for _ in instants_ns]
        for recorded in self._reader.messages(wanted, by_time=False, from_ns=max(0, first_ns)):
            if recorded.t_ns > last_ns + OVERLAP_NS:
                break
            if first_ns <= recorded.t_ns <= last_ns:
                of_instant = newest[bisect_left(instants_ns, recorded.t_ns)]
                held = of_instant.get(recorded.key)
                if held is None or held.t_ns <= recorded.t_ns:
                    of_instant[recorded.key] = recorded
        for t_ns, of_instant in zip(instants_ns, newest, strict=True):
            yield t_ns, {key: recorded.payload for key, recorded in of_instant.items()}


def _is_gate(payload: bytes) -> bool:
    """Tell whether a clock belongs to a gate: while a run waits for its start, it does not."""
    try:
        return _decode_clock(payload).state != "waiting"
    except REFUSALS:
        return False  # not the world's


def is_played(key: str, expressions: Sequence[str]) -> bool:
    """Return whether the messages of a key are played, if they match what the user wants.

    A replay publishes its own info, clock and views; what is about the processes on record is left out.
    """
    anew = key in (keys.INFO, keys.CLOCK) or key.startswith("process/") or messages.type_of(key) in VIEWS
    return not anew and roles.permits(expressions, key)


def author(recorded: Recorded) -> str:
    """Return the process that published a message, empty for the world and for unknown roles."""
    kind = messages.type_of(recorded.key)
    if kind is flight_messages.Estimate:
        return f"estimator.{keys.thing(recorded.key)}"
    if kind in (flight_messages.ClusterState, run_messages.ClusterRequest):
        return f"controller.{keys.thing(recorded.key)}"
    if kind is None or not issubclass(kind, SOURCED):
        return ""
    try:
        return _decode_sourced(recorded.payload).source
    except REFUSALS:
        return ""


def without_kills(payload: bytes) -> bytes:
    """Return a list of faults without those that kill a process: the participants of a replay are others."""
    try:
        listed: run_messages.Faults = messages.decode(keys.FAULTS, payload)
    except DecodeError:
        return payload
    others = tuple(fault for fault in listed.faults if fault.kind != PROCESS_KILL)
    return payload if others == listed.faults else messages.encode(msgspec.structs.replace(listed, faults=others))


class PlaybackViews:
    """Makes `view/**` of what a record has.

    Attributes:
        sources: keys whose last values are needed.
    """

    def __init__(self, drones: Sequence[str], clusters: Sequence[str]) -> None:
        self._drones = tuple(drones)
        self._clusters = tuple(clusters)
        of_drones = (key for drone in drones for key in (keys.truth(drone), keys.status(drone), keys.estimate(drone)))
        self.sources = frozenset((*of_drones, keys.VIEW_DRONES, *map(keys.cluster_state, clusters)))

    def views(self, last: Mapping[str, bytes], t_ns: int, seq: int) -> Iterator[Output]:
        """Yield the views of the gate t_ns, as far as the last values go."""
        drones = []
        estimates: defaultdict[str, list[EstimateView]] = defaultdict(list)
        for drone in self._drones:
            truth, status = _read(last, keys.truth(drone)), _read(last, keys.status(drone))
            if truth is not None and status is not None:
                pose = (truth.position_m, truth.orientation_wxyz, truth.rotor_rad_s)
                drones.append(DroneView(drone, *pose, status.state, status.battery_percent, status.commander))
            estimate = _read(last, keys.estimate(drone))
            if estimate is not None:
                estimates[f"estimator.{drone}"].append(estimate_view(drone, estimate))
        if drones:
            wind = _read(last, keys.VIEW_DRONES)
            wind_m_s = wind.wind_m_s if wind is not None and len(wind.wind_m_s) == len(drones) else ()
            yield Output(keys.VIEW_DRONES, ViewDrones(t_ns, seq, tuple(drones), wind_m_s))
        for cluster in self._clusters:
            state = _read(last, keys.cluster_state(cluster))
            if state is not None:
                yield Output(keys.cluster_view(cluster), cluster_view(state, t_ns, seq))
        for process, own in estimates.items():
            yield Output(keys.estimates_view(process), ViewEstimates(t_ns, seq, tuple(own)))


def _read(last: Mapping[str, bytes], key: str) -> Any:
    """Return the last message on a key, None where there is none that can be read."""
    payload = last.get(key)
    try:
        return messages.decode(key, payload) if payload is not None else None
    except DecodeError:
        return None
