"""From a wanted thrust direction to rotor commands: tilt loop, rate loop, and motors driven ahead of their lag."""

import math

from zsim.math import rotation as rot
from zsim.math.columns import Field, columns
from zsim.math.compiled import inlined
from zsim.math.rotation import Quaternion, Vector, axpy
from zsim.vehicles.vehicle import Firmware
from zsim_world.physics.fleet_arrays import ROTOR, VEHICLE, PerRotor, Row, of, put_of
from zsim_world.physics.rigid_body import vector
from zsim_world.physics.rotors import mix
from zsim_world.vehicles.observer import STEP_S

DRIVE = columns(  # what the loops of attitude and rate need of the firmware's settings, by which these begin
    "DriveColumns",
    (
        Field("k_rate", "1/s"),
        Field("k_tilt", "1/s"),
        Field("overdrive", "1"),  # part of the way to a command beyond it
        Field("slope", "1"),  # tan of the largest tilt
        Field("yaw_share", "1"),
        Field("body_rate", "rad/s"),  # largest, wanted of the tilt loop
    ),
)
Gains = tuple[float, float, float, float, float, float]


def loop_gains(design: Firmware, rotor_lag_s: float) -> tuple[float, float, float]:
    """Return the gains of rate, tilt and velocity loop [1/s] for a lag of the rotors."""
    rate = design.rate_per_lag / max(design.lag_lead * rotor_lag_s, design.lag_min_s)
    return rate, rate / design.loop_ratio, rate / design.loop_ratio**2


def lag_shares(design: Firmware, rotor_lag_s: float) -> tuple[float, float]:
    """Return what is left of a rotor's lag after a step, and by how much to overdrive it to shorten that lag."""
    decay = math.exp(-STEP_S / rotor_lag_s)
    return decay, (1.0 - math.exp(-STEP_S / (design.lag_lead * rotor_lag_s))) / (1.0 - decay)


@inlined
def drive(
    row: Row,
    rotors: PerRotor,
    gains: Gains,
    own: Quaternion,
    q_WB: Quaternion,
    w_WB_B: Vector,
    speeds: PerRotor,
    z_des: Vector,
    thrust_n: float,
    yaw_rate: float,
    commands: PerRotor,
) -> None:
    """Set rotor commands for a wanted direction of z_B (heading frame), thrust [N] and yaw rate [rad/s].

    Without a branch, so that several drones go at once (simd_firmware.py).

    Args:
        row, rotors: parameters; gains: its settings in DRIVE.
        own: the heading frame in W; q_WB, w_WB_B, speeds: attitude, body rate and rotor speeds believed.
        commands: [rad/s], to be set.
    """
    k_rate, k_tilt, overdrive, slope, yaw_share, body_rate_max = gains
    q_HB = rot.level(own, q_WB)
    z_B = rot.rotate_back(q_HB, limited_tilt(z_des, slope))
    up_B = rot.rotate_back(q_HB, (0.0, 0.0, yaw_rate))
    w, wx, wy = w_WB_B, -k_tilt * z_B[1], k_tilt * z_B[0]
    size = math.sqrt(wx * wx + wy * wy)
    s = 1.0 if size <= body_rate_max else body_rate_max / size
    ix, iy, iz = vector(row, VEHICLE.inertia)
    moment = (
        ix * k_rate * (s * wx + up_B[0] - w[0]) + (iz - iy) * w[1] * w[2],
        iy * k_rate * (s * wy + up_B[1] - w[1]) + (ix - iz) * w[2] * w[0],
        iz * k_rate * yaw_share * (up_B[2] - w[2]) + (iy - ix) * w[0] * w[1],
    )
    mix(row, rotors, thrust_n, moment, commands)
    for r in range(len(rotors.each)):  # under these commands the rotors reach what is wanted with a part of their lag
        speed = of(speeds, 0, r)
        put_of(commands, r, clipped(rotors, r, speed + overdrive * (of(commands, 0, r) - speed)))


@inlined
def clipped(rotors: PerRotor, r: int, speed: float) -> float:
    """Return a speed [rad/s] of rotor r within its limits."""
    return min(max(speed, of(rotors, ROTOR.low, r)), of(rotors, ROTOR.high, r))


@inlined
def limited_tilt(z: Vector, slope: float) -> Vector:
    """Return the unit vector along z, no farther from the vertical than the tilt of this tangent."""
    across = math.sqrt(z[0] * z[0] + z[1] * z[1])
    most = max(z[2], 1e-3) * slope
    s = 1.0 if across <= most else most / across
    z = (s * z[0], s * z[1], max(z[2], 1e-3))
    return axpy((0.0, 0.0, 0.0), 1.0 / rot.norm(z), z)
