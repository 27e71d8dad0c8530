"""The sensors of a fleet as arrays: errors, mounts and schedules, a row per drone and sensor."""

import math
from fractions import Fraction
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from zsim.math.columns import Field, columns
from zsim.math.frames import quaternion_from_rpy
from zsim.scenario.scenario import ErrorModel, MagConfig, Scenario, Sensor, Sensors
from zsim.scenario.sensor_presets import BOARD_RATE_HZ

SensorName = Literal["imu", "gps", "mag", "baro", "sonar", "flow"]
SENSORS: tuple[SensorName, ...] = ("imu", "gps", "mag", "baro", "sonar", "flow")  # the contract's order
IMU, GPS, MAG, BARO, SONAR, FLOW = range(6)
CHANNELS = (6, 6, 3, 1, 1, 3)  # numbers with an error of their own
VALUES = (6, 6, 3, 2, 2, 4)  # numbers of a sample as the kernel gives it (pressure, validity, quality added)
CHANNELS_MAX = 6
NOISE_WIDTH = tuple(2 * n + 1 for n in CHANNELS)  # per sample: white, walk of the bias, and one for drop-out

CONFIG = columns(  # of each drone and sensor
    "SensorColumns",
    (
        Field("white", "channel's", CHANNELS_MAX),  # standard deviation per sample
        Field("walk", "channel's", CHANNELS_MAX),  # standard deviation of the bias's step per sample
        Field("quantum", "channel's", CHANNELS_MAX),
        Field("p_BS", "m", 3),
        Field("q_BS", "1", 4),
        Field("drop", "1"),  # a sample is lost when its standard normal number is below this
        Field("limit_min", "m"),  # of the sonar
        Field("limit_max", "m"),
        Field("faulty", "1"),  # 0: the fault row below has no say
    ),
)
FAULT = columns(  # of each drone and sensor
    "SensorFaultColumns",
    (
        Field("offset", "channel's", CHANNELS_MAX),  # added to the errorless values
        Field("hold", "1"),  # FREE; ARMED: the next sample is kept; HOLDING: it is given again and again
        Field("held", "channel's", CHANNELS_MAX),
    ),
)
FREE, ARMED, HOLDING = 0.0, 1.0, 2.0
SCHEDULE = columns(  # sample n falls due at the first physics tick >= n * numerator / denominator
    "ScheduleColumns", (Field("numerator", "1"), Field("denominator", "1"), Field("count", "1"), Field("due", "tick"))
)
DENOMINATOR_MAX = 1000  # of a rate in Hz: any is met within 0.05 %, and n * numerator stays below 2^63


def rate_of(sensor: Sensor, name: str) -> float:
    """Return the rate [Hz] at which the device samples: the IMU always at the board's."""
    return BOARD_RATE_HZ if name == "imu" else sensor.rate_hz


def channels(sensors: Sensors, name: str) -> list[ErrorModel]:
    """Return the error models of the channels of one sensor, in the order of its values and in SI units."""
    if name == "imu":
        return [sensors.imu.accel_m_s2] * 3 + [radians(sensors.imu.gyro_deg_s)] * 3
    if name == "gps":
        return [sensors.gps.position_m] * 3 + [sensors.gps.velocity_m_s] * 3
    if name == "mag":
        return [sensors.mag.field_ut] * 3
    if name == "flow":
        return [sensors.flow.velocity_m_s] * 3
    return [sensors.baro.altitude_m] if name == "baro" else [sensors.sonar.range_m]


def radians(model: ErrorModel) -> ErrorModel:
    """Return an error model given in degrees as one in radians."""
    return ErrorModel(**{field: math.radians(getattr(model, field)) for field in ErrorModel.__struct_fields__})


def noise_sigma(model: ErrorModel, rate_hz: float) -> float:
    """Return the standard deviation of a sample's white noise: noise, and density over the device's rate."""
    return math.hypot(model.noise, model.density * math.sqrt(rate_hz))


def config(scenario: Scenario) -> NDArray[np.float64]:
    """Return errors and mounts of all sensors, shape (N, 6, CONFIG.size)."""
    table = np.zeros((len(scenario.drones), len(SENSORS), CONFIG.size))
    for i, drone in enumerate(scenario.drones):
        for s, name in enumerate(SENSORS):
            _fill(table[i, s], drone.sensors, name)
    return table


def _fill(row: NDArray[np.float64], sensors: Sensors, name: str) -> None:
    sensor: Sensor = getattr(sensors, name)
    rate = rate_of(sensor, name)
    for k, model in enumerate(channels(sensors, name)):
        row[CONFIG.white + k] = noise_sigma(model, rate)
        row[CONFIG.walk + k] = model.bias_walk / math.sqrt(rate)
        row[CONFIG.quantum + k] = model.quantum
    row[CONFIG.p_BS : CONFIG.p_BS + 3] = sensor.mount.position_m
    row[CONFIG.q_BS : CONFIG.q_BS + 4] = quaternion_from_rpy(np.radians(sensor.mount.rpy_deg))
    row[CONFIG.drop] = ndtri(sensor.dropout)
    row[CONFIG.limit_min], row[CONFIG.limit_max] = sensors.sonar.min_m, sensors.sonar.max_m


def schedule(scenario: Scenario) -> NDArray[np.int64]:
    """Return the time tables of all published sensors, shape (N, 6, SCHEDULE.size), with sample 0 due at tick 0."""
    table = np.zeros((len(scenario.drones), len(SENSORS), SCHEDULE.size), dtype=np.int64)
    tick_us = round(scenario.time.physics_dt_ms * 1000)
    for i, drone in enumerate(scenario.drones):
        for s, name in enumerate(SENSORS):
            sensor: Sensor = getattr(drone.sensors, name)
            rate = Fraction(sensor.rate_hz).limit_denominator(DENOMINATOR_MAX)
            period = 1_000_000 / rate / tick_us  # in ticks
            table[i, s, SCHEDULE.numerator], table[i, s, SCHEDULE.denominator] = period.numerator, period.denominator
    return table


def heading_sigma(mag: MagConfig, horizontal_ut: float) -> float:
    """Return the standard deviation [rad] of a heading from one magnetometer sample."""
    model = mag.field_ut
    return math.hypot(noise_sigma(model, mag.rate_hz), model.quantum / math.sqrt(12.0)) / max(horizontal_ut, 1.0)
