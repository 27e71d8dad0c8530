"""The options of navdata as data: tag, name and fields of each, packed, little-endian.

Every option begins with its tag and its size in bytes, both uint16, these four bytes included. Angles are in
millidegrees where a name says so, theta nose up, phi to the right, psi clockwise; axes x forward, y right, z down.

Source: ARDroneLib (SDK 2.0.1), navdata_common.h; the GPS option of firmware 2.4 and later: its branch `gps`.
"""

import re
import struct
from collections import namedtuple
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

HEADER = struct.Struct("<HH")  # tag, size
CHECKSUM_TAG = 0xFFFF
GPS_TAG = 27  # zimmu_3000 of 12 bytes in older SDKs
_FIELD = re.compile(r"(\w+):(\d*)([bBhHiIfd])")


class OptionLayout(NamedTuple):
    """The layout of an option.

    Attributes:
        tag, name: of the option.
        values: the NamedTuple type of its fields; a field of several numbers is a tuple.
        counts: numbers that each field has; 0 for a field that is one number.
        codec: of the flat numbers, without tag and size.
        size: bytes, tag and size included.
    """

    tag: int
    name: str
    values: type[Any]
    counts: tuple[int, ...]
    codec: struct.Struct
    size: int

    def zeros(self) -> Any:
        """Return the option with all numbers zero."""
        return self.nested(self.codec.unpack(bytes(self.codec.size)))

    def flat(self, option: Iterable[Any]) -> Iterator[Any]:
        """Yield the numbers of an option in the order of the wire."""
        for count, value in zip(self.counts, option, strict=True):
            if count:
                yield from value
            else:
                yield value

    def nested(self, numbers: tuple[Any, ...]) -> Any:
        """Return the option of flat numbers."""
        values, at = [], 0
        for count in self.counts:
            values.append(numbers[at : at + count] if count else numbers[at])
            at += count or 1
        return self.values(*values)


def _layout(tag: int, name: str, fields: str) -> OptionLayout:
    parts = _FIELD.findall(fields)
    kind = namedtuple(name, [field for field, _, _ in parts])
    codec = struct.Struct("<" + "".join(f"{count}{code}" for _, count, code in parts))
    counts = tuple(int(count) if count else 0 for _, count, _ in parts)
    return OptionLayout(tag, name, kind, counts, codec, HEADER.size + codec.size)


_TABLE = (
    (
        0,
        "demo",
        "ctrl_state:I battery_percent:I theta_mdeg:f phi_mdeg:f psi_mdeg:f altitude_mm:i vx_mm_s:f vy_mm_s:f vz_mm_s:f"
        " num_frames:I detection_camera_rot:9f detection_camera_trans:3f detection_tag_index:I detection_camera_type:I"
        " drone_camera_rot:9f drone_camera_trans:3f",
    ),
    (1, "time", "time:I"),
    (
        2,
        "raw_measures",
        "raw_accs:3H raw_gyros:3h raw_gyros_110:2h vbat_raw_mv:I us_debut_echo:H us_fin_echo:H us_association_echo:H"
        " us_distance_echo:H us_courbe_temps:H us_courbe_valeur:H us_courbe_ref:H flag_echo_ini:H nb_echo:H"
        " sum_echo:I alt_temp_raw_mm:i gradient:h",
    ),
    (
        3,
        "phys_measures",
        "accs_temp_degc:f gyro_temp:H phys_accs_mg:3f phys_gyros_deg_s:3f alim3V3:I vrefEpson:I vrefIDG:I",
    ),
    (4, "gyros_offsets", "offset_g:3f"),
    (5, "euler_angles", "theta_a_mdeg:f phi_a_mdeg:f"),
    (
        6,
        "references",
        "ref_theta:i ref_phi:i ref_theta_I:i ref_phi_I:i ref_pitch:i ref_roll:i ref_yaw:i ref_psi:i vx_ref:f vy_ref:f"
        " theta_mod:f phi_mod:f k_v_x:f k_v_y:f k_mode:I ui_time:f ui_theta:f ui_phi:f ui_psi:f ui_psi_accuracy:f"
        " ui_seq:i",
    ),
    (7, "trims", "angular_rates_trim_r:f euler_angles_trim_theta:f euler_angles_trim_phi:f"),
    (8, "rc_references", "rc_ref_pitch:i rc_ref_roll:i rc_ref_yaw:i rc_ref_gaz:i rc_ref_ag:i"),
    (
        9,
        "pwm",
        "motor:4B sat_motor:4B gaz_feed_forward:f gaz_altitude:f altitude_integral:f vz_ref:f u_pitch:i u_roll:i"
        " u_yaw:i yaw_u_I:f u_pitch_planif:i u_roll_planif:i u_yaw_planif:i u_gaz_planif:f current_motor_ma:4H"
        " altitude_prop:f altitude_der:f",
    ),
    (
        10,
        "altitude",
        "altitude_vision_mm:i altitude_vz:f altitude_ref_mm:i altitude_raw_mm:i obs_accZ:f obs_alt:f obs_x:3f"
        " obs_state:I est_vb:2f est_state:I",
    ),
    (11, "vision_raw", "vision_tx_raw:f vision_ty_raw:f vision_tz_raw:f"),
    (12, "vision_of", "of_dx:5f of_dy:5f"),
    (
        13,
        "vision",
        "vision_state:I vision_misc:i vision_phi_trim:f vision_phi_ref_prop:f vision_theta_trim:f"
        " vision_theta_ref_prop:f new_raw_picture:i theta_capture:f phi_capture:f psi_capture:f altitude_capture:i"
        " time_capture:I body_v:3f delta_phi:f delta_theta:f delta_psi:f gold_defined:I gold_reset:I gold_x:f gold_y:f",
    ),
    (
        14,
        "vision_perf",
        "time_szo:f time_corners:f time_compute:f time_tracking:f time_trans:f time_update:f time_custom:20f",
    ),
    (15, "trackers_send", "locked:30i point:60i"),
    (
        16,
        "vision_detect",
        "nb_detected:I type:4I xc:4I yc:4I width:4I height:4I dist_cm:4I orientation_angle_deg:4f rotation:36f"
        " translation:12f camera_source:4I",
    ),
    (17, "watchdog", "watchdog:i"),
    (18, "adc_data_frame", "version:I data_frame:32B"),
    (
        19,
        "video_stream",
        "quant:B frame_size:I frame_number:I atcmd_ref_seq:I atcmd_mean_ref_gap_ms:I atcmd_var_ref_gap:f"
        " atcmd_ref_quality:I out_bitrate:I desired_bitrate:I data:5i tcp_queue_level:I fifo_queue_level:I",
    ),
    (20, "games", "double_tap_counter:I finish_line_counter:I"),
    (21, "pressure_raw", "up:i ut:h temperature_ddegc:i pressure_pa:i"),
    (
        22,
        "magneto",
        "mx:h my:h mz:h magneto_raw_mg:3f magneto_rectified:3f magneto_offset:3f heading_unwrapped_deg:f"
        " heading_gyro_unwrapped_deg:f heading_fusion_unwrapped_deg:f magneto_calibration_ok:B magneto_state:I"
        " magneto_radius:f error_mean:f error_var:f",
    ),
    (
        23,
        "wind_speed",
        "wind_speed_m_s:f wind_angle_rad:f wind_compensation_theta:f wind_compensation_phi:f state_x:6f"
        " magneto_debug:3f",
    ),
    (
        24,
        "kalman_pressure",
        "offset_pressure:f est_z_mm:f est_zdot_mm_s:f est_bias_PWM:f est_biais_pression:f offset_US:f prediction_US:f"
        " cov_alt:f cov_PWM:f cov_vitesse:f bool_effet_sol:I somme_inno:f flag_rejet_US:I u_multisinus:f"
        " gaz_altitude:f flag_multisinus:I flag_multisinus_debut:I",
    ),
    (
        25,
        "hdvideo_stream",
        "hdvideo_state:I storage_fifo_nb_packets:I storage_fifo_size:I usbkey_size_kb:I usbkey_freespace_kb:I"
        " frame_number:I usbkey_remaining_time_s:I",
    ),
    (26, "wifi", "link_quality:I"),
    (
        GPS_TAG,
        "gps",
        "latitude_deg:d longitude_deg:d elevation_m:d hdop:d data_available:i zero_validated:i wpt_validated:i"
        " lat0_deg:d lon0_deg:d lat_fused_deg:d lon_fused_deg:d gps_state:I X_traj:f X_ref:f Y_traj:f Y_ref:f"
        " theta_p:f phi_p:f theta_i:f phi_i:f theta_d:f phi_d:f vdop:d pdop:d speed_m_s:f last_frame_time:I degree:f"
        " degree_mag:f ehpe_m:f ehve_m_s:f c_n0:f satellites:I channels:24B plugged:i ephemeris:I vx_traj:f vy_traj:f"
        " firmware_status:I",
    ),
    (28, "camera_settings", "temperature:h"),
    (29, "host", "flag:i gaz:f yaw:f phi:f theta:f magneto_psi:f magneto_psi_accuracy:f"),
    (CHECKSUM_TAG, "cks", "value:I"),
)
LAYOUTS = {tag: _layout(tag, name, fields) for tag, name, fields in _TABLE}
"""By tag."""
TAG_OF = {layout.name: tag for tag, layout in LAYOUTS.items()}
FULL_TAGS = tuple(tag for tag in LAYOUTS if tag < GPS_TAG)
"""What a packet of all options holds: 1904 bytes. The GPS stands in none that did not ask for it: readers differ in
what its tag means."""
