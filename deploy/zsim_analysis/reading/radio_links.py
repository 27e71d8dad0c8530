"""Which drones heard which during a flight, from the world's `RadioLinks`."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from zsim.contract.run_messages import RadioLinks

CONNECTS = 0.5  # probability from which a link counts as connected; it defines the range


class RadioSummary(Struct, frozen=True):
    """The reception of drones, averaged over the instants of a window."""

    heard_mean: float  # expected number of drones heard by a drone: 4 with a loss of one half count as 2
    connected_share: float  # share of instants at which every drone can reach all others, also via relays


class RadioHistory:
    """The links of N drones at K instants, without those of a ground station.

    Attributes:
        t_ns: instants, ascending.
        heard: expected number of other drones whose messages arrive, (K, N).
        connected: whether the graph of links of at least CONNECTS, before loss, was strongly connected, (K,).
        share: probability that a message of drone j arrives at drone i, mean over the instants, (N, N).

    Args:
        loss: share of messages lost at any distance.
    """

    def __init__(self, links: Sequence[RadioLinks], drones: int, loss: float = 0.0) -> None:
        by_time = {each.t_ns: each for each in links}
        self.t_ns: NDArray[np.int64] = np.array(sorted(by_time), np.int64)
        self.heard: NDArray[np.float64] = np.empty((len(self.t_ns), drones))
        self.connected: NDArray[np.bool_] = np.empty(len(self.t_ns), bool)
        self.share: NDArray[np.float64] = np.zeros((drones, drones))
        for k, t_ns in enumerate(self.t_ns.tolist()):
            reception, self.connected[k] = _graph(by_time[t_ns].hears, by_time[t_ns].reception, drones)
            arrives = (1.0 - loss) * reception
            self.heard[k] = arrives.sum(axis=1)
            self.share += arrives / len(self.t_ns)

    def summary(self, window_s: tuple[float, float]) -> RadioSummary | None:
        within = (self.t_ns >= window_s[0] * 1e9) & (self.t_ns <= window_s[1] * 1e9)
        if not within.any():
            return None
        return RadioSummary(float(self.heard[within].mean()), float(self.connected[within].mean()))


@lru_cache(maxsize=1024)  # links change rarely if reception does not depend on the distance
def _graph(
    hears: tuple[tuple[int, ...], ...], reception: tuple[tuple[float, ...], ...], drones: int
) -> tuple[NDArray[np.float64], bool]:
    """Return the reception of drone j at drone i, (N, N), and whether the graph is strongly connected."""
    matrix = np.zeros((drones, drones))
    chances = reception or [(1.0,) * len(heard) for heard in hears]
    for i, row in enumerate(zip(hears[:drones], chances[:drones], strict=False)):
        for j, chance in zip(*row, strict=False):
            if j < drones:
                matrix[i, j] = chance
    parts, _ = connected_components(csr_array(matrix >= CONNECTS), directed=True, connection="strong")
    return matrix, parts == 1
