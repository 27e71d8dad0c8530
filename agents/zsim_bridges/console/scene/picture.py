"""The picture of a run as arrays: poses, ellipsoids, formations and trails, from the newest views. Pure.

Axes, units and quaternions as everywhere: W east, north, up; quaternions w first, body to world.
"""

import math
from bisect import bisect_left
from collections.abc import Sequence
from itertools import takewhile
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.contract.flight_messages import EstimateView, ViewCluster, ViewDrones
from zsim.math import frames
from zsim.vehicles.vehicle import ROTORS_MAX
from zsim_agents.formation.spaces.cluster_space import ClusterSpace, SingularClusterError

Array = NDArray[np.float64]

ROTOR_SLOWDOWN = 50.0  # of the rotors' speed: at 10 pictures/s the fastest turn by 57 degrees, so not seen as backwards
SIGMAS = 2.0  # of an ellipsoid
SHARE_WITHIN = 1 - math.erfc(SIGMAS / math.sqrt(2)) - math.sqrt(2 / math.pi) * SIGMAS * math.exp(-(SIGMAS**2) / 2)
"""Of a Gaussian in three dimensions, within 2 sigma: chi-squared of three degrees of freedom at 4, 0.739."""
RADIUS_MAX_M = 60.0  # of an ellipsoid: before the first fix nothing is known, and the page would be inside of it
SHAPED_PHASES = frozenset({"assembling", "engaged", "held"})  # phases in which a formation has somewhere to be
CORNER_SHARE = (
    0.25  # of the way from a corner to the opposite side; there its angle is written, clear of names and sides
)
CLICK_RAD = 0.012  # half the angle in which a click on a small, far drone is one on it; chosen: about five pixels
SIDES = {"p": (0, 1), "q": (0, 2)}  # robots at their ends; docs/conventions.md


class DronePoses(NamedTuple):
    """N drones at one instant, those of a run in its order."""

    t_ns: int
    names: tuple[str, ...]
    p_W: Array  # (N, 3) m; NaN of a drone that is not in the view
    q_WB: Array  # (N, 4)
    rotor: Array  # (N, ROTORS_MAX) rad/s; 0 where a drone has fewer
    wind_W: Array  # (3,) m/s, the mean over the drones

    @property
    def present(self) -> NDArray[np.bool_]:
        """Return which drones are in the view, (N,)."""
        return np.isfinite(self.p_W[:, 0])


class Ellipsoids(NamedTuple):
    """Ellipsoids: centres, attitudes and half axes."""

    p_W: Array  # (M, 3) m
    wxyz: Array  # (M, 4)
    half_m: Array  # (M, 3)


class FormationSide(NamedTuple):
    """A side of a formation's triangle, or of its pair."""

    name: str
    ends_W: Array  # (2, 3) m


class FormationShape(NamedTuple):
    """A formation's true shape."""

    c: Array  # (4n,)
    p_c: Array  # (3,) m, its origin in W
    q_WC: Array  # (4,)
    sides: tuple[FormationSide, ...]
    corner: tuple[Array, str] | None  # where beta is written


def drone_poses(view: ViewDrones, names: Sequence[str]) -> DronePoses:
    """Return a view as arrays of the drones of those names, which may not all be in it: a replay has some alone."""
    count = len(names)
    p_W, q_WB = np.full((count, 3), np.nan), np.tile((1.0, 0.0, 0.0, 0.0), (count, 1))
    rotor = np.zeros((count, ROTORS_MAX))
    indices = {name: i for i, name in enumerate(names)}
    for drone in view.drones:
        i = indices.get(drone.name)
        if i is not None:
            p_W[i], q_WB[i] = drone.position_m, drone.orientation_wxyz
            rotor[i, : len(drone.rotor_rad_s)] = drone.rotor_rad_s
    wind = np.mean(view.wind_m_s, axis=0) if view.wind_m_s else np.zeros(3)
    return DronePoses(view.t_ns, tuple(names), p_W, q_WB, rotor, wind)


def drone_on_ray(
    drones: DronePoses, radii_m: Array, origin_W: Sequence[float], direction_W: Sequence[float]
) -> str | None:
    """Return the drone that a ray hits, of several that whose centre is nearest to it; None where it hits none.

    Args:
        drones: N of them.
        radii_m: (N,), of the balls around them that count as hit; of one far away, its ball is not below CLICK_RAD.
        origin_W, direction_W: of the ray [m; W]; a direction without length hits nothing.
    """
    direction = np.array(direction_W)
    length = float(np.linalg.norm(direction))
    if not 0.0 < length < math.inf:
        return None
    away = drones.p_W - np.array(origin_W)
    ahead_m = away @ (direction / length)
    distances_m = np.linalg.norm(away - ahead_m[:, None] * (direction / length), axis=1)
    hit = (ahead_m > 0.0) & (distances_m <= np.maximum(radii_m, CLICK_RAD * ahead_m))
    return drones.names[int(np.argmin(np.where(hit, distances_m, math.inf)))] if hit.any() else None


def short_names(names: Sequence[str]) -> list[str]:
    """Return what tells names apart: without the letters with which all begin; in full where one would be empty."""
    alike = takewhile(lambda column: len(set(column)) == 1 and not column[0].isdigit(), zip(*names, strict=False))
    stem = len(list(alike))
    short = [name[stem:] for name in names]
    return short if all(short) else list(names)


def rotor_angles(angles: Array, speeds: Array, turns: Array, dt_s: float) -> Array:
    """Return the angles [rad] to which rotors are drawn dt_s later: slowed down to be visible.

    Args:
        angles, speeds: (M,) rad, rad/s; turns: (M,), 1 of a rotor that turns clockwise seen from above, else -1.
    """
    return (angles - turns * speeds * (dt_s / ROTOR_SLOWDOWN)) % math.tau


def rotor_poses(p_W: Array, q_WB: Array, hubs_B: Array, angles: Array) -> tuple[Array, Array]:
    """Return centres (M, 3) [m] and quaternions (M, 4) of M rotors.

    Args:
        p_W, q_WB: of the drone of each, (M, 3) m and (M, 4).
        hubs_B: (M, 3) m.
        angles: (M,) rad.
    """
    p = p_W + np.einsum("mij,mj->mi", frames.rotation_matrix(q_WB), hubs_B)
    w, x, y, z = q_WB.T
    c, s = np.cos(angles / 2), np.sin(angles / 2)
    return p, np.column_stack((w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s))


def ellipsoids(estimates: Sequence[EstimateView]) -> Ellipsoids:
    """Return the ellipsoids of 2 sigma of estimates of position."""
    p = np.array([estimate.position_m for estimate in estimates]).reshape(-1, 3)
    P = np.array([estimate.covariance_m2 for estimate in estimates]).reshape(-1, 6)
    sigma_m, q = frames.principal_axes(P[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]])
    return Ellipsoids(p, q, np.clip(SIGMAS * sigma_m, 0.01, RADIUS_MAX_M))


def ghosts(space: ClusterSpace, view: ViewCluster) -> tuple[Array, Array] | None:
    """Return positions (n, 3) and quaternions (n, 4) of the robots as the formation is to stand, None without one."""
    if view.phase not in SHAPED_PHASES:
        return None
    try:
        p_W, yaw = space.inverse(np.array(view.desired))
    except SingularClusterError:
        return None
    return p_W, frames.quaternion_from_heading(yaw)


def formation_shape(space: ClusterSpace, p_W: Array, yaw: Array) -> FormationShape | None:
    """Return the formation of robots at p_W (n, 3) with headings yaw (n,), None where it has no frame."""
    try:
        c = space.forward(p_W, yaw)
    except SingularClusterError:
        return None
    roll, pitch, turn = (c[space.index(name)] if name in space.names else 0.0 for name in ("roll", "pitch", "yaw"))
    of_groups = any("." in name for name in space.names)  # p and q are then between groups
    known = [name for name in SIDES if name in space.names and not of_groups]
    sides = [FormationSide(f"{name} {c[space.index(name)]:.2f} m", p_W[list(SIDES[name])]) for name in known]
    corner = None
    if "beta" in space.names and len(known) == 2:
        sides.append(FormationSide("", p_W[[1, 2]]))
        corner = (
            p_W[0] + CORNER_SHARE * (p_W[1:].mean(axis=0) - p_W[0]),
            f"β {math.degrees(c[space.index('beta')]):.1f}°",
        )
    return FormationShape(c, c[:3], frames.quaternion_from_rpy((roll, pitch, turn)), tuple(sides), corner)


TRAIL_POINTS_MAX = 6_000  # of all trails together: 144 kB for a browser each time
TRAIL_MAX_S = 180.0  # simulated; as far as curves go back
TRAILS_S = (10.0, 30.0, 60.0, TRAIL_MAX_S)  # lengths among which one chooses
TRAIL_S = 60.0  # of those, the one that is chosen at first
SPACING_M = 0.08  # of two points: a sixth of a hull
SPACING_S = 0.05  # simulated, and of two points in time: as often as pictures come at 1 × real time
RECORD_GAP_S = 5.0  # simulated; between two points of a record farther apart it was not read yet, so nothing is drawn
STILL_M = 1e-3  # of a segment: a drone that stands leaves no trail


class CanvasTrails:
    """The trails of N drones: where each was within the last seconds.

    Args:
        count: how many drones.
        around: whether points of any time are kept, in whatever order they come, as of a record.

    Attributes:
        length_s: how far trails go back, simulated.
        number: another one where trails are not those of before and what was added since.
    """

    def __init__(self, count: int, around: bool = False) -> None:
        self._count = count
        self._around = around
        self._times: list[float] = []
        self._rows: list[NDArray[np.float32]] = []
        self.length_s = TRAIL_S
        self.number = 0

    def add(self, t_s: float, p_W: Array) -> bool:
        """Add positions (N, 3) [m] of an instant, NaN of a drone that is not in the view; return whether they were.

        Those of a flight are left out while no drone has moved on, and go on in time: before the last ones all begins
        anew.
        """
        if not self._around and self._times and t_s < self._times[-1]:
            self.clear()
        place = bisect_left(self._times, t_s)
        near = self._times[max(0, place - 1) : place + 1]
        if any(abs(other_s - t_s) < SPACING_S * 0.99 for other_s in near):
            return False
        if not self._around and self._rows:
            away_m = np.linalg.norm(p_W - self._rows[-1], axis=1)
            appears = np.isfinite(p_W[:, 0]) & ~np.isfinite(self._rows[-1][:, 0])
            if not (appears | (away_m >= SPACING_M)).any():
                return False
        self._times.insert(place, t_s)
        self._rows.insert(place, p_W.astype(np.float32))
        if not self._around:
            self.keep(t_s - TRAIL_MAX_S, math.inf)
        return True

    def keep(self, from_s: float, to_s: float) -> None:
        """Remove the points of other times."""
        old, late = bisect_left(self._times, from_s), bisect_left(self._times, to_s)
        del self._times[late:], self._rows[late:], self._times[:old], self._rows[:old]

    def choose_length(self, length_s: float) -> None:
        """Let trails go back so far [s, simulated]."""
        self.length_s = length_s
        self.number += 1

    def segments(self, t_s: float, p_W: Array) -> tuple[Array, NDArray[np.int64], Array]:
        """Return segments (M, 2, 3) up to where the drones are now, (N, 3), of which drone, (M,), and since when, (M,).

        Of many points those of evenly spaced times are taken.
        """
        begin, end = bisect_left(self._times, t_s - self.length_s), bisect_left(self._times, t_s)
        times = np.array(self._times[begin:end])
        rows = np.arange(len(times))
        if len(times) * self._count > TRAIL_POINTS_MAX:
            # A step that hardly ever changes, and points that stay the same: else trails would tremble.
            step_s = 2.0 ** math.ceil(math.log2((times[-1] - times[0]) * self._count / TRAIL_POINTS_MAX))
            rows = np.flatnonzero(np.diff(np.floor(times / step_s), prepend=-math.inf))
        times = np.append(times[rows], t_s)
        way = np.stack([*(self._rows[begin + k] for k in rows), p_W]).astype(float)
        lines = np.stack((way[:-1], way[1:]), axis=2).transpose(1, 0, 2, 3)  # drone, instant, end, axis
        drawn = np.linalg.norm(lines[:, :, 1] - lines[:, :, 0], axis=2) > STILL_M  # not of NaN
        drawn &= np.isfinite(p_W[:, :1])
        drawn &= (np.diff(times) < RECORD_GAP_S) | (not self._around)
        owners, instants = np.nonzero(drawn)
        return lines[drawn], owners, times[instants]

    def clear(self) -> None:
        """Remove all points."""
        self._times.clear()
        self._rows.clear()
        self.number += 1
