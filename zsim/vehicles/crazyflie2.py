"""Bitcraze Crazyflie 2.x, 27 g, brushed motors, as delivered.

Sources:
    Förster    J. Förster, System Identification of the Crazyflie 2.0 Nano Quadrocopter, BSc thesis, ETH Zürich 2015,
               as quoted in crazyflie-firmware, src/modules/src: controller_lee.c (inertia) and
               power_distribution_quadrotor.c (torque); M. Hamer's physical_constants.c (height of the centre of mass)
    cf2x       gym-pybullet-drones (J. Panerati et al., IROS 2021), assets/cf2x.urdf, after Landry (MIT 2015)
    RotorPy    S. Folk et al. 2023, rotorpy/vehicles/crazyflie_params.py
    Bitcraze   data sheet of the Crazyflie 2.1, and "Measuring propeller RPM: part 3" (2015)
The modelled firmware has the structure of the AR.Drone's; its gains follow from the longer lag of the motors: rate
16.7 1/s, tilt 5.4 1/s, velocity 1.7 1/s, climb 2.4 1/s. At 5 % battery, about twenty seconds of hover remain.
"""

from msgspec.structs import replace

from zsim.vehicles.ardrone2 import VEHICLE as ARDRONE2
from zsim.vehicles.vehicle import Airframe, Battery, Limits, Vehicle, cross_layout

ARM_M = 0.0397  # m, centre to rotor (cf2x); the overall 92 mm include the motor mounts (Bitcraze)
THRUST_N_S2 = 2.8816e-8  # N s^2: 3.16e-10 N per (rev/min)^2 (cf2x)

VEHICLE = Vehicle(
    mass_kg=0.027,  # kg (cf2x, Bitcraze)
    inertia_kg_m2=(16.571710e-6, 16.655602e-6, 29.261652e-6),  # kg m^2; products of up to 1.8e-6 omitted (Förster)
    arm_m=ARM_M,
    thrust_n_s2=THRUST_N_S2,
    torque_nm_s2=0.005964552 * THRUST_N_S2,  # N m s^2: torque per thrust of 5.96 mm (Förster)
    rotor_time_constant_s=0.072,  # s (RotorPy); 0 to 25 000 rev/min within about 0.18 s (Bitcraze)
    rotor_min_rad_s=300.0,  # rad/s, design choice: a twenty-fifth of the hover thrust
    rotor_max_rad_s=2273.0,  # rad/s: thrust-to-weight ratio of 2.25 (cf2x)
    drag_n_s_m=6.2e-3,  # N s/m: 1.025e-6 kg/rad (RotorPy, after Förster) with four rotors at 1516 rad/s in hover
    battery_mah=250.0,  # mAh (Bitcraze)
    takeoff_height_m=0.5,  # m, as in Bitcraze's examples
    limits=Limits(horizontal_speed_m_s=2.0),  # m/s, design choice: suits a room; the others as for the AR.Drone
    sensor_preset="crazyflie2",
    rotors=cross_layout(ARM_M),
    rotor_radius_m=0.0231,  # m (cf2x, 2.31348e-2 in its later versions)
    rotor_inertia_kg_m2=5e-8,  # kg m^2, estimated: a rod of 46 mm and 0.3 g
    airframe=Airframe(
        hull_radius_m=0.062,  # m, arm and propeller; the collision cylinder of cf2x has 0.06 m
        foot_xy_m=0.028,  # m, legs under the motors
        foot_depth_m=0.020,  # m, height of the centre of mass above the floor (Förster)
        foot_sag_m=0.001,  # m, design choice: 99 rad/s, which an integration step of 2.5 ms can follow
        foot_damping_ratio=0.4,  # design choice: as for the AR.Drone
        friction=0.5,  # plastic on a hard floor, typical
        rim_xy_m=0.044,  # m, 0.062 m / sqrt(2)
        rim_height_m=0.009,  # m, from the overall height of 29 mm (Bitcraze)
        reach_m=0.065,  # m, 0.0629 m to a corner of the rim, plus margin
        hull_frequency_rad_s=80.0,  # rad/s, design choice: as for the AR.Drone
        hull_damping_ratio=0.3,  # design choice: as for the AR.Drone
        clearance_m=0.1,  # m, design choice: the hull plus margin
    ),
    battery=Battery(
        voltage_v=3.7,  # V, one lithium-polymer cell, nominal
        efficiency=0.322,  # brushed motors; set so that a full battery lasts for 7 min of hover (Bitcraze)
        electronics_w=0.5,  # W, board and radio; estimated, set together with the efficiency
    ),
    firmware=replace(  # all other values are those of the AR.Drone
        ARDRONE2.firmware,
        lag_lead=0.35,  # leaves 25 ms of the motors' lag; the thrust-to-weight ratio of 2.25 permits it
        hold_1_s=0.5,  # 1/s, in the same ratio to the velocity loop as for the AR.Drone
        height_1_s=0.9,  # 1/s, in the same ratio to the climb loop as for the AR.Drone
        brake_s=0.8,  # s, longer since the velocity loop is slower
        takeoff_m_s=0.3,  # m/s, design choice: 0.6 take-off heights per second, as for the AR.Drone
        descent_m_s=0.3,  # m/s, design choice: gentler, since its feet are hard
        flare_m=1.0,  # m, design choice: half of the AR.Drone's, since it flies lower
    ),
)
