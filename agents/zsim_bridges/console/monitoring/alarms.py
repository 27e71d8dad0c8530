"""Alarms of a run: what an operator must see, in amber or red, with a name; which of them were acknowledged.

Order of this file: what an alarm is; alarms of drones, formations and processes, which are pure; what was lost; the
board that keeps since when each stands, and what was acknowledged.
"""

import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

from zsim.contract.run_messages import Event, Fault, Health
from zsim.contract.views import ViewCluster
from zsim_agents.formation.flight_check import HELD_ON_REQUEST, TOO_NEAR
from zsim_agents.formation.spaces.cluster_space import unit

Severity = Literal["amber", "red"]
BATTERY_LOW_PERCENT, BATTERY_EMPTY_PERCENT = 20.0, 10.0  # the AR.Drone warns at the first
UPSIDE_DOWN_DEG = 90.0
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
BACK = frozenset({"join", "restart", "superseded", "silent_end", "leave"})  # kinds that end it; a drop ends no death
OFF_REFERENCE_M = 2.0  # of a length of an engaged formation; chosen: the paper's drones come as close as that
FLOWN_PHASES = frozenset({"assembling", "engaged"})  # in which a formation's controller flies all of its drones


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
    yaw_sigma_deg: float | None = None
    estimate_lost: bool = False
    tilt_deg: float | None = None
    failsafe: str = ""  # why its firmware lands it or has stopped its rotors by itself; empty where it has not
    commander: str | None = None
    is_external: bool = False
    link_age_s: float | None = None  # wall, since its driver has published the state of the link
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
        add("red", "emergency", drone.failsafe or "rotors stopped")
    elif drone.state == "landing" and drone.failsafe:
        add("red", "lands by itself", drone.failsafe)
    if drone.tilt_deg is not None and drone.tilt_deg > UPSIDE_DOWN_DEG:
        add("red", "upside down", f"tilted by {drone.tilt_deg:.0f}°")
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


def formation_alarms(
    phases: Mapping[str, tuple[str, str]],
    foreign: Mapping[str, Mapping[str, str]],
    views: Mapping[str, ViewCluster],
) -> list[Alarm]:
    """Return the alarms of formations.

    Args:
        phases: phase and reason of each.
        foreign: who flies drones of each instead of its controller, by drone.
        views: the newest of each.
    """
    found = []
    for name, (phase, reason) in phases.items():
        if TOO_NEAR in reason:
            found.append(Alarm("red", name, "too near", reason))
        elif phase == "held" and HELD_ON_REQUEST not in reason:
            found.append(Alarm("amber", name, "held", reason))
        if phase in FLOWN_PHASES and foreign.get(name):
            found.append(Alarm("amber", name, "not flown whole", foreign_text(foreign[name])))
        if phase == "engaged" and (strayed := _strayed(views[name])):
            found.append(Alarm("red", name, "off reference", strayed))
    return found


def foreign_text(commanders: Mapping[str, str]) -> str:
    """Return in words who flies which drone instead of a formation's controller."""
    return ", ".join(f"{drone} is flown by {who}" for drone, who in commanders.items())


def foreign_commanders(
    controller: str, members: Iterable[str], commanders: Mapping[str, str | None], roles: Mapping[str, str]
) -> dict[str, str]:
    """Return who flies drones of a formation instead of its controller, by drone.

    A process of another name may control the formation; an operator's console does not.

    Args:
        controller: name of the formation's process.
        members: names of its drones.
        commanders: who flies each drone.
        roles: of processes, as far as they are known.
    """
    others = {drone: who for drone in members if (who := commanders.get(drone)) and who != controller}
    if any(commanders.get(drone) == controller for drone in members):
        return others
    return {d: who for d, who in others.items() if roles.get(who, who.partition(".")[0]) == "console"}


def _strayed(view: ViewCluster) -> str:
    """Return the length of an engaged formation that is farthest from its reference; empty where all are near it."""
    apart = [
        (abs(value - desired), name, value, desired)
        for name, value, desired in zip(view.names, view.value, view.desired, strict=True)
        if unit(name) == "m"
    ]
    away_m, name, value, desired = max(apart, default=(0.0, "", 0.0, 0.0))
    return f"{name} is {value:.1f} m, to be {desired:.1f} m" if away_m > OFF_REFERENCE_M else ""


def process_alarms(losses: Mapping[str, Event]) -> list[Alarm]:
    """Return the alarms of what was lost, by the newest event about each."""
    return [Alarm("red", name, LOST[event.kind], event.text) for name, event in losses.items()]


def fault_alarms(active: Iterable[Fault]) -> list[Alarm]:
    """Return an alarm for each injected fault that acts."""
    return [Alarm("amber", fault.target, fault.kind, parameters_text(fault)) for fault in active]


def parameters_text(fault: Fault) -> str:
    """Return the parameters of a fault as the terminal has them: NAME=VALUE."""
    return " ".join(f"{name}={value}" for name, value in fault.parameters.items() if value not in (None, {}))


class Losses:
    """Keeps which processes and drones are lost, by the events about them; called in several threads.

    Attributes:
        now: the newest event about each that is lost.
    """

    def __init__(self) -> None:
        self.now: dict[str, Event] = {}

    def note(self, event: Event) -> None:
        """Take an event: of a loss, or that somebody is back, as itself or in another process that does its work."""
        if event.kind in LOST and not is_false_join(event):
            self.now = {**self.now, event.subject: event}
        elif event.kind in BACK:
            self._remove({event.subject, *map(str, event.data.get("serves") or ())})

    def note_health(self, name: str, health: Health) -> None:
        """Take the health of a process: one that is not the one that was lost has come in its place."""
        lost = self.now.get(name)
        pid = None if lost is None else lost.data.get("pid")
        if lost is not None and pid and (lost.data.get("host"), pid) != (health.host, health.pid):
            self._remove({name})

    def _remove(self, names: set[str]) -> None:
        self.now = {name: lost for name, lost in self.now.items() if name not in names}


def is_false_join(event: Event) -> bool:
    """Return whether nobody was behind a join: the process of that name is where it was."""
    return event.kind == "no_show" and "incarnation" in event.data


@dataclass
class _Standing:
    """An alarm on the board: how often it came, and since when it is over [s; wall]; None while it is not."""

    alarm: Alarm
    since_s: float
    times: int = 1
    over_s: float | None = None
    acknowledged: bool = False


class AlarmBoard:
    """The alarms that stand. A red one that ends stays until it was acknowledged: somebody may have looked away."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._standing: dict[tuple[str, str], _Standing] = {}
        self.alarms: tuple[Alarm, ...] = ()

    def update(self, alarms: Sequence[Alarm], wall_s: float) -> None:
        """Take over the alarms of now."""
        with self._lock:
            now = {(each.subject, each.name): each for each in alarms}
            for key, standing in list(self._standing.items()):
                if key in now:
                    continue
                if standing.alarm.severity != "red" or standing.acknowledged:
                    del self._standing[key]
                elif standing.over_s is None:
                    standing.over_s = wall_s
            for key, alarm in now.items():
                self._set(key, alarm, wall_s)
            self.alarms = tuple(sorted(now.values(), key=_rank))

    def _set(self, key: tuple[str, str], alarm: Alarm, wall_s: float) -> None:
        standing = self._standing.setdefault(key, _Standing(alarm, wall_s))
        if standing.over_s is not None:
            standing.since_s, standing.over_s, standing.times = wall_s, None, standing.times + 1
        if alarm.severity != standing.alarm.severity:
            standing.acknowledged = False
        standing.alarm = alarm

    def acknowledge(self) -> None:
        """Acknowledge all alarms, and forget those that are over; one that becomes red is new."""
        with self._lock:
            self._standing = {key: each for key, each in self._standing.items() if each.over_s is None}
            for standing in self._standing.values():
                standing.acknowledged = True

    def clear(self) -> None:
        """Forget all, as a replay does that goes back."""
        with self._lock:
            self._standing, self.alarms = {}, ()

    def rows(self, wall_s: float) -> list[dict[str, object]]:
        """Return the alarms as plain data, red ones first, with how long each stands or has been over [s; wall]."""
        with self._lock:
            ordered = sorted(self._standing.values(), key=lambda each: _rank(each.alarm, each.over_s is not None))
            return [
                {
                    **each.alarm._asdict(),
                    "for_s": wall_s - each.since_s,
                    "acknowledged": each.acknowledged,
                    "over_s": None if each.over_s is None else wall_s - each.over_s,
                    "times": each.times,
                }
                for each in ordered
            ]

    def severity_of(self, subject: str) -> Severity | None:
        """Return the worst alarm of a drone, formation or process; None where it has none. For its colour."""
        return next((each.severity for each in self.alarms if each.subject == subject), None)


def _rank(alarm: Alarm, is_over: bool = False) -> tuple[bool, bool, str, str]:
    return alarm.severity != "red", is_over, alarm.subject, alarm.name
