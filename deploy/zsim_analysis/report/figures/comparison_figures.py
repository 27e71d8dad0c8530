"""The figures of a comparison: the runs over each other where lines are distinct, else side by side."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.reading.flight import Array
from zsim_analysis.reading.formation import Formation
from zsim_analysis.report.comparison import ComparedRun, clusters, parameters
from zsim_analysis.report.figures.plan_view import NAMED_MAX, draw_obstacles, draw_path
from zsim_analysis.report.figures.report_figures import (
    ROWS_MAX,
    curves,
    draw_drone_panels,
    draw_error,
    drone_panel_heights,
    name_states,
    parameter_groups,
    scale,
)
from zsim_analysis.report.figures.run_marks import LANE_IN, draw_instants, draw_lanes, name_marks, run_marks
from zsim_analysis.report.figures.time_marks import draw_marks, time_marks
from zsim_analysis.report.pages import (
    BLACK,
    ReportFigure,
    dress,
    drone_colour,
    label,
    label_time,
    legend_above,
    line,
    new_figure,
    run_style,
)

COLUMNS = 3  # runs beside each other in a row of a figure, at most
WIDTH_IN = 12.0  # of the figures on the page
DESIRED: dict[str, Any] = {"color": BLACK, "lw": 1.0, "ls": (0, (1, 2)), "zorder": 6}


def columns(runs: Sequence[ComparedRun]) -> int:
    """Return how many runs stand beside each other: rows as full as can be."""
    rows = -(-len(runs) // COLUMNS)
    return -(-len(runs) // rows)


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
                f"Formation parameters' errors (the paper's Figure 5){suffix}",
                "Runs side by side, each row on one scale, that of the windows (shaded), which larger errors leave.",
                _draw_errors(some, runs, cluster, names),
            )
    yield from _of_parameters(runs, cluster, names, suffix)


def _of_parameters(
    runs: Sequence[ComparedRun], cluster: str, names: Sequence[str], suffix: str
) -> Iterator[ReportFigure]:
    for file, number, what, group in parameter_groups(names):
        if shown := group[:ROWS_MAX]:
            yield ReportFigure(
                f"{file}_{cluster}.png",
                f"{what} (the paper's Figure {number}){suffix}",
                f"True and measured (from the estimates) {', '.join(shown)}; dotted: desired. Above: each run's marks.",
                _draw_parameters(runs, cluster, shown),
            )


def draw_plans(runs: Sequence[ComparedRun]) -> Figure:
    """Return the true paths from above, a plan per run, all on one scale."""
    across, order = columns(runs), _drone_order(runs)
    rows = -(-len(runs) // across)
    figure = new_figure(WIDTH_IN, 0.8 + rows * WIDTH_IN / across)
    grid = figure.subplots(rows, across, squeeze=False, sharex=True, sharey=True)
    for axes in grid.flat[len(runs) :]:
        axes.set_axis_off()
    for run, axes in zip(runs, grid.flat, strict=False):
        dress(axes)
        axes.set_title(run.name, fontsize=10)
        axes.set_aspect("equal", adjustable="box")
        draw_obstacles(axes, run.flight.scenario)
        for track in run.flight.tracks:
            draw_path(axes, track, drone_colour(order[track.name]), named=False)
    for axes in grid.flat[len(runs) - across : len(runs)]:
        axes.set_xlabel("east x (m)", fontsize=10)
        axes.tick_params(labelbottom=True)
    for axes in grid[:, 0]:
        axes.set_ylabel("north y (m)", fontsize=10)
    _even_out(grid)
    _name_drones(figure, grid[0, 0], order)
    return figure


def _even_out(grid: Any) -> None:
    """Give all plans one square range around what is drawn."""
    (left, right), (low, high) = grid[0, 0].get_xlim(), grid[0, 0].get_ylim()
    half = 0.52 * max(right - left, high - low)
    grid[0, 0].set_xlim((left + right) / 2 - half, (left + right) / 2 + half)
    grid[0, 0].set_ylim((low + high) / 2 - half, (low + high) / 2 + half)


def _drone_order(runs: Sequence[ComparedRun]) -> dict[str, int]:
    """Return a number for each drone of all runs: one of a name has one colour."""
    names = dict.fromkeys(track.name for run in runs for track in run.flight.tracks)
    return {name: number for number, name in enumerate(names)}


def _name_drones(figure: Figure, axes: Axes, order: dict[str, int]) -> None:
    for name, number in list(order.items())[:NAMED_MAX]:
        axes.plot([], [], color=drone_colour(number), lw=1.1, label=name)
    legend_above(figure, axes)


def draw_drones(runs: Sequence[ComparedRun]) -> Figure:
    """Return true altitude, state and battery of every drone, a column per run."""
    heights = drone_panel_heights(max(len(run.flight.tracks) for run in runs))
    across, order = columns(runs), _drone_order(runs)
    rows = -(-len(runs) // across)
    figure = new_figure(WIDTH_IN, (1.2 + sum(heights)) * rows)
    grid = figure.subplots(3 * rows, across, squeeze=False, sharex=True, height_ratios=heights * rows)
    for axes in grid.flat:
        axes.set_axis_off()
    for index, run in enumerate(runs):
        row, column = divmod(index, across)
        _draw_run_drones(run, grid[3 * row : 3 * row + 3, column], order, first=column == 0)
    for kind in (0, 2):
        _share_range(list(grid[kind::3].flat))
    name_states(grid[1, -1], [track for run in runs for track in run.flight.tracks])
    _name_drones(figure, grid[0, 0], order)
    return figure


def _draw_run_drones(run: ComparedRun, panels: Any, order: dict[str, int], first: bool) -> None:
    for axes, quantity in zip(panels, ("true altitude (m)", "", "battery (%)"), strict=True):
        axes.set_axis_on()
        dress(axes, quantity if first else "")
    panels[0].set_title(run.name, fontsize=10)
    draw_drone_panels(panels, run.flight.tracks, order, named=0)
    panels[-1].tick_params(labelbottom=True)
    draw_marks(panels, time_marks(run.flight, run.formations[0] if run.formations else None))


def _share_range(axes: Sequence[Axes]) -> None:
    """Give axes one range of values."""
    drawn = [each for each in axes if each.lines]
    low = min(each.get_ylim()[0] for each in drawn)
    high = max(each.get_ylim()[1] for each in drawn)
    for each in drawn:
        each.set_ylim(low, high)


def _draw_rms(runs: Sequence[ComparedRun], cluster: str, names: Sequence[str]) -> Figure:
    """Return the RMS errors, a panel for each unit: metres and radians have no axis in common."""
    shown = list(names)[:ROWS_MAX]
    groups = {each: [name for name in shown if unit(name) == each] for each in dict.fromkeys(map(unit, shown))}
    figure = new_figure(WIDTH_IN, 1.0 + len(groups) * 0.4 + 0.16 * (len(runs) + 1) * len(shown))
    heights = [len(group) for group in groups.values()]
    panels = figure.subplots(len(groups), 1, squeeze=False, height_ratios=heights)[:, 0]
    for axes, (measure, group) in zip(panels, groups.items(), strict=True):
        _draw_rms_panel(axes, runs, cluster, group)
        axes.set_xlabel(f"RMS error ({measure})", fontsize=10)
    for i, run in enumerate(runs):
        look = run_style(i)
        panels[0].plot([], [], look.marker, color=look.color, ms=7, label=run.name)
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
                    axes.plot(value, y, look.marker, color=look.color, mfc=face, ms=7, zorder=3)
    axes.set_yticks(range(len(names)), [label(name) for name in names])
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_xlim(left=0)
    for row in range(1, len(names)):
        axes.axhline(row - 0.5, color="#d8dee4", lw=0.6, zorder=1)
    axes.grid(False, axis="y")


def _draw_errors(
    some: Sequence[ComparedRun], runs: Sequence[ComparedRun], cluster: str, names: Sequence[str]
) -> Figure:
    """Return the errors of a few runs side by side; the scale of a row is that of all runs."""
    shown = list(names)[:ROWS_MAX]
    figure = new_figure(WIDTH_IN, 1.2 + 1.15 * len(shown))
    grid = figure.subplots(len(shown), len(some), squeeze=False, sharex=True, sharey="row")
    for run, column in zip(some, grid.T, strict=True):
        formation = run.formation(cluster)
        column[0].set_title(run.name, fontsize=10)
        label_time(column[-1:])
        for name, axes in zip(shown, column, strict=True):
            if formation is None or name not in formation.names:
                _draw_absence(axes)
                continue
            draw_error(axes, formation, name, np.ones(len(formation.t_s), bool))
            axes.axvspan(*run.summary.window_s, color="#eef2f6", zorder=0)
            draw_marks([axes], time_marks(run.flight, formation))
    for name, axes in zip(shown, grid[:, 0], strict=True):
        axes.set_ylabel(label(name), fontsize=10)
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
    figure = new_figure(WIDTH_IN, 1.2 + 2.1 * len(names) + lanes_in)
    heights = [lanes_in, *[2.0] * len(names)]
    lanes, *grid = figure.subplots(len(heights), 2, squeeze=False, sharex=True, sharey="row", height_ratios=heights)
    for name, (true_axes, measured_axes) in zip(names, grid, strict=True):
        dress(true_axes, label(name))
        dress(measured_axes)
        drawn: list[Array] = []
        for i, run in enumerate(runs):
            formation = run.formation(cluster)
            if formation is not None and name in formation.names:
                drawn += _draw_run(true_axes, measured_axes, formation, name, i, run.name)
        if drawn:
            scale(true_axes, *drawn)
        for axes in (true_axes, measured_axes):
            draw_instants(axes, marks)
    for axes, title in zip(lanes, ("true", "measured (estimates)"), strict=True):
        draw_lanes(axes, marks, named=axes is lanes[0])
        axes.set_title(title, fontsize=10)
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
        0.5, 0.5, "not in this run", transform=axes.transAxes, ha="center", va="center", fontsize=9, color="#57606a"
    )
