"""The fingerprint of a flight: SHA-256 over all truth instants."""

import hashlib

import numpy as np


class TruthHash:
    """SHA-256 over t_ns (int64), then position, velocity, orientation and angular velocity (float64).

    Little-endian, drone by drone in scenario order, instants in time order (contract, "Same bits").
    """

    def __init__(self, drones: int) -> None:
        self._hash = hashlib.sha256()
        self._rows = np.zeros(drones, dtype=[("t", "<i8"), ("x", "<f8", 13)])

    def add(
        self,
        t_ns: int,
        position_m: np.ndarray,
        velocity_m_s: np.ndarray,
        orientation_wxyz: np.ndarray,
        angular_velocity_rad_s: np.ndarray,
    ) -> None:
        """Add one instant of N drones; shapes (N, 3), (N, 3), (N, 4), (N, 3)."""
        values = self._rows["x"]
        self._rows["t"] = t_ns
        values[:, 0:3] = position_m
        values[:, 3:6] = velocity_m_s
        values[:, 6:10] = orientation_wxyz
        values[:, 10:13] = angular_velocity_rad_s
        self._hash.update(self._rows.tobytes())

    def hexdigest(self) -> str:
        return self._hash.hexdigest()
