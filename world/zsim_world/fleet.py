"""The fleet: all drones of a scenario, one gate at a time. The only thing that the rest of the world uses.

Samples are published in the contract's order of fields. Heights: `baro` altitude_m is the height over the origin of W
(zeroed at the field, as the aircraft does at power-up), and pressure_pa is that of the standard atmosphere at
`environment.height_m` + altitude_m.
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.errors import RunError
from zsim.frames import enu_to_geodetic, quaternion_from_heading
from zsim.scenario import Scenario
from zsim.streams import NormalBlock, stream
from zsim_world import firmware, gains, gate, observer, rigid_body, sensor_set, vehicle
from zsim_world import wind as wind_model
from zsim_world.battery import percent

GPS_FIX, GPS_SATELLITES = 3, 9  # a three-dimensional fix; satellites of a real navdata packet
LAND_BEFORE_TAKEOFF_PERCENT = 2.0 * firmware.LOW_BATTERY_PERCENT  # %, below which it does not take off
UPRIGHT_COSINE = 0.87  # 30 deg, beyond which it does not take off
NOISE_GATES = 64  # gates between two refills of the noise
OFF_GROUND = (firmware.HOVERING, firmware.FLYING)


class DivergedError(RunError):
    """The state of a drone is no longer finite; the text names the drone and the time."""


class Sample(NamedTuple):
    """One measurement; `values` in the contract's order of fields.

    imu: ax, ay, az [m/s^2], gx, gy, gz [rad/s]; gps: latitude, longitude [deg], altitude [m], e, n, u [m],
    ve, vn, vu [m/s] (see `Fleet.gps_sigma_m`, GPS_FIX, GPS_SATELLITES); mag: x, y, z [uT]; baro: pressure [Pa],
    altitude [m]; sonar: range [m], valid 0 or 1; flow: forward, left, up [m/s], quality.
    """

    sensor: str
    drone: int
    t_ns: int
    t_sample_ns: int
    values: tuple[float, ...]


class Truth(NamedTuple):
    """The true state of N drones, copied."""

    position_m: NDArray[np.float64]  # (N, 3), W
    velocity_m_s: NDArray[np.float64]  # (N, 3), W
    orientation_wxyz: NDArray[np.float64]  # (N, 4), B to W
    angular_velocity_rad_s: NDArray[np.float64]  # (N, 3), B
    accel_m_s2: NDArray[np.float64]  # (N, 3), W
    rotor_rad_s: NDArray[np.float64]  # (N, 4)
