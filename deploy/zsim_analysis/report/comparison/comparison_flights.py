"""The figures of a comparison that show drones: paths from above, altitude, state and battery, run by run."""

from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from zsim_analysis.report.comparison.comparison import Compared
from zsim_analysis.report.comparison.comparison_style import WIDTH_IN, columns
from zsim_analysis.report.figures.canvas import dress, drone_colour, legend_above, line, new_figure
from zsim_analysis.report.figures.flight_figures import NAMED_MAX, draw_path, draw_states, name_states


def draw_plans(runs: Sequence[Compared]) -> Figure:
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


def _drone_order(runs: Sequence[Compared]) -> dict[str, int]:
    """Return a number for each drone of all runs: one of a name has one colour."""
    names = dict.fromkeys(track.name for run in runs for track in run.flight.tracks)
    return {name: number for number, name in enumerate(names)}


def _name_drones(figure: Figure, axes: Axes, order: dict[str, int]) -> None:
    for name, number in list(order.items())[:NAMED_MAX]:
        axes.plot([], [], color=drone_colour(number), lw=1.1, label=name)
    legend_above(figure, axes)


def draw_drones(runs: Sequence[Compared]) -> Figure:
    """Return true altitude, state and battery of every drone, a column per run."""
    count = max(len(run.flight.tracks) for run in runs)
    heights = (3.0, 0.5 + 0.28 * count, 2.0)
    across, order = columns(runs), _drone_order(runs)
    rows = -(-len(runs) // across)
    figure = new_figure(WIDTH_IN, (1.2 + sum(heights)) * rows)
    grid = figure.subplots(3 * rows, across, squeeze=False, sharex=True, height_ratios=heights * rows)
    for axes in grid.flat:
        axes.set_axis_off()
    for place, run in enumerate(runs):
        row, column = divmod(place, across)
        _draw_run_drones(run, grid[3 * row : 3 * row + 3, column], order, first=column == 0)
    for kind in (0, 2):
        _share(list(grid[kind::3].flat))
    name_states(grid[1, -1], [track for run in runs for track in run.flight.tracks])
    _name_drones(figure, grid[0, 0], order)
    return figure


def _draw_run_drones(run: Compared, column: Any, order: dict[str, int], first: bool) -> None:
    altitude, state, battery = column
    for axes, word in ((altitude, "true altitude (m)"), (state, ""), (battery, "battery (%)")):
        axes.set_axis_on()
        dress(axes, word if first else "")
    altitude.set_title(run.name, fontsize=10)
    for i, track in enumerate(run.flight.tracks):
        look: dict[str, Any] = {"color": drone_colour(order[track.name]), "lw": 1.1}
        line(altitude, track.t_ns / 1e9, track.p_W[:, 2], **look)
        line(battery, track.status_t_ns / 1e9, track.battery_percent, **look)
        draw_states(state, track, i)
    state.set_yticks(range(len(run.flight.tracks)), [track.name for track in run.flight.tracks])
    state.invert_yaxis()
    state.grid(False)
    battery.set_xlabel("simulated time (s)", fontsize=10)
    battery.tick_params(labelbottom=True)


def _share(axes: Sequence[Axes]) -> None:
    """Give axes one range of values."""
    drawn = [each for each in axes if each.lines]
    low = min(each.get_ylim()[0] for each in drawn)
    high = max(each.get_ylim()[1] for each in drawn)
    for each in drawn:
        each.set_ylim(low, high)
