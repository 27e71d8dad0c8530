"""Clusters of three (the paper's) or more robots, whose frame is given by robots 1, 2 and 3, and clusters of two.

Robots 1, 2 and 3 define the frame C and the triangle (p, q, beta); each further robot k adds its distance rho, azimuth
and elevation from robot 1 in C. The origin is the centroid of all robots. Two robots form a rod with direction and
length, but no roll.
"""

from __future__ import annotations

import math

import numpy as np

from zsim.math import elementary as el
from zsim.math import linear
from zsim.math.compiled import portable
from zsim.math.rotation import (
    Matrix,
    Vector,
    add,
    column,
    cross,
    dot,
    matrix_from_rpy,
    norm,
    product,
    scaled,
    subtract,
)
from zsim_agents.formation.spaces.cluster_space import (
    LENGTH_MIN_M,
    Array,
    ClusterSpace,
    SingularClusterError,
    centroid,
    euler_axes_C,
    euler_rates,
    numbered,
    pitch_yaw,
    put,
    row,
    wrap_angle,
)

NO_FRAME = "robots 1, 2 and 3 are collinear or coincide: the formation has no frame"


class TriadCluster(ClusterSpace):
    """c = (x_c, y_c, z_c, roll, pitch, yaw, phi_1..phi_n, p, q, beta, rho_4, azimuth_4, elevation_4, ...).

    det J^-1 = -p^2 q^2 sin(beta) cos(pitch) for n = 3.
    """

    def __init__(self, n: int) -> None:
        others = [name for k in range(4, n + 1) for name in (f"rho_{k}", f"azimuth_{k}", f"elevation_{k}")]
        names = ["x_c", "y_c", "z_c", "roll", "pitch", "yaw", *numbered("phi", range(1, n + 1))]
        spread_text = "sin(beta) min(p, q)" if n == 3 else "minimum of sin(beta) min(p, q) and rho_k cos(elevation_k)"
        super().__init__(n, [*names, "p", "q", "beta", *others], spread_text)
        self._shape = 6 + n  # index of p in c

    def forward(self, p_W: Array, yaw: Array) -> Array:
        c = np.empty(self.size)
        if not triad_forward(p_W, yaw, c):
            raise SingularClusterError(NO_FRAME)
        return c

    def inverse(self, c: Array) -> tuple[Array, Array]:
        p_W, yaw = np.empty((self.n, 3)), np.empty(self.n)
        if not triad_inverse(c, p_W, yaw):
            raise self._no_direction(c)
        return p_W, yaw

    def jacobian(self, p_W: Array, yaw: Array) -> Array:
        d_W = p_W - p_W[0]
        x, y, z, h, area = triad_axes(row(d_W, 1), row(d_W, 2))
        if h == 0.0:
            raise SingularClusterError(NO_FRAME)
        R_WC = np.array([x, y, z]).T
        d_C = linear.product(d_W, R_WC)
        rate = np.zeros((3, self.n, 3))  # w_WC_C = sum over robots i of rate[:, i] v_i
        rate[0, :3] = np.outer((d_C[2, 0] - d_C[1, 0], -d_C[2, 0], d_C[1, 0]), z) / area
        rate[1, :3] = np.outer((-2.0, 1.0, 1.0), z) / h
        rate[2, :3] = np.outer((2.0, -1.0, -1.0), y) / h
        roll, pitch = el.atan2(y[2], z[2]), pitch_yaw(x)[0]

        J = np.zeros((self.size, self.n, 4))
        J[:3, :, :3] = np.eye(3)[:, None] / self.n
        J[3:6, :, :3] = linear.product(euler_rates(roll, pitch), rate.reshape(3, -1)).reshape(rate.shape)
        J[6 : 6 + self.n, :, 3] = np.eye(self.n)
        J[6 : 6 + self.n] -= J[5]
        J[self._shape : self._shape + 3, :3, :3] = _triangle_rows(d_W[1], d_W[2], np.array(z))
        for k in range(3, self.n):
            first = self._shape + 3 * (k - 2)
            J[first : first + 3, :, :3] = _spherical_rows(k, d_C[k], R_WC, rate)
        return J.reshape(self.size, self.size)

    def inverse_jacobian(self, c: Array) -> Array:
        J_inv = np.zeros((self.size, self.size))
        if not triad_inverse_jacobian(c, J_inv):
            raise self._no_direction(c)
        return J_inv

    def spread(self, c: Array) -> float:
        return float(triad_spread(c))

    def _no_direction(self, c: Array) -> SingularClusterError:
        p, q, beta = c[self._shape : self._shape + 3].tolist()
        return SingularClusterError(f"p {p:.3g} m, q {q:.3g} m, beta {beta:.3g} rad: the formation has no direction")


@portable
def triad_forward(p_W: Array, yaw: Array, c: Array) -> bool:
    """Write c (4n,) and return whether the robots define a frame; without one, nothing is written."""
    n = yaw.size
    p_index = 6 + n  # index of p in c
    p_1 = row(p_W, 0)
    d2, d3 = subtract(row(p_W, 1), p_1), subtract(row(p_W, 2), p_1)
    x, y, z, h, area = triad_axes(d2, d3)
    if h == 0.0:
        return False
    c[0], c[1], c[2] = centroid(p_W)
    c[3] = el.atan2(y[2], z[2])
    c[4], c[5] = pitch_yaw(x)
    for i in range(n):
        c[6 + i] = wrap_angle(yaw[i] - c[5])
    c[p_index], c[p_index + 1], c[p_index + 2] = norm(d2), norm(d3), el.atan2(area, dot(d2, d3))
    for k in range(3, n):
        first = p_index + 3 * (k - 2)
        c[first], c[first + 1], c[first + 2] = spherical(product((x, y, z), subtract(row(p_W, k), p_1)))
    return True


@portable
def triad_inverse(c: Array, p_W: Array, yaw: Array) -> bool:
    """Write positions (n, 3) and headings (n,), and return whether they are valid, i.e. the shape has a direction."""
    n = c.size // 4
    put_positions_C(c, p_W)
    R_WC = matrix_from_rpy(c[3], c[4], c[5])
    for i in range(n):
        d_W = product(R_WC, row(p_W, i))
        for k in range(3):
            p_W[i, k] = c[k] + d_W[k]
        yaw[i] = wrap_angle(c[5] + c[6 + i])
    return has_direction(c)


@portable
def triad_inverse_jacobian(c: Array, J_inv: Array) -> bool:
    """Write J^-1 (4n, 4n), zero on entry, and return whether the shape has a direction; without one, write nothing.

    Robot i moves at v_c + R_WC (w_WC_C x d_i + d_i') and turns at yaw' + phi_i'; d_i is its position in C, and d_i' the
    rate of this position due to changes of the shape.
    """
    n = c.size // 4
    if not has_direction(c):
        return False
    R_WC, axes_C, positions_C = matrix_from_rpy(c[3], c[4], c[5]), euler_axes_C(c[3], c[4]), np.empty((n, 3))
    put_positions_C(c, positions_C)
    for i in range(n):
        first = 4 * i
        for k in range(3):
            J_inv[first + k, k] = 1.0
            put(J_inv, first, 3 + k, product(R_WC, cross(axes_C[k], row(positions_C, i))))
        J_inv[first + 3, 5] = J_inv[first + 3, 6 + i] = 1.0
    put_shape_rates(J_inv, c, R_WC)
    return True


@portable
def put_shape_rates(J_inv: Array, c: Array, R_WC: Matrix) -> None:
    n = c.size // 4
    p_index = 6 + n
    triangle_C = triangle_rates(c[p_index], c[p_index + 1], c[p_index + 2])
    for robot in range(1, 3):
        for k in range(3):
            add_rate(J_inv, robot, p_index + k, product(R_WC, triangle_C[robot - 1][k]))
    for robot in range(3, n):
        first = p_index + 3 * (robot - 2)
        rates_C = spherical_rates(c[first], c[first + 1], c[first + 2])
        for k in range(3):
            add_rate(J_inv, robot, first + k, product(R_WC, rates_C[k]))


@portable
def add_rate(J_inv: Array, robot: int, column: int, rate_W: Vector) -> None:
    """Add the motion of one robot per unit of a variable; all move back by the mean, so that the centroid stays put."""
    n = J_inv.shape[0] // 4
    for k in range(3):
        mean_rate = rate_W[k] / n
        for i in range(n):
            J_inv[4 * i + k, column] -= mean_rate
        J_inv[4 * robot + k, column] += rate_W[k]


@portable
def triad_spread(c: Array) -> float:
    p_index = 6 + c.size // 4
    min_spread = el.sin(c[p_index + 2]) * min(c[p_index], c[p_index + 1])
    for first in range(p_index + 3, c.size, 3):
        min_spread = min(min_spread, c[first] * el.cos(c[first + 2]))
    return min_spread


@portable
def triad_axes(d2: Vector, d3: Vector) -> tuple[Vector, Vector, Vector, float, float]:
    """Return the axes x, y, z of C in W, h = |d2 + d3| [m] and the area |d2 x d3| [m^2] of d2 = P2 - P1, d3 = P3 - P1.

    x_C points from the middle of robots 2 and 3 to robot 1, z_C along d2 x d3; robot 2 is on the left. All results are
    zero if the three robots are collinear or coincide.
    """
    m = add(d2, d3)
    normal = cross(d2, d3)
    h, area = norm(m), norm(normal)
    if not (h > LENGTH_MIN_M and area > LENGTH_MIN_M * h):  # also true for NaN
        zero = (0.0, 0.0, 0.0)
        return zero, zero, zero, 0.0, 0.0
    x = (-m[0] / h, -m[1] / h, -m[2] / h)
    z = (normal[0] / area, normal[1] / area, normal[2] / area)
    return x, cross(z, x), z, h, area


@portable
def put_positions_C(c: Array, positions: Array) -> None:
    """Write the positions of the robots relative to the centroid, (n, 3) [m; C]."""
    n = c.size // 4
    p_index = 6 + n
    p, q = c[p_index], c[p_index + 1]
    ca2, sa2, ca3, sa3, _ = split_beta(p, q, c[p_index + 2])
    positions[:3] = 0.0  # positions relative to robot 1 until the centroid is subtracted
    positions[1, 0], positions[1, 1] = -p * ca2, p * sa2
    positions[2, 0], positions[2, 1] = -q * ca3, -q * sa3
    for k in range(3, n):
        first = p_index + 3 * (k - 2)
        positions[k, 0], positions[k, 1], positions[k, 2] = spherical_position(c[first], c[first + 1], c[first + 2])
    centre = centroid(positions)
    for i in range(n):
        for k in range(3):
            positions[i, k] -= centre[k]


@portable
def has_direction(c: Array) -> bool:
    """Return whether the midpoint of robots 2 and 3 is distinct from robot 1."""
    p_index = 6 + c.size // 4
    return split_beta(c[p_index], c[p_index + 1], c[p_index + 2])[4] > 0.0


@portable
def split_beta(p: float, q: float, beta: float) -> tuple[float, float, float, float, float]:
    """Return cos and sin of the angle at robot 1 from -x_C to robot 2, the same to robot 3, and h [m].

    All results are zero if x_C is undefined.
    """
    along2, along3 = p + q * el.cos(beta), q + p * el.cos(beta)
    h = math.sqrt(max(p * along2 + q * along3, 0.0))
    if not h > LENGTH_MIN_M:  # also true for NaN
        return 0.0, 0.0, 0.0, 0.0, 0.0
    return along2 / h, q * el.sin(beta) / h, along3 / h, p * el.sin(beta) / h, h


@portable
def triangle_rates(p: float, q: float, beta: float) -> tuple[Matrix, Matrix]:
    """Return the derivatives of P2 - P1 in C with respect to p, q and beta, then those of P3 - P1."""
    ca2, sa2, ca3, sa3, h = split_beta(p, q, beta)
    by_p, by_q = -sa2 / h, sa3 / h  # derivatives of the angle to robot 2; that to robot 3 turns the other way
    rates_2 = (
        (-ca2 + p * sa2 * by_p, sa2 + p * ca2 * by_p, 0.0),
        (p * sa2 * by_q, p * ca2 * by_q, 0.0),
        (p * sa2 * q * ca3 / h, p * ca2 * q * ca3 / h, 0.0),
    )
    rates_3 = (
        (-q * sa3 * by_p, q * ca3 * by_p, 0.0),
        (-ca3 - q * sa3 * by_q, -sa3 + q * ca3 * by_q, 0.0),
        (q * sa3 * p * ca2 / h, -q * ca3 * p * ca2 / h, 0.0),
    )
    return rates_2, rates_3


@portable
def spherical(d_C: Vector) -> Vector:
    horizontal = math.sqrt(d_C[0] * d_C[0] + d_C[1] * d_C[1])
    return norm(d_C), el.atan2(d_C[1], d_C[0]), el.atan2(d_C[2], horizontal)


@portable
def spherical_position(rho: float, azimuth: float, elevation: float) -> Vector:
    horizontal = rho * el.cos(elevation)
    return horizontal * el.cos(azimuth), horizontal * el.sin(azimuth), rho * el.sin(elevation)


@portable
def spherical_rates(rho: float, azimuth: float, elevation: float) -> Matrix:
    """Return the derivatives of (x, y, z) with respect to distance, azimuth and elevation."""
    sa, ca, se, ce = el.sin(azimuth), el.cos(azimuth), el.sin(elevation), el.cos(elevation)
    return (
        (ce * ca, ce * sa, se),
        (-rho * ce * sa, rho * ce * ca, 0.0),
        (-rho * se * ca, -rho * se * sa, rho * ce),
    )


def _triangle_rows(d2_W: Array, d3_W: Array, z_W: Array) -> Array:
    """Return the rows of J for p, q, beta and the columns of robots 1, 2, 3: (3, 3 robots, 3)."""
    p, q = el.length(d2_W), el.length(d3_W)
    u2, u3 = d2_W / p, d3_W / q
    t2, t3 = np.cross(z_W, u2) / p, np.cross(z_W, u3) / q
    zero = np.zeros(3)
    return np.array([[-u2, u2, zero], [-u3, zero, u3], [t2 - t3, -t2, t3]])


def _spherical_rows(k: int, d_C: Array, R_WC: Array, rate: Array) -> Array:
    """Return the rows of J for rho, azimuth and elevation of the robot with index k: (3, n, 3).

    In C the robot moves relative to robot 1 at R_WC^T (v_k - v_1) - w_WC_C x d_C.
    """
    x, y, z = d_C.tolist()
    horizontal, rho = el.hypot(x, y), el.hypot(x, y, z)
    if not horizontal > LENGTH_MIN_M:
        raise SingularClusterError(f"robot {k + 1} is on the z axis through robot 1: it has no azimuth")
    rates_C = np.array(spherical_rates(*spherical((x, y, z))))  # orthogonal rows of lengths 1, horizontal and rho
    gradient = rates_C / np.array([(1.0,), (horizontal * horizontal,), (rho * rho,)])
    motion_C = linear.product([(0, -z, y), (z, 0, -x), (-y, x, 0)], rate.reshape(3, -1)).reshape(rate.shape)
    motion_C[:, k] += R_WC.T
    motion_C[:, 0] -= R_WC.T
    return linear.product(gradient, motion_C.reshape(3, -1)).reshape(rate.shape)


class PairCluster(ClusterSpace):
    """c = (x_c, y_c, z_c, pitch, yaw, phi_1, phi_2, p); the origin is midway, and x_C points towards robot 1."""

    def __init__(self) -> None:
        super().__init__(2, ("x_c", "y_c", "z_c", "pitch", "yaw", "phi_1", "phi_2", "p"), "p")

    def forward(self, p_W: Array, yaw: Array) -> Array:
        c = np.empty(8)
        pair_forward(p_W, yaw, c)
        if not c[7] > LENGTH_MIN_M:  # also true for NaN
            raise SingularClusterError("robots 1 and 2 coincide: the formation has no direction")
        return c

    def inverse(self, c: Array) -> tuple[Array, Array]:
        p_W, yaw = np.empty((2, 3)), np.empty(2)
        pair_inverse(c, p_W, yaw)
        return p_W, yaw

    def jacobian(self, p_W: Array, yaw: Array) -> Array:
        _, _, _, pitch, psi, _, _, p = self.forward(p_W, yaw).tolist()
        if el.cos(pitch) < LENGTH_MIN_M:
            raise SingularClusterError("one robot is directly above the other: the formation has no yaw")
        x, y, z = np.array(matrix_from_rpy(0.0, pitch, psi)).T
        J = np.zeros((8, 2, 4))
        J[:3, :, :3] = np.eye(3)[:, None] / 2
        for k, axis in ((3, -z / p), (4, y / (p * el.cos(pitch))), (7, x)):
            J[k, 0, :3], J[k, 1, :3] = axis, -axis
        J[5:7, :, 3] = np.eye(2)
        J[5:7] -= J[4]
        return J.reshape(8, 8)

    def inverse_jacobian(self, c: Array) -> Array:
        J_inv = np.zeros((8, 8))
        pair_inverse_jacobian(c, J_inv)
        return J_inv

    def spread(self, c: Array) -> float:
        return float(c[7])


@portable
def pair_forward(p_W: Array, yaw: Array, c: Array) -> None:
    """Write c (8,); if the length p is zero, only the centroid and p are valid."""
    d_W = subtract(row(p_W, 0), row(p_W, 1))
    c[0], c[1], c[2] = centroid(p_W)
    c[3], c[4] = pitch_yaw(d_W)
    c[5], c[6] = wrap_angle(yaw[0] - c[4]), wrap_angle(yaw[1] - c[4])
    c[7] = norm(d_W)


@portable
def pair_inverse(c: Array, p_W: Array, yaw: Array) -> None:
    half_W = scaled(column(matrix_from_rpy(0.0, c[3], c[4]), 0), c[7] / 2)
    for k in range(3):
        p_W[0, k], p_W[1, k] = c[k] + half_W[k], c[k] - half_W[k]
    yaw[0], yaw[1] = wrap_angle(c[4] + c[5]), wrap_angle(c[4] + c[6])


@portable
def pair_inverse_jacobian(c: Array, J_inv: Array) -> None:
    """Write J^-1 (8, 8), zero on entry."""
    R_WC = matrix_from_rpy(0.0, c[3], c[4])
    x, y, z = column(R_WC, 0), column(R_WC, 1), column(R_WC, 2)
    for robot in range(2):
        first, half = 4 * robot, (0.5 - robot) * c[7]  # robot 1 is ahead, robot 2 behind
        for k in range(3):
            J_inv[first + k, k] = 1.0
        put(J_inv, first, 3, scaled(z, -half))
        put(J_inv, first, 4, scaled(y, half * el.cos(c[3])))
        put(J_inv, first, 7, scaled(x, 0.5 - robot))
        J_inv[first + 3, 4] = J_inv[first + 3, 5 + robot] = 1.0
