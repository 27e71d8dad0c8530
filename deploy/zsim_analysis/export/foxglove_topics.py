"""The topics of the Foxglove file, and the messages on each at an instant."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from os import SEEK_CUR, SEEK_END, SEEK_SET
from pathlib import Path
from typing import Any

import foxglove
import numpy as np
from foxglove.channels import (
    CameraCalibrationChannel,
    CompressedImageChannel,
    FrameTransformsChannel,
    LocationFixChannel,
    LogChannel,
    PointCloudChannel,
    PoseInFrameChannel,
    SceneUpdateChannel,
)
from foxglove.messages import PoseInFrame

from zsim.contract import keys
from zsim.contract.flight_messages import ClusterState, Status
from zsim.math.frames import heading
from zsim.presentation import colours_of
from zsim_agents.formation.spaces.cluster_space import ClusterSpace, SingularClusterError
from zsim_analysis.export import foxglove_messages, foxglove_scene
from zsim_analysis.export.foxglove_messages import NumericMessageType
from zsim_analysis.export.foxglove_scene import GREY, MAGENTA, Instant, RotorDisc, pose, timestamp

TF, LOG, DRONES, GROUND, TRAILS = "/tf", "/log", "/scene/drones", "/scene/ground", "/scene/trails"
FORMATIONS, ESTIMATES = "/scene/formations", "/scene/estimates"
POINTS, DESIRED = "/points/drones", "/points/desired"
SCENE_STEP_NS = 100_000_000  # between two pictures of what is drawn


class CheckedFile:
    """A file for a library that prints a failed write, at every write again, rather than raise it.

    Once a write has failed, nothing more is written.

    Args:
        path: of the file, new.

    Raises:
        OSError: it cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("xb")
        self._failure: OSError | None = None
        self._at = self._end = 0  # position and end of the file as the library knows them

    def write(self, data: bytes | bytearray) -> int:
        """Write bytes; return how many."""
        self._try(self._file.write, data)
        self._at += len(data)
        self._end = max(self._end, self._at)
        return len(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        """Set the position; return it."""
        self._try(self._file.seek, offset, whence)
        self._at = offset + {SEEK_SET: 0, SEEK_CUR: self._at, SEEK_END: self._end}[whence]
        return self._at

    def flush(self) -> None:
        """Write what is buffered."""
        self._try(self._file.flush)

    def check(self) -> None:
        """Raise the error of a failed write.

        Raises:
            OSError: a write has failed.
        """
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """End the file.

        Raises:
            OSError: a write has failed.
        """
        self.flush()
        try:
            self._file.close()
        finally:
            self.check()

    def _try(self, act: Callable[..., object], *args: Any) -> None:
        if self._failure is None:
            try:
                act(*args)
            except OSError as error:
                self._failure = error


def _camera_of(key: str) -> tuple[str, str, str]:
    """Return drone, camera and frame of a camera's key."""
    _, drone, what = keys.parts(key)
    camera = what.split("/")[1]
    return drone, camera, foxglove_scene.camera_frame(drone, camera)


class FoxgloveFile:
    """An MCAP file that is being written.

    Args:
        path: of the file, new.
        rotors: by drone, in the order of the scenario, what it is drawn with.
        spaces: the cluster space of each cluster that has one.

    Attributes:
        counts: messages by topic.
    """

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
        self._variables: dict[str, NumericMessageType] = {}
        self._drone = NumericMessageType("Drone", foxglove_messages.DRONE_NUMBERS, ("state",))
        self._trails = foxglove_scene.DroneTrails()
        self._status: dict[str, Status] = {}
        self._next_ns: dict[str, int] = {}
        self._has_static_scene = False
        self.counts: Counter[str] = Counter()

    def close(self) -> None:
        """End the file.

        Raises:
            OSError: it could not be written.
        """
        self._file.close()
        self._checked_file.close()

    def variables(self) -> dict[str, tuple[str, ...]]:
        """Return the names of the fields that are plotted of each cluster."""
        return {name: numbers.numbers for name, numbers in self._variables.items()}

    def write(self, instant: Instant) -> None:
        """Write all that is shown of an instant.

        Raises:
            OSError: it could not be written.
        """
        self._checked_file.check()
        self._status.update(instant.status)
        if not self._has_static_scene and instant.truth:
            self._log(DRONES, SceneUpdateChannel, foxglove_scene.drones(instant.t_ns, self._rotors), instant.t_ns)
            self._log(GROUND, SceneUpdateChannel, foxglove_scene.ground(instant.t_ns), instant.t_ns)
            self._has_static_scene = True
        self._write_frames(instant)
        for name in dict.fromkeys([*instant.truth, *instant.estimates]):
            self._write_drone(instant, name)
        for name, gps in instant.gps.items():
            fix = foxglove_messages.location_fix(gps, name, self._colours.get(name, GREY))
            self._log(f"/drone/{name}/gps", LocationFixChannel, fix, gps.t_ns)
        for name, state in instant.states.items():
            self._write_cluster(instant, name, state)
        for event in instant.events:
            self._log(LOG, LogChannel, foxglove_messages.log_line(event), event.t_ns)
        self._write_cameras(instant)
        self._write_scene(instant)

    def _write_cameras(self, instant: Instant) -> None:
        for key, info in instant.cameras:
            drone, camera, frame_id = _camera_of(key)
            calibration = foxglove_messages.camera_calibration(info, frame_id)
            self._log(f"/drone/{drone}/{camera}_camera/calibration", CameraCalibrationChannel, calibration, info.t_ns)
            placed = [(frame_id, info.position_m, info.orientation_wxyz)]
            fixed = foxglove_messages.transforms(info.t_ns, placed, foxglove_scene.frame(drone))
            self._log(TF, FrameTransformsChannel, fixed, info.t_ns)
        for key, image in instant.pictures:
            drone, camera, frame_id = _camera_of(key)
            picture = foxglove_messages.compressed_image(image, frame_id)
            self._log(f"/drone/{drone}/{camera}_camera/image", CompressedImageChannel, picture, image.t_ns)

    def _write_frames(self, instant: Instant) -> None:
        frames = [(foxglove_scene.frame(d), t.position_m, t.orientation_wxyz) for d, t in instant.truth.items()]
        frames += [
            (f"{foxglove_scene.frame(d)}/estimate", e.position_m, e.orientation_wxyz)
            for d, e in instant.estimates.items()
        ]
        for name, state in instant.states.items():
            for end, values in (("", state.value), ("/desired", state.desired)):
                placed = foxglove_messages.cluster_frame(state.names, values)
                frames += [(f"cluster/{name}{end}", *placed)] if placed else []
        if frames:
            self._log(TF, FrameTransformsChannel, foxglove_messages.transforms(instant.t_ns, frames), instant.t_ns)

    def _write_drone(self, instant: Instant, name: str) -> None:
        at, t_ns = timestamp(instant.t_ns), instant.t_ns
        truth, estimate = instant.truth.get(name), instant.estimates.get(name)
        for topic, state in ((f"/drone/{name}/pose", truth), (f"/drone/{name}/estimate", estimate)):
            if state is not None:
                placed = pose(state.position_m, state.orientation_wxyz)
                message = PoseInFrame(timestamp=at, frame_id=foxglove_scene.WORLD, pose=placed)
                self._log(topic, PoseInFrameChannel, message, t_ns)
        status = self._status.get(name)
        values = foxglove_messages.drone_numbers(truth, estimate, status)
        encoded = self._drone.encode(values, (status.state if status else "",))
        self._log_numbers(f"/drone/{name}/numbers", self._drone, encoded, t_ns)

    def _write_cluster(self, instant: Instant, name: str, state: ClusterState) -> None:
        if name not in self._variables:
            tidied = [foxglove_messages.tidy(each) for each in state.names]
            fields = [f"{what}_{each}" for what in ("desired", "estimated", "true") for each in tidied]
            self._variables[name] = NumericMessageType(
                f"Cluster_{foxglove_messages.tidy(name)}", [*fields, "margin"], ("phase", "reason")
            )
        numbers = self._variables[name]
        true = self._true(instant, name, state)
        values = [*state.desired, *state.value, *true, state.margin]
        if len(values) == len(numbers.numbers):  # of variables that change their number, the first ones are plotted
            encoded = numbers.encode(values, (state.phase, state.reason))
            self._log_numbers(f"/cluster/{name}/variables", numbers, encoded, instant.t_ns)

    def _true(self, instant: Instant, name: str, state: ClusterState) -> Sequence[float]:
        """Return the cluster variables of where the drones truly are, NaN where they have none."""
        unknown = [math.nan] * len(state.names)
        space = self._spaces.get(name)
        if space is None or space.names != state.names or not all(drone in instant.truth for drone in state.drones):
            return unknown
        truths = [instant.truth[drone] for drone in state.drones]
        yaw = heading([truth.orientation_wxyz for truth in truths])
        try:
            return space.forward(np.array([truth.position_m for truth in truths]), yaw).tolist()
        except SingularClusterError:
            return unknown

    def _write_scene(self, instant: Instant) -> None:
        if instant.truth and self._is_due(TRAILS, instant.t_ns, foxglove_scene.TRAIL_STEP_NS):
            self._log(TRAILS, SceneUpdateChannel, self._trails.update(instant, self._colours), instant.t_ns)
        if instant.truth and self._is_due(POINTS, instant.t_ns, SCENE_STEP_NS):
            places = [(truth.position_m, self._colours.get(d, GREY)) for d, truth in instant.truth.items()]
            self._log(POINTS, PointCloudChannel, foxglove_messages.points(instant.t_ns, places), instant.t_ns)
        if instant.states and self._is_due(FORMATIONS, instant.t_ns, SCENE_STEP_NS):
            desired = {c: m for c, state in instant.states.items() if (m := self._places(c, state)) is not None}
            self._log(FORMATIONS, SceneUpdateChannel, foxglove_scene.formations(instant, desired), instant.t_ns)
            if desired:
                places = [(place, MAGENTA) for each in desired.values() for place in each.tolist()]
                self._log(DESIRED, PointCloudChannel, foxglove_messages.points(instant.t_ns, places), instant.t_ns)
        if instant.estimates and self._is_due(ESTIMATES, instant.t_ns, SCENE_STEP_NS):
            self._log(ESTIMATES, SceneUpdateChannel, foxglove_scene.estimates(instant, self._colours), instant.t_ns)

    def _places(self, name: str, state: ClusterState) -> Any:
        """Return the desired positions of a cluster's drones (n, 3), None where they are not known."""
        space = self._spaces.get(name)
        if space is None or space.names != state.names or not any(state.desired):
            return None
        try:
            return space.inverse(np.array(state.desired))[0]
        except SingularClusterError:
            return None

    def _is_due(self, topic: str, t_ns: int, step_ns: int) -> bool:
        if t_ns < self._next_ns.get(topic, 0):
            return False
        self._next_ns[topic] = (t_ns // step_ns + 1) * step_ns
        return True

    def _log(self, topic: str, channel: Any, message: Any, t_ns: int) -> None:
        if topic not in self._channels:
            self._channels[topic] = channel(topic, context=self._context)
        self._channels[topic].log(message, log_time=t_ns)
        self.counts[topic] += 1

    def _log_numbers(self, topic: str, numbers: NumericMessageType, encoded: bytes, t_ns: int) -> None:
        if topic not in self._channels:
            schema = foxglove.Schema(name=numbers.name, encoding="protobuf", data=numbers.schema)
            self._channels[topic] = foxglove.Channel(
                topic, schema=schema, message_encoding="protobuf", context=self._context
            )
        self._channels[topic].log(encoded, log_time=t_ns)
        self.counts[topic] += 1
