"""The rotors of a vehicle: lag, thrust, torque, power; the mixer that finds speeds for thrust and torque; the battery.

Rotor r stands at (x, y) rotor_unit in B; seen from above it turns clockwise where its `turn` is 1. Groups of numbers
per rotor, `PerRotor`, are in the order of state/fleet_arrays.ROTOR.
"""

import math

from numpy.typing import NDArray

from zsim.math.compiled import inlined
from zsim.math.rotation import Quaternion, Vector, rotate
from zsim_world.physics.fleet_arrays import AERO, ROTOR, VEHICLE, PerRotor, Row, lift_share, mixed, of, place, put_of

LOW_SQUARE_MIN = 1e-12  # (rad/s)^2, of rotors that may stand still
GROUND_CLEARANCE_MIN = 0.5  # radii, the formula below is not meant for less


@inlined
def lagged(speed: float, command: float, decay: float) -> float:
    """Return a rotor's speed [rad/s] after a first-order lag has decayed to the fraction `decay` = exp(-t / lag)."""
    return command + (speed - command) * decay


@inlined
def ground_effect(height_m: float, radius_m: float) -> float:
    """Return the thrust near the ground over that in free air: 1 / (1 - (R / 4z)^2).

    Cheeseman and Bennett, ARC R&M 3021 (1955); z is the rotor's height, not taken below R/2 (factor 4/3).
    """
    z = max(height_m, GROUND_CLEARANCE_MIN * radius_m)
    ratio = radius_m / (4.0 * z)
    return 1.0 / (1.0 - ratio * ratio)


@inlined
def wrench(
    row: Row,
    rotors: PerRotor,
    q_WB: Quaternion,
    height_m: float,
    w_WB_B: Vector,
    speeds: PerRotor,
    commands: PerRotor,
    decay: float | None,
) -> tuple[float, Vector]:
    """Return thrust along z_B [N] and moment in B [N m] of the rotors.

    Moment: arms × thrusts, drag torque k_M w^2, reaction to the rotors' own acceleration J dw/dt, and the
    gyroscopic moment of their spin when the body turns.

    Args:
        row, rotors: the drone's parameters.
        q_WB, height_m: attitude, and height of the centre of mass over the ground.
        w_WB_B: body rate [rad/s].
        speeds, commands: of the rotors [rad/s] at the start of the step; decay: what is left of their lag since, or
            None at the start.
    """
    unit, radius, inertia = row[VEHICLE.rotor_unit], row[VEHICLE.rotor_radius], row[VEHICLE.rotor_inertia]
    ex, ey = rotate(q_WB, (unit, 0.0, 0.0))[2], rotate(q_WB, (0.0, unit, 0.0))[2]
    slew = 1.0 / row[VEHICLE.rotor_lag]
    total, mx, my, mz, spin = 0.0, 0.0, 0.0, 0.0, 0.0
    for r in range(len(rotors.each)):
        x, y, turn = place(rotors, r)
        speed, command = of(speeds, 0, r), of(commands, 0, r)
        if decay is not None:
            speed = lagged(speed, command, decay)
        square = speed * speed
        force = row[VEHICLE.thrust] * square * ground_effect(height_m + x * ex + y * ey, radius)
        total += force
        mx += y * unit * force
        my -= x * unit * force
        mz += (turn * row[VEHICLE.torque]) * square + (turn * inertia) * ((command - speed) * slew)
        spin += turn * inertia * speed
    return total, (mx + w_WB_B[1] * spin, my - w_WB_B[0] * spin, mz)


@inlined
def in_flow(
    row: Row,
    rotors: PerRotor,
    aero: Row,
    u_B: Vector,
    w_WB_B: Vector,
    speeds: PerRotor,
    commands: PerRotor,
    decay: float | None,
) -> tuple[Vector, Vector]:
    """Return force [N] and moment [N m] in B that a flow past the rotors adds (zsim.vehicles.vehicle.Aerodynamics).

    Translational lift, stated for rotors that fly, goes with the square of a speed below the least one commanded.

    Args:
        aero: (AERO.size,); u_B: velocity of the centre of mass against the air, in B [m/s].
        row, rotors, w_WB_B, speeds, commands, decay: as for `wrench`.
    """
    unit, (wx, wy, wz) = row[VEHICLE.rotor_unit], w_WB_B
    fx, fy, fz, mx, my, mz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for r in range(len(rotors.each)):
        x, y, _ = place(rotors, r)
        x, y = x * unit, y * unit
        speed, low = of(speeds, 0, r), of(rotors, ROTOR.low, r)
        if decay is not None:
            speed = lagged(speed, of(commands, 0, r), decay)
        ux, uy, uz = u_B[0] - wz * y, u_B[1] + wz * x, u_B[2] + wx * y - wy * x
        across = -aero[AERO.rotor_drag] * speed
        flying = min(speed * speed / max(low * low, LOW_SQUARE_MIN), 1.0)
        lift = aero[AERO.rotor_lift] * (ux * ux + uy * uy) * flying - aero[AERO.rotor_inflow] * speed * uz
        fx, fy, fz = fx + across * ux, fy + across * uy, fz + lift
        mx, my, mz = mx + y * lift, my - x * lift, mz + x * across * uy - y * across * ux
    return (fx, fy, fz), (mx, my, mz)


@inlined
def free_thrust(row: Row, speeds: PerRotor) -> float:
    """Return the thrust [N] far from the ground."""
    squares = 0.0
    for r in range(len(speeds.each)):
        squares += of(speeds, 0, r) * of(speeds, 0, r)
    return row[VEHICLE.thrust] * squares


@inlined
def mix(row: Row, rotors: PerRotor, thrust_n: float, moment: Vector, speeds: PerRotor) -> None:
    """Set rotor speeds [rad/s] that give a thrust [N] and a moment in B [N m] within the rotors' limits.

    What cannot be had is given up in this order: yaw first, then thrust, tilt last.
    """
    thrust = row[VEHICLE.thrust]
    low = thrust * row[VEHICLE.rotor_min] * row[VEHICLE.rotor_min]
    high = thrust * row[VEHICLE.rotor_max] * row[VEHICLE.rotor_max]
    roll, pitch = moment[0] / row[VEHICLE.rotor_unit], moment[1] / row[VEHICLE.rotor_unit]
    reach, least, most_lift = 0.0, lift_share(rotors, 0), lift_share(rotors, 0)
    for r in range(len(rotors.each)):
        by_roll, by_pitch, _, _ = mixed(rotors, r)
        reach = max(reach, abs(by_roll * roll + by_pitch * pitch))
        least, most_lift = min(least, lift_share(rotors, r)), max(most_lift, lift_share(rotors, r))
    # a mean with (low + reach) / least <= mean <= (high - reach) / most_lift, and the tilt that leaves one
    room = (high * least - low * most_lift) * (2.0 / (least + most_lift))
    scale = room / (2.0 * reach) if 2.0 * reach > room else 1.0
    roll, pitch, reach = roll * scale, pitch * scale, reach * scale
    mean = min(max(row[VEHICLE.rotor_share] * thrust_n, (low + reach) / least), (high - reach) / most_lift)
    yaw = moment[2] * thrust / row[VEHICLE.torque]
    sign, most = (1.0 if yaw >= 0.0 else -1.0), abs(yaw)
    for r in range(len(rotors.each)):
        by_roll, by_pitch, by_yaw, inverse = mixed(rotors, r)
        force, share = mean * lift_share(rotors, r) + by_roll * roll + by_pitch * pitch, sign * by_yaw
        room = (high - force if share > 0.0 else low - force) * (sign * inverse)
        most = min(most, room if share != 0.0 else most)
    for r in range(len(rotors.each)):
        by_roll, by_pitch, by_yaw, _ = mixed(rotors, r)
        force = mean * lift_share(rotors, r) + by_roll * roll + by_pitch * pitch
        put_of(speeds, r, math.sqrt(max(force + sign * by_yaw * most, low) / thrust))


@inlined
def power(row: NDArray, speeds: PerRotor) -> float:
    """Return the electric power [W] at these rotor speeds [rad/s]: of the shafts, sum of k_M w^3, and of the board."""
    cubes = 0.0
    for r in range(len(speeds.each)):
        speed = of(speeds, 0, r)
        cubes += speed * speed * speed
    return row[VEHICLE.torque] * cubes / row[VEHICLE.efficiency] + row[VEHICLE.electronics]


@inlined
def drained(row: NDArray, energy_j: float, speeds: PerRotor, dt: float) -> float:
    """Return the energy of the battery left [J] after dt [s], never below zero."""
    return max(energy_j - power(row, speeds) * dt, 0.0)


@inlined
def charge_percent(row: NDArray, energy_j: float) -> float:
    """Return the charge in percent of a full battery."""
    return 100.0 * energy_j / row[VEHICLE.capacity]
