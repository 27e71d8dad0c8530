"""What an estimator says of a drone, and how old a reading it can use."""

from typing import NamedTuple

from zsim.scenario.scenario import Drone
from zsim_agents.estimation.aiding import PATIENCE_S
from zsim_agents.estimation.madgwick import Quaternion, Vector


class Estimate(NamedTuple):
    """What is published at every gate; see the contract."""

    position_m: Vector
    velocity_m_s: Vector
    orientation_wxyz: Quaternion
    yaw_rad: float
    covariance: tuple[float, ...]
    """Of position and velocity, 6 x 6, row-major."""
    yaw_sigma_rad: float
    gyro_bias_rad_s: Vector
    """In the body frame."""
    sensors: dict[str, tuple[int, int]]
    """Readings (used, refused) since the start."""


def age_max_s(drone: Drone, gate_s: float) -> float:
    """Return the oldest age [s] at which a reading of a drone can be used."""
    latency_s = max(getattr(drone.sensors, name).latency_ms for name in ("imu", *PATIENCE_S)) * 1e-3
    return 2.0 * latency_s + 5.0 * gate_s
