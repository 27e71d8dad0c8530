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
from zsim_analysis.reading.formation import Formation, common_instants
from zsim_analysis.report.pages import (
    BLACK,
    BLUE,
    DARK,
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
)
from zsim_analysis.report.summary import RunSummary

POSITION = ("x_c", "y_c", "z_c")
ORIENTATION = ("roll", "pitch", "yaw")
MARK_MAX = 110  # characters in a line above a figure
ROWS_MAX = 24  # parameters in one figure; 6 drones


def draw_errors(formation: Formation, window_s: tuple[float, float]) -> Figure:
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


def draw_parameters(formation: Formation, names: Sequence[str], title: str) -> Figure:
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
    label_time(grid[-1:])
    grid[0].set_title(f"{title}, cluster {formation.name}", fontsize=11, loc="left")
    figure.align_ylabels(grid)
    legend_above(figure, grid[0])
    return figure


def curves(formation: Formation, name: str) -> tuple[Array, Array, Array]:
    """Return desired, measured and true values of a parameter; angles without jumps at ±π."""
    i = formation.column(name)
    desired = formation.desired[:, i].copy()
    known = np.isfinite(desired)
    if unit(name) == "rad":
        desired[known] = np.unwrap(desired[known])
    return desired, desired + formation.est_error[:, i], desired + formation.true_error[:, i]


def parameter_groups(names: Sequence[str]) -> list[tuple[str, int, str, list[str]]]:
    """Return the paper's figures of parameters over time: file, number, title, and which of the names each shows."""
    shape = [name for name in names if name not in POSITION + ORIENTATION and "phi" not in name]
    return [
        ("figure_6_position", 6, "Position of the formation", [name for name in POSITION if name in names]),
        ("figure_7_orientation", 7, "Orientation of the formation", [name for name in ORIENTATION if name in names]),
        ("figure_8_shape", 8, "Shape of the formation", shape),
    ]


OUTLINES = 7  # formations drawn into the plan, few enough to be distinct
APART = 0.6  # of the formation's own size: outlines nearer than this would cover each other
DRONE_PANELS = ("true altitude (m)", "state", "battery (%)")
NAMED_MAX = 12  # drones that a legend names
STATES = {
    "landed": GREY,
    "taking_off": ORANGE,
    "hovering": SKY,
    "flying": BLUE,
    "landing": PURPLE,
    "emergency": VERMILION,
}


def draw_plan(flight: RecordedFlight, formations: Sequence[Formation]) -> Figure:
    """Return the true paths from above with the outlines of the formations at some instants."""
    figure = new_figure(9, 9)
    axes = figure.subplots()
    dress(axes, "north y (m)")
    axes.set_xlabel("east x (m)", fontsize=10)
    axes.set_aspect("equal", adjustable="datalim")
    for i, track in enumerate(flight.tracks):
        draw_path(axes, track, drone_colour(i), named=i < NAMED_MAX)
    for formation in formations:
        _draw_desired(axes, formation)
        _draw_outlines(axes, formation, flight.tracks)
    legend_above(figure, axes, columns=4)
    return figure


def draw_path(axes: Axes, track: Track, colour: str, named: bool) -> None:
    """Draw a true path from above, with its start and its end."""
    if not len(track.t_ns):
        return
    step = max(1, len(track.t_ns) // 4000)  # a path has no extremes to keep, only a shape
    x, y = track.p_W[::step, 0], track.p_W[::step, 1]
    axes.plot(x, y, color=colour, lw=0.8, alpha=0.6, zorder=2, label=track.name if named else None)
    axes.plot(x[0], y[0], marker="s", color=colour, ms=7, mec="white", zorder=5)
    axes.plot(*track.p_W[-1, :2], marker="o", color=colour, ms=7, mec="white", zorder=5)


def _draw_desired(axes: Axes, formation: Formation) -> None:
    if "x_c" in formation.names and len(formation.t_s):
        engaged = np.array([phase == "engaged" for phase in formation.phases])
        desired = np.where(engaged[:, None], formation.desired, np.nan)
        x, y = (desired[:, formation.column(name)] for name in ("x_c", "y_c"))
        step = max(1, len(x) // 4000)
        axes.plot(x[::step], y[::step], color=BLACK, lw=1.3, zorder=3, label=f"desired centroid of {formation.name}")


def _draw_outlines(axes: Axes, formation: Formation, tracks: Sequence[Track]) -> None:
    members = [track for name in formation.drones for track in tracks if track.name == name]
    for t_s, p_W in outlines(members):
        ring = np.vstack([p_W, p_W[:1]])
        axes.fill(ring[:, 0], ring[:, 1], facecolor="#0000000d", edgecolor=DARK, lw=1.2, zorder=4)
        out = p_W[0] - p_W.mean(axis=0)
        away = out / max(float(np.linalg.norm(out)), 1e-9)
        axes.annotate(
            f"{t_s:.0f} s",
            p_W[0],
            xytext=18 * away,
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=9,
            zorder=6,
            bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.8},
        )


def outlines(members: Sequence[Track]) -> Iterator[tuple[float, Array]]:
    """Yield times [s] and positions (n, 2) [m] at which the outlines of a formation do not cover each other."""
    t_ns, places = common_instants(list(members))
    if not len(t_ns):
        return
    p_W = np.stack([track.p_W[place, :2] for track, place in zip(members, places, strict=True)], axis=1)
    drawn: list[Array] = []
    for k in np.linspace(len(t_ns) - 1, 0, OUTLINES).astype(int):
        size = np.linalg.norm(p_W[k] - p_W[k].mean(axis=0), axis=1).max()
        if all(np.linalg.norm(p_W[k] - other, axis=1).max() > APART * size for other in drawn):
            drawn.append(p_W[k])
            yield float(t_ns[k]) / 1e9, p_W[k]


def draw_drones(flight: RecordedFlight) -> Figure:
    """Return altitude, state and battery of every drone over the run."""
    count = len(flight.tracks)
    figure = new_figure(11, 6.4 + 0.28 * count)
    panels = figure.subplots(3, 1, sharex=True, height_ratios=drone_panel_heights(count))
    for axes, quantity in zip(panels, DRONE_PANELS, strict=True):
        dress(axes, quantity)
    draw_drone_panels(panels, flight.tracks, {track.name: i for i, track in enumerate(flight.tracks)}, NAMED_MAX)
    name_states(panels[1], flight.tracks)
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
        yield from _of_cluster(formation, window_s, f"_{formation.name}" if i else "")
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
            draw_drones(flight),
        )


def _of_cluster(formation: Formation, window_s: tuple[float, float], suffix: str) -> Iterator[ReportFigure]:
    yield ReportFigure(
        f"figure_5_errors{suffix}.png",
        "Formation parameters' errors (the paper's Figure 5)",
        "Left: the whole run. Right: the window of the statistics, on an axis of its own. "
        "Estimate − desired is what the controller sees; truth − desired is what the drones do. "
        "Until the formation is engaged, the controller takes its own estimate as the desired value.",
        draw_errors(formation, window_s),
    )
    for file, number, what, names in parameter_groups(formation.names):
        yield ReportFigure(
            f"{file}{suffix}.png",
            f"{what} (the paper's Figure {number})",
            f"Desired, measured (from the estimates) and true {', '.join(names)}.",
            draw_parameters(formation, names, what),
        )
