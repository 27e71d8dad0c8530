"""Sensor presets: plain dictionaries in the shape of a scenario's `sensors:` section.

`ardrone2` is measured on a real AR.Drone 2.0 standing still unless said otherwise; `paper` is the set-up of
Mas, Curi and Sánchez Peña, "Open-source Multi-UAV Simulator for the ROS Environment", section VI; `crazyflie2` is a
Crazyflie 2.1 with its flow deck and the magnetometer of the 2.0, in a room with radio positioning in place of GPS.
"""

from typing import Any

G_M_S2 = 9.80665  # m/s^2, standard gravity, ISO 80000-3
SEA_LEVEL_KG_M3 = 1.225  # kg/m^3, density of the standard atmosphere at sea level and 15 deg C, ISO 2533
BOARD_RATE_HZ = 200.0  # Hz, navigation board of the AR.Drone 2.0: its IMU samples and its firmware steps
GPS_RATE_HZ = 5.0  # Hz, Paparazzi's model of the ardrone2
SLOW_RATE_HZ = 25.0  # Hz, of magnetometer and barometer; chosen as the sonar's, the aircraft's magnetometer gives more

# Of both presets, for the paper is silent about them
BARO = {
    "rate_hz": SLOW_RATE_HZ,
    "altitude_m": {"noise": 0.1},  # m, chosen: twice Paparazzi's model of the ardrone2, for the wash of the rotors
}
SONAR = {
    "rate_hz": 25.0,  # Hz, ultrasound_freq 8 of the AR.Drone's configuration
    "range_m": {"noise": 0.01},  # m, chosen: what grass and tilt add to the 0.5 mm per LSB of the converter
}
FLOW = {
    "rate_hz": 15.0,  # Hz, of the reduced navdata in which the drone tells its velocity
    "velocity_m_s": {"noise": 0.1},  # m/s, chosen: nothing is published for the aircraft's flow
}

PRESETS: dict[str, dict[str, Any]] = {
    "ardrone2": {
        "imu": {
            "rate_hz": BOARD_RATE_HZ,
            "accel_m_s2": {
                "noise": 0.031,  # m/s^2, mean of three axes over 1200 s static
                "bias": 0.05,  # m/s^2, left after six-position calibration: 2 to 3 LSB of 19 mm/s^2
                "bias_walk": 0.0005,  # m/s^2/sqrt(s), from an Allan minimum of 0.003-0.005 m/s^2 at 10-30 s
                "quantum": 0.019,  # m/s^2 per LSB, 12 bits
            },
            "gyro_deg_s": {
                "noise": 0.06,  # deg/s at 200 Hz, 100 s static
                "bias": 0.1,  # deg/s, left after the drone's own offset removal at start
                "bias_walk": 0.003,  # deg/s/sqrt(s), from an Allan minimum of 0.003-0.006 deg/s at 3-5 s
                "quantum": 0.061,  # deg/s per LSB: 16.4 LSB/(deg/s)
            },
        },
        "gps": {
            "rate_hz": GPS_RATE_HZ,
            "latency_ms": 200.0,  # ms, Paparazzi's model of the ardrone2
            "position_m": {"noise": 2.0},  # m, likewise
            "velocity_m_s": {"noise": 0.43},  # m/s, ehve of a real navdata packet
        },
        "mag": {"rate_hz": SLOW_RATE_HZ, "field_ut": {"noise": 0.3, "quantum": 0.3}},  # AK8975: 0.3 uT per LSB
        "baro": BARO,
        "sonar": SONAR,
        "flow": FLOW,
    },
    "paper": {
        "imu": {
            "rate_hz": BOARD_RATE_HZ,
            "accel_m_s2": {"noise": 0.35},  # m/s^2, default of the paper's base simulator (tum_simulator)
            "gyro_deg_s": {"noise": 0.01},  # deg/s, section VI
        },
        "gps": {
            "rate_hz": GPS_RATE_HZ,
            "position_m": {"noise": 2.0},  # m, section VI
            "velocity_m_s": {"noise": 0.43},  # m/s, ehve of a real navdata packet; the paper is silent
        },
        # 0.94 uT: 3 deg of a horizontal field of 18 uT; chosen, the paper is silent
        "mag": {"rate_hz": SLOW_RATE_HZ, "field_ut": {"noise": 0.94}},
        "baro": BARO,
        "sonar": SONAR,
        "flow": FLOW,
    },
    "crazyflie2": {
        "imu": {
            "rate_hz": BOARD_RATE_HZ,
            "accel_m_s2": {
                "density": 0.0017,  # m/s^2/sqrt(Hz), 175 ug/sqrt(Hz) (data sheet of the BMI088)
                "bias": 0.05,  # m/s^2, left after calibration; chosen as the AR.Drone's
                "bias_walk": 0.0005,  # m/s^2/sqrt(s), chosen as the AR.Drone's
                "quantum": 0.0072,  # m/s^2 per LSB: 24 g in 16 bits (crazyflie-firmware, sensors_bmi088_bmp3xx.c)
            },
            "gyro_deg_s": {
                "density": 0.014,  # deg/s/sqrt(Hz) (data sheet of the BMI088)
                "bias": 0.1,  # deg/s, left after the firmware's own calibration at start; chosen as the AR.Drone's
                "bias_walk": 0.003,  # deg/s/sqrt(s), chosen as the AR.Drone's
                "quantum": 0.061,  # deg/s per LSB: 2000 deg/s in 16 bits (crazyflie-firmware, likewise)
            },
        },
        "gps": {
            "rate_hz": 10.0,  # Hz, chosen
            "position_m": {"noise": 0.1},  # m, chosen: what ultra-wideband ranging to anchors in a room usually reaches
            "velocity_m_s": {"noise": 0.2},  # m/s, chosen
        },
        # 0.15 uT per LSB: AK8963 of the Crazyflie 2.0; the 2.1 has no magnetometer (crazyflie-firmware, issue 701)
        "mag": {"rate_hz": SLOW_RATE_HZ, "field_ut": {"noise": 0.3, "quantum": 0.15}},  # noise: chosen as the AK8975's
        "baro": BARO,
        "sonar": {
            "rate_hz": 25.0,  # Hz, chosen as the AR.Drone's
            "range_m": {"noise": 0.02},  # m, chosen, with floor and tilt; crazyflie-firmware, zranger2.c, has 2.5 mm
            "max_m": 4.0,  # m, VL53L1x; at 4 m zranger2.c has 0.2 m
        },
        "flow": {"rate_hz": 25.0, "velocity_m_s": {"noise": 0.1}},  # chosen; nothing is published for the deck
    },
}

AS_PRINTED = {"imu": {"accel_m_s2": {"noise": 0.35 * G_M_S2}}}  # m/s^2, section VI: "std errors 0.35 g"
