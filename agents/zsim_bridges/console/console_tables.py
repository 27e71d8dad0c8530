"""What the console shows of the newest views, as tables.

Order of this file: HTML, which is pure and in which all texts of other processes are escaped; rows.
"""

import math
import zlib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from html import escape
from typing import NamedTuple

from zsim_bridges.console.alarms import (
    LATE_MS,
    LINK_LOSS_PERCENT,
    LINK_OLD_MS,
    Severity,
    battery_severity,
)
from zsim_bridges.console.run_condition import LINK_SILENT_S, Check
from zsim_bridges.console.run_monitor import FlightFigures
from zsim_bridges.console.view_buffer import EventRow, ReceivedEstimate, ReceivedLink, ViewBuffer

SPAN_NS = 1_000_000_000  # simulated, over which at least a rate is taken

Counts = Mapping[str, tuple[int, int]]
"""Measurements (used, refused) by sensor."""


class SensorRates:
    """Sensor rates of one drone at a time, from counts that are sampled now and then."""

    def __init__(self) -> None:
        self._drone = ""
        self._samples: list[tuple[int, Counts]] = []

    def update(self, drone: str, t_ns: int, counts: Counts) -> dict[str, float]:
        """Add the counts (used, refused) of a drone's sensors at an instant; return the latest rates [Hz]."""
        if drone != self._drone or self._has_restarted(t_ns, counts):
            self._drone, self._samples = drone, []
        if self._samples and self._samples[-1][0] == t_ns:
            self._samples.pop()  # the run stands still
        self._samples.append((t_ns, dict(counts)))
        while len(self._samples) > 2 and t_ns - self._samples[1][0] >= SPAN_NS:
            self._samples.pop(0)
        since_ns, before = self._samples[0]
        span_ns = t_ns - since_ns
        if span_ns <= 0:
            return {}
        return {kind: (sum(now) - sum(before.get(kind, now))) * 1e9 / span_ns for kind, now in counts.items()}

    def _has_restarted(self, t_ns: int, counts: Counts) -> bool:
        """Return whether a replay has gone back, or an estimator has restarted."""
        if not self._samples:
            return False
        last_ns, last = self._samples[-1]
        return t_ns < last_ns or any(sum(counts.get(kind, (0, 0))) < sum(before) for kind, before in last.items())


GREY, RED, AMBER, GREEN, BLUE = "#868e96", "#e03131", "#e8890c", "#2f9e44", "#1971c2"
STATE_COLOURS = {
    "landed": GREY,
    "taking_off": BLUE,
    "hovering": GREEN,
    "flying": GREEN,
    "landing": BLUE,
    "emergency": RED,
}
EVENT_COLOURS = {
    "refused": RED,
    "accepted": BLUE,
    "done": GREEN,
    "death": RED,
    "failure": RED,
    "overdue": RED,
    "silent": RED,
    "no_show": RED,
    "collision": RED,
    "emergency": RED,
    "flip": RED,
    "impact": RED,
    "touchdown": RED,
    "battery": RED,
    "landing": AMBER,
    "fault": AMBER,
    "fault_end": AMBER,
    "fault_clear": AMBER,
}
LINK_COLOURS = {"waiting": AMBER, "connected": BLUE, "armed": GREEN, "lost": RED}
SEVERITY_COLOURS = {"red": RED, "amber": AMBER}
LEFT_MAX_S = 24 * 3600.0  # of a battery that lasts longer no time is shown
COLUMNS = 8  # of the table of drones
PITCH_PX_PER_DEG = 0.9  # of the artificial horizon
COMPASS = (("N", 0, 1), ("E", 1, 0), ("S", 0, -1), ("W", -1, 0))  # marks, with x to the right and y up
NO_FAULT = "no fault acts"
FEW_LINES = "max-height:8em;overflow-y:auto"  # many formations must not push the emergency button off the page
STYLE = "font-size:12px;line-height:1.35;font-variant-numeric:tabular-nums"
BESIDE = "padding:2px 10px"  # of a text in a panel, which viser lets touch the edge; as wide as of its controls
TABLE_BESIDE = "padding:2px 12px 2px 8px;overflow-x:auto"  # and of a table; the panel's scroll bar is 12 px wide
NAME_WHOLE = 8  # characters of a name that stand on one line of the table of drones
WRAP = "white-space:normal"


class DroneRow(NamedTuple):
    """A drone's row in the table of drones."""

    name: str
    state: str
    battery_percent: float
    lag_ms: float | None
    commander: str | None
    gps: str
    faults: tuple[str, ...]
    link: tuple[str, str] = ("", "")  # of a driver, in words, and their colour
    sigma_m: float | None = None
    severity: Severity | None = None  # of its worst alarm
    failsafe: str = ""  # why it has landed or stopped by itself
    link_badness: float = 0.0  # for sorting: 1 where its age, its loss or its estimator's lag is an alarm


def drone_table(
    rows: Sequence[DroneRow],
    figures: Mapping[str, FlightFigures] | None = None,
    selected: Collection[str] = (),
    chosen: str = "",
    empty: str = "",
) -> str:
    """Return a table of drones.

    Args:
        rows: in their order.
        figures: of their flight by name.
        selected: names of those that one command is for.
        chosen: whose instruments are shown.
        empty: text where there is no row.
    """
    if not rows and empty:
        return f"<div style='{STYLE};{BESIDE};color:{GREY}'>{escape(empty)}</div>"
    head = _head(
        ("", "selected for one command"),
        ("drone", ""),
        ("state", "of its firmware"),
        ("z [m]", "height over the origin"),
        ("v [m/s]", "speed over the ground and up"),
        ("hdg", "heading [deg], from east to north"),
        ("battery", "with the time left at the present drain"),
        ("σ [m]", "of the estimated position"),
    )
    cells = (_drone_cells(row, (figures or {}).get(row.name), row.name in selected, row.name == chosen) for row in rows)
    return _table(head + "".join(cells))


def _drone_cells(row: DroneRow, figures: FlightFigures | None, selected: bool, chosen: bool) -> str:
    name = _coloured(row.name, SEVERITY_COLOURS[row.severity]) if row.severity else escape(row.name)
    if len(row.name) > NAME_WHOLE:
        name = f"<div style='{WRAP};overflow-wrap:anywhere'>{name}</div>"
    state = _coloured(row.state.replace("_", " "), STATE_COLOURS.get(row.state, GREY))
    flown = ["–"] * 3
    if figures is not None:
        flown = [f"{figures.position_m[2]:.1f}", f"{figures.speed_m_s:.1f}", f"{figures.heading_deg:.0f}°"]
    left = battery_left_text(figures.battery_left_s if figures else None)
    severity = battery_severity(row.battery_percent)
    colour = SEVERITY_COLOURS[severity] if severity else "inherit"
    charge = _coloured(f"{row.battery_percent:.0f} %{',' if left else ''}", colour)
    battery = f"<div style='{WRAP}'>{charge} {_coloured(left, colour)}</div>" if left else charge
    sigma = "–" if row.sigma_m is None else f"{row.sigma_m:.2f}"
    drone = escape(row.name)
    ticked = "true" if selected else "false"
    tick = f"<span class='zsim-select' role=checkbox aria-checked={ticked} aria-label='select {drone}'></span>"
    mark = f" data-zsim-drone='{drone}'{' data-zsim-chosen' if chosen else ''}"
    return _cells((tick, name, state, *flown, battery, sigma), mark) + _drone_notes(row, mark)


def _drone_notes(row: DroneRow, mark: str) -> str:
    """Return the rows below that of a drone: who flies it, and what is wrong."""
    lag = "no estimate" if row.lag_ms is None else f"lag {row.lag_ms:.0f} ms"
    late = row.lag_ms is not None and row.lag_ms > LATE_MS
    about = (
        f"{escape(row.commander or 'nobody')} · {_coloured(lag, AMBER if late else 'inherit')} · GPS {escape(row.gps)}"
    )
    faults = f"⚠ {', '.join(row.faults)}" if row.faults else ""
    notes = [(escape(row.failsafe), RED), (escape(faults), AMBER), (escape(row.link[0]), row.link[1])]
    return "".join(
        f"<tr{mark}><td></td><td colspan={COLUMNS - 1} style='color:{colour};padding:0 4px 2px;{WRAP}'>{note}</td></tr>"
        for note, colour in ((about, GREY), *notes)
        if note
    )


def battery_left_text(left_s: float | None) -> str:
    """Return the time that a battery lasts, which stands on one line; empty where it is not known."""
    return "" if left_s is None or left_s > LEFT_MAX_S else f"{left_s / 60.0:.0f}\N{NO-BREAK SPACE}min"


def figure_lines(figures: FlightFigures | None) -> str:
    """Return position, velocity and attitude of one drone."""
    if figures is None:
        return f"<div style='{STYLE};{BESIDE}'>not seen yet</div>"
    x, y, z = figures.position_m
    place = f"position {x:.2f}, {y:.2f}, {z:.2f} m"
    speed = f"speed {figures.speed_m_s:.2f} m/s, climb {figures.climb_m_s:+.2f} m/s"
    turn = f"roll {figures.roll_deg:+.1f}°, pitch {figures.pitch_deg:+.1f}°, heading {figures.heading_deg:.0f}°"
    return f"<div style='{STYLE};{BESIDE}'>{_instruments(figures)}{place}<br>{speed}<br>{turn}</div>"


def _instruments(figures: FlightFigures) -> str:
    """Return an artificial horizon, a compass, and gauges of speed, height and climb, as SVG."""
    pitch_px = max(-36.0, min(36.0, figures.pitch_deg * PITCH_PX_PER_DEG))
    ladder = "".join(
        f"<line x1=-{9 if deg % 20 else 16} x2={9 if deg % 20 else 16} y1={y} y2={y} stroke='#fff'/>"
        for deg in range(-40, 41, 10)
        if deg
        for y in [-deg * PITCH_PX_PER_DEG]
    )
    horizon = (
        "<clipPath id=zsim-horizon><circle r=38 /></clipPath><g clip-path='url(#zsim-horizon)'>"
        f"<g transform='rotate({-figures.roll_deg:.1f}) translate(0 {pitch_px:.1f})'>"
        "<rect x=-90 y=-180 width=180 height=180 fill='#4dabf7'/><rect x=-90 y=0 width=180 height=180 fill='#a0704a'/>"
        f"<line x1=-90 x2=90 stroke='#fff' stroke-width=1.5 />{ladder}</g></g>"
        "<circle r=38 fill=none stroke='#868e96' stroke-width=2 />"
        "<path d='M-22 0H-8L0 6L8 0H22' fill=none stroke='#ffd43b' stroke-width=2.5 />"
    )
    # A heading is counted from east to north; a compass has north at the top.
    marks = "".join(f"<text x={28 * x} y={-28 * y + 4} text-anchor=middle>{mark}</text>" for mark, x, y in COMPASS)
    compass = (
        "<circle r=38 fill=none stroke='#868e96' stroke-width=2 />"
        f"{marks}<g transform='rotate({90.0 - figures.heading_deg:.0f})'>"
        f"<path d='M0 -20L8 14L0 8L-8 14Z' fill='{BLUE}'/></g>"
    )
    gauges = "".join(
        f"<text x=0 y={y}>{label}</text><text x=122 y={y} text-anchor=end font-weight=700 font-size=14>{value}</text>"
        for y, label, value in (
            (16, "speed", f"{figures.speed_m_s:.1f} m/s"),
            (40, "height", f"{figures.position_m[2]:.1f} m"),
            (64, "climb", f"{figures.climb_m_s:+.1f} m/s"),
        )
    )
    return (
        "<svg class=zsim-instruments role=img viewBox='0 0 310 84' style='width:100%;max-width:340px' "
        "fill=currentColor font-size=11 aria-label='attitude, heading, speed, height, climb'>"
        f"<g transform='translate(42 42)'>{horizon}</g>"
        f"<g transform='translate(130 42)'>{compass}</g><g transform='translate(182 4)'>{gauges}</g></svg>"
    )


def link_note(link: ReceivedLink | None) -> tuple[str, str]:
    """Return what is known of the link to an external drone, and its colour; None before its driver has published."""
    if link is None:
        return "external; no driver yet", AMBER
    state = link.state
    if link.age_s > LINK_SILENT_S:
        return f"external; its driver has been silent for {link.age_s:.0f} s", RED
    age, loss, round_trip = state.age_ms, state.loss_percent, state.round_trip_ms
    figures = (("age {:.0f} ms", age), ("loss {:.0f} %", loss), ("round trip {:.0f} ms", round_trip))
    known = [text.format(value) for text, value in figures if value is not None]
    known += [f"{state.refused} refused"] if state.refused else []
    return f"external; {state.state}: {', '.join([state.peer, *known])}", LINK_COLOURS[state.state]


def link_badness(link: ReceivedLink | None) -> float:
    """Return how bad an external drone's link is: infinite where there is none, 1 where its figures are an alarm."""
    if link is None or link.age_s > LINK_SILENT_S or link.state.state == "lost":
        return math.inf
    return max((link.state.age_ms or 0.0) / LINK_OLD_MS, (link.state.loss_percent or 0.0) / LINK_LOSS_PERCENT)


def sensor_table(
    name: str, counts: Counts, rates: Mapping[str, float], uncertainty: str, own_rates: Mapping[str, float]
) -> str:
    """Return the table of one drone's sensors: measurements that its estimator used and refused, and rates [Hz].

    `own_rates` are those of the user's sensors, as set [Hz]; one that is not counted has a row, too.
    """
    counted = [
        (kind, used, refused, f"{rates[kind]:.0f} Hz" if kind in rates else "–")
        for kind, (used, refused) in counts.items()
    ]
    others = [(kind, "–", "–", f"{rate:.0f} Hz as set") for kind, rate in own_rates.items() if kind not in counts]
    title = f"<div style='{STYLE};{BESIDE}'><b>{escape(name)}</b>: {escape(uncertainty)}</div>"
    head = _head(
        ("sensor", "of the drone"),
        ("used", "measurements that its estimator used"),
        ("refused", "measurements that were too unlikely, or of no use"),
        ("rate", "at which they come, in simulated time"),
    )
    return title + _table(head + "".join(map(_row, [*counted, *others])))


def formation_lines(states: Mapping[str, tuple[str, str]]) -> str:
    """Return phase and reason of each formation by name."""
    lines = [
        f"<b>{escape(name)}</b>: {escape(phase.replace('_', ' '))}" + (f" – {escape(reason)}" if reason else "")
        for name, (phase, reason) in states.items()
    ]
    return f"<div style='{STYLE};{FEW_LINES};{BESIDE}'>{'<br>'.join(lines) or 'no formation'}</div>"


def preflight_lines(checks: Mapping[str, Sequence[Check]]) -> str:
    """Return the checks of drones before a take-off: what is not as it should be, or that all are ready."""
    lines = [
        _coloured(f"✗ {drone}: {check.name} {check.text}", RED if check.blocks else AMBER)
        for drone, each in checks.items()
        for check in each
        if not check.ok
    ]
    ready = [drone for drone, each in checks.items() if all(check.ok for check in each)]
    if ready and len(checks) == 1:
        points = ", ".join(f"{check.name} {check.text}" for check in checks[ready[0]])
        lines.append(_coloured(f"✓ {ready[0]}: {points}", GREEN))
    elif ready:
        lines.append(_coloured(f"✓ ready: {', '.join(ready)}", GREEN))
    title = "<b>Before take-off</b><br>" if lines else ""
    return f"<div style='{STYLE};{FEW_LINES};{BESIDE};padding-bottom:8px'>{title}{'<br>'.join(lines)}</div>"


def event_table(newest_first: Iterable[EventRow]) -> str:
    """Return the table of events, which are given newest first; the page unfolds what is longer than a few lines."""
    lines = map(_event_cells, newest_first)
    head = _head(("t [s]", "simulated time of the newest"), ("event", ""), ("newest first", ""))
    return _table(head + "".join(lines))


def _event_cells(row: EventRow) -> str:
    event = row.event
    kind = _coloured(event.kind, EVENT_COLOURS.get(event.kind, GREY))
    mark = f"{zlib.crc32(f'{event.kind} {event.subject} {event.text}'.encode()):x}"  # by which the page has it unfolded
    text = f"<div class='zsim-event-text'>{_times(row.times)}{escape(event.text)}</div>"
    return (
        f"<tr title='{escape(event.text)}' data-zsim-event='{mark}' style='vertical-align:top'>"
        f"<td style='text-align:right;color:{GREY}'>{event.t_ns / 1e9:.2f}</td>"
        f"<td>{kind}</td><td style='width:100%'>{text}</td></tr>"
    )


def _times(times: int) -> str:
    return f"<b>{times} ×</b> " if times > 1 else ""


def fault_lines(active: Sequence[str], over: Sequence[str] = ()) -> str:
    """Return the faults that act, and in grey those that are over."""
    lines = [_coloured(f"⚠ {fault}", AMBER) for fault in active] or [_coloured(NO_FAULT, GREY)]
    lines += [_coloured(f"over: {fault}", GREY) for fault in reversed(over)]
    return f"<div style='{STYLE};{FEW_LINES};{BESIDE};overflow-wrap:anywhere'>{'<br>'.join(lines)}</div>"


def _table(body: str) -> str:
    table = f"<table style='{STYLE};white-space:nowrap;border-spacing:2px 1px;width:100%'>{body}</table>"
    return f"<div style='{TABLE_BESIDE}'>{table}</div>"


def _head(*titles: tuple[str, str]) -> str:
    """Return a row of titles, each with its tooltip."""
    cells = (
        f"<th align=left valign=bottom style='{WRAP}' title='{escape(tooltip)}'>{escape(title)}</th>"
        for title, tooltip in titles
    )
    return f"<tr>{''.join(cells)}</tr>"


def _row(cells: Iterable[object]) -> str:
    return _cells(escape(str(cell)) for cell in cells)


def _cells(cells: Iterable[str], mark: str = "") -> str:
    return f"<tr{mark}>{''.join(f'<td align=left>{cell}</td>' for cell in cells)}</tr>"


def _coloured(text: str, colour: str) -> str:
    return f"<span style='color:{colour}'>{escape(text)}</span>"


class TableRows:
    """Makes rows of tables.

    Args:
        views: the newest ones.
        own_rates: of the user's sensors of each drone [Hz], by drone and sensor.
        severity_of: returns how bad the worst alarm of a drone is.
    """

    def __init__(
        self,
        views: ViewBuffer,
        own_rates: Mapping[str, Mapping[str, float]],
        severity_of: Callable[[str], Severity | None] = lambda _: None,
    ) -> None:
        self._severity_of = severity_of
        self._views = views
        self._own_rates = own_rates
        self._rates = SensorRates()

    def drone_rows(self) -> list[DroneRow]:
        """Return a row for each drone."""
        view, estimates, rows = self._views.drones, self._views.estimates(), []
        if view is None:
            return []
        faults = self._views.active_faults()
        for drone in view.drones:
            received = estimates.get(drone.name)
            gps = received.estimate.sensors.get("gps") if received else None
            own_faults = tuple(fault.kind for fault in faults if fault.target == drone.name)
            fixes = "–" if gps is None else f"{gps[0]} / {gps[1]}"
            lag = self._views.lag_ms(received) if received else None
            row = (drone.name, drone.state, drone.battery_percent, lag, drone.commander, fixes, own_faults)
            external = drone.name in self._views.external
            received_link = self._views.link_of(drone.name)
            link = link_note(received_link) if external else ("", "")
            sigma = received.sigma_m if received and received.fresh else None
            failsafe = self._views.failsafes.get(drone.name)
            is_down = drone.state in ("landing", "landed", "emergency")
            cause = failsafe.text if failsafe and is_down else ""
            badness = link_badness(received_link) if external else (lag or 0.0) / LATE_MS
            rows.append(DroneRow(*row, link, sigma, self._severity_of(drone.name), cause, badness))
        return rows

    def sensor_table(self, drone: str) -> str:
        """Return the table of one drone's sensors."""
        received, own_rates = self._views.estimates().get(drone), self._own_rates.get(drone, {})
        if received is None:
            return sensor_table(drone, {}, {}, "no estimate yet", own_rates)
        estimate = received.estimate
        rates = self._rates.update(drone, received.t_ns, estimate.sensors) if received.fresh else {}
        return sensor_table(drone, estimate.sensors, rates, _uncertainty(received), own_rates)


def _uncertainty(received: ReceivedEstimate) -> str:
    """Return an estimator's uncertainty in words."""
    if not received.fresh:
        return f"no estimate since {received.t_ns / 1e9:.1f} s"
    heading_deg = math.degrees(received.estimate.yaw_sigma_rad)
    return f"σ of position {received.sigma_m:.2f} m, of heading {heading_deg:.1f}°"
