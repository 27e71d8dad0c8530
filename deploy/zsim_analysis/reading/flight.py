"""A flight as arrays: read in one pass from its record, or from the messages themselves while it is flown here."""

from array import array
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from sys import intern
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct

from zsim.contract import keys
from zsim.contract.flight_messages import Quaternion
from zsim.contract.framing import GateMessages
from zsim.contract.messages import Info
from zsim.contract.run_messages import Bye, ClusterRequest, Event, Join
from zsim.record import Completeness, RecordReader, completeness
from zsim.schema.message import Vector3
from zsim_analysis.reading.drone_answers import DroneAnswers, EstimateFields, VelocityFields
from zsim_analysis.reading.recorded_flight import (
    TRUTH_WIDTH,
    ClusterStates,
    RecordedFlight,
    RecordedProcess,
    Track,
)
from zsim_analysis.reading.recorded_run import scenario_of, search_modules


class _Truth(Struct):
    """The part of a truth message that is needed here."""

    t_ns: int
    position_m: Vector3
    velocity_m_s: Vector3
    orientation_wxyz: Quaternion
    angular_velocity_rad_s: Vector3


class _Status(Struct):
    t_ns: int
    state: str
    battery_percent: float
    commander: str | None = None


class _State(Struct):
    t_ns: int
    phase: str
    names: tuple[str, ...]
    value: tuple[float, ...]
    desired: tuple[float, ...]
    drones: tuple[str, ...] = ()
    reason: str = ""


class _StateTable:
    """The states of a cluster as columns: those of a large formation repeat its names, which outweigh all numbers."""

    def __init__(self) -> None:
        self._names: tuple[str, ...] = ()
        self._drones: tuple[str, ...] = ()
        self._clear()

    def _clear(self) -> None:
        self._times, self._value, self._desired = array("q"), array("d"), array("d")
        self._phases: list[str] = []
        self._reasons: list[str] = []

    def add(self, state: _State) -> None:
        """Add a state; one with another number of variables than those before replaces them."""
        count = len(state.names)
        if not len(state.value) == len(state.desired) == count > 0:
            return
        if count != len(self._names):
            self._clear()
        self._names, self._drones = state.names, state.drones
        self._times.append(state.t_ns)
        self._value.extend(state.value)
        self._desired.extend(state.desired)
        self._phases.append(intern(state.phase))
        self._reasons.append(intern(state.reason))

    def states(self, name: str, drones: tuple[str, ...], requests: list[ClusterRequest]) -> ClusterStates:
        """Return all states by time, of several of an instant the last."""
        count = len(self._times)
        t_ns, places = np.unique(np.array(self._times, np.int64)[::-1], return_index=True)
        last = count - 1 - places
        return ClusterStates(
            name=name,
            drones=drones or self._drones,
            names=self._names,
            t_ns=t_ns,
            value=np.array(self._value).reshape(count, len(self._names))[last],
            desired=np.array(self._desired).reshape(count, len(self._names))[last],
            phases=[self._phases[i] for i in last],
            reasons=[self._reasons[i] for i in last],
            requests=requests,
        )


def read_flight(path: Path, answers: bool = False, motion: bool = True) -> RecordedFlight:
    """Return the flight of a record.

    Args:
        path: of the record.
        answers: with the drones' estimates and velocity commands.
        motion: with all of truth and status, not those of an instant in every second alone.

    Raises:
        RecordError: no such record.
    """
    with RecordReader(path) as reader:
        flight = FlightReader(answers)
        wanted = [key for key in reader.topics() if flight.handler(key)]
        if motion:
            for message in reader.messages(wanted, by_time=False):
                flight.add(message.key, message.payload, message.wall_ns)
            whole = completeness(reader)
        else:
            sampled = {key for key in wanted if keys.leaf(key) in ("truth", "status")}
            beside = {key for key in wanted if keys.parts(key)[0] != "drone"}
            whole = completeness(reader, beside, sampled, flight.add)
        recorded = flight.flight(sum(reader.topics().values()), whole)
        search_modules(path, recorded.info)
        return recorded


class FlightReader:
    """The flight while its record is read, or while it is flown in this process, message by message.

    Args:
        answers: take the drones' estimates and velocity commands too.
    """

    def __init__(self, answers: bool = False) -> None:
        self._answers = DroneAnswers() if answers else None
        self._infos: list[Info] = []
        self._events: list[Event] = []
        self._truth: dict[str, tuple[array[int], array[float]]] = {}
        self._status: dict[str, tuple[array[int], list[str], array[float]]] = {}
        self._states: defaultdict[str, _StateTable] = defaultdict(_StateTable)
        self._requests: dict[str, list[ClusterRequest]] = {}
        self._processes: dict[str, RecordedProcess] = {}
        self._first_wall_ns: int | None = None
        self._last_wall_ns = 0
        self._undecoded = 0
        self._handlers: dict[str, _Handler | None] = {}

    def handler(self, key: str) -> "_Handler | None":
        """Return what decodes and stores the messages of a key, None when no report needs them."""
        if key not in self._handlers:
            group, _, what = keys.parts(key)
            kinds: dict[str, tuple[type[Struct], Callable[[str, Any], None]]] = {
                keys.INFO: (Info, lambda _, message: self._infos.append(message)),
                keys.EVENT: (Event, lambda _, message: self._events.append(message)),
                "process/join": (Join, self._store_process),
                "process/bye": (Bye, self._store_process),
                "drone/truth": (_Truth, self._store_truth),
                "drone/sensor/status": (_Status, self._store_status),
                "cluster/state": (_State, lambda name, message: self._states[name].add(message)),
                "cluster/request": (
                    ClusterRequest,
                    lambda name, message: self._requests.setdefault(name, []).append(message),
                ),
            }
            if answers := self._answers:
                kinds["drone/estimate"] = (EstimateFields, answers.add_estimate)
                kinds["drone/cmd/velocity"] = (VelocityFields, answers.add_command)
            kind, store = kinds.get(f"{group}/{what}" if what else key, (None, None))
            self._handlers[key] = (msgspec.msgpack.Decoder(kind), store) if kind and store else None
        return self._handlers[key]

    def add(self, key: str, payload: bytes, wall_ns: int = 0) -> None:
        """Add a message of a record; one that cannot be decoded is counted.

        Args:
            wall_ns: when it was recorded; only of truth needed.
        """
        handler = self.handler(key)
        if handler is None:
            return
        decoder, store = handler
        try:
            message = decoder.decode(payload)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            self._undecoded += 1
            return
        if isinstance(message, _Truth):
            if self._first_wall_ns is None:
                self._first_wall_ns = wall_ns
            self._last_wall_ns = wall_ns
        store(keys.parts(key)[1], message)

    def add_message(self, key: str, message: Any, wall_ns: int) -> None:
        """Add a message of a flight in this process; it has not been encoded."""
        if handler := self.handler(key):
            handler[1](keys.parts(key)[1], message)

    def add_gate(self, gate: GateMessages, wall_ns: int) -> None:
        """Add the world's messages of a gate of a flight in this process."""
        self._first_wall_ns, self._last_wall_ns = self._first_wall_ns or wall_ns, wall_ns
        for key, payload in gate.pairs:
            if handler := self.handler(key):
                handler[1](keys.parts(key)[1], handler[0].decode(payload))

    def _store_truth(self, name: str, truth: _Truth) -> None:
        times, values = self._truth.setdefault(name, (array("q"), array("d")))
        times.append(truth.t_ns)
        values.extend(truth.position_m)
        values.extend(truth.velocity_m_s)
        values.extend(truth.orientation_wxyz)
        values.extend(truth.angular_velocity_rad_s)

    def _store_status(self, name: str, status: _Status) -> None:
        times, states, battery = self._status.setdefault(name, (array("q"), [], array("d")))
        times.append(status.t_ns)
        states.append(status.state)
        battery.append(status.battery_percent)
        if self._answers:
            self._answers.add_commander(name, status.t_ns, status.commander)

    def _store_process(self, name: str, message: Join | Bye) -> None:
        process = self._processes.setdefault(name, RecordedProcess(name))
        if isinstance(message, Bye):
            process.left = message.reason
            return
        process.role, process.host, process.pid = message.role, message.host, message.pid
        process.version, process.fingerprint = message.version, message.fingerprint
        process.incarnations += 1
        process.left = ""

    def flight(self, messages: int = 0, completeness: Completeness | None = None) -> RecordedFlight:
        """Return the flight when all messages are added; the arguments describe its record, if there is one."""
        info = self._infos[-1] if self._infos else None
        names = [drone.name for drone in info.drones] if info else sorted(self._truth)
        external = {drone.name for drone in info.drones if drone.body is not msgspec.UNSET} if info else set[str]()
        members = {c.name: c.drones for c in info.clusters} if info else dict.fromkeys(self._states, ())
        return RecordedFlight(
            info=info,
            scenario=scenario_of(info),
            tracks=[self._track(name, name in external) for name in names],
            clusters=[
                self._states[name].states(name, drones, self._requests.get(name, []))
                for name, drones in members.items()
            ],
            events=sorted(self._events, key=lambda event: (event.t_ns, event.seq)),
            processes=list(self._processes.values()),
            messages=messages,
            completeness=completeness or Completeness(),
            wall_s=(self._last_wall_ns - (self._first_wall_ns or 0)) / 1e9,
            undecoded=self._undecoded,
            began_ns=self._first_wall_ns,
            estimates=self._answers.estimates() if self._answers else {},
            commands=self._answers.commands() if self._answers else {},
        )

    def _track(self, name: str, external: bool) -> Track:
        times, values = self._truth.get(name, (array("q"), array("d")))
        status_times, states, battery = self._status.get(name, (array("q"), [], array("d")))
        t_ns, first = np.unique(np.array(times, np.int64), return_index=True)
        status_t_ns, status_first = np.unique(np.array(status_times, np.int64), return_index=True)
        return Track(
            name=name,
            t_ns=t_ns,
            truth=np.array(values, np.float64).reshape(-1, TRUTH_WIDTH)[first],
            status_t_ns=status_t_ns,
            states=[states[i] for i in status_first],
            battery_percent=np.array(battery, np.float64)[status_first],
            external=external,
        )


_Handler = tuple[msgspec.msgpack.Decoder[Any], Callable[[str, Any], None]]
