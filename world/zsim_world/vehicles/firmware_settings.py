"""The settings of one drone's firmware: limits of what a commander may ask, loop gains, its vehicle's design."""

import math

import numpy as np
from numpy.typing import NDArray

from zsim.math.compiled import Field, columns
from zsim.scenario.scenario import Drone
from zsim.vehicles.vehicle import Vehicle
from zsim_world.vehicles.attitude_control import DRIVE, lag_shares, loop_gains

SETTING = columns(  # limits of what a commander may ask, and the design of vehicle.Firmware
    "SettingColumns",
    (
        Field("drive", "DRIVE", DRIVE.size),
        Field("rotor_decay", "1"),  # left of the rotors' lag after a step
        Field("k_velocity", "1/s"),
        Field("k_climb", "1/s"),
        Field("speed", "m/s"),
        Field("climb", "m/s"),
        Field("yaw_rate", "rad/s"),
        Field("altitude", "m"),
        Field("takeoff_height", "m"),
        Field("k_hold", "1/s"),
        Field("k_height", "1/s"),
        Field("brake", "s"),
        Field("tilt_cut", "1"),
        Field("lift_min", "1"),
        Field("spin_up", "s"),
        Field("ascent", "m/s"),
        Field("ascent_max", "s"),
        Field("arrived", "m"),
        Field("arrived_speed", "m/s"),
        Field("descent", "m/s"),
        Field("descent_far", "1/s"),
        Field("flare", "m"),
        Field("touch_share", "1"),
        Field("touch_speed", "m/s"),
        Field("touch", "s"),
        Field("low_battery", "%"),
    ),
)


def settings(vehicle: Vehicle, drone: Drone) -> NDArray[np.float64]:
    """Return limits and loop gains of one drone, shape (SETTING.size,)."""
    limits, design, row = drone.limits, vehicle.firmware, np.empty(SETTING.size)
    k_rate, k_tilt, row[SETTING.k_velocity] = loop_gains(design, drone.rotor_time_constant_s)
    row[SETTING.rotor_decay], overdrive = lag_shares(design, drone.rotor_time_constant_s)
    slope = math.tan(math.radians(limits.tilt_deg))
    drive = (k_rate, k_tilt, overdrive, slope, design.yaw_share, design.body_rate_max_rad_s)
    row[SETTING.drive : SETTING.drive + DRIVE.size] = drive
    row[SETTING.k_climb] = design.climb_share * k_rate
    row[SETTING.speed], row[SETTING.climb] = limits.horizontal_speed_m_s, limits.vertical_speed_m_s
    row[SETTING.yaw_rate], row[SETTING.altitude] = math.radians(limits.yaw_rate_deg_s), limits.altitude_m
    row[SETTING.takeoff_height] = min(drone.takeoff_height_m, limits.altitude_m)
    row[SETTING.k_hold], row[SETTING.k_height], row[SETTING.brake] = design.hold_1_s, design.height_1_s, design.brake_s
    row[SETTING.tilt_cut], row[SETTING.lift_min] = design.tilt_cut_cosine, design.lift_share_min
    row[SETTING.spin_up], row[SETTING.ascent] = design.spin_up_s, design.takeoff_m_s
    row[SETTING.ascent_max], row[SETTING.arrived] = design.takeoff_s_max, design.arrived_m
    row[SETTING.arrived_speed], row[SETTING.descent] = design.arrived_m_s, design.descent_m_s
    row[SETTING.descent_far], row[SETTING.flare] = design.descent_far_1_s, design.flare_m
    row[SETTING.touch_share], row[SETTING.touch_speed] = design.touch_share, design.touch_m_s
    row[SETTING.touch], row[SETTING.low_battery] = design.touch_s, design.low_battery_percent
    return row
