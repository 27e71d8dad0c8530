"""MAVLink's axes and zsim's: north, east, down and forward, right, down against W (ENU) and B (FLU). Pure.

Source: https://mavlink.io/en/messages/common.html#MAV_FRAME; REP 103 has the same two turns.
"""

import math
from collections.abc import Sequence

from zsim.math.rotation import Quaternion, Vector

_HALF = math.sqrt(0.5)


def swapped(v: Sequence[float]) -> Vector:
    """Return a vector of NED in W, or one of W in NED."""
    return v[1], v[0], -v[2]


def flipped(v: Sequence[float]) -> Vector:
    """Return a vector of the body's forward, right, down in B, or one of B in those."""
    return v[0], -v[1], -v[2]


def attitude_turned(q: Sequence[float]) -> Quaternion:
    """Return q_WB of an attitude that turns forward, right, down into NED, or the latter of q_WB; w first.

    (0, 1, 1, 0) / sqrt(2) turns NED into ENU, (0, 1, 0, 0) FLU into FRD; both are their own inverse.
    """
    w, x, y, z = q
    return _HALF * (w + z), _HALF * (x + y), _HALF * (x - y), _HALF * (w - z)


def heading_to_ned(yaw_rad: float) -> float:
    """Return a heading from east, counter-clockwise, as one from north, clockwise, or back; in [-pi, pi)."""
    return (math.pi / 2 - yaw_rad + math.pi) % (2 * math.pi) - math.pi
