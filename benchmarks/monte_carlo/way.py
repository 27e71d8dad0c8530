"""The paths of Test 1's drones in a zsim flight, sampled every 20 ms, which the peers' drones follow."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

GATE_S = 0.02  # s between two points of a path


class Way(NamedTuple):
    """The true paths of three drones: their states at every gate from t = 0."""

    p_W: NDArray[np.float64]  # (K, 3, 3) positions [m]
    v_W: NDArray[np.float64]  # (K, 3, 3) velocities [m/s]
    yaw: NDArray[np.float64]  # (K, 3) [rad]

    @property
    def span_s(self) -> float:
        return (len(self.p_W) - 1) * GATE_S

    def at(self, t_s: float) -> int:
        """Return the index of the last point not after `t_s`."""
        return min(int(t_s / GATE_S + 1e-6), len(self.p_W) - 1)


def write(way: Way, path: Path) -> None:
    np.savez(path, **way._asdict())


def read(path: Path) -> Way:
    with np.load(path) as found:
        return Way(found["p_W"], found["v_W"], found["yaw"])
