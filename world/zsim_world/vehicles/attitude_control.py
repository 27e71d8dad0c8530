"""From a wanted thrust direction to rotor commands: tilt loop, rate loop, and motors driven ahead of their lag."""

import math

from zsim.math import rotation as rot
from zsim.math.compiled import inlined
from zsim.math.rotation import Quaternion, Vector, axpy
from zsim_world.physics.rotors import Four, mix
from zsim_world.state.vehicle import DRIVE_LAG_LEAD, INERTIA_X, INERTIA_Y, INERTIA_Z, ROTOR_MAX, ROTOR_MIN, Row
from zsim_world.vehicles.observer import STEP_S

# Columns of the firmware's settings
SLOPE = 0  # tan of the largest tilt
K_RATE, K_TILT = 6, 7  # 1/s
ROTOR_DECAY, OVERDRIVE = 10, 11  # left of the rotors' lag after a step; part of the way to command beyond it
GAINS = (K_RATE, K_TILT, OVERDRIVE, SLOPE)  # what the drive needs of them
RATE_PER_LAG = 0.42  # rate gain times the overdriven lag: damping 0.77 of rate loop and rotors together
LAG_MIN_S = 0.015  # s, three control steps: faster rotors do not make a faster loop
LOOP_RATIO = 3.1  # of a loop's gain to that of the loop around it
YAW_SHARE = 1 / 3.5  # of the rate gain; the rotors' own inertia makes yaw quicker: 0.04 s as tum_ardrone fitted
BODY_RATE_MAX = 5.0  # rad/s, wanted of the tilt loop


def loop_gains(rotor_lag_s: float) -> tuple[float, float, float]:
    """Return the gains of rate, tilt and velocity loop [1/s] for a lag of the rotors."""
    rate = RATE_PER_LAG / max(DRIVE_LAG_LEAD * rotor_lag_s, LAG_MIN_S)
    return rate, rate / LOOP_RATIO, rate / LOOP_RATIO**2


def lag_shares(rotor_lag_s: float) -> tuple[float, float]:
    """Return what is left of a rotor's lag after a step, and by how much to overdrive it to halve that lag."""
    decay = math.exp(-STEP_S / rotor_lag_s)
    return decay, (1.0 - math.exp(-STEP_S / (DRIVE_LAG_LEAD * rotor_lag_s))) / (1.0 - decay)


@inlined
def drive(
    row: Row,
    gains: Four,
    own: Quaternion,
    q_WB: Quaternion,
    w_WB_B: Vector,
    rotor: Four,
    z_des: Vector,
    thrust_n: float,
    yaw_rate: float,
) -> Four:
    """Return rotor commands for a wanted direction of z_B (heading frame), thrust [N] and yaw rate [rad/s].

    Without a branch, so that several drones go at once (steering.py).

    Args:
        row: the aircraft (vehicle.py); gains: its settings in GAINS.
        own: the heading frame in W; q_WB, w_WB_B, rotor: attitude, body rate and rotor speeds believed.
    """
    k_rate, k_tilt, overdrive, slope = gains
    q_HB = rot.level(own, q_WB)
    z_B = rot.rotate_back(q_HB, limited_tilt(z_des, slope))
    up_B = rot.rotate_back(q_HB, (0.0, 0.0, yaw_rate))
    w, wx, wy = w_WB_B, -k_tilt * z_B[1], k_tilt * z_B[0]
    size = math.sqrt(wx * wx + wy * wy)
    s = 1.0 if size <= BODY_RATE_MAX else BODY_RATE_MAX / size
    ix, iy, iz = row[INERTIA_X], row[INERTIA_Y], row[INERTIA_Z]
    moment = (
        ix * k_rate * (s * wx + up_B[0] - w[0]) + (iz - iy) * w[1] * w[2],
        iy * k_rate * (s * wy + up_B[1] - w[1]) + (ix - iz) * w[2] * w[0],
        iz * k_rate * YAW_SHARE * (up_B[2] - w[2]) + (iy - ix) * w[0] * w[1],
    )
    return _overdriven(row, rotor, overdrive, mix(row, thrust_n, moment))


@inlined
def _overdriven(row: Row, r: Four, s: float, wanted: Four) -> Four:
    """Return commands under which rotors at r move to `wanted` with a part of their lag only."""
    return clipped(
        row,
        (
            r[0] + s * (wanted[0] - r[0]),
            r[1] + s * (wanted[1] - r[1]),
            r[2] + s * (wanted[2] - r[2]),
            r[3] + s * (wanted[3] - r[3]),
        ),
    )


@inlined
def clipped(row: Row, speed: Four) -> Four:
    """Return rotor speeds [rad/s] within the rotors' limits."""
    low, high = row[ROTOR_MIN], row[ROTOR_MAX]
    return (
        min(max(speed[0], low), high),
        min(max(speed[1], low), high),
        min(max(speed[2], low), high),
        min(max(speed[3], low), high),
    )


@inlined
def limited_tilt(z: Vector, slope: float) -> Vector:
    """Return the unit vector along z, no farther from the vertical than the tilt of this tangent."""
    across = math.sqrt(z[0] * z[0] + z[1] * z[1])
    most = max(z[2], 1e-3) * slope
    s = 1.0 if across <= most else most / across
    z = (s * z[0], s * z[1], max(z[2], 1e-3))
    return axpy((0.0, 0.0, 0.0), 1.0 / rot.norm(z), z)
