"""What is written on the topics: Foxglove's messages, and the numbers of a drone. Pure."""

import math
import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from foxglove.messages import (
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

from zsim.contract.messages import Estimate, Event, Gps, Status, Truth
from zsim.math.frames import heading, quaternion_from_rpy
from zsim_analysis.export.columns import Values
from zsim_analysis.export.foxglove import scene_entities
from zsim_analysis.export.foxglove.shapes import colour, drone_colour, pose, quaternion, rgb, timestamp, vector

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
LEVELS = {  # of events; the others are told as information
    "refused": LogLevel.Warning,
    "fingerprint": LogLevel.Warning,
    "outputs_missing": LogLevel.Warning,
    "fault": LogLevel.Warning,
    "death": LogLevel.Error,
    "collision": LogLevel.Error,
    "diverged": LogLevel.Error,
}
_POINT = np.dtype([("position", "<f4", 3), ("colour", "u1", 4)])

Placed = tuple[str, Any, Any]  # a frame's name, its position in W and its orientation


def transforms(t_ns: int, frames: Iterable[Placed]) -> FrameTransforms:
    """Return where frames are in W."""
    at = timestamp(t_ns)
    made = [
        FrameTransform(
            timestamp=at,
            parent_frame_id=scene_entities.WORLD,
            child_frame_id=child,
            translation=vector(position),
            rotation=quaternion(orientation),
        )
        for child, position, orientation in frames
    ]
    return FrameTransforms(transforms=made)


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


def fix(gps: Gps, drone: str, index: int) -> LocationFix:
    """Return where a drone's GPS says it is, in the colour of the scenario's drone `index`."""
    variance = gps.sigma_m**2
    return LocationFix(
        timestamp=timestamp(max(0, gps.t_sample_ns)),
        frame_id=scene_entities.frame(drone),
        latitude=gps.latitude_deg,
        longitude=gps.longitude_deg,
        altitude=gps.altitude_m,
        position_covariance=[variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance],
        position_covariance_type=LocationFixPositionCovarianceType.DiagonalKnown,
        color=colour(drone_colour(index)),
    )


def log_line(event: Event) -> Log:
    """Return an event as a line of the log."""
    level = LEVELS.get(event.kind, LogLevel.Info)
    text = f"{event.kind}: {event.text}"
    return Log(timestamp=timestamp(event.t_ns), level=level, message=text, name=event.source, file=event.subject)


def points(t_ns: int, places: Iterable[tuple[Sequence[float], str]]) -> PointCloud:
    """Return coloured points in W."""
    rows = [(place, (*(round(255 * part) for part in rgb(tint)), 255)) for place, tint in places]
    kinds = PackedElementFieldNumericType
    fields = [PackedElementField(name=n, offset=4 * i, type=kinds.Float32) for i, n in enumerate("xyz")]
    fields += [
        PackedElementField(name=n, offset=12 + i, type=kinds.Uint8)
        for i, n in enumerate(("red", "green", "blue", "alpha"))
    ]
    return PointCloud(
        timestamp=timestamp(t_ns),
        frame_id=scene_entities.WORLD,
        pose=pose((0.0, 0.0, 0.0)),
        point_stride=_POINT.itemsize,
        fields=fields,
        data=np.array(rows, _POINT).tobytes(),
    )
