"""A fleet at t = 0: every drone on its feet, rotors still, batteries as the scenario says."""

import math
from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from zsim.math.frames import quaternion_from_heading, quaternion_from_rpy
from zsim.scenario import obstacle
from zsim.scenario.scenario import Drone, Scenario
from zsim.vehicles.vehicle import Vehicle
from zsim_world.fleet.flight_watch import SEEN
from zsim_world.physics import rigid_body
from zsim_world.physics.air import WIND
from zsim_world.physics.fleet_arrays import (
    CLOCK,
    EXPOSED,
    ROTOR,
    STATE,
    VEHICLE,
    Arrays,
    Boards,
    Bodies,
    KernelTime,
    NearPairs,
    NoiseRows,
    Senses,
    Watched,
    aero_row,
    rotor_row,
    rotor_slots,
    vehicle_row,
)
from zsim_world.physics.ground import contact_points
from zsim_world.physics.obstacle_contact import BALLS, SLOTS_MAX, obstacle_rows
from zsim_world.physics.simd import body_blocks
from zsim_world.sensors import sensor_set
from zsim_world.sensors.noise import NoiseTable
from zsim_world.sensors.sensor_set import FleetSensors
from zsim_world.vehicles import firmware, firmware_settings, observer, observer_gains
from zsim_world.vehicles.observer import BELIEF, CALIBRATION, DEVICE
from zsim_world.vehicles.simd_firmware import board_blocks, sound_actuators

ON_ROOF_M = 0.01  # m, chosen: so near to an obstacle a drone starts upon it


def arrays(scenario: Scenario, vehicles: Sequence[Vehicle], sensors: FleetSensors, noise: NoiseTable) -> Arrays:
    """Return the arrays of the kernel for a scenario whose drones are these vehicles with these sensors."""
    dt, drones, place = scenario.time.physics_dt_ms / 1000.0, scenario.drones, scenario.environment
    each = rotor_slots(vehicles)
    row = np.array([vehicle_row(vehicle, drone, place) for vehicle, drone in zip(vehicles, drones, strict=True)])
    rotors = np.array([rotor_row(vehicle, drone, each) for vehicle, drone in zip(vehicles, drones, strict=True)])
    clock = np.zeros(CLOCK.size, dtype=np.int64)
    clock[CLOCK.ticks_per_step] = round(observer.STEP_S / dt)
    time = KernelTime(clock=clock, spans=np.array([dt, scenario.silence.hover_s, scenario.silence.land_s]))
    numbers = NoiseRows(table=noise.table, at=noise.at, width=noise.width, cursor=noise.cursor)
    bodies, boards = _bodies(scenario, row, rotors, dt), _boards(scenario, vehicles, row, rotors)
    senses = _senses(scenario, sensors, noise)
    watched = Watched(seen=np.zeros((len(drones), SEEN.size)), found=np.zeros(len(drones), dtype=np.int64))
    watched.seen[bodies.external, SEEN.external] = 1.0
    return Arrays(time, bodies, boards, numbers, senses, _wind(scenario), noise.gust, watched)


def _bodies(scenario: Scenario, row: np.ndarray, rotors: np.ndarray, dt: float) -> Bodies:
    drones, n, obstacles = scenario.drones, len(scenario.drones), obstacle_rows(scenario.environment)
    each, slots = rotors.shape[1] // ROTOR.size, min(len(obstacles), SLOTS_MAX)
    state = np.array([_standing(drone, own, each) for drone, own in zip(drones, row, strict=True)])
    aero = np.array([aero_row(drone, scenario.environment) for drone in drones])
    external = np.array([i for i, drone in enumerate(drones) if drone.is_external], dtype=np.int64)
    half_decay = cast(Any, rigid_body.half_decay).py_func  # as Python: compiling it for a few numbers takes longer
    return Bodies(
        each=tuple(range(each)),
        vehicle=row,
        rotors=rotors,
        state=state,
        accel=np.zeros((n, 6)),
        anchor=np.array([_anchors(drone, own) for drone, own in zip(drones, row, strict=True)]),
        command=np.zeros((n, each)),
        energy=row[:, VEHICLE.capacity] * [drone.battery_percent / 100.0 for drone in drones],
        air=np.zeros((n, 3)),
        push=np.zeros((n, 3)),
        touching=np.zeros((n, n), dtype=np.int8),
        touched=np.zeros((n, n), dtype=np.int8),
        near=near(n),
        obstacle=obstacles,
        bumping=np.zeros((n, len(obstacles)), dtype=np.int8),
        bumped=np.zeros((n, len(obstacles)), dtype=np.int8),
        solid=np.full((n, slots), -1, dtype=np.int32),
        held=np.zeros((n, slots, BALLS, 3)),
        braced=np.zeros(n, dtype=np.int8),
        twist=np.zeros((n, 3)),
        aero_parts=(0, 1) if aero.any() else (0,),
        aero=aero,
        lanes=body_blocks(row, rotors, np.array([[half_decay(lag, dt)] for lag in row[:, VEHICLE.rotor_lag]]), aero),
        external=external,
        pose=state[external],
    )


def near(n: int) -> NearPairs:
    """Return near pairs that are yet to be found: no drone is where it was."""
    pairs = np.zeros((n * (n - 1) // 2, 2), dtype=np.int32)
    return NearPairs(pair=pairs, number=np.zeros(1, dtype=np.int64), origin=np.full((n, 3), np.inf))


def _boards(scenario: Scenario, vehicles: Sequence[Vehicle], row: np.ndarray, rotors: np.ndarray) -> Boards:
    drones, n, each = scenario.drones, len(scenario.drones), rotors.shape[1] // ROTOR.size
    both = list(zip(vehicles, drones, strict=True))
    setting = np.array([firmware_settings.settings(vehicle, drone) for vehicle, drone in both])
    calibration = np.array([_calibration(drone, scenario) for drone in drones])
    obstacles = obstacle_rows(scenario.environment)
    mounts = calibration[:, CALIBRATION.imu_turn : CALIBRATION.imu_turn + 4]
    return Boards(
        setting=setting,
        gain=np.array([observer_gains.gain_row(vehicle, drone, scenario.environment) for vehicle, drone in both]),
        calibration=calibration,
        setpoint=np.zeros((n, firmware.SETPOINT.size)),
        set_tick=np.zeros(n, dtype=np.int64),
        memory=np.zeros((n, firmware.MEMORY.size)),
        belief=np.array(
            [
                _first_belief(drone, own, board, obstacles, each)
                for drone, own, board in zip(drones, row, calibration, strict=True)
            ]
        ),
        actuator=sound_actuators(n, each),
        device=np.zeros((n, DEVICE.size)),
        lanes=board_blocks(row, rotors, setting, mounts),
    )


def _senses(scenario: Scenario, sensors: FleetSensors, noise: NoiseTable) -> Senses:
    field, log = scenario.environment, sensor_set.samples_per_gate(sensors, scenario.time.gate_ms) + 1
    kinds = len(sensors.names)
    exposures = log if kinds > len(sensor_set.SENSORS) else 1
    return Senses(
        place=np.array([*field.magnetic_field_ut, field.height_m]),
        config=sensor_set.config(sensors),
        fault=np.zeros((len(scenario.drones), kinds, sensor_set.FAULT.size)),
        schedule=sensor_set.schedule(sensors, scenario.time.physics_dt_ms),
        soonest=np.zeros(len(scenario.drones), dtype=np.int64),
        bias=noise.bias,
        whose=np.zeros((log, 3), dtype=np.int64),
        value=np.zeros((log, 6)),
        exposed_count=np.zeros(1, dtype=np.int64),
        exposed_whose=np.zeros((exposures, 3), dtype=np.int64),
        exposed=np.zeros((exposures, EXPOSED.size)),
    )


def _standing(drone: Drone, row: np.ndarray, rotors: int) -> np.ndarray:
    """Return the state of a drone whose feet carry its weight; a place above the ground is one that it falls from."""
    state = np.zeros(STATE.size + rotors)
    state[STATE.p_WB : STATE.p_WB + 3] = drone.position_m
    state[STATE.p_WB + 2] += row[VEHICLE.stand_height]
    state[STATE.q_WB : STATE.q_WB + 4] = quaternion_from_heading(math.radians(drone.yaw_deg))
    return state


def _anchors(drone: Drone, row: np.ndarray) -> np.ndarray:
    yaw = math.radians(drone.yaw_deg)
    turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    return np.array(drone.position_m[:2]) + contact_points(row)[:, :2] @ turn.T


def _first_belief(
    drone: Drone, row: np.ndarray, calibration: np.ndarray, obstacles: np.ndarray, rotors: int
) -> np.ndarray:
    """Return the belief at power-up: level, heading unknown until the first magnetometer sample.

    Where that tells none, the heading is the one that the drone was set down with. One that starts on a roof knows of
    its height, as one that has landed there.
    """
    belief = np.zeros(BELIEF.size + rotors)
    belief[BELIEF.q_WB] = 1.0
    if math.isnan(calibration[CALIBRATION.mag_bearing]):
        belief[BELIEF.heading] = math.radians(drone.yaw_deg)
        belief[BELIEF.q_WB : BELIEF.q_WB + 4] = quaternion_from_heading(belief[BELIEF.heading])
    belief[BELIEF.height] = row[VEHICLE.stand_height]
    roof_m = drone.position_m[2]
    is_on_roof = any(abs(obstacle.nearest(solid, *drone.position_m)[0]) < ON_ROOF_M for solid in obstacles)
    if is_on_roof and roof_m > observer.FLOOR_MIN_M:
        belief[BELIEF.height] = belief[BELIEF.stand_height] = roof_m + row[VEHICLE.stand_height]
    belief[BELIEF.still_steps] = observer.STILL_STEPS_MIN
    return belief


def _calibration(drone: Drone, scenario: Scenario) -> np.ndarray:
    """Return what the board knows of its mounts, and the bearing of the magnetic field where it gives a heading."""
    board = np.zeros(CALIBRATION.size)
    field = scenario.environment.magnetic_field_ut
    board[CALIBRATION.imu_turn : CALIBRATION.imu_turn + 4] = _turn(drone.sensors.imu.mount.rpy_deg)
    board[CALIBRATION.mag_turn : CALIBRATION.mag_turn + 4] = _turn(drone.sensors.mag.mount.rpy_deg)
    compass = sensor_set.has_compass(drone.sensors.mag, field)
    board[CALIBRATION.mag_bearing] = math.atan2(field[1], field[0]) if compass else math.nan
    board[CALIBRATION.sonar_min] = drone.sensors.sonar.min_m
    return board


def _turn(rpy_deg: tuple[float, float, float]) -> np.ndarray:
    return quaternion_from_rpy(np.radians(rpy_deg))


def _wind(scenario: Scenario) -> np.ndarray:
    wind = scenario.environment.wind
    row = np.empty(WIND.size)
    row[WIND.steady : WIND.steady + 3] = wind.steady_m_s
    row[WIND.gust], row[WIND.correlation] = wind.gust_m_s, wind.gust_correlation
    row[WIND.length], row[WIND.speed_min] = wind.gust_length_m, wind.gust_speed_min_m_s
    return row
