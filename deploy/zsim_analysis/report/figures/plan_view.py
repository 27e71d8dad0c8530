"""The plan view: true paths from above, with the obstacles and the formation drawn at some instants."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch, Rectangle
from scipy.spatial import ConvexHull, QhullError

from zsim.presentation import drone_colours
from zsim.scenario.obstacle import BOX, CENTRE, COSINE, HALF, SHAPE, SINE, row_of
from zsim.scenario.scenario import Scenario
from zsim_analysis.reading.formation import Formation, common_instants
from zsim_analysis.reading.recorded_flight import Array, RecordedFlight, Track
from zsim_analysis.report.pages import BLACK, COLUMN_IN, DARK, PAPER_PT, dress, legend_above, new_figure

ROOM = 0.06  # of the plan's range, at each end: marks at its edge are whole
OUTLINES = 7  # formations drawn into the plan, few enough to be distinct
APART = 0.6  # of the formation's own size: outlines nearer than this would cover each other
NAMED_MAX = 12  # drones that a legend names
RING_MAX = 4  # drones whose outline is drawn through them in their order; of more it is their hull


def draw_plan(flight: RecordedFlight, formations: Sequence[Formation]) -> Figure:
    """Return the true paths from above with the outlines of the formations at some instants."""
    figure = new_figure(COLUMN_IN, 1.15 * COLUMN_IN)
    axes = figure.subplots()
    dress(axes, "north y (m)")
    axes.set_xlabel("east x (m)", fontsize=PAPER_PT)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(ROOM)
    draw_obstacles(axes, flight.scenario)
    colours = drone_colours(len(flight.tracks))
    few = len(flight.tracks) <= NAMED_MAX
    for i, (track, colour) in enumerate(zip(flight.tracks, colours, strict=True)):
        draw_path(axes, track, colour, named=few or i in (0, len(colours) - 1))
    for formation in formations:
        _draw_desired(axes, formation)
        _draw_outlines(axes, formation, flight.tracks)
    legend_above(figure, axes, columns=3)
    return figure


def draw_obstacles(axes: Axes, scenario: Scenario | None) -> None:
    """Draw the outlines of a scenario's obstacles from above; the first one names them."""
    for number, obstacle in enumerate(scenario.environment.obstacles if scenario else ()):
        look = {"facecolor": "#8c959f99", "edgecolor": DARK, "hatch": "///", "lw": 1.0, "zorder": 1.5}
        patch = _outline(row_of(obstacle), {**look, "label": None if number else "obstacle"})
        axes.add_patch(patch)


def _outline(row: Sequence[float], look: dict[str, Any]) -> Patch:
    """Return an obstacle's shape from above; rows as in `zsim.scenario.obstacle`."""
    x, y = row[CENTRE], row[CENTRE + 1]
    if row[SHAPE] != BOX:
        return Circle((x, y), row[HALF], **look)
    a, b = row[HALF], row[HALF + 1]
    angle = math.degrees(math.atan2(row[SINE], row[COSINE]))
    return Rectangle((x - a, y - b), 2 * a, 2 * b, angle=angle, rotation_point="center", **look)


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


def _draw_desired(axes: Axes, formation: Formation) -> None:
    if "x_c" in formation.names and len(formation.t_s):
        engaged = np.array([phase == "engaged" for phase in formation.phases])
        desired = np.where(engaged[:, None], formation.desired, np.nan)
        x, y = (desired[:, formation.column(name)] for name in ("x_c", "y_c"))
        step = max(1, len(x) // 4000)
        axes.plot(x[::step], y[::step], color=BLACK, lw=0.9, zorder=3, label=f"{formation.name}, desired")


def _draw_outlines(axes: Axes, formation: Formation, tracks: Sequence[Track]) -> None:
    members = [track for name in formation.drones for track in tracks if track.name == name]
    for number, (t_s, p_W) in enumerate(outlines(members)):
        ring = p_W if len(p_W) <= RING_MAX else _hull(p_W)
        name = None if number else f"{formation.name}, at times"
        axes.fill(ring[:, 0], ring[:, 1], facecolor="#0000000d", edgecolor=DARK, lw=0.7, zorder=4, label=name)
        out = p_W[0] - p_W.mean(axis=0)
        away = out / max(float(np.linalg.norm(out)), 1e-9)
        axes.annotate(
            f"{t_s:.0f} s",
            p_W[0],
            xytext=9 * away,
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=PAPER_PT - 1.5,
            zorder=6,
            bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.8},
        )


def _hull(p_W: Array) -> Array:
    """Return the corners (h, 2) of the convex hull of positions (n, 2); all of them where they stand in one line."""
    try:
        return p_W[ConvexHull(p_W).vertices]
    except QhullError:
        return p_W


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
