"""Which robots are near each other: what a guard of separations has to look at.

Loops where they are compiled, array operations where they are not; both give the same pairs in the same order.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from zsim.math.compiled import COMPILES, portable
from zsim_agents.formation.spaces.cluster_space import Array

PairTable = NDArray[np.int64]


@portable
def near_pairs_in_turn(p_W: Array, within_m: float) -> PairTable:
    """Return the pairs (m, 2), i < j, by j and then by i, of positions (n, 3) that are nearer than a distance."""
    n = p_W.shape[0]
    pairs, found = np.empty((n * (n - 1) // 2, 2), np.int64), 0
    for j in range(1, n):
        for i in range(j):
            x, y, z = p_W[j, 0] - p_W[i, 0], p_W[j, 1] - p_W[i, 1], p_W[j, 2] - p_W[i, 2]
            if not math.sqrt(x * x + y * y + z * z) >= within_m:  # also true for NaN
                pairs[found, 0], pairs[found, 1] = i, j
                found += 1
    return pairs[:found]


def near_pairs_at_once(p_W: Array, within_m: float) -> PairTable:
    """Return the same by array operations."""
    j, i = np.tril_indices(len(p_W), -1)
    x, y, z = (p_W[j] - p_W[i]).T
    near = ~(np.sqrt(x * x + y * y + z * z) >= within_m)
    return np.column_stack((i[near], j[near]))


near_pairs = near_pairs_in_turn if COMPILES else near_pairs_at_once
