"""The figures of a report: the paper's of each cluster, the paths from above, and altitude, state and battery.

The paper's are errors (5), position (6), orientation (7) and shape (8).
"""

from collections.abc import Iterator, Sequence
from textwrap import shorten

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.reading.flight import Array, RecordedFlight, Track
from zsim_analysis.reading.formation import Formation
from zsim_analysis.report.figures.plan_view import NAMED_MAX, draw_plan
from zsim_analysis.report.figures.time_marks import TimeMarks, draw_marks, time_marks
from zsim_analysis.report.pages import (
    BLUE,
    DESIRED,
    GREEN,
    GREY,
    MEASURED,
    ORANGE,
    PURPLE,
    SKY,
    TRUE,
    VERMILION,
    ReportFigure,
    dress,
    drone_colour,
    label,
    label_time,
    legend_above,
    line,
    mark_figure,
    new_figure,
    padded_range,
)
from zsim_analysis.report.summary import RunSummary

POSITION = ("x_c", "y_c", "z_c")
ORIENTATION = ("roll", "pitch", "yaw")
MARK_MAX = 110  # characters in a line above a figure
ROWS_MAX = 24  # parameters in one figure; 6 drones


def draw_errors(formation: Formation, window_s: tuple[float, float], marks: TimeMarks) -> Figure:
    """Return Figure 5: a row per parameter, the whole run on the left, the window on the right."""
    names = formation.names[:ROWS_MAX]
    figure = new_figure(12, 1.0 + 1.15 * len(names))
    grid = figure.subplots(len(names), 2, squeeze=False, sharex="col", width_ratios=(1, 1))
    rows = formation.within(window_s)
    for name, (whole, zoom) in zip(names, grid, strict=True):
        draw_error(whole, formation, name, np.ones(len(rows), bool))
        whole.axvspan(*window_s, color="#eef2f6", zorder=0)
        whole.set_ylabel(label(name), fontsize=10)
        draw_error(zoom, formation, name, rows)
        _write_statistics(zoom, formation, name, rows)
    for column in grid.T:
        draw_marks(column, marks)
    grid[0, 0].set_title("whole run (shaded: window)", fontsize=10)
    grid[0, 1].set_title(f"window, {window_s[0]:g} to {window_s[1]:g} s", fontsize=10)
    label_time(grid[-1])
    figure.align_ylabels(grid[:, 0])
    legend_above(figure, grid[0, 0])
    return figure


def draw_error(axes: Axes, formation: Formation, name: str, rows: np.ndarray) -> None:
    """Draw the errors of a parameter, estimated and true, at some instants."""
    i = formation.column(name)
    dress(axes)
    axes.axhline(0, color="#000000", lw=0.6, zorder=1)
    line(axes, formation.t_s[rows], formation.true_error[rows, i], label="truth − desired", **TRUE)
    line(axes, formation.t_s[rows], formation.est_error[rows, i], label="estimate − desired", **MEASURED)
    judged = rows & formation.since_engaged
    scale(axes, formation.true_error[judged, i], formation.est_error[judged, i])


def _write_statistics(axes: Axes, formation: Formation, name: str, rows: np.ndarray) -> None:
    """Write standard deviations beside the axes, in the colours of their lines."""
    i = formation.column(name)
    for y, error, style in ((0.68, formation.est_error, MEASURED), (0.32, formation.true_error, TRUE)):
        known = error[rows, i][np.isfinite(error[rows, i])]
        text = f"std {known.std():.4f}\nmean {known.mean():+.4f}" if len(known) else "no data"
        axes.text(1.02, y, text, transform=axes.transAxes, fontsize=8.5, color=_darker(style["color"]), va="center")


def _darker(colour: str) -> str:
    """Return a colour that can be read as small print on white."""
    return {"#e69f00": "#9a6a00"}.get(colour, colour)


def draw_parameters(formation: Formation, names: Sequence[str], title: str, marks: TimeMarks) -> Figure:
    """Return Figure 6, 7 or 8: desired, measured and true values of some parameters over the run."""
    shown = list(names)[:ROWS_MAX]
    figure = new_figure(11, 1.2 + 2.1 * max(1, len(shown)))
    grid = figure.subplots(max(1, len(shown)), 1, squeeze=False, sharex=True)[:, 0]
    for name, axes in zip(shown, grid, strict=False):
        dress(axes, label(name))
        desired, measured, true = curves(formation, name)
        line(axes, formation.t_s, measured, label="measured (estimates)", **MEASURED)
        line(axes, formation.t_s, true, label="true", **TRUE)
        line(axes, formation.t_s, desired, label="desired", **DESIRED)
        since = formation.since_engaged
        scale(axes, true, measured[since], desired[since])
    draw_marks(list(grid[: len(shown)]), marks)
    label_time(grid[-1:])
    grid[0].set_title(f"{title}, cluster {formation.name}", fontsize=11, loc="left")
    figure.align_ylabels(grid)
    legend_above(figure, grid[0])
    return figure


def curves(formation: Formation, name: str) -> tuple[Array, Array, Array]:
    """Return desired, measured and true values of a parameter; angles without jumps at ±π.

    Angles are unwrapped from the engagement on: before it the desired value is the estimate's own, whose noise may turn
    it by whole rounds.
    """
    i = formation.column(name)
    desired = formation.desired[:, i].copy()
    known = np.isfinite(desired)
    if unit(name) != "rad" or not known.any():
        return desired, desired + formation.est_error[:, i], desired + formation.true_error[:, i]
    since = known & formation.since_engaged
    desired[since] = np.unwrap(desired[since])
    lines = desired, desired + formation.est_error[:, i], desired + formation.true_error[:, i]
    before = known & ~since
    for each in lines:
        each[before] = _nearest_round(each[before], desired[since][0] if since.any() else 0.0)
    return lines


def _nearest_round(angles: Array, to: float) -> Array:
    """Return angles [rad] less the whole turns that bring each within half a turn of `to`."""
    return angles - 2 * np.pi * np.round((angles - to) / (2 * np.pi))


def scale(axes: Axes, *values: Array) -> None:
    """Give an axis the range of values, not of all that is drawn: what is noise before the engagement leaves it."""
    if limits := padded_range(np.concatenate(values), 0.06):
        axes.set_ylim(limits)


def parameter_groups(names: Sequence[str]) -> list[tuple[str, int, str, list[str]]]:
    """Return the paper's figures of parameters over time: file, number, title, and which of the names each shows."""
    shape = [name for name in names if name not in POSITION + ORIENTATION and "phi" not in name]
    return [
        ("figure_6_position", 6, "Position of the formation", [name for name in POSITION if name in names]),
        ("figure_7_orientation", 7, "Orientation of the formation", [name for name in ORIENTATION if name in names]),
        ("figure_8_shape", 8, "Shape of the formation", shape),
    ]


DRONE_PANELS = ("true altitude (m)", "state", "battery (%)")
STATES = {
    "landed": GREY,
    "taking_off": ORANGE,
    "hovering": SKY,
    "flying": BLUE,
    "landing": PURPLE,
    "emergency": VERMILION,
}


def draw_drones(flight: RecordedFlight, marks: TimeMarks) -> Figure:
    """Return altitude, state and battery of every drone over the run."""
    count = len(flight.tracks)
    figure = new_figure(11, 6.4 + 0.28 * count)
    panels = figure.subplots(3, 1, sharex=True, height_ratios=drone_panel_heights(count))
    for axes, quantity in zip(panels, DRONE_PANELS, strict=True):
        dress(axes, quantity)
    draw_drone_panels(panels, flight.tracks, {track.name: i for i, track in enumerate(flight.tracks)}, NAMED_MAX)
    name_states(panels[1], flight.tracks)
    draw_marks(panels, marks)
    figure.align_ylabels()
    legend_above(figure, panels[0])
    return figure


def drone_panel_heights(count: int) -> tuple[float, float, float]:
    """Return the heights of DRONE_PANELS for so many drones."""
    return 3.0, 0.5 + 0.28 * count, 2.0


def draw_drone_panels(panels: Sequence[Axes], tracks: Sequence[Track], order: dict[str, int], named: int) -> None:
    """Draw drones into the axes of DRONE_PANELS.

    Args:
        panels: axes of altitude, state and battery.
        tracks: of the drones.
        order: by drone, the number of its colour.
        named: how many of them the legend is to name.
    """
    altitude, state, battery = panels
    for lane, track in enumerate(tracks):
        i = order[track.name]
        style = {"color": drone_colour(i), "lw": 1.1, "label": track.name if i < named else None}
        line(altitude, track.t_ns / 1e9, track.p_W[:, 2], **style)
        line(battery, track.status_t_ns / 1e9, track.battery_percent, **style)
        draw_states(state, track, lane)
    state.set_yticks(range(len(tracks)), [track.name for track in tracks])
    state.invert_yaxis()
    state.grid(False)
    label_time([battery])


def draw_states(axes: Axes, track: Track, lane: int) -> None:
    """Draw the states of a drone as a bar in a lane of its own."""
    if not track.states:
        return
    states = np.array(track.states)
    starts = np.flatnonzero(np.r_[True, states[1:] != states[:-1]])
    edges = np.r_[track.status_t_ns[starts], track.status_t_ns[-1]] / 1e9
    for start, left, right in zip(starts, edges[:-1], edges[1:], strict=True):
        colour = STATES.get(states[start], GREEN)
        axes.broken_barh([(left, right - left)], (lane - 0.36, 0.72), color=colour)


def name_states(axes: Axes, tracks: Sequence[Track]) -> None:
    """Put the names of the states that occur beside the axes."""
    occur = [name for name in STATES if any(name in track.states for track in tracks)]
    handles: list[Patch | Line2D] = [Patch(color=STATES[name], label=name.replace("_", " ")) for name in occur]
    if handles:
        axes.legend(handles=handles, loc="center left", bbox_to_anchor=(1.005, 0.5), frameon=False, fontsize=9)


def figures(flight: RecordedFlight, formations: Sequence[Formation], summary: RunSummary) -> Iterator[ReportFigure]:
    """Yield the figures that the record has data for, the first cluster's under the plain names, marked if need be."""
    mark = shortfall_mark(summary)
    for figure in _plain(flight, formations, summary.window_s):
        mark_figure(figure.drawing, mark)
        yield figure


def shortfall_mark(summary: RunSummary) -> str:
    """Return what every figure of a flight that did not fly its plan says of it; empty for one that did."""
    failed = [each.text for each in summary.shortfalls if each.fails]
    if not failed:
        return ""
    more = f" (and {len(failed) - 1} more)" if len(failed) > 1 else ""
    return f"Not as planned: {shorten(failed[0], MARK_MAX, placeholder=' …')}{more}"


def _plain(
    flight: RecordedFlight, formations: Sequence[Formation], window_s: tuple[float, float]
) -> Iterator[ReportFigure]:
    for i, formation in enumerate(formations):
        marks = time_marks(flight, formation)
        yield from _of_cluster(formation, window_s, marks, f"_{formation.name}" if i else "")
    if any(len(track.t_ns) for track in flight.tracks):
        yield ReportFigure(
            "plan_view.png",
            "Plan view",
            "True paths from above, with the formation drawn at some instants of simulated time.",
            draw_plan(flight, formations),
        )
        yield ReportFigure(
            "drones.png",
            "Drones",
            "True altitude, state of the firmware and battery of every drone.",
            draw_drones(flight, time_marks(flight, formations[0] if formations else None)),
        )


def _of_cluster(
    formation: Formation, window_s: tuple[float, float], marks: TimeMarks, suffix: str
) -> Iterator[ReportFigure]:
    yield ReportFigure(
        f"figure_5_errors{suffix}.png",
        "Formation parameters' errors (the paper's Figure 5)",
        "Left: the whole run. Right: the window of the statistics, on an axis of its own. "
        "Estimate − desired is what the controller sees; truth − desired is what the drones do. "
        "Until the formation is engaged, the controller takes its own estimate as the desired value.",
        draw_errors(formation, window_s, marks),
    )
    for file, number, what, names in parameter_groups(formation.names):
        yield ReportFigure(
            f"{file}{suffix}.png",
            f"{what} (the paper's Figure {number})",
            f"Desired, measured (from the estimates) and true {', '.join(names)}.",
            draw_parameters(formation, names, what, marks),
        )
