"""Sensor presets: plain dictionaries in the shape of a scenario's `sensors:` section.

`ardrone2` is measured on a real AR.Drone 2.0 standing still unless said otherwise; `paper` is the set-up of
Mas, Curi and Sánchez Peña, "Open-source Multi-UAV Simulator for the ROS Environment", section VI.
"""

from typing import Any

G_M_S2 = 9.80665  # m/s^2, standard gravity, ISO 80000-3

PRESETS: dict[str, dict[str, Any]] = {
    "ardrone2": {
        "imu": {
            "rate_hz": 200.0,  # navigation board frames, AR.Drone 2.0
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
            "rate_hz": 5.0,
            "latency_ms": 200.0,  # Paparazzi's model of the ardrone2
            "position_m": {"noise": 2.0},
            "velocity_m_s": {"noise": 0.43},  # ehve of a real navdata packet
        },
        "mag": {"rate_hz": 25.0, "field_ut": {"noise": 0.3, "quantum": 0.3}},  # AK8975: 0.3 uT per LSB
        "baro": {"rate_hz": 25.0, "altitude_m": {"noise": 0.1}},
        "sonar": {"rate_hz": 25.0, "range_m": {"noise": 0.01}},  # ultrasound_freq 8
        "flow": {"rate_hz": 15.0, "velocity_m_s": {"noise": 0.1}},
    },
    "paper": {
        "imu": {
            "rate_hz": 200.0,
            "accel_m_s2": {"noise": 0.35},  # m/s^2, default of the paper's base simulator (tum_simulator)
            "gyro_deg_s": {"noise": 0.01},  # deg/s, section VI
        },
        "gps": {
            "rate_hz": 5.0,
            "position_m": {"noise": 2.0},  # m, section VI
            "velocity_m_s": {"noise": 0.43},  # ehve of a real navdata packet; the paper is silent
        },
        "mag": {"rate_hz": 25.0, "field_ut": {"noise": 0.94}},  # 3 deg of a horizontal field of 18 uT
        "baro": {"rate_hz": 25.0, "altitude_m": {"noise": 0.1}},
        "sonar": {"rate_hz": 25.0, "range_m": {"noise": 0.01}},
        "flow": {"rate_hz": 15.0, "velocity_m_s": {"noise": 0.1}},
    },
}

AS_PRINTED = {"imu": {"accel_m_s2": {"noise": 0.35 * G_M_S2}}}  # m/s^2, section VI: "std errors 0.35 g"
