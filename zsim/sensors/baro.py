"""The barometer: static pressure and the height that it stands for."""

from zsim.schema.message import Number
from zsim.sensors.sensor import Channel, ErrorModel, Sample, Sensor, SensorType


class Baro(Sample, frozen=True):
    """Static pressure [Pa], and the height over the origin of W that it stands for [m]."""

    pressure_pa: Number
    altitude_m: Number


class BaroConfig(Sensor, frozen=True, kw_only=True):
    altitude_m: ErrorModel = ErrorModel()


BARO_PRESET = {
    "rate_hz": 25.0,  # Hz, chosen as the sonar's
    "altitude_m": {"noise": 0.1},  # m, chosen: twice Paparazzi's model of the ardrone2, for the wash of the rotors
}

BARO = SensorType(
    label="barometer",
    message=Baro,
    settings=BaroConfig,
    channels=(Channel("altitude_m", "m", axes="of height", bias_max=1e4),),
    exact=1,
    presets=dict.fromkeys(("ardrone2", "paper", "crazyflie2"), BARO_PRESET),  # the paper is silent
)
