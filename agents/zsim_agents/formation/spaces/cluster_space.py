"""Cluster space: a formation of n robots described as one articulated body.

Robot space is r = (x_i, y_i, z_i, theta_i), i = 1..n, positions in W [m], headings about z of W [rad]. Cluster space c
has as many variables: position and attitude of the formation, the relative heading of each robot, and the shape.
Velocities are related by c_dot = J(r) r_dot (Mas, Curi, Sanchez Pena, eqs. 1, 2).

The functions for the cluster frame C, with Z-Y-X Euler angles, are compiled, because a gate must take only
microseconds.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zsim.errors import UserCodeError
from zsim.math import elementary as el
from zsim.math import linear
from zsim.math.compiled import portable
from zsim.math.rotation import Matrix, Vector
from zsim.schema import plugin
from zsim.schema.checker import show

Array = NDArray[np.float64]

TAU = 2 * math.pi
CONDITION_LENGTH_M = 4.0  # p and q of the paper's formation, equation (3)
NAMES_SHOWN = 20  # maximum number of names in a message; the paper's cluster has 12
LENGTH_MIN_M = 1e-9  # a nanometre: below it, a direction is rounding noise


class SingularClusterError(ValueError):
    """The formation is degenerate and has no cluster frame."""


class ClusterSpace(ABC):
    """One convention of cluster variables for n robots; every method is a pure function.

    A user's space is a subclass with `forward`, `inverse`, `jacobian`, `inverse_jacobian` and `spread`, which the
    scenario names and `for_places` constructs.

    Args:
        names: names of the 4n variables, which include pitch. The beginning of a name gives the variable's kind: p, q
            and rho are lengths; w is a departure from a template [m]; roll, yaw, phi and azimuth are angles that wrap;
            pitch, beta and elevation are angles that do not.
        spread_text: the quantity that `spread` measures, in words for messages.

    Attributes:
        size: number of cluster variables, 4n.
        angular: (4n,) bool, true for the angles that wrap (roll, yaw, phi_i, azimuth_k).
        in_radians: (4n,) bool, true for all angles, including those that do not wrap (pitch, beta, elevation_k).
        period: (4n,) 2 pi for the angles that wrap, 0 for all other variables.
        bounds: (4n, 2) open bounds of the values that `forward` can give, infinite where there is no bound.
        neutral: (4n,) bool, true for the variables whose goal is zero unless a request names them: tilts, relative
            headings, departures from a template.
        tilts: indices of roll and pitch in c.
    """

    def __init__(self, n: int, names: Sequence[str], spread_text: str) -> None:
        self.n = n
        self.size = 4 * n
        self.names = tuple(names)
        if len(self.names) != self.size or "pitch" not in self.names:
            found = f"{len(self.names)} variables of {n} robots: {_listed(self.names)}"
            raise ValueError(f"{type(self).__name__} has {found}; must have {self.size}, pitch among them")
        self.spread_text = spread_text
        stems = [_stem(name) for name in names]
        self.angular = np.array([stem in {"roll", "yaw", "phi", "azimuth"} for stem in stems])
        self.in_radians = self.angular | np.array([stem in _BOUNDED_ANGLES for stem in stems])
        self.neutral = np.array([stem in {"roll", "pitch", "phi", "w"} for stem in stems])
        self.period = np.where(self.angular, TAU, 0.0)
        self.bounds = np.array([_BOUNDS.get(stem, (-math.inf, math.inf)) for stem in stems])
        self.tilts = tuple(i for i, stem in enumerate(stems) if stem in {"roll", "pitch"})
        self._lengths = [i for i, stem in enumerate(stems) if stem in _LENGTHS]
        self._pitch = self.names.index("pitch")

    @classmethod
    def for_places(cls, places_m: Array) -> ClusterSpace:
        """Return the space of n robots with given positions, (n, 3) [m]; by default cls(n), which ignores them.

        Args:
            places_m: the cluster's `template_m`, otherwise the start positions; x ahead, y left of the formation.
        """
        return cls(len(places_m))  # type: ignore[call-arg]

    @abstractmethod
    def forward(self, p_W: Array, yaw: Array) -> Array:
        """Return c (4n,) of robots at p_W (n, 3) [m] with headings yaw (n,) [rad].

        Raises:
            SingularClusterError: robots coincide or are collinear, so that there is no frame.
        """

    @abstractmethod
    def inverse(self, c: Array) -> tuple[Array, Array]:
        """Return positions p_W (n, 3) [m] and headings yaw (n,) [rad, wrapped] of robots in the formation c (4n,).

        Raises:
            SingularClusterError: the shape has no direction, so that the robots' positions are undefined.
        """

    @abstractmethod
    def jacobian(self, p_W: Array, yaw: Array) -> Array:
        """Return J (4n, 4n) with c_dot = J r_dot; r_dot is (vx, vy, vz, yaw rate), robot by robot, in W.

        Raises:
            SingularClusterError: as in `forward`.
        """

    @abstractmethod
    def inverse_jacobian(self, c: Array) -> Array:
        """Return J^-1 (4n, 4n) with r_dot = J^-1 c_dot, in closed form.

        Raises:
            SingularClusterError: as in `inverse`.
        """

    @abstractmethod
    def spread(self, c: Array) -> float:
        """Return the smallest height of the shape [m] (see `spread_text`); 0 if the shape is singular."""

    def motion(self, c: Array, c_dot: Array) -> Array:
        """Return r_dot (4n,) = J^-1 c_dot; spaces with a large J^-1 override this to avoid the matrix."""
        return linear.product(self.inverse_jacobian(c), c_dot)

    def specimen(self, separation_m: float) -> Array:
        """Return c (4n,) of a level formation with robots at least a given distance apart, for rehearsals."""
        radius_m = self.n * separation_m
        angles = np.arange(self.n) * (TAU / self.n)
        x, y = (el.elementwise(function)(angles) for function in (el.cos, el.sin))
        p_W = radius_m * np.column_stack((x, y, np.ones(self.n)))
        return self.forward(p_W, np.zeros(self.n))

    def margin(self, c: Array) -> float:
        """Return the distance to singularity [m]: spread(c) cos(pitch).

        It is zero exactly where J^-1 is singular (for a TriadCluster: robots 1, 2, 3 collinear or two of them
        coincident, another robot on the z axis through robot 1, or pitch at 90 degrees); in a level formation, it is
        the distance by which one robot may move before J^-1 becomes singular.
        """
        return self.measures(c)[1]

    def measures(self, c: Array) -> tuple[float, float]:
        """Return spread(c) and margin(c) [m], computing the spread once."""
        spread = self.spread(c)
        return spread, spread * float(el.cos(c[self._pitch]))

    def condition(self, c: Array) -> float:
        """Return the condition number of J^-1 (2-norm, in metres and radians without weights).

        The number grows with the size of a formation, although a large formation is not closer to singularity than a
        small one of the same shape. A formation larger than 4 m is therefore scaled down to 4 m.
        """
        lengths = np.abs(c[self._lengths])
        scaled = c.copy()
        scaled[self._lengths] *= min(1.0, CONDITION_LENGTH_M / max(float(lengths.max()), CONDITION_LENGTH_M))
        values = linear.singular_values(self.inverse_jacobian(scaled))
        return float(values[0] / values[-1]) if values[-1] > 0.0 else math.inf

    def difference(self, c_to: Array, c_from: Array) -> Array:
        """Return c_to - c_from (4n,), taking the shorter way round for angles that wrap."""
        return self.wrapped(c_to - c_from)

    def wrapped(self, c: Array) -> Array:
        """Return c (4n,), or a table (m, 4n) of such rows, with the angles that wrap brought into [-pi, pi]."""
        if c.ndim > 1:
            return c - self.period * np.rint(c / TAU)
        wrapped_c = np.empty(self.size)
        put_wrapped(c, self.period, wrapped_c)
        return wrapped_c

    def index(self, name: str) -> int:
        """Return the index of a variable in c; ValueError: the name is unknown."""
        if name not in self.names:
            raise ValueError(f"variable {name[:40]!r} is unknown; allowed: {_listed(self.names)}")
        return self.names.index(name)


def checked(space: ClusterSpace) -> ClusterSpace:
    """Return a user's space, made to raise UserCodeError for results that have a wrong shape or are not finite."""
    n, size = space.n, space.size
    shapes: dict[str, tuple[tuple[int, ...], ...]] = {
        "forward": ((size,),),
        "inverse": ((n, 3), (n,)),
        "jacobian": ((size, size),),
        "inverse_jacobian": ((size, size),),
        "spread": ((),),
        "motion": ((size,),),
    }
    for method, expected in shapes.items():
        setattr(space, method, _checked(getattr(space, method), f"{plugin.full_name(type(space))}.{method}", expected))
    return space


def _checked(method: Callable[..., Any], name: str, shapes: tuple[tuple[int, ...], ...]) -> Callable[..., Any]:
    def call(*arguments: Any) -> Any:
        returned = method(*arguments)
        try:
            parts = tuple(returned) if len(shapes) > 1 else (returned,)
            arrays = [plugin.numbers(part) for part in parts]
        except (TypeError, ValueError):
            arrays = []
        if [array.shape for array in arrays] != list(shapes):
            found = " and ".join(f"shape {array.shape}" for array in arrays) or show(returned)
            allowed = " and ".join(map(str, shapes)) if shapes != ((),) else "a number"
            raise UserCodeError(f"{name} returns {found}; must be {allowed}")
        for array in arrays:
            if not np.isfinite(array).all() and all(np.isfinite(argument).all() for argument in arguments):
                index = np.argwhere(~np.isfinite(array))[0].tolist()
                position = f" at {index}" if index else ""
                raise UserCodeError(f"{name} returns {array[tuple(index)]}{position}; must be finite")
        return tuple(arrays) if len(arrays) > 1 else arrays[0] if arrays[0].ndim else float(arrays[0])

    return call


def robot_rates(space: ClusterSpace, c: Array, c_dot: Array) -> tuple[Array, Array]:
    """Return velocities (n, 3) [m/s, W] and yaw rates (n,) [rad/s] of the robots of a formation c moving at c_dot."""
    r_dot = space.motion(c, c_dot).reshape(space.n, 4)
    return r_dot[:, :3].copy(), r_dot[:, 3].copy()


@portable
def put_wrapped(c: Array, period: Array, out: Array) -> None:
    """Write c with each variable wrapped to within half a period of zero; a period of 0 means no wrapping."""
    for k in range(c.size):
        out[k] = c[k] - period[k] * np.rint(c[k] / TAU)


@portable
def closest_pair(p_W: Array) -> tuple[float, int, int]:
    """Return the minimum distance [m] between two of the positions (n, 3), and the indices of that pair."""
    min_distance, first, second = math.inf, 0, 1
    for i in range(p_W.shape[0]):
        for j in range(i + 1, p_W.shape[0]):
            x, y, z = p_W[j, 0] - p_W[i, 0], p_W[j, 1] - p_W[i, 1], p_W[j, 2] - p_W[i, 2]
            distance = math.sqrt(x * x + y * y + z * z)
            if distance < min_distance:
                min_distance, first, second = distance, i, j
    return min_distance, first, second


def numbered(stem: str, robots: Iterable[int]) -> list[str]:
    return [f"{stem}_{k}" for k in robots]


def unit(name: str) -> str:
    """Return the unit of a variable of any cluster space: m or rad."""
    return "m" if name in ("x_c", "y_c", "z_c") or _stem(name) in _LENGTHS | {"w"} else "rad"


_LENGTHS = {"p", "q", "rho"}
_BOUNDED_ANGLES = {"pitch", "beta", "elevation"}
_BOUNDS = {
    "pitch": (-math.pi / 2, math.pi / 2),
    "elevation": (-math.pi / 2, math.pi / 2),
    "beta": (0.0, math.pi),
    "p": (0.0, math.inf),
    "q": (0.0, math.inf),
    "rho": (0.0, math.inf),
}


def _stem(name: str) -> str:
    """Return a name without group and number, e.g. phi for left.phi_2."""
    return name.rpartition(".")[2].rstrip("0123456789").rstrip("_")


def _listed(names: Sequence[str]) -> str:
    if len(names) <= NAMES_SHOWN:
        return ", ".join(names)
    return ", ".join((*names[: NAMES_SHOWN - 1], f"… {names[-1]}")) + f" ({len(names)})"


@portable
def wrap_angle(angle: float) -> float:
    """Return the angle in [-pi, pi]."""
    return angle - TAU * np.rint(angle / TAU)


@portable
def row(table: Array, i: int) -> Vector:
    return float(table[i, 0]), float(table[i, 1]), float(table[i, 2])


@portable
def put(J: Array, first: int, column: int, v: Vector) -> None:
    J[first, column], J[first + 1, column], J[first + 2, column] = v


@portable
def centroid(p_W: Array) -> Vector:
    n = p_W.shape[0]
    x, y, z = row(p_W, 0)
    for i in range(1, n):
        a = row(p_W, i)
        x, y, z = x + a[0], y + a[1], z + a[2]
    return x / n, y / n, z / n


@portable
def pitch_yaw(x_W: Vector) -> tuple[float, float]:
    """Return pitch and yaw of a frame from its x axis in W."""
    horizontal = math.sqrt(x_W[0] * x_W[0] + x_W[1] * x_W[1])
    return el.atan2(-x_W[2], horizontal), el.atan2(x_W[1], x_W[0])


@portable
def euler_axes_C(roll: float, pitch: float) -> Matrix:
    """Return w_WC_C for unit rates of roll, pitch and yaw, one row each."""
    sr, cr = el.sin(roll), el.cos(roll)
    sp, cp = el.sin(pitch), el.cos(pitch)
    return (1.0, 0.0, 0.0), (0.0, cr, -sr), (-sp, sr * cp, cr * cp)


def euler_rates(roll: float, pitch: float) -> Array:
    """Return T (3, 3) with (roll', pitch', yaw') = T w_WC_C; SingularClusterError: pitch is 90 degrees."""
    sr, cr = el.sin(roll), el.cos(roll)
    sp, cp = el.sin(pitch), el.cos(pitch)
    if cp < LENGTH_MIN_M:
        raise SingularClusterError("pitch is 90 deg: roll and yaw of the formation are one rotation there")
    return np.array([(1.0, sr * sp / cp, cr * sp / cp), (0.0, cr, -sr), (0.0, sr / cp, cr / cp)])
