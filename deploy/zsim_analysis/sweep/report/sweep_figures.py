"""The figures of a sweep: the runs of each point of the grid, with the mean's confidence interval upon them."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from zsim_analysis.reading.window_text import span_text
from zsim_analysis.report.figures.figure_mark import mark_figure
from zsim_analysis.report.pages import (
    BLACK,
    BLUE,
    COLUMN_IN,
    GREEN,
    GREY,
    PAGE_IN,
    PAPER_PT,
    VERMILION,
    ReportFigure,
    dress,
    label,
    legend_above,
    letter_panels,
    new_figure,
)
from zsim_analysis.sweep.intervals import LEVEL, RUNS_MIN, mean_interval, share_interval
from zsim_analysis.sweep.points import SweepResults
from zsim_analysis.sweep.report.distributions import PAPER, Panel, Samples, draw_distribution, known
from zsim_analysis.sweep.report.field_names import field_name
from zsim_analysis.sweep.report.grid_axis import MARK, POINTS_MAX, GridAxis, Place
from zsim_analysis.sweep.report.intervals_drawn import DrawnInterval, mark_beyond, scale_to_samples
from zsim_analysis.sweep.report.labels import LEVEL_LETTERS, UPRIGHT_LETTERS, wrapped
from zsim_analysis.sweep.sweep_summary import FormationParameter

PANELS_MAX = 24  # quantities in one figure; 6 drones
COLUMNS = 3  # of panels
NARROW_MAX = 8  # points side by side in a panel of a third of the page
SLICES = 6  # of a drawn value's range, each with a mean of its own
LEGEND_COLUMNS = 4
ONE_RUN, BEYOND_AXIS, TABLE_I = "one run", "the interval goes beyond the axis", "the paper's Table I"
NEVER_AS_PLANNED = "no run as planned"
SHARES = (("ended well", "o", GREEN), ("of these, as planned", "D", BLUE), ("of these, without collision", "s", BLACK))


def figures(results: SweepResults) -> Iterator[ReportFigure]:
    """Yield the figures that the runs have data for, with a panel for each quantity that they have."""
    parameters = dict(list(results.parameters().items())[:PANELS_MAX])
    rms, std, own = (
        [panel for panel in panels if len(known(results.flown(panel.column)))]
        for panels in (rms_panels(parameters), std_panels(parameters, results.paper_std), metric_panels(results))
    )
    if own:
        yield ReportFigure(
            "metrics.png",
            "Figures of the user's own",
            f"What {results.metrics_function} returned of each run." + _legend(results),
            _panels(results, own),
        )
    if rms:
        yield ReportFigure(
            "true_rms.png",
            "How well the formation was flown",
            f"RMS of truth − desired within the window{_window(results)}." + _legend(results),
            _panels(results, rms),
        )
    if std:
        yield ReportFigure(
            "est_std.png",
            f"Standard deviations as the controller sees them{', beside the paper' * bool(results.paper_std)}",
            f"Standard deviation of estimate − desired within the window{_window(results)}." + _legend(results),
            _panels(results, std),
        )
    yield ReportFigure(
        "safety.png",
        "How the runs ended, and how near the drones came to each other",
        "(a) Share of runs that ended well, and of those flown as planned and without a collision, "
        "with exact intervals. "
        "(b) Least true distance of two drones in the air." + _legend(results),
        _safety(results),
    )
    panels = [*own, *rms]
    for i, path in enumerate(results.drawn):
        if panels:
            yield ReportFigure(
                f"drawn_{i + 1}.png",
                f"Against {field_name(path)}",
                f"Each quantity over the value that was drawn; means of {SLICES} slices with as many runs each.",
                _scatter(results, path, panels),
            )


def rms_panels(parameters: Mapping[str, FormationParameter]) -> list[Panel]:
    """Return a panel for the true RMS error of each parameter."""
    return [
        Panel(f"{prefix}.true_rms", each.labelled(f"RMS error of {_symbol(each)}\nin truth ({each.unit})"))
        for prefix, each in parameters.items()
    ]


def std_panels(parameters: Mapping[str, FormationParameter], printed: Mapping[str, float]) -> list[Panel]:
    """Return a panel for the estimated standard deviation of each parameter."""
    return [
        Panel(
            f"{prefix}.est_std",
            each.labelled(f"std of the error of {_symbol(each)}\nas estimated ({each.unit})"),
            printed.get(each.name),
        )
        for prefix, each in parameters.items()
    ]


def metric_panels(results: SweepResults) -> list[Panel]:
    """Return a panel for each figure of the user's own."""
    return [Panel(column, str(field_name(column))) for column in results.metrics[:PANELS_MAX]]


def _symbol(parameter: FormationParameter) -> str:
    return label(parameter.name).rpartition(" (")[0]


def _window(results: SweepResults) -> str:
    windows_s = results.windows_s()
    return f" ({span_text(windows_s)})" if windows_s else ""


def _legend(results: SweepResults) -> str:
    left_out = results.design.points - POINTS_MAX
    if left_out > 0 and not GridAxis(results.design).field:
        return f" The first {POINTS_MAX} points are shown, the tables have all."
    return ""


def mean_label(results: SweepResults) -> str:
    """Return what a mean is of, and of how many runs, called seeds where they alone differ."""
    counts = {results.ended_well(point)[0] for point in range(results.design.points)} - {0}
    many = " to ".join(f"{count}" for count in sorted({min(counts), max(counts)})) if counts else "no"
    what = "runs" if results.drawn or not results.has_seeds else "seeds"
    shown = f"mean and {100 * LEVEL:g} % interval" if max(counts, default=0) >= RUNS_MIN else "mean"
    return f"{shown} of {many} {what[:-1] if counts == {1} else what}"


def _panels(results: SweepResults, panels: Sequence[Panel]) -> Figure:
    """Return the figure of some quantities."""
    axis = GridAxis(results.design) if results.design.points > 1 else None
    across = COLUMNS if not axis or axis.field or results.design.points <= NARROW_MAX else COLUMNS - 1
    across = min(across, len(panels))
    rows = -(-len(panels) // across)
    figure = new_figure(PAGE_IN if across > 1 else COLUMN_IN, 0.8 + rows * (2.0 if axis and axis.is_turned else 1.8))
    grid = figure.subplots(rows, across, squeeze=False).ravel()
    beyond = [draw_distribution(axes, results, panel, axis) for axes, panel in zip(grid, panels, strict=False)]
    letter_panels(grid[: len(panels)])
    for axes in grid[len(panels) :]:
        axes.set_visible(False)
    paper = any(panel.printed is not None for panel in panels)
    _name(figure, grid[0], results, axis, any(beyond), paper)
    return figure


def _name(
    figure: Figure,
    axes: Axes,
    results: SweepResults,
    axis: GridAxis | None,
    beyond: bool,
    paper: bool = False,
    means: bool = True,
) -> None:
    """Put the legend above a figure: what a dot, a mean, a box, a mark and a colour are."""
    mean = VERMILION if not axis or len(axis.series) == 1 else GREY
    if axis and means:
        axes.plot([], [], ".", color=BLUE if len(axis.series) == 1 else GREY, ms=7, alpha=0.6, label=ONE_RUN)
        if not axis.field:
            axes.plot([], [], "s", color="#0072b226", mec=BLUE, ms=8, label="quartiles and median")
        axes.errorbar([], [], yerr=[], fmt="o", ms=4, lw=1.4, capsize=3, color=mean, label=mean_label(results))
    elif means:
        axes.plot([], [], "s", color="#d55e0066", ms=8, label=mean_label(results))
    if beyond:
        axes.plot([], [], "^", color=mean, ms=7, mec="white", mew=0.6, label=BEYOND_AXIS)
    never = results.never_as_planned()
    if never and axis:
        axes.plot([], [], "x", color=MARK, ms=6, mew=1.6, label=NEVER_AS_PLANNED)
    if paper:
        axes.plot([], [], color=PAPER, ls="--", lw=1.2, label=TABLE_I)
    if axis and len(axis.series) > 1:
        for place in {place.series: place for place in axis.places.values()}.values():
            axes.plot([], [], color=axis.colour(place), lw=3, label=axis.series[place.series])
    legend_above(figure, axes, LEGEND_COLUMNS)
    if never and not axis:
        mark_figure(figure, NEVER_AS_PLANNED, "", MARK)  # all its runs left their plan


def _safety(results: SweepResults) -> Figure:
    axis = GridAxis(results.design) if results.design.points > 1 else None
    panel = Panel("min_separation_m", "least separation (m)")
    panels = [panel] if len(known(results.flown(panel.column))) else []
    figure = new_figure(PAGE_IN if panels else COLUMN_IN, 3.0)
    shares, *others = figure.subplots(1, 1 + len(panels), squeeze=False).ravel()
    _shares(shares, results, axis)
    beyond = [draw_distribution(axes, results, panel, axis) for axes, panel in zip(others, panels, strict=True)]
    letter_panels([shares, *others])
    _name(figure, shares, results, axis, any(beyond), means=bool(panels))
    return figure


def _shares(axes: Axes, results: SweepResults, axis: GridAxis | None) -> None:
    """Draw the shares of the runs of each point that ended well, and of those as planned and without a collision."""
    dress(axes, "share of runs")
    places = axis.places if axis else {0: Place(0.0, (-0.12, 0.12))}
    counts = (results.ended_well, results.as_planned, results.without_collision)
    for side, ((name, mark, own), counted) in enumerate(zip(SHARES, counts, strict=True), -1):
        for point, place in places.items():
            tint = axis.colour(place) if axis and len(axis.series) > 1 else own
            _share(axes, *counted(point), place.x + 0.5 * side * (place.room[1] - place.room[0]), mark, tint)
        axes.plot([], [], mark, color=own, mfc="white" if side >= 0 else own, ms=5, label=name)
    axes.set_ylim(-0.03, 1.03)
    if axis:
        axis.dress(axes)
        axis.mark(axes, results.never_as_planned())
    else:
        axes.set_xticks([])
        axes.set_xlim(-0.8, 0.8)


def _share(axes: Axes, count: int, of: int, x: float, mark: str, colour: str) -> None:
    """Draw a share with its interval; nothing of no runs."""
    if of:
        share = share_interval(count, of)
        ends = [[share.value - share.low], [share.high - share.value]]
        face = colour if mark == SHARES[0][1] else "white"
        axes.errorbar([x], [share.value], yerr=ends, fmt=mark, ms=5, lw=1.4, capsize=4, color=colour, mfc=face)


def _scatter(results: SweepResults, path: str, panels: Sequence[Panel]) -> Figure:
    rows = -(-len(panels) // COLUMNS)
    figure = new_figure(PAGE_IN, 0.8 + 1.8 * rows)
    grid = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
    x = results.values(path)
    beyond = False
    for axes, panel in zip(grid, panels, strict=False):
        dress(axes, wrapped(panel.label, UPRIGHT_LETTERS))
        axes.set_xlabel(wrapped(str(field_name(path)), LEVEL_LETTERS), fontsize=PAPER_PT)
        y = results.flown(panel.column)
        axes.plot(x, y, ".", color=BLUE, ms=4, alpha=0.45, mew=0, zorder=2, clip_on=False)
        intervals = [DrawnInterval(middle, mean_interval(samples)) for middle, samples in slices(x, y)]
        for each in intervals:
            each.draw(axes)
        scale_to_samples(axes, known(y))
        beyond |= mark_beyond(axes, intervals)
    letter_panels(grid[: len(panels)])
    for axes in grid[len(panels) :]:
        axes.set_visible(False)
    grid[0].plot([], [], ".", color=BLUE, ms=7, alpha=0.6, label=ONE_RUN)
    slice_label = f"mean and {100 * LEVEL:g} % interval of a slice"
    grid[0].errorbar([], [], yerr=[], fmt="o", ms=4, lw=1.4, capsize=3, color=VERMILION, label=slice_label)
    if beyond:
        grid[0].plot([], [], "^", color=VERMILION, ms=7, mec="white", mew=0.6, label=BEYOND_AXIS)
    legend_above(figure, grid[0], LEGEND_COLUMNS)
    if len(results.never_as_planned()) == results.design.points:
        mark_figure(figure, NEVER_AS_PLANNED, "", MARK)
    return figure


def slices(x: Samples, y: Samples, count: int = SLICES) -> Sequence[tuple[float, Samples]]:
    """Return the mean x and the y of `count` groups of runs by rising x, as equal in number as can be."""
    both = np.isfinite(x) & np.isfinite(y)
    order = np.argsort(x[both], kind="stable")
    groups = [part for part in np.array_split(order, count) if len(part) >= 2]
    return [(float(x[both][part].mean()), y[both][part]) for part in groups]
