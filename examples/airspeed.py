"""A custom sensor: airspeed from a pitot tube along the sensor's x axis.

    PYTHONPATH=examples zsim run scenarios/step.yaml \
        --set 'sensors.pitot={module: airspeed, mount: {position_m: [0.15, 0, 0]}}'

The error model applies to the differential pressure, and follows the data sheet of Sensirion's SDP31-500Pa.
"""

import math
from collections.abc import Sequence

from zsim.scenario.scenario import Environment
from zsim.schema.message import Number
from zsim.sensors.sensor import Channel, ErrorModel, RateHz, Sample, Sensor, SensorTruth, SensorType


class Airspeed(Sample, frozen=True):
    """Differential pressure [Pa], and the corresponding airspeed along the tube [m/s]."""

    pressure_pa: Number
    airspeed_m_s: Number


class PitotConfig(Sensor, frozen=True, kw_only=True):
    rate_hz: RateHz = 50.0  # Hz; an assumption: the SDP31 supports up to 2000 Hz
    pressure_pa: ErrorModel = ErrorModel(
        noise=0.1,  # Pa; zero-point repeatability of the SDP31
        bias=0.2,  # Pa; zero-point accuracy of the SDP31
        quantum=1 / 60,  # Pa; reciprocal of the SDP31's scale factor
    )


def pressure(truth: SensorTruth, settings: PitotConfig, environment: Environment) -> Sequence[float]:
    """Return rho / 2 u |u| [Pa], u being the sensor's speed through the air along its x axis."""
    u = (truth.R_WS.T @ (truth.v_WS - truth.air_W))[0]
    return [0.5 * environment.air_density_kg_m3 * u * abs(u)]


def speed(reading: Sequence[float], settings: PitotConfig, environment: Environment) -> Sequence[float]:
    """Return the values of the message: the pressure [Pa] and the corresponding airspeed [m/s]."""
    pascals = reading[0]
    return [pascals, math.copysign(math.sqrt(2.0 * abs(pascals) / environment.air_density_kg_m3), pascals)]


SENSOR = SensorType(
    label="pitot tube",
    message=Airspeed,
    settings=PitotConfig,
    channels=(Channel("pressure_pa", "Pa", axes="of pressure"),),
    equation=pressure,
    convert=speed,
)
