"""The figures of a sweep: a distribution per point of the grid, with the mean's confidence interval upon it."""

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from zsim_analysis.report.pages import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    VERMILION,
    ReportFigure,
    dress,
    label,
    legend_above,
    new_figure,
    padded_range,
)
from zsim_analysis.sweep.intervals import LEVEL, mean_interval, share_interval
from zsim_analysis.sweep.points import FormationParameter, SweepResults

Samples = NDArray[np.float64]
ROOM = 0.08  # of the range of samples, at each end of an axis

POINTS_MAX = 24  # beside each other in one panel; the tables have all
PANELS_MAX = 24  # parameters in one figure; 6 drones
COLUMNS = 3  # of panels
NARROW_MAX = 8  # points beside each other in a panel of a third of the page
DOTS_MAX = 400  # runs of a point drawn one by one
BINS = (5, 30)  # of a histogram, least and most
SLICES = 6  # of a drawn value's range, each with a mean of its own
GOLDEN = 0.6180339887  # spreads dots evenly without chance: multiples of the golden ratio, modulo 1
MEAN = {"color": VERMILION, "zorder": 5}
PAPER = "#9a6a00"


def figures(results: SweepResults) -> Iterator[ReportFigure]:
    """Yield the figures that the runs have data for."""
    parameters = dict(list(results.parameters().items())[:PANELS_MAX])
    if parameters:
        yield ReportFigure(
            "true_rms.png",
            "How well the formation was flown",
            f"RMS of truth − desired within the window{_window(results)}, a sample per run." + _legend(results),
            _panels(results, {f"{prefix}.true_rms": each for prefix, each in parameters.items()}, {}),
        )
        yield ReportFigure(
            "est_std.png",
            f"Standard deviations as the controller sees them{', beside the paper' * bool(results.paper_std)}",
            f"Standard deviation of estimate − desired within the window{_window(results)}, a sample per run"
            f"{'; dashed: Table I of the paper' * bool(results.paper_std)}." + _legend(results),
            _panels(results, {f"{prefix}.est_std": each for prefix, each in parameters.items()}, results.paper_std),
        )
    yield ReportFigure(
        "safety.png",
        "How the runs ended, and how near the drones came to each other",
        "Left: share of runs that ended well, and of those without a collision, with exact intervals. "
        "Right: least true distance of two drones in the air." + _legend(results),
        _safety(results),
    )
    for i, path in enumerate(results.drawn):
        if parameters:
            yield ReportFigure(
                f"drawn_{i + 1}.png",
                f"Against {path}",
                f"RMS of truth − desired over the value that was drawn, a dot per run; means of {SLICES} slices with "
                "as many runs each, with their intervals.",
                _scatter(results, path, parameters),
            )


def _window(results: SweepResults) -> str:
    windows_s = results.windows_s()
    return " ({:g} to {:g} s)".format(*windows_s) if windows_s else ""


def _legend(results: SweepResults) -> str:
    level = f"{100 * LEVEL:g} %"
    if results.design.points == 1:
        return f" Orange: mean with its {level} interval."
    left_out = results.design.points - POINTS_MAX
    more = f" The first {POINTS_MAX} points are shown, the tables have all." if left_out > 0 else ""
    return f" Boxes: quartiles and median, whiskers to 1.5 of the box. Orange: mean with its {level} interval.{more}"


def _panels(results: SweepResults, columns: dict[str, FormationParameter], printed: Mapping[str, float]) -> Figure:
    """Return a panel for each column and its parameter."""
    across = COLUMNS if results.design.points <= NARROW_MAX else COLUMNS - 1
    rows = -(-len(columns) // across)
    figure = new_figure(12, 0.8 + rows * (2.7 if _turned(results) else 2.4))
    grid = figure.subplots(rows, across, squeeze=False).ravel()
    for axes, (column, parameter) in zip(grid, columns.items(), strict=False):
        _distribution(axes, results, column, parameter.labelled(label(parameter.name)))
        if parameter.name in printed:
            _mark(axes, printed[parameter.name], results.design.points == 1)
    for axes in grid[len(columns) :]:
        axes.set_visible(False)
    if printed:
        legend_above(figure, grid[0])
    return figure


def _mark(axes: Axes, value: float, upright: bool) -> None:
    draw = axes.axvline if upright else axes.axhline
    low, high = axes.get_xlim() if upright else axes.get_ylim()
    room = 0.05 * (high - low)
    set_range = axes.set_xlim if upright else axes.set_ylim
    set_range(min(low, value - room), max(high, value + room))
    draw(value, color=PAPER, ls="--", lw=1.2, zorder=4, label="the paper's Table I")


def _distribution(axes: Axes, results: SweepResults, column: str, text: str) -> None:
    """Draw one quantity: a histogram where there is one point, boxes side by side where there are several."""
    if results.design.points == 1:
        dress(axes)
        axes.set_xlabel(text, fontsize=10)
        _histogram(axes, _known(results.values(column)))
        return
    dress(axes, text)
    shown = range(min(results.design.points, POINTS_MAX))
    for place in shown:
        _box(axes, _known(results.values(column, place)), place)
    _name_points(axes, results)
    scale_to_samples(axes, _known(results.values(column)))


def scale_to_samples(axes: Axes, samples: Samples) -> None:
    """Give a y axis the range of its samples: an interval of two runs may be a hundred times as wide."""
    if limits := padded_range(samples, ROOM):
        axes.set_ylim(limits)


def _known(samples: Samples) -> Samples:
    return samples[np.isfinite(samples)]


def _histogram(axes: Axes, samples: Samples) -> None:
    axes.set_ylabel("runs", fontsize=10)
    if not len(samples):
        axes.text(0.5, 0.5, "no data", transform=axes.transAxes, ha="center", color=GREY)
        return
    bins = int(np.clip(len(np.histogram_bin_edges(samples, "auto")) - 1, *BINS))
    axes.hist(samples, bins=bins, color=BLUE, alpha=0.55, edgecolor="white", lw=0.6, zorder=2)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    mean = mean_interval(samples)
    if np.isfinite(mean.low):
        axes.axvspan(mean.low, mean.high, color=VERMILION, alpha=0.25, lw=0, zorder=3)
    axes.axvline(mean.value, lw=1.4, **MEAN)
    if limits := padded_range(samples, ROOM):
        axes.set_xlim(limits)


def _box(axes: Axes, samples: Samples, place: int) -> None:
    if not len(samples):
        return
    axes.boxplot(
        [samples],
        positions=[place],
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
    dots = samples[:: max(1, -(-len(samples) // DOTS_MAX))]
    spread = 0.36 * ((np.arange(len(dots)) * GOLDEN) % 1 - 0.5)
    size = 7 if len(dots) < 30 else 4
    axes.plot(place + spread, dots, ".", color=BLUE, ms=size, alpha=0.45, mew=0, zorder=3)
    _bar(axes, place + 0.36, samples)


def _bar(axes: Axes, x: float, samples: Samples) -> None:
    """Draw a mean with its interval."""
    mean = mean_interval(samples)
    ends = [[mean.value - mean.low], [mean.high - mean.value]] if np.isfinite(mean.low) else None
    axes.errorbar([x], [mean.value], yerr=ends, fmt="o", ms=4, lw=1.4, capsize=3, **MEAN)


def _turned(results: SweepResults) -> bool:
    """Return whether the points' labels are too long to stand side by side."""
    shown = range(min(results.design.points, POINTS_MAX))
    return len(shown) > 1 and sum(len(results.label(point)) + 1 for point in shown) > 34


def _name_points(axes: Axes, results: SweepResults) -> None:
    shown = range(min(results.design.points, POINTS_MAX))
    turned = _turned(results)
    axes.set_xticks(
        list(shown),
        [results.label(point) for point in shown],
        rotation=45 if turned else 0,
        ha="right" if turned else "center",
    )
    axes.tick_params(axis="x", labelsize=8 if turned else 9)
    axes.grid(False, axis="x")
    axes.set_xlim(-0.6, len(shown) - 0.2)
    axes.set_xlabel(" · ".join(_short(path) for path in results.design.at(0)), fontsize=9)


def _short(path: str) -> str:
    return path.rpartition(".")[2] or path


def _safety(results: SweepResults) -> Figure:
    figure = new_figure(12, 4.2)
    shares, separation = figure.subplots(1, 2)
    _shares(shares, results)
    _distribution(separation, results, "min_separation_m", "least separation (m)")
    legend_above(figure, shares)
    return figure


def _shares(axes: Axes, results: SweepResults) -> None:
    """Draw the shares of the runs of each point that ended well, and of those that met no other drone."""
    dress(axes, "share of runs")
    shown = range(min(results.design.points, POINTS_MAX))
    of_kind: tuple[tuple[str, str, float, Callable[[int], tuple[int, int]]], ...] = (
        ("ended well", GREEN, -0.12, results.ended_well),
        ("of these, without collision", BLACK, 0.12, results.without_collision),
    )
    for name, colour, offset, counted in of_kind:
        counts = [(place, *counted(place)) for place in shown]
        shares = [(place, share_interval(count, of)) for place, count, of in counts if of]
        x = [place + offset for place, _ in shares]
        y = np.array([each.value for _, each in shares])
        ends = np.array([[each.value - each.low for _, each in shares], [each.high - each.value for _, each in shares]])
        axes.errorbar(x, y, yerr=ends, fmt="o", ms=5, lw=1.4, capsize=4, color=colour, label=name)
    axes.set_ylim(-0.03, 1.03)
    if results.design.points > 1:
        _name_points(axes, results)
    else:
        axes.set_xticks([])
        axes.set_xlim(-0.8, 0.8)


def _scatter(results: SweepResults, path: str, parameters: dict[str, FormationParameter]) -> Figure:
    rows = -(-len(parameters) // COLUMNS)
    figure = new_figure(12, 0.6 + 2.5 * rows)
    grid = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
    x = results.values(path)
    for axes, (prefix, parameter) in zip(grid, parameters.items(), strict=False):
        dress(axes, parameter.labelled(label(parameter.name)))
        axes.set_xlabel(path if len(path) <= 40 else _short(path), fontsize=9)
        y = results.values(f"{prefix}.true_rms")
        axes.plot(x, y, ".", color=BLUE, ms=4, alpha=0.45, mew=0, zorder=2)
        for middle, samples in slices(x, y):
            _bar(axes, middle, samples)
    for axes in grid[len(parameters) :]:
        axes.set_visible(False)
    return figure


def slices(x: Samples, y: Samples, count: int = SLICES) -> Sequence[tuple[float, Samples]]:
    """Return the mean x and the y of `count` groups of runs by rising x, as equal in number as can be."""
    both = np.isfinite(x) & np.isfinite(y)
    order = np.argsort(x[both], kind="stable")
    groups = [part for part in np.array_split(order, count) if len(part) >= 2]
    return [(float(x[both][part].mean()), y[both][part]) for part in groups]
