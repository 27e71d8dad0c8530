"""Frames as REP-103 and REP-105 have them, and where a drone's sensors stand in its body.

map is W (east, north, up). Of each drone: `NAME/odom`, in which its estimate is told (it lies on map, since the
estimate is of W), `NAME/base_link` (forward, left, up), and a frame for each sensor. Quaternions are w first.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from zsim.contract.messages import Quaternion, Vector3
from zsim.math.frames import quaternion_from_rpy, quaternion_multiply
from zsim.scenario.scenario import Mount, Sensors

MAP = "map"
UNTURNED: Quaternion = (1.0, 0.0, 0.0, 0.0)
# A sonar looks along -z of its sensor frame; the x axis of a ROS range finder is its beam: turned by 90 deg about y.
_ALONG_BEAM = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)


class FramePose(NamedTuple):
    """Where a frame stands in another one."""

    parent: str
    child: str
    position_m: Vector3
    orientation_wxyz: Quaternion


def odom(drone: str) -> str:
    return f"{drone}/odom"


def base(drone: str) -> str:
    return f"{drone}/base_link"


def sensor(drone: str, kind: str) -> str:
    return f"{drone}/{kind}_link"


def cluster(name: str) -> str:
    return f"cluster/{name}"


def static_frames(drone: str, sensors: Sensors) -> Iterator[FramePose]:
    """Yield the frames of a drone that never move: its odom in map, its sensors in its body."""
    yield FramePose(MAP, odom(drone), (0.0, 0.0, 0.0), UNTURNED)
    for kind in ("imu", "gps", "mag", "baro"):
        mount: Mount = getattr(sensors, kind).mount
        yield FramePose(base(drone), sensor(drone, kind), mount.position_m, _mount_rotation(mount))
    beam = quaternion_multiply(_mount_rotation(sensors.sonar.mount), _ALONG_BEAM)
    yield FramePose(base(drone), sensor(drone, "sonar"), sensors.sonar.mount.position_m, _quaternion(beam))


def _mount_rotation(mount: Mount) -> Quaternion:
    """Return q_BS."""
    return _quaternion(quaternion_from_rpy(np.radians(mount.rpy_deg)))


def _quaternion(q: np.ndarray) -> Quaternion:
    w, x, y, z = q.tolist()
    return w, x, y, z


Rows = tuple[Vector3, Vector3, Vector3]


def rotation_rows(q_WB: Quaternion) -> Rows:
    """Return R_WB row by row, in plain floats: messages come by the thousand, and small arrays cost more."""
    w, x, y, z = q_WB
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def into_body(q_WB: Quaternion, v_W: Vector3) -> Vector3:
    """Return v_B = R_WB^T v_W."""
    (a, b, c), (d, e, f), (g, h, i) = rotation_rows(q_WB)
    x, y, z = v_W
    return a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z


def mean_rate(q_WB1: Quaternion, q_WB2: Quaternion, dt_s: float) -> Vector3:
    """Return the constant w_WB_B [rad/s] that turns one attitude into the next within dt_s."""
    w1, x1, y1, z1 = q_WB1
    w2, x2, y2, z2 = q_WB2
    w = w1 * w2 + x1 * x2 + y1 * y2 + z1 * z2
    x = w1 * x2 - x1 * w2 - y1 * z2 + z1 * y2
    y = w1 * y2 + x1 * z2 - y1 * w2 - z1 * x2
    z = w1 * z2 - x1 * y2 + y1 * x2 - z1 * w2
    sine = math.sqrt(x * x + y * y + z * z)
    if sine == 0.0:
        return 0.0, 0.0, 0.0
    gain = math.copysign(2.0, w) * math.atan2(sine, abs(w)) / (sine * dt_s)
    return gain * x, gain * y, gain * z
