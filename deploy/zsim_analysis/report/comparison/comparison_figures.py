"""The figures of a comparison: the runs over each other where lines can be told apart, else side by side."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from zsim_analysis.reading.formation_variables import Formation
from zsim_analysis.report.comparison.comparison import Compared, clusters, parameters
from zsim_analysis.report.comparison.comparison_flights import draw_drones, draw_plans
from zsim_analysis.report.comparison.comparison_style import WIDTH_IN, columns, style
from zsim_analysis.report.figures.canvas import BLACK, dress, legend_above, line, new_figure
from zsim_analysis.report.figures.cluster_figures import ROWS_MAX, curves, draw_error, label
from zsim_analysis.report.figures.run_figures import ORIENTATION, POSITION, Named

DESIRED: dict[str, Any] = {"color": BLACK, "lw": 1.0, "ls": (0, (1, 2)), "zorder": 6}


def comparison_figures(runs: Sequence[Compared]) -> Iterator[Named]:
    """Yield the figures that the records have data for."""
    for cluster in clusters(runs):
        yield from _of_cluster(runs, cluster)
    if any(len(track.t_ns) for run in runs for track in run.flight.tracks):
        yield Named(
            "plan_view.png",
            "Plan view",
            "True paths from above, on one scale; squares: start, dots: end.",
            draw_plans(runs),
        )
        yield Named(
            "drones.png",
            "Drones",
            "True altitude, state of the firmware and battery of every drone, run by run on the same axes.",
            draw_drones(runs),
        )


def _of_cluster(runs: Sequence[Compared], cluster: str) -> Iterator[Named]:
    names = parameters(runs, cluster)
    suffix = f", cluster {cluster}" if len(clusters(runs)) > 1 else ""
    yield Named(
        f"rms_{cluster}.png",
        f"Errors of the formation's parameters{suffix}",
        "Root of the mean square of truth − desired (full marks) and of estimate − desired (hollow marks) within the "
        "window of each run.",
        _draw_rms(runs, cluster, names),
    )
    for number, start in enumerate(range(0, len(runs), columns(runs))):
        some = runs[start : start + columns(runs)]
        if any(run.formation(cluster) for run in some):
            yield Named(
                f"figure_5_errors_{cluster}_{number}.png",
                f"Formation parameters' errors (the paper's Figure 5){suffix}",
                "Runs side by side, each row on one scale, that of the windows (shaded), which larger errors leave.",
                _draw_errors(some, runs, cluster, names),
            )
    yield from _of_parameters(runs, cluster, names, suffix)


def _of_parameters(runs: Sequence[Compared], cluster: str, names: Sequence[str], suffix: str) -> Iterator[Named]:
    shape = tuple(name for name in names if name not in POSITION + ORIENTATION and "phi" not in name)
    for stem, paper, what, wanted in (
        ("figure_6_position", 6, "Position of the formation", POSITION),
        ("figure_7_orientation", 7, "Orientation of the formation", ORIENTATION),
        ("figure_8_shape", 8, "Shape of the formation", shape),
    ):
        present = [name for name in wanted if name in names][:ROWS_MAX]
        if present:
            yield Named(
                f"{stem}_{cluster}.png",
                f"{what} (the paper's Figure {paper}){suffix}",
                f"True and measured (from the estimates) {', '.join(present)} of the runs; dotted: desired.",
                _draw_parameters(runs, cluster, present),
            )


def _draw_rms(runs: Sequence[Compared], cluster: str, names: Sequence[str]) -> Figure:
    shown = list(names)[:ROWS_MAX]
    figure = new_figure(WIDTH_IN, 1.0 + 0.16 * (len(runs) + 1) * len(shown))
    axes = figure.subplots()
    dress(axes)
    lane = 1.0 / (len(runs) + 1)
    for i, run in enumerate(runs):
        found, how = run.summary.clusters.get(cluster), style(i)
        for row, name in enumerate(shown):
            errors = found.errors.get(name) if found else None
            y = row + (i - (len(runs) - 1) / 2) * lane
            for value, face in ((errors and errors.true_rms, how.color), (errors and errors.est_rms, "white")):
                if value is not None:
                    axes.plot(value, y, how.marker, color=how.color, mfc=face, ms=7, zorder=3)
        axes.plot([], [], how.marker, color=how.color, ms=7, label=run.name)
    axes.set_yticks(range(len(shown)), [label(name) for name in shown])
    axes.set_ylim(len(shown) - 0.5, -0.5)
    axes.set_xlim(left=0)
    for row in range(1, len(shown)):
        axes.axhline(row - 0.5, color="#d8dee4", lw=0.6, zorder=1)
    axes.grid(False, axis="y")
    axes.set_xlabel("RMS error (m, rad)", fontsize=10)
    legend_above(figure, axes)
    return figure


def _draw_errors(some: Sequence[Compared], runs: Sequence[Compared], cluster: str, names: Sequence[str]) -> Figure:
    """Return the errors of a few runs side by side; the scale of a row is that of all runs."""
    shown = list(names)[:ROWS_MAX]
    figure = new_figure(WIDTH_IN, 1.2 + 1.15 * len(shown))
    grid = figure.subplots(len(shown), len(some), squeeze=False, sharex=True, sharey="row")
    for run, column in zip(some, grid.T, strict=True):
        formation = run.formation(cluster)
        column[0].set_title(run.name, fontsize=10)
        column[-1].set_xlabel("simulated time (s)", fontsize=10)
        for name, axes in zip(shown, column, strict=True):
            if formation is None or name not in formation.names:
                _say_nothing(axes)
                continue
            draw_error(axes, formation, name, np.ones(len(formation.t_s), bool))
            axes.axvspan(*run.summary.window_s, color="#eef2f6", zorder=0)
    for name, axes in zip(shown, grid[:, 0], strict=True):
        axes.set_ylabel(label(name), fontsize=10)
        if limit := _greatest(runs, cluster, name):
            axes.set_ylim(-1.15 * limit, 1.15 * limit)
    figure.align_ylabels(grid[:, 0])
    legend_above(figure, next((axes for axes in grid[0] if axes.lines), grid[0, 0]))
    return figure


def _greatest(runs: Sequence[Compared], cluster: str, name: str) -> float:
    """Return the greatest error of a variable within the windows."""
    greatest = 0.0
    for run in runs:
        formation = run.formation(cluster)
        if formation is None or name not in formation.names:
            continue
        rows, i = formation.within(run.summary.window_s), formation.column(name)
        errors = np.abs(np.r_[formation.true_error[rows, i], formation.est_error[rows, i]])
        greatest = max(greatest, float(np.nanmax(errors, initial=0.0)) if np.isfinite(errors).any() else 0.0)
    return greatest


def _draw_parameters(runs: Sequence[Compared], cluster: str, names: Sequence[str]) -> Figure:
    """Return variables over time: true on the left, measured on the right, the runs over each other."""
    figure = new_figure(WIDTH_IN, 1.2 + 2.1 * len(names))
    grid = figure.subplots(len(names), 2, squeeze=False, sharex=True, sharey="row")
    for name, (true_axes, measured_axes) in zip(names, grid, strict=True):
        dress(true_axes, label(name))
        dress(measured_axes)
        for i, run in enumerate(runs):
            formation = run.formation(cluster)
            if formation is not None and name in formation.names:
                _draw_run(true_axes, measured_axes, formation, name, i, run.name)
    grid[0, 0].plot([], [], label="desired, while engaged", **DESIRED)
    grid[0, 0].set_title("true", fontsize=10)
    grid[0, 1].set_title("measured (estimates)", fontsize=10)
    for axes in grid[-1]:
        axes.set_xlabel("simulated time (s)", fontsize=10)
    figure.align_ylabels(grid[:, 0])
    legend_above(figure, grid[0, 0])
    return figure


def _draw_run(true_axes: Axes, measured_axes: Axes, formation: Formation, name: str, index: int, run: str) -> None:
    desired, measured, true = curves(formation, name)
    how = style(index)
    drawn: dict[str, Any] = {"color": how.color, "ls": how.dashes, "lw": 1.3, "zorder": 3}
    line(true_axes, formation.t_s, true, label=run, **drawn)
    line(measured_axes, formation.t_s, measured, **drawn)
    engaged = np.array([phase == "engaged" for phase in formation.phases])
    for axes in (true_axes, measured_axes):
        line(axes, formation.t_s, np.where(engaged, desired, np.nan), **DESIRED)


def _say_nothing(axes: Axes) -> None:
    dress(axes)
    axes.text(
        0.5, 0.5, "not in this run", transform=axes.transAxes, ha="center", va="center", fontsize=9, color="#57606a"
    )
