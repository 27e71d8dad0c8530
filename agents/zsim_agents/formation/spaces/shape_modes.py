"""The ways in which a set of points can change its shape without moving or turning as a whole."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from zsim_agents.formation.spaces.cluster_space import Array

INDEPENDENT_MIN = 1e-6  # share of a direction that must be new; rounding leaves 1e-15
PLANES = ((0, 1), (0, 2), (1, 2))


def centred(places: ArrayLike) -> Array:
    """Return places (n, 3) about their mean."""
    p = np.array(places, dtype=float).reshape(-1, 3)
    return p - p.mean(axis=0)


def turns(t: Array) -> Array:
    """Return the motions e_k x t_i of centred points under a unit turn about each axis: (3, n, 3)."""
    return np.array([np.cross(axis, t) for axis in np.eye(3)])


def shape_modes(t: Array) -> Array:
    """Return a basis (n, 3, 3n - 6) of the displacements that neither move nor turn centred points t (n, 3).

    Each mode moves the points by 1 m in the root mean square, and all are orthogonal to each other: N^T N = n I. The
    first are the homogeneous ones: growth, stretches along the axes and shears in their planes, as far as the points
    have room for them; the others follow from moving single points, in their order.

    Raises:
        ValueError: the points are in one line, or in one place.
    """
    n = len(t)
    rigid = _orthonormal([*np.repeat(np.eye(3)[:, None], n, axis=1), *turns(t)], [])
    if len(rigid) < 6:
        raise ValueError("template: all places are in one line; allowed: places that span a plane or space")
    single = np.eye(3 * n).reshape(3 * n, n, 3)
    found = _orthonormal([t, *_stretches(t), *_shears(t), *single], rigid)
    return np.sqrt(n) * np.array(found).T.reshape(n, 3, 3 * n - 6)


def _stretches(t: Array) -> list[Array]:
    return [t * axis for axis in np.eye(3)]


def _shears(t: Array) -> list[Array]:
    shears = []
    for a, b in PLANES:
        d = np.zeros_like(t)
        d[:, a], d[:, b] = t[:, b], t[:, a]
        shears.append(d)
    return shears


def _orthonormal(directions: list[Array], done: list[Array]) -> list[Array]:
    """Return unit vectors (3n,) along what is new in each direction (n, 3), in their order, beside those done."""
    found: list[Array] = []
    for direction in directions:
        v = direction.ravel()
        size = np.linalg.norm(v)
        for _ in range(2):  # the second pass takes out what rounding left of the first
            known = np.array([*done, *found])
            v = v - known.T @ (known @ v) if len(known) else v
        if size > 0.0 and np.linalg.norm(v) > INDEPENDENT_MIN * size:
            found.append(v / np.linalg.norm(v))
    return found
