"""The paper's figures of a formation: errors (5), position (6), orientation (7) and shape (8), sized for a page."""

from collections.abc import Iterable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.reading.formation import Formation, GoalErrors
from zsim_analysis.reading.recorded_flight import Array
from zsim_analysis.reading.shortfall import span_text
from zsim_analysis.report import figure_style as style

POSITION = ("x_c", "y_c", "z_c")
ORIENTATION = ("roll", "pitch", "yaw")
ROWS_MAX = 16  # parameters in one figure; 4 drones, and the height of a page
ROW_IN = 1.0  # height of a parameter over time, with its letter
ROWS_IN = 8.4  # of all rows, on a page of 9.25 in
MOVED_MAX = 3  # parameters of a large formation that are drawn individually


def parameter_groups(names: Sequence[str]) -> list[tuple[str, int, str, list[str]]]:
    """Return the paper's figures of parameters over time: file, number, title and parameter names."""
    position, orientation = ([name for name in group if name in names] for group in (POSITION, ORIENTATION))
    shape = [name for name in names if name not in POSITION + ORIENTATION and "phi" not in name]
    return [
        ("figure_6_position", 6, "Position of the formation", position),
        ("figure_7_orientation", 7, "Orientation of the formation", orientation),
        ("figure_8_shape", 8, "Shape of the formation", shape),
    ]


def numbered(number: int, paper: bool) -> str:
    """Return the end of a title that names the paper's figure; empty for flights other than the paper's."""
    return f" (the paper's Figure {number})" if paper else ""


def draw_errors(
    formation: Formation, window_s: tuple[float, float], marks: style.TimeMarks, goal: GoalErrors | None = None
) -> Figure:
    """Draw Figure 5: a row per parameter, errors against the final goal, the reference, and within the window.

    A large formation has rows for position and orientation, and one for all other parameters of each unit.
    """
    names = list(formation.names)
    if len(names) > ROWS_MAX:
        names = [name for name in (*POSITION, *ORIENTATION) if name in formation.names]
    others = _by_unit(name for name in formation.names if name not in names)
    count, columns = len(names) + len(others), 3 if goal else 2
    figure = style.new_figure(style.PAGE_IN, 0.8 + min(0.62 * count, ROWS_IN))
    grid = figure.subplots(count, columns, squeeze=False, sharex="col")
    rows = formation.within(window_s)
    every = np.ones(len(rows), bool)
    for name, axes in zip(names, grid, strict=False):
        i = formation.column(name)
        if goal and np.isfinite(goal.goal[i]):  # on an axis that includes its truth during the climb
            _draw_error(axes[0], formation.t_s, goal.true[:, i], goal.est[:, i])
            style.scale(axes[0], goal.true[:, i], goal.est[formation.since_engaged, i])
        elif goal:
            _draw_no_goal(axes[0])
        draw_error(axes[-2], formation, name, every)
        draw_error(axes[-1], formation, name, rows)
        _write_statistics(axes[-1], formation, i, formation.judged(window_s))
        axes[0].set_ylabel(style.label(name), fontsize=style.PAPER_PT)
    for (measure, members), axes in zip(others.items(), grid[len(names) :], strict=True):
        if goal:
            _draw_no_goal(axes[0])
        _draw_others(axes[-2], formation, members, every)
        _draw_others(axes[-1], formation, members, rows)
        axes[0].set_ylabel(f"{len(members)} others\n({measure})", fontsize=style.PAPER_PT)
    titles = ("against the final goal", "against the reference", f"the same, {span_text(window_s)}")
    for column, title in zip(grid.T, titles[-columns:], strict=True):
        column[0].set_title(title, fontsize=style.PAPER_PT)
    for axes in grid[:, :-1].flat:
        style.shade_window(axes, window_s)
    for column in grid.T[:-1]:
        style.draw_marks(column, marks)
    style.draw_marks(grid[:, -1], marks, whole=False)
    style.finish(figure, grid[0], grid, 6)
    return figure


def _by_unit(names: Iterable[str]) -> dict[str, list[str]]:
    grouped: dict[str, list[str]] = {}
    for name in names:
        grouped.setdefault(unit(name), []).append(name)
    return grouped


def draw_error(axes: Axes, formation: Formation, name: str, rows: np.ndarray) -> None:
    """Draw the estimated and true errors of a parameter at the instants `rows`."""
    i, since = formation.column(name), formation.since_engaged[rows]
    _draw_error(axes, formation.t_s[rows], formation.true_error[rows, i], formation.est_error[rows, i])
    style.scale(axes, formation.true_error[rows, i][since], formation.est_error[rows, i][since])


def _draw_error(axes: Axes, t_s: Array, true: Array, est: Array) -> None:
    style.dress(axes)
    axes.axhline(0, color=style.BLACK, lw=0.5, zorder=1)
    style.line(axes, t_s, true, label="true", **style.TRUE)
    style.line(axes, t_s, est, label="measured (estimates)", **style.MEASURED)


def _draw_no_goal(axes: Axes) -> None:
    axes.set_yticks([])
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(labelsize=style.PAPER_PT - 1)
    axes.text(
        0.5, 0.5, "not in the target", transform=axes.transAxes, ha="center", va="center", fontsize=style.PAPER_PT - 1
    )


def _draw_others(axes: Axes, formation: Formation, members: Sequence[str], rows: np.ndarray) -> None:
    """Draw the spread of the true errors of many parameters at the instants `rows`."""
    style.dress(axes)
    axes.axhline(0, color=style.BLACK, lw=0.5, zorder=1)
    errors = formation.true_error[:, [formation.column(name) for name in members]]
    style.draw_spread(axes, formation.t_s[rows], errors[rows], style.BLUE)
    style.scale(axes, errors[rows & formation.since_engaged].ravel())


def _write_statistics(axes: Axes, formation: Formation, i: int, rows: np.ndarray) -> None:
    """Write standard deviations and means beside the axes, in the colours of their lines."""
    missing = "no data" if rows.any() else "not\nengaged"
    for y, error, colour in ((0.75, formation.est_error, style.AMBER), (0.25, formation.true_error, style.BLUE)):
        known = error[rows, i][np.isfinite(error[rows, i])]
        text = f"std {known.std():.3g}\nmean {known.mean():+.2g}" if len(known) else missing
        place = {"transform": axes.transAxes, "fontsize": style.PAPER_PT - 1.5, "va": "center", "linespacing": 1.0}
        axes.text(1.03, y, text, color=colour, **place)


def draw_parameters(formation: Formation, names: Sequence[str], marks: style.TimeMarks) -> Figure:
    """Draw Figure 6, 7 or 8: desired, measured and true values of some parameters over the run.

    If there are too many, the figure shows those whose desired value moves most, and the true errors of all.
    """
    shown, others, since = list(names), dict[str, list[str]](), formation.since_engaged
    if len(names) > ROWS_MAX:
        spans = {}
        for name in names:
            desired = formation.desired[since, formation.column(name)]
            known = desired[np.isfinite(desired)]
            spans[name] = float(np.ptp(known)) if len(known) else 0.0
        most = sorted(spans, key=lambda name: -spans[name])[:MOVED_MAX]
        shown, others = [name for name in names if name in most], _by_unit(names)
    count = max(1, len(shown) + len(others))
    figure = style.new_figure(style.COLUMN_IN, 0.75 + min(ROW_IN * count, ROWS_IN))
    grid = figure.subplots(count, 1, squeeze=False, sharex=True)
    panels = grid[:, 0]
    for name, axes in zip(shown, panels, strict=False):
        style.dress(axes, style.label(name))
        desired, measured, true = curves(formation, name)
        style.line(axes, formation.t_s, true, label="true", **style.TRUE)
        style.line(axes, formation.t_s, measured, label="measured", **style.MEASURED)
        style.line(axes, formation.t_s, desired, label="desired", **style.DESIRED)
        style.scale(axes, true, measured[since], desired[since])
    for (measure, members), axes in zip(others.items(), panels[len(shown) :], strict=False):
        _draw_others(axes, formation, members, since)
        axes.set_ylabel(f"errors of\nall {len(members)} ({measure})", fontsize=style.PAPER_PT)
    style.draw_marks(panels[: len(shown) + len(others)], marks)
    style.finish(figure, panels, grid, 3)
    return figure


def curves(formation: Formation, name: str) -> tuple[Array, Array, Array]:
    """Return desired, measured and true values of a parameter, angles without jumps at ±π.

    Angles are unwrapped from the engagement on. Before it, the desired value is the noisy estimate, which may wind up
    by whole revolutions; there each value is brought within half a turn of the first desired one.
    """
    i = formation.column(name)
    desired = formation.desired[:, i].copy()
    known = np.isfinite(desired)
    angle = unit(name) == "rad" and known.any()
    since = known & formation.since_engaged
    if angle:
        desired[since] = np.unwrap(desired[since])
    lines = desired, desired + formation.est_error[:, i], desired + formation.true_error[:, i]
    if angle:
        before, first = known & ~since, desired[since][0] if since.any() else 0.0
        for each in lines:
            each[before] -= 2 * np.pi * np.round((each[before] - first) / (2 * np.pi))
    return lines
