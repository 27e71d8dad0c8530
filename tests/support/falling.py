"""Flights of a fleet without commands, and the quantities that tests of contact check in them."""

import math

import numpy as np
import pytest

from zsim_world.fleet.fleet import Fleet
from zsim_world.physics.fleet_arrays import STATE, VEHICLE


def fly(fleet: Fleet, seconds: float) -> np.ndarray:
    """Advance the fleet; return the state of all drones at every gate, (gates, N, STATE.size)."""
    track = []
    for _ in range(round(seconds / 0.02)):
        fleet.advance()
        track.append(fleet.bodies.state[:, : STATE.size].copy())
    return np.array(track)


def energy(fleet: Fleet, state: np.ndarray) -> np.ndarray:
    """Return each drone's kinetic plus potential energy [J], without that of springs; state (..., N, STATE.size)."""
    row = fleet.bodies.vehicle
    inertia = row[:, VEHICLE.inertia : VEHICLE.inertia + 3]
    kinetic = row[:, VEHICLE.mass] * (state[..., 3:6] ** 2).sum(-1) + (inertia * state[..., 10:13] ** 2).sum(-1)
    return 0.5 * kinetic + row[:, VEHICLE.mass] * row[:, VEHICLE.gravity] * state[..., 2]


def tilt_deg(state: np.ndarray) -> float:
    return math.degrees(math.acos(np.clip(1 - 2 * (state[7] ** 2 + state[8] ** 2), -1, 1)))


def check_slide(fleet: Fleet, slope: float, friction: float | None, rel: float) -> None:
    """Check that the first drone slides down a slope s [rad] at g (sin s - mu cos s) or, if mu is None, stays put."""
    track = fly(fleet, 1.0)[:, 0]
    speeds = np.linalg.norm(track[:, 3:6], axis=1)
    if friction is not None:
        expected = 9.80665 * (math.sin(slope) - friction * math.cos(slope))
        assert (speeds[-1] - speeds[19]) / 0.6 == pytest.approx(expected, rel=rel)  # once the feet have settled
    else:
        assert speeds[-1] < 1e-5
        assert np.linalg.norm(track[-1, :3] - track[0, :3]) < 0.01  # the feet settle meanwhile
