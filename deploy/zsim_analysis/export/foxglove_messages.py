"""Foxglove's messages of a run, and typed messages of numbers, which Foxglove plots and Rerun keeps as scalars. Pure.

Numbers are encoded as protobuf, https://protobuf.dev/programming-guides/encoding, with a `FileDescriptorSet` of
google/protobuf/descriptor.proto as schema. Only two kinds of fields are needed, so protobuf's library is not.
"""

import math
import re
import struct
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
from foxglove.messages import (
    CameraCalibration,
    CompressedImage,
    FrameTransform,
    FrameTransforms,
    LocationFix,
    LocationFixPositionCovarianceType,
    Log,
    LogLevel,
    PackedElementField,
    PackedElementFieldNumericType,
    PointCloud,
)

from zsim.contract.flight_messages import CameraImage, CameraInfo, Estimate, Status, Truth
from zsim.contract.messages import Gps
from zsim.contract.run_messages import Event
from zsim.math.frames import heading, quaternion_from_rpy
from zsim_analysis.export.foxglove_scene import (
    WORLD,
    colour,
    frame,
    pose,
    quaternion,
    rgb,
    timestamp,
    vector,
)
from zsim_analysis.export.message_columns import Values

PACKAGE: Final = "zsim"
DISTORTION_MODEL = "plumb_bob"  # k1, k2, p1, p2, k3, as OpenCV has them
_BYTES, _EIGHT = 2, 1  # wire types: bytes after their length, eight bytes
_DOUBLE, _STRING = 1, 9  # FieldDescriptorProto.Type
_OPTIONAL = 1  # FieldDescriptorProto.Label
_FLOAT = struct.Struct("<d")
FRAME = ("x_c", "y_c", "z_c", "roll", "pitch", "yaw")  # variables that place a cluster's frame
DRONE_NUMBERS = (
    *(f"{what}_{axis}_m" for what in ("true", "estimated") for axis in "xyz"),
    *(f"true_v{axis}_m_s" for axis in "xyz"),
    "true_yaw_rad",
    "estimated_yaw_rad",
    "error_m",
    "sigma_m",
    "battery_percent",
)
LEVELS = {  # of events; the others are information
    "refused": LogLevel.Warning,
    "fingerprint": LogLevel.Warning,
    "outputs_missing": LogLevel.Warning,
    "fault": LogLevel.Warning,
    "landing": LogLevel.Warning,
    "death": LogLevel.Error,
    "failure": LogLevel.Error,
    "overdue": LogLevel.Error,
    "collision": LogLevel.Error,
    "emergency": LogLevel.Error,
    "flip": LogLevel.Error,
    "impact": LogLevel.Error,
    "touchdown": LogLevel.Error,
    "battery": LogLevel.Error,
    "diverged": LogLevel.Error,
}
_POINT = np.dtype([("position", "<f4", 3), ("colour", "u1", 4)])

FramePose = tuple[str, Any, Any]  # a frame's name, its position in W and its orientation


class NumericMessageType:
    """A message of float64 fields, then of text fields; an unknown number is NaN.

    Args:
        name: of the message, a protobuf identifier.
        numbers: names of the numeric fields, protobuf identifiers.
        texts: names of the text fields.
    """

    def __init__(self, name: str, numbers: Sequence[str], texts: Sequence[str] = ()) -> None:
        self.name = f"{PACKAGE}.{name}"
        self.numbers = tuple(numbers)
        self.texts = tuple(texts)
        tags = range(1, len(self.numbers) + 1)
        self._heads = [_key(tag, _EIGHT) for tag in tags]
        self._text_keys = [_key(len(self.numbers) + place, _BYTES) for place in range(1, len(self.texts) + 1)]
        self.schema = _file(name, [*((n, _DOUBLE) for n in self.numbers), *((t, _STRING) for t in self.texts)])

    def encode(self, numbers: Iterable[float], texts: Iterable[str] = ()) -> bytes:
        """Return a message of values in the order of the fields."""
        parts = [head + _FLOAT.pack(value) for head, value in zip(self._heads, numbers, strict=True)]
        encoded = [text.encode() for text in texts]
        parts += [key + _varint(len(text)) + text for key, text in zip(self._text_keys, encoded, strict=True)]
        return b"".join(parts)


def _file(name: str, fields: Iterable[tuple[str, int]]) -> bytes:
    """Return a FileDescriptorSet of one message with fields of these names and types, counted from 1."""
    described = b"".join(_bytes(2, _field(*field, place)) for place, field in enumerate(fields, start=1))
    message = _bytes(1, name.encode()) + described
    file = (
        _bytes(1, f"{PACKAGE}/{name}.proto".encode())
        + _bytes(2, PACKAGE.encode())
        + _bytes(4, message)
        + _bytes(12, b"proto3")
    )
    return _bytes(1, file)


def _field(name: str, kind: int, number: int) -> bytes:
    """Return a FieldDescriptorProto."""
    counted = ((3, number), (4, _OPTIONAL), (5, kind))
    return _bytes(1, name.encode()) + b"".join(_key(field, 0) + _varint(value) for field, value in counted)


def _bytes(field: int, content: bytes) -> bytes:
    return _key(field, _BYTES) + _varint(len(content)) + content


def _key(field: int, wire_type: int) -> bytes:
    return _varint(field << 3 | wire_type)


def _varint(value: int) -> bytes:
    """Return seven bits a byte, the lowest first, the eighth bit set where more follow."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def transforms(t_ns: int, frames: Iterable[FramePose], parent: str = WORLD) -> FrameTransforms:
    """Return where frames are in another, W unless it is given."""
    at = timestamp(t_ns)
    frame_transforms = [
        FrameTransform(
            timestamp=at,
            parent_frame_id=parent,
            child_frame_id=child,
            translation=vector(position),
            rotation=quaternion(orientation),
        )
        for child, position, orientation in frames
    ]
    return FrameTransforms(transforms=frame_transforms)


def drone_numbers(truth: Truth | None, estimate: Estimate | None, status: Status | None) -> list[float]:
    """Return the values of DRONE_NUMBERS, NaN where one is not known."""
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


def tidy(name: str) -> str:
    """Return a name as part of a protobuf identifier."""
    return re.sub(r"\W", "_", name)


def cluster_frame(names: Sequence[str], values: Sequence[float]) -> tuple[Values, Values] | None:
    """Return position and orientation of a cluster's frame, None where it has none or it is not known yet."""
    if not any(values) or not set(FRAME) <= set(names):
        return None
    x_c = np.array([values[names.index(name)] for name in FRAME])
    return x_c[:3], quaternion_from_rpy(x_c[3:])


def location_fix(gps: Gps, drone: str, tint: str) -> LocationFix:
    """Return the position that a drone's GPS measured, in the drone's colour."""
    variance = gps.sigma_m**2
    return LocationFix(
        timestamp=timestamp(max(0, gps.t_sample_ns)),
        frame_id=frame(drone),
        latitude=gps.latitude_deg,
        longitude=gps.longitude_deg,
        altitude=gps.altitude_m,
        position_covariance=[variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance],
        position_covariance_type=LocationFixPositionCovarianceType.DiagonalKnown,
        color=colour(tint),
    )


def compressed_image(image: CameraImage, frame_id: str) -> CompressedImage:
    """Return a picture, at the time of its exposure."""
    at = timestamp(max(0, image.t_sample_ns))
    return CompressedImage(timestamp=at, frame_id=frame_id, data=image.data, format=image.format)


def camera_calibration(info: CameraInfo, frame_id: str) -> CameraCalibration:
    """Return what a camera's pixels mean; it is no part of a stereo pair."""
    return CameraCalibration(
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


def log_line(event: Event) -> Log:
    """Return an event as a line of the log."""
    level = LEVELS.get(event.kind, LogLevel.Info)
    text = f"{event.kind}: {event.text}"
    return Log(timestamp=timestamp(event.t_ns), level=level, message=text, name=event.source, file=event.subject)


def points(t_ns: int, coloured: Iterable[tuple[Sequence[float], str]]) -> PointCloud:
    """Return coloured points in W."""
    rows = [(position, (*(round(255 * part) for part in rgb(tint)), 255)) for position, tint in coloured]
    kinds = PackedElementFieldNumericType
    fields = [PackedElementField(name=n, offset=4 * i, type=kinds.Float32) for i, n in enumerate("xyz")]
    fields += [
        PackedElementField(name=n, offset=12 + i, type=kinds.Uint8)
        for i, n in enumerate(("red", "green", "blue", "alpha"))
    ]
    return PointCloud(
        timestamp=timestamp(t_ns),
        frame_id=WORLD,
        pose=pose((0.0, 0.0, 0.0)),
        point_stride=_POINT.itemsize,
        fields=fields,
        data=np.array(rows, _POINT).tobytes(),
    )
