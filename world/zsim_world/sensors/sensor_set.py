"""The stock sensors of a fleet: settings and schedules as arrays, measurement equations, errors and faults.

The arrays have a row per drone and sensor. All functions from `sample` on are compiled.

A sensor is at p_BS in the body, rotated by R_BS (q_BS: sensor components to body components). A measurement equation is
a function of body, mount and site that returns two vectors of error-free values, with unused elements zero. The first
`n` values of a reading have errors of their own.

Sonar and optical flow may see an obstacle, a surface or another drone below. A flow camera measures the motion of its
picture, which the board scales by the sonar's distance to obtain a velocity. If a picture shows two motions, of the
ground and of a drone below, that of the larger part prevails, as does the largest peak of a histogram of block motions
(PX4/Flow, src/modules/flow/flow.c).
"""

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.math import elementary as el
from zsim.math.compiled import Field, columns, inlined, kernel, noinline
from zsim.math.frames import quaternion_from_rpy
from zsim.math.randomness import normal_quantile
from zsim.math.rotation import (
    Quaternion,
    Vector,
    add,
    axpy,
    cross,
    heading,
    rotate,
    rotate_back,
    scaled,
    subtract,
    z_axis,
)
from zsim.scenario.scenario import Scenario
from zsim.sensors.sensor import VALUES_MAX, ErrorModel, Sensor, SensorType, noise_sigma
from zsim.sensors.sensor_catalogue import STOCK, Sensors
from zsim.sensors.stock_sensors import BOARD_RATE_HZ, MagConfig, SonarConfig
from zsim_world.physics.fleet_arrays import PLACE, STATE, VEHICLE, Bodies, NoiseRows, Senses, four, put, vector
from zsim_world.physics.rays import Scene, cast_ground, cast_hull, cast_parts
from zsim_world.physics.rigid_body import pose, velocity_at

SENSORS = tuple(STOCK)  # in the contract's order; users' sensors are numbered after these
IMU, GPS, MAG, BARO, SONAR, FLOW = range(len(SENSORS))
CHANNELS = tuple(kind.width for kind in STOCK.values())  # number of values with errors of their own, by sensor
CHANNELS_MAX = VALUES_MAX
NEVER = 2**63 - 1  # a tick that is never reached

CONFIG = columns(  # settings of one sensor of one drone
    "SensorColumns",
    (
        Field("white", "channel's", CHANNELS_MAX),  # standard deviation per sample
        Field("walk", "channel's", CHANNELS_MAX),  # standard deviation of the bias step per sample
        Field("quantum", "channel's", CHANNELS_MAX),
        Field("correlated", "1"),  # 0: no channel has a Gauss-Markov error
        Field("decay", "1", CHANNELS_MAX),  # factor applied to that error from sample to sample
        Field("kick", "channel's", CHANNELS_MAX),  # standard deviation of that error's increment per sample
        Field("p_BS", "m", 3),
        Field("q_BS", "1", 4),
        Field("drop", "1"),  # a sample is lost when its standard normal variate is below this
        Field("limit_min", "m"),  # range limits of the sonar
        Field("limit_max", "m"),
        Field("faulty", "1"),  # 0: the row of FAULT has no effect
    ),
)
FAULT = columns(  # effects of faults on one sensor of one drone
    "SensorFaultColumns",
    (
        Field("offset", "channel's", CHANNELS_MAX),  # added to the error-free values
        Field("hold", "1"),  # FREE; ARMED: the next reading will be stored; HOLDING: the stored one is repeated
        Field("held", "channel's", CHANNELS_MAX),  # the stored reading
    ),
)
FREE, ARMED, HOLDING = 0.0, 1.0, 2.0
SCHEDULE = columns(  # sample n is due at the first physics tick >= n * numerator / denominator
    "ScheduleColumns", (Field("numerator", "1"), Field("denominator", "1"), Field("count", "1"), Field("due", "tick"))
)
FIELD_MIN_UT = 1.0  # uT, weakest horizontal field from which a heading is derived: a fifteenth of that at 50 deg N
HEADING_SIGMA_MAX_RAD = 0.5  # rad, design choice: noisier headings wrap around, so their mean is meaningless
DENOMINATOR_MAX = 1000  # largest denominator of a rate [Hz]: fits any to 0.05 %; n * numerator stays below 2^63
SEA_LEVEL_PA = 101_325.0  # Pa, ISO 2533
LAPSE_1_M = 2.25577e-5  # 1/m, 0.0065 K/m over 288.15 K, ISO 2533
PRESSURE_EXPONENT = 5.25588  # g M / (R L), ISO 2533
SONAR_COSINE_MIN = 0.5  # a beam returns an echo up to 60 deg off the vertical; beyond that, it is scattered away
# Tangents of half the field of view, ahead and sideways: 320 x 240 pixels, 64 deg along the diagonal (data sheet of the
# AR.Drone 2.0); assumed for every vehicle
HALF_VIEW = (0.375, 0.5)
# Centres of the outer cells of a picture divided into 3 x 3 cells; a hull covers more than half of the picture if it
# covers the central cell and four of these
CELLS = ((-1.0, -1.0), (-1.0, 0.0), (-1.0, 1.0), (0.0, -1.0), (0.0, 1.0), (1.0, -1.0), (1.0, 0.0), (1.0, 1.0))
CELLS_MIN = 4


class FleetSensors(NamedTuple):
    """The sensors of all drones: stock sensors, then users' sensors by name."""

    names: tuple[str, ...]
    types: tuple[SensorType, ...]
    settings: list[list[Sensor | None]]  # per drone, in the order of `names`; None: no such sensor


def fleet_sensors(scenario: Scenario) -> FleetSensors:
    """Return the sensors of a scenario's drones; those of external drones are not simulated.

    Raises:
        DocumentError: a user's module is missing, or has changed since the scenario was resolved.
    """
    sections = [list(drone.sensors.sections()) for drone in scenario.drones]
    kinds = {name: kind for of_drone in sections for name, kind, _ in of_drone if name not in STOCK}
    names = (*SENSORS, *sorted(kinds))
    simulated = [() if drone.is_external else section for drone, section in zip(scenario.drones, sections, strict=True)]
    own = [{name: settings for name, _, settings in of_drone} for of_drone in simulated]
    types = STOCK | kinds
    return FleetSensors(names, tuple(types[n] for n in names), [[each.get(n) for n in names] for each in own])


def rate_of(sensor: Sensor, name: str) -> float:
    """Return the rate [Hz] at which a sensor samples; the IMU samples at the board's rate."""
    return BOARD_RATE_HZ if name == "imu" else sensor.rate_hz


def channels(sensors: Sensors, name: str) -> list[ErrorModel]:
    """Return the error models of a stock sensor's channels, in the order of its values, in SI units."""
    return STOCK[name].errors(getattr(sensors, name))


def config(sensors: FleetSensors) -> NDArray[np.float64]:
    """Return the error parameters and mounts of all sensors, (N, S, CONFIG.size)."""
    table = np.zeros((len(sensors.settings), len(sensors.names), CONFIG.size))
    for of_drone, own in zip(table, sensors.settings, strict=True):
        for row, name, kind, settings in zip(of_drone, sensors.names, sensors.types, own, strict=True):
            if settings is None:
                continue
            rate = rate_of(settings, name)
            for k, model in enumerate(kind.errors(settings)):
                row[CONFIG.white + k] = model.white_sigma(settings.rate_hz)
                row[CONFIG.walk + k] = model.bias_walk / math.sqrt(rate)
                row[CONFIG.quantum + k] = model.quantum
                if sigma := model.correlated_sigma:
                    # exact discretisation: Brown and Hwang, "Random signals", section 5.3
                    decay = el.exp(-1.0 / (rate * model.correlation_time_s))
                    row[CONFIG.correlated], row[CONFIG.decay + k] = 1.0, decay
                    row[CONFIG.kick + k] = sigma * math.sqrt(1.0 - decay * decay)
            row[CONFIG.p_BS : CONFIG.p_BS + 3] = settings.mount.position_m
            row[CONFIG.q_BS : CONFIG.q_BS + 4] = quaternion_from_rpy(np.radians(settings.mount.rpy_deg))
            row[CONFIG.drop] = normal_quantile(settings.dropout)
            if isinstance(settings, SonarConfig):
                row[CONFIG.limit_min], row[CONFIG.limit_max] = settings.min_m, settings.max_m
    return table


def noise_width(numbers: int, models: Sequence[ErrorModel]) -> int:
    """Return how many normal variates a sample takes: white noise, bias walk, one for drop-out, Gauss-Markov if any."""
    correlated = any(model.correlated_sigma for model in models)
    return (3 if correlated else 2) * numbers + 1


def schedule(sensors: FleetSensors, tick_ms: float) -> NDArray[np.int64]:
    """Return the schedules of all published sensors, (N, S, SCHEDULE.size), with sample 0 due at tick 0."""
    table = np.zeros((len(sensors.settings), len(sensors.names), SCHEDULE.size), dtype=np.int64)
    table[:, :, SCHEDULE.due] = NEVER
    tick_us = round(tick_ms * 1000)
    for row, own in zip(table, sensors.settings, strict=True):
        for s, settings in enumerate(own):
            if settings is not None:
                rate = Fraction(settings.rate_hz).limit_denominator(DENOMINATOR_MAX)
                period = 1_000_000 / rate / tick_us  # in ticks
                row[s] = (period.numerator, period.denominator, 0, 0)
    return table


def latencies(sensors: FleetSensors) -> NDArray[np.int64]:
    """Return the latency t_ns - t_sample_ns [ns] of each sensor of each drone, (N, S)."""
    ms = [[0.0 if each is None else each.latency_ms for each in own] for own in sensors.settings]
    return np.array([[round(latency * 1_000_000) for latency in own] for own in ms])


def samples_per_gate(sensors: FleetSensors, gate_ms: float) -> int:
    """Return the largest number of samples that all drones together can take in one gate."""
    rates = [
        rate_of(settings, name)
        for own in sensors.settings
        for name, settings in zip(sensors.names, own, strict=True)
        if settings is not None
    ]
    return sum(math.ceil(gate_ms / 1000.0 * rate) + 1 for rate in rates)


def heading_sigma(mag: MagConfig, horizontal_ut: float) -> float:
    """Return the standard deviation [rad] of a heading from one magnetometer sample in a horizontal field [uT]."""
    model = mag.field_ut
    sideways_ut = el.hypot(noise_sigma(model, mag.rate_hz), model.quantum / math.sqrt(12.0))
    return sideways_ut / max(horizontal_ut, FIELD_MIN_UT)


def has_compass(mag: MagConfig, field_ut: Sequence[float]) -> bool:
    """Return whether a magnetometer gives a usable heading in the magnetic field of the site [uT; W]."""
    horizontal_ut = el.length(field_ut[:2])
    return horizontal_ut >= FIELD_MIN_UT and heading_sigma(mag, horizontal_ut) <= HEADING_SIGMA_MAX_RAD


Values = tuple[Vector, Vector]
NONE = (0.0, 0.0, 0.0)


class BodyTruth(NamedTuple):
    """The true state of a drone."""

    p_WB: Vector  # m
    v_WB: Vector  # m/s
    q_WB: Quaternion
    w_WB_B: Vector  # rad/s
    a_WB: Vector  # m/s^2, acceleration of the centre of mass
    alpha_B: Vector  # rad/s^2


class MountedSensor(NamedTuple):
    """Pose of a sensor in the body, and the largest range of a range sensor."""

    p_BS: Vector  # m
    q_BS: Quaternion
    range_max: float  # m


class Site(NamedTuple):
    """Gravity and magnetic field at the site of the flight."""

    gravity: float  # m/s^2
    field_W: Vector  # uT, the Earth's magnetic field


@inlined
def sample(s: int, i: int, bodies: Bodies, noise: NoiseRows, senses: Senses, scene: Scene, value: NDArray) -> bool:
    """Write a reading of sensor `s` of drone `i` into `value`, (6,); return False if the reading is lost."""
    config, accel = senses.config[i, s], bodies.accel[i]
    p, v, q, rate = pose(bodies.state[i])
    x = BodyTruth(p, v, q, rate, vector(accel, 0), vector(accel, 3))
    mounted = MountedSensor(vector(config, CONFIG.p_BS), four(config, CONFIG.q_BS), config[CONFIG.limit_max])
    site = Site(bodies.vehicle[i, VEHICLE.gravity], vector(senses.place, PLACE.field_W))
    first, second = _ideal(s, x, mounted, site)
    if scene.tree.part.shape[0] > 0 or bodies.near.above[i] != 0:
        if s == SONAR:
            first = sonar_over(x, mounted, first, scene, bodies.state, bodies.vehicle, i)
        elif s == FLOW:
            beam = senses.config[i, SONAR]
            ranging = MountedSensor(vector(beam, CONFIG.p_BS), four(beam, CONFIG.q_BS), beam[CONFIG.limit_max])
            first = flow_over(x, mounted, ranging, first, scene, bodies.state, bodies.vehicle, i)
    put(value, 0, first)
    put(value, 3, second)
    at = noise.at[s] + noise.cursor[i, s] * noise.width[i, s]
    noise.cursor[i, s] += 1
    height = senses.place[PLACE.height]
    if config[CONFIG.faulty] != 0.0:
        return _read_faulty(s, value, config, senses.bias[i, s], senses.fault[i, s], noise.table[i], at, height)
    return _read(s, value, config, senses.bias[i, s], noise.table[i], at, height)


@inlined
def _ideal(s: int, x: BodyTruth, mounted: MountedSensor, site: Site) -> Values:
    """Return the error-free values of stock sensor `s`."""
    if s == IMU:
        return imu(x, mounted, site)
    if s == GPS:
        return gps(x, mounted, site)
    if s == MAG:
        return mag(x, mounted, site)
    if s == BARO:
        return baro(x, mounted, site)
    if s == SONAR:
        return sonar(x, mounted, site)
    return flow(x, mounted, site)


@inlined
def _read(s: int, value: NDArray, config: NDArray, bias: NDArray, noise: NDArray, at: int, height: float) -> bool:
    """Turn error-free values into a reading, in place; return False if it is lost."""
    n = CHANNELS[s]
    add_errors(n, value, config, bias, noise, at)
    if s == SONAR:
        value[0] = max(value[0], 0.0)
        if value[0] < config[CONFIG.limit_min] or value[0] > config[CONFIG.limit_max]:
            value[1] = 0.0
    elif s == BARO:
        value[1] = value[0]
        value[0] = pressure(height + value[1])
    return noise[at + 2 * n] >= config[CONFIG.drop]


@noinline
def _read_faulty(
    s: int, value: NDArray, config: NDArray, bias: NDArray, fault: NDArray, noise: NDArray, at: int, height: float
) -> bool:
    """Do the same as `_read`, but add the offset of a fault first and apply the hold of a stuck sensor last."""
    displace(CHANNELS[s], value, fault)
    is_received = _read(s, value, config, bias, noise, at, height)
    if is_received:
        hold_reading(value, fault)
    return is_received


@inlined
def sensor_velocity(x: BodyTruth, s: MountedSensor) -> Vector:
    """Return the velocity of the sensor in W: v_WB + R (w × p_BS)."""
    return add(x.v_WB, rotate(x.q_WB, cross(x.w_WB_B, s.p_BS)))


@inlined
def sensor_height(x: BodyTruth, s: MountedSensor) -> float:
    """Return the height of the sensor above the origin of W [m]."""
    return x.p_WB[2] + rotate(x.q_WB, s.p_BS)[2]


@inlined
def imu(x: BodyTruth, s: MountedSensor, site: Site) -> Values:
    """Return the specific force [m/s^2] at the sensor and the body rate [rad/s], both in S.

    f_S = R_SB (R_BW (a_WB - g_W) + alpha × p_BS + w × (w × p_BS)),  w_S = R_SB w    (Titterton and Weston, ch. 3)
    """
    f = rotate_back(x.q_WB, (x.a_WB[0], x.a_WB[1], x.a_WB[2] + site.gravity))
    f = add(f, add(cross(x.alpha_B, s.p_BS), cross(x.w_WB_B, cross(x.w_WB_B, s.p_BS))))
    return rotate_back(s.q_BS, f), rotate_back(s.q_BS, x.w_WB_B)


@inlined
def gps(x: BodyTruth, s: MountedSensor, site: Site) -> Values:
    """Return the position [m] and velocity [m/s] of the antenna in W."""
    return add(x.p_WB, rotate(x.q_WB, s.p_BS)), sensor_velocity(x, s)


@inlined
def mag(x: BodyTruth, s: MountedSensor, site: Site) -> Values:
    """Return the Earth's field in S [uT]."""
    return rotate_back(s.q_BS, rotate_back(x.q_WB, site.field_W)), NONE


@inlined
def baro(x: BodyTruth, s: MountedSensor, site: Site) -> Values:
    """Return the height of the sensor above the origin of W [m]."""
    return (sensor_height(x, s), 0.0, 0.0), NONE


@inlined
def pressure(altitude_m: float) -> float:
    """Return the static pressure [Pa] of the standard atmosphere at an altitude above sea level (ISO 2533).

    The law holds up to 11 km, the limit of scenarios; above, it is extrapolated and reaches vacuum at 44 km.
    """
    return SEA_LEVEL_PA * el.power(max(1.0 - LAPSE_1_M * altitude_m, 0.0), PRESSURE_EXPONENT)


@inlined
def sonar(x: BodyTruth, s: MountedSensor, site: Site) -> Values:
    """Return the distance [m] to the ground along -z of the sensor, and 1 if there is an echo, otherwise 0.

    Without an echo (ground beyond range_max, or beam too far off the vertical), the distance is range_max.
    """
    upright = rotate(x.q_WB, z_axis(s.q_BS))[2]  # cosine of the angle between beam and vertical
    if upright < SONAR_COSINE_MIN:
        return (s.range_max, 0.0, 0.0), NONE
    distance = max(sensor_height(x, s), 0.0) / upright
    return (min(distance, s.range_max), 1.0 if distance <= s.range_max else 0.0, 0.0), NONE


@inlined
def flow(x: BodyTruth, s: MountedSensor, site: Site) -> Values:
    """Return the sensor's velocity [m/s] in the heading frame, and the quality in [0, 1].

    Heading frame: x forward and y left in the horizontal plane, z up. The quality is the cosine of the tilt, a
    measure of how much of the picture shows the ground.
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
    """Add the errors of the first `n` channels to error-free values, in place.

    `noise` holds standard normal variates from index `at` on, as counted by `noise_width`; `bias` holds the biases of
    all channels, then the states of their Gauss-Markov processes, and is advanced in place.
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
    """Add the offset of a fault to the error-free values of a sensor, in place."""
    for k in range(n):
        value[k] += fault[FAULT.offset + k]


@inlined
def hold_reading(value: NDArray, fault: NDArray) -> None:
    """Store the first reading of a stuck sensor, (6,), or overwrite a later one with it, in place."""
    if fault[FAULT.hold] == ARMED:
        fault[FAULT.hold] = HOLDING
        for k in range(CHANNELS_MAX):
            fault[FAULT.held + k] = value[k]
    elif fault[FAULT.hold] == HOLDING:
        for k in range(CHANNELS_MAX):
            value[k] = fault[FAULT.held + k]


@kernel(makes_arrays=False)
def read(n: int, value: NDArray, config: NDArray, bias: NDArray, fault: NDArray, noise: NDArray) -> bool:
    """Turn the error-free values of a user's sensor into a reading, in place; return False if it is lost."""
    displace(n, value, fault)
    add_errors(n, value, config, bias, noise, 0)
    is_received = noise[2 * n] >= config[CONFIG.drop]
    if is_received:
        hold_reading(value, fault)
    return is_received


@inlined
def _beam(x: BodyTruth, s: MountedSensor) -> tuple[Vector, Vector]:
    """Return the position [m] of a sensor and the unit vector along its -z axis, both in W."""
    return add(x.p_WB, rotate(x.q_WB, s.p_BS)), scaled(rotate(x.q_WB, z_axis(s.q_BS)), -1.0)


@inlined
def _hull(state: NDArray, vehicle: NDArray, i: int, o: Vector, d: Vector, far: float) -> tuple[float, int]:
    """Return the distance [m] along a ray to the nearest hull of a drone other than `i`, and that drone; or `far`, -1.

    Args:
        state, vehicle: rows of all drones, as in Bodies.
    """
    nearest, owner = far, -1
    for j in range(state.shape[0]):
        if j != i:
            p, q = vector(state[j], STATE.p_WB), four(state[j], STATE.q_WB)
            distance = cast_hull(p, q, vehicle[j, VEHICLE.hull_radius], o, d, nearest)
            if distance < nearest:
                nearest, owner = distance, j
    return nearest, owner


@noinline
def sonar_over(
    x: BodyTruth, s: MountedSensor, value: Vector, scene: Scene, state: NDArray, vehicle: NDArray, i: int
) -> Vector:
    """Return a sonar's distance [m] to the first object in its beam, and its echo, given those over bare ground.

    As over bare ground, there is no echo if the beam is too far off the vertical.

    Args:
        state, vehicle: rows of all drones, as in Bodies; i: the drone that carries the sonar.
    """
    o, d = _beam(x, s)
    if -d[2] < SONAR_COSINE_MIN:
        return value
    distance, _ = _hull(state, vehicle, i, o, d, cast_parts(scene, o, d, value[0]))
    return (distance, 1.0, 0.0) if distance < value[0] else value


@noinline
def flow_over(
    x: BodyTruth,
    s: MountedSensor,
    ranging: MountedSensor,
    value: Vector,
    scene: Scene,
    state: NDArray,
    vehicle: NDArray,
    i: int,
) -> Vector:
    """Return the velocity [m/s] that a flow sensor reports, given the one over bare ground.

    It is the velocity relative to the surface in the picture, times the distance measured by the sonar over that of the
    surface: correct if both sensors see the same surface. The surface is the one at the centre of the picture. A
    drone's hull counts only if it covers most of the picture; its velocity is that at the point on the optical axis.

    Args:
        ranging: the sonar; state, vehicle: rows of all drones, as in Bodies; i: the drone that carries the sensor.
    """
    o, d = _beam(x, s)
    b, down = _beam(x, ranging)
    max_distance = ranging.range_max
    if -d[2] < SONAR_COSINE_MIN or -down[2] < SONAR_COSINE_MIN:
        return value  # without an echo, the board keeps the last distance
    distance = cast_parts(scene, o, d, max_distance)
    measured, _ = _hull(state, vehicle, i, b, down, cast_parts(scene, b, down, max_distance))
    covered, owner = _hull(state, vehicle, i, o, d, distance)
    if owner >= 0 and not _covers(x, s, scene, state[owner], vehicle[owner, VEHICLE.hull_radius], o, max_distance):
        covered, owner = distance, -1
    if covered >= max_distance and measured >= max_distance:
        return value
    distance, measured = cast_ground(o, d, covered), cast_ground(b, down, measured)
    if distance >= max_distance or measured >= max_distance or distance <= 0.0:
        return value
    u, v = value[0], value[1]
    if owner >= 0:
        arm = subtract(axpy(o, distance, d), vector(state[owner], STATE.p_WB))
        v_hull, psi = velocity_at(state[owner], arm), heading(x.q_WB)
        cos, sin = el.cos(psi), el.sin(psi)
        u, v = u - (cos * v_hull[0] + sin * v_hull[1]), v - (cos * v_hull[1] - sin * v_hull[0])
    return (u * measured / distance, v * measured / distance, value[2])


@inlined
def _covers(x: BodyTruth, s: MountedSensor, scene: Scene, hull: NDArray, radius: float, o: Vector, far: float) -> bool:
    """Return whether the hull at the centre of the picture covers most of it."""
    cells, share = 0, 2.0 / 3.0
    for k in range(len(CELLS)):
        ahead, aside = share * HALF_VIEW[0] * CELLS[k][0], share * HALF_VIEW[1] * CELLS[k][1]
        scale = 1.0 / math.sqrt(ahead * ahead + aside * aside + 1.0)
        d = rotate(x.q_WB, rotate(s.q_BS, (ahead * scale, aside * scale, -scale)))
        background = cast_parts(scene, o, d, far)
        if cast_hull(vector(hull, STATE.p_WB), four(hull, STATE.q_WB), radius, o, d, background) < background:
            cells += 1
    return cells >= CELLS_MIN
