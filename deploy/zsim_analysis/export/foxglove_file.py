"""Writes a record as a Foxglove file, in order of time and in bounded memory: its topics, and when each is written.

Foxglove shows all topics; Rerun reads the transforms, poses, points, fixes, pictures, log and numbers.
"""

import math
import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from itertools import chain, groupby
from os import SEEK_CUR, SEEK_END, SEEK_SET
from pathlib import Path
from typing import Any, NamedTuple

import foxglove
import msgspec
import numpy as np
from foxglove import channels
from foxglove.messages import PoseInFrame

from zsim.contract import keys, messages
from zsim.contract.flight_messages import CameraImage, CameraInfo, ClusterState, Estimate, Status, Truth
from zsim.contract.messages import Gps, Info
from zsim.contract.run_messages import Event
from zsim.errors import NotTrustedError
from zsim.math.frames import heading
from zsim.presentation import colours_of
from zsim.record import Recorded, RecordReader
from zsim.scenario.scenario import Scenario
from zsim.vehicles.vehicle import cross_layout
from zsim_agents.formation.spaces.cluster_space import ClusterSpace, SingularClusterError
from zsim_agents.formation.spaces.scenario_space import scenario_space
from zsim_analysis.export import foxglove_messages as build
from zsim_analysis.export.columns import DecodedMessages, MessageSelection, subject
from zsim_analysis.export.foxglove_messages import GREY, MAGENTA, TRAIL_STEP_NS, NumericMessageType, RotorDisc
from zsim_analysis.reading.recorded_run import decode_or_none, scenario_of, search_modules

TF, LOG, DRONES, GROUND, TRAILS = "/tf", "/log", "/scene/drones", "/scene/ground", "/scene/trails"
FORMATIONS, ESTIMATES = "/scene/formations", "/scene/estimates"
POINTS, DESIRED = "/points/drones", "/points/desired"
SCENE_STEP_NS = 100_000_000  # interval between messages with scenes or points
DRAWN = (Truth, Estimate, Status, Gps, ClusterState, Event, CameraImage, CameraInfo)
LATEST_NS = 2**32 * 10**9  # Foxglove stores seconds in 32 bits
ARM_M = 0.1785  # arm length of the AR.Drone, for drones of an unknown scenario
ROTOR_RADIUS = 0.57  # fraction of the arm length, for unknown rotors: the AR.Drone's 0.102 m / 0.1785 m


class ConvertedRun(NamedTuple):
    """The content of a written file."""

    topics: dict[str, int]  # number of messages by topic
    variables: dict[str, tuple[str, ...]]  # names of the numeric fields by cluster
    rotors: dict[str, list[RotorDisc]]  # by drone, in the order of the scenario
    refused: int  # number of messages that could not be read


def convert(
    reader: RecordReader, selection: MessageSelection, path: Path, progress: Callable[[int, int], None]
) -> ConvertedRun:
    """Write the MCAP file; return its content. `progress` is called with the number of messages read and the total."""
    selected_keys = [key for key in selection.keys(reader) if messages.type_of(key) in DRAWN or key == keys.INFO]
    total = sum(reader.topics()[key] for key in selected_keys)
    recorded = reader.last(keys.INFO)
    info = decode_or_none(recorded) if recorded else None
    search_modules(reader.path, info)
    scenario = scenario_of(info)
    decoded = DecodedMessages(selection.messages(reader, selected_keys), _decode, lambda done: progress(done, total))
    rotors = _rotors(info, scenario, dict.fromkeys(subject(key) for key in selected_keys if key.startswith("drone/")))
    spaces: dict[str, ClusterSpace] = {}
    if scenario:
        for cluster in scenario.clusters:
            with suppress(ValueError, NotTrustedError):
                spaces[cluster.name] = scenario_space(scenario, cluster)
    file = FoxgloveFile(path, rotors, spaces)
    with deferred_signals() as check:
        try:
            for instant in chain(_cameras_before(reader, selection, selected_keys), _instants(decoded)):
                file.write(instant)
                check()
        finally:
            file.close()
    return ConvertedRun(
        dict(sorted(file.counts.items())),
        {name: kind.numbers for name, kind in file.variables.items()},
        rotors,
        decoded.refused,
    )


@contextmanager
def deferred_signals() -> Iterator[Callable[[], None]]:
    """Defer SIGINT and SIGTERM; yield a function that handles those received meanwhile.

    An exception that their handlers raise within a call into the Foxglove library would be printed, then lost.
    """
    pending: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM) if threading.current_thread() is threading.main_thread() else ()
    previous = {number: handler for number in numbers if callable(handler := signal.getsignal(number))}

    def check() -> None:
        if pending:
            number = pending.pop(0)
            previous[signal.Signals(number)](number, None)

    for number in previous:
        signal.signal(number, lambda signum, _: pending.append(signum))
    try:
        yield check
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    check()


def _decode(recorded: Recorded) -> Any:
    return decode_or_none(recorded) if recorded.t_ns < LATEST_NS else None


def _rotors(info: Info | None, scenario: Scenario | None, present: Mapping[str, None]) -> dict[str, list[RotorDisc]]:
    """Return the rotors of every drone in the record, in the order of the scenario.

    If `world/info` does not give a drone's rotors, they are assumed to form an X.
    """
    arms_m = {drone.name: drone.arm_m for drone in scenario.drones} if scenario else {}
    rotors_by_drone = {drone.name: drone.rotors for drone in info.drones} if info else {}
    rotors = {}
    for name in sorted(present, key=list({**arms_m, **present}).index):
        arm_m = arms_m.get(name, ARM_M)
        cross = [RotorDisc(rotor.x_m, rotor.y_m, ROTOR_RADIUS * arm_m) for rotor in cross_layout(arm_m)]
        rotors[name] = [RotorDisc(each.x_m, each.y_m, each.radius_m) for each in rotors_by_drone.get(name, ())] or cross
    return rotors


@dataclass
class Instant:
    """The messages of one time: the last of each key, but all events and all camera messages."""

    t_ns: int
    truth: dict[str, Truth] = field(default_factory=dict)
    estimates: dict[str, Estimate] = field(default_factory=dict)
    status: dict[str, Status] = field(default_factory=dict)
    gps: dict[str, Gps] = field(default_factory=dict)
    states: dict[str, ClusterState] = field(default_factory=dict)
    events: list[Event] = field(default_factory=list)
    pictures: list[tuple[str, CameraImage]] = field(default_factory=list)
    cameras: list[tuple[str, CameraInfo]] = field(default_factory=list)


def _instants(decoded: Iterable[tuple[Recorded, Any]]) -> Iterator[Instant]:
    """Group messages, given in order of time, by time; `world/info` is left out."""
    decoded_messages = ((recorded.key, message) for recorded, message in decoded if not isinstance(message, Info))
    for t_ns, group in groupby(decoded_messages, key=lambda pair: pair[1].t_ns):
        instant = Instant(t_ns)
        newest: dict[type, dict[str, Any]] = {
            Truth: instant.truth,
            Estimate: instant.estimates,
            Status: instant.status,
            Gps: instant.gps,
            ClusterState: instant.states,
        }
        for key, message in group:
            match message:
                case Event():
                    instant.events.append(message)
                case CameraImage():
                    instant.pictures.append((key, message))
                case CameraInfo():
                    instant.cameras.append((key, message))
                case _:
                    newest[type(message)][subject(key)] = message
        yield instant


def _cameras_before(
    reader: RecordReader, selection: MessageSelection, selected_keys: Iterable[str]
) -> Iterator[Instant]:
    """Yield the latest calibrations from before the selected times, as cameras may publish them only once."""
    from_ns = round((selection.from_s or 0.0) * 1e9)
    camera_keys = [key for key in selected_keys if messages.type_of(key) is CameraInfo]
    calibrations: dict[str, CameraInfo] = {}
    for recorded in reader.messages(camera_keys) if from_ns and camera_keys else ():
        if recorded.t_ns < from_ns and (info := _decode(recorded)) is not None:
            calibrations[recorded.key] = msgspec.structs.replace(info, t_ns=from_ns)
    if calibrations:
        yield Instant(from_ns, cameras=list(calibrations.items()))


class FoxgloveFile:
    """An MCAP file that is being written; `rotors` are by drone in the order of the scenario, `spaces` by cluster."""

    def __init__(
        self, path: Path, rotors: Mapping[str, Sequence[RotorDisc]], spaces: Mapping[str, ClusterSpace]
    ) -> None:
        self._context = foxglove.Context()
        self._checked_file = CheckedFile(path)
        self._file = foxglove.open_mcap(self._checked_file, context=self._context)
        self._rotors = rotors
        self._spaces = spaces
        self._colours = colours_of(rotors)
        self._channels: dict[str, Any] = {}
        self.variables: dict[str, NumericMessageType] = {}  # by cluster
        self._drone = NumericMessageType("Drone", build.DRONE_NUMBERS, ("state",))
        self._trails = build.DroneTrails()
        self._status: dict[str, Status] = {}
        self._next_ns: dict[str, int] = {}
        self._has_static_scene = False
        self.counts: Counter[str] = Counter()  # number of messages by topic

    def close(self) -> None:
        """Finish the file; raise OSError if it could not be written."""
        self._file.close()
        self._checked_file.close()

    def write(self, instant: Instant) -> None:
        """Write all messages of one time; raise OSError if they cannot be written."""
        self._checked_file.check()
        self._status.update(instant.status)
        if not self._has_static_scene and instant.truth:
            self._log(DRONES, channels.SceneUpdateChannel, build.drones(instant.t_ns, self._rotors), instant.t_ns)
            self._log(GROUND, channels.SceneUpdateChannel, build.ground(instant.t_ns), instant.t_ns)
            self._has_static_scene = True
        frames: list[build.FramePose] = []
        for name, truth in instant.truth.items():
            frames.append((build.frame(name), truth.position_m, truth.orientation_wxyz))
        for name, estimate in instant.estimates.items():
            frames.append((f"{build.frame(name)}/estimate", estimate.position_m, estimate.orientation_wxyz))
        for name, state in instant.states.items():
            for end, values in (("", state.value), ("/desired", state.desired)):
                if placed := build.cluster_frame(state.names, values):
                    frames.append((f"cluster/{name}{end}", *placed))
        if frames:
            self._log(TF, channels.FrameTransformsChannel, build.transforms(instant.t_ns, frames), instant.t_ns)
        for name in dict.fromkeys([*instant.truth, *instant.estimates]):
            self._write_drone(instant, name)
        for name, gps in instant.gps.items():
            fix = build.location_fix(gps, name, self._colours.get(name, GREY))
            self._log(f"/drone/{name}/gps", channels.LocationFixChannel, fix, gps.t_ns)
        for name, state in instant.states.items():
            self._write_cluster(instant, name, state)
        for event in instant.events:
            self._log(LOG, channels.LogChannel, build.log_line(event), event.t_ns)
        for key, info in instant.cameras:
            drone, frame = _camera_of(key)
            calibration = build.camera_calibration(info, frame)
            self._log(f"/{frame}/calibration", channels.CameraCalibrationChannel, calibration, info.t_ns)
            placed = [(frame, info.position_m, info.orientation_wxyz)]
            self._log(
                TF, channels.FrameTransformsChannel, build.transforms(info.t_ns, placed, build.frame(drone)), info.t_ns
            )
        for key, image in instant.pictures:
            _, frame = _camera_of(key)
            self._log(
                f"/{frame}/image", channels.CompressedImageChannel, build.compressed_image(image, frame), image.t_ns
            )
        self._write_scene(instant)

    def _write_drone(self, instant: Instant, name: str) -> None:
        stamp, t_ns = build.timestamp(instant.t_ns), instant.t_ns
        truth, estimate = instant.truth.get(name), instant.estimates.get(name)
        for topic, state in ((f"/drone/{name}/pose", truth), (f"/drone/{name}/estimate", estimate)):
            if state is not None:
                placed = build.pose(state.position_m, state.orientation_wxyz)
                message = PoseInFrame(timestamp=stamp, frame_id=build.WORLD, pose=placed)
                self._log(topic, channels.PoseInFrameChannel, message, t_ns)
        status = self._status.get(name)
        values = build.drone_numbers(truth, estimate, status)
        encoded = self._drone.encode(values, (status.state if status else "",))
        self._log(f"/drone/{name}/numbers", self._drone, encoded, t_ns)

    def _write_cluster(self, instant: Instant, name: str, state: ClusterState) -> None:
        if name not in self.variables:
            tidied = [build.tidy(each) for each in state.names]
            fields = [f"{source}_{each}" for source in ("desired", "estimated", "true") for each in tidied]
            kind = NumericMessageType(f"Cluster_{build.tidy(name)}", [*fields, "margin"], ("phase", "reason"))
            self.variables[name] = kind
        numbers = self.variables[name]
        true = [math.nan] * len(state.names)  # replaced if space and truth are known and the shape is not singular
        space, truths = self._spaces.get(name), [instant.truth[d] for d in state.drones if d in instant.truth]
        if space is not None and space.names == state.names and len(truths) == len(state.drones):
            yaw = heading([truth.orientation_wxyz for truth in truths])
            with suppress(SingularClusterError):
                true = space.forward(np.array([truth.position_m for truth in truths]), yaw).tolist()
        values = [*state.desired, *state.value, *true, state.margin]
        if len(values) == len(numbers.numbers):  # nothing is written if the number of variables has changed
            encoded = numbers.encode(values, (state.phase, state.reason))
            self._log(f"/cluster/{name}/variables", numbers, encoded, instant.t_ns)

    def _write_scene(self, instant: Instant) -> None:
        t_ns, truth = instant.t_ns, instant.truth
        if truth and self._is_due(TRAILS, t_ns, TRAIL_STEP_NS):
            self._log(TRAILS, channels.SceneUpdateChannel, self._trails.update(t_ns, truth, self._colours), t_ns)
        if truth and self._is_due(POINTS, t_ns):
            points = [(state.position_m, self._colours.get(d, GREY)) for d, state in truth.items()]
            self._log(POINTS, channels.PointCloudChannel, build.points(t_ns, points), t_ns)
        if instant.states and self._is_due(FORMATIONS, t_ns):
            desired = {c: m for c, state in instant.states.items() if (m := self._places(c, state)) is not None}
            scene = build.formations(t_ns, instant.states, truth, desired)
            self._log(FORMATIONS, channels.SceneUpdateChannel, scene, t_ns)
            if desired:
                points = [(position, MAGENTA) for each in desired.values() for position in each.tolist()]
                self._log(DESIRED, channels.PointCloudChannel, build.points(t_ns, points), t_ns)
        if instant.estimates and self._is_due(ESTIMATES, t_ns):
            scene = build.ellipsoids(t_ns, instant.estimates, self._colours)
            self._log(ESTIMATES, channels.SceneUpdateChannel, scene, t_ns)

    def _places(self, name: str, state: ClusterState) -> Any:
        """Return the desired positions of a cluster's drones (n, 3); None if they are unknown or the shape singular."""
        space = self._spaces.get(name)
        if space is None or space.names != state.names or not any(state.desired):
            return None
        try:
            return space.inverse(np.array(state.desired))[0]
        except SingularClusterError:
            return None

    def _is_due(self, topic: str, t_ns: int, step_ns: int = SCENE_STEP_NS) -> bool:
        if t_ns < self._next_ns.get(topic, 0):
            return False
        self._next_ns[topic] = (t_ns // step_ns + 1) * step_ns
        return True

    def _log(self, topic: str, channel: Any, message: Any, t_ns: int) -> None:
        """Log a message on a topic; the topic's first message decides its channel or numeric type."""
        if topic not in self._channels:
            if isinstance(channel, NumericMessageType):
                schema = foxglove.Schema(name=channel.name, encoding="protobuf", data=channel.schema)
                new = foxglove.Channel(topic, schema=schema, message_encoding="protobuf", context=self._context)
            else:
                new = channel(topic, context=self._context)
            self._channels[topic] = new
        self._channels[topic].log(message, log_time=t_ns)
        self.counts[topic] += 1


def _camera_of(key: str) -> tuple[str, str]:
    """Return a camera's drone and frame from its key; its x is to the right of the image, y down, z forward."""
    _, drone, leaf = keys.parts(key)
    return drone, f"{build.frame(drone)}/{leaf.split('/')[1]}_camera"


class CheckedFile:
    """A file for a library that prints every failed write instead of raising an error.

    After a failed write, nothing more is written.

    Raises:
        OSError: the file cannot be created.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("xb")
        self._failure: OSError | None = None
        self._position = self._end = 0  # position and end of the file as the library sees them

    def write(self, data: bytes | bytearray) -> int:
        self._try(self._file.write, data)
        self._position += len(data)
        self._end = max(self._end, self._position)
        return len(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        self._try(self._file.seek, offset, whence)
        self._position = offset + {SEEK_SET: 0, SEEK_CUR: self._position, SEEK_END: self._end}[whence]
        return self._position

    def flush(self) -> None:
        self._try(self._file.flush)

    def check(self) -> None:
        """Raise the OSError of a failed write, if there was one."""
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """Close the file; raise OSError if a write has failed."""
        self.flush()
        try:
            self._file.close()
        finally:
            self.check()

    def _try(self, operation: Callable[..., object], *args: Any) -> None:
        if self._failure is None:
            try:
                operation(*args)
            except OSError as error:
                self._failure = error
