"""The battery: energy drawn by rotors and board; a full 1000 mAh hovers for twelve minutes."""

from numpy.typing import NDArray

from zsim.math.compiled import inlined
from zsim_world.physics.rotors import Four, shaft_power
from zsim_world.state.vehicle import BOARD_W, CAPACITY, EFFICIENCY


@inlined
def power(row: NDArray, speed: Four) -> float:
    """Return the electric power [W] at these rotor speeds [rad/s]."""
    return shaft_power(row, speed) / EFFICIENCY + BOARD_W


@inlined
def drained(row: NDArray, energy_j: float, speed: Four, dt: float) -> float:
    """Return the energy left [J] after dt [s], never below zero."""
    return max(energy_j - power(row, speed) * dt, 0.0)


@inlined
def percent(row: NDArray, energy_j: float) -> float:
    """Return the charge in percent of a full battery."""
    return 100.0 * energy_j / row[CAPACITY]
