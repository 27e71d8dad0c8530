"""The drones of several runs beside each other: true paths from above; altitude, state and battery."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from zsim.presentation import colours_of
from zsim_analysis.report.comparison import ComparedRun
from zsim_analysis.report.figures.drone_panels import draw_drone_panels, drone_panel_heights, name_states
from zsim_analysis.report.figures.plan_view import NAMED_MAX, draw_obstacles, draw_path
from zsim_analysis.report.figures.time_marks import draw_marks, time_marks
from zsim_analysis.report.pages import PAGE_IN, PAPER_PT, dress, legend_above, letter_panels, new_figure

COLUMNS = 3  # runs beside each other in a row of a figure, at most


def columns(runs: Sequence[ComparedRun]) -> int:
    """Return how many runs stand beside each other: rows as full as can be."""
    rows = -(-len(runs) // COLUMNS)
    return -(-len(runs) // rows)


def draw_plans(runs: Sequence[ComparedRun]) -> Figure:
    """Return the true paths from above, a plan per run, all on one scale."""
    across, colours = columns(runs), _drone_colours(runs)
    rows = -(-len(runs) // across)
    figure = new_figure(PAGE_IN, 0.8 + rows * PAGE_IN / across)
    grid = figure.subplots(rows, across, squeeze=False, sharex=True, sharey=True)
    for axes in grid.flat[len(runs) :]:
        axes.set_axis_off()
    for run, axes in zip(runs, grid.flat, strict=False):
        dress(axes)
        axes.set_title(run.label, fontsize=PAPER_PT)
        axes.set_aspect("equal", adjustable="box")
        draw_obstacles(axes, run.flight.scenario)
        for track in run.flight.tracks:
            draw_path(axes, track, colours[track.name], named=False)
    for axes in grid.flat[len(runs) - across : len(runs)]:
        axes.set_xlabel("east x (m)", fontsize=PAPER_PT)
        axes.tick_params(labelbottom=True)
    for axes in grid[:, 0]:
        axes.set_ylabel("north y (m)", fontsize=PAPER_PT)
    _even_out(grid)
    letter_panels(list(grid.flat[: len(runs)]))
    _name_drones(figure, grid[0, 0], colours)
    return figure


def _even_out(grid: Any) -> None:
    """Give all plans one square range around what is drawn."""
    (left, right), (low, high) = grid[0, 0].get_xlim(), grid[0, 0].get_ylim()
    half = 0.52 * max(right - left, high - low)
    grid[0, 0].set_xlim((left + right) / 2 - half, (left + right) / 2 + half)
    grid[0, 0].set_ylim((low + high) / 2 - half, (low + high) / 2 + half)


def _drone_colours(runs: Sequence[ComparedRun]) -> dict[str, str]:
    """Return a colour for each drone of all runs: one of a name has one colour."""
    return colours_of(list(dict.fromkeys(track.name for run in runs for track in run.flight.tracks)))


def _name_drones(figure: Figure, axes: Axes, colours: Mapping[str, str]) -> None:
    """Name the drones above all axes, of many the first and the last."""
    named = list(colours.items())
    for name, colour in named if len(named) <= NAMED_MAX else (named[0], named[-1]):
        axes.plot([], [], color=colour, lw=1.1, label=name)
    legend_above(figure, axes)


def draw_drones(runs: Sequence[ComparedRun]) -> Figure:
    """Return true altitude, state and battery of every drone, a column per run."""
    heights = drone_panel_heights(max(len(run.flight.tracks) for run in runs))
    across, colours = columns(runs), _drone_colours(runs)
    rows = -(-len(runs) // across)
    figure = new_figure(PAGE_IN, (1.0 + 0.6 * sum(heights)) * rows)
    grid = figure.subplots(3 * rows, across, squeeze=False, sharex=True, height_ratios=heights * rows)
    for axes in grid.flat:
        axes.set_axis_off()
    for index, run in enumerate(runs):
        row, column = divmod(index, across)
        _draw_run_drones(run, grid[3 * row : 3 * row + 3, column], colours, first=column == 0)
    letter_panels([grid[3 * (index // across), index % across] for index in range(len(runs))])
    for kind in (0, 2):
        _share_range(list(grid[kind::3].flat))
    name_states(figure, [track for run in runs for track in run.flight.tracks])
    _name_drones(figure, grid[0, 0], colours)
    return figure


def _draw_run_drones(run: ComparedRun, panels: Any, colours: Mapping[str, str], first: bool) -> None:
    for axes, quantity in zip(panels, ("true altitude (m)", "", "battery (%)"), strict=True):
        axes.set_axis_on()
        dress(axes, quantity if first else "")
    panels[0].set_title(run.label, fontsize=PAPER_PT)
    draw_drone_panels(panels, run.flight.tracks, colours, named=0)
    panels[-1].tick_params(labelbottom=True)
    draw_marks(panels, time_marks(run.flight, run.formations[0] if run.formations else None))


def _share_range(axes: Sequence[Axes]) -> None:
    """Give axes one range of values."""
    drawn = [each for each in axes if each.lines]
    low = min(each.get_ylim()[0] for each in drawn)
    high = max(each.get_ylim()[1] for each in drawn)
    for each in drawn:
        each.set_ylim(low, high)
