"""Altitude, state of the firmware and battery of every drone, on one time axis."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from zsim.presentation import colours_of
from zsim_analysis.reading.recorded_flight import RecordedFlight, Track
from zsim_analysis.report.figures.plan_view import NAMED_MAX
from zsim_analysis.report.figures.time_marks import TimeMarks, draw_marks
from zsim_analysis.report.pages import (
    BLUE,
    COLUMN_IN,
    GREEN,
    GREY,
    ORANGE,
    PAPER_PT,
    PURPLE,
    SKY,
    VERMILION,
    dress,
    label_time,
    legend_above,
    letter_panels,
    line,
    new_figure,
)

LANES_IN = 5.0  # of states: half of it on the page; more drones share it
LANES_NAMED = 12  # of them, at most
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
    heights = drone_panel_heights(count)
    figure = new_figure(COLUMN_IN, 1.6 + 0.5 * sum(heights))
    panels = figure.subplots(3, 1, sharex=True, height_ratios=heights)
    for axes, quantity in zip(panels, DRONE_PANELS, strict=True):
        dress(axes, quantity)
    colours = colours_of([track.name for track in flight.tracks])
    draw_drone_panels(panels, flight.tracks, colours, count if count <= NAMED_MAX else 0)
    name_states(figure, flight.tracks)
    draw_marks(panels, marks)
    letter_panels(panels)
    figure.align_ylabels()
    legend_above(figure, panels[0], columns=3)
    if count > NAMED_MAX:
        name_ends(panels[0], list(colours.items()))
    return figure


def name_ends(axes: Axes, colours: Sequence[tuple[str, str]]) -> None:
    """Name the first and the last of many drones, between which the colours change by and by, below the axes' top."""
    ends = [Line2D([], [], color=tint, lw=1.5, label=name) for name, tint in (colours[0], colours[-1])]
    axes.legend(
        handles=ends, loc="best", fontsize=PAPER_PT - 1, frameon=False, title="from … to", title_fontsize=PAPER_PT - 1
    )


def drone_panel_heights(count: int) -> tuple[float, float, float]:
    """Return the heights of DRONE_PANELS for so many drones."""
    return 3.0, 0.5 + min(0.28 * count, LANES_IN), 2.0


def draw_drone_panels(panels: Sequence[Axes], tracks: Sequence[Track], colours: Mapping[str, str], named: int) -> None:
    """Draw drones into the axes of DRONE_PANELS.

    Args:
        panels: axes of altitude, state and battery.
        tracks: of the drones.
        colours: of the drones, by name.
        named: how many of them the legend is to name.
    """
    altitude, state, battery = panels
    for lane, track in enumerate(tracks):
        style = {"color": colours[track.name], "lw": 0.9, "label": track.name if lane < named else None}
        line(altitude, track.t_ns / 1e9, track.p_W[:, 2], **style)
        line(battery, track.status_t_ns / 1e9, track.battery_percent, **style)
        draw_states(state, track, lane)
    step = -(-len(tracks) // LANES_NAMED)
    state.set_yticks(range(0, len(tracks), step), [track.name for track in tracks[::step]])
    state.set_ylim(len(tracks) - 0.5, -0.5)
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


def name_states(figure: Figure, tracks: Sequence[Track]) -> None:
    """Put the names of the states that occur below the axes of a figure."""
    occur = [name for name in STATES if any(name in track.states for track in tracks)]
    handles = [Patch(color=STATES[name], label=name.replace("_", " ")) for name in occur]
    if handles:
        columns = 3 if figure.get_size_inches()[0] <= COLUMN_IN else 6
        look = {"frameon": False, "fontsize": PAPER_PT, "columnspacing": 1.2, "handlelength": 1.2}
        figure.legend(handles=handles, loc="outside lower center", ncols=min(columns, len(handles)), **look)
