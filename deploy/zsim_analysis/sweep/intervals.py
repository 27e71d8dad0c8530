"""Confidence intervals of means and of shares. Pure."""

import math

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray
from scipy.special import betaincinv, stdtrit

LEVEL = 0.95  # of all intervals of a report
RUNS_MIN = 5  # chosen: of two runs Student's interval is nine times as wide as their distance; fewer are shown singly


class ConfidenceInterval(Struct, frozen=True):
    """A value with the ends of its confidence interval; NaN ends where too few samples show no spread."""

    value: float
    low: float
    high: float


def mean_interval(samples: NDArray[np.float64], level: float = LEVEL) -> ConfidenceInterval:
    """Return the mean of samples (n,) with Student's interval: mean ± t(n − 1) s / √n; none below RUNS_MIN samples.

    It holds for normal samples, and for others by the central limit theorem as n grows.
    """
    n = len(samples)
    middle = float(np.mean(samples)) if n else math.nan
    if n < RUNS_MIN:
        return ConfidenceInterval(middle, math.nan, math.nan)
    half = float(stdtrit(n - 1, (1 + level) / 2) * np.std(samples, ddof=1) / math.sqrt(n))
    return ConfidenceInterval(middle, middle - half, middle + half)


def share_interval(count: int, of: int, level: float = LEVEL) -> ConfidenceInterval:
    """Return count / of with the exact interval of Clopper and Pearson (Biometrika 26, 1934); of > 0.

    It covers the true share at least as often as `level` says, whatever the share and the number of runs.
    """
    tail = (1 - level) / 2
    low = float(betaincinv(count, of - count + 1, tail)) if count else 0.0
    high = float(betaincinv(count + 1, of - count, 1 - tail)) if count < of else 1.0
    return ConfidenceInterval(count / of, low, high)
