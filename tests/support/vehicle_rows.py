"""A drone's parameters in the form of the world's compiled kernel."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from zsim.scenario.scenario_file import resolve
from zsim.vehicles.vehicle import vehicle_of
from zsim_world.physics.fleet_arrays import PerRotor, rotor_row, vehicle_row


def rows_of(scenario: Any, i: int = 0) -> tuple[NDArray[np.float64], PerRotor]:
    """Return the parameters of a scenario's drone `i`, and those of its rotors."""
    drone = scenario.drones[i]
    vehicle = vehicle_of(drone.model)
    count = len(vehicle.rotors)
    known = PerRotor(rotor_row(vehicle, drone, count), 0, 1, tuple(range(count)))
    return vehicle_row(vehicle, drone, scenario.environment), known


def one_drone(**drone: Any) -> tuple[NDArray[np.float64], PerRotor]:
    """Return the parameters of a drone with the given fields, and those of its rotors."""
    drones = [{"name": "a", "position_m": [0, 0, 0], **drone}]
    return rows_of(resolve({"name": "t", "duration_s": 1, "drones": drones}))


def per_rotor(numbers: Any) -> PerRotor:
    """Return groups of numbers, one for each rotor."""
    held = np.array(numbers, dtype=float)
    return PerRotor(held, 0, 1, tuple(range(len(held))))
