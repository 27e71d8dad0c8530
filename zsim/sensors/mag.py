"""The magnetometer."""

from zsim.schema.message import Vector3
from zsim.sensors.sensor import Channel, ErrorModel, Sample, Sensor, SensorType

MAG_RATE_HZ = 25.0  # Hz, chosen as the sonar's, the aircraft's magnetometer gives more


class Mag(Sample, frozen=True):
    """The Earth's field in the axes of the sensor [uT]."""

    field_ut: Vector3


class MagConfig(Sensor, frozen=True, kw_only=True):
    field_ut: ErrorModel = ErrorModel()


MAG_PRESETS = {
    "ardrone2": {"rate_hz": MAG_RATE_HZ, "field_ut": {"noise": 0.3, "quantum": 0.3}},  # AK8975: 0.3 uT per LSB
    # 0.94 uT: 3 deg of a horizontal field of 18 uT; chosen, the paper is silent
    "paper": {"rate_hz": MAG_RATE_HZ, "field_ut": {"noise": 0.94}},
    "crazyflie2": {
        "rate_hz": MAG_RATE_HZ,
        "field_ut": {"noise": 0.3, "quantum": 0.15},
    },  # AK8963 of the 2.0, 0.15 uT per LSB; the 2.1 has none (crazyflie-firmware, issue 701)
}

MAG = SensorType(
    label="magnetometer",
    message=Mag,
    settings=MagConfig,
    channels=(Channel("field_ut", "uT", 3, axes="in the sensor's axes", bias_max=1e4),),
    presets=MAG_PRESETS,
)
