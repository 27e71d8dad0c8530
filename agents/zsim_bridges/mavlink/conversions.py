"""Between zsim's axes and units and MAVLink's: W is east, north, up and B forward, left, up; MAVLink's are NED and FRD.

Sources: https://mavlink.io/en/messages/common.html#MAV_FRAME for the axes,
https://mavlink.io/en/services/mission.html#mission_item_int for whole numbers.
"""

import math

from zsim.math.rotation import Quaternion, Vector

DEGREES, LOCAL_M = 1e-7, 1e-4  # unit of x and y in messages that have them as whole numbers
INT32_UNKNOWN = 2**31 - 1  # INT32_MAX: NaN among whole numbers of 32 bits
UINT16_UNKNOWN = 65535  # likewise of 16 bits
_S = math.sqrt(0.5)


def ned(v_W: Vector) -> Vector:
    """Return a vector of W in north, east, down; its own inverse."""
    return v_W[1], v_W[0], -v_W[2]


def frd(v_B: Vector) -> Vector:
    """Return a vector of B in forward, right, down; its own inverse."""
    return v_B[0], -v_B[1], -v_B[2]


def attitude_ned(q_WB: Quaternion) -> Quaternion:
    """Return the attitude forward-right-down to north-east-down, w first and not negative; its own inverse.

    W to NED is half a turn about (1, 1, 0), FRD to B half a turn about x.
    """
    w, x, y, z = q_WB
    w, x, y, z = -x, w, z, -y
    q = -_S * (x + y), _S * (w + z), _S * (w - z), _S * (y - x)
    return q if q[0] >= 0.0 else (-q[0], -q[1], -q[2], -q[3])


def wrapped(angle_rad: float) -> float:
    """Return an angle in [-pi, pi]."""
    return math.remainder(angle_rad, math.tau)


def yaw_ned(yaw_W: float) -> float:
    """Return a yaw counter-clockwise from east as one clockwise from north [rad]; its own inverse."""
    return wrapped(0.5 * math.pi - yaw_W)


def from_int(value: int, unit: float) -> float:
    """Return a whole number in a unit; NaN where it is not known."""
    return math.nan if value == INT32_UNKNOWN else unit * value


def to_int(value: float, unit: float) -> int:
    """Return a value as a whole number in a unit."""
    return round(value / unit) if math.isfinite(value) else INT32_UNKNOWN


def global_ints(place: Vector) -> tuple[int, int, int]:
    """Return latitude [deg], longitude [deg] and height [m] as whole numbers [1e-7 deg, 1e-7 deg, mm]."""
    return round(1e7 * place[0]), round(1e7 * place[1]), round(1000 * place[2])


def int16(value: float) -> int:
    """Return the nearest whole number of 16 bits, within 32767 either way."""
    return max(-32767, min(32767, round(value)))
