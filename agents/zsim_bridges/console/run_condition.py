"""The condition of the run that pages show: its head, checks before a take-off, and refusals. Pure.

A control of a page is disabled with the reason for which its request would be refused; an empty reason means that the
request would be accepted.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Literal, NamedTuple

from zsim.contract.flight_messages import state_refusal
from zsim.contract.messages import Info
from zsim.contract.run_messages import Clock, holding_up
from zsim.scenario.scenario import Scenario
from zsim_agents.formation.flight_check import (
    AIRBORNE,
    DOWN,
    GUARD_PARTS,
    HELD_ON_REQUEST,
    READY_TO_ENGAGE,
    REJOINING,
    EngagementLimits,
)
from zsim_agents.formation.spaces.cluster_space import ClusterSpace
from zsim_bridges.console.alarms import BATTERY_EMPTY_PERCENT, BATTERY_LOW_PERCENT, LATE_MS, DroneCondition

TILT_MAX_DEG = 30.0  # of a drone that takes off; chosen: more than any slope, much less than on its side
LINK_SILENT_S = 3.0  # wall; drivers publish the state of a link once a second
LIMITS = EngagementLimits()  # of a formation's controller that lets its drones take off
AT_END = "the record is at its end; go back on the timeline"
WAITING_SHOWN = 4  # processes that are named
STANDS_S = 2.0  # wall; a running world that waits for longer appears to have stopped
NO_RUN = {"t_s": 0.0, "replay": False, "age_s": 0.0, "alarms": []}
Level = Literal["no run", "waiting", "running", "paused", "emergency", "silent", "ended"]


class ShownRun(NamedTuple):
    """The constant properties of the run that pages show; cluster spaces by formation."""

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
    led = {name for cluster in scenario.clusters for name in cluster.drones}
    return [drone.name for drone in scenario.drones if drone.name not in led]


# Checks before a take-off


class Check(NamedTuple):
    """One check of a drone before its take-off."""

    name: str  # what is checked
    text: str  # figures, with what is allowed where the check fails
    ok: bool = True
    blocks: bool = False  # whether a failure disables the take-off


def preflight_checks(drone: DroneCondition, in_formation: bool, foreign: str = "") -> tuple[Check, ...]:
    """Return the checks of a drone.

    Args:
        in_formation: whether a controller flies it, which needs its estimator.
        foreign: its commander, if neither this console nor its formation's controller; otherwise empty.
    """
    percent, tilt_deg = drone.battery_percent, drone.tilt_deg or 0.0
    checks = []
    if percent < BATTERY_EMPTY_PERCENT:
        text = f"{percent:.0f} %; must be {BATTERY_EMPTY_PERCENT:.0f} % or more"
        checks.append(Check("battery", text, False, True))
    else:
        low = percent < BATTERY_LOW_PERCENT
        checks.append(Check("battery", f"{percent:.0f} %{'; low' if low else ''}", not low))
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
    elif (drone.lag_ms or 0.0) > LATE_MS:
        checks.append(Check("estimator", f"{drone.lag_ms:.0f} ms late", False))
    else:
        checks.append(Check("estimator", f"σ {sigma_m:.2f} m"))

    link, link_age_s = drone.link_state, drone.link_age_s
    if not drone.is_external:
        pass  # it has no driver, whatever is published as its link
    elif link is None or link_age_s is None:
        checks.append(Check("link", "no driver yet", False, True))
    elif link_age_s > LINK_SILENT_S:
        checks.append(Check("link", f"its driver has been silent for {link_age_s:.0f} s", False, True))
    else:
        checks.append(Check("link", link, link in ("connected", "armed"), blocks=True))
    text = f"flown by {foreign}; must be released" if foreign else drone.commander or "free"
    return *checks, Check("control", text, not foreign, blocks=in_formation)


class RunCondition(NamedTuple):
    """The condition on which the controls of a page depend."""

    clock: str | None = None  # state of the run's clock; None before the first answer
    silent_s: float = 0.0  # how long the world has not answered [wall]; 0 while it answers
    ended: str = ""  # why the run is over; empty while it goes on
    replayed: bool = False  # whether it is a replay, in which nothing can be flown
    at_end: bool = False  # whether the replay is at the end of its record
    drones: Mapping[str, str] = {}  # state by name of the drones seen so far
    phases: Mapping[str, tuple[str, str]] = {}  # phase and reason of each formation by name
    members: Mapping[str, Collection[str]] = {}  # names of the drones of each formation
    checks: Mapping[str, tuple[Check, ...]] = {}  # checks of each drone before a take-off, as far as known

    @property
    def level(self) -> Level:
        if self.ended:
            return "ended"
        if self.silent_s:
            return "silent"
        if "emergency" in self.drones.values() and not self.replayed:  # a replay's needs no action
            return "emergency"
        return "paused" if self.clock == "paused" else "running" if self.clock == "running" else "waiting"

    def off(self) -> str:
        if self.ended:
            return f"the run is over: {self.ended}"
        return f"the world has not answered for {self.silent_s:.0f} s" if self.silent_s else ""

    def grounded(self) -> str:
        return self.off() or ("a record is played back" if self.replayed else "")

    def all_down(self, names: Collection[str] | None = None) -> bool:
        """Return whether all drones seen so far, or the named ones, are on the ground."""
        return DOWN.issuperset(state for name, state in self.drones.items() if names is None or name in names)


# Refusals


def run_refusals(run: RunCondition) -> dict[str, str]:
    off, state = run.off(), run.clock or "unknown"
    running = "" if state == "running" else f"the run is {state}"
    paused = "" if state == "paused" else f"the run is {state}, not paused"
    onward = off or paused or (AT_END if run.at_end else "")
    return {"pause": off or running, "resume": onward, "step": onward, "rate": off, "seek": off}


def drone_refusals(run: RunCondition, drone: str) -> dict[str, str]:
    state = run.drones.get(drone)
    modes = ("takeoff", "land", "return", "emergency", "reset")
    unseen = run.grounded() or ("" if state else f"{drone} has not been seen yet")
    refused = {mode: unseen or state_refusal(drone, state or "", mode) or "" for mode in modes}
    refused["takeoff"] = refused["takeoff"] or preflight_refusal(run, [drone])
    return {**refused, "emergency": run.grounded()}  # always enabled: the state shown may be outdated


def preflight_refusal(run: RunCondition, drones: Collection[str]) -> str:
    refusals = []
    for name in drones:
        if run.drones.get(name) == "landed":
            failed = [f"{each.name} {each.text}" for each in run.checks.get(name, ()) if each.blocks and not each.ok]
            refusals += [f"{name}: {', '.join(failed)}"] if failed else []
    return "; ".join(refusals)


def is_held_by_fault(run: RunCondition, cluster: str) -> bool:
    """Return whether a formation is held by a fault rather than on request."""
    phase, reason = run.phases.get(cluster, ("", ""))
    on_request = any(note in reason for note in (HELD_ON_REQUEST, GUARD_PARTS)) and REJOINING not in reason
    return phase == "held" and not on_request


def formation_refusals(run: RunCondition, cluster: str) -> dict[str, str]:
    """Return why each operation of a formation would be refused, as far as its phase determines it."""
    phase, reason = run.phases.get(cluster, ("", ""))
    off = run.grounded() or ("" if phase else f"{cluster} has no controller yet")
    flown = "" if phase == "engaged" else f"{cluster} is {_words(phase)}, not engaged"
    held = f"{cluster} is held: {reason}" if is_held_by_fault(run, cluster) else ""
    steered = off or held or ("" if phase == "held" else flown)
    if phase == "assembling":
        engage = "" if READY_TO_ENGAGE in reason else reason
    elif phase == "held" and not held:
        engage = ""
    else:
        engage = f"{cluster} is {_words(phase)}; it engages when assembled, or when held on request"
    grounded = [name for name in run.members.get(cluster, ()) if run.drones.get(name) not in AIRBORNE]
    fault = reason if held else ""
    if not fault or REJOINING in fault:
        rejoin = f"{cluster} is {'rejoining' if fault else 'not held by a fault'}"
    elif grounded:
        state = run.drones.get(grounded[0]) or "not seen"
        rejoin = f"{grounded[0]} is {_words(state)}; take it off first"
    else:
        rejoin = ""
    return {
        "takeoff": off or _takeoff_refusal(run, cluster, phase),
        "engage": off or engage,
        "hold": off or ("" if REJOINING in reason else held or flown),
        "rejoin": off or rejoin,
        "land": off or ("all drones are on the ground" if phase == "idle" and run.all_down() else ""),
        "target": steered,
        "trajectory": steered,
    }


def _takeoff_refusal(run: RunCondition, cluster: str, phase: str) -> str:
    """Return why a formation would not take off; its drones must be landed or in the air."""
    members = run.members.get(cluster, ())
    if phase != "idle":
        idle_first = "; Land makes it idle" if phase == "held" and run.all_down(members) else ""
        return f"{cluster} is {_words(phase)}, not idle{idle_first}"
    states = {name: run.drones.get(name, "landed") for name in members}
    stopped = [name for name, state in states.items() if state == "emergency"]
    if stopped:
        return _reset_first(stopped)
    moving = [name for name, state in states.items() if state not in AIRBORNE | DOWN]
    if moving:
        return f"{moving[0]} is {_words(states[moving[0]])}; it must be landed or in the air"
    return preflight_refusal(run, members)


def _reset_first(stopped: Sequence[str]) -> str:
    return f"{', '.join(stopped)} in emergency; reset first"


def fleet_refusals(run: RunCondition, single: Collection[str] = ()) -> dict[str, str]:
    """Return why each operation on all drones would have no effect; `single` are the drones without a formation."""
    off = run.grounded()
    in_air = not run.all_down() or any(phase not in ("idle", "landing") for phase, _ in run.phases.values())
    in_emergency = "emergency" in run.drones.values()
    refusals = {name: _takeoff_refusal(run, name, phase) for name, (phase, _) in run.phases.items()}
    landed = [name for name in single if run.drones.get(name) == "landed"]
    unfit = [refusal for name in landed if (refusal := preflight_refusal(run, [name]))]
    takeoff = ""
    if "" not in refusals.values() and len(landed) == len(unfit):  # neither a formation nor a single drone
        stopped = [name for name in single if run.drones.get(name) == "emergency"]
        on_ground = [refusal for name, refusal in refusals.items() if run.all_down(run.members.get(name, ()))]
        reasons = [*on_ground, *unfit, *([_reset_first(stopped)] if stopped else []), *refusals.values()]
        takeoff = reasons[0] if reasons else "no drone is on the ground"
    return {
        "takeoff": off or takeoff,
        "land": off or ("" if in_air else "all drones are on the ground"),
        "reset": off or ("" if in_emergency else "no drone is in an emergency"),
    }


def _words(phase: str) -> str:
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
        t_ns: simulated time of what is shown.
        alarms: as `AlarmBoard.rows`.
        single: drones without a formation.
        world: description of where the run is.
        record_s: of a replay, times of the first and the last gate on record [s].
    """
    stands = clock is not None and any(each.since_wall_s > STANDS_S for each in clock.waiting_for)
    level = "waiting" if run.level == "running" and stands else run.level
    t_s = (t_ns or (clock.t_ns if clock else 0)) / 1e9
    if run.level == "ended":
        title, detail = f"run over at {t_s:.1f} s", run.ended
    elif run.level == "silent":
        title = f"no answer from the world for {run.silent_s:.0f} s"
        detail = f"the display is as of {t_s:.1f} s and may be outdated"
    else:
        state = "waiting" if run.clock == "running" and stands else run.clock or "no clock yet"
        pace = f" × {clock.rate:.1f}" if clock is not None and state == "running" else ""
        title, detail = f"{state} {t_s:.1f} s{pace}", _waiting(clock, world)
        if run.replayed:
            from_s, to_s = record_s or (t_s, t_s)
            share = f" ({100.0 * min(1.0, max(0.0, t_s - from_s) / (to_s - from_s)):.0f} %)" if to_s > from_s else ""
            title = f"REPLAY · {state} {t_s:.1f} of {to_s:.1f} s{share}{pace}"
        if run.level == "emergency":
            title = f"EMERGENCY · {title}"
    phases = run.phases if len(run.phases) <= 1 and not (run.ended or run.silent_s) else {}
    formation = [f"{n}: {_words(p)}{f' – {reason}' if reason else ''}" for n, (p, reason) in phases.items()]
    lines = [name, "a record is played back" if run.replayed else "", detail, *formation]
    refusals = {"land": fleet_refusals(run, single)["land"], "emergency": run.grounded()}
    whole = {"t_s": t_ns / 1e9, "replay": run.replayed, "age_s": run.silent_s, "alarms": list(alarms)}
    return {"level": level, "title": title, "detail": " · ".join(filter(None, lines)), "refusals": refusals, **whole}


def no_run_head(world: str, ended: str = "") -> dict[str, Any]:
    """Return the head of a page without a run.

    Args:
        world: description of where a run is searched for.
        ended: why the launcher's run ended before the console had found it.
    """
    reason = f"the run is over: {ended}" if ended else "there is no run yet"
    level, title, detail = ("ended", "run over", ended) if ended else ("waiting", "waiting for a world", world)
    refusals: dict[str, Any] = {"refusals": {"land": reason, "emergency": reason}}
    return {"level": level, "title": title, "detail": detail, **refusals, **NO_RUN}


def _waiting(clock: Clock | None, world: str) -> str:
    """Describe which processes the world is waiting for, and where absent ones are expected."""
    if clock is None:
        return "waiting for the world's clock"
    late = holding_up(clock.state, clock.waiting_for)
    names = [f"{each.name}{each.host and f' on {each.host}'} ({each.since_wall_s:.0f} s)" for each in late]
    rest = [f"{len(names) - WAITING_SHOWN} more"] if len(names) > WAITING_SHOWN else []
    where = f" in {world}" if world and not all(each.host for each in late) else ""
    return f"waiting for {', '.join([*names[:WAITING_SHOWN], *rest])}{where}" if names else ""
