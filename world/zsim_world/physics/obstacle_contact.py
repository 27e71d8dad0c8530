"""Obstacles and the hulls of drones that run into them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from zsim.math.compiled import apart, inlined
from zsim.scenario import obstacle
from zsim.scenario.scenario import Environment
from zsim_world.physics.encounter import hull_force
from zsim_world.physics.rigid_body import POSITION, VELOCITY
from zsim_world.state.vehicle import HULL_DAMPING, HULL_RADIUS, HULL_STIFFNESS

nearest: Any = inlined(obstacle.nearest)


def rows(environment: Environment) -> NDArray[np.float64]:
    """Return the obstacles of a scenario, (M, obstacle.COLUMNS)."""
    return np.array([obstacle.row_of(each) for each in environment.obstacles]).reshape(-1, obstacle.COLUMNS)


@apart
def bumps(
    vehicle: NDArray, state: NDArray, push: NDArray, obstacles: NDArray, bumping: NDArray, bumped: NDArray
) -> None:
    """Add to `push` what obstacles push drones with, and note who touches which; a hull is a sphere.

    Args:
        vehicle, state: parameters and state, a row per drone.
        push: (N, 3) force [N], added to.
        obstacles: a row each (zsim/scenario/obstacle.py).
        bumping: (N, M) 1 where they are in contact now, updated; bumped: (N, M) set to 1 where contact begins.
    """
    for i in range(state.shape[0]):
        for m in range(obstacles.shape[0]):
            depth = _bump(vehicle[i], state[i], push[i], obstacles[m])
            if depth > 0.0 and bumping[i, m] == 0:
                bumped[i, m] = 1
            bumping[i, m] = 1 if depth > 0.0 else 0


@inlined
def _bump(vehicle: NDArray, state: NDArray, push: NDArray, solid: NDArray) -> float:
    """Push one drone off one obstacle; return by how much its hull is dented [m], below 0 where they do not touch."""
    distance, nx, ny, nz = nearest(solid, state[POSITION], state[POSITION + 1], state[POSITION + 2])
    depth = vehicle[HULL_RADIUS] - distance
    if depth > 0.0:
        closing = -(state[VELOCITY] * nx + state[VELOCITY + 1] * ny + state[VELOCITY + 2] * nz)
        force = hull_force(vehicle[HULL_STIFFNESS], vehicle[HULL_DAMPING], depth, closing)
        push[0] += force * nx
        push[1] += force * ny
        push[2] += force * nz
    return depth
