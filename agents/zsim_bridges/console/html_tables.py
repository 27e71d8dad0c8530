"""The page's tables as HTML. Pure; all texts of other processes are escaped."""

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import NamedTuple

from zsim.contract.run_messages import Clock, Event

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
    "collision": RED,
    "fault": AMBER,
    "fault_end": AMBER,
    "fault_clear": AMBER,
}
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


class SensorRow(NamedTuple):
    """A sensor's row: how many of its measurements an estimator used."""

    kind: str
    used: int
    refused: int
    rate_hz: float | None


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
    line = _cells("td", (*cells, escape(row.commander or "nobody")))
    if row.faults:
        faults = escape(", ".join(row.faults))
        line += f"<tr><td colspan=6 style='color:{AMBER};padding:0 4px 2px 12px'>⚠ {faults}</td></tr>"
    return line


def sensor_table(name: str, rows: Iterable[SensorRow], uncertainty: str) -> str:
    """Return the table of one drone's sensors, and its estimator's `uncertainty`."""
    lines = [
        _row("td", (row.kind, row.used, row.refused, "–" if row.rate_hz is None else f"{row.rate_hz:.0f} Hz"))
        for row in rows
    ]
    title = f"<div style='{STYLE};padding:2px 0'><b>{escape(name)}</b>: {escape(uncertainty)}</div>"
    head = _head(
        ("sensor", "of the drone"),
        ("used", "measurements that its estimator used"),
        ("refused", "measurements that were too unlikely, or of no use"),
        ("rate", "at which they come, in simulated time"),
    )
    return title + _table(head + "".join(lines))


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


def _row(tag: str, cells: Iterable[object]) -> str:
    return _cells(tag, (escape(str(cell)) for cell in cells))


def _cells(tag: str, cells: Iterable[str]) -> str:
    return f"<tr>{''.join(f'<{tag} align=left>{cell}</{tag}>' for cell in cells)}</tr>"


def _coloured(text: str, colour: str) -> str:
    return f"<span style='color:{colour}'>{escape(text)}</span>"
