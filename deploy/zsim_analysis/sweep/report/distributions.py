"""One quantity of a sweep in a panel: a histogram of one point, else the runs of every point with their mean."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from msgspec import Struct
from numpy.typing import NDArray

from zsim_analysis.report.pages import BLUE, PAPER_PT, VERMILION, dress, padded_range
from zsim_analysis.sweep.intervals import mean_interval
from zsim_analysis.sweep.points import SweepResults
from zsim_analysis.sweep.report.grid_axis import GridAxis, Place
from zsim_analysis.sweep.report.intervals_drawn import (
    ROOM,
    DrawnInterval,
    mark_beyond,
    mark_beyond_level,
    scale_to_samples,
)
from zsim_analysis.sweep.report.labels import LEVEL_LETTERS, UPRIGHT_LETTERS, wrapped
from zsim_analysis.sweep.sweep_summary import count_text

Samples = NDArray[np.float64]

DOTS_MAX = 400  # runs of a point drawn one by one
BINS = (5, 30)  # of a histogram, least and most
GOLDEN = 0.6180339887  # spreads dots evenly without chance: multiples of the golden ratio, modulo 1
PAPER = "#9a6a00"


class Panel(Struct, frozen=True):
    """A quantity in a panel of its own: its column, its full name with its unit, and the paper's value of it."""

    column: str
    label: str
    printed: float | None = None


def draw_distribution(axes: Axes, results: SweepResults, panel: Panel, axis: GridAxis | None) -> bool:
    """Draw one quantity: a histogram where there is one point, else points; return if an interval leaves the axis."""
    if axis is None:
        dress(axes)
        axes.set_xlabel(wrapped(panel.label, LEVEL_LETTERS), fontsize=PAPER_PT)
        samples = known(results.flown(panel.column))
        count = count_text(len(samples), results.ended_well(0)[0])
        axes.text(0.98, 0.9, count, transform=axes.transAxes, ha="right", fontsize=PAPER_PT - 1, zorder=6)
        return _histogram(axes, samples, panel.printed)
    dress(axes, wrapped(panel.label, UPRIGHT_LETTERS))
    drawn = []
    for point, place in axis.places.items():
        if len(samples := known(results.flown(panel.column, point))):
            drawn.append(_draw_point(axes, samples, place, axis))
            _count_beside(axes, drawn[-1][1], count_text(len(samples), results.ended_well(point)[0]))
    if axis.field:
        _join_means(axes, drawn, axis)
    axis.dress(axes)
    axis.mark(axes, results.never_as_planned())
    scale_to_samples(axes, known(results.flown(panel.column)))
    if panel.printed is not None:
        _mark_printed(axes, panel.printed, upright=False)
    return mark_beyond(axes, [interval for _, interval in drawn])


def known(samples: Samples) -> Samples:
    """Return the finite samples."""
    return samples[np.isfinite(samples)]


def _histogram(axes: Axes, samples: Samples, printed: float | None) -> bool:
    axes.set_ylabel("runs", fontsize=PAPER_PT)
    bins = int(np.clip(len(np.histogram_bin_edges(samples, "auto")) - 1, *BINS))
    axes.hist(samples, bins=bins, color=BLUE, alpha=0.55, edgecolor="white", lw=0.6, zorder=2)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    mean = mean_interval(samples)
    if np.isfinite(mean.low):
        axes.axvspan(mean.low, mean.high, color=VERMILION, alpha=0.25, lw=0, zorder=3)
    axes.axvline(mean.value, lw=1.4, color=VERMILION, zorder=5)
    if limits := padded_range(samples, ROOM):
        axes.set_xlim(limits)
    if printed is not None:
        _mark_printed(axes, printed, upright=True)
    return mark_beyond_level(axes, mean)


def _draw_point(axes: Axes, samples: Samples, place: Place, axis: GridAxis) -> tuple[Place, DrawnInterval]:
    """Draw the runs of a point and their mean; return the mean."""
    colour = axis.colour(place)
    if not axis.field:
        _box(axes, samples, place.x)
    dots = samples[:: max(1, -(-len(samples) // DOTS_MAX))]
    shares = ((np.arange(len(dots)) + 0.5) * GOLDEN + 0.5 * (1 - GOLDEN)) % 1
    low, high = place.room
    size = 7 if len(dots) < 30 else 4
    axes.plot(low + shares * (high - low), dots, ".", color=colour, ms=size, alpha=0.45, mew=0, zorder=3, clip_on=False)
    mean_x = place.x if axis.field else place.x + 0.36  # beside the box
    mean_colour = VERMILION if len(axis.series) == 1 else colour
    interval = DrawnInterval(mean_x, mean_interval(samples), mean_colour)
    interval.draw(axes)
    return place, interval


def _count_beside(axes: Axes, interval: DrawnInterval, count: str) -> None:
    """Write at a mean of how many runs it is, where that is less than the legend says."""
    if count:
        at = (interval.x, interval.mean.value)
        offset: dict[str, Any] = {"xytext": (0, 7), "textcoords": "offset points", "ha": "center"}
        axes.annotate(count, at, fontsize=PAPER_PT - 1, color=interval.colour, zorder=6, **offset)


def _join_means(axes: Axes, drawn: Sequence[tuple[Place, DrawnInterval]], axis: GridAxis) -> None:
    """Draw a line from mean to mean along the axis, one for each combination of the other fields."""
    for series in range(len(axis.series)):
        own = sorted((each for place, each in drawn if place.series == series), key=lambda each: each.x)
        if own:
            means = [each.mean.value for each in own]
            axes.plot([each.x for each in own], means, color=own[0].colour, lw=1.0, alpha=0.7, zorder=4)


def _box(axes: Axes, samples: Samples, x: float) -> None:
    axes.boxplot(
        [samples],
        positions=[x],
        widths=0.5,
        showfliers=False,
        patch_artist=True,
        boxprops={"facecolor": "#0072b226", "edgecolor": BLUE, "lw": 1.0},
        medianprops={"color": BLUE, "lw": 1.6},
        whiskerprops={"color": BLUE, "lw": 1.0},
        capprops={"color": BLUE, "lw": 1.0},
        zorder=2,
        manage_ticks=False,
    )


def _mark_printed(axes: Axes, value: float, upright: bool) -> None:
    draw = axes.axvline if upright else axes.axhline
    low, high = axes.get_xlim() if upright else axes.get_ylim()
    room = 0.05 * (high - low)
    set_range = axes.set_xlim if upright else axes.set_ylim
    set_range(min(low, value - room), max(high, value + room))
    draw(value, color=PAPER, ls="--", lw=1.2, zorder=4)
