"""Flights of a fleet without commands, and what tests of contact look at in them."""

import math

import numpy as np

from zsim_world.fleet.fleet import Fleet
from zsim_world.physics.fleet_arrays import STATE, VEHICLE


def fly(fleet: Fleet, seconds: float) -> np.ndarray:
    """Advance, and return the state of all drones at every gate, (gates, N, STATE.size)."""
    track = []
    for _ in range(round(seconds / 0.02)):
        fleet.advance()
        track.append(fleet.bodies.state[:, : STATE.size].copy())
    return np.array(track)


def energy(fleet: Fleet, state: np.ndarray) -> np.ndarray:
    """Return kinetic and potential energy of each drone [J], without that of springs; state (..., N, STATE.size)."""
    row = fleet.bodies.vehicle
    inertia = row[:, VEHICLE.inertia : VEHICLE.inertia + 3]
    kinetic = row[:, VEHICLE.mass] * (state[..., 3:6] ** 2).sum(-1) + (inertia * state[..., 10:13] ** 2).sum(-1)
    return 0.5 * kinetic + row[:, VEHICLE.mass] * row[:, VEHICLE.gravity] * state[..., 2]


def tilt_deg(state: np.ndarray) -> float:
    return math.degrees(math.acos(np.clip(1 - 2 * (state[7] ** 2 + state[8] ** 2), -1, 1)))
