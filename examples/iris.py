"""3DR Iris, `model: iris`, with the parameters of RotorS; its front rotors are farther out than its rear ones.

Sources: RotorS (Furrer et al. 2016), rotors_gazebo/resource/iris.yaml (mass, inertia, rotors) and
rotors_description/urdf/iris.xacro (motors, rotor drag); 3D Robotics' data sheet (battery).
"""

import math
from typing import Literal

from msgspec.structs import replace

from zsim.vehicles.ardrone2 import VEHICLE as ARDRONE2
from zsim.vehicles.vehicle import Aerodynamics, Airframe, Battery, Rotor

FRONT_M, FRONT_RAD = 0.255539, 0.533708  # m; rad, from the nose
REAR_M, REAR_RAD = 0.238537, 2.565218  # m; rad, from the nose
THRUST_N_S2 = 8.54858e-6  # N s^2


def _rotor(name: str, arm_m: float, angle_rad: float, turn: Literal[-1, 1]) -> Rotor:
    return Rotor(name=name, x_m=arm_m * math.cos(angle_rad), y_m=arm_m * math.sin(angle_rad), turn=turn)


VEHICLE = replace(
    ARDRONE2,
    mass_kg=1.52,  # kg
    inertia_kg_m2=(0.0347563, 0.0458929, 0.0977),  # kg m^2
    arm_m=FRONT_M,
    thrust_n_s2=THRUST_N_S2,
    torque_nm_s2=0.016 * THRUST_N_S2,  # N m s^2; RotorS: torque per thrust is 0.016 m
    rotor_time_constant_s=0.02,  # s; RotorS: 0.0125 s up and 0.025 s down
    rotor_min_rad_s=100.0,  # rad/s; an assumption: it gives about a fortieth of the hover thrust
    rotor_max_rad_s=838.0,  # rad/s
    drag_n_s_m=0.0,  # N s/m; RotorS attributes all drag to the rotors
    aerodynamics=Aerodynamics(rotor_drag_n_s2_m=8.06428e-5),  # N s^2/m
    battery_mah=5100.0,  # mAh
    rotors=(
        _rotor("front_left", FRONT_M, FRONT_RAD, 1),
        _rotor("front_right", FRONT_M, -FRONT_RAD, -1),
        _rotor("rear_right", REAR_M, -REAR_RAD, 1),
        _rotor("rear_left", REAR_M, REAR_RAD, -1),
    ),
    rotor_radius_m=0.1,  # m
    rotor_inertia_kg_m2=1.7e-5,  # kg m^2; a rod of 5 g, 0.2 m long
    airframe=Airframe(
        hull_radius_m=0.36,  # m; arm plus rotor radius
        foot_xy_m=0.15,  # m; an assumption
        foot_depth_m=0.1,  # m; an assumption, from the 0.11 m height of body and legs
        foot_sag_m=0.002,  # m; assumed equal to the AR.Drone's
        foot_damping_ratio=0.4,  # assumed equal to the AR.Drone's
        friction=0.5,  # typical of plastic on a hard floor
        rim_xy_m=0.25,  # m; 0.36 m / sqrt(2)
        rim_height_m=0.03,  # m; above the rotors, which are at 0.023 m
        reach_m=0.37,  # m; 0.355 m to a corner of the rim, plus a margin
        hull_frequency_rad_s=80.0,  # rad/s; assumed equal to the AR.Drone's
        hull_damping_ratio=0.3,  # assumed equal to the AR.Drone's
        clearance_m=0.4,  # m; the hull radius plus a margin
    ),
    battery=Battery(
        voltage_v=11.1,  # V; nominal, three lithium-polymer cells
        efficiency=0.8,  # typical of motors with their controllers
        electronics_w=5.0,  # W; an assumption
    ),
)
