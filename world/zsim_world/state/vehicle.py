"""The aircraft as one row of numbers per drone: what a scenario says of it, and what it is silent about.

Geometry in B (x forward, y left, z up, origin at the centre of mass). Rotors in the order front left, front right,
rear right, rear left; seen from above the first and third turn clockwise (Paparazzi, airframe ardrone2).
"""

import math

import numpy as np
from numpy.typing import NDArray

from zsim.scenario.scenario import Drone, Environment
from zsim.scenario.sensor_presets import SEA_LEVEL_KG_M3

MASS, INERTIA_X, INERTIA_Y, INERTIA_Z = 0, 1, 2, 3  # kg, kg m^2
ROTOR_XY = 4  # m, |x| = |y| of a rotor's hub: arm / sqrt(2), cross layout
THRUST, TORQUE = 5, 6  # N s^2, N m s^2: k_F and k_M at the field's air density
ROTOR_LAG, ROTOR_MIN, ROTOR_MAX = 7, 8, 9  # s, rad/s, rad/s
DRAG = 10  # N s/m at the field's air density
GRAVITY, AIR_DENSITY = 11, 12  # m/s^2, kg/m^3
FOOT_STIFFNESS, FOOT_DAMPING = 13, 14  # N/m, N s/m per contact point
HULL_STIFFNESS, HULL_DAMPING = 15, 16  # N/m, N s/m between two hulls, of this drone's mass
CAPACITY = 17  # J, of a full battery
ROTOR_RADIUS, ROTOR_INERTIA = 18, 19  # m, kg m^2
SIZE, HULL_RADIUS, STAND_HEIGHT = 20, 21, 22  # of the AR.Drone's, m, m
COLUMNS = 23
Row = NDArray[np.float64] | tuple[float, ...]  # of one drone: a view, or loaded

REFERENCE_DENSITY_KG_M3 = SEA_LEVEL_KG_M3  # k_F, k_M and the drag of a scenario hold there
# The AR.Drone's rotor; another aircraft's is taken as similar in shape: k_F grows as R^4, k_M and the inertia as R^5
REFERENCE_THRUST_N_S2, REFERENCE_TORQUE_NM_S2 = 8.048e-6, 2.423e-7  # Li, MSc thesis, TU Delft 2014, through AuRoRA
ROTOR_INERTIA_KG_M2 = 2.029585e-5  # kg m^2, rotor and gear (Li 2014, as above)
ROTOR_RADIUS_M = 0.1  # m, 0.2 m propeller
# The AR.Drone's airframe; another aircraft's is taken as similar in shape, in proportion to its arm
REFERENCE_ARM_M = 0.1785  # m, centre to rotor (Li 2014, as above)
HULL_RADIUS_M = 0.26  # m, half of the indoor hull's 0.515 m (OpenMAS, measured)
FOOT_DEPTH_M = 0.060  # m, feet below the centre of mass: half of the aircraft's 0.127 m height, rounded down
FOOT_XY_M = 0.10  # m, a foot's |x| and |y|: under the hub of the central cross
EDGE_XY_M = 0.18  # m, |x| and |y| of the hull's corners: 0.26 m / sqrt(2)
EDGE_HEIGHT_M = 0.03  # m, upper rim of the hull above the centre of mass
FOOT_SAG_M = 0.002  # m, by which the feet give under the weight; sets their stiffness
FOOT_DAMPING_RATIO = 0.4  # of critical, of the aircraft bouncing on its four feet
FRICTION = 0.6  # foam on a hard floor, typical
HULL_FREQUENCY_RAD_S = 80.0  # rad/s, of two equal drones pressed together: 3 m/s dent 4 cm of foam
HULL_DAMPING_RATIO = 0.3  # of critical: rebound at about 0.4 of the speed of approach
COULOMB_PER_MAH = 3.6  # C per mAh: 3600 s to the hour
BATTERY_V = 11.1  # V, three lithium-polymer cells, nominal
EFFICIENCY = 0.9  # electric to shaft power, set so that a full 1000 mAh hovers for 12 min (10-12 min published)
BOARD_W = 4.6  # W, main board, camera and radio; set with EFFICIENCY
DRIVE_LAG_LEAD = 0.5  # the firmware overdrives the motors to halve their lag; see firmware.py

CONTACT_POINTS_B = np.array(
    [[sx * FOOT_XY_M, sy * FOOT_XY_M, -FOOT_DEPTH_M] for sx, sy in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
    + [[sx * EDGE_XY_M, sy * EDGE_XY_M, EDGE_HEIGHT_M] for sx, sy in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
)
CONTACT_REACH_M = 0.27  # m, farther than any contact point from the centre of mass
STAND_HEIGHT_M = FOOT_DEPTH_M - FOOT_SAG_M  # m, of the centre of mass of a standing drone


def parameters(drone: Drone, environment: Environment) -> NDArray[np.float64]:
    """Return the row of one drone, shape (COLUMNS,).

    Thrust, torque and drag of the scenario hold at 1.225 kg/m^3 and scale with the air density.
    """
    row = np.empty(COLUMNS)
    density = environment.air_density_kg_m3 / REFERENCE_DENSITY_KG_M3
    row[MASS] = drone.mass_kg
    row[INERTIA_X : INERTIA_Z + 1] = drone.inertia_kg_m2
    row[ROTOR_XY] = drone.arm_m / math.sqrt(2.0)
    row[THRUST], row[TORQUE] = drone.thrust_n_s2 * density, drone.torque_nm_s2 * density
    row[ROTOR_LAG] = drone.rotor_time_constant_s
    row[ROTOR_MIN], row[ROTOR_MAX] = drone.rotor_min_rad_s, drone.rotor_max_rad_s
    row[DRAG] = drone.drag_n_s_m * density
    row[GRAVITY], row[AIR_DENSITY] = environment.gravity_m_s2, environment.air_density_kg_m3
    size = drone.arm_m / REFERENCE_ARM_M
    row[SIZE], row[HULL_RADIUS], row[STAND_HEIGHT] = size, size * HULL_RADIUS_M, size * STAND_HEIGHT_M
    stiffness = drone.mass_kg * environment.gravity_m_s2 / (4.0 * size * FOOT_SAG_M)
    row[FOOT_STIFFNESS] = stiffness
    row[FOOT_DAMPING] = 2.0 * FOOT_DAMPING_RATIO * math.sqrt(stiffness * drone.mass_kg / 4.0)
    reduced = drone.mass_kg / 2.0
    row[HULL_STIFFNESS] = reduced * HULL_FREQUENCY_RAD_S**2
    row[HULL_DAMPING] = 2.0 * HULL_DAMPING_RATIO * reduced * HULL_FREQUENCY_RAD_S
    row[CAPACITY] = drone.battery_mah * COULOMB_PER_MAH * BATTERY_V
    row[ROTOR_RADIUS] = ROTOR_RADIUS_M * (drone.thrust_n_s2 / REFERENCE_THRUST_N_S2) ** 0.25
    row[ROTOR_INERTIA] = ROTOR_INERTIA_KG_M2 * drone.torque_nm_s2 / REFERENCE_TORQUE_NM_S2
    return row
