"""The cluster of many robots: a template that moves and rotates as a rigid body, and small deviations from it.

    P_i = C + R (t_i + (N w)_i)

C is the centroid, t_i the positions in the template, N a basis of the displacements that neither move nor rotate it,
w the coordinates in this basis, and R the best-fit rotation of the template to the robots. No robot is privileged, and
the motion of one robot changes the frame by only a fraction of about 1/n.

The best-fit attitude is that of Horn, Closed-form solution of absolute orientation using unit quaternions, J. Opt. Soc.
Am. A 4 (1987), section 4: the same rotation as Kabsch's (1976), but never a reflection. It serves as a formation's
frame in Belta, Kumar, Abstraction and control for groups of robots, IEEE Trans. Robotics 20 (2004).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from zsim.math import elementary as el
from zsim.math.compiled import portable
from zsim.math.linear import eigen, product, solve
from zsim.math.rotation import Matrix, matrix, matrix_from_rpy
from zsim_agents.formation.spaces.cluster_space import (
    CONDITION_LENGTH_M,
    LENGTH_MIN_M,
    TAU,
    Array,
    ClusterSpace,
    SingularClusterError,
    euler_axes_C,
    euler_rates,
    numbered,
    pitch_yaw,
    row,
)

INDEPENDENT_MIN = 1e-6  # minimum share of a direction outside the span of the previous ones; rounding leaves 1e-15
PLANES = ((0, 1), (0, 2), (1, 2))
NO_FRAME = "the robots are collinear or coincide, or are too far from the template: the formation has no frame"
HEADING, TURN, BEND = 6, slice(0, 3), slice(3, 6)  # indices in the 7 x 7 matrix of `condition`


class TemplateCluster(ClusterSpace):
    """c = (x_c, y_c, z_c, roll, pitch, yaw, phi_1..phi_n, w_1..w_{3n-6}); w in metres rms over the robots.

    w_1 is growth: robots move outwards, by w_1 in the root mean square. Then come the stretches and shears that the
    template's extent permits (`shape_modes`). The template is given as positions (n, 3), n >= 3, from any origin.

    Raises:
        ValueError: there are fewer than three positions, or all are collinear.

    Attributes:
        t_C: positions in the template relative to their centroid, (n, 3) [m; C].
        modes_C: the basis N, (n, 3, 3n - 6).
    """

    def __init__(self, places_m: ArrayLike) -> None:
        self.t_C = centred(places_m)
        n = len(self.t_C)
        if n < 3:
            raise ValueError(f"template: {n} positions; allowed: 3 or more")
        self.modes_C = shape_modes(self.t_C)
        self._modes = self.modes_C.reshape(3 * n, 3 * n - 6)
        self._modes_inverse = np.ascontiguousarray(self._modes.T) / n  # N^T / n, the inverse of N on its span
        self._inertia = inertia(product(self.t_C.T, self.t_C))
        self._reach_m = math.sqrt(n * float(eigen(self._inertia)[0][0]))
        names = ["x_c", "y_c", "z_c", "roll", "pitch", "yaw", *numbered("phi", range(1, n + 1))]
        spread_text = "root mean square distance of the robots from the line through them"
        super().__init__(n, [*names, *numbered("w", range(1, 3 * n - 5))], spread_text)
        self._shape = 6 + n  # index of w_1 in c

    @classmethod
    def for_places(cls, places_m: Array) -> TemplateCluster:
        return cls(places_m)

    def forward(self, p_W: Array, yaw: Array) -> Array:
        centre_W, b_C, R_WC = self._fit(p_W)
        c = np.empty(self.size)
        c[:3] = centre_W
        c[3:6] = euler_angles(R_WC)
        c[6 : self._shape] = yaw - c[5]
        c[6 : self._shape] -= TAU * np.rint(c[6 : self._shape] / TAU)
        c[self._shape :] = product(self._modes_inverse, (b_C - self.t_C).ravel())
        return c

    def inverse(self, c: Array) -> tuple[Array, Array]:
        yaw = c[5] + c[6 : self._shape]
        return c[:3] + product(self._points_C(c), rotation_of(c).T), yaw - TAU * np.rint(yaw / TAU)

    def jacobian(self, p_W: Array, yaw: Array) -> Array:
        """Return J, from w_WC_C = M^-1 sum of t_i x R^T v_i, M = tr(S) I - S, S = sum of b_i t_i^T.

        With b_i = R^T (P_i - C), this follows from sum of t_i x b_i = 0, the condition for R to be the best fit.
        """
        _, b_C, R_WC = self._fit(p_W)
        n = self.n
        arms = np.array([product(skew(t), R_WC.T) for t in self.t_C]).transpose(1, 0, 2)  # (3, n, 3), for t_i x R^T v_i
        turn = solve(inertia(product(b_C.T, self.t_C)), arms.reshape(3, 3 * n)).reshape(3, n, 3)
        roll, pitch, _ = euler_angles(R_WC)
        cross_C = np.array([skew(b) for b in b_C]).reshape(3 * n, 3)
        moved_C = product(cross_C, turn.reshape(3, 3 * n)).reshape(n, 3, n, 3)  # b_i' = R^T v_i - w_WC_C x b_i
        moved_C[range(n), :, range(n)] += R_WC.T  # without the motion of the centroid, which N^T ignores

        J = np.zeros((self.size, n, 4))
        J[:3, :, :3] = np.eye(3)[:, None] / n
        J[3:6, :, :3] = product(euler_rates(roll, pitch), turn.reshape(3, 3 * n)).reshape(3, n, 3)
        J[6 : self._shape, :, 3] = np.eye(n)
        J[6 : self._shape] -= J[5]
        J[self._shape :, :, :3] = product(self._modes_inverse, moved_C.reshape(3 * n, 3 * n)).reshape(-1, n, 3)
        return J.reshape(self.size, self.size)

    def inverse_jacobian(self, c: Array) -> Array:
        R_WC, points_C = rotation_of(c), self._points_C(c)
        J_inv = np.zeros((self.n, 4, self.size))
        J_inv[:, :3, :3] = np.eye(3)
        for k, axis_C in enumerate(euler_axes_of(c), start=3):
            J_inv[:, :3, k] = product(product(points_C, skew(axis_C).T), R_WC.T)
        modes_W = [product(R_WC, mode_C) for mode_C in self.modes_C]
        J_inv[:, :3, self._shape :] = modes_W
        J_inv[:, 3, 5] = 1.0
        J_inv[:, 3, 6 : self._shape] = np.eye(self.n)
        return J_inv.reshape(self.size, self.size)

    def motion(self, c: Array, c_dot: Array) -> Array:
        w_WC_C = product(euler_axes_of(c).T, c_dot[3:6])
        v_C = product(self._points_C(c), skew(w_WC_C).T) + product(self._modes, c_dot[self._shape :]).reshape(self.n, 3)
        r_dot = np.empty((self.n, 4))
        r_dot[:, :3] = c_dot[:3] + product(v_C, rotation_of(c).T)
        r_dot[:, 3] = c_dot[5] + c_dot[6 : self._shape]
        return r_dot.ravel()

    def specimen(self, separation_m: float) -> Array:
        c = np.zeros(self.size)
        distance = np.linalg.norm(self.t_C[:, None] - self.t_C, axis=2)[np.triu_indices(self.n, 1)].min()
        radius_m = math.sqrt(float((self.t_C**2).sum()) / self.n)
        c[self._shape] = radius_m * max(separation_m / max(float(distance), LENGTH_MIN_M) - 1.0, 0.0)
        c[2] = float(np.abs(self._points_C(c)).max()) + separation_m
        return c

    def spread(self, c: Array) -> float:
        """Return the root mean square distance of the robots from the line through them, measured along the template.

        It is the minimum eigenvalue of M (see `jacobian`) over the square root of n times that of the template: exact
        for the template at any scale, and zero where another rotation fits equally well.
        """
        S = product(self._points_C(c).T, self.t_C)
        return float(eigen(inertia((S + S.T) / 2))[0][0]) / self._reach_m

    def condition(self, c: Array) -> float:
        """Return the condition number of J^-1, with the robots' velocities, headings and phi weighted by their rms.

        With these weights, the number does not grow with the number of robots; a formation with robots farther than 4 m
        from the centroid is scaled down to 4 m. w_k and the centroid are orthonormal in these weights, which leaves a
        7 x 7 matrix of turns, the three directions of w coupled to them, and the mean of phi.
        """
        points_C = self._points_C(c)
        scale = min(1.0, CONDITION_LENGTH_M / max(float(np.linalg.norm(points_C, axis=1).max()), LENGTH_MIN_M))
        axes = euler_axes_of(c).T
        squared = scale * scale
        M = squared * product(axes.T, inertia(product(points_C.T, self.t_C)).T)  # template scaled likewise
        stiff = solve(squared * self._inertia, M.T)
        turn_block = squared * product(product(axes.T, inertia(product(points_C.T, points_C))), axes)
        G = np.eye(7)
        G[TURN, TURN] = turn_block / self.n
        G[2, 2] += 1.0  # a turn in yaw turns every heading
        G[TURN, BEND] = _root(turn_block - product(M, stiff), self.n)
        G[BEND, TURN] = G[TURN, BEND].T
        G[HEADING, 2] = G[2, HEADING] = 1.0
        values = eigen(G)[0]
        return math.sqrt(values[-1] / values[0]) if values[0] > 0.0 else math.inf

    def _points_C(self, c: Array) -> Array:  # positions relative to the centroid, (n, 3) [m]
        return self.t_C + product(self._modes, c[self._shape :]).reshape(self.n, 3)

    def _fit(self, p_W: Array) -> tuple[Array, Array, Array]:
        """Return the centroid (3,), the positions relative to it in C (n, 3), and R_WC (3, 3)."""
        centre_W = np.add.reduce(p_W, axis=0) / self.n
        b_W = p_W - centre_W
        gap, R_WC = fitted_rotation(product(self.t_C.T, b_W))
        if not gap > LENGTH_MIN_M * self._reach_m:  # also true for NaN
            raise SingularClusterError(NO_FRAME)
        return centre_W, product(b_W, R_WC), R_WC


def _root(E: Array, n: int) -> Array:
    """Return the symmetric square root of E / n (3, 3); eigenvalues of E are negative only by rounding."""
    values, vectors = eigen((E + E.T) / 2)
    return product(vectors * np.sqrt(np.maximum(values, 0.0) / n), vectors.T)


def fitted_rotation(H: Array) -> tuple[float, Array]:
    """Return how well the rotation is defined, and the rotation R (3, 3) that maximises the sum of b_i . R t_i.

    H (3, 3) is the sum of t_i b_i^T. The first result is half the difference between the two largest eigenvalues of
    Horn's matrix [unit of H], which is the smallest eigenvalue of tr(S) I - S with S = sum of R^T b_i t_i^T. It is zero
    where several rotations fit equally well, or H is not finite.
    """
    K = np.empty((4, 4))
    if not put_horn_matrix(H, K):
        return 0.0, np.eye(3)
    values, vectors = eigen(K)
    return float(values[3] - values[2]) / 2.0, rotation_of_quaternion(vectors[:, 3])


@portable
def put_horn_matrix(H: Array, K: Array) -> bool:
    """Write Horn's matrix (4, 4), whose dominant eigenvector is the quaternion, w first; return whether H is finite."""
    xx, xy, xz = row(H, 0)
    yx, yy, yz = row(H, 1)
    zx, zy, zz = row(H, 2)
    K[0, 0], K[0, 1], K[0, 2], K[0, 3] = xx + yy + zz, yz - zy, zx - xz, xy - yx
    K[1, 0], K[1, 1], K[1, 2], K[1, 3] = yz - zy, xx - yy - zz, xy + yx, zx + xz
    K[2, 0], K[2, 1], K[2, 2], K[2, 3] = zx - xz, xy + yx, -xx + yy - zz, yz + zy
    K[3, 0], K[3, 1], K[3, 2], K[3, 3] = xy - yx, zx + xz, yz + zy, -xx - yy + zz
    return math.isfinite(xx + xy + xz + yx + yy + yz + zx + zy + zz)


@portable
def rotation_of_quaternion(q: Array) -> Array:
    """Return R (3, 3) of a unit quaternion (4,), w first."""
    return array_of(matrix((q[0], q[1], q[2], q[3])))


def centred(positions: ArrayLike) -> Array:
    p = np.array(positions, dtype=float).reshape(-1, 3)
    return p - p.mean(axis=0)


def turns(t: Array) -> Array:
    """Return the motions e_k x t_i of centred points under a unit rotation about each axis, (3, n, 3)."""
    return np.array([np.cross(axis, t) for axis in np.eye(3)])


def shape_modes(t: Array) -> Array:
    """Return a basis (n, 3, 3n - 6) of the displacements that neither move nor turn centred points t (n, 3).

    Each mode moves the points by 1 m in the root mean square, and all are orthogonal to each other: N^T N = n I. The
    first modes are homogeneous, as far as the extent of the points permits: growth, stretches along the axes and shears
    in their planes. The others come from moving single points, in order.

    Raises:
        ValueError: the points are collinear or coincide.
    """
    n = len(t)
    rigid = _orthonormal([*np.repeat(np.eye(3)[:, None], n, axis=1), *turns(t)], [])
    if len(rigid) < 6:
        raise ValueError("template: all positions are collinear; allowed: positions that span a plane or space")
    single = np.eye(3 * n).reshape(3 * n, n, 3)
    stretches = [t * axis for axis in np.eye(3)]
    shears = [np.zeros_like(t) for _ in PLANES]
    for d, (a, b) in zip(shears, PLANES, strict=True):
        d[:, a], d[:, b] = t[:, b], t[:, a]
    basis = _orthonormal([t, *stretches, *shears, *single], rigid)
    return np.sqrt(n) * np.array(basis).T.reshape(n, 3, 3 * n - 6)


def _orthonormal(directions: list[Array], given: list[Array]) -> list[Array]:
    """Return directions (n, 3) as unit vectors (3n,), orthogonal to `given` and each other; omit dependent ones."""
    basis: list[Array] = []
    for direction in directions:
        v = direction.ravel()
        size = el.length(v.tolist())
        for _ in range(2):  # the second pass removes the rounding errors of the first
            earlier = np.array([*given, *basis])
            v = v - product(earlier.T, product(earlier, v)) if len(earlier) else v
        remainder = el.length(v.tolist())
        if size > 0.0 and remainder > INDEPENDENT_MIN * size:
            basis.append(v / remainder)
    return basis


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
    """Return the cross-product matrix (3, 3) of a."""
    A = np.zeros((3, 3))
    A[0, 1], A[0, 2] = -a[2], a[1]
    A[1, 0], A[1, 2] = a[2], -a[0]
    A[2, 0], A[2, 1] = -a[1], a[0]
    return A


def euler_angles(R_WC: Array) -> tuple[float, float, float]:
    """Return roll, pitch and yaw of R_WC = Rz(yaw) Ry(pitch) Rx(roll)."""
    pitch, yaw = pitch_yaw((R_WC[0, 0], R_WC[1, 0], R_WC[2, 0]))
    return el.atan2(R_WC[2, 1], R_WC[2, 2]), pitch, yaw


@portable
def array_of(R: Matrix) -> Array:
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
    """Return w_WC_C for unit rates of roll, pitch and yaw, as the rows of (3, 3)."""
    return array_of(euler_axes_C(c[3], c[4]))
