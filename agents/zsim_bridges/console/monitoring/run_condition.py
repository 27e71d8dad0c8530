"""The condition of the run that a page shows, and which of an operator's requests it would refuse, and why. Pure."""

from collections.abc import Collection, Mapping, Sequence
from typing import Literal, NamedTuple

from zsim.contract.state_rules import state_refusal
from zsim_agents.formation.flight_check import (
    AIRBORNE,
    DOWN,
    GUARD_PARTS,
    HELD_ON_REQUEST,
    READY_TO_ENGAGE,
    REJOINING,
)
from zsim_bridges.console.monitoring.preflight import Check, takeoff_refusal

AT_END = "the record is at its end; go back on the timeline"
Level = Literal["no run", "waiting", "running", "paused", "emergency", "silent", "ended"]


class RunCondition(NamedTuple):
    """What the controls of a page depend on.

    Attributes:
        clock: state of the run's clock; None before the first answer.
        silent_s: for how long the world has not answered; 0 while it does [s, wall].
        ended: why the run is over; empty while it goes on.
        replayed: whether a record is played back: nobody can be flown.
        at_end: whether that stands still at the end of the record.
        drones: state of each drone by name, of those that were seen.
        phases: phase and reason of each formation by name.
        members: names of the drones of each formation.
        checks: of each drone before a take-off, as far as they are known.
    """

    clock: str | None = None
    silent_s: float = 0.0
    ended: str = ""
    replayed: bool = False
    at_end: bool = False
    drones: Mapping[str, str] = {}
    phases: Mapping[str, tuple[str, str]] = {}
    members: Mapping[str, Collection[str]] = {}
    checks: Mapping[str, tuple[Check, ...]] = {}

    @property
    def level(self) -> Level:
        """What matters most about the run."""
        if self.ended:
            return "ended"
        if self.silent_s:
            return "silent"
        if "emergency" in self.drones.values() and not self.replayed:  # of a record nobody has to act
            return "emergency"
        return "paused" if self.clock == "paused" else "running" if self.clock == "running" else "waiting"

    def off(self) -> str:
        """Return why no request can be answered; empty where one can."""
        if self.ended:
            return f"the run is over: {self.ended}"
        return f"the world has not answered for {self.silent_s:.0f} s" if self.silent_s else ""

    def grounded(self) -> str:
        """Return why nothing can be flown; empty where something can."""
        return self.off() or ("a record is played back" if self.replayed else "")


def run_refusals(run: RunCondition) -> dict[str, str]:
    """Return why each operation of the run's time would be refused; empty where it would not."""
    off, state = run.off(), run.clock or "unknown"
    running = "" if state == "running" else f"the run is {state}"
    paused = "" if state == "paused" else f"the run is {state}, not paused"
    onward = off or paused or (AT_END if run.at_end else "")
    return {"pause": off or running, "resume": onward, "step": onward, "rate": off, "seek": off}


def drone_refusals(run: RunCondition, drone: str) -> dict[str, str]:
    """Return why each mode of one drone, and its return, would be refused; empty where it would not."""
    state = run.drones.get(drone)
    modes = ("takeoff", "land", "return", "emergency", "reset")
    unseen = run.grounded() or ("" if state else f"{drone} was not seen yet")
    refused = {mode: unseen or state_refusal(drone, state or "", mode) or "" for mode in modes}
    refused["takeoff"] = refused["takeoff"] or preflight_refusal(run, [drone])
    return {**refused, "emergency": run.grounded()}  # never kept back: what is shown may be older than what is


def preflight_refusal(run: RunCondition, drones: Collection[str]) -> str:
    """Return why drones that are on the ground would not be let take off, by their checks; empty where they would."""
    landed = [name for name in drones if run.drones.get(name) == "landed"]
    return "; ".join(filter(None, (takeoff_refusal(name, run.checks.get(name, ())) for name in landed)))


def is_held_by_fault(run: RunCondition, cluster: str) -> bool:
    """Return whether a formation is held, and not on request."""
    phase, reason = run.phases.get(cluster, ("", ""))
    on_request = any(note in reason for note in (HELD_ON_REQUEST, GUARD_PARTS)) and REJOINING not in reason
    return phase == "held" and not on_request


def formation_refusals(run: RunCondition, cluster: str) -> dict[str, str]:
    """Return why each operation of a formation would be refused, as far as its phase says; empty where it would not."""
    phase, reason = run.phases.get(cluster, ("", ""))
    off = run.grounded() or ("" if phase else f"{cluster} has no controller yet")
    flown = "" if phase == "engaged" else f"{cluster} is {_words(phase)}, not engaged"
    held = f"{cluster} is held: {reason}" if is_held_by_fault(run, cluster) else ""
    on_request = phase == "held" and not held
    steered = off or held or ("" if phase == "held" else flown)
    return {
        "takeoff": off or _takeoff_refusal(run, cluster, phase),
        "engage": off or _engage_refusal(cluster, phase, reason, on_request),
        "hold": off or ("" if REJOINING in reason else held or flown),
        "rejoin": off or _rejoin_refusal(run, cluster, reason if held else ""),
        "land": off or ("all drones are on the ground" if phase == "idle" and _all_down(run) else ""),
        "target": steered,
        "trajectory": steered,
    }


def _takeoff_refusal(run: RunCondition, cluster: str, phase: str) -> str:
    """Return why a formation would not take off; it starts with drones that are landed or in the air."""
    if phase != "idle":
        down = phase == "held" and _all_down(run, run.members.get(cluster, ()))
        return f"{cluster} is {_words(phase)}, not idle{'; Land makes it idle' if down else ''}"
    members = [(name, run.drones.get(name, "landed")) for name in run.members.get(cluster, ())]
    stopped = [name for name, state in members if state == "emergency"]
    if stopped:
        return _reset_first(stopped)
    moving = [(name, state) for name, state in members if state not in AIRBORNE | DOWN]
    if moving:
        return f"{moving[0][0]} is {_words(moving[0][1])}; it must be landed or in the air"
    return preflight_refusal(run, run.members.get(cluster, ()))


def _reset_first(stopped: Sequence[str]) -> str:
    return f"{', '.join(stopped)} in emergency; reset first"


def _rejoin_refusal(run: RunCondition, cluster: str, fault: str) -> str:
    if not fault or REJOINING in fault:
        return f"{cluster} is {'rejoining' if fault else 'not held by a fault'}"
    down = [(name, state) for name in run.members.get(cluster, ()) if (state := run.drones.get(name)) not in AIRBORNE]
    return f"{down[0][0]} is {_words(down[0][1] or 'not seen')}; take it off first" if down else ""


def _engage_refusal(cluster: str, phase: str, reason: str, on_request: bool) -> str:
    if on_request:
        return ""
    if phase == "assembling":
        return "" if READY_TO_ENGAGE in reason else reason
    return f"{cluster} is {_words(phase)}; it engages when assembled, or when held on request"


def fleet_refusals(run: RunCondition, single: Collection[str] = ()) -> dict[str, str]:
    """Return why each operation on all drones would do nothing; empty where it would.

    Args:
        run: its condition.
        single: drones of no formation.
    """
    off = run.grounded()
    phases = [phase for phase, _ in run.phases.values()]
    in_air = not _all_down(run) or any(phase not in ("idle", "landing") for phase in phases)
    in_emergency = "emergency" in run.drones.values()
    return {
        "takeoff": off or _fleet_takeoff_refusal(run, single),
        "land": off or ("" if in_air else "all drones are on the ground"),
        "reset": off or ("" if in_emergency else "no drone is in an emergency"),
    }


def _fleet_takeoff_refusal(run: RunCondition, single: Collection[str]) -> str:
    """Return why neither a formation nor a drone of none would take off."""
    refusals = {name: _takeoff_refusal(run, name, phase) for name, (phase, _) in run.phases.items()}
    singles = {name: run.drones.get(name) for name in single}
    landed = [name for name, state in singles.items() if state == "landed"]
    unfit = [refusal for name in landed if (refusal := preflight_refusal(run, [name]))]
    if "" in refusals.values() or len(landed) > len(unfit):
        return ""
    stopped = [name for name, state in singles.items() if state == "emergency"]
    on_ground = [refusal for name, refusal in refusals.items() if _all_down(run, run.members.get(name, ()))]
    reasons = [*on_ground, *unfit, *([_reset_first(stopped)] if stopped else []), *refusals.values()]
    return reasons[0] if reasons else "no drone is on the ground"


def _all_down(run: RunCondition, names: Collection[str] | None = None) -> bool:
    """Return whether all drones, or those of some names, are on the ground as far as they were seen."""
    return DOWN.issuperset(state for name, state in run.drones.items() if names is None or name in names)


def _words(phase: str) -> str:
    return phase.replace("_", " ")
