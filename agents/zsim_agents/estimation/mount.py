"""Where a sensor sits in the body."""

import math

from zsim.scenario.scenario import Mount
from zsim_agents.estimation.madgwick import Rotation


def mount_rotation(mount: Mount) -> Rotation:
    """Return R_BS = Rz(yaw) Ry(pitch) Rx(roll) of a mount, row by row."""
    roll, pitch, yaw = (math.radians(angle) for angle in mount.rpy_deg)
    sr, cr, sp, cp, sy, cy = (
        math.sin(roll), math.cos(roll), math.sin(pitch), math.cos(pitch), math.sin(yaw), math.cos(yaw),
    )  # fmt: skip
    return (
        cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr,
        sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr,
        -sp, cp * sr, cp * cr,
    )  # fmt: skip
