"""Where drones have been: the last stretch of each one's way, as line segments. Pure."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

POINTS_MAX = 6_000  # of all trails together: 144 kB for a browser each time
POINTS_OF_ONE = 300
SPACING_M = 0.08  # of two points: a sixth of a hull


class DroneTrails:
    """The ways of N drones.

    Args:
        count: how many drones.
    """

    def __init__(self, count: int) -> None:
        self._room = min(POINTS_OF_ONE, max(2, POINTS_MAX // count))
        self._points = np.zeros((count, self._room, 3))
        self._lengths = np.zeros(count, dtype=np.int64)

    def add(self, p_W: Array) -> bool:
        """Take positions (N, 3) [m], NaN of a drone that is not there; return whether any has moved on."""
        last = self._points[np.arange(len(p_W)), np.maximum(self._lengths - 1, 0)]
        moved = (np.linalg.norm(p_W - last, axis=1) >= SPACING_M) | (self._lengths == 0)
        moved &= np.isfinite(p_W[:, 0])
        for i in np.flatnonzero(moved):
            if self._lengths[i] == self._room:
                self._points[i, :-1] = self._points[i, 1:]
            else:
                self._lengths[i] += 1
            self._points[i, self._lengths[i] - 1] = p_W[i]
        return bool(moved.any())

    def segments(self, p_W: Array) -> tuple[Array, NDArray[np.int64]]:
        """Return segments (M, 2, 3) up to where the drones are now, (N, 3), and whose each is (M,)."""
        lines, whose = [np.zeros((0, 2, 3))], [np.zeros(0, dtype=np.int64)]
        there = np.isfinite(p_W[:, 0])
        for i, length in enumerate(self._lengths):
            if not length or not there[i]:
                continue
            way = np.vstack((self._points[i, :length], p_W[i]))
            lines.append(np.stack((way[:-1], way[1:]), axis=1))
            whose.append(np.full(len(way) - 1, i))
        return np.concatenate(lines), np.concatenate(whose)

    def clear(self) -> None:
        """Forget everything."""
        self._lengths[:] = 0
