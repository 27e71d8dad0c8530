"""The fingerprint of a flight: SHA-256 over all truth instants."""

import hashlib

import numpy as np

COLUMNS = 13  # of a drone's state that count


class TruthHash:
    """SHA-256 over t_ns (int64), then position, velocity, orientation and angular velocity (float64).

    Little-endian, drone by drone in scenario order, instants in time order (contract, "Same bits").
    """

    def __init__(self, drones: int) -> None:
        self._hash = hashlib.sha256()
        self._rows = np.zeros(drones, dtype=[("t", "<i8"), ("x", "<f8", COLUMNS)])

    def add(self, t_ns: int, state: np.ndarray) -> None:
        """Add one instant of N drones; state (N, 13 or more): position, velocity, orientation, angular velocity."""
        self._rows["t"] = t_ns
        self._rows["x"] = state[:, :COLUMNS]
        self._hash.update(self._rows.data)

    def hexdigest(self) -> str:
        return self._hash.hexdigest()
