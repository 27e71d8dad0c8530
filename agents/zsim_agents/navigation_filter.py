"""The error-state EKF of one drone, on filterpy's ExtendedKalmanFilter.

Error state: position (3), velocity (3), small rotation of the attitude (3), all in the world frame, gyroscope
bias (3) in the body frame, accelerometer bias (3) where the drone has one, then the bias of every other channel
that has one. Its mean is zero outside of `correct`: the caller moves what an update found into the nominal state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from scipy.special import chdtri

from zsim_agents.aiding_models import DOF_MAX, write_squared_distances
from zsim_agents.dead_reckoning import GYRO_BIAS, write_prediction
from zsim_agents.strapdown import Interval, Strapdown

ROWS_MAX = 32  # of one stacked update; more measurements of a gate go into a second one


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
    """What drives the error state between measurements; all are spectral densities but the first two."""

    accel_sigma: float
    """White noise of the accelerometer per sample [m/s^2]."""
    gyro_sigma: float
    """White noise of the gyroscope per sample [rad/s]."""
    tilt_density: float
    """What Madgwick's pull adds to the tilt [rad^2/s]."""
    levelling_s: float
    """Time constant of Madgwick's pull [s]."""


class Stack:
    """Measurements of one instant, to be judged and used together; filled from outside, row by row."""

    def __init__(self, size: int) -> None:
        self.H = np.zeros((ROWS_MAX, size))
        self.z = np.zeros(ROWS_MAX)
        self.predicted = np.zeros(ROWS_MAX)
        self.R = np.zeros((ROWS_MAX, ROWS_MAX))
        self.blocks: list[tuple[int, int]] = []
        self.rows = 0

    def clear(self) -> None:
        """Forget all measurements."""
        self.H[: self.rows] = 0.0
        self.blocks.clear()
        self.rows = 0

    def has_room(self, rows: int) -> bool:
        """Whether a measurement of that many rows still fits."""
        return self.rows + rows <= ROWS_MAX

    def add(self, z: Sequence[float], predicted: Sequence[float], variance: Sequence[float]) -> None:
        """Close a block whose rows of H from `rows` on have been written.

        Args:
            z: the measurement.
            predicted: what the nominal state predicts.
            variance: white noise of each row, squared.
        """
        first = self.rows
        last = first + len(z)
        self.z[first:last] = z
        self.predicted[first:last] = predicted
        for row, value in zip(range(first, last), variance, strict=True):
            self.R[row, row] = value
        self.blocks.append((first, last - first))
        self.rows = last


class NavigationFilter(ExtendedKalmanFilter):
    """Covariance of the error state, its growth, and stacked updates with an innovation gate per sensor.

    Args:
        noise: process noise.
        biases: the channels with a bias, in the order of the state; `gyro` comes first, `accel` next if present.
        gate_probability: probability with which a good measurement passes, per sensor and sample.
    """

    def __init__(self, noise: ProcessNoise, biases: dict[str, BiasPrior], gate_probability: float) -> None:
        self.bias_index: dict[str, int] = {}
        size = GYRO_BIAS
        for name, prior in biases.items():
            self.bias_index[name] = size
            size += prior.size
        super().__init__(size, ROWS_MAX)
        self.noise = noise
        self.x = np.zeros(size)
        self.P = np.zeros((size, size))
        self.Q = np.zeros((size, size))
        self._zero = np.zeros(size)
        self._walk = np.zeros(size)
        self._all = np.arange(size)
        self.with_accel_bias = "accel" in biases
        self.aiding_biases = bool(set(biases) - {"gyro", "accel"})
        self.distances: list[float] = []
        """Squared normalised innovation of each block of the last update."""
        self._thresholds = [0.0] + [float(chdtri(dof, 1.0 - gate_probability)) for dof in range(1, DOF_MAX + 1)]
        for name, prior in biases.items():
            span = slice(self.bias_index[name], self.bias_index[name] + prior.size)
            self._walk[span] = prior.walk**2
            self.set_variance(span, prior.sigma**2)

    def set_variance(self, span: slice, variance: float | Sequence[float]) -> None:
        """Give states a new variance without any correlation with the others."""
        self.P[span, :] = 0.0
        self.P[:, span] = 0.0
        self.P[self._all[span], self._all[span]] = variance

    def add_variance(self, span: slice, variance: float | Sequence[float]) -> None:
        """Make states less certain, their correlations kept."""
        self.P[self._all[span], self._all[span]] += variance

    def predict_x(self, u: float = 0) -> None:
        """Leave the mean at zero: the nominal state has moved instead."""

    def advance(self, strapdown: Strapdown, interval: Interval) -> None:
        """Let the covariance grow over an interval of dead reckoning that ends at the nominal state."""
        noise, dt = self.noise, interval.dt
        turn = noise.gyro_sigma**2 * interval.square_s2 + interval.lost_turn
        velocity = noise.accel_sigma**2 * interval.square_s2 + interval.lost_velocity
        write_prediction(
            self.F,
            self.Q,
            self._walk,
            strapdown.state,
            interval.v_before,
            strapdown.gravity,
            noise.levelling_s,
            self.with_accel_bias,
            (velocity, turn + noise.tilt_density * dt, turn),
            dt,
        )
        self.predict()

    def correct(self, stack: Stack) -> list[bool]:
        """Use the measurements of a stack; the error found is in `x` until `take_error`.

        All are tried together; those whose own innovation lies outside of its gate are then taken back.

        Returns:
            For each block whether it was used.
        """
        before = self.P
        self._update(stack, slice(0, stack.rows))
        blocks = stack.blocks
        distances = np.empty(len(blocks))
        write_squared_distances(self.S, self.y, np.array(blocks), distances)
        self.distances = distances.tolist()
        passed = [
            distance <= self._thresholds[size] for distance, (_, size) in zip(self.distances, blocks, strict=True)
        ]
        if not all(passed):
            self.x, self.P = self._zero, before
            used = [block for block, good in zip(blocks, passed, strict=True) if good]
            kept = [row for first, size in used for row in range(first, first + size)]
            if kept:
                self._update(stack, kept)
        return passed

    def _update(self, stack: Stack, rows: slice | list[int]) -> None:
        H = stack.H[rows]
        predicted = stack.predicted[rows]
        R = stack.R[rows, rows] if isinstance(rows, slice) else stack.R[np.ix_(rows, rows)]
        self.update(stack.z[rows], lambda x: H, lambda x: predicted, R)

    def take_error(self) -> np.ndarray:
        """Return the mean of the error state and set it to zero, for the caller to put into the nominal state."""
        error, self.x = self.x, self._zero
        return error
