"""Alarms of a run, amber or red, from its condition and events; and the effects of injected faults.

Order of this file: alarms of drones, formations and processes, which are pure; losses of processes; the board with
the age of each alarm and its acknowledgement; the watch on faults.
"""

import threading
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from zsim.contract.flight_messages import ViewCluster
from zsim.contract.run_messages import Event, Fault, Health
from zsim_agents.formation.flight_check import HELD_ON_REQUEST, TOO_NEAR
from zsim_agents.formation.spaces.cluster_space import unit

Severity = Literal["amber", "red"]
BATTERY_LOW_PERCENT, BATTERY_EMPTY_PERCENT = 20.0, 10.0  # the AR.Drone warns at the first
UPSIDE_DOWN_DEG = 90.0
LATE_MS = 200.0  # of an estimator: ten gates of 20 ms
SIGMA_HIGH_M = 2.0  # of a position; chosen: the greatest distance between the paper's drones
LINK_OLD_MS, LINK_LOSS_PERCENT = 500.0, 10.0  # chosen; PX4 leaves offboard mode after the first
LOST = {
    "death": "dead",
    "no_show": "missing",
    "silent": "silent",
    "overdue": "overdue",
    "failure": "failed",
    "diverged": "diverged",
}
"""Kinds of events that report the loss of a process or drone, with the name of the alarm."""
BACK = frozenset({"join", "restart", "superseded", "silent_end", "leave"})  # kinds that end a loss; a drop does not
OFF_REFERENCE_M = 2.0  # of a length of an engaged formation; chosen: the least distance between the paper's drones
FLOWN_PHASES = frozenset({"assembling", "engaged"})  # in which a formation's controller flies all of its drones
KEPT = 8  # faults that are over and still shown
SIGMA_GROWN = 1.2  # ratio; the sigma of an estimate changes by that much without a fault
LAG_GROWN_MS = 40.0  # two gates
LIFE = ("alive", "dead")  # states of a process
DEATH_AND_RETURN = 3  # alive, dead, alive
WIND_GROWN_M_S = 0.3  # chosen: above the rounding of what is shown


class Alarm(NamedTuple):
    """An alarm: amber calls for attention, red for action; `name` is unique per drone, formation or process."""

    severity: Severity
    subject: str
    name: str
    text: str = ""


class DroneCondition(NamedTuple):
    """The inputs of a drone's alarms and checks; None where unknown or not applicable."""

    name: str
    state: str
    battery_percent: float
    lag_ms: float | None = None
    sigma_m: float | None = None
    yaw_sigma_deg: float | None = None
    estimate_lost: bool = False
    tilt_deg: float | None = None
    failsafe: str = ""  # why its firmware is landing it or has stopped its rotors without a command; otherwise empty
    commander: str | None = None
    is_external: bool = False
    link_age_s: float | None = None  # wall, since its driver has published the state of the link
    link_state: str | None = None
    link_age_ms: float | None = None
    link_loss_percent: float | None = None


def battery_severity(percent: float) -> Severity | None:
    if percent < BATTERY_EMPTY_PERCENT:
        return "red"
    return "amber" if percent < BATTERY_LOW_PERCENT else None


def drone_alarms(drone: DroneCondition) -> list[Alarm]:
    found: list[Alarm] = []

    def add(severity: Severity, name: str, text: str = "") -> None:
        found.append(Alarm(severity, drone.name, name, text))

    if drone.state == "emergency":
        add("red", "emergency", drone.failsafe or "rotors stopped")
    elif drone.state == "landing" and drone.failsafe:
        add("red", "lands by itself", drone.failsafe)
    if (drone.tilt_deg or 0.0) > UPSIDE_DOWN_DEG:
        add("red", "upside down", f"tilted by {drone.tilt_deg:.0f}°")
    if severity := battery_severity(drone.battery_percent):
        add(severity, "battery", f"{drone.battery_percent:.0f} %")
    if drone.estimate_lost:
        add("red", "no estimate")
    elif (drone.lag_ms or 0.0) > LATE_MS:
        add("amber", "estimate late", f"{drone.lag_ms:.0f} ms")
    if (drone.sigma_m or 0.0) > SIGMA_HIGH_M:
        add("amber", "sigma", f"{drone.sigma_m:.1f} m")
    if drone.link_state == "lost":
        add("red", "link lost")
        return found
    if (drone.link_age_ms or 0.0) > LINK_OLD_MS:
        add("amber", "link old", f"{drone.link_age_ms:.0f} ms")
    if (drone.link_loss_percent or 0.0) > LINK_LOSS_PERCENT:
        add("amber", "link loss", f"{drone.link_loss_percent:.0f} %")
    return found


def formation_alarms(
    phases: Mapping[str, tuple[str, str]],
    foreign: Mapping[str, Mapping[str, str]],
    views: Mapping[str, ViewCluster],
) -> list[Alarm]:
    """Return the alarms of formations, by their phases and reasons, other commanders of their drones, and views."""
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
    return ", ".join(f"{drone} is flown by {who}" for drone, who in commanders.items())


def foreign_commanders(
    controller: str, members: Iterable[str], commanders: Mapping[str, str | None], roles: Mapping[str, str]
) -> dict[str, str]:
    """Return the commanders, other than its controller, of a formation's drones, by drone.

        Args:
    controller: expected name of the formation's process; if it flies no drone, the controller may have another
                name, so only consoles count as foreign.
            roles: of processes, as far as known.
    """
    others = {drone: who for drone in members if (who := commanders.get(drone)) and who != controller}
    if any(commanders.get(drone) == controller for drone in members):
        return others
    return {d: who for d, who in others.items() if roles.get(who, who.partition(".")[0]) == "console"}


def _strayed(view: ViewCluster) -> str:
    """Describe the length of an engaged formation that deviates most from its reference; empty if all are close."""
    apart = [
        (abs(value - desired), name, value, desired)
        for name, value, desired in zip(view.names, view.value, view.desired, strict=True)
        if unit(name) == "m"
    ]
    away_m, name, value, desired = max(apart, default=(0.0, "", 0.0, 0.0))
    return f"{name} is {value:.1f} m, to be {desired:.1f} m" if away_m > OFF_REFERENCE_M else ""


def run_alarms(losses: Mapping[str, Event], active: Iterable[Fault], silent_s: float) -> list[Alarm]:
    """Return the alarms of lost processes, of active injected faults, and of a silent world."""
    found = [Alarm("red", name, LOST[event.kind], event.text) for name, event in losses.items()]
    if silent_s:
        found.append(Alarm("red", "world", "silent", f"no answer for {silent_s:.0f} s"))
    return found + [Alarm("amber", fault.target, fault.kind, parameters_text(fault)) for fault in active]


def parameters_text(fault: Fault) -> str:
    """Return the parameters of a fault as in the terminal: NAME=VALUE."""
    return " ".join(f"{name}={value}" for name, value in fault.parameters.items() if value not in (None, {}))


class Losses:
    """Tracks which processes and drones are lost: `now` holds the newest event about each; thread-safe."""

    def __init__(self) -> None:
        self.now: dict[str, Event] = {}

    def note(self, event: Event) -> None:
        """Process an event: a loss, or a return, of the process itself or of one that replaces it."""
        no_process_joined = event.kind == "no_show" and "incarnation" in event.data  # it has returned
        if event.kind in LOST and not no_process_joined:
            self.now = {**self.now, event.subject: event}
        elif event.kind in BACK:
            self._remove({event.subject, *map(str, event.data.get("serves") or ())})

    def note_health(self, name: str, health: Health) -> None:
        """Process a health message: a process with another host or pid replaces a lost one."""
        lost = self.now.get(name)
        pid = None if lost is None else lost.data.get("pid")
        if lost is not None and pid and (lost.data.get("host"), pid) != (health.host, health.pid):
            self._remove({name})

    def _remove(self, names: set[str]) -> None:
        self.now = {name: lost for name, lost in self.now.items() if name not in names}


@dataclass
class _Standing:
    """An alarm on the board: how often it was raised, and when it ended [s; wall]; None while it is active."""

    alarm: Alarm
    since_s: float
    times: int = 1
    over_s: float | None = None
    acknowledged: bool = False


class AlarmBoard:
    """The active alarms; a red one that has ended stays until it is acknowledged, since it may have gone unnoticed."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._standing: dict[tuple[str, str], _Standing] = {}
        self.alarms: tuple[Alarm, ...] = ()

    def update(self, alarms: Sequence[Alarm], wall_s: float) -> None:
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
                standing = self._standing.setdefault(key, _Standing(alarm, wall_s))
                if standing.over_s is not None:
                    standing.since_s, standing.over_s, standing.times = wall_s, None, standing.times + 1
                if alarm.severity != standing.alarm.severity:
                    standing.acknowledged = False
                standing.alarm = alarm
            self.alarms = tuple(sorted(now.values(), key=_rank))

    def acknowledge(self) -> None:
        """Acknowledge all alarms and remove ended ones; an alarm that turns red later needs a new acknowledgement."""
        with self._lock:
            self._standing = {key: each for key, each in self._standing.items() if each.over_s is None}
            for standing in self._standing.values():
                standing.acknowledged = True

    def clear(self) -> None:
        """Remove all: a replay has gone back."""
        with self._lock:
            self._standing, self.alarms = {}, ()

    def rows(self, wall_s: float) -> list[dict[str, object]]:
        """Return the alarms as plain data, red ones first, with how long each has been active or over [s; wall]."""
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
        """Return the severity of the worst alarm of a drone, formation or process; None without one."""
        return next((each.severity for each in self.alarms if each.subject == subject), None)


def _rank(alarm: Alarm, is_over: bool = False) -> tuple[bool, bool, str, str]:
    return alarm.severity != "red", is_over, alarm.subject, alarm.name


class FaultWatch:
    """The targets of injected faults, and what has changed since they began. Pure."""

    def __init__(self) -> None:
        self._watched: dict[int, _WatchedFault] = {}

    def clear(self) -> None:
        self._watched.clear()

    def update(
        self,
        begun: Iterable[Fault],
        active: Iterable[Fault],
        drones: Mapping[str, DroneCondition],
        phases: Mapping[str, str],
        lost: Collection[str],
        wind_m_s: float,
    ) -> None:
        """Update from the present condition: faults begun or active, processes dead or silent."""
        acting = {fault.id: fault for fault in active}
        known = {fault.id: fault for fault in begun} | acting
        for number in self._watched.keys() - known.keys():
            self._watched[number].over = True
        for number, fault in known.items():
            watched = self._watched.setdefault(number, _WatchedFault(fault))
            watched.fault, watched.over = acting.get(number, watched.fault), number not in acting
            watched.update(drones, phases, lost, wind_m_s)
        over = [number for number, each in self._watched.items() if each.over]
        for number in over[:-KEPT]:
            del self._watched[number]

    def lines(self, is_over: bool = False) -> list[str]:
        return [each.line() for each in self._watched.values() if each.over == is_over]


@dataclass
class _WatchedFault:
    """A fault and the quantities of its target (drones, or processes named after them) that it may change."""

    fault: Fault
    before: tuple[float, ...] = ()  # sigma [m], lag [ms] and wind [m/s] of the target at first
    worst: tuple[float, ...] = ()  # the worst of these while the fault is active
    states: dict[str, list[str]] = field(default_factory=dict)  # successive states of drones, formations and processes
    over: bool = False

    def update(
        self,
        drones: Mapping[str, DroneCondition],
        phases: Mapping[str, str],
        lost: Collection[str],
        wind_m_s: float,
    ) -> None:
        """Record the worst figures and all states while the fault is active; a killed process returns afterwards."""
        parts = self.fault.target.split("/")
        things = {part.rpartition(".")[2] for part in parts}
        everybody = not things & (set(drones) | set(phases))  # the world
        struck = [drone for name, drone in drones.items() if everybody or name in things]
        sigma_m = max((drone.sigma_m or 0.0 for drone in struck), default=0.0)
        lag_ms = max((drone.lag_ms or 0.0 for drone in struck), default=0.0)
        now = (sigma_m, lag_ms, wind_m_s if self.fault.kind == "gust" else 0.0)
        self.before = self.before or now
        if not self.over:
            self.worst = tuple(map(max, self.worst or now, now))
        states = {drone.name: drone.state for drone in struck}
        states |= phases if everybody or len(phases) == 1 else {name: phases[name] for name in things & set(phases)}
        states |= {part: LIFE[part in lost] for part in parts if "." in part}
        for name, state in states.items():
            seen = self.states.setdefault(name, [state])
            is_killed = state in LIFE and len(seen) < DEATH_AND_RETURN
            if seen[-1] != state and (not self.over or is_killed):
                seen.append(state)

    def line(self) -> str:
        fault, worst = self.fault, self.worst or self.before
        until = "" if fault.until_ns is None else f" to {fault.until_ns / 1e9:.1f} s"
        what = " ".join(filter(None, (f"#{fault.id} {fault.kind} of {fault.target}", parameters_text(fault))))
        effects = []
        if worst[0] > SIGMA_GROWN * self.before[0] > 0.0:
            effects.append(f"σ {self.before[0]:.2f} → {worst[0]:.2f} m")
        if worst[1] > self.before[1] + LAG_GROWN_MS:
            effects.append(f"lag {self.before[1]:.0f} → {worst[1]:.0f} ms")
        if worst[2] > self.before[2] + WIND_GROWN_M_S:
            effects.append(f"wind {self.before[2]:.1f} → {worst[2]:.1f} m/s")
        for name, seen in self.states.items():
            if len(seen) > 1 or seen == ["dead"]:
                effects.append(f"{name} {' → '.join(each.replace('_', ' ') for each in seen[-4:])}")
        return f"{what}, {fault.from_ns / 1e9:.1f} s{until}: {', '.join(effects) or 'no effect seen'}"
