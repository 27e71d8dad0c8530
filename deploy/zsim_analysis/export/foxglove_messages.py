"""Foxglove messages built from those of a run: transforms, numbers, fixes, pictures, log, points and scenes.

Numbers are typed messages, which Foxglove plots and Rerun keeps as scalars. They are encoded as protobuf,
https://protobuf.dev/programming-guides/encoding, with a `FileDescriptorSet` of google/protobuf/descriptor.proto as
schema. As only two types of fields are needed, the protobuf library is not used.

At any time, Foxglove shows only the last message of a topic, so each scene message is complete.
"""

import math
import re
import struct
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from foxglove import messages as fox

from zsim.contract.flight_messages import CameraImage, CameraInfo, ClusterState, Estimate, Status, Truth
from zsim.contract.messages import Gps
from zsim.contract.run_messages import INCIDENTS, Event
from zsim.math.frames import heading, principal_axes, quaternion_from_rpy
from zsim.presentation import colours_of, rgb
from zsim_analysis.export.columns import Values

PACKAGE: Final = "zsim"
WORLD = "world"
DISTORTION_MODEL = "plumb_bob"  # k1, k2, p1, p2, k3, as in OpenCV
_BYTES, _EIGHT = 2, 1  # wire types: length-delimited, eight bytes
_DOUBLE, _STRING = 1, 9  # FieldDescriptorProto.Type
_OPTIONAL = 1  # FieldDescriptorProto.Label
_FLOAT = struct.Struct("<d")
FRAME = ("x_c", "y_c", "z_c", "roll", "pitch", "yaw")  # variables that give the pose of a cluster's frame
DRONE_NUMBERS = (
    *(f"{what}_{axis}_m" for what in ("true", "estimated") for axis in "xyz"),
    *(f"true_v{axis}_m_s" for axis in "xyz"),
    "true_yaw_rad",
    "estimated_yaw_rad",
    "error_m",
    "sigma_m",
    "battery_percent",
)
# event kinds by log level; all others are logged as information
WARNINGS = ("refused", "fingerprint", "outputs_missing", "fault", "landing")
FAILURES = ("collision", *INCIDENTS, "death", "failure", "overdue", "diverged")
_POINT = np.dtype([("position", "<f4", 3), ("colour", "u1", 4)])

FramePose = tuple[str, Any, Any]  # name of a frame, and its position and orientation in the parent frame
Vector = Sequence[float] | Values


class NumericMessageType:
    """A message type with float64 fields, then text fields, named by protobuf identifiers; unknown numbers are NaN."""

    def __init__(self, name: str, numbers: Sequence[str], texts: Sequence[str] = ()) -> None:
        self.name = f"{PACKAGE}.{name}"
        self.numbers = tuple(numbers)
        self._number_keys = [_key(tag, _EIGHT) for tag in range(1, len(numbers) + 1)]
        self._text_keys = [_key(len(numbers) + index, _BYTES) for index in range(1, len(texts) + 1)]
        fields = [*((each, _DOUBLE) for each in numbers), *((each, _STRING) for each in texts)]
        described = b""
        for number, (field, kind) in enumerate(fields, start=1):  # one FieldDescriptorProto each
            counted = ((3, number), (4, _OPTIONAL), (5, kind))
            number_keys = b"".join(_key(tag, 0) + _varint(value) for tag, value in counted)
            described += _bytes(2, _bytes(1, field.encode()) + number_keys)
        file = (
            _bytes(1, f"{PACKAGE}/{name}.proto".encode())
            + _bytes(2, PACKAGE.encode())
            + _bytes(4, _bytes(1, name.encode()) + described)
            + _bytes(12, b"proto3")
        )
        self.schema = _bytes(1, file)  # a FileDescriptorSet with this message only

    def encode(self, numbers: Iterable[float], texts: Iterable[str] = ()) -> bytes:
        parts = [key + _FLOAT.pack(value) for key, value in zip(self._number_keys, numbers, strict=True)]
        encoded = [text.encode() for text in texts]
        parts += [key + _varint(len(text)) + text for key, text in zip(self._text_keys, encoded, strict=True)]
        return b"".join(parts)


def _bytes(field: int, content: bytes) -> bytes:
    return _key(field, _BYTES) + _varint(len(content)) + content


def _key(field: int, wire_type: int) -> bytes:
    return _varint(field << 3 | wire_type)


def _varint(value: int) -> bytes:
    """Encode a varint: seven bits per byte, lowest first, with the eighth bit set if more bytes follow."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def tidy(name: str) -> str:
    """Return a name in a form that fits into a protobuf identifier."""
    return re.sub(r"\W", "_", name)


def drone_numbers(truth: Truth | None, estimate: Estimate | None, status: Status | None) -> list[float]:
    """Return the values of DRONE_NUMBERS, with NaN for unknown ones."""
    nothing = [math.nan] * 3
    true = list(truth.position_m) if truth else nothing
    estimated = list(estimate.position_m) if estimate else nothing
    variance = sum(estimate.covariance[i] for i in (0, 7, 14)) if estimate else math.nan
    return [
        *true,
        *estimated,
        *(truth.velocity_m_s if truth else nothing),
        float(heading(truth.orientation_wxyz)) if truth else math.nan,
        estimate.yaw_rad if estimate else math.nan,
        math.dist(true, estimated),
        math.sqrt(max(variance, 0.0)) if estimate else math.nan,
        status.battery_percent if status else math.nan,
    ]


# Parts of messages


def timestamp(t_ns: int) -> fox.Timestamp:
    return fox.Timestamp(t_ns // 10**9, t_ns % 10**9)


def vector(v: Vector) -> fox.Vector3:
    x, y, z = map(float, v)
    return fox.Vector3(x=x, y=y, z=z)


def quaternion(wxyz: Vector) -> fox.Quaternion:
    w, x, y, z = map(float, wxyz)
    return fox.Quaternion(x=x, y=y, z=z, w=w)


def pose(position: Vector, wxyz: Vector = (1.0, 0.0, 0.0, 0.0)) -> fox.Pose:
    return fox.Pose(position=vector(position), orientation=quaternion(wxyz))


def colour(text: str, opacity: float = 1.0) -> fox.Color:
    """Return the colour of `#rrggbb`."""
    red, green, blue = (part / 255 for part in rgb(text))
    return fox.Color(r=red, g=green, b=blue, a=opacity)


def frame(drone: str) -> str:
    return f"drone/{drone}"


# Messages


def transforms(t_ns: int, frames: Iterable[FramePose], parent: str = WORLD) -> fox.FrameTransforms:
    placed = []
    for child, position, orientation in frames:
        pose: dict[str, Any] = {"translation": vector(position), "rotation": quaternion(orientation)}
        names = {"parent_frame_id": parent, "child_frame_id": child}
        placed.append(fox.FrameTransform(timestamp=timestamp(t_ns), **names, **pose))
    return fox.FrameTransforms(transforms=placed)


def cluster_frame(names: Sequence[str], values: Sequence[float]) -> tuple[Values, Values] | None:
    """Return position and orientation of a cluster's frame; None if it has none or its pose is not yet known."""
    if not any(values) or not set(FRAME) <= set(names):
        return None
    x_c = np.array([values[names.index(name)] for name in FRAME])
    return x_c[:3], quaternion_from_rpy(x_c[3:])


def location_fix(gps: Gps, drone: str, tint: str) -> fox.LocationFix:
    """Return the position measured by a drone's GPS, in the drone's colour."""
    variance = gps.sigma_m**2
    return fox.LocationFix(
        timestamp=timestamp(max(0, gps.t_sample_ns)),
        frame_id=frame(drone),
        latitude=gps.latitude_deg,
        longitude=gps.longitude_deg,
        altitude=gps.altitude_m,
        position_covariance=[variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance],
        position_covariance_type=fox.LocationFixPositionCovarianceType.DiagonalKnown,
        color=colour(tint),
    )


def compressed_image(image: CameraImage, frame_id: str) -> fox.CompressedImage:
    stamp = timestamp(max(0, image.t_sample_ns))
    return fox.CompressedImage(timestamp=stamp, frame_id=frame_id, data=image.data, format=image.format)


def camera_calibration(info: CameraInfo, frame_id: str) -> fox.CameraCalibration:
    """Return the calibration of a camera that is not part of a stereo pair."""
    return fox.CameraCalibration(
        timestamp=timestamp(info.t_ns),
        frame_id=frame_id,
        width=info.width,
        height=info.height,
        distortion_model=DISTORTION_MODEL,
        D=list(info.D),
        K=list(info.K),
        R=np.eye(3).ravel().tolist(),
        P=np.column_stack([np.reshape(info.K, (3, 3)), np.zeros(3)]).ravel().tolist(),
    )


def log_line(event: Event) -> fox.Log:
    level = fox.LogLevel.Warning if event.kind in WARNINGS else fox.LogLevel.Info
    level = fox.LogLevel.Error if event.kind in FAILURES else level
    text = f"{event.kind}: {event.text}"
    return fox.Log(timestamp=timestamp(event.t_ns), level=level, message=text, name=event.source, file=event.subject)


def points(t_ns: int, coloured: Iterable[tuple[Sequence[float], str]]) -> fox.PointCloud:
    """Return coloured points in W."""
    kinds = fox.PackedElementFieldNumericType
    fields = [fox.PackedElementField(name=n, offset=4 * i, type=kinds.Float32) for i, n in enumerate("xyz")]
    fields += [
        fox.PackedElementField(name=n, offset=12 + i, type=kinds.Uint8)
        for i, n in enumerate(("red", "green", "blue", "alpha"))
    ]
    return fox.PointCloud(
        timestamp=timestamp(t_ns),
        frame_id=WORLD,
        pose=pose((0.0, 0.0, 0.0)),
        point_stride=_POINT.itemsize,
        fields=fields,
        data=np.array([(position, (*rgb(tint), 255)) for position, tint in coloured], _POINT).tobytes(),
    )


# Scenes

MAGENTA, DARK, GREY = "#d4008f", "#30363d", "#8c959f"
TRAIL_S = 20.0  # simulated time covered by a trail
TRAIL_STEP_NS = 500_000_000  # interval between points of a trail, and between messages with trails
SIGMAS = 2.0  # semi-axes of an estimate's ellipsoid in standard deviations
LINE_PX = 2.0  # width of lines on screen
GROUND_M, GROUND_STEP_M = 50, 5  # half the width of the grid on the ground, and its spacing


class RotorDisc(NamedTuple):
    """A rotor as it is drawn: its position in B, and its radius."""

    x_m: float
    y_m: float
    radius_m: float


class BodyBox(NamedTuple):
    """A box of a drone's body: centre and size in B, in arm lengths, and colour."""

    middle: tuple[float, float, float]
    size: tuple[float, float, float]
    colour: str


BODY = (
    BodyBox((0.0, 0.0, 0.0), (1.0, 0.4, 0.3), DARK),
    BodyBox((0.35, 0.0, 0.1), (0.5, 0.3, 0.2), MAGENTA),  # the nose, like an AR.Drone's hull over battery and camera
)


def arm_of(discs: Iterable[RotorDisc]) -> float:
    """Return the length of a drone's longest arm [m]."""
    return max(math.hypot(disc.x_m, disc.y_m) for disc in discs)


def drones(t_ns: int, rotors: Mapping[str, Sequence[RotorDisc]]) -> fox.SceneUpdate:
    """Return all drones, each in its own frame, so that one message suffices; `rotors` are by drone."""
    stamp, entities = timestamp(t_ns), []
    for name, mark in colours_of(rotors).items():
        discs = rotors[name]
        arm_m = arm_of(discs)
        cubes, cylinders = [], []
        for box in BODY:
            middle, size = ([arm_m * each for each in part] for part in (box.middle, box.size))
            cubes.append(fox.CubePrimitive(pose=pose(middle), size=vector(size), color=colour(box.colour)))
        for disc in discs:
            size = vector((2 * disc.radius_m, 2 * disc.radius_m, 0.03 * arm_m))
            look: dict[str, Any] = {"bottom_scale": 1.0, "top_scale": 1.0, "color": colour(mark, 0.5)}
            cylinders.append(fox.CylinderPrimitive(pose=pose((disc.x_m, disc.y_m, 0.2 * arm_m)), size=size, **look))
        ends = [end for disc in discs for end in ((0.0, 0.0, 0.0), (disc.x_m, disc.y_m, 0.0))]
        arms = _line(ends, colour(DARK), fox.LinePrimitiveLineType.LineList, 0.1 * arm_m, scale_invariant=False)
        look = {"billboard": True, "font_size": 12.0, "scale_invariant": True, "color": colour(mark)}
        label = fox.TextPrimitive(pose=pose((0, 0, 2 * arm_m)), text=name, **look)
        parts: dict[str, Any] = {"cubes": cubes, "cylinders": cylinders, "lines": [arms], "texts": [label]}
        entities.append(fox.SceneEntity(timestamp=stamp, id=name, frame_id=frame(name), frame_locked=True, **parts))
    return fox.SceneUpdate(entities=entities)


def ground(t_ns: int) -> fox.SceneUpdate:
    marks = range(-GROUND_M, GROUND_M + 1, GROUND_STEP_M)
    ends = [end for a in marks for end in ((a, -GROUND_M, 0), (a, GROUND_M, 0))]
    ends += [end for a in marks for end in ((-GROUND_M, a, 0), (GROUND_M, a, 0))]
    grid = _line(ends, colour(GREY, 0.4), fox.LinePrimitiveLineType.LineList, 1.0)
    return fox.SceneUpdate(entities=[_entity(timestamp(t_ns), "ground", lines=[grid])])


def formations(
    t_ns: int, states: Mapping[str, ClusterState], truth: Mapping[str, Truth], desired_m: Mapping[str, Values]
) -> fox.SceneUpdate:
    """Return the outline of each cluster's drones, and ghosts at their desired positions (n, 3), where known."""
    stamp, entities = timestamp(t_ns), []
    for name, state in states.items():
        lines, ghosts = [], []
        positions = [truth[drone].position_m for drone in state.drones if drone in truth]
        if len(positions) > 1:
            lines.append(_line(positions, colour(DARK), fox.LinePrimitiveLineType.LineLoop))
        if name in desired_m:
            lines.append(_line(desired_m[name], colour(MAGENTA, 0.6), fox.LinePrimitiveLineType.LineLoop))
            ghosts = [
                fox.SpherePrimitive(pose=pose(position), size=vector((0.5, 0.5, 0.2)), color=colour(MAGENTA, 0.3))
                for position in desired_m[name]
            ]
        entities.append(_entity(stamp, name, lines=lines, spheres=ghosts))
    return fox.SceneUpdate(entities=entities)


def ellipsoids(t_ns: int, estimates: Mapping[str, Estimate], colours: Mapping[str, str]) -> fox.SceneUpdate:
    """Return ellipsoids of SIGMAS standard deviations around the estimated positions."""
    stamp, entities = timestamp(t_ns), []
    for name, estimate in estimates.items():
        sigma_m, axes = principal_axes(np.array(estimate.covariance).reshape(6, 6)[:3, :3])
        ellipsoid = fox.SpherePrimitive(
            pose=pose(estimate.position_m, axes),
            size=vector([2.0 * SIGMAS * each for each in sigma_m]),
            color=colour(colours.get(name, GREY), 0.25),
        )
        entities.append(_entity(stamp, name, spheres=[ellipsoid]))
    return fox.SceneUpdate(entities=entities)


class DroneTrails:
    """The last seconds of each drone's path."""

    def __init__(self) -> None:
        self._paths: dict[str, deque[Sequence[float]]] = {}
        self._length = round(TRAIL_S * 1e9) // TRAIL_STEP_NS + 1

    def update(self, t_ns: int, truth: Mapping[str, Truth], colours: Mapping[str, str]) -> fox.SceneUpdate:
        stamp, entities = timestamp(t_ns), []
        for name, state in truth.items():
            path = self._paths.setdefault(name, deque(maxlen=self._length))
            path.append(state.position_m)
            trail = _line(path, colour(colours.get(name, GREY), 0.7), fox.LinePrimitiveLineType.LineStrip)
            entities.append(_entity(stamp, name, lines=[trail]))
        return fox.SceneUpdate(entities=entities)


def _line(
    points: Iterable[Any],
    tint: fox.Color,
    kind: fox.LinePrimitiveLineType,
    width: float = LINE_PX,
    scale_invariant: bool = True,
) -> fox.LinePrimitive:
    """Return a line whose `width` is in pixels if `scale_invariant`, otherwise in metres."""
    corners = [fox.Point3(x=x, y=y, z=z) for x, y, z in (map(float, each) for each in points)]
    look: dict[str, Any] = {"thickness": width, "scale_invariant": scale_invariant, "color": tint}
    return fox.LinePrimitive(type=kind, pose=pose((0, 0, 0)), points=corners, **look)


def _entity(stamp: fox.Timestamp, name: str, **parts: Any) -> fox.SceneEntity:
    return fox.SceneEntity(timestamp=stamp, id=name, frame_id=WORLD, **parts)
