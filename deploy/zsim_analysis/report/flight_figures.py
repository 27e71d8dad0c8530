"""Figures of a flight, sized for a page: those of its formations, as in the paper, and those of its drones.

Formations: errors (Figure 5), position (6), orientation (7) and shape (8). Drones: plan view; altitude, state and
battery; errors of estimates; velocities; errors against references; distances; radio. A few drones get a line or a
column each; larger fleets are drawn as a spread.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import reduce
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Rectangle
from scipy.spatial import ConvexHull, QhullError
from scipy.special import chdtri

from zsim.presentation import colours_of, drone_colours
from zsim.scenario.scenario import Scenario, Surface
from zsim.scenario.surroundings import BOX, CENTRE, COSINE, HALF, SHAPE, SINE, corners_of, placed, row_of
from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.reading import drone_errors
from zsim_analysis.reading.formation import Formation, GoalErrors, common_instants
from zsim_analysis.reading.recorded_flight import Array, RadioHistory, RecordedFlight, Track
from zsim_analysis.reading.shortfall import span_text
from zsim_analysis.report import figure_style as style

EACH_MAX = 4  # maximum number of drones that get a column each on a page
PAIRS_MAX = 6  # maximum number of pairs of drones that get a line each: those of four drones
NAMED_MAX = 12  # maximum number of drones named in a legend
SMALL_PT = style.PAPER_PT - 1.5

# Formations

POSITION = ("x_c", "y_c", "z_c")
ORIENTATION = ("roll", "pitch", "yaw")
ROWS_MAX = 16  # maximum number of parameters in one figure: those of 4 drones, which fill the height of a page
ROW_IN = 1.0  # height of a parameter's panel, with its letter [in]
ROWS_IN = 8.4  # maximum height of all rows [in], on a page of 9.25 in
MOVED_MAX = 3  # number of parameters of a large formation drawn individually


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
    """Draw Figure 5: a row per parameter, its errors against the final goal and the reference, and within the window.

    A large formation has rows for position and orientation, and one for all other parameters of each unit.
    """
    names = list(formation.names)
    if len(names) > ROWS_MAX:
        names = [name for name in (*POSITION, *ORIENTATION) if name in formation.names]
    grouped = _by_unit(name for name in formation.names if name not in names)
    count, columns = len(names) + len(grouped), 3 if goal else 2
    figure = style.new_figure(style.PAGE_IN, 0.8 + min(0.62 * count, ROWS_IN))
    grid = figure.subplots(count, columns, squeeze=False, sharex="col")
    rows = formation.within(window_s)
    all_rows = np.ones(len(rows), bool)
    for name, axes in zip(names, grid, strict=False):
        i = formation.column(name)
        if goal and np.isfinite(goal.goal[i]):  # on an axis that includes the truth during the climb
            _draw_error(axes[0], formation.t_s, goal.true[:, i], goal.est[:, i])
            style.scale(axes[0], goal.true[:, i], goal.est[formation.since_engaged, i])
        elif goal:
            _draw_no_goal(axes[0])
        draw_error(axes[-2], formation, name, all_rows)
        draw_error(axes[-1], formation, name, rows)
        _write_statistics(axes[-1], formation, i, formation.judged(window_s))
        axes[0].set_ylabel(style.label(name), fontsize=style.PAPER_PT)
    for (measure, members), axes in zip(grouped.items(), grid[len(names) :], strict=True):
        if goal:
            _draw_no_goal(axes[0])
        _draw_others(axes[-2], formation, members, all_rows)
        _draw_others(axes[-1], formation, members, rows)
        axes[0].set_ylabel(f"{len(members)} others\n({measure})", fontsize=style.PAPER_PT)
    titles = ("against the final goal", "against the reference", f"the same, {span_text(window_s)}")
    for column, title in zip(grid.T, titles[-columns:], strict=True):
        column[0].set_title(title, fontsize=style.PAPER_PT)
    for axes in grid[:, :-1].flat:
        style.shade_window(axes, window_s)
    for column in grid.T[:-1]:
        style.draw_marks(column, marks)
    style.draw_marks(grid[:, -1], marks, extend=False)
    style.finish(figure, grid[0], grid, 6)
    return figure


def _by_unit(names: Iterable[str]) -> dict[str, list[str]]:
    grouped: dict[str, list[str]] = {}
    for name in names:
        grouped.setdefault(unit(name), []).append(name)
    return grouped


def draw_error(axes: Axes, formation: Formation, name: str, rows: np.ndarray) -> None:
    """Draw the estimated and true errors of a parameter at the samples `rows`."""
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
    """Draw the spread of the true errors of many parameters at the samples `rows`."""
    style.dress(axes)
    axes.axhline(0, color=style.BLACK, lw=0.5, zorder=1)
    errors = formation.true_error[:, [formation.column(name) for name in members]]
    style.draw_spread(axes, formation.t_s[rows], errors[rows], style.BLUE)
    style.scale(axes, errors[rows & formation.since_engaged].ravel())


def _write_statistics(axes: Axes, formation: Formation, i: int, rows: np.ndarray) -> None:
    """Write standard deviations and means beside the axes, in the colours of their lines."""
    missing = "no data" if rows.any() else "not\nengaged"
    for y, error, colour in ((0.75, formation.est_error, style.AMBER), (0.25, formation.true_error, style.BLUE)):
        finite = error[rows, i][np.isfinite(error[rows, i])]
        text = f"std {finite.std():.3g}\nmean {finite.mean():+.2g}" if len(finite) else missing
        text_style = {"transform": axes.transAxes, "fontsize": style.PAPER_PT - 1.5, "va": "center", "linespacing": 1.0}
        axes.text(1.03, y, text, color=colour, **text_style)


def draw_parameters(formation: Formation, names: Sequence[str], marks: style.TimeMarks) -> Figure:
    """Draw Figure 6, 7 or 8: desired, measured and true values of some parameters over the run.

    If there are too many, the figure shows those whose desired value moves most, and the true errors of all.
    """
    shown, grouped, since = list(names), dict[str, list[str]](), formation.since_engaged
    if len(names) > ROWS_MAX:
        spans = {}
        for name in names:
            desired = formation.desired[since, formation.column(name)]
            finite = desired[np.isfinite(desired)]
            spans[name] = float(np.ptp(finite)) if len(finite) else 0.0
        most_moved = sorted(spans, key=lambda name: -spans[name])[:MOVED_MAX]
        shown, grouped = [name for name in names if name in most_moved], _by_unit(names)
    count = max(1, len(shown) + len(grouped))
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
    for (measure, members), axes in zip(grouped.items(), panels[len(shown) :], strict=False):
        _draw_others(axes, formation, members, since)
        axes.set_ylabel(f"errors of\nall {len(members)} ({measure})", fontsize=style.PAPER_PT)
    style.draw_marks(panels[: len(shown) + len(grouped)], marks)
    style.finish(figure, panels, grid, 3)
    return figure


def curves(formation: Formation, name: str) -> tuple[Array, Array, Array]:
    """Return desired, measured and true values of a parameter, angles without jumps at ±π.

    Angles are unwrapped from the engagement on. Before it, the desired value is the noisy estimate, which may wind up
    by whole revolutions; there each value is brought within half a turn of the first desired value after it.
    """
    i = formation.column(name)
    desired = formation.desired[:, i].copy()
    is_known = np.isfinite(desired)
    angle = unit(name) == "rad" and is_known.any()
    is_engaged = is_known & formation.since_engaged
    if angle:
        desired[is_engaged] = np.unwrap(desired[is_engaged])
    lines = desired, desired + formation.est_error[:, i], desired + formation.true_error[:, i]
    if angle:
        is_before, first_value = is_known & ~is_engaged, desired[is_engaged][0] if is_engaged.any() else 0.0
        for each in lines:
            each[is_before] -= 2 * np.pi * np.round((each[is_before] - first_value) / (2 * np.pi))
    return lines


# Plan view

# margin at each end of the plan, as a share of its range, so that marks at its edge are not cut off
MARGIN_SHARE = 0.06
OUTLINES = 7  # maximum number of outlines of a formation in the plan, few enough to be distinguishable
# smallest distance between outlines, as a share of the formation's size; closer ones would overlap
OUTLINE_DISTANCE_MIN = 0.6
RING_MAX = 4  # maximum number of drones whose outline connects them in order; for more, it is their convex hull


def draw_plan(flight: RecordedFlight, formations: Sequence[Formation]) -> Figure:
    """Draw the true paths from above, with the outlines of the formations at several times."""
    figure = style.new_figure(style.COLUMN_IN, 1.15 * style.COLUMN_IN)
    axes = figure.subplots()
    style.dress(axes, "north y (m)")
    axes.set_xlabel("east x (m)", fontsize=style.PAPER_PT)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(MARGIN_SHARE)
    draw_obstacles(axes, flight.scenario)
    colours = drone_colours(len(flight.tracks))
    shows_names = len(flight.tracks) <= NAMED_MAX
    for i, (track, colour) in enumerate(zip(flight.tracks, colours, strict=True)):
        draw_path(axes, track, colour, named=shows_names or i in (0, len(colours) - 1))
    for formation in formations:
        if "x_c" in formation.names and len(formation.t_s):
            desired = np.where(formation.engaged[:, None], formation.desired, np.nan)
            x, y = (desired[:: max(1, len(desired) // 4000), formation.column(name)] for name in ("x_c", "y_c"))
            axes.plot(x, y, color=style.BLACK, lw=0.9, zorder=3, label=f"{formation.name}, desired")
        _draw_outlines(axes, formation, flight.tracks)
    for number, each in enumerate(drone_errors.reference_errors(flight).values()):
        x, y = each.reference[:: max(1, len(each.reference) // 4000), :2].T
        named = None if number else "references"
        axes.plot(x, y, color=style.BLACK, lw=0.7, ls=(0, (4, 2)), zorder=3, label=named)
    style.legend_above(figure, axes, columns=3)
    return figure


def draw_obstacles(axes: Axes, scenario: Scenario | None) -> None:
    """Draw the outlines of a scenario's obstacles (`zsim.scenario.surroundings`) and surfaces from above."""
    for number, surface in enumerate((scenario and scenario.environment.surfaces) or ()):
        _draw_surface(axes, surface, None if number else "surface, the darker the higher")
    look: dict[str, Any] = {"facecolor": "#8c959f99", "edgecolor": style.DARK, "hatch": "///", "lw": 1.0, "zorder": 1.5}
    for number, obstacle in enumerate(scenario.environment.obstacles if scenario else ()):
        row = row_of(obstacle)
        x, y, a = row[CENTRE], row[CENTRE + 1], row[HALF]
        labelled = {**look, "label": None if number else "obstacle"}
        if row[SHAPE] != BOX:
            axes.add_patch(Circle((x, y), a, **labelled))
        else:
            b, angle = row[HALF + 1], math.degrees(math.atan2(row[SINE], row[COSINE]))
            corner = (x - a, y - b)
            axes.add_patch(Rectangle(corner, 2 * a, 2 * b, angle=angle, rotation_point="center", **labelled))


def _draw_surface(axes: Axes, surface: Surface, label: str | None) -> None:
    """Draw the triangles of a surface from above, the highest on top."""
    corners = corners_of(placed(surface))
    corners = corners[np.argsort(corners[..., 2].max(axis=1), kind="stable")]
    heights = corners[..., 2].mean(axis=1)
    look: dict[str, Any] = {"cmap": "Greys", "edgecolors": "face", "lw": 0.3, "zorder": 1.2, "rasterized": True}
    triangles = PolyCollection(list(corners[..., :2]), array=heights, **look)
    low, high = corners[..., 2].min(), corners[..., 2].max()
    triangles.set_clim(low - 0.4 * max(high - low, 0.1), high + 0.8 * max(high - low, 0.1))  # never white, never black
    axes.add_collection(triangles, autolim=False)
    if label:
        axes.add_patch(Rectangle((np.nan, np.nan), 1, 1, facecolor="#8c959f", label=label))


def draw_path(axes: Axes, track: Track, colour: str, named: bool) -> None:
    """Draw a true path from above, with its start and its end."""
    if not len(track.t_ns):
        return
    step = max(1, len(track.t_ns) // 4000)  # a path has no extremes to keep, only a shape
    x, y = track.p_W[::step, 0], track.p_W[::step, 1]
    axes.plot(x, y, color=colour, lw=0.6, alpha=0.7, zorder=2, label=track.name if named else None)
    look: dict[str, Any] = {"color": colour, "ms": 4, "mec": "white", "mew": 0.5, "zorder": 5, "clip_on": False}
    axes.plot(x[0], y[0], marker="s", **look)
    axes.plot(*track.p_W[-1, :2], marker="o", **look)


def _draw_outlines(axes: Axes, formation: Formation, tracks: Sequence[Track]) -> None:
    """Draw the outlines of a formation with their times, skipping outlines that would overlap."""
    members = [track for name in formation.drones for track in tracks if track.name == name]
    t_ns, indices = common_instants(members)
    if not len(t_ns):
        return
    paths_W = np.stack([track.p_W[index, :2] for track, index in zip(members, indices, strict=True)], axis=1)
    outlines: list[Array] = []
    for k in np.linspace(len(t_ns) - 1, 0, OUTLINES).astype(int):
        p_W = paths_W[k]
        centre = p_W.mean(axis=0)
        size = np.linalg.norm(p_W - centre, axis=1).max()
        if any(np.linalg.norm(p_W - other, axis=1).max() <= OUTLINE_DISTANCE_MIN * size for other in outlines):
            continue
        ring = p_W
        if len(p_W) > RING_MAX:
            with suppress(QhullError):  # collinear
                ring = p_W[ConvexHull(p_W).vertices]
        name = None if outlines else f"{formation.name}, at several times"
        outlines.append(p_W)
        axes.fill(ring[:, 0], ring[:, 1], facecolor="#0000000d", edgecolor=style.DARK, lw=0.7, zorder=4, label=name)
        direction = p_W[0] - centre
        offset = 9 * direction / max(float(np.linalg.norm(direction)), 1e-9)
        look: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "va": "center", "fontsize": SMALL_PT}
        look["bbox"] = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.8}
        axes.annotate(f"{t_ns[k] / 1e9:.0f} s", p_W[0], xytext=offset, zorder=6, **look)


# Altitude, state and battery

LANES_IN = 5.0  # maximum height of the panel of states, in units of 0.5 in
LANES_NAMED = 12  # maximum number of drones named beside their states
DRONE_PANELS = ("true altitude (m)", "state", "battery (%)")
STATES = {
    "landed": style.GREY,
    "taking_off": style.ORANGE,
    "hovering": style.SKY,
    "flying": style.BLUE,
    "landing": style.PURPLE,
    "emergency": style.VERMILION,
}


def draw_drones(flight: RecordedFlight, marks: style.TimeMarks) -> Figure:
    """Draw altitude, state and battery of every drone over the run."""
    count = len(flight.tracks)
    heights = drone_panel_heights(count)
    figure = style.new_figure(style.COLUMN_IN, 1.6 + 0.5 * sum(heights))
    panels = figure.subplots(3, 1, sharex=True, height_ratios=heights)
    for axes, quantity in zip(panels, DRONE_PANELS, strict=True):
        style.dress(axes, quantity)
    colours = colours_of([track.name for track in flight.tracks])
    draw_drone_panels(panels, flight.tracks, colours, count if count <= NAMED_MAX else 0)
    name_states(figure, flight.tracks)
    style.draw_marks(panels, marks)
    style.letter_panels(panels)
    figure.align_ylabels()
    style.legend_above(figure, panels[0], columns=3)
    if count > NAMED_MAX:  # the colours change gradually from the first drone to the last
        ends = [list(colours.items())[index] for index in (0, -1)]
        handles = [Line2D([], [], color=colour, lw=1.5, label=name) for name, colour in ends]
        look: dict[str, Any] = {"fontsize": style.PAPER_PT - 1, "title_fontsize": style.PAPER_PT - 1, "frameon": False}
        panels[0].legend(handles=handles, loc="best", title="from … to", **look)
    return figure


def drone_panel_heights(count: int) -> tuple[float, float, float]:
    """Return the heights of DRONE_PANELS for a number of drones."""
    return 3.0, 0.5 + min(0.28 * count, LANES_IN), 2.0


def draw_drone_panels(
    panels: Sequence[Axes], tracks: Sequence[Track], colours: Mapping[str, str], named_count: int
) -> None:
    """Draw drones into the axes of DRONE_PANELS; the legend names the first `named_count`."""
    altitude, state, battery = panels
    for lane, track in enumerate(tracks):
        look = {"color": colours[track.name], "lw": 0.9, "label": track.name if lane < named_count else None}
        style.line(altitude, track.t_ns / 1e9, track.p_W[:, 2], **look)
        style.line(battery, track.status_t_ns / 1e9, track.battery_percent, **look)
        if track.states:
            states = np.array(track.states)
            starts = np.flatnonzero(np.r_[True, states[1:] != states[:-1]])
            edges = np.r_[track.status_t_ns[starts], track.status_t_ns[-1]] / 1e9
            for start, left, right in zip(starts, edges[:-1], edges[1:], strict=True):
                colour = STATES.get(states[start], style.GREEN)
                state.broken_barh([(left, right - left)], (lane - 0.36, 0.72), color=colour)
    step = -(-len(tracks) // LANES_NAMED)
    state.set_yticks(range(0, len(tracks), step), [track.name for track in tracks[::step]])
    state.set_ylim(len(tracks) - 0.5, -0.5)
    state.grid(False)
    style.label_time([battery])


def name_states(figure: Figure, tracks: Sequence[Track]) -> None:
    """Add a legend of the states that occur, below the axes of a figure."""
    occur = [name for name in STATES if any(name in track.states for track in tracks)]
    handles = [Patch(color=STATES[name], label=name.replace("_", " ")) for name in occur]
    if handles:
        columns = 3 if figure.get_size_inches()[0] <= style.COLUMN_IN else 6
        look = {"frameon": False, "fontsize": style.PAPER_PT, "columnspacing": 1.2, "handlelength": 1.2}
        figure.legend(handles=handles, loc="outside lower center", ncols=min(columns, len(handles)), **look)


# Errors of estimates

ERRORS = ("x (m)", "y (m)", "z (m)", "yaw (rad)")
INSIDE = 0.9545  # probability that a normally distributed error is within SIGMAS standard deviations
CONSISTENT = "95 % of χ²"  # range of NEES that contains 95 % of the samples of a consistent estimator
BAND_GREY = "#9aa5b1"  # different from the colours of all time marks
FLOOR = 0.1  # smallest NEES drawn on its logarithmic axis


def draw_estimates(
    errors: Mapping[str, drone_errors.EstimateErrors],
    colours: Mapping[str, str],
    window_s: tuple[float, float],
    marks: style.TimeMarks,
) -> Figure:
    """Draw estimate − truth with its band, and the NEES, of each drone; for many drones their spread."""
    if len(errors) > EACH_MAX:
        return _draw_many_estimates(errors, colours, window_s, marks)
    figure = style.new_figure(style.PAGE_IN, 0.8 + 0.95 * (len(ERRORS) + 1))
    grid = figure.subplots(len(ERRORS) + 1, len(errors), squeeze=False, sharex=True, sharey="row")
    for (name, each), column in zip(errors.items(), grid.T, strict=True):
        rows = _rows(each, window_s)
        inside, finite_nees = each.share_inside(rows), each.nees[rows][np.isfinite(each.nees[rows])]
        for i, axes in enumerate(column[:-1]):
            style.dress(axes)
            bin_s, half = style.thinned(each.t_s, drone_errors.SIGMAS * each.sigma[:, i])
            band = f"±{drone_errors.SIGMAS:g}σ as stated"
            axes.fill_between(bin_s, -half, half, color=BAND_GREY, alpha=0.45, lw=0, zorder=1, label=band)
            axes.axhline(0, color=style.BLACK, lw=0.5, zorder=1)
            look: dict[str, Any] = {"color": colours[name], "lw": 0.6, "zorder": 3, "label": "estimate − truth"}
            style.line(axes, each.t_s, each.error[:, i], **look)
        _draw_nees(column[-1], each.t_s, each.nees, colours[name])
        notes = [f"{100 * share:.0f} % in {drone_errors.SIGMAS:g}σ" for share in inside]
        notes.append(
            f"mean {finite_nees.mean():.3g}, ideal {drone_errors.DEGREES}" if len(finite_nees) else "P is singular"
        )
        column[0].set_title(name, loc="left", fontsize=style.PAPER_PT)
        for axes, note in zip(column, notes, strict=True):  # above the axes, where it covers no data
            axes.set_title(note, loc="right", fontsize=SMALL_PT, pad=2.0)
        style.draw_marks(column, marks)
    since_s = -np.inf if marks.engaged_s is None else marks.engaged_s  # large initial sigmas may leave the axes
    for i, row in enumerate(grid[:-1]):
        limit = 0.0
        for each in errors.values():
            rows = each.t_s >= since_s
            extent = np.maximum(np.abs(each.error[rows, i]), drone_errors.SIGMAS * each.sigma[rows, i])
            limit = max(limit, float(np.nanmax(extent, initial=0.0)))
        if limit > 0:
            row[0].set_ylim(-1.05 * limit, 1.05 * limit)
    for axes, quantity in zip(grid[:, 0], (*ERRORS, "NEES"), strict=True):
        axes.set_ylabel(quantity, fontsize=style.PAPER_PT)
    style.finish(figure, grid[0], grid, 7)
    return figure


def _rows(errors: drone_errors.EstimateErrors, window_s: tuple[float, float]) -> np.ndarray:
    """Return a mask of the samples within the window; if there are none, of all samples."""
    rows = (errors.t_s >= window_s[0]) & (errors.t_s <= window_s[1])
    return rows if rows.any() else np.ones(len(rows), bool)


def _draw_nees(axes: Axes, t_s: Array, nees: Array, colour: str, drone_count: int = 1) -> None:
    """Draw NEES, or its mean over `drone_count` drones, with the 95 % range of a consistent estimator."""
    style.dress(axes)
    low, high = (float(chdtri(drone_count * drone_errors.DEGREES, share)) / drone_count for share in (0.975, 0.025))
    axes.axhspan(low, high, zorder=0.6, label=CONSISTENT, fc="none", ec=BAND_GREY, hatch="////", lw=0.0)
    style.line(axes, t_s, np.maximum(nees, FLOOR), color=colour, lw=0.6, zorder=3)
    axes.set_yscale("log")
    axes.tick_params(which="both", labelsize=style.PAPER_PT - 1)


def _draw_many_estimates(
    errors: Mapping[str, drone_errors.EstimateErrors],
    colours: Mapping[str, str],
    window_s: tuple[float, float],
    marks: style.TimeMarks,
) -> Figure:
    """Draw position error and mean NEES over time, and the statistics of each drone within the window."""
    t_s = reduce(np.intersect1d, (each.t_s for each in errors.values()))  # times at which all drones have an estimate
    indices = [np.searchsorted(each.t_s, t_s) for each in errors.values()]
    pairs = list(zip(errors.values(), indices, strict=True))
    distance = np.column_stack(
        [np.linalg.norm(each.error[index][:, drone_errors.POSITION], axis=1) for each, index in pairs]
    )
    nees = np.column_stack([each.nees[index] for each, index in pairs]).mean(axis=1)
    figure = style.new_figure(style.PAGE_IN, 3.6)
    grid = figure.subplots(2, 2, width_ratios=(1.3, 1), sharex="col")
    style.dress(grid[0, 0], "position error (m)")
    style.draw_spread(grid[0, 0], t_s, distance, style.BLUE)
    is_engaged = t_s >= (marks.engaged_s or 0.0)  # earlier, the initial noise would set the scale
    grid[0, 0].set_ylim(0.0, 1.1 * float(np.max(distance[is_engaged], initial=0.0)) or None)
    _draw_nees(grid[1, 0], t_s, nees, style.BLUE, drone_count=len(errors))
    grid[1, 0].set_yscale("linear")
    grid[1, 0].set_ylabel(f"NEES, mean of {len(errors)}", fontsize=style.PAPER_PT)
    style.draw_marks(grid[:, 0], marks)
    style.label_time(grid[1:, 0])
    numbers, look = np.arange(1, len(errors) + 1), {"c": [colours[name] for name in errors], "s": 14, "zorder": 3}
    statistics = []  # per drone: RMS position error [m], stated RMS [m], mean share of x, y, z within SIGMAS
    for each in errors.values():
        rows = _rows(each, window_s)
        squares = (
            np.mean(np.sum(part[rows][:, drone_errors.POSITION] ** 2, axis=1)) for part in (each.error, each.sigma)
        )
        statistics.append((*map(np.sqrt, squares), each.share_inside(rows)[list(drone_errors.POSITION)].mean()))
    rms, stated_rms, inside = np.array(statistics).T
    upper, lower = grid[:, 1]
    style.dress(upper, "RMS (m)")
    upper.scatter(numbers, rms, clip_on=False, **look)
    upper.plot(numbers, stated_rms, "_", color=style.BLACK, ms=5, zorder=2, label="σ as stated", clip_on=False)
    upper.set_ylim(bottom=0)
    upper.set_title("each drone, within the window", fontsize=style.PAPER_PT)
    style.dress(lower, f"x, y, z in {drone_errors.SIGMAS:g}σ (%)")
    lower.scatter(numbers, 100 * inside, clip_on=False, **look)
    lower.axhline(
        100 * INSIDE, color=style.BLACK, lw=0.7, ls="--", label=f"share of a Gaussian error in {drone_errors.SIGMAS:g}σ"
    )
    lower.set_ylim(top=101)
    lower.set_xlabel("drone, in the order of the scenario", fontsize=style.PAPER_PT)
    style.letter_panels(grid.flat)
    figure.align_ylabels()
    style.legend_above(figure, grid[0, 0], columns=6)
    return figure


# Velocities and distances

VELOCITIES = ("forward (m/s)", "left (m/s)", "up (m/s)", "yaw rate (rad/s)")
GAP_S = 0.5  # lines break where a drone has no samples for longer than this


def draw_velocities(
    responses: Mapping[str, drone_errors.VelocityResponse], colours: Mapping[str, str], marks: style.TimeMarks
) -> Figure:
    """Draw commanded and flown velocity of every drone; for many drones the spread of their difference."""
    if len(responses) > EACH_MAX:
        return _draw_many_velocities(responses, marks)
    figure = style.new_figure(style.PAGE_IN, 0.8 + 0.85 * len(VELOCITIES))
    grid = figure.subplots(len(VELOCITIES), len(responses), squeeze=False, sharex=True, sharey="row")
    for (name, each), column in zip(responses.items(), grid.T, strict=True):
        column[0].set_title(name, fontsize=style.PAPER_PT)
        gaps = np.diff(each.t_s, prepend=each.t_s[0]) > GAP_S
        for i, axes in enumerate(column):
            style.dress(axes, VELOCITIES[i] if axes is grid[i, 0] else "")
            measured, commanded = (np.where(gaps, np.nan, values[:, i]) for values in (each.flown, each.commanded))
            style.line(axes, each.t_s, measured, color=colours[name], lw=0.6, zorder=3, label="flown")
            style.line(axes, each.t_s, commanded, color=style.BLACK, lw=1.0, zorder=2, label="commanded")
        style.draw_marks(column, marks)
    style.finish(figure, grid[0], grid, 7)
    return figure


def _draw_many_velocities(responses: Mapping[str, drone_errors.VelocityResponse], marks: style.TimeMarks) -> Figure:
    """Draw the spread of flown − commanded over all drones."""
    t_s = reduce(np.union1d, (each.t_s for each in responses.values()))
    panels = ("horizontal (m/s)", "up (m/s)", "yaw rate (rad/s)")
    values = np.full((len(panels), len(t_s), len(responses)), np.nan)
    for k, each in enumerate(responses.values()):
        error = each.flown - each.commanded
        columns = np.hypot(error[:, 0], error[:, 1]), error[:, 2], error[:, 3]
        values[:, np.searchsorted(t_s, each.t_s), k] = columns
    figure = style.new_figure(style.COLUMN_IN, 4.0)
    grid = figure.subplots(len(panels), 1, squeeze=False, sharex=True)
    for axes, quantity, table in zip(grid[:, 0], panels, values, strict=True):
        style.dress(axes, quantity)
        style.draw_spread(axes, t_s, table, style.BLUE)
    grid[0, 0].set_title("flown − commanded", fontsize=style.PAPER_PT)
    style.draw_marks(grid[:, 0], marks)
    style.finish(figure, grid[:, 0], grid, 3)
    return figure


REFERENCE_COMPONENTS = ("east (m)", "north (m)", "up (m)", "heading (deg)")  # components of truth − reference


def draw_references(
    errors: Mapping[str, drone_errors.ReferenceErrors], colours: Mapping[str, str], marks: style.TimeMarks
) -> Figure:
    """Draw truth − reference of each drone with a reference of its own; for many drones their spread."""
    figure = style.new_figure(style.COLUMN_IN, 0.9 + 0.85 * len(REFERENCE_COMPONENTS))
    grid = figure.subplots(len(REFERENCE_COMPONENTS), 1, squeeze=False, sharex=True)
    t_s = reduce(np.union1d, (each.t_s for each in errors.values()))
    for i, axes in enumerate(grid[:, 0]):
        style.dress(axes, REFERENCE_COMPONENTS[i])
        scale = math.degrees(1.0) if i == drone_errors.YAW else 1.0
        axes.axhline(0, color=style.BLACK, lw=0.5, zorder=1)
        if len(errors) > NAMED_MAX:
            values = np.full((len(t_s), len(errors)), np.nan)
            for k, each in enumerate(errors.values()):
                values[np.searchsorted(t_s, each.t_s), k] = scale * each.error[:, i]
            style.draw_spread(axes, t_s, values, style.BLUE)
            continue
        for name, each in errors.items():
            gaps = np.diff(each.t_s, prepend=each.t_s[0]) > GAP_S
            error = np.where(gaps, np.nan, scale * each.error[:, i])
            style.line(axes, each.t_s, error, color=colours[name], lw=0.5, zorder=2)
            on_path = np.where(each.on_path, error, np.nan)
            style.line(axes, each.t_s, on_path, color=colours[name], lw=1.2, zorder=3, label=name)
    style.draw_marks(grid[:, 0], marks)
    style.finish(figure, grid[:, 0], grid, 3)
    return figure


def draw_distances(
    distances: drone_errors.Distances,
    separations: drone_errors.Separations,
    colours: Mapping[str, str],
    marks: style.TimeMarks,
) -> Figure:
    """Draw each pair's distance in both drones' colours, and the limits; for many drones, distances to the nearest."""
    figure = style.new_figure(style.COLUMN_IN, 2.5)
    axes = figure.subplots()
    if distances.pairs:
        style.dress(axes, "distance (m)")
        for (one, other), column in zip(distances.pairs, distances.between.T, strict=True):
            look = {"color": colours[one], "gapcolor": colours[other], "ls": (0, (4, 4)), "lw": 1.0}
            axes.plot(distances.t_s, column, label=f"{one} – {other}", **look)
    else:
        style.dress(axes, "nearest drone (m)")
        style.draw_spread(axes, distances.t_s, distances.nearest, style.BLUE)
    axes.set_ylim(bottom=0)
    style.draw_marks([axes], marks)
    for distance_m, name, colour, dashes in (
        (separations.margin_m, "guard acts", style.AMBER, "--"),
        (separations.alarm_m, "alarm", style.VERMILION, "-."),
        (separations.touch_m, "hulls touch", style.VERMILION, "-"),
    ):
        if distance_m:
            axes.axhline(distance_m, color=colour, lw=0.8, ls=dashes, zorder=1.8)
            text_style = {"ha": "right", "va": "bottom", "transform": axes.get_yaxis_transform(), "zorder": 7}
            axes.text(0.995, distance_m, f"{name}: {distance_m:.2g} m", color=colour, fontsize=SMALL_PT, **text_style)
    style.label_time([axes])
    style.legend_above(figure, axes, columns=3)
    return figure


# Radio

CELLS_MAX = 6  # maximum number of drones for which cells have room for a number
DARK_SHARE = 0.6  # share above which a cell is dark and its number white


def draw_radio(radio: RadioHistory, names: Sequence[str], marks: style.TimeMarks) -> Figure:
    """Draw the share of messages received on each link, and how many drones each drone hears over time."""
    figure = style.new_figure(style.PAGE_IN, 2.6)
    matrix, axes = figure.subplots(1, 2, width_ratios=(1, 2))
    style.dress(matrix, "receiver")
    matrix.grid(visible=False)
    image = matrix.imshow(100 * radio.share, cmap="Blues", vmin=0, vmax=100, interpolation="nearest")
    matrix.set_xlabel("sender", fontsize=style.PAPER_PT)
    ticks = range(len(names)) if len(names) <= NAMED_MAX else []
    for axis in (matrix.xaxis, matrix.yaxis):
        axis.set_ticks(ticks, [names[tick] for tick in ticks], fontsize=SMALL_PT)
    matrix.tick_params(axis="x", rotation=90)
    for i, j in np.ndindex(radio.share.shape) if len(names) <= CELLS_MAX else ():
        if i != j:
            look = {"ha": "center", "va": "center", "fontsize": SMALL_PT}
            colour = "white" if radio.share[i, j] > DARK_SHARE else style.BLACK
            matrix.text(j, i, f"{100 * radio.share[i, j]:.0f}", color=colour, **look)
    scale = figure.colorbar(image, ax=matrix)
    scale.set_label("messages that arrive (%)", fontsize=style.PAPER_PT)
    scale.ax.tick_params(labelsize=SMALL_PT)
    t_s = radio.t_ns / 1e9
    style.dress(axes, "drones heard")
    if len(names) > EACH_MAX:
        style.draw_spread(axes, t_s, radio.heard, style.BLUE)
    else:
        for name, colour, received in zip(names, drone_colours(len(names)), radio.heard.T, strict=True):
            style.line(axes, t_s, received, color=colour, lw=1.0, label=name)
    if not radio.connected.all():
        axes.fill_between(
            t_s, 0, 1, where=~radio.connected, transform=axes.get_xaxis_transform(), color=style.GREY, alpha=0.3, lw=0,
            label="not connected",
        )  # fmt: skip
    axes.set_ylim(bottom=0)
    style.draw_marks([axes], marks)
    style.label_time([axes])
    style.letter_panels([matrix, axes])
    style.legend_above(figure, axes, columns=5)
    return figure
