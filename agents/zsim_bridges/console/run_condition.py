"""The condition of the run that pages show: alarms, checks before a take-off, refusals, and the page's head. No I/O.

An alarm is amber or red. A control on a page is disabled, and shows the reason, while its request would be refused.
Such reasons are called refusals here; an empty one means that the request would be accepted.
"""

import math
import threading
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from zsim.contract.flight_messages import ViewCluster, state_refusal
from zsim.contract.messages import Info
from zsim.contract.run_messages import ADMISSIONS, Clock, Event, Fault, Health, holding_up, waiting_text
from zsim.scenario.scenario import Scenario
from zsim_agents.formation.flight_check import (
    AIRBORNE,
    DOWN,
    GUARD_PARTS,
    HELD_ON_REQUEST,
    READY_TO_ENGAGE,
    REJOINING,
    TOO_NEAR,
    EngagementLimits,
)
from zsim_agents.formation.spaces.cluster_space import ClusterSpace, unit

Severity = Literal["amber", "red"]
BATTERY_LOW_PERCENT, BATTERY_EMPTY_PERCENT = 20.0, 10.0  # thresholds of amber and red; the AR.Drone warns at the first
UPSIDE_DOWN_DEG = 90.0
LAG_MAX_MS = 200.0  # an estimator's lag above which an alarm is raised: ten gates of 20 ms
SIGMA_HIGH_M = 2.0  # σ of a position above which an alarm is raised: the default minimum separation of drones
LINK_AGE_MAX_MS, LINK_LOSS_PERCENT = 500.0, 10.0  # alarm thresholds; PX4 leaves offboard mode after the first
LOSS_NAMES = {
    "death": "dead",
    "no_show": "missing",
    "silent": "silent",
    "overdue": "overdue",
    "failure": "failed",
    "diverged": "diverged",
}
"""Kinds of events that report the loss of a process or drone, with the names of the alarms."""
RETURN_KINDS = frozenset({*ADMISSIONS, "silent_end", "leave"})  # kinds of events that end a loss; `drop` does not
OFF_REFERENCE_M = 2.0  # alarm threshold of a length's error: the default minimum separation of drones
FLOWN_PHASES = frozenset({"assembling", "engaged"})  # phases in which a formation's controller flies all of its drones


class Alarm(NamedTuple):
    """An alarm: amber calls for attention, red for action; `name` is unique per drone, formation or process."""

    severity: Severity
    subject: str
    name: str
    text: str = ""


class DroneCondition(NamedTuple):
    """The quantities from which a drone's alarms and checks follow; None where unknown or not applicable."""

    name: str
    state: str
    battery_percent: float
    lag_ms: float | None = None
    sigma_m: float | None = None
    yaw_sigma_deg: float | None = None
    estimate_lost: bool = False
    tilt_deg: float | None = None
    failsafe: str = ""  # why it landed by itself or its rotors were stopped; empty if neither
    commander: str | None = None
    is_external: bool = False
    link_age_s: float | None = None  # wall time since its driver last published the state of the link
    link_state: str | None = None
    link_age_ms: float | None = None
    link_loss_percent: float | None = None


def battery_severity(percent: float) -> Severity | None:
    if percent < BATTERY_EMPTY_PERCENT:
        return "red"
    return "amber" if percent < BATTERY_LOW_PERCENT else None


def drone_alarms(drone: DroneCondition) -> list[Alarm]:
    alarms: list[Alarm] = []

    def add(severity: Severity, name: str, text: str = "") -> None:
        alarms.append(Alarm(severity, drone.name, name, text))

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
    elif (drone.lag_ms or 0.0) > LAG_MAX_MS:
        add("amber", "estimate late", f"{drone.lag_ms:.0f} ms")
    if (drone.sigma_m or 0.0) > SIGMA_HIGH_M:
        add("amber", "sigma", f"{drone.sigma_m:.1f} m")
    if drone.link_state == "lost":
        add("red", "link lost")
        return alarms
    if (drone.link_age_ms or 0.0) > LINK_AGE_MAX_MS:
        add("amber", "link stale", f"{drone.link_age_ms:.0f} ms")
    if (drone.link_loss_percent or 0.0) > LINK_LOSS_PERCENT:
        add("amber", "link loss", f"{drone.link_loss_percent:.0f} %")
    return alarms


def formation_alarms(
    phases: Mapping[str, tuple[str, str]],
    foreign: Mapping[str, Mapping[str, str]],
    views: Mapping[str, ViewCluster],
) -> list[Alarm]:
    """Return the alarms of formations.

    Args:
        phases: phase and reason of each formation.
        foreign: for each formation, the commanders of its drones other than its controller, by drone.
        views: newest view of each formation.
    """
    alarms = []
    for name, (phase, reason) in phases.items():
        if TOO_NEAR in reason:
            alarms.append(Alarm("red", name, "too near", reason))
        elif phase == "held" and HELD_ON_REQUEST not in reason:
            alarms.append(Alarm("amber", name, "held", reason))
        if phase in FLOWN_PHASES and foreign.get(name):
            alarms.append(Alarm("amber", name, "other commanders", foreign_text(foreign[name])))
        if phase == "engaged" and (deviation := _largest_deviation(views[name])):
            alarms.append(Alarm("red", name, "off reference", deviation))
    return alarms


def foreign_text(commanders: Mapping[str, str]) -> str:
    return ", ".join(f"{drone} is flown by {commander}" for drone, commander in commanders.items())


def foreign_commanders(
    controller: str, members: Iterable[str], commanders: Mapping[str, str | None], roles: Mapping[str, str]
) -> dict[str, str]:
    """Return the commanders of a formation's drones other than its controller, by drone.

    Args:
        controller: expected name of the controller's process; if no drone is flown by a process of that name, the
            controller may have another name, so only consoles are considered foreign.
        members: the formation's drones.
        commanders: commander of each drone.
        roles: roles of the known processes, by name.
    """
    others = {drone: commander for drone in members if (commander := commanders.get(drone)) and commander != controller}
    if any(commanders.get(drone) == controller for drone in members):
        return others
    return {
        d: commander
        for d, commander in others.items()
        if roles.get(commander, commander.partition(".")[0]) == "console"
    }


def _largest_deviation(view: ViewCluster) -> str:
    """Describe the length that deviates most from its reference in an engaged formation; empty if all are close."""
    errors = [
        (abs(value - desired), name, value, desired)
        for name, value, desired in zip(view.names, view.value, view.desired, strict=True)
        if unit(name) == "m"
    ]
    error_m, name, value, desired = max(errors, default=(0.0, "", 0.0, 0.0))
    return f"{name} is {value:.1f} m; should be {desired:.1f} m" if error_m > OFF_REFERENCE_M else ""


def run_alarms(losses: Mapping[str, Event], active: Iterable[Fault], silent_s: float) -> list[Alarm]:
    """Return the alarms of lost processes, of active injected faults, and of a silent world."""
    alarms = [Alarm("red", name, LOSS_NAMES[event.kind], event.text) for name, event in losses.items()]
    if silent_s:
        alarms.append(Alarm("red", "world", "silent", f"no answer for {silent_s:.0f} s"))
    return alarms + [Alarm("amber", fault.target, fault.kind, parameters_text(fault)) for fault in active]


def parameters_text(fault: Fault) -> str:
    """Return the parameters of a fault as typed in a terminal: NAME=VALUE."""
    return " ".join(f"{name}={value}" for name, value in fault.parameters.items() if value not in (None, {}))


class Losses:
    """Tracks which processes and drones are lost: `current` holds the newest event about each; thread-safe."""

    def __init__(self) -> None:
        self.current: dict[str, Event] = {}

    def note(self, event: Event) -> None:
        """Process an event: a process or drone may be lost, return, or be replaced."""
        is_false_join = event.kind == "no_show" and "incarnation" in event.data  # the process of that name is present
        if event.kind in LOSS_NAMES and not is_false_join:
            self.current = {**self.current, event.subject: event}
        elif event.kind in RETURN_KINDS:
            self._remove({event.subject, *map(str, event.data.get("serves") or ())})

    def note_health(self, name: str, health: Health) -> None:
        """Process a health message: a process whose host or pid differs from that of the lost one replaces it."""
        lost = self.current.get(name)
        pid = None if lost is None else lost.data.get("pid")
        if lost is not None and pid and (lost.data.get("host"), pid) != (health.host, health.pid):
            self._remove({name})

    def _remove(self, names: set[str]) -> None:
        self.current = {name: lost for name, lost in self.current.items() if name not in names}


@dataclass
class _BoardEntry:
    """An alarm on the board; `times` counts how often it was raised."""

    alarm: Alarm
    since_s: float  # when it was last raised [s; wall]
    times: int = 1
    ended_s: float | None = None  # when it ended [s; wall]; None while it is active
    acknowledged: bool = False


class AlarmBoard:
    """The active alarms, and ended red ones until they are acknowledged, since they may have gone unnoticed."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._entries: dict[tuple[str, str], _BoardEntry] = {}
        self.alarms: tuple[Alarm, ...] = ()

    def update(self, alarms: Sequence[Alarm], wall_s: float) -> None:
        with self._lock:
            now = {(each.subject, each.name): each for each in alarms}
            for key, entry in list(self._entries.items()):
                if key in now:
                    continue
                if entry.alarm.severity != "red" or entry.acknowledged:
                    del self._entries[key]
                elif entry.ended_s is None:
                    entry.ended_s = wall_s
            for key, alarm in now.items():
                entry = self._entries.setdefault(key, _BoardEntry(alarm, wall_s))
                if entry.ended_s is not None:
                    entry.since_s, entry.ended_s, entry.times = wall_s, None, entry.times + 1
                if alarm.severity != entry.alarm.severity:
                    entry.acknowledged = False
                entry.alarm = alarm
            self.alarms = tuple(sorted(now.values(), key=_rank))

    def acknowledge(self) -> None:
        """Acknowledge all alarms and remove ended ones; an alarm that later turns red must be acknowledged again."""
        with self._lock:
            self._entries = {key: each for key, each in self._entries.items() if each.ended_s is None}
            for entry in self._entries.values():
                entry.acknowledged = True

    def clear(self) -> None:
        """Remove all alarms, as when a replay has been rewound."""
        with self._lock:
            self._entries, self.alarms = {}, ()

    def rows(self, wall_s: float) -> list[dict[str, object]]:
        """Return the alarms as plain data, red ones first, with how long each has been active or over [s; wall]."""
        with self._lock:
            ordered = sorted(self._entries.values(), key=lambda each: _rank(each.alarm, each.ended_s is not None))
            return [
                {
                    **each.alarm._asdict(),
                    "for_s": wall_s - each.since_s,
                    "acknowledged": each.acknowledged,
                    "over_s": None if each.ended_s is None else wall_s - each.ended_s,
                    "times": each.times,
                }
                for each in ordered
            ]

    def severity_of(self, subject: str) -> Severity | None:
        """Return the severity of the worst alarm of a drone, formation or process; None if there is none."""
        return next((each.severity for each in self.alarms if each.subject == subject), None)


def _rank(alarm: Alarm, is_over: bool = False) -> tuple[bool, bool, str, str]:
    return alarm.severity != "red", is_over, alarm.subject, alarm.name


TILT_MAX_DEG = 30.0  # maximum tilt before take-off; design choice: above any slope, far below that of a toppled drone
LINK_SILENT_S = 3.0  # wall; drivers publish the state of a link once a second
LIMITS = EngagementLimits()  # limits within which a formation's controller lets its drones take off
AT_END = "the record is at its end; go back on the timeline"
NO_CLOCK = "waiting for the world's clock"
WAITING_SHOWN_S = 2.0  # wall; a running world that has waited for a process for longer is shown as waiting
NO_RUN = {"t_s": 0.0, "replay": False, "age_s": 0.0, "alarms": []}
Level = Literal["no run", "waiting", "running", "paused", "emergency", "silent", "ended"]


class ShownRun(NamedTuple):
    """The constant properties of the run that pages show; `spaces` has the cluster space of each formation."""

    info: Info
    scenario: Scenario
    spaces: Mapping[str, ClusterSpace]

    @property
    def is_replay(self) -> bool:
        return bool(self.info.replay_of)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(drone.name for drone in self.info.drones)

    @property
    def members(self) -> dict[str, tuple[str, ...]]:
        return {cluster.name: tuple(cluster.drones) for cluster in self.scenario.clusters}

    @property
    def single(self) -> list[str]:
        return single_drones(self.scenario)


def single_drones(scenario: Scenario) -> list[str]:
    in_formations = {name for cluster in scenario.clusters for name in cluster.drones}
    return [drone.name for drone in scenario.drones if drone.name not in in_formations]


# Checks before a take-off


class Check(NamedTuple):
    """One check of a drone before its take-off."""

    name: str  # name of the checked property
    text: str  # the measured value, and the allowed range if the check fails
    ok: bool = True
    blocks: bool = False  # whether a failure disables the take-off


def preflight_checks(drone: DroneCondition, in_formation: bool, foreign: str = "") -> tuple[Check, ...]:
    """Return a drone's checks before a take-off.

    Args:
        in_formation: whether a formation's controller flies the drone, and so needs its estimate.
        foreign: the drone's commander if that is not its formation's controller; otherwise empty.
    """
    percent, tilt_deg = drone.battery_percent, drone.tilt_deg or 0.0
    checks = []
    if percent < BATTERY_EMPTY_PERCENT:
        text = f"{percent:.0f} %; must be {BATTERY_EMPTY_PERCENT:.0f} % or more"
        checks.append(Check("battery", text, False, True))
    else:
        is_low = percent < BATTERY_LOW_PERCENT
        checks.append(Check("battery", f"{percent:.0f} %{'; low' if is_low else ''}", not is_low))
    if tilt_deg > TILT_MAX_DEG:
        text = f"tilted by {tilt_deg:.0f}°; must be {TILT_MAX_DEG:.0f}° or less"
        checks.append(Check("upright", text, False, True))
    else:
        checks.append(Check("upright", f"{tilt_deg:.0f}°"))

    sigma_m, yaw_deg, yaw_max_deg = drone.sigma_m, drone.yaw_sigma_deg or 0.0, math.degrees(LIMITS.yaw_sigma_max_rad)
    if sigma_m is None:
        checks.append(Check("estimator", "no current estimate", False, in_formation))
    elif sigma_m > LIMITS.sigma_max_m:
        text = f"σ of position is {sigma_m:.1f} m; must be {LIMITS.sigma_max_m:g} m or less"
        checks.append(Check("estimator", text, False, in_formation))
    elif yaw_deg > yaw_max_deg:
        text = f"σ of heading is {yaw_deg:.0f}°; must be {yaw_max_deg:.0f}° or less"
        checks.append(Check("estimator", text, False, in_formation))
    elif (drone.lag_ms or 0.0) > LAG_MAX_MS:
        checks.append(Check("estimator", f"{drone.lag_ms:.0f} ms late", False))
    else:
        checks.append(Check("estimator", f"σ {sigma_m:.2f} m"))

    link, link_age_s = drone.link_state, drone.link_age_s
    if not drone.is_external:
        pass  # it has no driver, so a published link state is ignored
    elif link is None or link_age_s is None:
        checks.append(Check("link", "no driver yet", False, True))
    elif link_age_s > LINK_SILENT_S:
        checks.append(Check("link", f"its driver has been silent for {link_age_s:.0f} s", False, True))
    else:
        checks.append(Check("link", link, link in ("connected", "armed"), blocks=True))
    text = f"flown by {foreign}; must be released" if foreign else drone.commander or "free"
    return *checks, Check("control", text, not foreign, blocks=in_formation)


class RunCondition(NamedTuple):
    """The condition of a run, which determines what the controls of a page offer."""

    clock: str | None = None  # state of the run's clock; None before the first answer
    silent_s: float = 0.0  # time since the world last answered [s; wall]; 0 while it answers
    ended: str = ""  # why the run is over; empty while it continues
    replayed: bool = False  # whether the run is a replay, in which nothing can be flown
    at_end: bool = False  # whether the replay is at the end of its record
    drones: Mapping[str, str] = {}  # states of the drones seen so far, by name
    phases: Mapping[str, tuple[str, str]] = {}  # phase and reason of each formation, by name
    members: Mapping[str, Collection[str]] = {}  # names of each formation's drones
    checks: Mapping[str, tuple[Check, ...]] = {}  # checks before take-off of each drone seen so far

    @property
    def level(self) -> Level:
        if self.ended:
            return "ended"
        if self.silent_s:
            return "silent"
        if "emergency" in self.drones.values() and not self.replayed:  # an emergency in a replay needs no action
            return "emergency"
        return "paused" if self.clock == "paused" else "running" if self.clock == "running" else "waiting"

    def outage(self) -> str:
        if self.ended:
            return f"the run is over: {self.ended}"
        return f"the world has not answered for {self.silent_s:.0f} s" if self.silent_s else ""

    def flight_refusal(self) -> str:
        return self.outage() or ("a record is being played back" if self.replayed else "")

    def all_down(self, names: Collection[str] | None = None) -> bool:
        """Return whether all drones seen so far, or the named ones, are on the ground."""
        return DOWN.issuperset(state for name, state in self.drones.items() if names is None or name in names)


# Refusals


def run_refusals(run: RunCondition) -> dict[str, str]:
    outage, state = run.outage(), run.clock
    unseen = "" if state else NO_CLOCK
    running = "" if state == "running" else unseen or f"the run is {state}"
    paused = "" if state == "paused" else unseen or f"the run is {state}, not paused"
    resume = outage or paused or (AT_END if run.at_end else "")
    return {"pause": outage or running, "resume": resume, "step": resume, "rate": outage, "seek": outage}


def drone_refusals(run: RunCondition, drone: str) -> dict[str, str]:
    state = run.drones.get(drone)
    modes = ("takeoff", "land", "return", "emergency", "reset")
    common = run.flight_refusal() or ("" if state else f"{drone} has not been seen yet")
    refusals = {mode: common or state_refusal(drone, state or "", mode) or "" for mode in modes}
    refusals["takeoff"] = refusals["takeoff"] or preflight_refusal(run, [drone])
    # An emergency stop is possible whatever the drone's state, since the known one may be outdated.
    return {**refusals, "emergency": run.flight_refusal()}


def preflight_refusal(run: RunCondition, drones: Collection[str]) -> str:
    refusals = []
    for name in drones:
        if run.drones.get(name) == "landed":
            failed = [f"{each.name} {each.text}" for each in run.checks.get(name, ()) if each.blocks and not each.ok]
            refusals += [f"{name}: {', '.join(failed)}"] if failed else []
    return "; ".join(refusals)


def is_held_by_fault(run: RunCondition, cluster: str) -> bool:
    """Return whether a formation is held by a fault, not on request (even if the guard moves drones apart)."""
    phase, reason = run.phases.get(cluster, ("", ""))
    on_request = any(note in reason for note in (HELD_ON_REQUEST, GUARD_PARTS)) and REJOINING not in reason
    return phase == "held" and not on_request


def formation_refusals(run: RunCondition, cluster: str) -> dict[str, str]:
    """Return why each operation of a formation would be refused, as far as its phase and its drones' states tell."""
    phase, reason = run.phases.get(cluster, ("", ""))
    grounding = run.flight_refusal() or ("" if phase else f"{cluster} has no controller yet")
    not_engaged = "" if phase == "engaged" else f"{cluster} is {_phase_text(phase)}, not engaged"
    held = f"{cluster} is held: {reason}" if is_held_by_fault(run, cluster) else ""
    steering = grounding or held or ("" if phase == "held" else not_engaged)
    if phase == "assembling":
        engage = "" if READY_TO_ENGAGE in reason else reason
    elif phase == "held" and not held:
        engage = ""
    else:
        engage = f"{cluster} is {_phase_text(phase)}; it engages when assembled, or when held on request"
    grounded = [name for name in run.members.get(cluster, ()) if run.drones.get(name) not in AIRBORNE]
    fault = reason if held else ""
    if not fault or REJOINING in fault:
        rejoin = f"{cluster} is {'rejoining' if fault else 'not held by a fault'}"
    elif grounded:
        state = run.drones.get(grounded[0]) or "not seen"
        rejoin = f"{grounded[0]} is {_phase_text(state)}; let it take off first"
    else:
        rejoin = ""
    return {
        "takeoff": grounding or _takeoff_refusal(run, cluster, phase),
        "engage": grounding or engage,
        "hold": grounding or ("" if REJOINING in reason else held or not_engaged),
        "rejoin": grounding or rejoin,
        "land": grounding or ("all drones are on the ground" if phase == "idle" and run.all_down() else ""),
        "target": steering,
        "trajectory": steering,
    }


def _takeoff_refusal(run: RunCondition, cluster: str, phase: str) -> str:
    """Return why a formation would not take off; each of its drones must be landed or in the air."""
    members = run.members.get(cluster, ())
    if phase != "idle":
        idle_first = "; Land makes it idle" if phase == "held" and run.all_down(members) else ""
        return f"{cluster} is {_phase_text(phase)}, not idle{idle_first}"
    states = {name: run.drones.get(name, "landed") for name in members}
    stopped = [name for name, state in states.items() if state == "emergency"]
    if stopped:
        return _reset_first(stopped)
    moving = [name for name, state in states.items() if state not in AIRBORNE | DOWN]
    if moving:
        return f"{moving[0]} is {_phase_text(states[moving[0]])}; it must be landed or in the air"
    return preflight_refusal(run, members)


def _reset_first(stopped: Sequence[str]) -> str:
    return f"{', '.join(stopped)} must be reset first: rotors stopped in an emergency"


def fleet_refusals(run: RunCondition, single: Collection[str] = ()) -> dict[str, str]:
    """Return why each operation on all drones would have no effect; `single` names the drones without a formation."""
    grounding = run.flight_refusal()
    in_air = not run.all_down() or any(phase not in ("idle", "landing") for phase, _ in run.phases.values())
    in_emergency = "emergency" in run.drones.values()
    refusals = {name: _takeoff_refusal(run, name, phase) for name, (phase, _) in run.phases.items()}
    landed = [name for name in single if run.drones.get(name) == "landed"]
    unready = [refusal for name in landed if (refusal := preflight_refusal(run, [name]))]
    takeoff = ""
    if "" not in refusals.values() and len(landed) == len(unready):  # no formation and no single drone can take off
        stopped = [name for name in single if run.drones.get(name) == "emergency"]
        on_ground = [refusal for name, refusal in refusals.items() if run.all_down(run.members.get(name, ()))]
        reasons = [*on_ground, *unready, *([_reset_first(stopped)] if stopped else []), *refusals.values()]
        takeoff = reasons[0] if reasons else "no drone is on the ground"
    return {
        "takeoff": grounding or takeoff,
        "land": grounding or ("" if in_air else "all drones are on the ground"),
        "reset": grounding or ("" if in_emergency else "no drone is in an emergency"),
    }


def _phase_text(phase: str) -> str:
    return phase.replace("_", " ")


# The head of the page


def page_head(
    name: str,
    run: RunCondition,
    clock: Clock | None,
    t_ns: int,
    alarms: Sequence[dict[str, object]] = (),
    single: Sequence[str] = (),
    world: str = "",
    record_s: tuple[float, float] | None = None,
) -> dict[str, Any]:
    """Return the head of the page of a run as plain data.

    Args:
        name: the scenario's name.
        t_ns: simulated time of the views that are shown.
        alarms: alarms as returned by `AlarmBoard.rows`.
        single: drones without a formation.
        world: description of where the run is.
        record_s: times of the first and the last recorded gate of a replay [s].
    """
    is_waiting = clock is not None and any(each.since_wall_s > WAITING_SHOWN_S for each in clock.waiting_for)
    level = "waiting" if run.level == "running" and is_waiting else run.level
    t_s = (t_ns or (clock.t_ns if clock else 0)) / 1e9
    if run.level == "ended":
        title, detail = f"run over at {t_s:.1f} s", run.ended
    elif run.level == "silent":
        title = f"no answer from the world for {run.silent_s:.0f} s"
        detail = f"the display shows the state at {t_s:.1f} s and may be outdated"
    else:
        state = "waiting" if run.clock == "running" and is_waiting else run.clock or "no clock yet"
        rate_text = f" × {clock.rate:.1f}" if clock is not None and state == "running" else ""
        title, detail = f"{state} {t_s:.1f} s{rate_text}", _waiting(clock, world)
        if run.replayed:
            from_s, to_s = record_s or (t_s, t_s)
            share = f" ({100.0 * min(1.0, max(0.0, t_s - from_s) / (to_s - from_s)):.0f} %)" if to_s > from_s else ""
            title = f"REPLAY · {state} {t_s:.1f} of {to_s:.1f} s{share}{rate_text}"
        if run.level == "emergency":
            title = f"EMERGENCY · {title}"
    phases = run.phases if len(run.phases) <= 1 and not (run.ended or run.silent_s) else {}
    formation = [f"{n}: {_phase_text(p)}{f' – {reason}' if reason else ''}" for n, (p, reason) in phases.items()]
    lines = [name, "a record is being played back" if run.replayed else "", detail, *formation]
    refusals = {"land": fleet_refusals(run, single)["land"], "emergency": run.flight_refusal()}
    common = {"t_s": t_ns / 1e9, "replay": run.replayed, "age_s": run.silent_s, "alarms": list(alarms)}
    return {"level": level, "title": title, "detail": " · ".join(filter(None, lines)), "refusals": refusals, **common}


def no_run_head(world: str, ended: str = "") -> dict[str, Any]:
    """Return the head of a page without a run.

    Args:
        world: description of where the console looks for a run.
        ended: why the launcher's run ended before the console found it.
    """
    reason = f"the run is over: {ended}" if ended else "there is no run yet"
    level, title, detail = ("ended", "run over", ended) if ended else ("waiting", "waiting for a world", world)
    refusals: dict[str, Any] = {"refusals": {"land": reason, "emergency": reason}}
    return {"level": level, "title": title, "detail": detail, **refusals, **NO_RUN}


def _waiting(clock: Clock | None, world: str) -> str:
    """Describe which processes the world is waiting for and, if some are absent, where they are expected."""
    if clock is None:
        return NO_CLOCK
    text = waiting_text(clock.state, clock.waiting_for)
    all_present = all(each.host for each in holding_up(clock.state, clock.waiting_for))
    return f"{text} in {world}" if world and not all_present else text
