"""The paper's figures of a formation: errors (5), position (6), orientation (7) and shape (8), fit for its page."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.reading.formation import Formation
from zsim_analysis.reading.goal import GoalErrors
from zsim_analysis.reading.recorded_flight import Array
from zsim_analysis.reading.window_text import span_text
from zsim_analysis.report.figures.spread import draw_spread
from zsim_analysis.report.figures.time_marks import TimeMarks, draw_marks, shade_window
from zsim_analysis.report.pages import (
    BLACK,
    BLUE,
    COLUMN_IN,
    DESIRED,
    MEASURED,
    PAGE_IN,
    PAPER_PT,
    TRUE,
    dress,
    label,
    label_time,
    legend_above,
    letter_panels,
    line,
    new_figure,
    padded_range,
)

POSITION = ("x_c", "y_c", "z_c")
ORIENTATION = ("roll", "pitch", "yaw")
ROWS_MAX = 16  # parameters in one figure; 4 drones, and the height of a page
ROW_IN = 1.0  # of a parameter over time, with its letter
ROWS_IN = 8.4  # of all rows, on a page of 9.25 in
MOVED_MAX = 3  # parameters of a large formation that are drawn one by one


def draw_errors(
    formation: Formation, window_s: tuple[float, float], marks: TimeMarks, goal: GoalErrors | None = None
) -> Figure:
    """Return Figure 5: a row per parameter, errors against the final goal, the reference, and within the window.

    Of a large formation the rows are its position and orientation, and all others together, by their unit.
    """
    names = list(formation.names) if len(formation.names) <= ROWS_MAX else _frame(formation.names)
    others = _by_unit(name for name in formation.names if name not in names)
    count, columns = len(names) + len(others), 3 if goal else 2
    figure = new_figure(PAGE_IN, 0.8 + min(0.62 * count, ROWS_IN))
    grid = figure.subplots(count, columns, squeeze=False, sharex="col")
    rows = formation.within(window_s)
    every = np.ones(len(rows), bool)
    for name, axes in zip(names, grid, strict=False):
        if goal:
            _draw_goal(axes[0], formation, goal, name)
        draw_error(axes[-2], formation, name, every)
        draw_error(axes[-1], formation, name, rows)
        _write_statistics(axes[-1], formation, name, formation.judged(window_s))
        axes[0].set_ylabel(label(name), fontsize=PAPER_PT)
    for (measure, members), axes in zip(others.items(), grid[len(names) :], strict=True):
        if goal:
            _draw_no_goal(axes[0])
        _draw_others(axes[-2], formation, members, every)
        _draw_others(axes[-1], formation, members, rows)
        axes[0].set_ylabel(f"{len(members)} others\n({measure})", fontsize=PAPER_PT)
    _finish_errors(figure, grid, window_s, marks)
    return figure


def _finish_errors(figure: Figure, grid: Any, window_s: tuple[float, float], marks: TimeMarks) -> None:
    titles = ("against the final goal", "against the reference", f"the same, {span_text(window_s)}")
    for column, title in zip(grid.T, titles[-grid.shape[1] :], strict=True):
        column[0].set_title(title, fontsize=PAPER_PT)
    letter_panels(grid[0])
    for axes in grid[:, :-1].flat:
        shade_window(axes, window_s)
    for column in grid.T[:-1]:
        draw_marks(column, marks)
    draw_marks(grid[:, -1], marks, whole=False)
    label_time(grid[-1])
    figure.align_ylabels(grid[:, 0])
    legend_above(figure, grid[0, 0], columns=6)


def _frame(names: Sequence[str]) -> list[str]:
    return [name for name in (*POSITION, *ORIENTATION) if name in names]


def _by_unit(names: Any) -> dict[str, list[str]]:
    grouped: dict[str, list[str]] = {}
    for name in names:
        grouped.setdefault(unit(name), []).append(name)
    return grouped


def _draw_goal(axes: Axes, formation: Formation, goal: GoalErrors, name: str) -> None:
    """Draw the errors of a parameter against the final goal: those of its truth before the engagement count too."""
    i = formation.column(name)
    if not np.isfinite(goal.goal[i]):
        _draw_no_goal(axes)
        return
    dress(axes)
    axes.axhline(0, color=BLACK, lw=0.5, zorder=1)
    line(axes, formation.t_s, goal.true[:, i], label="true", **TRUE)
    line(axes, formation.t_s, goal.est[:, i], label="measured (estimates)", **MEASURED)
    scale(axes, goal.true[:, i], goal.est[formation.since_engaged, i])


def _draw_no_goal(axes: Axes) -> None:
    axes.set_yticks([])
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(labelsize=PAPER_PT - 1)
    axes.text(0.5, 0.5, "not in the target", transform=axes.transAxes, ha="center", va="center", fontsize=PAPER_PT - 1)


def _draw_others(axes: Axes, formation: Formation, members: Sequence[str], rows: np.ndarray) -> None:
    """Draw the true errors of many parameters at some instants as their spread."""
    dress(axes)
    axes.axhline(0, color=BLACK, lw=0.5, zorder=1)
    errors = formation.true_error[:, [formation.column(name) for name in members]]
    draw_spread(axes, formation.t_s[rows], errors[rows], BLUE)
    scale(axes, errors[rows & formation.since_engaged].ravel())


def draw_error(axes: Axes, formation: Formation, name: str, rows: np.ndarray) -> None:
    """Draw the errors of a parameter, estimated and true, at some instants."""
    i = formation.column(name)
    dress(axes)
    axes.axhline(0, color=BLACK, lw=0.5, zorder=1)
    line(axes, formation.t_s[rows], formation.true_error[rows, i], label="true", **TRUE)
    line(axes, formation.t_s[rows], formation.est_error[rows, i], label="measured (estimates)", **MEASURED)
    judged = rows & formation.since_engaged
    scale(axes, formation.true_error[judged, i], formation.est_error[judged, i])


def _write_statistics(axes: Axes, formation: Formation, name: str, rows: np.ndarray) -> None:
    """Write standard deviations and means beside the axes, in the colours of their lines."""
    i, missing = formation.column(name), "no data" if rows.any() else "not\nengaged"
    for y, error, style in ((0.75, formation.est_error, MEASURED), (0.25, formation.true_error, TRUE)):
        known = error[rows, i][np.isfinite(error[rows, i])]
        text = f"std {known.std():.3g}\nmean {known.mean():+.2g}" if len(known) else missing
        place = {"transform": axes.transAxes, "fontsize": PAPER_PT - 1.5, "va": "center", "linespacing": 1.0}
        axes.text(1.03, y, text, color=_darker(style["color"]), **place)


def _darker(colour: str) -> str:
    """Return a colour that can be read as small print on white."""
    return {"#e69f00": "#9a6a00"}.get(colour, colour)


def draw_parameters(formation: Formation, names: Sequence[str], marks: TimeMarks) -> Figure:
    """Return Figure 6, 7 or 8: desired, measured and true values of some parameters over the run.

    Of more than fit, those whose desired value moves most, and the spread of the true errors of all.
    """
    shown = list(names) if len(names) <= ROWS_MAX else _moved_most(formation, names)
    others = _by_unit(names) if len(names) > ROWS_MAX else {}
    count = max(1, len(shown) + len(others))
    figure = new_figure(COLUMN_IN, 0.75 + min(ROW_IN * count, ROWS_IN))
    grid = figure.subplots(count, 1, squeeze=False, sharex=True)[:, 0]
    for name, axes in zip(shown, grid, strict=False):
        dress(axes, label(name))
        desired, measured, true = curves(formation, name)
        line(axes, formation.t_s, true, label="true", **TRUE)
        line(axes, formation.t_s, measured, label="measured", **MEASURED)
        line(axes, formation.t_s, desired, label="desired", **DESIRED)
        since = formation.since_engaged
        scale(axes, true, measured[since], desired[since])
    for (measure, members), axes in zip(others.items(), grid[len(shown) :], strict=False):
        _draw_others(axes, formation, members, formation.since_engaged)
        axes.set_ylabel(f"errors of\nall {len(members)} ({measure})", fontsize=PAPER_PT)
    draw_marks(list(grid[: len(shown) + len(others)]), marks)
    letter_panels(grid)
    label_time(grid[-1:])
    figure.align_ylabels(grid)
    legend_above(figure, grid[0], columns=3)
    return figure


def _moved_most(formation: Formation, names: Sequence[str]) -> list[str]:
    """Return the parameters whose desired value moves most once engaged, in their own order."""
    desired = formation.desired[formation.since_engaged]
    columns = {name: desired[:, formation.column(name)] for name in names}
    spans = {name: _span(each) for name, each in columns.items()}
    most = sorted(spans, key=lambda name: -spans[name])[:MOVED_MAX]
    return [name for name in names if name in most]


def _span(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.ptp(known)) if len(known) else 0.0


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


def numbered(number: int, paper: bool) -> str:
    """Return what a title says of the figure of the paper that its own shows; nothing of any other flight."""
    return f" (the paper's Figure {number})" if paper else ""
