"""Where everything stands in a picture of the run: arrays from what eyes were told. Pure, without a page.

Axes, units and quaternions as everywhere: W east, north, up; quaternions w first, body to world.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.contract.messages import EstimateView, ViewCluster, ViewDrones
from zsim.math import frames
from zsim_agents.formation.spaces.cluster_space import ClusterSpace, SingularClusterError

Array = NDArray[np.float64]

SLOWED = 50.0  # of the rotors' speed: at 10 pictures/s the fastest turn by 57 degrees, so not seen as backwards
SIGMAS = 2.0  # of an ellipsoid
SHARE_WITHIN = 1 - math.erfc(SIGMAS / math.sqrt(2)) - math.sqrt(2 / math.pi) * SIGMAS * math.exp(-(SIGMAS**2) / 2)
"""Of a Gaussian in three dimensions, within 2 sigma: chi-squared of three degrees of freedom at 4, 0.739."""
RADIUS_MAX_M = 60.0  # of an ellipsoid: before the first fix nothing is known, and the page would be inside of it
SPIN = np.array([-1.0, 1.0, -1.0, 1.0])  # against the drag torque of each rotor, as zsim.vehicles.vehicle.cross_layout
SHAPED = frozenset({"assembling", "engaged", "held"})  # phases in which a formation has somewhere to be
INTO = 0.25  # of the way from a corner to the opposite side; there its angle is written, clear of names and sides
SIDES = {"p": (0, 1), "q": (0, 2)}  # robots at their ends; docs/conventions.md


class Drones(NamedTuple):
    """N drones at one instant, those of a run in its order."""

    t_ns: int
    names: tuple[str, ...]
    p_W: Array  # (N, 3) m; NaN of a drone of which nothing is said
    q_WB: Array  # (N, 4)
    rotor: Array  # (N, 4) rad/s
    wind_W: Array  # (3,) m/s, the mean over the drones

    @property
    def there(self) -> NDArray[np.bool_]:
        """Return which drones are there, (N,)."""
        return np.isfinite(self.p_W[:, 0])


class Balls(NamedTuple):
    """Ellipsoids: centres, attitudes and half axes."""

    p_W: Array  # (M, 3) m
    wxyz: Array  # (M, 4)
    half_m: Array  # (M, 3)


class Side(NamedTuple):
    """A side of a formation's triangle, or of its pair."""

    name: str
    ends_W: Array  # (2, 3) m


class Shape(NamedTuple):
    """A formation as it truly stands."""

    c: Array  # (4n,)
    p_c: Array  # (3,) m, its origin in W
    q_WC: Array  # (4,)
    sides: tuple[Side, ...]
    corner: tuple[Array, str] | None  # where beta is written


def drones_of(view: ViewDrones, names: Sequence[str]) -> Drones:
    """Return a view as arrays of the drones of those names, which may not all be in it: a replay has some alone."""
    count = len(names)
    p_W, q_WB, rotor = np.full((count, 3), np.nan), np.tile((1.0, 0.0, 0.0, 0.0), (count, 1)), np.zeros((count, 4))
    places = {name: i for i, name in enumerate(names)}
    for drone in view.drones:
        i = places.get(drone.name)
        if i is not None:
            p_W[i], q_WB[i], rotor[i] = drone.position_m, drone.orientation_wxyz, drone.rotor_rad_s[:4]
    wind = np.mean(view.wind_m_s, axis=0) if view.wind_m_s else np.zeros(3)
    return Drones(view.t_ns, tuple(names), p_W, q_WB, rotor, wind)


def turned(angles: Array, rotor: Array, dt_s: float) -> Array:
    """Return the angles (N, 4) [rad] to which rotors are drawn dt_s later: slowed down, so that eyes can follow."""
    return (angles + SPIN * rotor * (dt_s / SLOWED)) % math.tau


def rotor_poses(drones: Drones, hubs_B: Array, angles: Array) -> tuple[Array, Array]:
    """Return centres (4N, 3) and quaternions (4N, 4) of the rotors.

    Args:
        drones: N of them.
        hubs_B: (4, 3) m.
        angles: (N, 4) rad.
    """
    R_WB = frames.rotation_matrix(drones.q_WB)
    p = drones.p_W[:, None] + np.einsum("nij,kj->nki", R_WB, hubs_B)
    w, x, y, z = (part[:, None] for part in drones.q_WB.T)
    c, s = np.cos(angles / 2), np.sin(angles / 2)
    q = np.stack((w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s), axis=-1)
    return p.reshape(-1, 3), q.reshape(-1, 4)


def ellipsoids(estimates: Sequence[EstimateView]) -> Balls:
    """Return where estimates believe their drones to be: ellipsoids of 2 sigma."""
    p = np.array([estimate.position_m for estimate in estimates]).reshape(-1, 3)
    P = np.array([estimate.covariance_m2 for estimate in estimates]).reshape(-1, 6)
    sigma_m, q = frames.principal_axes(P[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]])
    return Balls(p, q, np.clip(SIGMAS * sigma_m, 0.01, RADIUS_MAX_M))


def ghosts(space: ClusterSpace, view: ViewCluster) -> tuple[Array, Array] | None:
    """Return positions (n, 3) and quaternions (n, 4) of the robots as the formation is to stand, None without one."""
    if view.phase not in SHAPED:
        return None
    try:
        p_W, yaw = space.inverse(np.array(view.desired))
    except SingularClusterError:
        return None
    return p_W, frames.quaternion_from_heading(yaw)


def shape(space: ClusterSpace, p_W: Array, yaw: Array) -> Shape | None:
    """Return the formation of robots at p_W (n, 3) with headings yaw (n,), None where it has no frame."""
    try:
        c = space.forward(p_W, yaw)
    except SingularClusterError:
        return None
    roll, pitch, turn = (c[space.index(name)] if name in space.names else 0.0 for name in ("roll", "pitch", "yaw"))
    of_groups = any("." in name for name in space.names)  # p and q are then between groups
    known = [name for name in SIDES if name in space.names and not of_groups]
    sides = [Side(f"{name} {c[space.index(name)]:.2f} m", p_W[list(SIDES[name])]) for name in known]
    corner = None
    if "beta" in space.names and len(known) == 2:
        sides.append(Side("", p_W[[1, 2]]))
        corner = (p_W[0] + INTO * (p_W[1:].mean(axis=0) - p_W[0]), f"β {math.degrees(c[space.index('beta')]):.1f}°")
    return Shape(c, c[:3], frames.quaternion_from_rpy((roll, pitch, turn)), tuple(sides), corner)
