"""The figures of a sweep: the runs at each point of the grid, with their mean and its confidence interval.

Sections of this file: figures; one quantity in a panel; means and their intervals; the x axis of a grid.
"""

import re
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator
from msgspec import Struct

from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.reading.shortfall import span_text
from zsim_analysis.report import figure_style as style
from zsim_analysis.sweep.design import Grid, SweepDesign
from zsim_analysis.sweep.sweep_summary import (
    LEVEL,
    RUNS_MIN,
    SEPARATION,
    ConfidenceInterval,
    Samples,
    SweepResults,
    count_text,
    field_name,
    finite,
    mean_interval,
    share_interval,
)

PANELS_MAX = 24  # maximum number of quantities in one figure; enough for a formation of 6 drones
COLUMNS = 3  # columns of panels
NARROW_MAX = 8  # maximum number of points side by side in a panel one third of the page wide
SLICES = 6  # number of groups of runs, sorted by a randomly drawn value, each with its own mean
LEGEND_COLUMNS = 4
ONE_RUN, BEYOND_AXIS, TABLE_I = "one run", "the interval goes beyond the axis", "the paper's Table I"
NEVER_AS_PLANNED = "no run as planned"
SHARES = (
    ("ended well", "o", style.GREEN),
    ("of these, as planned", "D", style.BLUE),
    ("of these, without collision", "s", style.BLACK),
)
LEVEL_LETTERS, UPRIGHT_LETTERS = 28, 25  # characters of size PAPER_PT that fit the width and height of a narrow panel
FORMULA = re.compile(r"\$[^$]*\$")


class Panel(Struct, frozen=True):
    """A quantity shown in a panel: its column, its label with unit, and the value printed in the paper."""

    column: str
    label: str
    printed: float | None = None


def figures(results: SweepResults) -> Iterator[style.ReportFigure]:
    """Yield the figures for which there are data, with one panel per quantity."""
    own = [Panel(column, str(field_name(column))) for column in results.metrics[:PANELS_MAX]]
    rms, std = list[Panel](), list[Panel]()
    for prefix, each in list(results.parameters.items())[:PANELS_MAX]:
        symbol = style.label(each.name).rpartition(" (")[0]
        in_truth, estimated = f"RMS of the true error\nof {symbol}", f"std of the error of {symbol}\nas estimated"
        rms.append(Panel(f"{prefix}.true_rms", each.labelled(f"{in_truth} ({unit(each.name)})")))
        printed = results.paper_std.get(each.name)
        std.append(Panel(f"{prefix}.est_std", each.labelled(f"{estimated} ({unit(each.name)})"), printed))
    own, rms, std = (
        [panel for panel in panels if len(finite(results.planned_values(panel.column)))] for panels in (own, rms, std)
    )
    windows_s = results.windows_s()
    window = f" ({span_text(windows_s)})" if windows_s else ""
    hint = ""
    if results.design.points > POINTS_MAX and not GridAxis(results.design).field:
        hint = f" The first {POINTS_MAX} points are shown; the tables contain all of them."
    comparison = ", compared with the paper" if results.paper_std else ""
    for name, title, caption, panels in (
        ("metrics", "Your own metrics", f"What {results.metrics_function} returned for each run.", own),
        ("true_rms", "How well the formation was flown", f"RMS of truth − desired within the window{window}.", rms),
        (
            "est_std",
            f"Standard deviations as the controller sees them{comparison}",
            f"Standard deviation of estimate − desired within the window{window}.",
            std,
        ),
    ):
        if panels:
            yield style.ReportFigure(f"{name}.png", title, f"{caption}{hint}", _draw_panels(results, panels))
    yield style.ReportFigure(
        "safety.png",
        "How the runs ended, and how close the drones came to each other",
        "(a) Share of runs that ended well and, of these, shares flown as planned and without a collision "
        f"or crash, with exact intervals. (b) Minimum true distance between two drones in the air.{hint}",
        _draw_safety(results),
    )
    for i, path in enumerate(results.drawn if own or rms else ()):
        yield style.ReportFigure(
            f"drawn_{i + 1}.png",
            f"Against {field_name(path)}",
            f"Each quantity against the drawn value; means of {SLICES} slices with equal numbers of runs.",
            _draw_slices(results, path, [*own, *rms]),
        )


def _draw_panels(results: SweepResults, panels: Sequence[Panel]) -> Figure:
    axis = GridAxis(results.design) if results.design.points > 1 else None
    across = COLUMNS if not axis or axis.field or results.design.points <= NARROW_MAX else COLUMNS - 1
    across = min(across, len(panels))
    figure, grid = _panel_grid(len(panels), across, 2.0 if axis and axis.is_turned else 1.8)
    beyond = [draw_distribution(axes, results, panel, axis) for axes, panel in zip(grid, panels, strict=True)]
    paper = any(panel.printed is not None for panel in panels)
    _add_legend(figure, grid[0], results, axis, any(beyond), paper)
    return figure


def _panel_grid(count: int, across: int, row_in: float) -> tuple[Figure, Any]:
    rows = -(-count // across)
    figure = style.new_figure(style.PAGE_IN if across > 1 else style.COLUMN_IN, 0.8 + rows * row_in)
    grid = figure.subplots(rows, across, squeeze=False).ravel()
    style.letter_panels(grid[:count])
    for axes in grid[count:]:
        axes.set_visible(False)
    return figure, grid[:count]


def _draw_safety(results: SweepResults) -> Figure:
    """Draw the shares of runs that ended well, and the minimum separations if there are any."""
    axis = GridAxis(results.design) if results.design.points > 1 else None
    has_separations = len(finite(results.planned_values(SEPARATION))) > 0
    figure = style.new_figure(style.PAGE_IN if has_separations else style.COLUMN_IN, 3.0)
    axes, *separation_axes = figure.subplots(1, 1 + has_separations, squeeze=False).ravel()
    style.dress(axes, "share of runs")
    positions = axis.positions if axis else {0: PointPosition(0.0, (-0.12, 0.12))}
    counts = (results.ended_well, partial(results.count, "as_planned"), results.without_collision)
    for side, ((name, mark, share_colour), count_of) in enumerate(zip(SHARES, counts, strict=True), -1):
        for point, position in positions.items():
            tint = axis.colour(position) if axis and len(axis.series) > 1 else share_colour
            count, total = count_of(point)
            if total:
                share = share_interval(count, total)
                ends = [[share.value - share.low], [share.high - share.value]]
                x = position.x + 0.5 * side * (position.room[1] - position.room[0])
                look: dict[str, Any] = {"color": tint, "mfc": "white" if side >= 0 else tint}
                axes.errorbar([x], [share.value], yerr=ends, fmt=mark, ms=5, lw=1.4, capsize=4, **look)
        colour = style.GREY if axis and len(axis.series) > 1 else share_colour  # colours then distinguish the series
        axes.plot([], [], mark, color=colour, mfc="white" if side >= 0 else colour, ms=5, label=name)
    axes.set_ylim(-0.03, 1.03)
    if axis:
        axis.dress(axes)
        axis.mark(axes, results.never_as_planned())
    else:
        axes.set_xticks([])
        axes.set_xlim(-0.8, 0.8)
    separation = Panel(SEPARATION, "least separation (m)")
    beyond = any(draw_distribution(each, results, separation, axis) for each in separation_axes)
    style.letter_panels([axes, *separation_axes])
    _add_legend(figure, axes, results, axis, beyond, means=has_separations)
    return figure


def _add_legend(
    figure: Figure,
    axes: Axes,
    results: SweepResults,
    axis: "GridAxis | None",
    beyond: bool,
    paper: bool = False,
    means: bool = True,
) -> None:
    """Add the legend of dots, means, boxes, marks and colours above a figure."""
    mean = style.VERMILION if not axis or len(axis.series) == 1 else style.GREY
    if axis and means and most_runs(results) == 1:
        axes.plot([], [], "o", color=mean, ms=4, label=ONE_RUN)
    elif axis and means:
        axes.plot(
            [], [], ".", color=style.BLUE if len(axis.series) == 1 else style.GREY, ms=7, alpha=0.6, label=ONE_RUN
        )
        if not axis.field:
            axes.plot([], [], "s", color="#0072b226", mec=style.BLUE, ms=8, label="quartiles and median")
        axes.errorbar([], [], yerr=[], fmt="o", ms=4, lw=1.4, capsize=3, color=mean, label=mean_label(results))
    elif means:
        axes.plot([], [], "s", color="#d55e0066", ms=8, label=mean_label(results))
    if beyond:
        axes.plot([], [], "^", color=mean, ms=7, mec="white", mew=0.6, label=BEYOND_AXIS)
    never = results.never_as_planned()
    if never and axis:
        axes.plot([], [], "x", color=MARK, ms=6, mew=1.6, label=NEVER_AS_PLANNED)
    if paper:
        axes.plot([], [], color=style.AMBER, ls="--", lw=1.2, label=TABLE_I)
    if axis and len(axis.series) > 1:
        for position in {position.series: position for position in axis.positions.values()}.values():
            axes.plot([], [], color=axis.colour(position), lw=3, label=axis.series[position.series])
    style.legend_above(figure, axes, LEGEND_COLUMNS)
    if never and not axis:
        style.mark_figure(figure, NEVER_AS_PLANNED, "", MARK)  # no run followed its plan


def most_runs(results: SweepResults) -> int:
    """Return the largest number of runs of one point that ended well."""
    return max((results.ended_well(point)[0] for point in range(results.design.points)), default=0)


def mean_label(results: SweepResults) -> str:
    """Return the legend entry of the means, with the number of runs (called seeds if only these vary)."""
    counts = {results.ended_well(point)[0] for point in range(results.design.points)} - {0}
    count_range = " to ".join(f"{count}" for count in sorted({min(counts), max(counts)})) if counts else "no"
    noun = "runs" if results.drawn or not results.has_seeds else "seeds"
    statistic = f"mean and {100 * LEVEL:g} % interval" if max(counts, default=0) >= RUNS_MIN else "mean"
    return f"{statistic} of {count_range} {noun[:-1] if counts == {1} else noun}"


def _draw_slices(results: SweepResults, path: str, panels: Sequence[Panel]) -> Figure:
    """Draw each quantity against a randomly drawn value, with the mean of each slice of runs."""
    figure, grid = _panel_grid(len(panels), COLUMNS, 1.8)
    x, beyond = results.values(path), False
    for axes, panel in zip(grid, panels, strict=True):
        style.dress(axes, wrapped(panel.label, UPRIGHT_LETTERS))
        axes.set_xlabel(wrapped(str(field_name(path)), LEVEL_LETTERS), fontsize=style.PAPER_PT)
        y = results.planned_values(panel.column)
        axes.plot(x, y, ".", color=style.BLUE, ms=4, alpha=0.45, mew=0, zorder=2, clip_on=False)
        means = [DrawnMean(middle, mean_interval(samples)) for middle, samples in slices(x, y)]
        for each in means:
            each.draw(axes)
        style.scale(axes, finite(y), pad=MEAN_ROOM)
        beyond |= mark_beyond(axes, means)
    grid[0].plot([], [], ".", color=style.BLUE, ms=7, alpha=0.6, label=ONE_RUN)
    slice_label = f"mean and {100 * LEVEL:g} % interval of a slice"
    grid[0].errorbar([], [], yerr=[], fmt="o", ms=4, lw=1.4, capsize=3, color=style.VERMILION, label=slice_label)
    if beyond:
        grid[0].plot([], [], "^", color=style.VERMILION, ms=7, mec="white", mew=0.6, label=BEYOND_AXIS)
    style.legend_above(figure, grid[0], LEGEND_COLUMNS)
    if len(results.never_as_planned()) == results.design.points:
        style.mark_figure(figure, NEVER_AS_PLANNED, "", MARK)
    return figure


def slices(x: Samples, y: Samples) -> Sequence[tuple[float, Samples]]:
    """Sort runs by x into SLICES groups of nearly equal size; return mean x and all y of each group of two or more."""
    is_finite = np.isfinite(x) & np.isfinite(y)
    order = np.argsort(x[is_finite], kind="stable")
    groups = [part for part in np.array_split(order, SLICES) if len(part) >= 2]
    return [(float(x[is_finite][part].mean()), y[is_finite][part]) for part in groups]


def wrapped(text: str, letters: int) -> str:
    """Wrap a label between words into lines of at most `letters` characters; a formula counts as two."""
    lines: list[str] = []
    for each in text.split("\n"):
        line = ""
        for word in each.split():
            candidate = f"{line} {word}".strip()
            if line and len(FORMULA.sub("xx", candidate)) > letters:
                lines.append(line)
                line = word
            else:
                line = candidate
        lines.append(line)
    return "\n".join(lines)


# One quantity in a panel

DOTS_MAX = 400  # maximum number of runs of a point that are drawn individually
BINS = (5, 30)  # minimum and maximum number of bins in a histogram
GOLDEN = 0.6180339887  # fractional part of the golden ratio; its multiples modulo 1 spread dots evenly and reproducibly


def draw_distribution(axes: Axes, results: SweepResults, panel: Panel, axis: "GridAxis | None") -> bool:
    """Draw one quantity at all points, or its histogram if `axis` is None; return whether an interval is cut off."""
    if axis is None:
        style.dress(axes)
        axes.set_xlabel(wrapped(panel.label, LEVEL_LETTERS), fontsize=style.PAPER_PT)
        samples = finite(results.planned_values(panel.column))
        count = count_text(len(samples), results.ended_well(0)[0])
        axes.text(0.98, 0.9, count, transform=axes.transAxes, ha="right", fontsize=style.PAPER_PT - 1, zorder=6)
        return _draw_histogram(axes, samples, panel.printed)
    style.dress(axes, wrapped(panel.label, UPRIGHT_LETTERS))
    drawn_means: list[tuple[PointPosition, DrawnMean]] = []
    for point, position in axis.positions.items():
        if len(samples := finite(results.planned_values(panel.column, point))):
            mean = _draw_point(axes, samples, position, axis)
            drawn_means.append((position, mean))
            if count := count_text(len(samples), results.ended_well(point)[0]):
                look: dict[str, Any] = {"fontsize": style.PAPER_PT - 1, "color": mean.colour, "zorder": 6}
                offset: dict[str, Any] = {"xytext": (0, 7), "textcoords": "offset points", "ha": "center"}
                axes.annotate(count, (mean.x, mean.mean.value), **look, **offset)
    for series in range(len(axis.series) if axis.field else 0):  # one line per combination of the other fields
        series_means = sorted(
            (each for position, each in drawn_means if position.series == series), key=lambda each: each.x
        )
        if series_means:
            values = [each.mean.value for each in series_means]
            axes.plot(
                [each.x for each in series_means], values, color=series_means[0].colour, lw=1.0, alpha=0.7, zorder=4
            )
    axis.dress(axes)
    axis.mark(axes, results.never_as_planned())
    style.scale(axes, finite(results.planned_values(panel.column)), pad=MEAN_ROOM)
    if panel.printed is not None:
        low, high = axes.get_ylim()
        axes.set_ylim(*_with_printed(low, high, panel.printed))
        axes.axhline(panel.printed, color=style.AMBER, ls="--", lw=1.2, zorder=4)
    return mark_beyond(axes, [mean for _, mean in drawn_means])


def _draw_histogram(axes: Axes, samples: Samples, printed: float | None) -> bool:
    axes.set_ylabel("runs", fontsize=style.PAPER_PT)
    bins = int(np.clip(len(np.histogram_bin_edges(samples, "auto")) - 1, *BINS))
    axes.hist(samples, bins=bins, color=style.BLUE, alpha=0.55, edgecolor="white", lw=0.6, zorder=2)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    mean = mean_interval(samples)
    if np.isfinite(mean.low):
        axes.axvspan(mean.low, mean.high, color=style.VERMILION, alpha=0.25, lw=0, zorder=3)
    axes.axvline(mean.value, lw=1.4, color=style.VERMILION, zorder=5)
    if limits := style.padded_range(samples, MEAN_ROOM):
        axes.set_xlim(limits)
    if printed is not None:
        low, high = axes.get_xlim()
        axes.set_xlim(*_with_printed(low, high, printed))
        axes.axvline(printed, color=style.AMBER, ls="--", lw=1.2, zorder=4)
    return mark_beyond(axes, [DrawnMean(float(np.mean(axes.get_ylim())), mean)], along="x")


def _with_printed(low: float, high: float, value: float) -> tuple[float, float]:
    """Return the limits of an axis, extended to include the paper's value."""
    room = 0.05 * (high - low)
    return min(low, value - room), max(high, value + room)


def _draw_point(axes: Axes, samples: Samples, position: "PointPosition", axis: "GridAxis") -> "DrawnMean":
    """Draw the runs of a point and their mean; return the mean."""
    colour = axis.colour(position)
    if not axis.field and len(samples) > 1:
        line = {"color": style.BLUE, "lw": 1.0}
        box = {"facecolor": "#0072b226", "edgecolor": style.BLUE, "lw": 1.0}
        look: dict[str, Any] = {"boxprops": box, "medianprops": {"color": style.BLUE, "lw": 1.6}}
        look |= {"whiskerprops": line, "capprops": line, "patch_artist": True, "showfliers": False}
        axes.boxplot([samples], positions=[position.x], widths=0.5, zorder=2, manage_ticks=False, **look)
    dots = samples[:: max(1, -(-len(samples) // DOTS_MAX))]
    shares = ((np.arange(len(dots)) + 0.5) * GOLDEN + 0.5 * (1 - GOLDEN)) % 1
    low, high = position.room
    size = 7 if len(dots) < 30 else 4
    if len(samples) > 1:  # a single run is drawn as the mean
        spread = low + shares * (high - low)
        axes.plot(spread, dots, ".", color=colour, ms=size, alpha=0.45, mew=0, zorder=3, clip_on=False)
    mean_x = position.x if axis.field or len(samples) == 1 else position.x + 0.36  # beside the box
    mean = DrawnMean(mean_x, mean_interval(samples), style.VERMILION if len(axis.series) == 1 else colour)
    mean.draw(axes)
    return mean


# Means and their intervals

MEAN_ROOM = 0.08  # margin at each end of an axis, as a share of the samples' range; intervals may exceed it
BEYOND = {"y": ("v", "^"), "x": ("<", ">")}  # marks at the low and the high end of an axis


class DrawnMean(Struct, frozen=True):
    """A mean with its confidence interval, drawn at `x`."""

    x: float
    mean: ConfidenceInterval
    colour: str = style.VERMILION

    def draw(self, axes: Axes) -> None:
        mean = self.mean
        ends = [[mean.value - mean.low], [mean.high - mean.value]] if np.isfinite(mean.low) else None
        axes.errorbar([self.x], [mean.value], yerr=ends, fmt="o", ms=4, lw=1.4, capsize=3, color=self.colour, zorder=5)


def mark_beyond(axes: Axes, means: Sequence[DrawnMean], along: Literal["x", "y"] = "y") -> bool:
    """Mark intervals that extend beyond the ends of an axis; return whether any does."""
    low, high = axes.get_xlim() if along == "x" else axes.get_ylim()
    is_any_beyond = False
    for each in means:
        beyond = ((each.mean.low < low, low), (each.mean.high > high, high))
        for (is_beyond, end), mark in zip(beyond, BEYOND[along], strict=True):
            if is_beyond:
                x, y = (end, each.x) if along == "x" else (each.x, end)
                axes.plot([x], [y], mark, color=each.colour, ms=7, mec="white", mew=0.6, clip_on=False, zorder=7)
                is_any_beyond = True
    return is_any_beyond


# The x axis of a grid

POINTS_MAX = 24  # maximum number of points side by side in one panel; the tables contain all of them
# colours of the combinations of those fields that are not on the axis
SERIES = (style.BLUE, style.GREEN, style.PURPLE, style.ORANGE, style.SKY, style.BLACK)
DECADES_MIN = 30.0  # smallest ratio of the largest to the smallest value for a logarithmic axis
LABELS_LENGTH_MAX = 34  # maximum length of all labels together, with a space each, that fits side by side in a panel
MARK_HEIGHT = 1.1  # height of the marks drawn above runs and intervals, as a share of the axes' height
MARK = style.VERMILION
GROUP_MAX = 0.3  # largest share of the axis range for the combinations at one value; leaves room for six marks
TICKS_MAX = 8  # maximum number of labelled values on an axis; if there are more values, only every n-th is labelled


class PointPosition(Struct, frozen=True):
    """The position at which a point of the grid is drawn."""

    x: float  # centre of the point
    room: tuple[float, float]  # range of x over which its runs are spread
    series: int = 0  # index of its combination of the other fields


class GridAxis:
    """The x axis of a sweep over several points: numeric values to scale, all others side by side.

    Attributes:
        field: path of the field on the axis; None if the points are side by side.
        series: labels of the combinations of the other fields; [""] if there are no other fields.
        positions: position of each point, by its number.
    """

    def __init__(self, design: SweepDesign) -> None:
        self._paths = list(design.point_values(0))
        self._names = [design.names(point) for point in range(design.points)]
        self.field, self._is_logarithmic = None, False
        self._numbers: list[float] = []
        self.series = [""]
        self.positions: dict[int, PointPosition] = {}
        grids = [axis for axis in design.axes if isinstance(axis, Grid) and len(axis.values) > 1]
        numeric = [grid for grid in grids if all(type(value) in (int, float) for value in grid.values)]
        longest = max(numeric, key=lambda grid: len(grid.values), default=None)
        if longest and design.points <= len(longest.values) * len(SERIES):
            self._place_on_numbers(design, longest.path)
        else:
            for point in range(min(design.points, POINTS_MAX)):
                self.positions[point] = PointPosition(float(point), (point - 0.18, point + 0.18))
        self._labels = [" · ".join(names.values()) for names in self._names[:POINTS_MAX]]

    def _place_on_numbers(self, design: SweepDesign, field: str) -> None:
        self.field = field
        self._numbers = [float(design.point_values(point)[field]) for point in range(design.points)]
        values = sorted(set(self._numbers))
        if values[0] > 0 and values[-1] >= DECADES_MIN * values[0]:  # values over several decades, most of them small
            steps = np.diff(values)
            self._is_logarithmic = bool(steps.max() > 2 * steps.min())
        combinations = [
            ", ".join(field_name(path).at(value) for path, value in names.items() if path != field)
            for names in self._names
        ]
        self.series = list(dict.fromkeys(combinations))
        numbers = self._space(np.array(self._numbers))
        distinct = np.unique(numbers)
        width = min(0.6 * float(np.diff(distinct).min()), GROUP_MAX * float(np.ptp(distinct)))
        each = width / len(self.series)
        for point, (number, combination) in enumerate(zip(numbers, combinations, strict=True)):
            series = self.series.index(combination)
            left = number - width / 2 + series * each
            x, low, high = (float(self._value(left + share * each)) for share in (0.5, 0.15, 0.85))
            self.positions[point] = PointPosition(x, (low, high), series)

    def _space(self, values: Any) -> Any:
        return np.log10(values) if self._is_logarithmic else values

    def _value(self, positions: Any) -> Any:
        return 10.0**positions if self._is_logarithmic else positions

    def colour(self, position: PointPosition) -> str:
        return SERIES[position.series]

    @property
    def is_turned(self) -> bool:
        """Whether the labels are too long to fit side by side."""
        return not self.field and sum(len(text) + 1 for text in self._labels) > LABELS_LENGTH_MAX

    def mark(self, axes: Axes, points: Sequence[int]) -> None:
        look: dict[str, Any] = {"color": MARK, "ms": 6, "mew": 1.6, "clip_on": False}
        for position in (self.positions[point] for point in points if point in self.positions):
            axes.plot([position.x], [MARK_HEIGHT], "x", transform=axes.get_xaxis_transform(), **look)

    def dress(self, axes: Axes) -> None:
        if self.field:
            names = dict(zip(self._numbers, (each[self.field] for each in self._names), strict=True))
            if self._is_logarithmic:
                axes.set_xscale("log")
                axes.xaxis.set_minor_locator(NullLocator())
            ticks = sorted(names)[:: -(-len(names) // TICKS_MAX)]
            axes.set_xticks(ticks, [names[tick] for tick in ticks])
            rooms = [end for position in self.positions.values() for end in position.room]
            low, high = (float(self._space(np.array(end))) for end in (min(rooms), max(rooms)))
            axes.set_xlim(*(float(self._value(end)) for end in (low - 0.03 * (high - low), high + 0.03 * (high - low))))
        else:
            turned = self.is_turned
            look: dict[str, Any] = {"rotation": 45, "ha": "right"} if turned else {"rotation": 0, "ha": "center"}
            axes.set_xticks(range(len(self.positions)), self._labels, **look)
            axes.grid(False, axis="x")
            axes.set_xlim(-0.6, len(self.positions) - 0.2)
            axes.tick_params(axis="x", labelsize=style.PAPER_PT - 1.5 if turned else style.PAPER_PT - 1)
        names = [self.field] if self.field else self._paths
        axes.set_xlabel(
            wrapped(" · ".join(str(field_name(path)) for path in names), LEVEL_LETTERS), fontsize=style.PAPER_PT
        )
