"""Cluster space: a formation of n robots described as one articulated body.

Robot space is r = (x_i, y_i, z_i, theta_i), i = 1..n, positions in W [m], headings about z of W [rad];
cluster space c holds as many variables: where the formation is, how it is turned, how each robot is turned
against it, and its shape. Velocities are related by c_dot = J(r) r_dot (Mas, Curi, Sanchez Pena, eqs. 1, 2).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zsim.errors import UserCodeError
from zsim.math.compiled import portable
from zsim.math.rotation import Matrix, Vector, add, cross, matrix_from_rpy, norm
from zsim.schema import plugin
from zsim.schema.checker import show

Array = NDArray[np.float64]

TAU = 2 * math.pi
CONDITION_LENGTH_M = 4.0  # p and q of the paper's formation, equation (3)
NAMES_SHOWN = 20  # in a message; the paper's cluster has 12


class SingularClusterError(ValueError):
    """The formation is so degenerate that its cluster frame does not exist."""


class ClusterSpace(ABC):
    """One convention of cluster variables for n robots; every method is a pure function.

    A space of one's own is a subclass with `forward`, `inverse`, `jacobian`, `inverse_jacobian` and `spread`, of which
    a scenario names the class; it is made by `for_places`.

    Args:
        n: number of robots.
        names: of the variables, 4 n, pitch among them. The beginning of a name gives its kind: p, q, rho are
            lengths, w departures in metres, roll, yaw, phi, azimuth angles that wrap, pitch, beta, elevation angles
            that do not.
        spread_text: what `spread` measures, in words for messages.

    Raises:
        ValueError: other names.

    Attributes:
        n: number of robots.
        size: number of cluster variables, 4 n.
        names: their names in the order of c; lengths in metres, angles in radians.
        angular: (4n,) bool, true for the angles that wrap (roll, yaw, phi_i, azimuth_k).
        in_radians: (4n,) bool, true for all angles, also those that do not wrap (pitch, beta, elevation_k).
        period: (4n,) of the angles that wrap, 2 pi, and 0 for all else.
        bounds: (4n, 2) open bounds of the values that `forward` can give, infinite where there is none.
        neutral: (4n,) bool, true for the variables that are zero in a formation that has no other goal: tilts,
            headings against the formation, departures from a template.
        tilts: places of roll and pitch in c.
        spread_text: what `spread` measures, in words for messages.
    """

    def __init__(self, n: int, names: Sequence[str], spread_text: str) -> None:
        self.n = n
        self.size = 4 * n
        self.names = tuple(names)
        if len(self.names) != self.size or "pitch" not in self.names:
            names_text = f"{len(self.names)} variables of {n} robots: {_listed(self.names)}"
            raise ValueError(f"{type(self).__name__} has {names_text}; must have {self.size}, pitch among them")
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
        """Return the space of as many robots as there are places (n, 3) [m]; here cls(n), what a scenario names.

        Args:
            places_m: the cluster's `template_m`, else where its robots start; x ahead, y left of the formation.
        """
        return cls(len(places_m))  # type: ignore[call-arg]

    @abstractmethod
    def forward(self, p_W: Array, yaw: Array) -> Array:
        """Return c (4n,) of robots at p_W (n, 3) [m] with headings yaw (n,) [rad].

        Raises:
            SingularClusterError: robots coincide or stand in line, so that there is no frame.
        """

    @abstractmethod
    def inverse(self, c: Array) -> tuple[Array, Array]:
        """Return positions p_W (n, 3) [m] and headings yaw (n,) [rad, wrapped] of the robots of c (4n,).

        Raises:
            SingularClusterError: the shape has no extent (h = 0), so that robots have no place.
        """

    @abstractmethod
    def jacobian(self, p_W: Array, yaw: Array) -> Array:
        """Return J (4n, 4n) with c_dot = J r_dot; r_dot ordered (vx, vy, vz, yaw rate) robot by robot, W.

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
        """Return the smallest height of the shape [m] (see `spread_text`); 0 where the shape is singular."""

    def motion(self, c: Array, c_dot: Array) -> Array:
        """Return r_dot (4n,) = J^-1 c_dot; spaces whose J^-1 is large have a shorter way than through the matrix."""
        return self.inverse_jacobian(c).dot(c_dot)  # the same bits as @, in half of its time at so small a size

    def specimen(self, apart_m: float) -> Array:
        """Return c (4n,) of some formation with robots at least so far apart, level, to try code on."""
        radius_m = self.n * apart_m
        turns = np.arange(self.n) * (TAU / self.n)
        p_W = radius_m * np.column_stack((np.cos(turns), np.sin(turns), np.ones(self.n)))
        return self.forward(p_W, np.zeros(self.n))

    def margin(self, c: Array) -> float:
        """Return the distance to singularity [m]: spread(c) cos(pitch).

        It is zero exactly where J^-1 is singular (robots 1, 2, 3 in line or two of them in one place, a
        further robot on the z axis through robot 1, or pitch at 90 degrees), and a length: how far one
        robot may move before a level formation becomes singular.
        """
        return self.measures(c)[1]

    def measures(self, c: Array) -> tuple[float, float]:
        """Return spread and margin [m]."""
        spread = self.spread(c)
        return spread, spread * math.cos(c[self._pitch])

    def condition(self, c: Array) -> float:
        """Return the condition number of J^-1 (2-norm, metres and radians as they are).

        It grows with the unit of length, so a formation larger than 4 m is judged scaled down to 4 m: a
        large formation is not nearer to singularity than a small one of the same shape.
        """
        lengths = np.abs(c[self._lengths])
        scaled = c.copy()
        scaled[self._lengths] *= min(1.0, CONDITION_LENGTH_M / max(float(lengths.max()), CONDITION_LENGTH_M))
        return float(np.linalg.cond(self.inverse_jacobian(scaled)))

    def difference(self, c_to: Array, c_from: Array) -> Array:
        """Return c_to - c_from (4n,), angles that wrap the short way."""
        return self.wrapped(c_to - c_from)

    def wrapped(self, c: Array) -> Array:
        """Return c (4n,), or a table (m, 4n) of them, with the angles that wrap taken to [-pi, pi]."""
        if c.ndim > 1:
            return c - self.period * np.rint(c / TAU)
        near = np.empty(self.size)
        put_wrapped(c, self.period, near)
        return near

    def index(self, name: str) -> int:
        """Return the place of a variable in c.

        Raises:
            ValueError: there is no such variable.
        """
        if name not in self.names:
            raise ValueError(f"variable {name[:40]!r} is unknown; allowed: {_listed(self.names)}")
        return self.names.index(name)


def checked(space: ClusterSpace) -> ClusterSpace:
    """Let a space of a user's own refuse, in every method, what is no finite number of the right shape.

    Its methods then raise UserCodeError, which names class, method and value.
    """
    n, size = space.n, space.size
    shapes: dict[str, tuple[tuple[int, ...], ...]] = {
        "forward": ((size,),),
        "inverse": ((n, 3), (n,)),
        "jacobian": ((size, size),),
        "inverse_jacobian": ((size, size),),
        "spread": ((),),
        "motion": ((size,),),
    }
    for method, wanted in shapes.items():
        setattr(space, method, _Checked(getattr(space, method), f"{plugin.full_name(type(space))}.{method}", wanted))
    return space


class _Checked:
    """A method of a user's space, with the shapes of what it returns."""

    def __init__(self, method: Callable[..., Any], name: str, shapes: tuple[tuple[int, ...], ...]) -> None:
        self._method = method
        self._name = name
        self._shapes = shapes

    def __call__(self, *arguments: Any) -> Any:
        returned = self._method(*arguments)
        try:
            parts = tuple(returned) if len(self._shapes) > 1 else (returned,)
            arrays = [plugin.numbers(part) for part in parts]
        except (TypeError, ValueError):
            arrays = []
        if [array.shape for array in arrays] != list(self._shapes):
            found = " and ".join(f"shape {array.shape}" for array in arrays) or show(returned)
            allowed = " and ".join(map(str, self._shapes)) if self._shapes != ((),) else "a number"
            raise UserCodeError(f"{self._name} returns {found}; must be {allowed}")
        for array in arrays:
            if not np.isfinite(array).all() and all(np.isfinite(argument).all() for argument in arguments):
                place = np.argwhere(~np.isfinite(array))[0].tolist()
                at = f" at {place}" if place else ""
                raise UserCodeError(f"{self._name} returns {array[tuple(place)]}{at}; must be finite")
        return tuple(arrays) if len(arrays) > 1 else arrays[0] if arrays[0].ndim else float(arrays[0])


def robot_rates(space: ClusterSpace, c: Array, c_dot: Array) -> tuple[Array, Array]:
    """Return velocities (n, 3) [m/s, W] and yaw rates (n,) [rad/s] of the robots of c moving at c_dot."""
    r_dot = space.motion(c, c_dot).reshape(space.n, 4)
    return r_dot[:, :3].copy(), r_dot[:, 3].copy()


@portable
def put_wrapped(c: Array, period: Array, near: Array) -> None:
    """Write c with each variable taken to half a period about zero; period is 2 pi or, for none, 0."""
    for k in range(c.size):
        near[k] = c[k] - period[k] * np.rint(c[k] / TAU)


@portable
def closest_pair(p_W: Array) -> tuple[float, int, int]:
    """Return the least distance [m] between two of the positions (n, 3), and the indices of that pair."""
    least, first, second = math.inf, 0, 1
    for i in range(p_W.shape[0]):
        for j in range(i + 1, p_W.shape[0]):
            x, y, z = p_W[j, 0] - p_W[i, 0], p_W[j, 1] - p_W[i, 1], p_W[j, 2] - p_W[i, 2]
            distance = math.sqrt(x * x + y * y + z * z)
            if distance < least:
                least, first, second = distance, i, j
    return least, first, second


def numbered(stem: str, robots: Iterable[int]) -> list[str]:
    """Return the names of a variable that every robot has, robots counted from 1."""
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
    """Return a name without its group and its number: phi for left.phi_2."""
    return name.rpartition(".")[2].rstrip("0123456789").rstrip("_")


def _listed(names: Sequence[str]) -> str:
    """Return names for a line of text, of many the first and the last."""
    if len(names) <= NAMES_SHOWN:
        return ", ".join(names)
    return ", ".join((*names[: NAMES_SHOWN - 1], f"… {names[-1]}")) + f" ({len(names)})"


LENGTH_MIN_M = 1e-9  # a nanometre: below it a direction is rounding noise


@portable
def wrap_angle(angle: float) -> float:
    """Return the angle taken to [-pi, pi]."""
    return angle - TAU * np.rint(angle / TAU)


@portable
def row(table: Array, i: int) -> Vector:
    """Return row i of a table (n, 3)."""
    return float(table[i, 0]), float(table[i, 1]), float(table[i, 2])


@portable
def put(J: Array, first: int, column: int, v: Vector) -> None:
    """Write v into a column of J, from row first on."""
    J[first, column], J[first + 1, column], J[first + 2, column] = v


@portable
def centroid(p_W: Array) -> Vector:
    """Return the mean of positions (n, 3)."""
    n = p_W.shape[0]
    x, y, z = row(p_W, 0)
    for i in range(1, n):
        a = row(p_W, i)
        x, y, z = x + a[0], y + a[1], z + a[2]
    return x / n, y / n, z / n


@portable
def pitch_yaw(x_W: Vector) -> tuple[float, float]:
    """Return pitch and yaw of a frame from its x axis in W."""
    flat = math.sqrt(x_W[0] * x_W[0] + x_W[1] * x_W[1])
    return math.atan2(-x_W[2], flat), math.atan2(x_W[1], x_W[0])


@portable
def euler_axes_C(roll: float, pitch: float) -> Matrix:
    """Return w_WC_C of a unit rate of roll, of pitch and of yaw."""
    sr, cr = math.sin(roll), math.cos(roll)
    sp, cp = math.sin(pitch), math.cos(pitch)
    return (1.0, 0.0, 0.0), (0.0, cr, -sr), (-sp, sr * cp, cr * cp)


def euler_rates(roll: float, pitch: float) -> Array:
    """Return T (3, 3) with (roll', pitch', yaw') = T w_WC_C.

    Raises:
        SingularClusterError: pitch is at 90 degrees.
    """
    sr, cr = math.sin(roll), math.cos(roll)
    sp, cp = math.sin(pitch), math.cos(pitch)
    if cp < LENGTH_MIN_M:
        raise SingularClusterError("pitch is 90 deg: roll and yaw of the formation are one rotation there")
    return np.array([(1.0, sr * sp / cp, cr * sp / cp), (0.0, cr, -sr), (0.0, sr / cp, cr / cp)])


@portable
def triad_axes(d2: Vector, d3: Vector) -> tuple[Vector, Vector, Vector, float, float]:
    """Return the axes x, y, z of C in W, h = |d2 + d3| [m] and the area |d2 x d3| [m^2].

    x_C points from the middle of robots 2 and 3 to robot 1, z_C along d2 x d3; robot 2 is on the left.
    All is zero where the three robots are in line or in one place.

    Args:
        d2, d3: P2 - P1 and P3 - P1, both in W [m].
    """
    m = add(d2, d3)
    normal = cross(d2, d3)
    h, area = norm(m), norm(normal)
    if not (h > LENGTH_MIN_M and area > LENGTH_MIN_M * h):  # also true for NaN
        none = (0.0, 0.0, 0.0)
        return none, none, none, 0.0, 0.0
    x = (-m[0] / h, -m[1] / h, -m[2] / h)
    z = (normal[0] / area, normal[1] / area, normal[2] / area)
    return x, cross(z, x), z, h, area


@portable
def inertia(S: Array) -> Array:
    """Return tr(S) I - S (3, 3)."""
    M = np.empty((3, 3))
    trace = S[0, 0] + S[1, 1] + S[2, 2]
    for i in range(3):
        for j in range(3):
            M[i, j] = (trace if i == j else 0.0) - S[i, j]
    return M


@portable
def skew(a: Array) -> Array:
    """Return the matrix (3, 3) of a x ."""
    A = np.zeros((3, 3))
    A[0, 1], A[0, 2] = -a[2], a[1]
    A[1, 0], A[1, 2] = a[2], -a[0]
    A[2, 0], A[2, 1] = -a[1], a[0]
    return A


def euler_angles(R_WC: Array) -> tuple[float, float, float]:
    """Return roll, pitch and yaw of R_WC = Rz(yaw) Ry(pitch) Rx(roll)."""
    pitch, yaw = pitch_yaw((R_WC[0, 0], R_WC[1, 0], R_WC[2, 0]))
    return math.atan2(R_WC[2, 1], R_WC[2, 2]), pitch, yaw


@portable
def array_of(R: Matrix) -> Array:
    """Return a matrix as an array (3, 3)."""
    rows = np.empty((3, 3))
    for i in range(3):
        rows[i, 0], rows[i, 1], rows[i, 2] = R[i]
    return rows


@portable
def rotation_of(c: Array) -> Array:
    """Return R_WC (3, 3) of a cluster (4n,) with roll, pitch and yaw at 3, 4 and 5."""
    return array_of(matrix_from_rpy(c[3], c[4], c[5]))


@portable
def euler_axes_of(c: Array) -> Array:
    """Return w_WC_C of a unit rate of roll, of pitch and of yaw, row by row (3, 3)."""
    return array_of(euler_axes_C(c[3], c[4]))
