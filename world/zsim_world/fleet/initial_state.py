"""A fleet at t = 0: every drone on its feet, rotors still, batteries as the scenario says."""

import math
from typing import Any, cast

import numpy as np

from zsim.math.frames import quaternion_from_heading, quaternion_from_rpy
from zsim.scenario.scenario import Drone, Scenario
from zsim_world.physics import obstacle_contact, rigid_body, simd, simd_body
from zsim_world.physics import wind as wind_model
from zsim_world.sensors import sensor_set
from zsim_world.sensors.noise import NoiseTable, samples_per_gate
from zsim_world.state import vehicle
from zsim_world.state.fleet_arrays import Arrays, Boards, Bodies, Near, Noise, Senses, Time
from zsim_world.vehicles import attitude_control, firmware, observer, observer_gains, simd_firmware


def arrays(scenario: Scenario, noise: NoiseTable) -> Arrays:
    """Return the arrays of the kernel for a scenario."""
    dt = scenario.time.physics_dt_ms / 1000.0
    row = np.array([vehicle.parameters(drone, scenario.environment) for drone in scenario.drones])
    time = Time(
        clock=np.array([0, round(observer.STEP_S / dt)], dtype=np.int64),
        spans=np.array([dt, scenario.silence.hover_s, scenario.silence.land_s]),
    )
    numbers = Noise(table=noise.table, at=noise.at, cursor=noise.cursor)
    boards, senses = _boards(scenario, row), _senses(scenario, noise)
    return Arrays(time, _bodies(scenario, row, dt), boards, numbers, senses, _wind(scenario), noise.gust)


def _bodies(scenario: Scenario, row: np.ndarray, dt: float) -> Bodies:
    drones, n, obstacles = scenario.drones, len(scenario.drones), obstacle_contact.rows(scenario.environment)
    half_decay = cast(Any, rigid_body.half_decay).py_func  # as Python: compiling it for a few numbers takes longer
    return Bodies(
        vehicle=row,
        state=np.array([_standing(*each) for each in zip(drones, row, strict=True)]),
        accel=np.zeros((n, 6)),
        anchor=np.array([_anchors(*each) for each in zip(drones, row, strict=True)]),
        command=np.zeros((n, 4)),
        energy=row[:, vehicle.CAPACITY] * [drone.battery_percent / 100.0 for drone in drones],
        air=np.zeros((n, 3)),
        push=np.zeros((n, 3)),
        touching=np.zeros((n, n), dtype=np.int8),
        touched=np.zeros((n, n), dtype=np.int8),
        near=near(n),
        obstacle=obstacles,
        bumping=np.zeros((n, len(obstacles)), dtype=np.int8),
        bumped=np.zeros((n, len(obstacles)), dtype=np.int8),
        lanes=simd.blocks(
            simd_body.COLUMNS, row, np.array([[half_decay(lag, dt)] for lag in row[:, vehicle.ROTOR_LAG]])
        ),
    )


def near(n: int) -> Near:
    """Return near pairs that are yet to be found: no drone is where it was."""
    pairs = np.zeros((n * (n - 1) // 2, 2), dtype=np.int32)
    return Near(pair=pairs, noted=np.zeros(1, dtype=np.int64), origin=np.full((n, 3), np.inf))


def _boards(scenario: Scenario, row: np.ndarray) -> Boards:
    drones, n = scenario.drones, len(scenario.drones)
    setting = np.array([firmware.settings(drone) for drone in drones])
    calibration = np.array([_calibration(drone, scenario) for drone in drones])
    mounts = calibration[:, observer.IMU_TURN : observer.IMU_TURN + 4]
    return Boards(
        setting=setting,
        gain=np.array([observer_gains.gain_row(drone, scenario.environment) for drone in drones]),
        calibration=calibration,
        setpoint=np.zeros((n, firmware.SETPOINT_COLUMNS)),
        set_tick=np.zeros(n, dtype=np.int64),
        memory=np.zeros((n, firmware.MEMORY_COLUMNS)),
        belief=np.array([_first_belief(height) for height in row[:, vehicle.STAND_HEIGHT]]),
        actuator=simd_firmware.sound_actuators(n),
        device=np.zeros((n, observer.REGISTERS)),
        lanes=simd.blocks(simd_firmware.COLUMNS, row, setting[:, attitude_control.GAINS], mounts),
    )


def _senses(scenario: Scenario, noise: NoiseTable) -> Senses:
    field, log = scenario.environment, samples_per_gate(scenario) + 1
    return Senses(
        place=np.array([*field.magnetic_field_ut, field.height_m]),
        config=sensor_set.config(scenario),
        fault=np.zeros((len(scenario.drones), len(sensor_set.SENSORS), sensor_set.FAULT_COLUMNS)),
        schedule=sensor_set.schedule(scenario),
        soonest=np.zeros(len(scenario.drones), dtype=np.int64),
        bias=noise.bias,
        whose=np.zeros((log, 3), dtype=np.int64),
        value=np.zeros((log, 6)),
    )


def _standing(drone: Drone, row: np.ndarray) -> np.ndarray:
    """Return the state of a drone whose feet carry its weight; a place above the ground is one that it falls from."""
    state = np.zeros(rigid_body.COLUMNS)
    state[rigid_body.POSITION : rigid_body.POSITION + 3] = drone.position_m
    state[rigid_body.POSITION + 2] += row[vehicle.STAND_HEIGHT]
    state[rigid_body.ATTITUDE : rigid_body.ATTITUDE + 4] = quaternion_from_heading(math.radians(drone.yaw_deg))
    return state


def _anchors(drone: Drone, row: np.ndarray) -> np.ndarray:
    yaw = math.radians(drone.yaw_deg)
    turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    return np.array(drone.position_m[:2]) + row[vehicle.SIZE] * vehicle.CONTACT_POINTS_B[:, :2] @ turn.T


def _first_belief(height: float) -> np.ndarray:
    """Return the belief at power-up: level, heading unknown until the first magnetometer sample."""
    belief = np.zeros(observer.COLUMNS)
    belief[observer.ATTITUDE] = 1.0
    belief[observer.HEIGHT] = height
    belief[observer.STILL_STEPS] = observer.STILL_STEPS_MIN
    return belief


def _calibration(drone: Drone, scenario: Scenario) -> np.ndarray:
    """Return what the board knows of its mounts, and the bearing of the magnetic field at the place."""
    board = np.zeros(observer.CALIBRATION)
    field = scenario.environment.magnetic_field_ut
    board[observer.IMU_TURN : observer.IMU_TURN + 4] = _turn(drone.sensors.imu.mount.rpy_deg)
    board[observer.MAG_TURN : observer.MAG_TURN + 4] = _turn(drone.sensors.mag.mount.rpy_deg)
    board[observer.MAG_BEARING] = math.atan2(field[1], field[0])
    board[observer.SONAR_MIN] = drone.sensors.sonar.min_m
    return board


def _turn(rpy_deg: tuple[float, float, float]) -> np.ndarray:
    return quaternion_from_rpy(np.radians(rpy_deg))


def _wind(scenario: Scenario) -> np.ndarray:
    wind = scenario.environment.wind
    row = np.empty(wind_model.COLUMNS)
    row[wind_model.STEADY : wind_model.STEADY + 3] = wind.steady_m_s
    row[wind_model.GUST], row[wind_model.CORRELATION] = wind.gust_m_s, wind.gust_correlation
    row[wind_model.LENGTH], row[wind_model.SPEED_MIN] = wind.gust_length_m, wind.gust_speed_min_m_s
    return row
