"""What the console shows of the newest views, as tables.

Order of this file: HTML, which is pure and in which all texts of other processes are escaped; rows.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import NamedTuple

from zsim.contract.run_messages import Clock, Event, Fault
from zsim.contract.views import EstimateView
from zsim_bridges.console.sensor_rates import Counts, SensorRates
from zsim_bridges.console.view_buffer import ReceivedEstimate, ReceivedLink, ViewBuffer

LATE_MS = 200.0  # of an estimator: ten gates of 20 ms
LOW_PERCENT = 20.0  # of a battery; the AR.Drone warns there
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
    "death": RED,
    "overdue": RED,
    "silent": RED,
    "no_show": RED,
    "collision": RED,
    "fault": AMBER,
    "fault_end": AMBER,
    "fault_clear": AMBER,
}
LINK_COLOURS = {"waiting": AMBER, "connected": BLUE, "armed": GREEN, "lost": RED}
LINK_SILENT_S = 3.0  # wall; drivers publish the state of a link once a second
NO_FAULT = "no fault acts"
FEW_LINES = "max-height:8em;overflow-y:auto"  # many formations must not push the emergency button off the page
STYLE = "font-size:12px;line-height:1.35;font-variant-numeric:tabular-nums"


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


def drone_table(rows: Sequence[DroneRow]) -> str:
    """Return the table of all drones."""
    head = _head(
        ("drone", ""),
        ("state", "of its firmware"),
        ("battery", ""),
        ("lag", "how far its estimator is behind the run"),
        ("GPS", "fixes that its estimator used / refused"),
        ("flown by", "the process whose commands it obeys"),
    )
    return _table(head + "".join(map(_drone_cells, rows)))


def _drone_cells(row: DroneRow) -> str:
    state = _coloured(row.state.replace("_", " "), STATE_COLOURS.get(row.state, GREY))
    battery = _coloured(f"{row.battery_percent:.0f} %", RED if row.battery_percent < LOW_PERCENT else "inherit")
    lag = "–" if row.lag_ms is None else f"{row.lag_ms:.0f} ms"
    late = row.lag_ms is not None and row.lag_ms > LATE_MS
    cells = (escape(row.name), state, battery, _coloured(lag, AMBER if late else "inherit"), escape(row.gps))
    line = _cells((*cells, escape(row.commander or "nobody")))
    faults = f"⚠ {', '.join(row.faults)}" if row.faults else ""
    for note, colour in ((faults, AMBER), row.link):
        if note:
            line += f"<tr><td colspan=6 style='color:{colour};padding:0 4px 2px 12px'>{escape(note)}</td></tr>"
    return line


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
    title = f"<div style='{STYLE};padding:2px 0'><b>{escape(name)}</b>: {escape(uncertainty)}</div>"
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
    return f"<div style='{STYLE};{FEW_LINES};padding:2px 4px'>{'<br>'.join(lines) or 'no formation'}</div>"


def clock_line(now: Clock | None, t_ns: int, silent_s: float = 0.0) -> str:
    """Return the run's time, and which processes it waits for; or for how long the world has been `silent_s`.

    `t_ns` is the time of the picture, 0 before the first.
    """
    if silent_s:
        text = _coloured(f"no answer from the world for {silent_s:.0f} s", RED)
        return f"<div style='{STYLE};padding:2px 4px;font-size:14px'>{text}, last at <b>{t_ns / 1e9:.1f} s</b></div>"
    if now is None:
        return f"<div style='{STYLE};padding:2px 4px'>no clock yet</div>"
    waiting = [w for w in now.waiting_for if now.state == "waiting" or w.since_wall_s > 0.5]
    waiting = [w for w in waiting if not w.held_by] or waiting  # causes alone
    colour = {"running": GREEN, "paused": AMBER}.get(now.state, GREY)
    t_s = (t_ns or now.t_ns) / 1e9
    time, pace = (f"{t_s:.1f}", f" × {now.rate:.1f} real time") if now.state == "running" else (f"{t_s:.2f}", "")
    text = f"{_coloured(now.state, colour)} <b>{time} s</b>{pace}"
    if waiting:
        names = ", ".join(f"{w.name} on {w.host} ({w.since_wall_s:.0f} s)" for w in waiting[:4])
        text += f"<br>waiting for {escape(names)}"
    return f"<div style='{STYLE};padding:2px 4px;font-size:14px'>{text}</div>"


def event_table(newest_first: Iterable[Event]) -> str:
    """Return the table of events, which are given newest first."""
    lines = [
        f"<tr><td style='text-align:right;color:{GREY}'>{event.t_ns / 1e9:.2f}</td>"
        f"<td>{_coloured(event.kind, EVENT_COLOURS.get(event.kind, GREY))}</td><td>{escape(event.text)}</td></tr>"
        for event in newest_first
    ]
    head = _head(("t [s]", "simulated time"), ("event", ""), ("newest first", ""))
    return _table(head + "".join(lines), "overflow-wrap:anywhere")


def fault_lines(faults: Sequence[str]) -> str:
    """Return the active faults."""
    lines = "<br>".join(f"⚠ {escape(fault)}" for fault in faults)
    style = f"{STYLE};{FEW_LINES};padding:2px 4px;color:{AMBER if faults else GREY}"
    return f"<div style='{style}'>{lines or NO_FAULT}</div>"


def _table(body: str, wrap: str = "white-space:nowrap") -> str:
    return f"<table style='{STYLE};{wrap};border-spacing:4px 1px;width:100%'>{body}</table>"


def _head(*titles: tuple[str, str]) -> str:
    """Return a row of titles, each with its tooltip."""
    cells = (f"<th align=left title='{escape(tooltip)}'>{escape(title)}</th>" for title, tooltip in titles)
    return f"<tr>{''.join(cells)}</tr>"


def _row(cells: Iterable[object]) -> str:
    return _cells(escape(str(cell)) for cell in cells)


def _cells(cells: Iterable[str]) -> str:
    return f"<tr>{''.join(f'<td align=left>{cell}</td>' for cell in cells)}</tr>"


def _coloured(text: str, colour: str) -> str:
    return f"<span style='color:{colour}'>{escape(text)}</span>"


class TableRows:
    """Makes rows of tables.

    Args:
        views: the newest ones.
        own_rates: of the user's sensors of each drone [Hz], by drone and sensor.
    """

    def __init__(self, views: ViewBuffer, own_rates: Mapping[str, Mapping[str, float]]) -> None:
        self._views = views
        self._own_rates = own_rates
        self._rates = SensorRates()

    def drone_rows(self) -> list[DroneRow]:
        """Return a row for each drone."""
        view, estimates, rows = self._views.drones, self._views.estimates(), []
        if view is None:
            return []
        faults = self._active()
        for drone in view.drones:
            received = estimates.get(drone.name)
            gps = received.estimate.sensors.get("gps") if received else None
            own_faults = tuple(fault.kind for fault in faults if fault.target == drone.name)
            fixes = "–" if gps is None else f"{gps[0]} / {gps[1]}"
            lag = self._lag_ms(received, view.t_ns) if received else None
            row = (drone.name, drone.state, drone.battery_percent, lag, drone.commander, fixes, own_faults)
            external = drone.name in self._views.external
            rows.append(DroneRow(*row, link_note(self._views.link_of(drone.name)) if external else ("", "")))
        return rows

    def active_faults(self) -> list[str]:
        """Return kind and target of each active fault."""
        return [f"{fault.kind} of {fault.target}{_end_text(fault)}" for fault in self._active()]

    def _active(self) -> list[Fault]:
        now_ns = self._views.drones.t_ns if self._views.drones else 0
        return [fault for fault in self._views.faults if _is_active(fault, now_ns)]

    def sensor_table(self, drone: str) -> str:
        """Return the table of one drone's sensors."""
        received, own_rates = self._views.estimates().get(drone), self._own_rates.get(drone, {})
        if received is None:
            return sensor_table(drone, {}, {}, "no estimate yet", own_rates)
        estimate = received.estimate
        rates = self._rates.update(drone, received.t_ns, estimate.sensors) if received.fresh else {}
        return sensor_table(drone, estimate.sensors, rates, _uncertainty(received), own_rates)

    def _lag_ms(self, received: ReceivedEstimate, now_ns: int) -> float:
        """Return how far an estimator is behind: by its health, or by its view where that is old."""
        health = self._views.healths.get(received.process)
        if health is not None and received.fresh:
            return health.lag_ns / 1e6
        return max(0, now_ns - received.t_ns) / 1e6


def _is_active(fault: Fault, now_ns: int) -> bool:
    return fault.from_ns <= now_ns and (fault.until_ns is None or fault.until_ns > now_ns)


def _end_text(fault: Fault) -> str:
    return "" if fault.until_ns is None else f" until {fault.until_ns / 1e9:.1f} s"


def _uncertainty(received: ReceivedEstimate) -> str:
    """Return an estimator's uncertainty in words."""
    if not received.fresh:
        return f"no estimate since {received.t_ns / 1e9:.1f} s"
    heading_deg = math.degrees(received.estimate.yaw_sigma_rad)
    return f"σ of position {sigma_m(received.estimate):.2f} m, of heading {heading_deg:.1f}°"


def sigma_m(estimate: EstimateView) -> float:
    """Return the root of the mean variance of the position over its axes; 0 where that is negative, so none."""
    xx, _, _, yy, _, zz = estimate.covariance_m2
    return math.sqrt(max(0.0, xx + yy + zz) / 3)
