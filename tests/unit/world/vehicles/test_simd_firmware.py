"""Eight boards in one step: the bits of each board's own."""

from typing import Any

import numpy as np

from zsim.math import rotation
from zsim.scenario.scenario_file import resolve
from zsim_world.fleet.fleet import Fleet
from zsim_world.physics.fleet_arrays import ROTOR, VEHICLE, PerRotor
from zsim_world.physics.simd import LANES
from zsim_world.vehicles import firmware, observer
from zsim_world.vehicles.firmware import BOARD_LANES, BOARD_ROTORS, DRIVE
from zsim_world.vehicles.observer import BELIEF

COUNT = 11  # a whole block and a part of one
STEP_TICKS = 2  # of 2.5 ms


def flying():
    """Return drones of two kinds in the air, each with a setpoint of another kind; one stands."""
    heavy: Any = {"mass_kg": 0.6, "arm_m": 0.25, "thrust_n_s2": 1.2e-5, "rotor_time_constant_s": 0.05}
    mount: Any = {"imu": {"mount": {"rpy_deg": [5.0, -3.0, 170.0]}}}
    drones = [
        {
            "name": f"d{k}",
            "position_m": [3.0 * k, 0, 0],
            "yaw_deg": 33.0 * k,
            "sensors": mount,
            **(heavy if k % 3 else {}),
        }
        for k in range(COUNT)
    ]
    fleet = Fleet(resolve({"name": "t", "duration_s": 60, "drones": drones}))
    for i in range(COUNT - 1):
        assert fleet.takeoff(i) is None
    for _ in range(350):
        fleet.advance()
    fleet.set_attitude(1, (0.98, 0.1, -0.1, 0.0), 5.0, 2.0)
    fleet.set_rotors(2, (300.0, 310.0, 320.0, 330.0))
    fleet.set_ardrone(3, 0.5, -0.3, 0.2, 1.0)
    for i in range(4, COUNT - 1):
        fleet.set_velocity(i, (0.5 * i, -1.0, 0.3), 0.4 * (i - 6))
    return fleet


def lane(table, i, at, count):
    """Return what stands in the columns of drone i."""
    return tuple(table[i // LANES].reshape(-1, LANES)[at : at + count, i % LANES].tolist())


def rotors_of(table, i, group, count):
    """Return groups of numbers per rotor of drone i."""
    return PerRotor(np.array(lane(table, i, BOARD_LANES.size + 4 * group, 4 * count)), 0, 1, (0, 1, 2, 3))


def test_a_block_turns_and_drives_with_the_bits_of_each_drone():
    fleet, driven = flying(), 0
    boards, lanes = fleet.boards, fleet.boards.lanes
    for _ in range(60):
        fleet._noise.refill()
        before = boards.belief.copy()
        fleet._integrate(STEP_TICKS)
        for i in range(COUNT):
            w = lane(lanes, i, BOARD_LANES.w_WB_B, 3)
            turn = rotation.from_rotation_vector(observer.step_turn(w))
            q = rotation.normalised(rotation.multiply(tuple(before[i, BELIEF.q_WB : BELIEF.q_WB + 4]), turn))
            assert lane(lanes, i, BOARD_LANES.heading, 1) == (rotation.heading(q),)
            if lane(lanes, i, BOARD_LANES.driven, 1) == (0.0,):
                continue
            driven += 1
            sizes = {BOARD_LANES.own: 4, BOARD_LANES.q_WB: 4, BOARD_LANES.w_WB_B: 3, BOARD_LANES.z_H: 3}
            own, believed, rate, z = (lane(lanes, i, at, size) for at, size in sizes.items())
            thrust, yaw_rate = lane(lanes, i, BOARD_LANES.thrust, 2)
            row, gains = lane(lanes, i, 0, VEHICLE.size), lane(lanes, i, BOARD_LANES.drive, DRIVE.size)
            known, speeds = (
                rotors_of(lanes, i, group, size) for group, size in ((0, ROTOR.size), (BOARD_ROTORS.speed, 1))
            )
            commands = PerRotor(np.zeros(4), 0, 1, (0, 1, 2, 3))
            firmware.drive(row, known, gains, own, believed, rate, speeds, z, thrust, yaw_rate, commands)
            assert tuple(rotors_of(lanes, i, BOARD_ROTORS.command, 1).numbers) == tuple(commands.numbers)
    assert driven == 60 * (COUNT - 2)
    np.testing.assert_array_equal(rotors_of(lanes, 2, BOARD_ROTORS.command, 1).numbers, fleet.bodies.command[2])
