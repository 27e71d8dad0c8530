"""The newest views as HTML tables, in which all texts from other processes are escaped."""

import importlib.resources
import math
import zlib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from html import escape
from typing import NamedTuple

from zsim.contract.run_messages import INCIDENTS
from zsim_bridges.console.run_condition import (
    LAG_MAX_MS,
    LINK_AGE_MAX_MS,
    LINK_LOSS_PERCENT,
    LINK_SILENT_S,
    LOSS_NAMES,
    Check,
    DroneCondition,
    Severity,
    battery_severity,
)
from zsim_bridges.console.run_monitor import FlightMetrics
from zsim_bridges.console.view_buffer import EventRow, ReceivedLink, ViewBuffer

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
    **dict.fromkeys(("refused", "collision", *LOSS_NAMES, *INCIDENTS), RED),
    **dict.fromkeys(("landing", "fault", "fault_end", "fault_clear"), AMBER),
    "accepted": BLUE,
    "done": GREEN,
}
LINK_COLOURS = {"waiting": AMBER, "connected": BLUE, "armed": GREEN, "lost": RED}
SEVERITY_COLOURS = {"red": RED, "amber": AMBER}
REMAINING_MAX_S = 24 * 3600.0  # longest remaining battery time that is shown
COLUMNS = 8  # number of columns of the table of drones
PITCH_PX_PER_DEG, PITCH_MAX_PX = 0.9, 36.0  # scale and limit of the artificial horizon
NO_FAULT = "no active fault"
LIMITED_HEIGHT = "max-height:8em;overflow-y:auto"  # many formations must not push the emergency button off the page
STYLE = "font-size:12px;line-height:1.35;font-variant-numeric:tabular-nums"
PANEL_PADDING = "padding:2px 10px"  # padding of a text in a panel, equal to that of viser's controls
TABLE_PADDING = "padding:2px 12px 2px 8px;overflow-x:auto"  # padding of a table; the panel's scroll bar is 12 px wide
NAME_FIT_CHARS = 8  # number of characters of a name that fit on one line of the table of drones
WRAP = "white-space:normal"
SPAN_NS = 1_000_000_000  # simulated; minimum time over which a sensor's rate is averaged

Counts = Mapping[str, tuple[int, int]]
"""Measurements (used, refused) by sensor."""


class DroneRow(NamedTuple):
    """A drone's row in the table of drones."""

    drone: DroneCondition
    gps: str = "–"  # numbers of fixes used and refused
    faults: tuple[str, ...] = ()  # kinds of the active injected faults
    link: tuple[str, str] = ("", "")  # description of the driver's link, and the colour of that text
    severity: Severity | None = None  # severity of the drone's worst alarm

    @property
    def name(self) -> str:
        return self.drone.name

    @property
    def link_badness(self) -> float:
        """Badness of an external drone's link, or of another's lag: 1 at the alarm threshold, infinite if lost."""
        drone = self.drone
        if not drone.is_external:
            return (drone.lag_ms or 0.0) / LAG_MAX_MS
        if drone.link_age_s is None or drone.link_age_s > LINK_SILENT_S or drone.link_state == "lost":
            return math.inf
        return max((drone.link_age_ms or 0.0) / LINK_AGE_MAX_MS, (drone.link_loss_percent or 0.0) / LINK_LOSS_PERCENT)


class TableRows:
    """Derives rows and tables from the newest views.

    Args:
        own_rates: configured rates of the user's sensors [Hz], by drone and sensor.
        severity_of: returns the severity of a drone's worst alarm.
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
        views, rows = self._views, []
        faults, estimates = views.active_faults(), views.estimates()
        for name, drone in views.conditions().items():
            gps = estimates[name].estimate.sensors.get("gps") if name in estimates else None
            fixes = "–" if gps is None else f"{gps[0]} / {gps[1]}"
            own_faults = tuple(fault.kind for fault in faults if fault.target == name)
            link = link_note(views.link_of(name)) if drone.is_external else ("", "")
            rows.append(DroneRow(drone, fixes, own_faults, link, self._severity_of(name)))
        return rows

    def sensor_tables(self, drones: Collection[str]) -> dict[str, str]:
        """Return the table of each drone's sensors by drone; the rates of other drones are no longer followed."""
        self._rates.keep(drones)
        return {drone: self._sensor_table(drone) for drone in drones}

    def _sensor_table(self, drone: str) -> str:
        received, own_rates = self._views.estimates().get(drone), self._own_rates.get(drone, {})
        if received is None:
            return sensor_table(drone, {}, {}, "no estimate yet", own_rates)
        sensors = received.estimate.sensors
        if not received.is_fresh:
            return sensor_table(drone, sensors, {}, f"no estimate since {received.t_ns / 1e9:.1f} s", own_rates)
        rates = self._rates.update(drone, received.t_ns, sensors)
        uncertainty = f"σ of position {received.sigma_m:.2f} m, of heading {received.yaw_sigma_deg:.1f}°"
        return sensor_table(drone, sensors, rates, uncertainty, own_rates)


class SensorRates:
    """Derives the sensor rates of drones from irregular samples of their estimators' counts."""

    def __init__(self) -> None:
        self._samples: dict[str, list[tuple[int, Counts]]] = {}

    def keep(self, drones: Collection[str]) -> None:
        """Forget the samples of all other drones."""
        self._samples = {drone: samples for drone, samples in self._samples.items() if drone in drones}

    def update(self, drone: str, t_ns: int, counts: Counts) -> dict[str, float]:
        """Add the counts of a drone's sensors at simulated time t_ns; return the latest rates [Hz]."""
        samples = self._samples.setdefault(drone, [])
        if samples:
            last_ns, last = samples[-1]
            restarted = any(sum(counts.get(kind, (0, 0))) < sum(before) for kind, before in last.items())
            if t_ns < last_ns or restarted:  # the estimator restarted, or a replay was rewound
                samples.clear()
            elif t_ns == last_ns:
                samples.pop()  # the run is paused
        samples.append((t_ns, dict(counts)))
        while len(samples) > 2 and t_ns - samples[1][0] >= SPAN_NS:
            samples.pop(0)
        since_ns, before = samples[0]
        span_ns = t_ns - since_ns
        if span_ns <= 0:
            return {}
        return {kind: (sum(now) - sum(before.get(kind, now))) * 1e9 / span_ns for kind, now in counts.items()}


# The drones


def drone_table(
    rows: Sequence[DroneRow],
    metrics: Mapping[str, FlightMetrics] | None = None,
    selected: Collection[str] = (),
    chosen: str = "",
    empty: str = "",
) -> str:
    """Return a table of drones.

    Args:
        metrics: flight figures by drone.
        selected: names of the drones selected to receive the same command.
        chosen: name of the drone whose instruments are shown.
        empty: text shown if there are no rows.
    """
    if not rows and empty:
        return f"<div style='{STYLE};{PANEL_PADDING};color:{GREY}'>{escape(empty)}</div>"
    head = _head(
        ("", "selected for one command"),
        ("drone", ""),
        ("state", "state of the drone's firmware"),
        ("z [m]", "height above the origin"),
        ("v [m/s]", "speed, including the climb"),
        ("hdg", "heading [deg], 0 = east, 90 = north"),
        ("battery", "charge, and time left at the present drain"),
        ("σ [m]", "σ of the estimated position"),
    )
    cells = (_drone_cells(row, (metrics or {}).get(row.name), row.name in selected, row.name == chosen) for row in rows)
    return _table(head + "".join(cells))


def _drone_cells(row: DroneRow, metrics: FlightMetrics | None, selected: bool, chosen: bool) -> str:
    """Return a drone's rows: its figures, and notes on its commander, failsafe, faults and link."""
    drone = row.drone
    name = _coloured(drone.name, SEVERITY_COLOURS[row.severity]) if row.severity else escape(drone.name)
    if len(drone.name) > NAME_FIT_CHARS:
        name = f"<div style='{WRAP};overflow-wrap:anywhere'>{name}</div>"
    state = _coloured(drone.state.replace("_", " "), STATE_COLOURS.get(drone.state, GREY))
    flight_cells = ["–"] * 3
    if metrics is not None:
        flight_cells = [f"{metrics.position_m[2]:.1f}", f"{metrics.speed_m_s:.1f}", f"{metrics.heading_deg:.0f}°"]
    remaining_s = metrics.battery_remaining_s if metrics else None
    remaining = (
        "" if remaining_s is None or remaining_s > REMAINING_MAX_S else f"{remaining_s / 60.0:.0f}\N{NO-BREAK SPACE}min"
    )
    severity = battery_severity(drone.battery_percent)
    colour = SEVERITY_COLOURS[severity] if severity else "inherit"
    charge = _coloured(f"{drone.battery_percent:.0f} %{',' if remaining else ''}", colour)
    battery = f"<div style='{WRAP}'>{charge} {_coloured(remaining, colour)}</div>" if remaining else charge
    sigma = "–" if drone.sigma_m is None else f"{drone.sigma_m:.2f}"
    aria_checked, label = ("true" if selected else "false"), escape(drone.name)
    checkbox = (
        f"<span class='zsim-select' role=checkbox aria-checked={aria_checked} aria-label='select {label}'></span>"
    )
    mark = f" data-zsim-drone='{label}'{' data-zsim-chosen' if chosen else ''}"

    lag = "no estimate" if drone.lag_ms is None else f"lag {drone.lag_ms:.0f} ms"
    lag_colour = AMBER if drone.lag_ms is not None and drone.lag_ms > LAG_MAX_MS else "inherit"
    status = f"{escape(drone.commander or 'nobody')} · {_coloured(lag, lag_colour)} · GPS {escape(row.gps)}"
    if metrics is not None and metrics.obstacle_m is not None:
        status += f" · {metrics.obstacle_m:.1f} m from an obstacle"
    failsafe = drone.failsafe if drone.state in ("landing", "landed", "emergency") else ""
    faults = f"⚠ {', '.join(row.faults)}" if row.faults else ""
    notes = [(status, GREY), (escape(failsafe), RED), (escape(faults), AMBER), (escape(row.link[0]), row.link[1])]
    return _cells((checkbox, name, state, *flight_cells, battery, sigma), mark) + "".join(
        f"<tr{mark}><td></td><td colspan={COLUMNS - 1} style='color:{colour};padding:0 4px 2px;{WRAP}'>{note}</td></tr>"
        for note, colour in notes
        if note
    )


def link_note(link: ReceivedLink | None) -> tuple[str, str]:
    """Return a description of the link to an external drone, and its colour; None: its driver has not published yet."""
    if link is None:
        return "external; no driver yet", AMBER
    state = link.state
    if link.age_s > LINK_SILENT_S:
        return f"external; its driver has been silent for {link.age_s:.0f} s", RED
    age, loss, round_trip = state.age_ms, state.loss_percent, state.round_trip_ms
    metrics = (("age {:.0f} ms", age), ("loss {:.0f} %", loss), ("round trip {:.0f} ms", round_trip))
    texts = [text.format(value) for text, value in metrics if value is not None]
    texts += [f"{state.refused} refused"] if state.refused else []
    return f"external; {state.state}: {', '.join([state.peer, *texts])}", LINK_COLOURS[state.state]


# One drone


_INSTRUMENTS = importlib.resources.files("zsim_bridges.console.frame").joinpath("instruments.html").read_text("utf-8")


def metric_lines(metrics: FlightMetrics | None) -> str:
    """Return position, velocity and attitude of one drone, with its instruments."""
    if metrics is None:
        return f"<div style='{STYLE};{PANEL_PADDING}'>not seen yet</div>"
    x, y, z = metrics.position_m
    instruments = _INSTRUMENTS.format(
        bank=f"{-metrics.roll_deg:.1f}",
        pitch_px=f"{max(-PITCH_MAX_PX, min(PITCH_MAX_PX, metrics.pitch_deg * PITCH_PX_PER_DEG)):.1f}",
        course=f"{90.0 - metrics.heading_deg:.0f}",  # headings are measured from east; compass courses, from north
        speed=f"{metrics.speed_m_s:.1f}",
        height=f"{z:.1f}",
        climb=f"{metrics.climb_m_s:+.1f}",
    )
    position = f"position {x:.2f}, {y:.2f}, {z:.2f} m"
    speed = f"speed {metrics.speed_m_s:.2f} m/s, climb {metrics.climb_m_s:+.2f} m/s"
    turn = f"roll {metrics.roll_deg:+.1f}°, pitch {metrics.pitch_deg:+.1f}°, heading {metrics.heading_deg:.0f}°"
    return f"<div style='{STYLE};{PANEL_PADDING}'>{instruments}{position}<br>{speed}<br>{turn}</div>"


def sensor_table(
    name: str, counts: Counts, rates: Mapping[str, float], uncertainty: str, own_rates: Mapping[str, float]
) -> str:
    """Return the table of one drone's sensors: measurements that its estimator used and rejected, and rates [Hz].

    `own_rates` are the configured rates of the user's sensors [Hz], each of which has a row even if the estimator does
    not count it.
    """
    counted = [
        (kind, used, refused, f"{rates[kind]:.0f} Hz" if kind in rates else "–")
        for kind, (used, refused) in counts.items()
    ]
    uncounted = [
        (kind, "–", "–", f"{rate:.0f} Hz (configured)") for kind, rate in own_rates.items() if kind not in counts
    ]
    title = f"<div style='{STYLE};{PANEL_PADDING}'><b>{escape(name)}</b>: {escape(uncertainty)}</div>"
    head = _head(
        ("sensor", "sensor of the drone"),
        ("used", "measurements that its estimator used"),
        ("rejected", "measurements that were too unlikely or unusable"),
        ("rate", "rate of arrival in simulated time"),
    )
    rows = (_cells(escape(str(cell)) for cell in row) for row in (*counted, *uncounted))
    return title + _table(head + "".join(rows))


# Formations, checks, events and faults


def formation_lines(states: Mapping[str, tuple[str, str]]) -> str:
    """Return the phase and reason of each formation as HTML; `states` has them by name."""
    lines = [
        f"<b>{escape(name)}</b>: {escape(phase.replace('_', ' '))}" + (f" – {escape(reason)}" if reason else "")
        for name, (phase, reason) in states.items()
    ]
    return f"<div style='{STYLE};{LIMITED_HEIGHT};{PANEL_PADDING}'>{'<br>'.join(lines) or 'no formation'}</div>"


def preflight_lines(checks: Mapping[str, Sequence[Check]]) -> str:
    """Return the failed pre-take-off checks of drones, and the names of those that are ready, as HTML."""
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
    return f"<div style='{STYLE};{LIMITED_HEIGHT};{PANEL_PADDING};padding-bottom:8px'>{title}{'<br>'.join(lines)}</div>"


def event_table(newest_first: Iterable[EventRow]) -> str:
    """Return the table of events; each row has a mark, by which the page unfolds the row's long text."""
    lines = []
    for event, times, _ in newest_first:
        kind = _coloured(event.kind, EVENT_COLOURS.get(event.kind, GREY))
        mark = f"{zlib.crc32(f'{event.kind} {event.subject} {event.text}'.encode()):x}"
        count = f"<b>{times} ×</b> " if times > 1 else ""
        lines.append(
            f"<tr title='{escape(event.text)}' data-zsim-event='{mark}' style='vertical-align:top'>"
            f"<td style='text-align:right;color:{GREY}'>{event.t_ns / 1e9:.2f}</td><td>{kind}</td>"
            f"<td style='width:100%'><div class='zsim-event-text'>{count}{escape(event.text)}</div></td></tr>"
        )
    head = _head(("t [s]", "simulated time of the newest occurrence"), ("event", ""), ("newest first", ""))
    return _table(head + "".join(lines))


def fault_lines(active: Sequence[str], ended: Sequence[str] = ()) -> str:
    """Return the active faults, followed by past ones in grey, as HTML."""
    lines = [_coloured(f"⚠ {fault}", AMBER) for fault in active] or [_coloured(NO_FAULT, GREY)]
    lines += [_coloured(f"over: {fault}", GREY) for fault in reversed(ended)]
    return f"<div style='{STYLE};{LIMITED_HEIGHT};{PANEL_PADDING};overflow-wrap:anywhere'>{'<br>'.join(lines)}</div>"


def _table(body: str) -> str:
    table = f"<table style='{STYLE};white-space:nowrap;border-spacing:2px 1px;width:100%'>{body}</table>"
    return f"<div style='{TABLE_PADDING}'>{table}</div>"


def _head(*titles: tuple[str, str]) -> str:
    """Return a row of titles, each with its tooltip."""
    cells = (
        f"<th align=left valign=bottom style='{WRAP}' title='{escape(tooltip)}'>{escape(title)}</th>"
        for title, tooltip in titles
    )
    return f"<tr>{''.join(cells)}</tr>"


def _cells(cells: Iterable[str], mark: str = "") -> str:
    return f"<tr{mark}>{''.join(f'<td align=left>{cell}</td>' for cell in cells)}</tr>"


def _coloured(text: str, colour: str) -> str:
    return f"<span style='color:{colour}'>{escape(text)}</span>"
