"""Stock sensors: message, settings, channels and presets of each.

Their equations are compiled in zsim_world.sensors. The preset `paper` follows the paper of Mas, Curi and Sánchez Peña;
where it specifies nothing, the values are those of the AR.Drone unless a comment states another source.
"""

import math

from zsim.schema.message import Count, Number, Vector3
from zsim.schema.quantities import G_M_S2, NonNegative, Positive
from zsim.sensors.sensor import Channel, ErrorModel, Sample, Sensor, SensorType

BOARD_RATE_HZ = 200.0  # Hz, rate of IMU samples and firmware steps on the AR.Drone 2.0's navigation board


class Imu(Sample, frozen=True):
    """Specific force [m/s^2] and body rate [rad/s] in sensor axes; at rest and level, the force is (0, 0, +9.81)."""

    accel_m_s2: Vector3
    gyro_rad_s: Vector3


class ImuConfig(Sensor, frozen=True, kw_only=True):
    accel_m_s2: ErrorModel = ErrorModel()
    gyro_deg_s: ErrorModel = ErrorModel()


# The maximum biases are about ten times what any such sensor can show, so that only mistakes are refused.
IMU = SensorType(
    label="IMU",
    message=Imu,
    settings=ImuConfig,
    channels=(
        Channel("accel_m_s2", "m/s^2", 3, 1.0, "accel", "accelerometer", "in the sensor's axes", 500.0),
        Channel("gyro_deg_s", "deg/s", 3, math.pi / 180.0, "gyro", "gyroscope", "in the sensor's axes", 5700.0),
    ),
    presets={
        "ardrone2": {
            "rate_hz": BOARD_RATE_HZ,
            "accel_m_s2": {
                "noise": 0.031,  # m/s^2, mean of three axes over 1200 s static
                "bias": 0.05,  # m/s^2, remaining after six-position calibration: 2 to 3 LSB of 19 mm/s^2
                "bias_walk": 0.0005,  # m/s^2/sqrt(s), from an Allan minimum of 0.003-0.005 m/s^2 at 10-30 s
                "quantum": 0.019,  # m/s^2 per LSB, 12 bits
            },
            "gyro_deg_s": {
                "noise": 0.06,  # deg/s at 200 Hz, 100 s static
                "bias": 0.1,  # deg/s, remaining after the drone's own offset removal at start
                "bias_walk": 0.003,  # deg/s/sqrt(s), from an Allan minimum of 0.003-0.006 deg/s at 3-5 s
                "quantum": 0.061,  # deg/s per LSB: 16.4 LSB/(deg/s)
            },
        },
        "paper": {
            "rate_hz": BOARD_RATE_HZ,
            "accel_m_s2": {"noise": 0.35},  # m/s^2, default of the paper's base simulator (tum_simulator)
            "gyro_deg_s": {"noise": 0.01},  # deg/s, section VI
        },
        "crazyflie2": {
            "rate_hz": BOARD_RATE_HZ,
            "accel_m_s2": {
                "density": 0.0017,  # m/s^2/sqrt(Hz), 175 ug/sqrt(Hz) (data sheet of the BMI088)
                "bias": 0.05,  # m/s^2, remaining after calibration; assumed equal to the AR.Drone's
                "bias_walk": 0.0005,  # m/s^2/sqrt(s), assumed equal to the AR.Drone's
                "quantum": 0.0072,  # m/s^2 per LSB: ±24 g in 16 bits (crazyflie-firmware, sensors_bmi088_bmp3xx.c)
            },
            "gyro_deg_s": {
                "density": 0.014,  # deg/s/sqrt(Hz) (data sheet of the BMI088)
                "bias": 0.1,  # deg/s, remaining after the firmware's calibration at start; assumed as for the AR.Drone
                "bias_walk": 0.003,  # deg/s/sqrt(s), assumed equal to the AR.Drone's
                "quantum": 0.061,  # deg/s per LSB: ±2000 deg/s in 16 bits (crazyflie-firmware, same file)
            },
        },
    },
)
IMU_AS_PRINTED = {"accel_m_s2": {"noise": 0.35 * G_M_S2}}  # m/s^2, section VI: "std errors 0.35 g"


class Gps(Sample, frozen=True):
    """A fix of the antenna: position in WGS 84 (deg, m) and in W [m], and velocity in W [m/s].

    `sigma_m` is the standard deviation of the position per axis; `fix` is the NMEA fix type, 3 for a 3D fix.
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


GPS = SensorType(
    label="GPS",
    message=Gps,
    settings=GpsConfig,
    channels=(
        Channel("position_m", "m", 3, axes="east, north, up", bias_max=1e5),
        Channel("velocity_m_s", "m/s", 3),
    ),
    presets={
        "ardrone2": {
            "rate_hz": 5.0,  # Hz, Paparazzi's model of the ardrone2
            "latency_ms": 200.0,  # ms, Paparazzi's model of the ardrone2
            "position_m": {"noise": 2.0},  # m, Paparazzi's model of the ardrone2
            "velocity_m_s": {"noise": 0.43},  # m/s, field `ehve` of a navdata packet from a real drone
        },
        "paper": {
            "rate_hz": 5.0,  # Hz, as for the AR.Drone
            "position_m": {"noise": 2.0},  # m, section VI
            "velocity_m_s": {"noise": 0.43},  # m/s, as for the AR.Drone
        },
        "crazyflie2": {
            "rate_hz": 10.0,  # Hz, assumed
            "position_m": {"noise": 0.1},  # m, typical of ultra-wideband ranging to anchors in a room
            "velocity_m_s": {"noise": 0.2},  # m/s, assumed
        },
    },
)


class Mag(Sample, frozen=True):
    """The Earth's magnetic field in the axes of the sensor [uT]."""

    field_ut: Vector3


class MagConfig(Sensor, frozen=True, kw_only=True):
    field_ut: ErrorModel = ErrorModel()


_MAG_RATE_HZ = 25.0  # Hz, design choice: the sonar's rate; the aircraft's magnetometer is faster
MAG = SensorType(
    label="magnetometer",
    message=Mag,
    settings=MagConfig,
    channels=(Channel("field_ut", "uT", 3, axes="in the sensor's axes", bias_max=1e4),),
    presets={
        "ardrone2": {"rate_hz": _MAG_RATE_HZ, "field_ut": {"noise": 0.3, "quantum": 0.3}},  # AK8975: 0.3 uT per LSB
        # 0.94 uT turns a horizontal field of 18 uT by 3 deg; assumed, since the paper states none
        "paper": {"rate_hz": _MAG_RATE_HZ, "field_ut": {"noise": 0.94}},
        # AK8963 of the Crazyflie 2.0, 0.15 uT per LSB; the 2.1 has no magnetometer (crazyflie-firmware, issue 701)
        "crazyflie2": {"rate_hz": _MAG_RATE_HZ, "field_ut": {"noise": 0.3, "quantum": 0.15}},
    },
)


class Baro(Sample, frozen=True):
    """Static pressure [Pa], and the corresponding height above the origin of W [m]."""

    pressure_pa: Number
    altitude_m: Number


class BaroConfig(Sensor, frozen=True, kw_only=True):
    altitude_m: ErrorModel = ErrorModel()


_BARO_PRESET = {
    "rate_hz": 25.0,  # Hz, design choice: the sonar's rate
    "altitude_m": {"noise": 0.1},  # m, twice that of Paparazzi's model of the ardrone2, to allow for rotor wash
}
BARO = SensorType(
    label="barometer",
    message=Baro,
    settings=BaroConfig,
    channels=(Channel("altitude_m", "m", axes="of height", bias_max=1e4),),
    exact=1,
    presets=dict.fromkeys(("ardrone2", "paper", "crazyflie2"), _BARO_PRESET),
)


class Sonar(Sample, frozen=True):
    """Distance to the ground along the beam [m]; not `valid` without an echo."""

    range_m: Number
    valid: bool


class SonarConfig(Sensor, frozen=True, kw_only=True):
    range_m: ErrorModel = ErrorModel()
    min_m: NonNegative = 0.03
    max_m: Positive = 6.0


_SONAR_PRESET = {
    "rate_hz": 25.0,  # Hz, ultrasound_freq 8 of the AR.Drone's configuration
    "range_m": {"noise": 0.01},  # m, assumed effect of grass and tilt, far above the converter's 0.5 mm per LSB
}
SONAR = SensorType(
    label="sonar",
    message=Sonar,
    settings=SonarConfig,
    channels=(Channel("range_m", "m", axes="of range", bias_max=1e4),),
    exact=1,
    presets={
        "ardrone2": _SONAR_PRESET,
        "paper": _SONAR_PRESET,
        "crazyflie2": {
            "rate_hz": 25.0,  # Hz, design choice: the AR.Drone's rate
            "range_m": {"noise": 0.02},  # m, assumed, including floor and tilt; zranger2.c of its firmware has 2.5 mm
            "max_m": 4.0,  # m, VL53L1x; zranger2.c has a standard deviation of 0.2 m there
        },
    },
)


class Flow(Sample, frozen=True):
    """Velocity over the ground in the heading frame [m/s], and the share of the picture that shows ground, 0 to 1."""

    velocity_m_s: Vector3
    quality: Number


class FlowConfig(Sensor, frozen=True, kw_only=True):
    velocity_m_s: ErrorModel = ErrorModel()


_FLOW_PRESET = {
    "rate_hz": 15.0,  # Hz, rate of the reduced navdata, which contain the drone's velocity
    "velocity_m_s": {"noise": 0.1},  # m/s, assumed: no value is published for the aircraft's optical flow
}
FLOW = SensorType(
    label="optical flow",
    message=Flow,
    settings=FlowConfig,
    channels=(Channel("velocity_m_s", "m/s", 3, axes="forward, left, up", bias_max=1e3),),
    exact=1,
    presets={
        "ardrone2": _FLOW_PRESET,
        "paper": _FLOW_PRESET,
        "crazyflie2": {"rate_hz": 25.0, "velocity_m_s": {"noise": 0.1}},  # assumed; no values are published
    },
)
