"""The entries of an AR.Drone 2.0's configuration as data: kind, category, default and range of each.

Source: AR.Drone Developer Guide SDK 2.0, chapter 8; ARDroneLib (SDK 2.0.1), config_keys.h.
"""

from typing import Literal, NamedTuple

Kind = Literal["flag", "whole", "number", "text", "fixed"]
Category = Literal["common", "application", "user", "session"]
TEXT_MAX = 128  # characters of a value (Developer Guide 8.1)


class ConfigurationEntry(NamedTuple):
    """An entry of the configuration; `fixed` cannot be written."""

    kind: Kind
    category: Category
    default: str
    low: float = 0.0
    high: float = 0.0


_COMMON_FIXED = {
    "general": {
        "num_version_config": "1",
        "num_version_mb": "33",
        "num_version_soft": "2.4.8",
        "drone_serial": "XXXXXXXXXX",
        "soft_build_date": "2014-01-01 00:00",
        **{f"motor{i}_{part}": "0.0" for i in range(1, 5) for part in ("soft", "hard", "supplier")},
        "flying_time": "0",
        "vbat_min": "9000",
    },
    "control": {
        "accs_offset": "{ -2.0480000e+03 2.0480000e+03 2.0480000e+03 }",
        "accs_gains": "{ 1.0 0.0 0.0 0.0 1.0 0.0 0.0 0.0 1.0 }",
        "gyros_offset": "{ 1.6625000e+03 1.6625000e+03 1.6625000e+03 }",
        "gyros_gains": "{ 6.8940529e-03 -6.8940529e-03 -3.6215587e-03 }",
        "gyros110_offset": "{ 1.6625000e+03 1.6625000e+03 }",
        "gyros110_gains": "{ 1.5271631e-03 -1.5271631e-03 }",
        "magneto_offset": "{ 0.0 0.0 0.0 }",
        "magneto_radius": "0.0",
        "gyro_offset_thr_x": "4.0",
        "gyro_offset_thr_y": "4.0",
        "gyro_offset_thr_z": "0.5",
        "pwm_ref_gyros": "500",
        "osctun_value": "0",
        "osctun_test": "FALSE",
    },
    "pic": {"ultrasound_watchdog": "3", "pic_version": "262192"},
    "video": {"camif_fps": "30", "camif_buffers": "2", "num_trackers": "12", "video_storage_space": "0"},
}
_ALTITUDE = (20.0, 100_000.0)  # mm; the highest means that there is no limit (ARDroneLib)
_TILT, _CLIMB, _YAW = (0.0, 0.52), (200.0, 2000.0), (0.7, 6.11)  # rad, mm/s, rad/s (Developer Guide 8.6)
_INDOOR = {"euler_angle_max": "0.20944", "control_vz_max": "700", "control_yaw": "1.7453"}
_OUTDOOR = {"euler_angle_max": "0.34907", "control_vz_max": "1000", "control_yaw": "3.4907"}
LIMITS = tuple(_INDOOR)
"""Of tilt [rad], climb [mm/s] and yaw rate [rad/s]: the aircraft keeps a set for indoors and one for outdoors."""
_RANGES = {"euler_angle_max": _TILT, "control_vz_max": _CLIMB, "control_yaw": _YAW}
_CODES = (0.0, 255.0)  # of codecs, modes and channels, as numbers of a byte
_MASK = (0.0, 2.0**32 - 1)
_RATE = (0.0, 20_000.0)  # kbit/s

ENTRIES: dict[str, ConfigurationEntry] = {
    **{
        f"{section}:{key}": ConfigurationEntry("fixed", "common", value)
        for section, entries in _COMMON_FIXED.items()
        for key, value in entries.items()
    },
    "general:ardrone_name": ConfigurationEntry("text", "common", "My ARDrone"),
    "general:navdata_demo": ConfigurationEntry("flag", "common", "FALSE"),
    "general:navdata_options": ConfigurationEntry("whole", "application", "65537", *_MASK),
    "general:com_watchdog": ConfigurationEntry("whole", "common", "2", 1.0, 60.0),
    "general:video_enable": ConfigurationEntry("flag", "common", "TRUE"),
    "general:vision_enable": ConfigurationEntry("flag", "common", "TRUE"),
    "control:control_level": ConfigurationEntry("whole", "application", "0", *_CODES),
    **{f"control:{key}": ConfigurationEntry("number", "user", _INDOOR[key], *_RANGES[key]) for key in LIMITS},
    **{f"control:indoor_{key}": ConfigurationEntry("number", "user", _INDOOR[key], *_RANGES[key]) for key in LIMITS},
    **{f"control:outdoor_{key}": ConfigurationEntry("number", "user", _OUTDOOR[key], *_RANGES[key]) for key in LIMITS},
    "control:altitude_max": ConfigurationEntry("whole", "common", "3000", *_ALTITUDE),
    "control:altitude_min": ConfigurationEntry("whole", "common", "50", *_ALTITUDE),
    "control:control_iphone_tilt": ConfigurationEntry("number", "user", "0.34907", *_TILT),
    "control:outdoor": ConfigurationEntry("flag", "common", "FALSE"),
    "control:flight_without_shell": ConfigurationEntry("flag", "common", "FALSE"),
    "control:autonomous_flight": ConfigurationEntry("flag", "common", "FALSE"),
    "control:manual_trim": ConfigurationEntry("flag", "user", "FALSE"),
    "control:flying_mode": ConfigurationEntry("whole", "session", "0", 0.0, 2.0),
    "control:hovering_range": ConfigurationEntry("whole", "session", "1000", 0.0, 100_000.0),
    "control:flight_anim": ConfigurationEntry("text", "common", "0,0"),
    "control:flying_camera_enable": ConfigurationEntry("flag", "session", "FALSE"),
    "control:flying_camera_mode": ConfigurationEntry("text", "session", ""),
    "network:ssid_single_player": ConfigurationEntry("text", "common", "ardrone2"),
    "network:ssid_multi_player": ConfigurationEntry("text", "common", "ardrone2"),
    "network:wifi_mode": ConfigurationEntry("whole", "common", "0", 0.0, 2.0),
    "network:wifi_rate": ConfigurationEntry("whole", "common", "0", *_CODES),
    "network:owner_mac": ConfigurationEntry("text", "common", "00:00:00:00:00:00"),
    "pic:ultrasound_freq": ConfigurationEntry("whole", "common", "8", 7.0, 8.0),
    "video:codec_fps": ConfigurationEntry("whole", "session", "30", 1.0, 30.0),
    "video:video_codec": ConfigurationEntry("whole", "session", "129", *_CODES),
    "video:video_slices": ConfigurationEntry("whole", "session", "0", *_CODES),
    "video:video_live_socket": ConfigurationEntry("whole", "session", "0", *_CODES),
    "video:bitrate": ConfigurationEntry("whole", "application", "1000", *_RATE),
    "video:max_bitrate": ConfigurationEntry("whole", "session", "1000", *_RATE),
    "video:bitrate_ctrl_mode": ConfigurationEntry("whole", "application", "0", 0.0, 2.0),
    "video:bitrate_storage": ConfigurationEntry("whole", "application", "4000", *_RATE),
    "video:video_channel": ConfigurationEntry("whole", "session", "0", 0.0, 4.0),
    "video:video_on_usb": ConfigurationEntry("flag", "common", "TRUE"),
    "video:video_file_index": ConfigurationEntry("whole", "common", "1", *_MASK),
    "leds:leds_anim": ConfigurationEntry("text", "common", "0,0,0"),
    "detect:enemy_colors": ConfigurationEntry("whole", "session", "1", *_CODES),
    "detect:groundstripe_colors": ConfigurationEntry("whole", "session", "16", *_CODES),
    "detect:enemy_without_shell": ConfigurationEntry("whole", "session", "0", *_CODES),
    "detect:detect_type": ConfigurationEntry("whole", "session", "3", *_CODES),
    "detect:detections_select_h": ConfigurationEntry("whole", "session", "0", *_MASK),
    "detect:detections_select_v_hsync": ConfigurationEntry("whole", "session", "0", *_MASK),
    "detect:detections_select_v": ConfigurationEntry("whole", "session", "0", *_MASK),
    "syslog:output": ConfigurationEntry("whole", "common", "7", *_MASK),
    "syslog:max_size": ConfigurationEntry("whole", "common", "102400", *_MASK),
    "syslog:nb_files": ConfigurationEntry("whole", "common", "5", *_CODES),
    "userbox:userbox_cmd": ConfigurationEntry("text", "session", "0"),
    "gps:latitude": ConfigurationEntry("number", "session", "500", -1000.0, 1000.0),
    "gps:longitude": ConfigurationEntry("number", "session", "500", -1000.0, 1000.0),
    "gps:altitude": ConfigurationEntry("number", "session", "0", -1e5, 1e5),
}
"""By `section:key`; beside them stand the identifiers and descriptions of `custom`."""
