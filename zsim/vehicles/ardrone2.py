"""Parrot AR.Drone 2.0 with its indoor hull.

Sources:
    Li           Q. Li, Grey-Box System Identification of a Quadrotor Unmanned Aerial Vehicle, MSc thesis, TU Delft
                 2014, as used by AuRoRA
    OpenMAS      measurements of an aircraft
    tum_ardrone  model of the ROS package, fitted to flights
"""

from zsim.vehicles.vehicle import Airframe, Battery, Firmware, Limits, Vehicle, cross_layout

ARM_M = 0.1785  # m, centre to rotor (Li)

VEHICLE = Vehicle(
    mass_kg=0.429,  # kg (Li)
    inertia_kg_m2=(2.237568e-3, 2.985236e-3, 4.80374e-3),  # kg m^2, about x, y and z (Li)
    arm_m=ARM_M,
    thrust_n_s2=8.048e-6,  # N s^2 (Li)
    torque_nm_s2=2.423e-7,  # N m s^2 (Li)
    rotor_time_constant_s=0.030,  # s; with the lag of the loops it gives tum_ardrone's fitted tilt lag of 0.143 s
    rotor_min_rad_s=126.0,  # rad/s, idle (Li)
    rotor_max_rad_s=503.0,  # rad/s (Li)
    drag_n_s_m=0.249,  # N s/m, fitted in flight (tum_ardrone)
    battery_mah=1000.0,  # mAh, of the battery supplied with the aircraft
    takeoff_height_m=1.0,  # m, as on the real aircraft
    limits=Limits(),  # the defaults are those of the aircraft's SDK
    sensor_preset="ardrone2",
    rotors=cross_layout(ARM_M),  # the first and third turn clockwise (Paparazzi, airframe ardrone2)
    rotor_radius_m=0.1,  # m, 0.2 m propeller
    rotor_inertia_kg_m2=2.029585e-5,  # kg m^2, rotor and gear (Li)
    airframe=Airframe(
        hull_radius_m=0.26,  # m, half of the indoor hull's 0.515 m (OpenMAS)
        foot_xy_m=0.10,  # m, under the hub of the central cross
        foot_depth_m=0.060,  # m, half of the aircraft's 0.127 m height, rounded down
        foot_sag_m=0.002,  # m, design choice: 70 rad/s, which an integration step of 2.5 ms can follow
        foot_damping_ratio=0.4,  # design choice: each swing reaches a quarter of the one before
        friction=0.6,  # foam on a hard floor, typical
        rim_xy_m=0.18,  # m, 0.26 m / sqrt(2)
        rim_height_m=0.03,  # m
        reach_m=0.27,  # m, 0.2563 m to a corner of the rim, plus margin
        hull_frequency_rad_s=80.0,  # rad/s, design choice: an impact at 3 m/s dents the foam by 4 cm
        hull_damping_ratio=0.3,  # rebound at about 0.4 of the approach speed
        clearance_m=0.3,  # m, the hull plus margin
    ),
    battery=Battery(
        voltage_v=11.1,  # V, three lithium-polymer cells, nominal
        efficiency=0.9,  # set so that a full battery lasts for 12 min of hover (10-12 min published)
        electronics_w=4.6,  # W, main board, camera and radio; set together with the efficiency
    ),
    firmware=Firmware(
        lag_lead=0.5,  # leaves 15 ms of the rotors' lag
        rate_per_lag=0.42,  # damping ratio of 0.77 for rate loop and rotors together; here a gain of 28 1/s
        lag_min_s=0.015,  # s, three control steps
        loop_ratio=3.1,  # tilt gain 9 1/s: closed loop of about 0.12 s, within the 0.143 s that tum_ardrone fitted
        yaw_share=1 / 3.5,  # the rotors' own inertia makes yaw faster: 0.04 s, as tum_ardrone fitted
        body_rate_max_rad_s=5.0,  # rad/s, design choice: above the 3.1 rad/s that a step to the tilt limit demands
        climb_share=1 / 7,  # climb gain 4 1/s: unlike horizontal motion, climbing needs no prior tilt
        hold_1_s=0.8,  # 1/s, below the velocity loop's 2.9 1/s
        height_1_s=1.5,  # 1/s, below the climb loop's 4 1/s
        brake_s=0.6,  # s, about the ratio of stopping distance to speed
        tilt_cut_cosine=0.25,  # beyond 75 deg the motors are cut, as in the real aircraft when overturned
        lift_share_min=0.15,  # design choice: leaves some thrust for tilt control in a descent
        spin_up_s=0.5,  # s, design choice: long compared with the rotors' lag
        takeoff_m_s=0.6,  # m/s, design choice: within the climb limit of 1 m/s
        takeoff_s_max=20.0,  # s, design choice: over twice the time to climb to the maximum take-off height of 5 m
        arrived_m=0.08,  # m, design choice: a small part of the take-off height
        arrived_m_s=0.2,  # m/s, design choice: a third of the take-off speed
        descent_m_s=0.4,  # m/s, design choice: touches down as after a fall of 8 mm
        descent_far_1_s=0.3,  # 1/s, design choice: 1 m/s at 4 m above the ground
        flare_m=2.0,  # m, design choice: 5 s at the final speed
        touch_share=0.6,  # design choice: about midway between hover and lift_share_min
        touch_m_s=0.15,  # m/s, design choice: well below descent_m_s
        touch_s=0.25,  # s, design choice: 50 control steps, so that noise does not stop the rotors
        low_battery_percent=5.0,  # %, about half a minute of hover remains
        disturbance_walk=0.2,  # m/s^2/sqrt(s): gusts of 0.5 m/s over 5 s on a drag of 0.58 1/s give 0.18
        lift_walk=0.4,  # m/s^2/sqrt(s): ground effect and downwash change faster than gusts
        tilt_walk=6e-4,  # rad/sqrt(s): vibration, rounding, and residual errors after turns
        bias_walk=2e-5,  # rad/s/sqrt(s): a bias of 0.1 deg/s is found within a minute
        lift_bias_walk=3e-3,  # m/s^2/sqrt(s): effect of the board's temperature on its accelerometer
    ),
)
