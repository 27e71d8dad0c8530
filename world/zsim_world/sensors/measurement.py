"""The sensors: truth to measurement at a mount X_BS, and the errors that turn it into a reading. All pure.

A sensor stands at p_BS in the body and is turned by R_BS (q_BS: sensor components to body components).
"""

import math

from zsim.math.compiled import inlined
from zsim.math.rotation import Quaternion, Vector, add, cross, heading, rotate, rotate_back, z_axis

SEA_LEVEL_PA = 101_325.0  # Pa, ISO 2533
LAPSE_1_M = 2.25577e-5  # 1/m, 0.0065 K/m over 288.15 K, ISO 2533
PRESSURE_EXPONENT = 5.25588  # g M / (R L), ISO 2533
SONAR_COSINE_MIN = 0.5  # an echo comes back up to 60 deg from the vertical; beyond, it is scattered away


@inlined
def point_velocity(v_WB: Vector, q_WB: Quaternion, w_WB_B: Vector, p_BS: Vector) -> Vector:
    """Return the velocity of a point of the body in W: v_WB + R (w × p_BS)."""
    return add(v_WB, rotate(q_WB, cross(w_WB_B, p_BS)))


@inlined
def imu(
    a_WB: Vector, q_WB: Quaternion, w_WB_B: Vector, alpha_B: Vector, gravity: float, p_BS: Vector, q_BS: Quaternion
) -> tuple[Vector, Vector]:
    """Return specific force [m/s^2] and body rate [rad/s] at the sensor, both in S.

    f_S = R_SB (R_BW (a_WB - g_W) + alpha × p_BS + w × (w × p_BS)),  w_S = R_SB w    (Titterton and Weston, ch. 3)

    Args:
        a_WB: acceleration of the centre of mass in W; alpha_B: angular acceleration in B [rad/s^2].
    """
    f = rotate_back(q_WB, (a_WB[0], a_WB[1], a_WB[2] + gravity))
    f = add(f, add(cross(alpha_B, p_BS), cross(w_WB_B, cross(w_WB_B, p_BS))))
    return rotate_back(q_BS, f), rotate_back(q_BS, w_WB_B)


@inlined
def gps(p_WB: Vector, v_WB: Vector, q_WB: Quaternion, w_WB_B: Vector, p_BS: Vector) -> tuple[Vector, Vector]:
    """Return position [m] and velocity [m/s] of the antenna in W."""
    return add(p_WB, rotate(q_WB, p_BS)), point_velocity(v_WB, q_WB, w_WB_B, p_BS)


@inlined
def mag(q_WB: Quaternion, q_BS: Quaternion, field_W: Vector) -> Vector:
    """Return the Earth's field in S, in the unit of `field_W`."""
    return rotate_back(q_BS, rotate_back(q_WB, field_W))


@inlined
def height(p_WB: Vector, q_WB: Quaternion, p_BS: Vector) -> float:
    """Return the height of the sensor over the origin of W [m]."""
    return p_WB[2] + rotate(q_WB, p_BS)[2]


@inlined
def pressure(altitude_m: float) -> float:
    """Return the static pressure [Pa] of the standard atmosphere at an altitude above sea level (ISO 2533).

    It holds to 11 km, which no scenario allows to exceed; a drone that a wind carries beyond finds the same law, and
    where that ends, at 44 km, a vacuum.
    """
    return SEA_LEVEL_PA * math.pow(max(1.0 - LAPSE_1_M * altitude_m, 0.0), PRESSURE_EXPONENT)


@inlined
def sonar(p_WB: Vector, q_WB: Quaternion, p_BS: Vector, q_BS: Quaternion, range_max: float) -> tuple[float, bool]:
    """Return the distance [m] to the ground along -z of the sensor, and whether there is an echo.

    Without an echo (beyond range_max, or the beam too far from the vertical) the distance is range_max.
    """
    upright = rotate(q_WB, z_axis(q_BS))[2]  # cosine between beam and vertical
    if upright < SONAR_COSINE_MIN:
        return range_max, False
    distance = max(height(p_WB, q_WB, p_BS), 0.0) / upright
    return min(distance, range_max), distance <= range_max


@inlined
def flow(v_WB: Vector, q_WB: Quaternion, w_WB_B: Vector, p_BS: Vector) -> tuple[Vector, float]:
    """Return the sensor's velocity [m/s] in the heading frame, and the quality in [0, 1].

    Heading frame: x forward and y left in the horizontal plane, z up. The quality is the cosine of the tilt: how much
    of the picture is ground.
    """
    v = point_velocity(v_WB, q_WB, w_WB_B, p_BS)
    psi = heading(q_WB)
    c, s = math.cos(psi), math.sin(psi)
    return (c * v[0] + s * v[1], c * v[1] - s * v[0], v[2]), max(z_axis(q_WB)[2], 0.0)


@inlined
def reading(value: float, bias: float, white: float, quantum: float) -> float:
    """Return what the converter gives: value + bias + white, rounded to the quantum (0: none)."""
    x = value + bias + white
    return x if quantum == 0.0 else quantum * math.floor(x / quantum + 0.5)
