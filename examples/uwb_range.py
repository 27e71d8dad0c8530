"""A custom sensor: the range from a drone's UWB tag to an anchor at a fixed position.

    zsim run scenarios/step.yaml --set 'sensors.my_uwb={module: uwb_range, anchor_m: [0, 0, 2]}'

The module is found on Python's path (`PYTHONPATH=examples`) or in the folder of the scenario file. For several
anchors, declare several sensors with this module.
"""

from collections.abc import Sequence

import numpy as np

from zsim.scenario.scenario import Environment
from zsim.schema.message import Number
from zsim.schema.quantities import Vector3
from zsim.sensors.sensor import Channel, ErrorModel, RateHz, Sample, Sensor, SensorTruth, SensorType


class UwbRange(Sample, frozen=True):
    """Distance between the antennas of tag and anchor [m]."""

    range_m: Number


class UwbConfig(Sensor, frozen=True, kw_only=True):
    rate_hz: RateHz = 10.0  # Hz; an assumption, as if ten tags took turns
    range_m: ErrorModel = ErrorModel(noise=0.1)  # m; data sheet of the DWM1000: 10 cm
    anchor_m: Vector3 = (0.0, 0.0, 0.0)  # in W


def distance(truth: SensorTruth, settings: UwbConfig, environment: Environment) -> Sequence[float]:
    """Return |p_WS - p_WA| [m], from the sensor S to the anchor A."""
    return [float(np.linalg.norm(truth.p_WS - settings.anchor_m))]


SENSOR = SensorType(
    label="UWB ranger",
    message=UwbRange,
    settings=UwbConfig,
    channels=(Channel("range_m", "m", axes="of range"),),
    equation=distance,
)
