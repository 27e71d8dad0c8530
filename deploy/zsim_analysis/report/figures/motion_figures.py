"""How the drones move: commanded and flown velocity, and how far they are apart; many drones as their spread."""

from collections.abc import Mapping, Sequence
from functools import reduce

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from zsim_analysis.reading.distances import Distances, Separations
from zsim_analysis.reading.drone_errors import VelocityResponse
from zsim_analysis.reading.recorded_flight import Array
from zsim_analysis.report.figures.spread import draw_spread
from zsim_analysis.report.figures.time_marks import TimeMarks, draw_marks
from zsim_analysis.report.pages import (
    BLACK,
    BLUE,
    COLUMN_IN,
    PAGE_IN,
    PAPER_PT,
    VERMILION,
    dress,
    label_time,
    legend_above,
    letter_panels,
    line,
    new_figure,
)

EACH_MAX = 4  # drones with a column of their own on a page
PAIRS_MAX = 6  # with a line of their own: of four drones
QUANTITIES = ("forward (m/s)", "left (m/s)", "up (m/s)", "yaw rate (rad/s)")
GUARD = "#9a6a00"  # an orange that can be read as small print
GAP_S = 0.5  # without a command: nobody flies the drone by velocity, and no line is drawn


def draw_velocities(responses: Mapping[str, VelocityResponse], colours: Mapping[str, str], marks: TimeMarks) -> Figure:
    """Return commanded and flown velocity of every drone, or of many the spread of their difference."""
    if len(responses) > EACH_MAX:
        return _draw_many(responses, marks)
    figure = new_figure(PAGE_IN, 0.8 + 0.85 * len(QUANTITIES))
    grid = figure.subplots(len(QUANTITIES), len(responses), squeeze=False, sharex=True, sharey="row")
    for (name, each), column in zip(responses.items(), grid.T, strict=True):
        column[0].set_title(name, fontsize=PAPER_PT)
        for i, axes in enumerate(column):
            dress(axes)
            flown, commanded = (_broken(each.t_s, values[:, i]) for values in (each.flown, each.commanded))
            line(axes, each.t_s, flown, color=colours[name], lw=0.6, zorder=3, label="flown")
            line(axes, each.t_s, commanded, color=BLACK, lw=1.0, zorder=2, label="commanded")
        draw_marks(column, marks)
    for axes, quantity in zip(grid[:, 0], QUANTITIES, strict=True):
        axes.set_ylabel(quantity, fontsize=PAPER_PT)
    letter_panels(grid[0])
    label_time(grid[-1])
    figure.align_ylabels(grid[:, 0])
    legend_above(figure, grid[0, 0], columns=7)
    return figure


def _broken(t_s: Array, values: Array) -> Array:
    """Return values with NaN behind every gap of time, where a line breaks."""
    return np.where(np.diff(t_s, prepend=t_s[0]) > GAP_S, np.nan, values)


def _draw_many(responses: Mapping[str, VelocityResponse], marks: TimeMarks) -> Figure:
    """Return the spread of flown − commanded over all drones."""
    t_s = reduce(np.union1d, (each.t_s for each in responses.values()))
    panels = ("horizontal (m/s)", "up (m/s)", "yaw rate (rad/s)")
    values = [np.full((len(t_s), len(responses)), np.nan) for _ in panels]
    for k, each in enumerate(responses.values()):
        place, error = np.searchsorted(t_s, each.t_s), each.flown - each.commanded
        for table, column in zip(values, (np.hypot(error[:, 0], error[:, 1]), error[:, 2], error[:, 3]), strict=True):
            table[place, k] = column
    figure = new_figure(COLUMN_IN, 4.0)
    grid = figure.subplots(len(panels), 1, sharex=True)
    for axes, quantity, table in zip(grid, panels, values, strict=True):
        dress(axes, quantity)
        draw_spread(axes, t_s, table, BLUE)
    grid[0].set_title("flown − commanded", fontsize=PAPER_PT)
    draw_marks(grid, marks)
    letter_panels(grid)
    label_time(grid[-1:])
    figure.align_ylabels()
    legend_above(figure, grid[0], columns=3)
    return figure


def draw_distances(
    distances: Distances, separations: Separations, colours: Mapping[str, str], marks: TimeMarks
) -> Figure:
    """Return the distances of every pair, in the colours of both, with what they are to keep; of many the nearest."""
    figure = new_figure(COLUMN_IN, 2.5)
    axes = figure.subplots()
    if distances.pairs:
        dress(axes, "distance (m)")
        for (one, other), column in zip(distances.pairs, distances.between.T, strict=True):
            look = {"color": colours[one], "gapcolor": colours[other], "ls": (0, (4, 4)), "lw": 1.0}
            axes.plot(distances.t_s, column, label=f"{one} – {other}", **look)
    else:
        dress(axes, "nearest drone (m)")
        draw_spread(axes, distances.t_s, distances.nearest, BLUE)
    axes.set_ylim(bottom=0)
    draw_marks([axes], marks)
    _draw_separations(axes, separations)
    label_time([axes])
    legend_above(figure, axes, columns=3)
    return figure


def _draw_separations(axes: Axes, separations: Separations) -> None:
    """Draw what distances are to keep, each with its name on it."""
    lines: Sequence[tuple[float | None, str, str, str]] = (
        (separations.margin_m, "guard parts", GUARD, "--"),
        (separations.alarm_m, "alarm", VERMILION, "-."),
        (separations.touch_m, "hulls touch", VERMILION, "-"),
    )
    for distance_m, name, colour, dashes in lines:
        if distance_m:
            axes.axhline(distance_m, color=colour, lw=0.8, ls=dashes, zorder=1.8)
            place = {"ha": "right", "va": "bottom", "transform": axes.get_yaxis_transform(), "zorder": 7}
            axes.text(0.995, distance_m, f"{name}: {distance_m:.2g} m", color=colour, fontsize=PAPER_PT - 1.5, **place)
