"""From W (east, north, up) and B (forward, left, up) to MAVLink's axes: north, east, down; forward, right, down.

Source of MAVLink's axes: https://mavlink.io/en/messages/common.html#MAV_FRAME.
"""

import math

from zsim.math.rotation import Quaternion, Vector

_S = math.sqrt(0.5)


def ned(v_W: Vector) -> Vector:
    """Return a vector of W in north, east, down; the same formula leads back."""
    return v_W[1], v_W[0], -v_W[2]


def frd(v_B: Vector) -> Vector:
    """Return a vector of B in forward, right, down; the same formula leads back."""
    return v_B[0], -v_B[1], -v_B[2]


def attitude_ned(q_WB: Quaternion) -> Quaternion:
    """Return the attitude forward-right-down to north-east-down, w first and not negative.

    W to NED is half a turn about (1, 1, 0), FRD to B half a turn about x; the same formula leads back.
    """
    w, x, y, z = q_WB
    w, x, y, z = -x, w, z, -y
    q = -_S * (x + y), _S * (w + z), _S * (w - z), _S * (y - x)
    return q if q[0] >= 0.0 else (-q[0], -q[1], -q[2], -q[3])


def wrapped(angle_rad: float) -> float:
    """Return an angle in [-pi, pi]."""
    return math.remainder(angle_rad, math.tau)


def yaw_ned(yaw_W: float) -> float:
    """Return a yaw counter-clockwise from east as one clockwise from north [rad]; the same formula leads back."""
    return wrapped(0.5 * math.pi - yaw_W)
