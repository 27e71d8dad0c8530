"""Means with their confidence intervals in figures; an interval that leaves the axis is marked where it does."""

import numpy as np
from matplotlib.axes import Axes
from msgspec import Struct
from numpy.typing import NDArray

from zsim_analysis.report.pages import VERMILION, padded_range
from zsim_analysis.sweep.intervals import ConfidenceInterval

ROOM = 0.08  # of the range of samples, at each end of an axis
BEYOND = {True: ("v", "^"), False: ("<", ">")}  # marks at the low and the high end of an upright or a level axis


class DrawnInterval(Struct, frozen=True):
    """A mean with its interval as it stands in a figure, at x."""

    x: float
    mean: ConfidenceInterval
    colour: str = VERMILION

    def draw(self, axes: Axes) -> None:
        """Draw the mean, and its interval where it has one."""
        mean = self.mean
        ends = [[mean.value - mean.low], [mean.high - mean.value]] if np.isfinite(mean.low) else None
        axes.errorbar([self.x], [mean.value], yerr=ends, fmt="o", ms=4, lw=1.4, capsize=3, color=self.colour, zorder=5)


def scale_to_samples(axes: Axes, samples: NDArray[np.float64]) -> None:
    """Give a y axis the range of its samples: an interval of two runs may be a hundred times as wide."""
    if limits := padded_range(samples, ROOM):
        axes.set_ylim(limits)


def mark_beyond(axes: Axes, intervals: list[DrawnInterval]) -> bool:
    """Mark at the ends of the y axis which intervals go beyond it; return whether any does."""
    low, high = axes.get_ylim()
    found = False
    for each in intervals:
        ends = ((each.mean.low < low, low, BEYOND[True][0]), (each.mean.high > high, high, BEYOND[True][1]))
        for is_beyond, end, mark in ends:
            if is_beyond:
                _mark(axes, each.x, end, mark, each.colour)
                found = True
    return found


def mark_beyond_level(axes: Axes, mean: ConfidenceInterval) -> bool:
    """Mark at the ends of the x axis that the interval of its one mean goes beyond it; return whether it does."""
    low, high = axes.get_xlim()
    middle = float(np.mean(axes.get_ylim()))
    ends = ((mean.low < low, low, BEYOND[False][0]), (mean.high > high, high, BEYOND[False][1]))
    for is_beyond, end, mark in ends:
        if is_beyond:
            _mark(axes, end, middle, mark, VERMILION)
    return any(is_beyond for is_beyond, _, _ in ends)


def _mark(axes: Axes, x: float, y: float, mark: str, colour: str) -> None:
    axes.plot([x], [y], mark, color=colour, ms=7, mec="white", mew=0.6, clip_on=False, zorder=7)
