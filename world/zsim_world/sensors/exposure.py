"""What the equations of the stock sensors are given, each a function of these three, pure and compiled.

A sensor stands at p_BS in the body and is turned by R_BS (q_BS: sensor components to body components). An equation
returns two vectors of errorless values; unused places are zero.
"""

from typing import NamedTuple

from zsim.math.compiled import inlined
from zsim.math.rotation import Quaternion, Vector, add, cross, rotate

Values = tuple[Vector, Vector]
NONE = (0.0, 0.0, 0.0)


class BodyTruth(NamedTuple):
    """The true state of a drone."""

    p_WB: Vector  # m
    v_WB: Vector  # m/s
    q_WB: Quaternion
    w_WB_B: Vector  # rad/s
    a_WB: Vector  # m/s^2, of the centre of mass in W
    alpha_B: Vector  # rad/s^2


class MountedSensor(NamedTuple):
    """Pose of a sensor in the body, and the largest range of one that has such."""

    p_BS: Vector  # m
    q_BS: Quaternion
    range_max: float  # m


class Site(NamedTuple):
    """Where the flight is."""

    gravity: float  # m/s^2
    field_W: Vector  # uT, of the Earth


@inlined
def sensor_velocity(x: BodyTruth, s: MountedSensor) -> Vector:
    """Return the velocity of the sensor in W: v_WB + R (w × p_BS)."""
    return add(x.v_WB, rotate(x.q_WB, cross(x.w_WB_B, s.p_BS)))


@inlined
def sensor_height(x: BodyTruth, s: MountedSensor) -> float:
    """Return the height of the sensor over the origin of W [m]."""
    return x.p_WB[2] + rotate(x.q_WB, s.p_BS)[2]
