"""The cluster of three robots of the paper, and its generalisation to more of them.

Robots 1, 2, 3 give the frame C and the triangle (p, q, beta); each further robot k adds its distance rho,
azimuth and elevation, seen from robot 1 in C. The origin is the centroid of all robots.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from zsim_agents.cluster_frame import (
    LENGTH_MIN_M,
    cross,
    euler_axes_C,
    euler_rates,
    pitch_yaw,
    rotation_WC,
    triad_axes,
    wrap_angle,
)
from zsim_agents.cluster_space import Array, ClusterSpace, SingularClusterError, numbered


class TriadCluster(ClusterSpace):
    """c = (x_c, y_c, z_c, roll, pitch, yaw, phi_1..phi_n, p, q, beta, rho_4, azimuth_4, elevation_4, ...).

    det J^-1 = -p^2 q^2 sin(beta) cos(pitch) at n = 3.
    """

    def __init__(self, n: int) -> None:
        others = [name for k in range(4, n + 1) for name in (f"rho_{k}", f"azimuth_{k}", f"elevation_{k}")]
        names = ["x_c", "y_c", "z_c", "roll", "pitch", "yaw", *numbered("phi", range(1, n + 1))]
        spread_text = (
            "sin(beta) min(p, q)" if n == 3 else "least of sin(beta) min(p, q) and rho_k cos(elevation_k)"
        )
        super().__init__(n, [*names, "p", "q", "beta", *others], spread_text)
        self._shape = 6 + n  # place of p in c
        self._constant = np.zeros((n, 4, 4 * n))  # the part of J^-1 that holds everywhere
        self._constant[:, :3, :3] = np.eye(3)
        self._constant[:, 3, 5] = 1.0
        self._constant[range(n), 3, range(6, 6 + n)] = 1.0

    def forward(self, p_W: Array, yaw: Array) -> Array:
        d2, d3, *others = (p_W[1:] - p_W[0]).tolist()
        x, y, z, _, area = triad_axes(d2, d3)
        roll = math.atan2(y[2], z[2])
        pitch, psi = pitch_yaw(x)
        phi = [wrap_angle(heading - psi) for heading in yaw.tolist()]
        beta = math.atan2(area, d2[0] * d3[0] + d2[1] * d3[1] + d2[2] * d3[2])
        shape = [math.hypot(*d2), math.hypot(*d3), beta]
        for d in others:
            shape += _spherical((_dot(x, d), _dot(y, d), _dot(z, d)))
        return np.array([*(p_W.sum(axis=0) / self.n).tolist(), roll, pitch, psi, *phi, *shape])

    def inverse(self, c: Array) -> tuple[Array, Array]:
        roll, pitch, psi, *rest = c[3:].tolist()
        p_C = np.array(self._places_C(rest[self.n :]))
        yaw = np.array([wrap_angle(psi + phi) for phi in rest[: self.n]])
        return c[:3] + p_C @ rotation_WC(roll, pitch, psi).T, yaw

    def jacobian(self, p_W: Array, yaw: Array) -> Array:
        d_W = p_W - p_W[0]
        x, y, z, h, area = triad_axes(d_W[1].tolist(), d_W[2].tolist())
        R_WC = np.array([x, y, z]).T
        d_C = d_W @ R_WC
        rate = np.zeros((3, self.n, 3))  # w_WC_C = sum over robots of rate[:, i] v_i
        rate[0, :3] = np.outer((d_C[2, 0] - d_C[1, 0], -d_C[2, 0], d_C[1, 0]), z) / area
        rate[1, :3] = np.outer((-2.0, 1.0, 1.0), z) / h
        rate[2, :3] = np.outer((2.0, -1.0, -1.0), y) / h
        roll, pitch = math.atan2(y[2], z[2]), pitch_yaw(x)[0]

        J = np.zeros((self.size, self.n, 4))
        J[:3, :, :3] = np.eye(3)[:, None] / self.n
        J[3:6, :, :3] = np.tensordot(euler_rates(roll, pitch), rate, 1)
        J[6 : 6 + self.n, :, 3] = np.eye(self.n)
        J[6 : 6 + self.n] -= J[5]
        J[self._shape : self._shape + 3, :3, :3] = _triangle_rows(d_W[1], d_W[2], np.array(z))
        for k in range(3, self.n):
            row = self._shape + 3 * (k - 2)
            J[row : row + 3, :, :3] = _spherical_rows(k, d_C[k], R_WC, rate)
        return J.reshape(self.size, self.size)

    def inverse_jacobian(self, c: Array) -> Array:
        roll, pitch, psi, *rest = c[3:].tolist()
        shape = rest[self.n :]
        axes_C = euler_axes_C(roll, pitch)
        turning = [[cross(axis, place) for axis in axes_C] for place in self._places_C(shape)]
        R_WC = rotation_WC(roll, pitch, psi)
        J_inv = self._constant.copy()
        J_inv[:, :3, 3:6] = R_WC @ np.array(turning).transpose(0, 2, 1)
        J_inv[:, :3, self._shape :] = R_WC @ self._shape_rates_C(shape)
        return J_inv.reshape(self.size, self.size)

    def spread(self, c: Array) -> float:
        p, q, beta, *others = c[self._shape :].tolist()
        heights = [
            rho * math.cos(elevation) for rho, elevation in zip(others[::3], others[2::3], strict=True)
        ]
        return min(math.sin(beta) * min(p, q), *heights) if heights else math.sin(beta) * min(p, q)

    def _places_C(self, shape: Sequence[float]) -> list[list[float]]:
        """Return the places of the robots from the centroid, in C [m]."""
        p, q, beta, *others = shape
        ca2, sa2, ca3, sa3, _ = _split_beta(p, q, beta)
        from_1 = [(0.0, 0.0, 0.0), (-p * ca2, p * sa2, 0.0), (-q * ca3, -q * sa3, 0.0)]
        for k in range(0, len(others), 3):
            rho, azimuth, elevation = others[k : k + 3]
            flat = rho * math.cos(elevation)
            from_1.append((flat * math.cos(azimuth), flat * math.sin(azimuth), rho * math.sin(elevation)))
        centre = [sum(column) / self.n for column in zip(*from_1, strict=True)]
        return [[a - b for a, b in zip(place, centre, strict=True)] for place in from_1]

    def _shape_rates_C(self, shape: Sequence[float]) -> Array:
        """Return the derivatives of `_places_C` by the shape variables, (n, 3, 3n - 6)."""
        rates = np.zeros((self.n, 3, len(shape)))
        rates[1:3, :2, :3] = _triangle_rates(*shape[:3])
        for k in range(3, self.n):
            at = 3 * (k - 2)
            rates[k, :, at : at + 3] = _spherical_rates(*shape[at : at + 3])
        return rates - rates.sum(axis=0) / self.n


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _split_beta(p: float, q: float, beta: float) -> tuple[float, float, float, float, float]:
    """Return cos and sin of the angle at robot 1 from -x_C to robot 2, the same to robot 3, and h [m]."""
    along2, along3 = p + q * math.cos(beta), q + p * math.cos(beta)
    h = math.sqrt(max(p * along2 + q * along3, 0.0))
    if not h > LENGTH_MIN_M:  # also true for NaN
        raise SingularClusterError(
            f"p {p:.3g} m, q {q:.3g} m, beta {beta:.3g} rad: the formation has no direction"
        )
    return along2 / h, q * math.sin(beta) / h, along3 / h, p * math.sin(beta) / h, h


def _triangle_rates(p: float, q: float, beta: float) -> list[list[list[float]]]:
    """Return the derivatives of (x, y) of robots 2 and 3 from robot 1, in C, by p, q and beta: (2, 2, 3)."""
    ca2, sa2, ca3, sa3, h = _split_beta(p, q, beta)
    by_p, by_q = -sa2 / h, sa3 / h  # of the angle of robot 2; that of robot 3 turns the other way
    return [
        [
            [-ca2 + p * sa2 * by_p, p * sa2 * by_q, p * sa2 * q * ca3 / h],
            [sa2 + p * ca2 * by_p, p * ca2 * by_q, p * ca2 * q * ca3 / h],
        ],
        [
            [-q * sa3 * by_p, -ca3 - q * sa3 * by_q, q * sa3 * p * ca2 / h],
            [q * ca3 * by_p, -sa3 + q * ca3 * by_q, -q * ca3 * p * ca2 / h],
        ],
    ]


def _triangle_rows(d2_W: Array, d3_W: Array, z_W: Array) -> Array:
    """Return the rows of J for p, q, beta on robots 1, 2, 3: (3, 3 robots, 3)."""
    p, q = math.hypot(*d2_W), math.hypot(*d3_W)
    u2, u3 = d2_W / p, d3_W / q
    t2, t3 = np.cross(z_W, u2) / p, np.cross(z_W, u3) / q
    none = np.zeros(3)
    return np.array([[-u2, u2, none], [-u3, none, u3], [t2 - t3, -t2, t3]])


def _spherical(d_C: Sequence[float]) -> tuple[float, float, float]:
    flat = math.hypot(d_C[0], d_C[1])
    return math.hypot(flat, d_C[2]), math.atan2(d_C[1], d_C[0]), math.atan2(d_C[2], flat)


def _spherical_rates(rho: float, azimuth: float, elevation: float) -> list[list[float]]:
    """Return the derivatives of (x, y, z) by rho, azimuth and elevation, (3, 3)."""
    sa, ca, se, ce = math.sin(azimuth), math.cos(azimuth), math.sin(elevation), math.cos(elevation)
    return [
        [ce * ca, -rho * ce * sa, -rho * se * ca],
        [ce * sa, rho * ce * ca, -rho * se * sa],
        [se, 0.0, rho * ce],
    ]


def _spherical_rows(k: int, d_C: Array, R_WC: Array, rate: Array) -> Array:
    """Return the rows of J for rho, azimuth and elevation of robot index k, (3, n, 3).

    In C the robot moves from robot 1 at R_WC^T (v_k - v_1) - w_WC_C x d_C.
    """
    x, y, z = d_C.tolist()
    flat, rho = math.hypot(x, y), math.hypot(x, y, z)
    if not flat > LENGTH_MIN_M:
        raise SingularClusterError(f"robot {k + 1} is on the z axis through robot 1: it has no azimuth")
    gradient = np.array(
        [
            (x / rho, y / rho, z / rho),
            (-y / flat**2, x / flat**2, 0.0),
            (-x * z / (flat * rho**2), -y * z / (flat * rho**2), flat / rho**2),
        ]
    )
    motion_C = np.tensordot(np.array([(0, -z, y), (z, 0, -x), (-y, x, 0)]), rate, 1)
    motion_C[:, k] += R_WC.T
    motion_C[:, 0] -= R_WC.T
    return np.tensordot(gradient, motion_C, 1)
