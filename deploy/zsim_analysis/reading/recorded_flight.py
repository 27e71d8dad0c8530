"""A flight as arrays: tracks, estimates, commands, radio links, cluster states, events and processes.

`read_flight` builds them from a record in one pass, `FlightReader` from the messages of a flight in this process.
"""

from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from sys import intern
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from zsim.contract import keys
from zsim.contract.flight_messages import Covariance, Quaternion
from zsim.contract.framing import GateMessages
from zsim.contract.messages import Info
from zsim.contract.run_messages import Bye, ClusterRequest, Event, Join, RadioLinks
from zsim.record import Completeness, RecordReader, completeness
from zsim.scenario.scenario import Scenario
from zsim.schema.message import Vector3
from zsim_analysis.reading.recorded_run import scenario_of, search_modules

Array = NDArray[np.float64]
Times = NDArray[np.int64]
TRUTH_WIDTH = 13  # position, velocity, orientation, angular velocity
CONNECTED_MIN = 0.5  # minimum reception probability, apart from loss, of a connected link: that at range_m


@dataclass
class Track:
    """True motion of one drone, in the frames W and B of the contract."""

    name: str
    t_ns: Times  # (T,) times of the truth, ascending and unique
    truth: Array  # (T, 13) position [m], velocity [m/s], orientation w first, angular velocity [rad/s; B]
    status_t_ns: Times  # (S,) times of the status
    states: list[str]  # (S,) names of the firmware's state
    battery_percent: Array  # (S,)
    # whether the body is external; if so, `truth` is the pose published by its driver, which is an estimate
    external: bool = False

    @property
    def p_W(self) -> Array:
        return self.truth[:, :3]

    @property
    def yaw(self) -> Array:
        """The heading (T,) [rad]."""
        w, x, y, z = self.truth[:, 6:10].T
        return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))

    @property
    def yaw_rate(self) -> Array:
        """The angular velocity about the vertical axis of W (T,) [rad/s]."""
        w, x, y, z = self.truth[:, 6:10].T
        up_B = np.column_stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
        return np.sum(up_B * self.truth[:, 10:13], axis=1)


@dataclass
class DroneEstimates:
    """Published estimates of one drone."""

    t_ns: Times  # (E,) ascending and unique
    p_W: Array  # (E, 3) position [m]
    v_W: Array  # (E, 3) velocity [m/s]
    # yaw, yaw_sigma: (E,) heading and its standard deviation [rad]
    yaw: Array
    yaw_sigma: Array
    covariance: Array  # (E, 6, 6) of position and velocity [SI]


@dataclass
class DroneReferences:
    """The reference of one drone that flies on its own."""

    t_ns: Times  # (K,) ascending and unique
    place: Array  # (K, 4) x, y, z in W [m], yaw [rad, not wrapped]
    phases: list[str]


@dataclass
class VelocityCommands:
    """Velocity commands to one drone, sent by its commander."""

    t_ns: Times  # (C,) ascending and unique
    velocity: Array  # (C, 3) [m/s] as sent
    yaw_rate: Array  # (C,) [rad/s]
    # (C,) whether the velocity is in W; otherwise x is forward and y left according to the sender's estimated heading
    in_W: NDArray[np.bool_]


@dataclass
class ClusterStates:
    """Published states of one cluster's controller: K samples of n variables."""

    name: str
    drones: tuple[str, ...]
    names: tuple[str, ...]
    t_ns: Times
    value: Array
    desired: Array
    phases: list[str]
    reasons: list[str]  # (K,) why the controller waits or is held
    requests: list[ClusterRequest]  # accepted and refused ones, from sources other than the cluster's plan
    orders: list[str] = field(default_factory=list)  # (K,) drones in the order of the robots, separated by spaces

    def robot_of(self, row: int, drone: str) -> int:
        """Return a drone's index as a robot in a row, or its index in `drones` if the row's order lacks it."""
        order = self.orders[row].split() if self.orders else []
        return order.index(drone) if drone in order else self.drones.index(drone)


@dataclass
class RecordedProcess:
    """A process that joined the run."""

    name: str
    role: str = ""
    host: str = ""
    pid: int = 0
    version: str = ""
    fingerprint: str = ""
    incarnations: int = 0
    left: str = ""


class RadioSummary(Struct, frozen=True):
    """The reception between drones, averaged over a window."""

    heard_mean: float  # expected number of drones that a drone hears: 4 heard with a loss of one half count as 2
    connected_share: float  # share of time in which every drone can reach all others, directly or via relays


class RadioHistory:
    """The links between N drones at K times, without those of a ground station.

    Attributes:
        t_ns: times, ascending, (K,).
        heard: expected number of other drones whose messages arrive, (K, N).
        connected: whether links with a reception >= CONNECTED_MIN, `loss` aside, strongly connect the drones, (K,).
        share: probability that a message of drone j arrives at drone i, mean over time, (N, N).

    Args:
        links: the links at each time.
        drones: number of drones, N.
        loss: share of messages lost at any distance.
    """

    def __init__(self, links: Sequence[RadioLinks], drones: int, loss: float = 0.0) -> None:
        by_time = {each.t_ns: each for each in links}
        self.t_ns: NDArray[np.int64] = np.array(sorted(by_time), np.int64)
        self.heard: NDArray[np.float64] = np.empty((len(self.t_ns), drones))
        self.connected: NDArray[np.bool_] = np.empty(len(self.t_ns), bool)
        self.share: NDArray[np.float64] = np.zeros((drones, drones))
        for k, t_ns in enumerate(self.t_ns.tolist()):
            reception, self.connected[k] = _graph(by_time[t_ns].hears, by_time[t_ns].reception, drones)
            arrives = (1.0 - loss) * reception
            self.heard[k] = arrives.sum(axis=1)
            self.share += arrives / len(self.t_ns)

    def summary(self, window_s: tuple[float, float]) -> RadioSummary | None:
        within = (self.t_ns >= window_s[0] * 1e9) & (self.t_ns <= window_s[1] * 1e9)
        if not within.any():
            return None
        return RadioSummary(float(self.heard[within].mean()), float(self.connected[within].mean()))


@lru_cache(maxsize=1024)  # links change rarely if reception does not depend on the distance
def _graph(
    hears: tuple[tuple[int, ...], ...], reception: tuple[tuple[float, ...], ...], drones: int
) -> tuple[NDArray[np.float64], bool]:
    """Return the reception probability of drone j at drone i, (N, N), and whether the graph is strongly connected."""
    matrix = np.zeros((drones, drones))
    probabilities = reception or [(1.0,) * len(senders) for senders in hears]
    for i, row in enumerate(zip(hears[:drones], probabilities[:drones], strict=False)):
        for j, probability in zip(*row, strict=False):
            if j < drones:
                matrix[i, j] = probability
    components, _ = connected_components(csr_array(matrix >= CONNECTED_MIN), directed=True, connection="strong")
    return matrix, components == 1


@dataclass
class RecordedFlight:
    """Everything that a report needs of a flight; fields that are not in the record are None or empty."""

    info: Info | None
    scenario: Scenario | None
    tracks: list[Track]
    clusters: list[ClusterStates]
    events: list[Event]
    processes: list[RecordedProcess]
    messages: int  # number of messages in the record, over all keys
    completeness: Completeness
    wall_s: float  # wall time from the first to the last truth message, by the recorder's clock
    undecoded: int = 0  # number of payloads that do not match the type of their key
    began_ns: int | None = None  # wall time of the first truth message [ns since 1970]; None without truth
    # estimates and commands by drone; empty unless requested
    estimates: dict[str, DroneEstimates] = field(default_factory=dict)
    commands: dict[str, VelocityCommands] = field(default_factory=dict)
    others: dict[str, int] = field(default_factory=dict)  # in process: message counts of keys that no report reads
    cpu_s: float | None = None  # CPU time of this process from the first gate to the last; None for a record
    radio: RadioHistory | None = None  # None if the scenario has no radio
    references: dict[str, DroneReferences] = field(default_factory=dict)  # of drones that fly on their own, by drone

    @property
    def end(self) -> dict[str, Any] | None:
        """Data of the world's last `end` event; None without one."""
        return next((event.data for event in reversed(self.events) if event.kind == "end"), None)

    @property
    def replay_of(self) -> str:
        """The run_id of the run that was replayed; empty for a flight."""
        return self.info.replay_of if self.info else ""

    @property
    def first_ns(self) -> int:
        """Time of the first truth message [ns]."""
        return min((int(track.t_ns[0]) for track in self.tracks if len(track.t_ns)), default=0)

    @property
    def last_ns(self) -> int:
        return max((int(track.t_ns[-1]) for track in self.tracks if len(track.t_ns)), default=0)


def read_flight(path: Path, answers: bool = False, motion: bool = True) -> RecordedFlight:
    """Return the flight of a record; raise RecordError if there is no record.

    With `answers`, it includes the drones' estimates and velocity commands; without `motion`, truth, status and
    reference messages only once per second.
    """
    with RecordReader(path) as reader:
        flight = FlightReader(answers)
        report_keys = [key for key in reader.topics() if flight.handler(key)]
        if motion:
            for message in reader.messages(report_keys, by_time=False):
                flight.add(message.key, message.payload, message.wall_ns)
            record_completeness = completeness(reader)
        else:
            sampled = {key for key in report_keys if keys.leaf(key) in ("truth", "status", "reference")}
            unsampled = {key for key in report_keys if keys.parts(key)[0] != "drone"}
            record_completeness = completeness(reader, unsampled, sampled, flight.add)
        recorded = flight.flight(sum(reader.topics().values()), record_completeness)
        search_modules(path, recorded.info)
        return recorded


# Messages, reduced to the fields that are used


class _Truth(Struct):
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


class _Estimate(Struct):
    t_ns: int
    position_m: Vector3
    velocity_m_s: Vector3
    yaw_rad: float
    covariance: Covariance
    yaw_sigma_rad: float


class _Reference(Struct):
    t_ns: int
    phase: str
    position_m: Vector3
    yaw_rad: float


class _Velocity(Struct):
    t_ns: int
    source: str
    velocity_m_s: Vector3
    yaw_rate_rad_s: float
    frame: str = "heading"


class _Rows:
    """Rows of numbers with their times, and texts for some messages, stored compactly."""

    def __init__(self, width: int, kind: str) -> None:
        self.t_ns, self.values, self.width = array("q"), array(kind), width
        self.texts: list[tuple[str, ...]] = []

    def by_time(self, last: bool = False) -> tuple[Times, np.ndarray, list[tuple[str, ...]]]:
        """Return unique ascending times (R,) [ns], and the first or last row (R, width) and texts at each of them."""
        step, count = -1 if last else 1, len(self.t_ns)
        t_ns, chosen = np.unique(np.array(self.t_ns, np.int64)[::step], return_index=True)
        chosen = count - 1 - chosen if last else chosen
        texts = [self.texts[i] for i in chosen] if self.texts else []
        return t_ns, np.array(self.values).reshape(count, self.width)[chosen], texts


_Handler = tuple[msgspec.msgpack.Decoder[Any], Callable[[str, Any], None]]


class FlightReader:
    """Collects a flight message by message; with `answers`, including the drones' estimates and velocity commands."""

    def __init__(self, answers: bool = False) -> None:
        self._answers = answers
        self._infos: list[Info] = []
        self._radio: list[RadioLinks] = []
        self._events: list[Event] = []
        self._truth: defaultdict[str, _Rows] = defaultdict(lambda: _Rows(TRUTH_WIDTH, "d"))
        self._status: defaultdict[str, _Rows] = defaultdict(lambda: _Rows(1, "d"))
        self._commanders: defaultdict[str, list[tuple[int, str]]] = defaultdict(list)
        self._estimates: defaultdict[str, _Rows] = defaultdict(lambda: _Rows(3 + 3 + 1 + 1 + 36, "f"))
        self._references: defaultdict[str, _Rows] = defaultdict(lambda: _Rows(3 + 1, "d"))
        self._commands: defaultdict[tuple[str, str], _Rows] = defaultdict(lambda: _Rows(3 + 1 + 1, "f"))
        self._states: dict[str, _Rows] = {}
        self._members: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {}  # names of variables, drones
        self._requests: defaultdict[str, list[ClusterRequest]] = defaultdict(list)
        self._processes: dict[str, RecordedProcess] = {}
        self._first_wall_ns: int | None = None
        self._last_wall_ns = 0
        self._undecoded = 0
        self._others: Counter[str] = Counter()
        self._handlers: dict[str, _Handler | None] = {}

    def handler(self, key: str) -> _Handler | None:
        """Return a decoder of a key's messages and a function that stores them; None for keys that no report needs."""
        if key not in self._handlers:
            group, _, leaf = keys.parts(key)
            kinds: dict[str, tuple[type[Struct], Callable[[str, Any], None]]] = {
                keys.INFO: (Info, lambda _, message: self._infos.append(message)),
                keys.RADIO: (RadioLinks, lambda _, message: self._radio.append(message)),
                keys.EVENT: (Event, lambda _, message: self._events.append(message)),
                "process/join": (Join, self._add_process),
                "process/bye": (Bye, self._add_process),
                "drone/truth": (_Truth, self._add_truth),
                "drone/sensor/status": (_Status, self._add_status),
                "drone/reference": (_Reference, self._add_reference),
                "cluster/state": (_State, self._add_state),
                "cluster/request": (ClusterRequest, lambda name, message: self._requests[name].append(message)),
            }
            if self._answers:
                kinds["drone/estimate"] = (_Estimate, self._add_estimate)
                kinds["drone/cmd/velocity"] = (_Velocity, self._add_command)
            kind, store = kinds.get(f"{group}/{leaf}" if leaf else key, (None, None))
            self._handlers[key] = (msgspec.msgpack.Decoder(kind), store) if kind and store else None
        return self._handlers[key]

    def add(self, key: str, payload: bytes, wall_ns: int = 0) -> None:
        """Add a recorded message, or count it if it cannot be decoded. `wall_ns` is needed for truth only."""
        if (handler := self.handler(key)) is None:
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
        """Add a message of a flight in this process, where messages are not encoded."""
        if handler := self.handler(key):
            handler[1](keys.parts(key)[1], message)
        else:
            self._others[key] += 1

    def add_gate(self, gate: GateMessages, wall_ns: int) -> None:
        """Add the world's messages of a gate of a flight in this process."""
        self._first_wall_ns, self._last_wall_ns = self._first_wall_ns or wall_ns, wall_ns
        for key, payload in gate.pairs:
            if handler := self.handler(key):
                handler[1](keys.parts(key)[1], handler[0].decode(payload))

    def _add_truth(self, name: str, truth: _Truth) -> None:
        rows = self._truth[name]
        rows.t_ns.append(truth.t_ns)
        rows.values.extend(truth.position_m)
        rows.values.extend(truth.velocity_m_s)
        rows.values.extend(truth.orientation_wxyz)
        rows.values.extend(truth.angular_velocity_rad_s)

    def _add_status(self, name: str, status: _Status) -> None:
        rows = self._status[name]
        rows.t_ns.append(status.t_ns)
        rows.values.append(status.battery_percent)
        rows.texts.append((status.state,))
        if self._answers:
            commanders, commander = self._commanders[name], status.commander or ""
            if not commanders or commanders[-1][1] != commander:
                commanders.append((status.t_ns, commander))

    def _add_estimate(self, drone: str, estimate: _Estimate) -> None:
        rows = self._estimates[drone]
        rows.t_ns.append(estimate.t_ns)
        rows.values.extend(estimate.position_m)
        rows.values.extend(estimate.velocity_m_s)
        rows.values.extend((estimate.yaw_rad, estimate.yaw_sigma_rad))
        rows.values.extend(estimate.covariance)

    def _add_reference(self, drone: str, reference: _Reference) -> None:
        rows = self._references[drone]
        rows.t_ns.append(reference.t_ns)
        rows.values.extend(reference.position_m)
        rows.values.append(reference.yaw_rad)
        rows.texts.append((intern(reference.phase),))

    def _add_command(self, drone: str, command: _Velocity) -> None:
        rows = self._commands[drone, command.source]
        rows.t_ns.append(command.t_ns)
        rows.values.extend(command.velocity_m_s)
        rows.values.extend((command.yaw_rate_rad_s, command.frame == "world"))

    def _add_state(self, cluster: str, state: _State) -> None:
        """Add a state; a state with another number of variables replaces all earlier ones."""
        if not len(state.value) == len(state.desired) == len(state.names) > 0:
            return
        width = 2 * len(state.names)
        if (rows := self._states.get(cluster)) is None or rows.width != width:
            rows = self._states[cluster] = _Rows(width, "d")
        self._members[cluster] = state.names, state.drones
        rows.t_ns.append(state.t_ns)
        rows.values.extend(state.value)
        rows.values.extend(state.desired)
        rows.texts.append((intern(state.phase), intern(state.reason), intern(" ".join(state.drones))))

    def _add_process(self, name: str, message: Join | Bye) -> None:
        process = self._processes.setdefault(name, RecordedProcess(name))
        if isinstance(message, Bye):
            process.left = message.reason
            return
        process.role, process.host, process.pid = message.role, message.host, message.pid
        process.version, process.fingerprint = message.version, message.fingerprint
        process.incarnations += 1
        process.left = ""

    def flight(self, messages: int = 0, completeness: Completeness | None = None) -> RecordedFlight:
        """Return the flight after all messages have been added; the arguments describe its record, if any."""
        info = self._infos[-1] if self._infos else None
        external = {drone.name for drone in info.drones if drone.body is not msgspec.UNSET} if info else set[str]()
        members = {c.name: c.drones for c in info.clusters} if info else dict.fromkeys(self._states, ())
        tracks = []
        for name in [drone.name for drone in info.drones] if info else sorted(self._truth):
            t_ns, truth, _ = self._truth[name].by_time()
            status_t_ns, battery, texts = self._status[name].by_time()
            states = [state for (state,) in texts]
            tracks.append(Track(name, t_ns, truth, status_t_ns, states, battery[:, 0], name in external))
        clusters = []
        for name, drones in members.items():
            t_ns, values, texts = self._states.get(name, _Rows(0, "d")).by_time(last=True)
            names, known_drones = self._members.get(name, ((), ()))
            value, desired = np.split(values, 2, axis=1)
            phases, reasons = [phase for phase, _, _ in texts], [reason for _, reason, _ in texts]
            state_texts = (phases, reasons, self._requests[name], [order for _, _, order in texts])
            clusters.append(ClusterStates(name, drones or known_drones, names, t_ns, value, desired, *state_texts))
        estimates = {}
        for drone, rows in self._estimates.items():
            t_ns, values, _ = rows.by_time()
            p_W, v_W, yaw, sigma, covariance = np.split(values.astype(np.float64), (3, 6, 7, 8), axis=1)
            estimates[drone] = DroneEstimates(t_ns, p_W, v_W, yaw[:, 0], sigma[:, 0], covariance.reshape(-1, 6, 6))
        references = {}
        for drone, rows in self._references.items():
            t_ns, pose, texts = rows.by_time()
            references[drone] = DroneReferences(t_ns, pose, [phase for (phase,) in texts])
        scenario = scenario_of(info)
        radio = scenario.radio_of_agents if scenario else None
        return RecordedFlight(
            info=info,
            scenario=scenario,
            tracks=tracks,
            clusters=clusters,
            events=sorted(self._events, key=lambda event: (event.t_ns, event.seq)),
            processes=list(self._processes.values()),
            messages=messages,
            completeness=completeness or Completeness(),
            wall_s=(self._last_wall_ns - (self._first_wall_ns or 0)) / 1e9,
            undecoded=self._undecoded,
            began_ns=self._first_wall_ns,
            estimates=estimates,
            commands=self._obeyed_commands(),
            others=dict(self._others),
            radio=RadioHistory(self._radio, len(tracks), radio.loss if radio else 0.0) if self._radio else None,
            references=references,
        )

    def _obeyed_commands(self) -> dict[str, VelocityCommands]:
        """Return the commands that each drone obeyed, by time.

        A command was obeyed if the latest status names its source as commander, or if it names no commander and the
        next commander, if any, is this source. Without any status, all commands are deemed obeyed.
        """
        by_drone: defaultdict[str, list[tuple[Times, np.ndarray]]] = defaultdict(list)
        for (drone, source), rows in self._commands.items():
            t_ns, values, _ = rows.by_time()
            if commanders := self._commanders[drone]:
                index = np.searchsorted(np.array([t for t, _ in commanders]), t_ns, side="right") - 1
                names = np.array([name for _, name in commanders])
                current, subsequent = names[np.maximum(index, 0)], names[np.minimum(index + 1, len(names) - 1)]
                obeyed = (current == source) | ((current == "") & np.isin(subsequent, ("", source)))
                t_ns, values = t_ns[obeyed], values[obeyed]
            by_drone[drone].append((t_ns, values))
        obeyed_commands = {}
        for drone, parts in by_drone.items():
            t_ns, unique_rows = np.unique(np.concatenate([times for times, _ in parts]), return_index=True)
            values = np.concatenate([values for _, values in parts])[unique_rows].astype(np.float64)
            obeyed_commands[drone] = VelocityCommands(t_ns, values[:, :3], values[:, 3], values[:, 4] > 0)
        return obeyed_commands
