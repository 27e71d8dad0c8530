"""Many lines as one picture: their median, the band that holds nine of ten, and the one that is farthest out."""

import numpy as np
from matplotlib.axes import Axes

from zsim_analysis.reading.recorded_flight import Array

BAND = (5.0, 95.0)  # percentiles
LABELS = ("median", "5 to 95 %", "least and greatest")
INSTANTS = 1000  # at which percentiles are computed


def draw_spread(axes: Axes, t_s: Array, values: Array, colour: str) -> None:
    """Draw lines (K, N) as their spread at every instant; no extreme is lost by leaving instants out.

    Args:
        axes: to draw into.
        t_s: (K,) simulated time.
        values: (K, N), NaN where unknown.
        colour: of the spread.
    """
    known = np.isfinite(values).any(axis=1)
    t_s, values = t_s[known], values[known]
    if not len(t_s):
        return
    low, middle, high, least, greatest = _spread(values, -(-len(t_s) // INSTANTS))
    at = t_s[:: -(-len(t_s) // INSTANTS)]
    axes.fill_between(at, low, high, color=colour, alpha=0.25, lw=0, zorder=2, label=LABELS[1])
    axes.plot(at, middle, color=colour, lw=1.0, zorder=3, label=LABELS[0])
    for k, extreme in enumerate((least, greatest)):
        axes.plot(at, extreme, color=colour, lw=0.4, alpha=0.7, zorder=2, label=None if k else LABELS[2])


def _spread(values: Array, step: int) -> tuple[Array, Array, Array, Array, Array]:
    """Return low, median, high of every step-th instant, and the extremes of all instants up to the next of them."""
    low, middle, high = np.nanpercentile(values[::step], (BAND[0], 50.0, BAND[1]), axis=1)
    starts = np.arange(0, len(values), step)
    least = np.minimum.reduceat(np.nanmin(values, axis=1), starts)
    greatest = np.maximum.reduceat(np.nanmax(values, axis=1), starts)
    return low, middle, high, least, greatest
