"""The sensors of a fleet as arrays: errors, mounts and schedules, a row per drone and sensor."""

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.math import elementary as el
from zsim.math.compiled import Field, columns
from zsim.math.frames import quaternion_from_rpy
from zsim.math.randomness import normal_quantile
from zsim.scenario.scenario import Scenario
from zsim.sensors.sensor import VALUES_MAX, ErrorModel, Sensor, SensorType, noise_sigma
from zsim.sensors.sensor_catalogue import STOCK, Sensors
from zsim.sensors.stock_sensors import BOARD_RATE_HZ, MagConfig, SonarConfig

SENSORS = tuple(STOCK)  # the contract's order; a user's own count on from there
IMU, GPS, MAG, BARO, SONAR, FLOW = range(len(SENSORS))
CHANNELS = tuple(kind.width for kind in STOCK.values())  # numbers with an error of their own
CHANNELS_MAX = VALUES_MAX
NEVER = 2**63 - 1  # a tick that does not come

CONFIG = columns(  # of each drone and sensor
    "SensorColumns",
    (
        Field("white", "channel's", CHANNELS_MAX),  # standard deviation per sample
        Field("walk", "channel's", CHANNELS_MAX),  # standard deviation of the bias's step per sample
        Field("quantum", "channel's", CHANNELS_MAX),
        Field("correlated", "1"),  # 0: no channel has an error that is a Gauss-Markov process
        Field("decay", "1", CHANNELS_MAX),  # of that error from sample to sample
        Field("kick", "channel's", CHANNELS_MAX),  # standard deviation of what it gains per sample
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
FIELD_MIN_UT = 1.0  # uT, of a horizontal field that still gives a heading: a fifteenth of that at 50 degrees north
HEADING_SIGMA_MAX_RAD = 0.5  # rad, chosen: noisier, samples wrap around, and their mean is no heading
DENOMINATOR_MAX = 1000  # of a rate in Hz: any is met within 0.05 %, and n * numerator stays below 2^63


class FleetSensors(NamedTuple):
    """The sensors of all drones: stock sensors, then users' sensors by name."""

    names: tuple[str, ...]
    types: tuple[SensorType, ...]
    settings: list[list[Sensor | None]]  # of each drone, in the order of the names; None: it has no such sensor


def fleet_sensors(scenario: Scenario) -> FleetSensors:
    """Return the sensors of a scenario's drones; external drones have none here.

    Raises:
        DocumentError: a user's module is missing, or differs from the one with which the scenario was resolved.
    """
    sections = [list(drone.sensors.sections()) for drone in scenario.drones]
    kinds = {name: kind for of_drone in sections for name, kind, _ in of_drone if name not in STOCK}
    names = (*SENSORS, *sorted(kinds))
    simulated = [() if drone.is_external else of for drone, of in zip(scenario.drones, sections, strict=True)]
    own = [{name: settings for name, _, settings in of_drone} for of_drone in simulated]
    types = STOCK | kinds
    return FleetSensors(names, tuple(types[n] for n in names), [[each.get(n) for n in names] for each in own])


def rate_of(sensor: Sensor, name: str) -> float:
    """Return the rate [Hz] at which a device samples; the IMU samples at the rate of the board."""
    return BOARD_RATE_HZ if name == "imu" else sensor.rate_hz


def channels(sensors: Sensors, name: str) -> list[ErrorModel]:
    """Return the error models of the channels of a stock sensor, in the order of its values and in SI units."""
    return STOCK[name].errors(getattr(sensors, name))


def config(sensors: FleetSensors) -> NDArray[np.float64]:
    """Return errors and mounts of all sensors, shape (N, S, CONFIG.size)."""
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
                if sigma := model.correlated_sigma:  # exact: Brown and Hwang, "Random signals", section 5.3
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
    """Return the number of normal numbers per sample: white, bias walk, one for drop-out, Gauss-Markov if any."""
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
    """Return t_ns - t_sample_ns of each drone and sensor [ns], (N, S)."""
    ms = [[0.0 if each is None else each.latency_ms for each in own] for own in sensors.settings]
    return np.array([[round(latency * 1_000_000) for latency in own] for own in ms])


def samples_per_gate(sensors: FleetSensors, gate_ms: float) -> int:
    """Return the largest number of samples that all drones together take in one gate."""
    rates = [
        rate_of(settings, name)
        for own in sensors.settings
        for name, settings in zip(sensors.names, own, strict=True)
        if settings is not None
    ]
    return sum(math.ceil(gate_ms / 1000.0 * rate) + 1 for rate in rates)


def heading_sigma(mag: MagConfig, horizontal_ut: float) -> float:
    """Return the standard deviation [rad] of a heading from one magnetometer sample, from the sideways field."""
    model = mag.field_ut
    sideways_ut = el.hypot(noise_sigma(model, mag.rate_hz), model.quantum / math.sqrt(12.0))
    return sideways_ut / max(horizontal_ut, FIELD_MIN_UT)


def has_compass(mag: MagConfig, field_ut: Sequence[float]) -> bool:
    """Return whether a magnetometer gives a heading in the magnetic field of the place [uT; W]."""
    horizontal_ut = el.length(field_ut[:2])
    return horizontal_ut >= FIELD_MIN_UT and heading_sigma(mag, horizontal_ut) <= HEADING_SIGMA_MAX_RAD
