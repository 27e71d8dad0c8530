"""What each aiding sensor should read, and how that depends on the error state: plain floats, compiled.

Every function takes the state at the instant of the sample (p, v in the world, R_WB, w_WB_B), writes its rows
of the Jacobian H, which come in as zero, and returns the predicted reading. `lag` is the age of the sample
[s]: to first order an error of the past position is the present one less lag times that of the velocity.
The body rate's own error times a lever arm is left out: below 1 mm/s.
"""

import math

import numpy as np

from zsim.math.compiled import portable
from zsim.math.rotation import Matrix, Vector, add, column, composed, cross, product, transposed
from zsim_agents.estimation.dead_reckoning import (
    ATTITUDE,
    HORIZONTAL_MIN,
    POSITION,
    VELOCITY,
    heading_gradient,
    write_minus_cross,
)

SIX = tuple[float, float, float, float, float, float]
COSINE_MIN = 0.1  # of the sonar's ray to the vertical; flatter than 84 deg it does not hit the ground below


@portable
def write_gps(H: np.ndarray, i: int, p: Vector, v: Vector, R: Matrix, w: Vector, arm: Vector, lag: float) -> SIX:
    """Antenna at p_BS = `arm`: position p + R r [m], velocity v + R (w x r) [m/s]; six rows from `i`."""
    offset = product(R, arm)
    swing = product(R, cross(w, arm))
    for k in range(3):
        H[i + k, POSITION + k] = 1.0
        H[i + k, VELOCITY + k] = -lag
        H[i + 3 + k, VELOCITY + k] = 1.0
    write_minus_cross(H, i, ATTITUDE, offset, 1.0)
    write_minus_cross(H, i + 3, ATTITUDE, swing, 1.0)
    return *add(p, offset), *add(v, swing)


@portable
def write_mag(H: np.ndarray, i: int, R: Matrix, R_BS: Matrix, field_W: Vector) -> Vector:
    """Magnetometer turned by R_BS in a known field: (R R_BS)^T m [uT]; three rows from `i`."""
    R_WS = composed(R, R_BS)
    for k in range(3):
        row = cross(column(R_WS, k), field_W)
        H[i + k, ATTITUDE] = row[0]
        H[i + k, ATTITUDE + 1] = row[1]
        H[i + k, ATTITUDE + 2] = row[2]
    return product(transposed(R_WS), field_W)


@portable
def write_baro(H: np.ndarray, i: int, p: Vector, R: Matrix, arm: Vector, lag: float) -> float:
    """Barometer at p_BS = `arm`: its height [m]; one row."""
    offset = product(R, arm)
    H[i, POSITION + 2] = 1.0
    H[i, VELOCITY + 2] = -lag
    H[i, ATTITUDE] = offset[1]
    H[i, ATTITUDE + 1] = -offset[0]
    return p[2] + offset[2]


@portable
def write_sonar(H: np.ndarray, i: int, p: Vector, R: Matrix, arm: Vector, down_B: Vector, lag: float) -> float:
    """Sonar at p_BS = `arm` that looks along `down_B` at the ground z_W = 0: height / cosine [m]; one row.

    Returns 0 with an empty row if the sonar does not look down.
    """
    offset = product(R, arm)
    ray = product(R, down_B)
    cosine = -ray[2]
    if cosine < COSINE_MIN:
        return 0.0
    height = p[2] + offset[2]
    per_cosine = height / (cosine * cosine)
    H[i, POSITION + 2] = 1.0 / cosine
    H[i, VELOCITY + 2] = -lag / cosine
    H[i, ATTITUDE] = offset[1] / cosine + per_cosine * ray[1]
    H[i, ATTITUDE + 1] = -offset[0] / cosine - per_cosine * ray[0]
    return height / cosine


@portable
def write_flow(H: np.ndarray, i: int, v: Vector, R: Matrix, w: Vector, arm: Vector) -> Vector:
    """Velocity of the camera at p_BS = `arm` in the heading frame, Rz(yaw)^T (v + R (w x r)); three rows."""
    swing = product(R, cross(w, arm))
    x, y, _ = column(R, 0)
    length = math.sqrt(max(x * x + y * y, HORIZONTAL_MIN))
    c, s = x / length, y / length
    u_W = add(v, swing)
    u = (c * u_W[0] + s * u_W[1], c * u_W[1] - s * u_W[0], u_W[2])
    H[i, VELOCITY] = c
    H[i, VELOCITY + 1] = s
    H[i + 1, VELOCITY] = -s
    H[i + 1, VELOCITY + 1] = c
    H[i + 2, VELOCITY + 2] = 1.0
    by_heading = heading_gradient(R)
    for k in range(3):
        turned = cross((1.0 if k == 0 else 0.0, 1.0 if k == 1 else 0.0, 1.0 if k == 2 else 0.0), swing)
        H[i, ATTITUDE + k] = by_heading[k] * u[1] + c * turned[0] + s * turned[1]
        H[i + 1, ATTITUDE + k] = -by_heading[k] * u[0] + c * turned[1] - s * turned[0]
        H[i + 2, ATTITUDE + k] = turned[2]
    return u
