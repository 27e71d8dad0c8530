"""Alarms of a run: what an operator must see now, in amber or red, with a name; which of them were acknowledged.

Order of this file: what an alarm is; alarms of drones, formations and processes, which are pure; the board that keeps
since when each stands, and what was acknowledged.
"""

import threading
from collections.abc import Iterable, Mapping, Sequence
from typing import Literal, NamedTuple

from zsim.contract.run_messages import Event, Fault
from zsim_agents.formation.flight_data import HELD_ON_REQUEST, TOO_NEAR

Severity = Literal["amber", "red"]
BATTERY_LOW_PERCENT, BATTERY_EMPTY_PERCENT = 20.0, 10.0  # the AR.Drone warns at the first
LATE_MS = 200.0  # of an estimator: ten gates of 20 ms
SIGMA_HIGH_M = 2.0  # of a position; chosen: as far apart as the paper's drones may come
LINK_OLD_MS, LINK_LOSS_PERCENT = 500.0, 10.0  # chosen: PX4 leaves offboard mode after the first
LOST = {
    "death": "dead",
    "no_show": "missing",
    "silent": "silent",
    "overdue": "overdue",
    "failure": "failed",
    "diverged": "diverged",
}
"""Kinds of events that report a process or drone that is lost, and the name of the alarm."""
BACK = frozenset({"join", "restart", "superseded", "silent_end", "leave", "drop"})  # kinds that end it


class Alarm(NamedTuple):
    """Something that an operator must see.

    Attributes:
        severity: amber: look at it; red: act.
        subject: the drone, formation or process.
        name: of the alarm; one subject has each name once.
        text: with figures.
    """

    severity: Severity
    subject: str
    name: str
    text: str = ""


class DroneCondition(NamedTuple):
    """What alarms of a drone are made of; None for what is not known, or does not apply."""

    name: str
    state: str
    battery_percent: float
    lag_ms: float | None = None
    sigma_m: float | None = None
    estimate_lost: bool = False
    link_state: str | None = None
    link_age_ms: float | None = None
    link_loss_percent: float | None = None


def battery_severity(percent: float) -> Severity | None:
    """Return the severity of the alarm of a battery, None where there is none."""
    if percent < BATTERY_EMPTY_PERCENT:
        return "red"
    return "amber" if percent < BATTERY_LOW_PERCENT else None


def drone_alarms(drone: DroneCondition) -> list[Alarm]:
    """Return the alarms of one drone."""
    found: list[Alarm] = []

    def add(severity: Severity, name: str, text: str = "") -> None:
        found.append(Alarm(severity, drone.name, name, text))

    if drone.state == "emergency":
        add("red", "emergency", "rotors stopped")
    if severity := battery_severity(drone.battery_percent):
        add(severity, "battery", f"{drone.battery_percent:.0f} %")
    if drone.estimate_lost:
        add("red", "no estimate")
    elif drone.lag_ms is not None and drone.lag_ms > LATE_MS:
        add("amber", "estimate late", f"{drone.lag_ms:.0f} ms")
    if drone.sigma_m is not None and drone.sigma_m > SIGMA_HIGH_M:
        add("amber", "sigma", f"{drone.sigma_m:.1f} m")
    return found + _link_alarms(drone)


def _link_alarms(drone: DroneCondition) -> list[Alarm]:
    if drone.link_state == "lost":
        return [Alarm("red", drone.name, "link lost")]
    figures = (
        ("link old", drone.link_age_ms, LINK_OLD_MS, "ms"),
        ("link loss", drone.link_loss_percent, LINK_LOSS_PERCENT, "%"),
    )
    return [
        Alarm("amber", drone.name, name, f"{value:.0f} {unit}")
        for name, value, limit, unit in figures
        if value is not None and value > limit
    ]


def formation_alarms(phases: Mapping[str, tuple[str, str]]) -> list[Alarm]:
    """Return the alarms of formations, by their phase and reason."""
    found = []
    for name, (phase, reason) in phases.items():
        if TOO_NEAR in reason:
            found.append(Alarm("red", name, "too near", reason))
        elif phase == "held" and HELD_ON_REQUEST not in reason:
            found.append(Alarm("amber", name, "held", reason))
    return found


def process_alarms(losses: Mapping[str, Event]) -> list[Alarm]:
    """Return the alarms of what was lost, by the newest event about each."""
    return [Alarm("red", name, LOST[event.kind], event.text) for name, event in losses.items()]


def fault_alarms(active: Iterable[Fault]) -> list[Alarm]:
    """Return an alarm for each injected fault that acts."""
    return [Alarm("amber", fault.target, fault.kind) for fault in active]


class AlarmBoard:
    """The alarms that stand, and which of them were acknowledged: once it is over, an alarm may come again."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._since_s: dict[tuple[str, str], float] = {}
        self._acknowledged: set[tuple[str, str, str]] = set()
        self.alarms: tuple[Alarm, ...] = ()

    def update(self, alarms: Sequence[Alarm], wall_s: float) -> None:
        """Take over the alarms of now, the red ones first."""
        with self._lock:
            keys = {(each.subject, each.name) for each in alarms}
            self._since_s = {key: self._since_s.get(key, wall_s) for key in keys}
            self._acknowledged &= {(each.subject, each.name, each.severity) for each in alarms}
            self.alarms = tuple(sorted(alarms, key=lambda each: (each.severity != "red", each.subject, each.name)))

    def acknowledge(self) -> None:
        """Acknowledge all alarms that stand; one that becomes red is new."""
        with self._lock:
            self._acknowledged = {(each.subject, each.name, each.severity) for each in self.alarms}

    def rows(self, wall_s: float) -> list[dict[str, object]]:
        """Return the alarms as plain data, with how long each stands [s; wall]."""
        with self._lock:
            return [
                {
                    **each._asdict(),
                    "for_s": wall_s - self._since_s[each.subject, each.name],
                    "acknowledged": (each.subject, each.name, each.severity) in self._acknowledged,
                }
                for each in self.alarms
            ]

    def severity_of(self, subject: str) -> Severity | None:
        """Return the worst alarm of a drone, formation or process; None where it has none. For its colour."""
        return next((each.severity for each in self.alarms if each.subject == subject), None)
