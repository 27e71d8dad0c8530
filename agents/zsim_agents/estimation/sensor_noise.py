"""What a scenario's error model means for a filter."""

from __future__ import annotations

import math

from zsim.scenario.scenario import ErrorModel


def white_sigma(error: ErrorModel, rate_hz: float) -> float:
    """Return the standard deviation of the white part per sample, in the channel's unit.

    Noise, density * sqrt(rate) and the converter's rounding (uniform: quantum^2/12) in quadrature.
    """
    return math.sqrt(error.noise**2 + error.density**2 * rate_hz + error.quantum**2 / 12.0)


def has_bias(error: ErrorModel) -> bool:
    """Whether a filter must carry the channel's bias as a state."""
    return error.bias > 0.0 or error.bias_walk > 0.0
