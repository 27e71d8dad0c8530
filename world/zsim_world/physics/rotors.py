"""Four rotors: lag, thrust, torque, and the mixer that finds speeds for a wanted thrust and torque."""

import math

from numpy.typing import NDArray

from zsim.math.compiled import inlined
from zsim.math.rotation import Quaternion, Vector, rotate
from zsim_world.state.vehicle import ROTOR_INERTIA, ROTOR_MAX, ROTOR_MIN, ROTOR_RADIUS, ROTOR_XY, THRUST, TORQUE, Row

Four = tuple[float, float, float, float]
# Rotor i stands at (SIDE_X[i], SIDE_Y[i]) * ROTOR_XY; TURN is the sign of its drag torque on the body about z.
SIDE_X = (1.0, 1.0, -1.0, -1.0)
SIDE_Y = (1.0, -1.0, -1.0, 1.0)
TURN = (1.0, -1.0, 1.0, -1.0)
GROUND_CLEARANCE_MIN = 0.5  # radii, the formula below is not meant for less


@inlined
def lagged(speed: Four, command: Four, decay: float) -> Four:
    """Return rotor speeds [rad/s] after a first-order lag has decayed to the fraction `decay` = exp(-t / lag)."""
    return (
        command[0] + (speed[0] - command[0]) * decay,
        command[1] + (speed[1] - command[1]) * decay,
        command[2] + (speed[2] - command[2]) * decay,
        command[3] + (speed[3] - command[3]) * decay,
    )


@inlined
def ground_effect(height_m: float, radius_m: float) -> float:
    """Return the thrust near the ground over that in free air: 1 / (1 - (R / 4z)^2).

    Cheeseman and Bennett, ARC R&M 3021 (1955); z is the rotor's height, not taken below R/2 (factor 4/3).
    """
    z = max(height_m, GROUND_CLEARANCE_MIN * radius_m)
    ratio = radius_m / (4.0 * z)
    return 1.0 / (1.0 - ratio * ratio)


@inlined
def wrench(
    row: Row, q_WB: Quaternion, height_m: float, w_WB_B: Vector, speed: Four, slew: Four
) -> tuple[float, Vector]:
    """Return thrust along z_B [N] and moment in B [N m] of the four rotors.

    Moment: arms × thrusts, drag torque k_M w^2, reaction to the rotors' own acceleration J dw/dt, and the
    gyroscopic moment of their spin when the body turns.

    Args:
        row: the drone's parameters (vehicle.py).
        q_WB, height_m: attitude, and height of the centre of mass over the ground.
        w_WB_B: body rate [rad/s].
        speed, slew: rotor speeds [rad/s] and their derivatives [rad/s^2].
    """
    arm, radius, inertia = row[ROTOR_XY], row[ROTOR_RADIUS], row[ROTOR_INERTIA]
    ex, ey = rotate(q_WB, (arm, 0.0, 0.0))[2], rotate(q_WB, (0.0, arm, 0.0))[2]
    total, mx, my, mz, spin = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(4):
        square = speed[k] * speed[k]
        force = row[THRUST] * square * ground_effect(height_m + SIDE_X[k] * ex + SIDE_Y[k] * ey, radius)
        total += force
        mx += SIDE_Y[k] * arm * force
        my -= SIDE_X[k] * arm * force
        mz += TURN[k] * (row[TORQUE] * square + inertia * slew[k])
        spin += TURN[k] * inertia * speed[k]
    return total, (mx + w_WB_B[1] * spin, my - w_WB_B[0] * spin, mz)


@inlined
def shaft_power(row: NDArray, speed: Four) -> float:
    """Return the mechanical power of the four rotors [W]: sum of k_M w^3."""
    s = 0.0
    for k in range(4):
        s += speed[k] * speed[k] * speed[k]
    return row[TORQUE] * s


@inlined
def mix(row: Row, thrust_n: float, moment: Vector) -> Four:
    """Return rotor speeds [rad/s] for a thrust [N] and a moment in B [N m] within the rotors' limits.

    What cannot be had is given up in this order: yaw first, then thrust, tilt last.
    """
    low = row[THRUST] * row[ROTOR_MIN] * row[ROTOR_MIN]
    high = row[THRUST] * row[ROTOR_MAX] * row[ROTOR_MAX]
    roll, pitch = 0.25 * moment[0] / row[ROTOR_XY], 0.25 * moment[1] / row[ROTOR_XY]
    reach = abs(roll) + abs(pitch)
    scale = (high - low) / (2.0 * reach) if 2.0 * reach > high - low else 1.0
    roll, pitch, reach = roll * scale, pitch * scale, reach * scale
    mean = min(max(0.25 * thrust_n, low + reach), high - reach)
    yaw = 0.25 * moment[2] * row[THRUST] / row[TORQUE]
    f0, f1 = mean + roll - pitch, mean - roll - pitch
    f2, f3 = mean - roll + pitch, mean + roll + pitch
    if yaw >= 0.0:
        yaw = min(yaw, high - max(f0, f2), min(f1, f3) - low)
    else:
        yaw = -min(-yaw, high - max(f1, f3), min(f0, f2) - low)
    return (
        math.sqrt(max(f0 + yaw, low) / row[THRUST]),
        math.sqrt(max(f1 - yaw, low) / row[THRUST]),
        math.sqrt(max(f2 + yaw, low) / row[THRUST]),
        math.sqrt(max(f3 - yaw, low) / row[THRUST]),
    )
