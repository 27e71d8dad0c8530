"""The satellite receiver: position and velocity of its antenna."""

from zsim.schema.message import Count, Number, Vector3
from zsim.sensors.sensor import Channel, ErrorModel, Sample, Sensor, SensorType

GPS_RATE_HZ = 5.0  # Hz, Paparazzi's model of the ardrone2
SPEED_NOISE = {"noise": 0.43}  # m/s, ehve of a real navdata packet; the paper is silent


class Gps(Sample, frozen=True):
    """A fix of the antenna: WGS 84 (deg, m), the same in W [m], velocity in W [m/s].

    `sigma_m` is the standard deviation of the position per axis; `fix` as in NMEA, 3 for three dimensions.
    """

    latitude_deg: Number
    longitude_deg: Number
    altitude_m: Number
    position_m: Vector3
    velocity_m_s: Vector3
    sigma_m: Number
    fix: Count
    satellites: Count


class GpsConfig(Sensor, frozen=True, kw_only=True):
    position_m: ErrorModel = ErrorModel()
    velocity_m_s: ErrorModel = ErrorModel()


GPS_PRESETS = {
    "ardrone2": {
        "rate_hz": GPS_RATE_HZ,
        "latency_ms": 200.0,  # ms, Paparazzi's model of the ardrone2
        "position_m": {"noise": 2.0},  # m, likewise
        "velocity_m_s": SPEED_NOISE,
    },
    "paper": {
        "rate_hz": GPS_RATE_HZ,
        "position_m": {"noise": 2.0},  # m, section VI
        "velocity_m_s": SPEED_NOISE,
    },
    "crazyflie2": {
        "rate_hz": 10.0,  # Hz, chosen
        "position_m": {"noise": 0.1},  # m, chosen: what ultra-wideband ranging to anchors in a room usually reaches
        "velocity_m_s": {"noise": 0.2},  # m/s, chosen
    },
}

GPS = SensorType(
    label="GPS",
    message=Gps,
    settings=GpsConfig,
    channels=(
        Channel("position_m", "m", 3, axes="east, north, up", bias_max=1e5),
        Channel("velocity_m_s", "m/s", 3),
    ),
    presets=GPS_PRESETS,
)
