"""What the error state of a drone's filter consists of, and how uncertain it is before the first reading.

Position (3), velocity (3), small rotation of the attitude (3), all in the world frame, gyroscope bias (3) in the
body frame, accelerometer bias (3) where the drone has one, then the bias of every other channel that has one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from zsim_agents.estimation.aiding_models import DOF_MAX
from zsim_agents.estimation.dead_reckoning import GYRO_BIAS

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BiasPrior:
    """Three equal states of bias, or one."""

    size: int
    sigma: float
    """Standard deviation at the start, in the channel's unit."""
    walk: float
    """Random walk, per sqrt(s)."""


@dataclass(frozen=True)
class ProcessNoise:
    """What drives the error state between measurements."""

    accel_sigma: float
    """White noise of the accelerometer per sample [m/s^2]."""
    gyro_sigma: float
    """White noise of the gyroscope per sample [rad/s]."""
    tilt_density: float
    """What Madgwick's pull adds to the tilt [rad^2/s]."""
    levelling_s: float
    """Time constant of Madgwick's pull [s]."""


class ErrorState:
    """Places and beginning of an error state.

    Args:
        biases: the channels with a bias, in the order of the state: `gyro` first, `accel` next if present.

    Attributes:
        size: n.
        bias_index: first state of each channel's bias.
        with_accel_bias: whether there is one of the accelerometer.
        aiding_biases: whether there is one of another sensor.
        walk: density of each bias' random walk [unit^2/s], (n,).
        covariance: at the start, (n, n); of all but the biases it is zero.
    """

    def __init__(self, biases: Mapping[str, BiasPrior]) -> None:
        self.bias_index: dict[str, int] = {}
        self.size = GYRO_BIAS
        for name, prior in biases.items():
            self.bias_index[name] = self.size
            self.size += prior.size
        self.with_accel_bias = "accel" in biases
        self.aiding_biases = bool(set(biases) - {"gyro", "accel"})
        self.walk, self.covariance = np.zeros(self.size), np.zeros((self.size, self.size))
        for name, prior in biases.items():
            span = slice(self.bias_index[name], self.bias_index[name] + prior.size)
            self.walk[span] = prior.walk**2
            set_variance(self.covariance, span, prior.sigma**2)


def set_variance(P: Array, span: slice, variance: float | Sequence[float]) -> None:
    """Give states a new variance without any correlation with the others."""
    P[span, :] = 0.0
    P[:, span] = 0.0
    np.fill_diagonal(P[span, span], variance)


def innovation_limits(gate_probability: float) -> Array:
    """Return how large y^T S^-1 y may be, by the number of rows, (DOF_MAX + 1,)."""
    return np.append(0.0, chdtri(np.arange(1, DOF_MAX + 1), 1.0 - gate_probability))
