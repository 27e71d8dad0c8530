"""The error-state EKF of one drone, on filterpy's ExtendedKalmanFilter.

Its states are those of error_state.py. Their mean is zero between gates: what an update finds is moved into the
nominal state.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from numpy.typing import NDArray

from zsim.math.compiled import COMPILES
from zsim_agents.estimation.aiding_models import within_gates
from zsim_agents.estimation.dead_reckoning import write_prediction
from zsim_agents.estimation.error_state import BiasPrior, ErrorState, ProcessNoise, innovation_limits, set_variance
from zsim_agents.estimation.kalman_update import ROWS_MAX, predicted_covariance, stacked_update
from zsim_agents.estimation.strapdown import Interval, Strapdown

Array = NDArray[np.float64]

_NO_BLOCKS = np.zeros((0, 2), dtype=np.int64)


class Stack:
    """Measurements of one gate, to be judged and used together; H is filled from outside, row by row.

    Args:
        size: of the error state.
    """

    def __init__(self, size: int) -> None:
        self.H = np.zeros((ROWS_MAX, size))
        self.z: list[float] = []
        self.predicted: list[float] = []
        self.variance: list[float] = []
        self.blocks: list[tuple[int, int]] = []
        """First row and number of rows of each measurement."""
        self.rows = 0

    def clear(self) -> None:
        """Forget all measurements."""
        self.H[: self.rows] = 0.0
        for part in (self.z, self.predicted, self.variance, self.blocks):
            part.clear()
        self.rows = 0

    def has_room(self, rows: int) -> bool:
        """Whether a measurement of that many rows still fits."""
        return self.rows + rows <= ROWS_MAX

    def add(self, z: Sequence[float], predicted: Sequence[float], variance: Sequence[float]) -> None:
        """Add a measurement whose rows of H, from `rows` on, have been written.

        Args:
            z: what was measured.
            predicted: what the nominal state predicts.
            variance: of the white noise of each row.
        """
        self.z.extend(z)
        self.predicted.extend(predicted)
        self.variance.extend(variance)
        self.blocks.append((self.rows, len(z)))
        self.rows += len(z)

    def arrays(self) -> tuple[Array, Array, Array]:
        """Return the innovations (m,), H (m, n) and the variances (m,)."""
        return np.array(self.z) - self.predicted, self.H[: self.rows], np.array(self.variance)


class NavigationFilter(ExtendedKalmanFilter):
    """Covariance of the error state, its growth, and stacked updates with an innovation gate per sensor.

    Args:
        noise: process noise.
        biases: the channels with a bias, in the order of the state: `gyro` first, `accel` next if present.
        gate_probability: probability with which a good measurement passes, per sensor and sample.
    """

    def __init__(self, noise: ProcessNoise, biases: dict[str, BiasPrior], gate_probability: float) -> None:
        states = ErrorState(biases)
        super().__init__(states.size, ROWS_MAX)
        self.noise = noise
        self.x = np.zeros(states.size)
        self.P = states.covariance
        self.Q = np.zeros((states.size, states.size))
        self.bias_index = states.bias_index
        self.with_accel_bias = states.with_accel_bias
        self.aiding_biases = states.aiding_biases
        self._zero = np.zeros(states.size)
        self._walk = states.walk
        self._all = np.arange(states.size)
        self._distances = np.zeros(ROWS_MAX)
        self._blocks: dict[tuple[tuple[int, int], ...], NDArray[np.int64]] = {}
        self._limits = innovation_limits(gate_probability)

    def set_variance(self, span: slice, variance: float | Sequence[float]) -> None:
        """Give states a new variance without any correlation with the others."""
        set_variance(self.P, span, variance)

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
        if COMPILES:
            self.P = predicted_covariance(self.P, self.F, self.Q)
        else:
            self.predict()

    def correct(self, stack: Stack) -> list[bool]:
        """Use the measurements of a stack; the error found is in `x` until `take_error`.

        All are tried together; those whose own innovation lies outside of its gate are then left out.

        Returns:
            For each block whether it was used.
        """
        y, H, variance = stack.arrays()
        if self._use(y, H, variance, self._block_array(stack), self._limits):
            return [True] * len(stack.blocks)
        passed = [
            bool(distance <= self._limits[size])
            for distance, (_, size) in zip(self._distances, stack.blocks, strict=False)
        ]
        used = [block for block, good in zip(stack.blocks, passed, strict=True) if good]
        kept = [row for first, size in used for row in range(first, first + size)]
        if kept:
            self._use(y[kept], H[kept], variance[kept], _NO_BLOCKS, self._limits)
        return passed

    def _use(self, y: Array, H: Array, variance: Array, blocks: NDArray[np.int64], limits: Array) -> bool:
        """Judge and use innovations: compiled, or by filterpy's own update where nothing can be compiled."""
        if COMPILES:
            used, x, P, S = stacked_update(self.P, H, variance, y, blocks, limits, self._distances)
            self.y, self.S = y, S
            if used:
                self.x, self.P = x, P
            return used
        before = self.P
        self.update(y, lambda x: H, lambda x: 0.0, np.diag(variance))
        if within_gates(self.S, self.y, blocks, limits, self._distances):
            return True
        self.x, self.P = self._zero, before
        return False

    def _block_array(self, stack: Stack) -> NDArray[np.int64]:
        """Return the stack's blocks as an array; few patterns occur, so each is made once."""
        pattern = tuple(stack.blocks)
        if pattern not in self._blocks:
            self._blocks[pattern] = np.array(pattern)
        return self._blocks[pattern]

    def take_error(self) -> Array:
        """Return the mean of the error state, for the nominal state, and set it to zero."""
        error, self.x = self.x, self._zero
        return error
