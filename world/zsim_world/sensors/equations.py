"""The measurement equations of the stock sensors, then errors and faults. All compiled.

A sensor is at p_BS in the body, rotated by R_BS (q_BS: sensor components to body components). An equation is a function
of body, mount and site, and returns two vectors of errorless values; unused places are zero. The error model works on
rows of `zsim_world.sensors.sensor_set`; `n` numbers of a reading have an error of their own.
"""

import math
from typing import NamedTuple

from numpy.typing import NDArray

from zsim.math import elementary as el
from zsim.math.compiled import inlined, kernel
from zsim.math.rotation import Quaternion, Vector, add, cross, heading, rotate, rotate_back, z_axis
from zsim_world.sensors.sensor_set import ARMED, CHANNELS_MAX, CONFIG, FAULT, HOLDING

SEA_LEVEL_PA = 101_325.0  # Pa, ISO 2533
LAPSE_1_M = 2.25577e-5  # 1/m, 0.0065 K/m over 288.15 K, ISO 2533
PRESSURE_EXPONENT = 5.25588  # g M / (R L), ISO 2533
SONAR_COSINE_MIN = 0.5  # an echo comes back up to 60 deg from the vertical; beyond, it is scattered away

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
    """Pose of a sensor in the body, and the largest range of a range sensor."""

    p_BS: Vector  # m
    q_BS: Quaternion
    range_max: float  # m


class Site(NamedTuple):
    """The place of the flight."""

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


@inlined
def imu(x: BodyTruth, s: MountedSensor, site: Site) -> Values:
    """Return specific force [m/s^2] and body rate [rad/s] at the sensor, both in S.

    f_S = R_SB (R_BW (a_WB - g_W) + alpha × p_BS + w × (w × p_BS)),  w_S = R_SB w    (Titterton and Weston, ch. 3)
    """
    f = rotate_back(x.q_WB, (x.a_WB[0], x.a_WB[1], x.a_WB[2] + site.gravity))
    f = add(f, add(cross(x.alpha_B, s.p_BS), cross(x.w_WB_B, cross(x.w_WB_B, s.p_BS))))
    return rotate_back(s.q_BS, f), rotate_back(s.q_BS, x.w_WB_B)


@inlined
def gps(x: BodyTruth, s: MountedSensor, site: Site) -> Values:
    """Return position [m] and velocity [m/s] of the antenna in W."""
    return add(x.p_WB, rotate(x.q_WB, s.p_BS)), sensor_velocity(x, s)


@inlined
def mag(x: BodyTruth, s: MountedSensor, site: Site) -> Values:
    """Return the Earth's field in S [uT]."""
    return rotate_back(s.q_BS, rotate_back(x.q_WB, site.field_W)), NONE


@inlined
def baro(x: BodyTruth, s: MountedSensor, site: Site) -> Values:
    """Return the height of the sensor over the origin of W [m]."""
    return (sensor_height(x, s), 0.0, 0.0), NONE


@inlined
def pressure(altitude_m: float) -> float:
    """Return the static pressure [Pa] of the standard atmosphere at an altitude above sea level (ISO 2533).

    The law holds to 11 km, the limit of scenarios; beyond it is extrapolated, to vacuum at 44 km.
    """
    return SEA_LEVEL_PA * el.power(max(1.0 - LAPSE_1_M * altitude_m, 0.0), PRESSURE_EXPONENT)


@inlined
def sonar(x: BodyTruth, s: MountedSensor, site: Site) -> Values:
    """Return the distance [m] to the ground along -z of the sensor, and 1 where there is an echo.

    Without an echo (beyond range_max, or the beam too far from the vertical) the distance is range_max.
    """
    upright = rotate(x.q_WB, z_axis(s.q_BS))[2]  # cosine between beam and vertical
    if upright < SONAR_COSINE_MIN:
        return (s.range_max, 0.0, 0.0), NONE
    distance = max(sensor_height(x, s), 0.0) / upright
    return (min(distance, s.range_max), 1.0 if distance <= s.range_max else 0.0, 0.0), NONE


@inlined
def flow(x: BodyTruth, s: MountedSensor, site: Site) -> Values:
    """Return the sensor's velocity [m/s] in the heading frame, and the quality in [0, 1].

    Heading frame: x forward and y left in the horizontal plane, z up. The quality is the cosine of the tilt: how much
    of the picture is ground.
    """
    v = sensor_velocity(x, s)
    psi = heading(x.q_WB)
    cos, sin = el.cos(psi), el.sin(psi)
    quality = max(z_axis(x.q_WB)[2], 0.0)
    return (cos * v[0] + sin * v[1], cos * v[1] - sin * v[0], v[2]), (quality, 0.0, 0.0)


@inlined
def rounded(value: float, bias: float, white: float, quantum: float) -> float:
    """Return value + bias + white, rounded to the quantum of the converter (0: not rounded)."""
    x = value + bias + white
    return x if quantum == 0.0 else quantum * math.floor(x / quantum + 0.5)


@inlined
def add_errors(n: int, value: NDArray, config: NDArray, bias: NDArray, noise: NDArray, at: int) -> None:
    """Add the errors of n channels to a value, in place.

    `noise` has standard normal numbers from `at` on (sensor_set.noise_width); `bias` is the bias of each channel, and
    behind those of all its Gauss-Markov process.
    """
    if config[CONFIG.correlated] != 0.0:
        for k in range(n):
            state = CHANNELS_MAX + k
            bias[state] = config[CONFIG.decay + k] * bias[state] + config[CONFIG.kick + k] * noise[at + 2 * n + 1 + k]
            value[k] += bias[state]
    for k in range(n):
        bias[k] += config[CONFIG.walk + k] * noise[at + n + k]
        white = config[CONFIG.white + k] * noise[at + k]
        value[k] = rounded(value[k], bias[k], white, config[CONFIG.quantum + k])


@inlined
def displace(n: int, value: NDArray, fault: NDArray) -> None:
    """Add the offset of a fault to the errorless values of a sensor, in place."""
    for k in range(n):
        value[k] += fault[FAULT.offset + k]


@inlined
def hold_reading(value: NDArray, fault: NDArray) -> None:
    """Store the first reading (6,) of a stuck sensor, or replace a reading by the stored one, in place."""
    if fault[FAULT.hold] == ARMED:
        fault[FAULT.hold] = HOLDING
        for k in range(CHANNELS_MAX):
            fault[FAULT.held + k] = value[k]
    elif fault[FAULT.hold] == HOLDING:
        for k in range(CHANNELS_MAX):
            value[k] = fault[FAULT.held + k]


@kernel(makes_arrays=False)
def read(n: int, value: NDArray, config: NDArray, bias: NDArray, fault: NDArray, noise: NDArray) -> bool:
    """Turn the errorless values of a user's sensor into a reading, in place; return False if it is lost."""
    displace(n, value, fault)
    add_errors(n, value, config, bias, noise, 0)
    kept = noise[2 * n] >= config[CONFIG.drop]
    if kept:
        hold_reading(value, fault)
    return kept
