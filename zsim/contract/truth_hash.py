"""The fingerprint of a flight: SHA-256 over all truth instants (contract, "Same bits")."""

import hashlib

import numpy as np
from numpy.typing import ArrayLike, NDArray

COLUMNS = 13  # position, velocity, orientation, angular velocity of a drone
HELD_BYTES = 16_384  # hashed in one go, which takes as long as a few instants


class TruthHash:
    """SHA-256 over t_ns (int64), then position, velocity, orientation and angular velocity (float64).

    Little-endian, drone by drone in scenario order, instants in time order.

    Args:
        rows: of each `add`: the drones of an instant, or all rows of a flight at once.
    """

    def __init__(self, rows: int) -> None:
        row = np.dtype([("t", "<i8"), ("x", "<f8", COLUMNS)])
        self._hash = hashlib.sha256()
        self._rows = np.zeros((max(1, HELD_BYTES // max(1, rows * row.itemsize)), rows), dtype=row)
        self._t, self._x = self._rows["t"], self._rows["x"]
        self._held = 0

    def add(self, t_ns: ArrayLike, state: NDArray[np.float64]) -> None:
        """Add rows.

        Args:
            t_ns: of all, or of each (rows,).
            state: (rows, 13 or more): position, velocity, orientation, angular velocity.
        """
        self._t[self._held] = t_ns
        self._x[self._held] = state[:, :COLUMNS]
        self._held += 1
        if self._held == len(self._rows):
            self._take_in()

    def _take_in(self) -> None:
        self._hash.update(self._rows[: self._held].data)
        self._held = 0

    def hexdigest(self) -> str:
        """Return the hash of all rows, as hexadecimal digits."""
        self._take_in()
        return self._hash.hexdigest()
