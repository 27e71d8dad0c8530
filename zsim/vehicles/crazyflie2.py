"""Bitcraze Crazyflie 2.x, 27 g, brushed motors, as delivered.

Sources:
    Förster    J. Förster, System Identification of the Crazyflie 2.0 Nano Quadrocopter, BSc thesis, ETH Zürich 2015,
               by the firmware that quotes it: crazyflie-firmware, src/modules/src, controller_lee.c (inertia) and
               power_distribution_quadrotor.c (torque); M. Hamer's physical_constants.c (height of the centre of mass)
    cf2x       gym-pybullet-drones (J. Panerati et al., IROS 2021), assets/cf2x.urdf, after Landry (MIT 2015)
    RotorPy    S. Folk et al. 2023, rotorpy/vehicles/crazyflie_params.py
    Bitcraze   data sheet of the Crazyflie 2.1, and "Measuring propeller RPM: part 3" (2015)
Its firmware has the structure of the AR.Drone's here; the gains follow from the motors' lag, which is longer.
"""

from zsim.vehicles.vehicle import Airframe, Battery, Firmware, Limits, Vehicle, cross_layout

ARM_M = 0.0397  # m, centre to rotor (cf2x); 92 mm over all are with the motor mounts (Bitcraze)
THRUST_N_S2 = 2.8816e-8  # N s^2: 3.16e-10 N per (rev/min)^2 (cf2x)

VEHICLE = Vehicle(
    mass_kg=0.027,  # kg (cf2x, Bitcraze)
    inertia_kg_m2=(16.571710e-6, 16.655602e-6, 29.261652e-6),  # kg m^2; products up to 1.8e-6 left out (Förster)
    arm_m=ARM_M,
    thrust_n_s2=THRUST_N_S2,
    torque_nm_s2=0.005964552 * THRUST_N_S2,  # N m s^2: 5.96 mm of torque per thrust (Förster)
    rotor_time_constant_s=0.072,  # s (RotorPy); 0 to 25 000 rev/min within about 0.18 s (Bitcraze)
    rotor_min_rad_s=300.0,  # rad/s, chosen: a twenty-fifth of the hover's thrust
    rotor_max_rad_s=2273.0,  # rad/s: thrust over weight 2.25 (cf2x)
    drag_n_s_m=6.2e-3,  # N s/m: 1.025e-6 kg/rad (RotorPy, after Förster) at the four rotors' 1516 rad/s of hover
    battery_mah=250.0,  # mAh (Bitcraze)
    takeoff_height_m=0.5,  # m, as Bitcraze's examples
    limits=Limits(horizontal_speed_m_s=2.0),  # m/s, chosen: a room's size; the others as the AR.Drone's
    sensor_preset="crazyflie2",
    rotors=cross_layout(ARM_M),
    rotor_radius_m=0.0231,  # m (cf2x, 2.31348e-2 in its later versions)
    rotor_inertia_kg_m2=5e-8,  # kg m^2, a rod of 46 mm and 0.3 g; estimated
    airframe=Airframe(
        hull_radius_m=0.062,  # m, arm and propeller; the collision cylinder of cf2x has 0.06 m
        foot_xy_m=0.028,  # m, legs under the motors
        foot_depth_m=0.020,  # m, height of the centre of mass over the floor (Förster)
        foot_sag_m=0.001,  # m, chosen: 99 rad/s, an integrator's step of 2.5 ms follows it
        foot_damping_ratio=0.4,  # chosen
        friction=0.5,  # plastic on a hard floor, typical
        rim_xy_m=0.044,  # m, 0.062 m / sqrt(2)
        rim_height_m=0.009,  # m, 29 mm of height in all (Bitcraze)
        reach_m=0.065,  # m, 0.0629 m to a corner of the rim, and room
        hull_frequency_rad_s=80.0,  # rad/s, chosen as the AR.Drone's
        hull_damping_ratio=0.3,  # chosen as the AR.Drone's
        clearance_m=0.1,  # m, chosen
    ),
    battery=Battery(
        voltage_v=3.7,  # V, one lithium-polymer cell, nominal
        efficiency=0.322,  # brushed motors; set so that a full battery hovers for 7 min (Bitcraze)
        electronics_w=0.5,  # W, board and radio; estimated, set with the efficiency
    ),
    firmware=Firmware(
        lag_lead=0.35,  # 25 ms left of the motors' lag; thrust over weight of 2.25 leaves room for it
        rate_per_lag=0.42,  # damping 0.77 of rate loop and rotors together; 16.7 1/s here
        lag_min_s=0.015,  # s, three control steps
        loop_ratio=3.1,  # tilt 5.4 1/s, velocity 1.7 1/s
        yaw_share=1 / 3.5,  # chosen as the AR.Drone's
        body_rate_max_rad_s=5.0,  # rad/s, chosen as the AR.Drone's
        climb_share=1 / 7,  # 2.4 1/s
        hold_1_s=0.5,  # 1/s, below the velocity loop as much as the AR.Drone's
        height_1_s=0.9,  # 1/s, below the climb as much as the AR.Drone's
        brake_s=0.8,  # s, longer as the velocity loop is slower
        tilt_cut_cosine=0.25,  # chosen as the AR.Drone's
        lift_share_min=0.15,  # chosen as the AR.Drone's
        spin_up_s=0.5,  # s, chosen as the AR.Drone's
        takeoff_m_s=0.3,  # m/s, chosen: half of its height in a second
        takeoff_s_max=20.0,  # s, chosen as the AR.Drone's
        arrived_m=0.08,  # m, chosen as the AR.Drone's
        arrived_m_s=0.2,  # m/s, chosen as the AR.Drone's
        descent_m_s=0.3,  # m/s, chosen: softer, for its feet are hard
        descent_far_1_s=0.3,  # 1/s, chosen as the AR.Drone's
        flare_m=1.0,  # m, chosen
        touch_share=0.6,  # chosen as the AR.Drone's
        touch_m_s=0.15,  # m/s, chosen as the AR.Drone's
        touch_s=0.25,  # s, chosen as the AR.Drone's
        low_battery_percent=5.0,  # %, about twenty seconds of hover remain
        disturbance_walk=0.2,  # m/s^2/sqrt(s), as the AR.Drone's: its drag over mass is less, 0.23 1/s
        lift_walk=0.4,  # m/s^2/sqrt(s), as the AR.Drone's
        tilt_walk=6e-4,  # rad/sqrt(s), as the AR.Drone's
        bias_walk=2e-5,  # rad/s/sqrt(s), as the AR.Drone's
        lift_bias_walk=3e-3,  # m/s^2/sqrt(s), as the AR.Drone's
    ),
)
