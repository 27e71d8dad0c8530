"""Who heard whom during a flight, of the world's `RadioLinks`."""

from functools import lru_cache

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from zsim.contract.run_messages import RadioLinks


class RadioSummary(Struct, frozen=True):
    """How well drones heard each other, on average over the instants of a window."""

    heard_mean: float  # drones that a drone hears
    connected_share: float  # of the instants: every drone's messages could reach all, over others too


class RadioHistory:
    """The links of N drones at K instants, reduced to what is drawn; a ground station's are left out.

    Attributes:
        t_ns: instants, ascending.
        heard: how many others each drone heard at each, (K, N).
        connected: whether the graph was strongly connected, (K,).
        share: of the instants at which drone i heard drone j, (N, N).
    """

    def __init__(self, links: list[RadioLinks], drones: int) -> None:
        by_time = {each.t_ns: each for each in links}
        self.t_ns: NDArray[np.int64] = np.array(sorted(by_time), np.int64)
        known = [_graph(by_time[t_ns].hears, drones) for t_ns in self.t_ns.tolist()]
        self.heard: NDArray[np.int64] = np.array([hears.sum(axis=1) for hears, _ in known]).reshape(-1, drones)
        self.connected: NDArray[np.bool_] = np.array([connected for _, connected in known], bool)
        total = np.zeros((drones, drones))
        for hears, _ in known:
            total += hears
        self.share = total / max(1, len(known))

    def summary(self, window_s: tuple[float, float]) -> RadioSummary | None:
        within = (self.t_ns >= window_s[0] * 1e9) & (self.t_ns <= window_s[1] * 1e9)
        if not within.any():
            return None
        return RadioSummary(float(self.heard[within].mean()), float(self.connected[within].mean()))


@lru_cache(maxsize=1024)  # links change rarely
def _graph(hears: tuple[tuple[int, ...], ...], drones: int) -> tuple[NDArray[np.bool_], bool]:
    """Return whether drone i hears drone j, (N, N), and whether all reach all."""
    matrix = np.zeros((drones, drones), dtype=bool)
    for i, heard in enumerate(hears[:drones]):
        matrix[i, [j for j in heard if j < drones]] = True
    parts, _ = connected_components(csr_array(matrix), directed=True, connection="strong")
    return matrix, parts == 1
