"""The arrays of a fleet, which the kernel reads and writes: a row for each of N drones, with room for R rotors.

R is the largest number of rotors in the fleet, but at least five unless all vehicles have four rotors in an X
(`cross_layout`), whose positions and mixing are then constants of the code. Numbers per rotor follow the columns of a
row, R for each group; for a drone with fewer rotors the speeds and limits of the missing ones are zero. Compiled code
takes R from `each`, a tuple of R numbers: it is compiled for each R, with unrolled loops over rotors.
"""

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from zsim.math import elementary as el
from zsim.math.compiled import Field, columns, inlined
from zsim.math.rotation import Quaternion, Vector
from zsim.scenario.scenario import Drone, Environment
from zsim.scenario.surroundings import Sheet
from zsim.schema.quantities import COULOMB_PER_MAH, SEA_LEVEL_KG_M3
from zsim.vehicles.vehicle import Aerodynamics, Vehicle, allocation, lift_shares, mixing
from zsim_world.physics.rays import Scene

REFERENCE_DENSITY_KG_M3 = SEA_LEVEL_KG_M3  # air density for which a vehicle's coefficients are given

VEHICLE = columns(
    "VehicleColumns",
    (
        Field("mass", "kg"),
        Field("inertia", "kg m^2", 3),
        Field("rotor_unit", "m"),  # unit of the rotors' positions: arm / sqrt(2)
        Field("thrust", "N s^2"),  # at the scenario's air density; so are torque and drag
        Field("torque", "N m s^2"),
        Field("rotor_lag", "s"),
        Field("rotor_min", "rad/s"),
        Field("rotor_max", "rad/s"),
        Field("drag", "N s/m"),
        Field("gravity", "m/s^2"),
        Field("air_density", "kg/m^3"),
        Field("rotor_radius", "m"),
        Field("rotor_inertia", "kg m^2"),
        Field("rotor_share", "1"),  # 1 / number of rotors
        Field("jet_start", "m"),  # width of the jet where it leaves the rotors
        Field("contact_reach", "m"),  # distance from the centre of mass that no contact point exceeds
        Field("stand_height", "m"),  # height of the centre of mass of a standing drone
        Field("foot_stiffness", "N/m"),  # per contact point
        Field("foot_damping", "N s/m"),
        Field("foot_xy", "m"),
        Field("foot_depth", "m"),
        Field("rim_xy", "m"),
        Field("rim_height", "m"),
        Field("friction", "1"),
        Field("hull_radius", "m"),
        Field("hull_stiffness", "N/m"),  # between two drones of this mass
        Field("hull_damping", "N s/m"),
        Field("capacity", "J"),  # energy of a full battery
        Field("efficiency", "1"),  # from electric to shaft power
        Field("electronics", "W"),
    ),
)
ROTOR = columns(  # parameters of the rotors: one group per parameter, one number per rotor
    "RotorGroups",
    (
        Field("x", "rotor_unit"),
        Field("y", "rotor_unit"),
        Field("turn", "1"),  # sign of the drag torque on the body about z; 0: no such rotor
        Field("low", "rad/s"),  # speed limits
        Field("high", "rad/s"),
        Field("roll", "1"),  # thrust per (moment / rotor_unit)
        Field("pitch", "1"),
        Field("yaw", "1"),  # thrust per (moment / (torque per thrust))
        Field("yaw_inverse", "1"),  # 1 / yaw; 0 if yaw is 0
        Field("lift", "1"),  # thrust / mean thrust of all rotors at zero moment; 1 for balanced rotors
    ),
)
AERO = columns(  # zsim.vehicles.vehicle.Aerodynamics, at the scenario's air density
    "AeroColumns",
    (
        Field("linear", "N s/m", 3),
        Field("quadratic", "N s^2/m^2", 3),
        Field("rotor_drag", "N s^2/m"),
        Field("rotor_inflow", "N s^2/m"),
        Field("rotor_lift", "N s^2/m^2"),
    ),
)
STATE = columns(  # followed by R rotor speeds [rad/s]
    "StateColumns", (Field("p_WB", "m", 3), Field("v_WB", "m/s", 3), Field("q_WB", "1", 4), Field("w_WB_B", "rad/s", 3))
)
CLOCK = columns(
    "ClockColumns", (Field("tick", "1"), Field("ticks_per_step", "1"))
)  # current tick; ticks per step of the firmware
SPAN = columns(
    "SpanColumns", (Field("dt", "s"), Field("hover", "s"), Field("land", "s"))
)  # length of a tick; silence until hovering, then until landing
PLACE = columns("PlaceColumns", (Field("field_W", "uT", 3), Field("height", "m")))  # height of W above sea level
EXPOSED = columns(  # truth that a user's sensor measures; accel as in Bodies
    "ExposedColumns", (Field("state", "STATE", 13), Field("accel", "m/s^2, rad/s^2", 6), Field("air", "m/s", 3))
)
STREAMS = columns("StreamColumns", (Field("sensors", "1", 6), Field("wind", "1")))

Row = NDArray[np.float64] | tuple[float, ...]  # row of one drone: an array view, or its values loaded into a tuple
CROSS_ROTORS = 4
# Groups of ROTOR for four rotors in an X (zsim.vehicles.vehicle.cross_layout)
_X, _Y, _TURN = (1.0, 1.0, -1.0, -1.0), (1.0, -1.0, -1.0, 1.0), (1.0, -1.0, 1.0, -1.0)
_ROLL, _PITCH, _YAW = (0.25, -0.25, -0.25, 0.25), (-0.25, -0.25, 0.25, 0.25), (0.25, -0.25, 0.25, -0.25)


class KernelTime(NamedTuple):
    clock: NDArray  # int64 (CLOCK.size,)
    spans: NDArray  # (SPAN.size,)


class NearPairs(NamedTuple):
    """Pairs of drones that can affect each other, and the drones' positions when they were found (contacts.py)."""

    pair: NDArray  # int32 (N (N - 1) / 2, 2), i < j, ascending
    number: NDArray  # int64 (1,), number of pairs
    origin: NDArray  # (N, 3), m
    above: NDArray  # int8 (N,), 1 if a drone's sonar or flow sensor may see another drone
    eye: NDArray  # (N, 3), downward view: offset from the drone's centre [m], range [m], cosine of the largest tilt


class Bodies(NamedTuple):
    each: tuple[int, ...]  # R numbers
    vehicle: NDArray  # (N, VEHICLE.size)
    rotors: NDArray  # (N, ROTOR.size * R)
    state: NDArray  # (N, STATE.size + R)
    accel: NDArray  # (N, 6), acceleration in W [m/s^2] and angular acceleration in B [rad/s^2]
    anchor: NDArray  # (N, 8, 2), m, anchors of the contact points on the ground
    command: NDArray  # (N, R), rad/s
    energy: NDArray  # (N,), J
    air: NDArray  # (N, 3), m/s
    push: NDArray  # (N, 3), N
    touching: NDArray  # int8 (N, N), 1 where hulls are in contact now
    touched: NDArray  # int8 (N, N), 1 where contact began in this gate
    near: NearPairs
    obstacle: NDArray  # (M, surroundings.COLUMNS)
    bumping: NDArray  # int8 (N, M + surfaces), 1 if more of a drone than its feet touches an obstacle or surface
    bumped: NDArray  # int8 (N, M + surfaces), 1 where such contact began in this gate
    solid: NDArray  # int32 (N, K), obstacles within reach; see physics/surfaces.py
    held: NDArray  # (N, K, BALLS, 3), m, anchors on these obstacles
    plane: NDArray  # (N, BALLS, PLANE.size), nearest planes of surfaces (physics/surfaces.py); no rows without surfaces
    braced: NDArray  # int8 (N,), 1 if an obstacle or surface is within reach or a hull touches another
    twist: NDArray  # (N, 3), N m in W, moment of other drones' hulls; valid where braced
    lanes: NDArray  # (blocks, columns of a block); see physics/simd.py
    aero_parts: tuple[int, ...]  # length 2 if any drone has aerodynamics, else 1: compiled code then omits them
    aero: NDArray  # (N, AERO.size)
    external: NDArray  # int64 (E,), indices of the drones that are not integrated
    pose: NDArray  # (E, STATE.size + R), their states, extrapolated at their velocities in every tick


class Boards(NamedTuple):
    setting: NDArray  # (N, firmware.SETTING.size)
    gain: NDArray  # (N, observer.GAIN.size)
    calibration: NDArray  # (N, observer.CALIBRATION.size)
    setpoint: NDArray  # (N, firmware.SETPOINT.size)
    set_tick: NDArray  # int64 (N,), tick at which the setpoint was sent
    memory: NDArray  # (N, firmware.MEMORY.size)
    belief: NDArray  # (N, observer.BELIEF.size + R)
    actuator: NDArray  # (N, firmware.ACTUATOR.size + 2 R), effects of faults on rotor commands
    device: NDArray  # (N, observer.DEVICE.size)
    lanes: NDArray  # (blocks, columns of a block); see firmware.py


class NoiseRows(NamedTuple):
    """Standard normal variates, a row per drone; the last row is for the wind that is common to all."""

    table: NDArray  # (N + 1, all streams)
    at: NDArray  # int64 (STREAMS.size,), where each stream begins in a row
    width: NDArray  # int64 (N + 1, STREAMS.size), numbers per sample
    cursor: NDArray  # int64 (N + 1, STREAMS.size), count of numbers used from each stream


class Senses(NamedTuple):
    """N sets of S sensors, the six stock ones first, and the log of their samples in a gate."""

    place: NDArray  # (PLACE.size,)
    config: NDArray  # (N, S, sensor_set.CONFIG.size)
    fault: NDArray  # (N, S, sensor_set.FAULT.size)
    schedule: NDArray  # int64 (N, S, sensor_set.SCHEDULE.size)
    soonest: NDArray  # int64 (N,), next tick at which a sensor other than the IMU is due
    bias: NDArray  # (N, 6, 12): biases of all channels, then their Gauss-Markov processes
    whose: NDArray  # int64 (samples, 3): sensor, drone, tick
    value: NDArray  # (samples, 6)
    exposed_count: NDArray  # int64 (1,), number of exposures of users' sensors in this gate
    exposed_whose: NDArray  # int64 (user samples, 3): sensor, drone, tick
    exposed: NDArray  # (user samples, EXPOSED.size)


class Watched(NamedTuple):
    """The data for detecting incidents of N drones; see fleet/flight_watch.py."""

    seen: NDArray  # (N, flight_watch.SEEN.size)
    found: NDArray  # int64 (N,), bits of each drone's incidents in the last gate


class Arrays(NamedTuple):
    time: KernelTime
    bodies: Bodies
    boards: Boards
    noise: NoiseRows
    senses: Senses
    wind: NDArray  # (contacts.WIND.size,)
    gust: NDArray  # (N, 3), m/s
    watched: Watched
    scene: Scene
    sheet: Sheet


def state_arrays(group: tuple[object, ...]) -> Iterator[NDArray]:
    """Yield the arrays that make up the state of a fleet: all but near pairs (found anew), scene and sheet."""
    for member in group:
        if isinstance(member, np.ndarray):
            yield member
        elif isinstance(member, tuple) and not isinstance(member, NearPairs | Scene | Sheet):
            yield from state_arrays(member)


class PerRotor(NamedTuple):
    """One drone's groups of numbers per rotor, in a row or in a block of drones; read by `value_of`."""

    numbers: NDArray
    first: int
    step: int
    each: tuple[int, ...]


class Aero(NamedTuple):
    """Aerodynamics of one drone; if `parts` (Bodies.aero_parts) has length 1, compiled code omits them."""

    parts: tuple[int, ...]
    numbers: Row  # (AERO.size,)


@inlined
def vector(row: Row, at: int) -> Vector:
    return (row[at], row[at + 1], row[at + 2])


@inlined
def four(row: Row, at: int) -> Quaternion:
    return (row[at], row[at + 1], row[at + 2], row[at + 3])


@inlined
def put(row: NDArray, at: int, a: Vector) -> None:
    row[at], row[at + 1], row[at + 2] = a


@inlined
def put_four(row: NDArray, at: int, a: Quaternion) -> None:
    row[at], row[at + 1], row[at + 2], row[at + 3] = a


@inlined
def value_of(rotors: PerRotor, group: int, r: int) -> float:
    """Return the value for rotor r in a group."""
    return rotors.numbers[rotors.first + rotors.step * (group * len(rotors.each) + r)]


@inlined
def rotor_layout(rotors: PerRotor, r: int) -> tuple[float, float, float]:
    """Return x, y [rotor_unit] and turn of rotor r, from the drone's rotor parameters."""
    if len(rotors.each) == CROSS_ROTORS:
        return _X[r], _Y[r], _TURN[r]
    return value_of(rotors, ROTOR.x, r), value_of(rotors, ROTOR.y, r), value_of(rotors, ROTOR.turn, r)


@inlined
def mixed(rotors: PerRotor, r: int) -> tuple[float, float, float, float]:
    """Return the mixer's roll, pitch, yaw and inverse of yaw for rotor r, from the drone's rotor parameters."""
    if len(rotors.each) == CROSS_ROTORS:
        return _ROLL[r], _PITCH[r], _YAW[r], 1.0 / _YAW[r]
    inverse = value_of(rotors, ROTOR.yaw_inverse, r)
    return value_of(rotors, ROTOR.roll, r), value_of(rotors, ROTOR.pitch, r), value_of(rotors, ROTOR.yaw, r), inverse


@inlined
def lift_share(rotors: PerRotor, r: int) -> float:
    """Return the ratio of rotor r's thrust to the mean, from the drone's rotor parameters."""
    if len(rotors.each) == CROSS_ROTORS:
        return 1.0
    return value_of(rotors, ROTOR.lift, r)


@inlined
def put_value(rotors: PerRotor, r: int, value: float) -> None:
    """Set the value for rotor r in the first group."""
    rotors.numbers[rotors.first + rotors.step * r] = value


def rotor_slots(vehicles: Iterable[Vehicle]) -> int:
    slots, cross_allocation = CROSS_ROTORS, np.array((_Y, [-x for x in _X], _TURN))
    for vehicle in vehicles:
        cross = np.array_equal(allocation(vehicle), cross_allocation)
        slots = max(slots, len(vehicle.rotors) if cross else max(len(vehicle.rotors), CROSS_ROTORS + 1))
    return slots


def vehicle_row(vehicle: Vehicle, drone: Drone, environment: Environment) -> NDArray[np.float64]:
    """Return the parameters of one drone, (VEHICLE.size,): its vehicle's, with the scenario's changes."""
    row, frame = np.empty(VEHICLE.size), vehicle.airframe
    density = environment.air_density_kg_m3 / REFERENCE_DENSITY_KG_M3
    size = drone.arm_m / vehicle.arm_m
    row[VEHICLE.mass] = drone.mass_kg
    row[VEHICLE.inertia : VEHICLE.inertia + 3] = drone.inertia_kg_m2
    row[VEHICLE.rotor_unit] = drone.arm_m / math.sqrt(2.0)
    row[VEHICLE.thrust], row[VEHICLE.torque] = drone.thrust_n_s2 * density, drone.torque_nm_s2 * density
    row[VEHICLE.rotor_lag] = drone.rotor_time_constant_s
    row[VEHICLE.rotor_min], row[VEHICLE.rotor_max] = drone.rotor_min_rad_s, drone.rotor_max_rad_s
    row[VEHICLE.drag] = drone.drag_n_s_m * density
    row[VEHICLE.gravity], row[VEHICLE.air_density] = environment.gravity_m_s2, environment.air_density_kg_m3
    row[VEHICLE.rotor_radius] = vehicle.rotor_radius_m * math.sqrt(math.sqrt(drone.thrust_n_s2 / vehicle.thrust_n_s2))
    row[VEHICLE.rotor_inertia] = vehicle.rotor_inertia_kg_m2 * drone.torque_nm_s2 / vehicle.torque_nm_s2
    row[VEHICLE.rotor_share] = 1.0 / len(vehicle.rotors)
    row[VEHICLE.jet_start] = math.sqrt(len(vehicle.rotors)) * row[VEHICLE.rotor_radius]
    row[VEHICLE.contact_reach] = frame.reach_m * size
    row[VEHICLE.stand_height] = size * (frame.foot_depth_m - frame.foot_sag_m)
    stiffness = drone.mass_kg * environment.gravity_m_s2 / (4.0 * size * frame.foot_sag_m)
    row[VEHICLE.foot_stiffness] = stiffness
    row[VEHICLE.foot_damping] = 2.0 * frame.foot_damping_ratio * math.sqrt(stiffness * drone.mass_kg / 4.0)
    row[VEHICLE.foot_xy], row[VEHICLE.foot_depth] = size * frame.foot_xy_m, size * frame.foot_depth_m
    row[VEHICLE.rim_xy], row[VEHICLE.rim_height] = size * frame.rim_xy_m, size * frame.rim_height_m
    row[VEHICLE.friction] = frame.friction
    reduced = drone.mass_kg / 2.0
    row[VEHICLE.hull_radius] = size * frame.hull_radius_m
    row[VEHICLE.hull_stiffness] = reduced * el.square(frame.hull_frequency_rad_s)
    row[VEHICLE.hull_damping] = 2.0 * frame.hull_damping_ratio * reduced * frame.hull_frequency_rad_s
    row[VEHICLE.capacity] = drone.battery_mah * COULOMB_PER_MAH * vehicle.battery.voltage_v
    row[VEHICLE.efficiency], row[VEHICLE.electronics] = vehicle.battery.efficiency, vehicle.battery.electronics_w
    return row


def aero_row(drone: Drone, environment: Environment) -> NDArray[np.float64]:
    """Return the aerodynamics of one drone, (AERO.size,)."""
    row, aero = np.empty(AERO.size), Aerodynamics() if drone.aerodynamics is UNSET else drone.aerodynamics
    row[AERO.linear : AERO.linear + 3] = aero.linear_drag_n_s_m
    row[AERO.quadratic : AERO.quadratic + 3] = aero.quadratic_drag_n_s2_m2
    row[AERO.rotor_drag], row[AERO.rotor_inflow] = aero.rotor_drag_n_s2_m, aero.rotor_inflow_n_s2_m
    row[AERO.rotor_lift] = aero.rotor_lift_n_s2_m2
    return row * (environment.air_density_kg_m3 / REFERENCE_DENSITY_KG_M3)


def rotor_row(vehicle: Vehicle, drone: Drone, rotors: int) -> NDArray[np.float64]:
    """Return the parameters of each rotor of one drone, (ROTOR.size * rotors,)."""
    groups, count = np.zeros((ROTOR.size, rotors)), len(vehicle.rotors)
    roll, minus_pitch, turn = allocation(vehicle)
    groups[ROTOR.x, :count], groups[ROTOR.y, :count], groups[ROTOR.turn, :count] = -minus_pitch, roll, turn
    groups[ROTOR.low, :count], groups[ROTOR.high, :count] = drone.rotor_min_rad_s, drone.rotor_max_rad_s
    groups[ROTOR.roll : ROTOR.yaw + 1, :count] = mixing(vehicle).T
    groups[ROTOR.lift], groups[ROTOR.lift, :count] = 1.0, lift_shares(vehicle)
    yaw = groups[ROTOR.yaw]
    groups[ROTOR.yaw_inverse] = np.divide(1.0, yaw, out=np.zeros(rotors), where=yaw != 0.0)
    return groups.ravel()
