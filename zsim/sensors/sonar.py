"""The sonar, or another ranger that looks down."""

from zsim.schema.message import Number
from zsim.schema.quantities import NonNegative, Positive
from zsim.sensors.sensor import Channel, ErrorModel, Sample, Sensor, SensorType


class Sonar(Sample, frozen=True):
    """Distance to the ground along the beam [m]; without an echo it is not `valid`."""

    range_m: Number
    valid: bool


class SonarConfig(Sensor, frozen=True, kw_only=True):
    range_m: ErrorModel = ErrorModel()
    min_m: NonNegative = 0.03
    max_m: Positive = 6.0


SONAR_PRESET = {
    "rate_hz": 25.0,  # Hz, ultrasound_freq 8 of the AR.Drone's configuration
    "range_m": {"noise": 0.01},  # m, chosen: what grass and tilt add to the 0.5 mm per LSB of the converter
}
SONAR_PRESETS = {
    "ardrone2": SONAR_PRESET,
    "paper": SONAR_PRESET,  # it is silent
    "crazyflie2": {
        "rate_hz": 25.0,  # Hz, chosen as the AR.Drone's
        "range_m": {"noise": 0.02},  # m, chosen, with floor and tilt; crazyflie-firmware, zranger2.c, has 2.5 mm
        "max_m": 4.0,  # m, VL53L1x; at 4 m zranger2.c has 0.2 m
    },
}

SONAR = SensorType(
    label="sonar",
    message=Sonar,
    settings=SonarConfig,
    channels=(Channel("range_m", "m", axes="of range", bias_max=1e4),),
    exact=1,
    presets=SONAR_PRESETS,
)
