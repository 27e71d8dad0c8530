"""The condition of the run that a page shows, and which of an operator's requests it would refuse, and why. Pure."""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Literal, NamedTuple

from zsim.contract.run_messages import Clock
from zsim.contract.state_rules import state_refusal
from zsim_agents.formation.flight_data import (
    AIRBORNE,
    DOWN,
    GUARD_PARTS,
    HELD_ON_REQUEST,
    READY_TO_ENGAGE,
    REJOINING,
    EngagementLimits,
)
from zsim_bridges.console.alarms import (
    BATTERY_EMPTY_PERCENT,
    BATTERY_LOW_PERCENT,
    LATE_MS,
    DroneCondition,
)

TILT_MAX_DEG = 30.0  # of a drone that takes off; chosen: steeper than any ground, far less than its side or back
LINK_SILENT_S = 3.0  # wall; drivers publish the state of a link once a second
LIMITS = EngagementLimits()  # those by which a formation's controller takes off


class Check(NamedTuple):
    """One point of the check.

    Attributes:
        name: what is looked at.
        text: with figures, and what is allowed where it is not as it must be.
        ok: whether it is as it should be.
        blocks: whether no take-off is offered where it is not.
    """

    name: str
    text: str
    ok: bool = True
    blocks: bool = False


def preflight_checks(drone: DroneCondition, in_formation: bool, foreign: str = "") -> tuple[Check, ...]:
    """Return the check of a drone.

    Args:
        drone: its condition.
        in_formation: whether a controller flies it, which needs its estimator.
        foreign: who flies it, where that is neither this console nor its formation's controller.
    """
    checks = [_battery(drone), _upright(drone), _estimator(drone, in_formation)]
    if drone.is_external:
        checks.append(_link(drone))
    control = f"flown by {foreign}; must be given back" if foreign else drone.commander or "free"
    return (*checks, Check("control", control, not foreign, blocks=in_formation))


def _battery(drone: DroneCondition) -> Check:
    percent = drone.battery_percent
    if percent < BATTERY_EMPTY_PERCENT:
        return Check("battery", f"{percent:.0f} %; must be {BATTERY_EMPTY_PERCENT:.0f} % or more", False, True)
    if percent < BATTERY_LOW_PERCENT:
        return Check("battery", f"{percent:.0f} %; low", False)
    return Check("battery", f"{percent:.0f} %")


def _upright(drone: DroneCondition) -> Check:
    tilt_deg = drone.tilt_deg or 0.0
    if tilt_deg > TILT_MAX_DEG:
        return Check("upright", f"tilted by {tilt_deg:.0f}°; must be {TILT_MAX_DEG:.0f}° or less", False, True)
    return Check("upright", f"{tilt_deg:.0f}°")


def _estimator(drone: DroneCondition, in_formation: bool) -> Check:
    sigma_m, yaw_deg, yaw_max_deg = drone.sigma_m, drone.yaw_sigma_deg, math.degrees(LIMITS.yaw_sigma_max_rad)
    if sigma_m is None:
        return Check("estimator", "no estimate of the present", False, in_formation)
    if sigma_m > LIMITS.sigma_max_m:
        text = f"σ of position is {sigma_m:.1f} m; must be {LIMITS.sigma_max_m:g} m or less"
        return Check("estimator", text, False, in_formation)
    if yaw_deg is not None and yaw_deg > yaw_max_deg:
        text = f"σ of heading is {yaw_deg:.0f}°; must be {yaw_max_deg:.0f}° or less"
        return Check("estimator", text, False, in_formation)
    if drone.lag_ms is not None and drone.lag_ms > LATE_MS:
        return Check("estimator", f"{drone.lag_ms:.0f} ms late", False)
    return Check("estimator", f"σ {sigma_m:.2f} m")


def _link(drone: DroneCondition) -> Check:
    if drone.link_state is None or drone.link_age_s is None:
        return Check("link", "no driver yet", False, True)
    if drone.link_age_s > LINK_SILENT_S:
        return Check("link", f"its driver has been silent for {drone.link_age_s:.0f} s", False, True)
    connected = drone.link_state in ("connected", "armed")
    return Check("link", drone.link_state, connected, blocks=True)


def takeoff_refusal(drone: str, checks: Sequence[Check]) -> str:
    """Return why a drone that is on the ground may not take off; empty where it may."""
    failed = [f"{check.name} {check.text}" for check in checks if check.blocks and not check.ok]
    return f"{drone}: {', '.join(failed)}" if failed else ""


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


WAITING_SHOWN = 4  # processes that are named
SOON_S = 0.5  # wall; a running world waits for so long now and then
STANDS_S = 2.0  # wall; a running world that waits for longer stands, for whoever looks


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
    """Return the head of the page of a run.

    Args:
        name: of the scenario.
        run: its condition.
        clock: the newest.
        t_ns: simulated time of what is shown.
        alarms: as `AlarmBoard.rows`.
        single: drones of no formation.
        world: where the run is, in words.
        record_s: of a replay, the times of the first and the last gate on record [s].
    """
    level = "waiting" if run.level == "running" and _stands(clock) else run.level
    title, detail = _title_and_detail(run, clock, t_ns, world, record_s)
    lines = [each for each in (name, "a record is played back" if run.replayed else "", detail, *_phases(run)) if each]
    refusals = {"land": fleet_refusals(run, single)["land"], "emergency": run.grounded()}
    head = {"level": level, "title": title, "detail": " · ".join(lines), "t_s": t_ns / 1e9, "replay": run.replayed}
    return {**head, "age_s": run.silent_s, "refusals": refusals, "alarms": list(alarms)}


def no_run_head(world: str, ended: str = "") -> dict[str, Any]:
    """Return the head of a page without a run.

    Args:
        world: where one is looked for.
        ended: why that of its launcher was over before the console had found it.
    """
    reason = f"the run is over: {ended}" if ended else "there is no run yet"
    refusals = {"land": reason, "emergency": reason}
    words = ("ended", "run over", ended) if ended else ("waiting", "waiting for a world", world)
    head = {**dict(zip(("level", "title", "detail"), words, strict=True)), "t_s": 0.0, "replay": False}
    return {**head, "age_s": 0.0, "refusals": refusals, "alarms": []}


def _stands(clock: Clock | None) -> bool:
    """Return whether time stands for so long that nobody would call that running."""
    return clock is not None and any(each.since_wall_s > STANDS_S for each in clock.waiting_for)


def _title_and_detail(
    run: RunCondition, clock: Clock | None, t_ns: int, world: str, record_s: tuple[float, float] | None
) -> tuple[str, str]:
    """Return the title and the detail."""
    t_s = (t_ns or (clock.t_ns if clock else 0)) / 1e9
    if run.level == "ended":
        return f"run over at {t_s:.1f} s", run.ended
    if run.level == "silent":
        return f"no answer from the world for {run.silent_s:.0f} s", f"what is shown is of {t_s:.1f} s, and may be over"
    state = "waiting" if run.clock == "running" and _stands(clock) else run.clock or "no clock yet"
    pace = f" × {clock.rate:.1f}" if clock is not None and state == "running" else ""
    title = f"{state} {t_s:.1f} s{pace}"
    if run.replayed:
        from_s, to_s = record_s or (t_s, t_s)
        share = f" ({100.0 * min(1.0, max(0.0, t_s - from_s) / (to_s - from_s)):.0f} %)" if to_s > from_s else ""
        title = f"REPLAY · {state} {t_s:.1f} of {to_s:.1f} s{share}{pace}"
    return f"EMERGENCY · {title}" if run.level == "emergency" else title, _waiting(clock, world)


def _waiting(clock: Clock | None, world: str) -> str:
    """Return which processes the world waits for, causes alone, and where those are awaited that never came."""
    if clock is None:
        return "waiting for the world's clock"
    late = [each for each in clock.waiting_for if clock.state == "waiting" or each.since_wall_s > SOON_S]
    late = [each for each in late if not each.held_by] or late
    names = [f"{each.name}{each.host and f' on {each.host}'} ({each.since_wall_s:.0f} s)" for each in late]
    rest = [f"{len(names) - WAITING_SHOWN} more"] if len(names) > WAITING_SHOWN else []
    where = f" in {world}" if world and not all(each.host for each in late) else ""
    return f"waiting for {', '.join([*names[:WAITING_SHOWN], *rest])}{where}" if names else ""


def _phases(run: RunCondition) -> list[str]:
    if len(run.phases) > 1 or run.ended or run.silent_s:
        return []
    return [f"{n}: {p.replace('_', ' ')}" + (f" – {reason}" if reason else "") for n, (p, reason) in run.phases.items()]
