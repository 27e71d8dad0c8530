"""The figures of a comparison: the runs over each other where lines are distinct, else side by side."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.reading.formation import Formation
from zsim_analysis.reading.recorded_flight import Array
from zsim_analysis.report.comparison import ComparedRun, clusters, parameters
from zsim_analysis.report.figures.comparison_drones import columns, draw_drones, draw_plans
from zsim_analysis.report.figures.formation_figures import curves, draw_error, numbered, parameter_groups, scale
from zsim_analysis.report.figures.run_marks import LANE_IN, draw_instants, draw_lanes, name_marks, run_marks
from zsim_analysis.report.figures.run_style import run_style
from zsim_analysis.report.figures.time_marks import TAKE_OVER, draw_marks, shade_window, time_marks
from zsim_analysis.report.pages import (
    BLACK,
    GRID,
    PAGE_IN,
    PAPER_PT,
    ReportFigure,
    dress,
    label,
    label_time,
    legend_above,
    letter_panels,
    line,
    new_figure,
)
from zsim_analysis.report.paper import flies_paper_test

ROOM = 0.03  # of the greatest RMS, beyond it: its mark is whole
ROWS_MAX = 24  # parameters in one figure; 6 drones
DESIRED: dict[str, Any] = {"color": BLACK, "lw": 1.0, "ls": (0, (1, 2)), "zorder": 6}


def comparison_figures(runs: Sequence[ComparedRun]) -> Iterator[ReportFigure]:
    """Yield the figures that the records have data for."""
    for cluster in clusters(runs):
        yield from _of_cluster(runs, cluster)
    if any(len(track.t_ns) for run in runs for track in run.flight.tracks):
        yield ReportFigure(
            "plan_view.png",
            "Plan view",
            "True paths from above, on one scale; squares: start, dots: end.",
            draw_plans(runs),
        )
        yield ReportFigure(
            "drones.png",
            "Drones",
            "True altitude, state of the firmware and battery of every drone, run by run on the same axes.",
            draw_drones(runs),
        )


def _of_cluster(runs: Sequence[ComparedRun], cluster: str) -> Iterator[ReportFigure]:
    names = parameters(runs, cluster)
    paper = all(flies_paper_test(run.flight, cluster) and not time_marks(run.flight).has(TAKE_OVER) for run in runs)
    suffix = f", cluster {cluster}" if len(clusters(runs)) > 1 else ""
    yield ReportFigure(
        f"rms_{cluster}.png",
        f"Errors of the formation's parameters{suffix}",
        "Root of the mean square of truth − desired (full marks) and of estimate − desired (hollow marks) within the "
        "window of each run.",
        _draw_rms(runs, cluster, names),
    )
    for number, start in enumerate(range(0, len(runs), columns(runs))):
        some = runs[start : start + columns(runs)]
        if any(run.formation(cluster) for run in some):
            yield ReportFigure(
                f"figure_5_errors_{cluster}_{number}.png",
                f"Formation parameters' errors{numbered(5, paper)}{suffix}",
                "Runs side by side, each row on one scale, that of the windows (shaded), which larger errors leave.",
                _draw_errors(some, runs, cluster, names),
            )
    for file, number, what, group in parameter_groups(names):
        if shown := group[:ROWS_MAX]:
            yield ReportFigure(
                f"{file}_{cluster}.png",
                f"{what}{numbered(number, paper)}{suffix}",
                f"(a) True and (b) measured (from the estimates) {', '.join(shown)}; dotted: desired. "
                "Above: each run's marks.",
                _draw_parameters(runs, cluster, shown),
            )


def _draw_rms(runs: Sequence[ComparedRun], cluster: str, names: Sequence[str]) -> Figure:
    """Return the RMS errors, a panel for each unit: metres and radians have no axis in common."""
    shown = list(names)[:ROWS_MAX]
    groups = {each: [name for name in shown if unit(name) == each] for each in dict.fromkeys(map(unit, shown))}
    figure = new_figure(PAGE_IN, 1.0 + len(groups) * 0.4 + 0.16 * (len(runs) + 1) * len(shown))
    heights = [len(group) for group in groups.values()]
    panels = figure.subplots(len(groups), 1, squeeze=False, height_ratios=heights)[:, 0]
    for axes, (measure, group) in zip(panels, groups.items(), strict=True):
        _draw_rms_panel(axes, runs, cluster, group)
        axes.set_xlabel(f"RMS error ({measure})", fontsize=PAPER_PT)
    letter_panels(panels)
    for i, run in enumerate(runs):
        look = run_style(i)
        panels[0].plot([], [], look.marker, color=look.color, ms=7, label=run.label)
    legend_above(figure, panels[0])
    return figure


def _draw_rms_panel(axes: Axes, runs: Sequence[ComparedRun], cluster: str, names: Sequence[str]) -> None:
    dress(axes)
    lane = 1.0 / (len(runs) + 1)
    for i, run in enumerate(runs):
        judged, look = run.summary.clusters.get(cluster), run_style(i)
        for row, name in enumerate(names):
            errors = judged.errors.get(name) if judged else None
            y = row + (i - (len(runs) - 1) / 2) * lane
            for value, face in ((errors and errors.true_rms, look.color), (errors and errors.est_rms, "white")):
                if value is not None:
                    axes.plot(value, y, look.marker, color=look.color, mfc=face, ms=7, zorder=3, clip_on=False)
    axes.set_yticks(range(len(names)), [label(name) for name in names])
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.margins(x=ROOM)
    axes.set_xlim(left=0)
    for row in range(1, len(names)):
        axes.axhline(row - 0.5, color=GRID, lw=0.6, zorder=1)
    axes.grid(False, axis="y")


def _draw_errors(
    some: Sequence[ComparedRun], runs: Sequence[ComparedRun], cluster: str, names: Sequence[str]
) -> Figure:
    """Return the errors of a few runs side by side; the scale of a row is that of all runs."""
    shown = list(names)[:ROWS_MAX]
    figure = new_figure(PAGE_IN, 0.9 + 0.7 * len(shown))
    grid = figure.subplots(len(shown), len(some), squeeze=False, sharex=True, sharey="row")
    for run, column in zip(some, grid.T, strict=True):
        formation = run.formation(cluster)
        column[0].set_title(run.label, fontsize=PAPER_PT)
        label_time(column[-1:])
        for name, axes in zip(shown, column, strict=True):
            if formation is None or name not in formation.names:
                _draw_absence(axes)
                continue
            draw_error(axes, formation, name, np.ones(len(formation.t_s), bool))
            shade_window(axes, run.summary.window_s)
            draw_marks([axes], time_marks(run.flight, formation))
    letter_panels(grid[0])
    for name, axes in zip(shown, grid[:, 0], strict=True):
        axes.set_ylabel(label(name), fontsize=PAPER_PT)
        if limit := _greatest(runs, cluster, name):
            axes.set_ylim(-1.15 * limit, 1.15 * limit)
    figure.align_ylabels(grid[:, 0])
    legend_above(figure, next((axes for axes in grid[0] if axes.lines), grid[0, 0]))
    return figure


def _greatest(runs: Sequence[ComparedRun], cluster: str, name: str) -> float:
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


def _draw_parameters(runs: Sequence[ComparedRun], cluster: str, names: Sequence[str]) -> Figure:
    """Return variables over time: true on the left, measured on the right, the runs over each other."""
    lanes_in, marks = LANE_IN * len(runs), run_marks(runs, cluster)
    figure = new_figure(PAGE_IN, 0.9 + 1.4 * len(names) + lanes_in)
    heights = [lanes_in, *[1.35] * len(names)]
    lanes, *grid = figure.subplots(len(heights), 2, squeeze=False, sharex=True, sharey="row", height_ratios=heights)
    for name, (true_axes, measured_axes) in zip(names, grid, strict=True):
        dress(true_axes, label(name))
        dress(measured_axes)
        drawn: list[Array] = []
        for i, run in enumerate(runs):
            formation = run.formation(cluster)
            if formation is not None and name in formation.names:
                drawn += _draw_run(true_axes, measured_axes, formation, name, i, run.label)
        if drawn:
            scale(true_axes, *drawn)
        for axes in (true_axes, measured_axes):
            draw_instants(axes, marks)
    for axes, title in zip(lanes, ("true", "measured (estimates)"), strict=True):
        draw_lanes(axes, marks, named=axes is lanes[0])
        axes.set_title(title, fontsize=PAPER_PT)
    letter_panels(lanes)
    grid[0][0].plot([], [], label="desired, while engaged", **DESIRED)
    name_marks(grid[0][0], marks)
    label_time(grid[-1])
    figure.align_ylabels([row[0] for row in grid])
    legend_above(figure, grid[0][0])
    return figure


def _draw_run(
    true_axes: Axes, measured_axes: Axes, formation: Formation, name: str, index: int, run: str
) -> list[Array]:
    """Draw a run; return what its axes are to hold."""
    desired, measured, true = curves(formation, name)
    look = run_style(index)
    drawn: dict[str, Any] = {"color": look.color, "ls": look.dashes, "lw": 1.3, "zorder": 3}
    line(true_axes, formation.t_s, true, label=run, **drawn)
    line(measured_axes, formation.t_s, measured, **drawn)
    engaged = np.array([phase == "engaged" for phase in formation.phases])
    for axes in (true_axes, measured_axes):
        line(axes, formation.t_s, np.where(engaged, desired, np.nan), **DESIRED)
    since = formation.since_engaged
    return [true, measured[since], desired[since]]


def _draw_absence(axes: Axes) -> None:
    dress(axes)
    axes.text(
        0.5,
        0.5,
        "not in this run",
        transform=axes.transAxes,
        ha="center",
        va="center",
        fontsize=PAPER_PT - 1,
        color="#57606a",
    )
