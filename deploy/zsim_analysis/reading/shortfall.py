"""The verdict on a flight: deviations from its plan, and incidents of its drones. Only `verdict` reads a file.

Order of this file: shortfalls, the window of the statistics, and their texts; then drones, then formations.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from zsim.contract.run_messages import FURTHER_COUNTED, INCIDENTS, Event
from zsim.errors import NotTrustedError
from zsim.record import Completeness
from zsim.record.completeness import SECOND_NS
from zsim.scenario.roles import PILOT, WORLD, agent_names, expected_processes, lets_drop
from zsim.scenario.scenario import Cluster, ClusterPlan, Processes, Scenario
from zsim_agents.formation.flight_check import HELD_ON_REQUEST
from zsim_agents.formation.flight_plan import REFUSALS, Follow, MoveTo, plan_of, waiting_step
from zsim_agents.formation.spaces.cluster_space import ClusterSpace
from zsim_agents.formation.spaces.scenario_space import scenario_space
from zsim_agents.formation.trajectory import Hold, Reference, variable_of
from zsim_analysis.reading.drone_errors import AIRBORNE_PHASES
from zsim_analysis.reading.formation import cluster_of
from zsim_analysis.reading.recorded_flight import Array, ClusterStates, RecordedFlight, read_flight

NOT_AS_PLANNED = "NOT AS PLANNED"
ENGAGES_S = 20.0  # time from take-off within which a formation must engage; design choice: engaging takes 4 to 12 s
MOVES_NS, MOVES_MIN = 500_000_000, 1e-3  # a reference that moves less (m or rad) in this time is at rest; design choice
HELD_MAX_S = 2.0  # longest total hold that still follows the plan; design choice: four times the wait after a fault
LATE_MAX_S = 1.0  # longest missing part of a reference left unreported; design choice: two attempts at a plan step
SAMPLE_NS = 100_000_000  # sampling interval of a reference that is compared with the plan's
# a drone farther off for that many successive seconds has strayed; design choice: over twice the minimum separation
STRAYED_M, STRAYED_S = 5.0, 3
SETTLED_S = 10.0  # time from the engagement until drones must be at their positions; design choice
# m or rad; tolerance of the reference against the plan's, which is computed by the same formulas
REFERENCE_TOLERANCE = 1e-3
CONTROLLER, CONSOLE = ("controller.", f"{PILOT}."), "console"  # name prefixes of plans' controllers, and of operators
CRASHES = ("emergency", "flip", "impact", "touchdown")  # incidents that bring a drone down
ONE_HIT_NS = 500_000_000  # a touchdown within this time of an impact belongs to it; design choice
REFUSED_NS = 5_000_000_000  # a command refused within this time before a landing explains it; design choice
# requests that make a formation leave its plan
DEVIATING_REQUESTS = ("hold", "land", "target", "trajectory", "assemble")


class Shortfall(Struct, frozen=True):
    """A deviation of a flight from its plan, or an incident."""

    # drones: emergency, flip, impact, touchdown, battery, landing (the first incident), mission (incomplete),
    # strayed (far from its position or reference), reference (no take-off), override (flown by others); clusters:
    # plan (a step refused to the end, or flown in part), engagement (never), held (too long), request (commanded by
    # others), early (the run ended before a step was due), window (not engaged throughout it); and collision, process
    # (an expected one died, failed, left or never joined), record (incomplete)
    kind: str
    subject: str  # the cluster, drone, process, or "record"; for a collision both parties, as "drone1, drone2"
    t_s: float  # simulated time at which it began
    text: str
    fails: bool  # whether the flight did not follow its plan, so that the command ends with exit code 1


class Verdict(Struct, frozen=True):
    """Completeness of a record, and shortfalls of its flight."""

    completeness: Completeness
    shortfalls: list[Shortfall]


def verdict(record: Path) -> Verdict:
    """Return the same verdict on a recorded flight as its report, without reading all of its motion.

    Raises:
        RecordError: there is no such record.
    """
    flight = read_flight(record, motion=False)
    return Verdict(flight.completeness, shortfalls(flight, window_of(flight)[0]))


def shortfalls(flight: RecordedFlight, window_s: tuple[float, float]) -> list[Shortfall]:
    """Return the shortfalls of a flight, failures first; empty if it followed its plan."""
    lines = [*_incidents(flight), *_collisions_and_missions(flight)]
    lines += [line for states in flight.clusters for line in _cluster_shortfalls(states, flight, window_s)]
    lines += [line for drone in flight.references for line in _reference_shortfalls(drone, flight)]
    lines += [*_overrides(flight), *_processes(flight)]
    if not flight.completeness.complete:
        text = f"the record is {flight.completeness}"
        lines.append(Shortfall("record", "record", flight.last_ns / 1e9, text, True))
    return sorted(lines, key=lambda line: not line.fails)


def marks_of(lines: Sequence[Shortfall]) -> list[tuple[str, bool]]:
    """Return the line of each shortfall, and whether it is a failure."""
    return [(f"{NOT_AS_PLANNED if each.fails else 'note'}: {each.text}", each.fails) for each in lines]


def window_of(flight: RecordedFlight) -> tuple[tuple[float, float], str]:
    """Return the window of a flight's statistics [s], and a note if it is not the scenario's."""
    return window(flight.scenario.report.window_s if flight.scenario else None, flight.last_ns / 1e9)


def window(wanted_s: tuple[float, float] | None, length_s: float) -> tuple[tuple[float, float], str]:
    """Return the window of a run's statistics [s], and a note if it is not the scenario's.

    If the scenario has no window, the last two thirds of the run are used.
    """
    default = (length_s / 3, length_s)
    if wanted_s is None:
        return default, ""
    start, end = wanted_s
    if end <= length_s:
        return wanted_s, ""
    if start < length_s:
        return (start, length_s), f"The run ended at {length_s:.2f} s, inside the window {span_text(wanted_s)}."
    return default, (
        f"The run ended at {length_s:.2f} s, before the window {span_text(wanted_s)}; "
        "the last two thirds of the run are used."
    )


def phase_shares(t_s: Array, phases: list[str], window_s: tuple[float, float]) -> dict[str, float]:
    """Return the share of each phase of a formation among the samples of a window, the largest first."""
    rows = np.flatnonzero((t_s >= window_s[0]) & (t_s <= window_s[1])).tolist()
    return {phase: count / len(rows) for phase, count in Counter(phases[row] for row in rows).most_common()}


def seconds_text(t_s: float) -> str:
    """Format a time [s] with at most two decimals."""
    return f"{t_s:.2f}".rstrip("0").rstrip(".")


def span_text(span_s: tuple[float, float]) -> str:
    return f"{seconds_text(span_s[0])} to {seconds_text(span_s[1])} s"


def percent_text(share: float) -> str:
    """Format a share in percent; only exactly 1 and 0 are shown as 100 and 0."""
    percent = 100 * share if share in (0.0, 1.0) else min(max(100 * share, 0.1), 99.9)
    return f"{percent:.3g}"


def _processes(flight: RecordedFlight) -> Iterator[Shortfall]:
    """Yield the expected processes that were lost for good, unless the scenario allows dropping them."""
    scenario = flight.scenario
    expected = {*expected_processes(scenario), *agent_names(scenario), WORLD} if scenario else set()
    actions = scenario.processes if scenario else Processes()
    dropped = {event.subject for event in flight.events if event.kind == "drop"}  # without a replacement
    for event in flight.events:
        if event.kind == "end":
            return  # deaths after the end do not matter
        if event.subject not in expected:
            continue
        on_death = event.data.get("on_death")
        is_death = event.kind == "death" and (on_death == "end" or event.subject in dropped)
        # a process that was expected to return is dropped once it is overdue
        is_overdue = event.kind == "overdue" or (event.kind == "death" and on_death in ("wait", "restart"))
        allowed = event.kind != "overdue" and lets_drop(actions.on_death, event.subject)
        allowed = allowed or (is_overdue and lets_drop(actions.on_overdue or {}, event.subject))
        t_s = event.t_ns / 1e9
        text = event.text if event.kind == "failure" else f"{event.text}, at {t_s:.2f} s"
        if event.kind == "leave":
            yield Shortfall("process", event.subject, t_s, text, bool(event.data.get("fails")))
        elif (is_death or event.kind in ("failure", "overdue")) and not allowed:
            yield Shortfall("process", event.subject, t_s, text, True)


# Drones


def _incidents(flight: RecordedFlight) -> Iterator[Shortfall]:
    """Yield a line for each drone with incidents: the first of each kind, by time."""
    by_drone: dict[str, list[Event]] = {}
    for event in flight.events:
        if event.kind in (*INCIDENTS, "landing"):
            by_drone.setdefault(event.subject, []).append(event)
    for drone, events in by_drone.items():
        first = {event.kind: event for event in reversed(events)}
        hit, touch = first.get("impact"), first.get("touchdown")
        if hit and touch and abs(hit.t_ns - touch.t_ns) <= ONE_HIT_NS:
            del first["touchdown"]
        in_order = sorted(first.values(), key=lambda event: (event.t_ns, event.seq))
        parts = [_incident_text(event, _refusal_before(event, flight)) for event in in_order]
        text = f"{drone}: {', '.join(parts)}{_active_faults(drone, (events[0].t_ns, events[0].seq), flight)}"
        fails = not all(  # a landing because a program other than a plan's controller fell silent is not a failure
            event.kind == "landing"
            and event.data.get("cause") == "silence"
            and not str(event.data.get("commander") or "").startswith(CONTROLLER)
            for event in events
        )
        yield Shortfall(events[0].kind, drone, events[0].t_ns / 1e9, text, fails)
    reported = {*by_drone, *(event.subject for event in flight.events if event.data.get("mode") == "emergency")}
    for track in flight.tracks:  # records of versions without these events
        if track.name not in reported and not track.external and track.states and track.states[-1] == "emergency":
            t_s = float(track.status_t_ns[-1]) / 1e9
            yield Shortfall("emergency", track.name, t_s, f"{track.name} ended in an emergency", True)


def _refusal_before(event: Event, flight: RecordedFlight) -> str:
    """Return why a drone's latest refused command was refused, if that may explain an event; otherwise empty.

    Only the first of many identical refusals are events; the last of these says that further ones are only counted.
    """
    commands = f"drone/{event.subject}/cmd/"
    for each in reversed(flight.events):
        if each.kind == "refused" and each.subject.startswith(commands) and each.t_ns <= event.t_ns:
            is_near = event.t_ns - each.t_ns < REFUSED_NS or each.text.endswith(FURTHER_COUNTED)
            return f"refused: {each.data.get('reason', '')}" if is_near else ""
    return ""


def _incident_text(event: Event, refused: str) -> str:
    at_time, data = f"at {seconds_text(event.t_ns / 1e9)} s", event.data
    match event.kind:
        case "emergency" if data.get("cause") == "command":
            emergency = "operator's emergency" if event.source.startswith(CONSOLE) else "emergency"
            return f"ended by: {emergency} {at_time} ({event.source})"
        case "emergency":
            cause = "its driver reported it" if data.get("cause") == "driver" else "tilted too far"
            return f"emergency {at_time} ({cause})"
        case "impact":
            return f"hit {data.get('other', 'something')} at {data.get('speed_m_s', 0.0):.1f} m/s {at_time}"
        case "landing":
            charge = data.get("charge_percent")
            cause_text = (
                f"no command from {data.get('commander') or 'its commander'} took effect{refused and f'; {refused}'}"
            )
            return f"landed by itself {at_time} ({cause_text if charge is None else f'{charge:.1f} % of charge left'})"
        case "touchdown":
            return f"touched {data.get('other', 'something')} in flight {at_time}"
        case "flip":
            return f"upside down {at_time}"
        case _:
            return f"no charge left {at_time}"


def _active_faults(drone: str, instant: tuple[int, int], flight: RecordedFlight) -> str:
    """Describe the faults of a drone or the world that were active at an event, given as (t_ns, sequence number)."""
    active: dict[object, str] = {}
    for each in flight.events:
        if (each.t_ns, each.seq) > instant:
            break
        if each.kind == "fault" and each.data.get("target") in (drone, "world"):
            source = each.data.get("source") or "somebody"
            owner = "the scenario's" if source == "scenario" else f"{source}'s"
            since = seconds_text(each.t_ns / 1e9)
            active[each.data.get("id")] = f"{owner} fault {each.data.get('kind')} since {since} s"
        elif each.kind in ("fault_end", "fault_clear"):
            active.pop(each.data.get("id"), None)
    return f"; {', '.join(active.values())}" if active else ""


def _collisions_and_missions(flight: RecordedFlight) -> Iterator[Shortfall]:
    """Yield each collision of two drones, or of a drone and an obstacle, and each incomplete mission.

    Of the missions that bridges reported, only each drone's latest one matters.
    """
    pairs: dict[frozenset[object], list[Event]] = {}
    for event in flight.events:
        if event.kind == "collision":
            pairs.setdefault(frozenset((event.subject, event.data.get("other"))), []).append(event)
    for first, *others in pairs.values():
        t_s, contacts = first.t_ns / 1e9, f" ({1 + len(others)} contacts in all)" if others else ""
        pair = f"{first.subject}, {first.data.get('other', 'something')}"
        yield Shortfall("collision", pair, t_s, f"{first.text} at {seconds_text(t_s)} s{contacts}", True)
    newest = {event.subject: event for event in flight.events if event.kind == "mission"}
    for drone, event in newest.items():
        data, t_s = event.data, event.t_ns / 1e9
        if data.get("state") != "finished":
            reason = f"{data.get('reason')}, at {seconds_text(t_s)} s" if data.get("reason") else "the run ended"
            text = f"{drone}: flew {data.get('done')} of {data.get('items')} mission items; {reason}"
            yield Shortfall("mission", drone, t_s, text, bool(data.get("failsafe")))


def _overrides(flight: RecordedFlight) -> Iterator[Shortfall]:
    """Yield each drone of a planned cluster that was flown or landed by someone other than its controller."""
    members = {
        drone for states in flight.clusters for drone in states.drones if cluster_of(flight.scenario, states.name)
    }
    for drone in sorted(members):
        if parts := list(_interventions(drone, flight)):
            further = f" (and {len(parts) - 1} more)" if len(parts) > 1 else ""
            yield Shortfall("override", drone, parts[0].from_ns / 1e9, f"{drone}: {parts[0].text}{further}", False)


class _Intervention(NamedTuple):
    """An interval [ns] in which a drone was flown or landed by someone other than its controller."""

    from_ns: int
    until_ns: int
    text: str

    def covers(self, t_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        return (self.from_ns <= t_ns) & (t_ns <= self.until_ns)


def _interventions(drone: str, flight: RecordedFlight) -> Iterator[_Intervention]:
    """Yield the interventions in the flight of a drone, by time."""
    drone_events = [event for event in flight.events if event.subject == drone]
    for index, event in enumerate(drone_events):
        if event.source.startswith(CONTROLLER):
            continue
        if event.kind == "commander":
            ends = (each.t_ns for each in drone_events[index + 1 :] if each.kind in ("commander", "release"))
            until_ns = next(ends, flight.last_ns)
            text = f"flown by {event.source} from {span_text((event.t_ns / 1e9, until_ns / 1e9))}"
            yield _Intervention(event.t_ns, until_ns, text)
        elif event.kind == "mode" and event.data.get("mode") == "land":
            text = f"asked to land by {event.source} at {seconds_text(event.t_ns / 1e9)} s"
            yield _Intervention(event.t_ns, flight.last_ns, text)


def _reference_shortfalls(drone: str, flight: RecordedFlight) -> Iterator[Shortfall]:
    """Yield a shortfall if a drone did not fly its reference, or strayed from it."""
    references = flight.references[drone]
    track = next((each for each in flight.tracks if each.name == drone), None)
    is_flown = np.isin(references.phases, AIRBORNE_PHASES)
    piloted = flight.scenario.piloted() if flight.scenario else {}
    takeoff_s, end_s = piloted[drone].takeoff_s if drone in piloted else 0.0, flight.last_ns / 1e9
    if not is_flown.any():
        if end_s - takeoff_s >= ENGAGES_S:
            state = track.states[-1] if track and track.states else "unknown"
            text = f"{drone}: did not take off with its reference at {seconds_text(takeoff_s)} s; it is {state}"
            yield Shortfall("reference", drone, takeoff_s, text, True)
        return
    if track is None or track.external:
        return
    _, rows = np.unique(references.t_ns // SECOND_NS, return_index=True)  # one per second, as `verdict` reads them
    rows = rows[is_flown[rows]]
    t_ns, reference_rows, track_rows = np.intersect1d(
        references.t_ns[rows], track.t_ns, assume_unique=True, return_indices=True
    )
    away_m = np.linalg.norm(track.p_W[track_rows] - references.place[rows][reference_rows, :3], axis=1)
    for intervention in _interventions(drone, flight):
        away_m[intervention.covers(t_ns)] = 0.0
    yield from _far(drone, t_ns, away_m, "its reference", flight)


# Formations


def _cluster_shortfalls(
    states: ClusterStates, flight: RecordedFlight, window_s: tuple[float, float]
) -> Iterator[Shortfall]:
    if not states.phases:
        return
    cluster = cluster_of(flight.scenario, states.name)
    plan, end_s = cluster.plan if cluster else None, flight.last_ns / 1e9
    takeoff_s = plan.takeoff_s if plan else None
    refused = [*_refused(states)]
    yield from refused
    if "engaged" not in states.phases:
        phase = states.phases[-1]
        if takeoff_s is None:
            yield _line(states, "window", 0.0, "never engaged; it has no planned take-off")
        elif takeoff_s >= end_s:
            yield _line(states, "early", end_s, f"the run ended before its take-off at {seconds_text(takeoff_s)} s")
        elif end_s - takeoff_s < ENGAGES_S:
            delay_text = seconds_text(end_s - takeoff_s)
            yield _line(
                states, "early", end_s, f"never engaged; the run ended {delay_text} s after its take-off, {phase}"
            )
        else:
            reason = f": {states.reasons[-1]}" if states.reasons[-1] else ""
            yield _line(states, "engagement", takeoff_s, f"never engaged, {phase} to the end{reason}", True)
        return
    if flight.scenario and cluster:
        yield from _strayed(states, flight, flight.scenario, cluster)
    yield from _hold_shortfalls(states, flight)
    requests = [each for each in states.requests if each.ok and each.op in DEVIATING_REQUESTS]
    if requests and takeoff_s is not None:
        first = ", ".join(f"{each.op} at {seconds_text(each.t_ns / 1e9)} s ({each.source})" for each in requests[:3])
        further = f" and {len(requests) - 3} more" if len(requests) > 3 else ""
        yield _line(states, "request", requests[0].t_ns / 1e9, f"requested: {first}{further}")
    if flight.scenario and cluster and plan and takeoff_s is not None:
        for step, due_s in (("trajectory", plan.trajectory and plan.trajectory.start_s), ("landing", plan.land_s)):
            if due_s is not None and due_s >= end_s:
                yield _line(states, "early", end_s, f"the run ended before its {step} at {seconds_text(due_s)} s")
        follows = plan.trajectory is not None and plan.trajectory.start_s < end_s
        if plan.target and not follows and _moves(states):
            yield _line(states, "early", end_s, "the run ended before its reference was at the target")
        if not refused and (planned := _planned(states, flight.scenario, cluster, takeoff_s)):
            yield from (_trajectory_flown if plan.trajectory else _target_reached)(states, planned, plan)
    yield from _outside(states, window_s)


def _line(states: ClusterStates, kind: str, t_s: float, text: str, fails: bool = False) -> Shortfall:
    return Shortfall(kind, states.name, t_s, f"{states.name}: {text}", fails)


def _refused(states: ClusterStates) -> Iterator[Shortfall]:
    """Yield the steps of the plan that were refused until the end, or until the landing that dropped them."""
    refused_since: tuple[str, float] | None = None
    was_engaged = False
    for index, reason in enumerate(states.reasons):
        step = waiting_step(reason)
        engaged = states.phases[index] in ("engaged", "held")
        was_engaged = was_engaged or engaged
        if step is None:
            refused_since = None
            continue
        op, cause = step
        refused_since = (
            refused_since if refused_since and refused_since[0] == op else (op, float(states.t_ns[index]) / 1e9)
        )
        is_last = index + 1 == len(states.reasons)
        was_flying = engaged or (
            was_engaged and states.phases[index] == "assembling"
        )  # also while the formation changes
        if was_flying and (is_last or states.phases[index + 1] == "landing"):
            yield _line(states, "plan", refused_since[1], f"the {op} of the plan was refused to the end: {cause}", True)


def _strayed(
    states: ClusterStates, flight: RecordedFlight, scenario: Scenario, cluster: Cluster
) -> Iterator[Shortfall]:
    """Yield the drones whose true positions were far from those desired in the engaged formation.

    The controller sees estimates, which may differ from the truth. Interventions are excluded.
    """
    engaged = np.array([phase == "engaged" for phase in states.phases], bool)
    settled = states.t_ns >= states.t_ns[engaged][0] + round(SETTLED_S * 1e9)
    rows = _sampled(states, np.flatnonzero(engaged & settled), SECOND_NS)
    try:
        space = scenario_space(scenario, cluster)
        positions_W = np.array(
            [space.inverse(c)[0] for c in states.desired[rows]] if space.names == states.names else []
        )
    except (*REFUSALS, ValueError):
        return
    tracks = {track.name: track for track in flight.tracks if not track.external}
    for drone in states.drones if len(positions_W) else ():
        if (track := tracks.get(drone)) is None:
            continue
        t_ns, state_rows, track_rows = np.intersect1d(
            states.t_ns[rows], track.t_ns, assume_unique=True, return_indices=True
        )
        robots = np.array([states.robot_of(row, drone) for row in rows[state_rows].tolist()], np.intp)
        away_m = np.linalg.norm(track.p_W[track_rows] - positions_W[state_rows, robots], axis=1)
        for intervention in _interventions(drone, flight):
            away_m[intervention.covers(t_ns)] = 0.0
        yield from _far(drone, t_ns, away_m, "its position in the formation", flight)


def _far(drone: str, t_ns: NDArray[np.int64], away_m: Array, goal: str, flight: RecordedFlight) -> Iterator[Shortfall]:
    """Yield a shortfall if a drone was far off for STRAYED_S; `away_m` are its distances from `goal` once a second."""
    stretches = np.split(np.arange(len(t_ns)), np.flatnonzero(np.diff(away_m > STRAYED_M)) + 1)
    strayed = [each for each in stretches if len(each) >= STRAYED_S and away_m[each[0]] > STRAYED_M]
    if strayed:
        from_ns, max_m = int(t_ns[strayed[0][0]]), max(float(away_m[each].max()) for each in strayed)
        text = f"{drone}: up to {max_m:.0f} m from {goal}, from {from_ns / 1e9:.0f} s on"
        yield Shortfall("strayed", drone, from_ns / 1e9, f"{text}{_active_faults(drone, (from_ns, 0), flight)}", True)


def _hold_shortfalls(states: ClusterStates, flight: RecordedFlight) -> Iterator[Shortfall]:
    """Yield the total time that a formation was held after its engagement, except on request.

    Holds during interventions in the flight of its drones are reported, but are not failures.
    """
    phases = np.array(states.phases)
    rows = np.flatnonzero(phases == "held")
    rows = rows[[HELD_ON_REQUEST not in states.reasons[row] for row in rows]] if len(rows) else rows
    if not len(rows):
        return
    t_ns, next_rows = states.t_ns[rows], np.minimum(rows + 1, len(phases) - 1)
    lengths_s = (states.t_ns[next_rows] - t_ns) / 1e9
    by_others = np.zeros(len(rows), bool)
    for intervention in (intervention for drone in states.drones for intervention in _interventions(drone, flight)):
        by_others |= intervention.covers(t_ns)
    span_s = (float(t_ns[0]) / 1e9, float(states.t_ns[next_rows[-1]]) / 1e9)
    length = seconds_text(float(lengths_s.sum()))
    text = f"held for {length} s, from {span_text(span_s)}: {states.reasons[rows[0]]}"
    if by_others.any():
        text += f"; {seconds_text(float(lengths_s[by_others].sum()))} s of it while others flew or landed its drones"
    yield _line(states, "held", span_s[0], text, float(lengths_s[~by_others].sum()) > HELD_MAX_S)


def _moves(states: ClusterStates) -> bool:
    """Return whether the reference moves at the end, with neither a hold nor the separation guard active."""
    last = states.t_ns > states.t_ns[-1] - MOVES_NS
    phases = {phase for phase, row in zip(states.phases, last, strict=True) if row}
    moved = float(np.ptp(states.desired[last], axis=0).max())
    return phases == {"engaged"} and not states.reasons[-1] and moved > MOVES_MIN


class PlannedReference(NamedTuple):
    """The reference of a plan from start_s on, and the variables that it names, as indices into c."""

    space: ClusterSpace
    reference: Reference
    start_s: float
    entries: NDArray[np.intp]

    def follows(self, states: ClusterStates, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Return a mask of the `rows` of `states` in which the engaged formation followed the reference."""
        is_followed = np.zeros(len(rows), bool)
        for i, row in enumerate(rows.tolist()):
            if states.phases[row] == "engaged":
                value = self.reference.value(float(states.t_ns[row] / 1e9 - self.start_s))[0]
                deviation = self.space.difference(states.desired[row], value)
                is_followed[i] = np.abs(deviation[self.entries]).max(initial=0.0) <= REFERENCE_TOLERANCE
        return is_followed


def _planned(states: ClusterStates, scenario: Scenario, cluster: Cluster, takeoff_s: float) -> PlannedReference | None:
    """Return the trajectory, or else the target, of a cluster's plan; None without either, or if it is refused."""
    steps = [each.request for each in plan_of(cluster) if isinstance(each.request, MoveTo | Follow)]
    try:
        space = scenario_space(scenario, cluster)
        if space.names != states.names or not steps:
            return None
        base = states.desired[states.phases.index("engaged")].copy()  # a formation engages where it is
        base[space.neutral] = 0.0
        names, reference, start_s = dict[str, None](), None, takeoff_s
        for step in steps:
            if isinstance(step, MoveTo):
                base = step.goal(space, base)
                names.update(dict.fromkeys(step.values))
                reference = Hold(base)
            else:
                reference, start_s = step.trajectory(space, base), step.start_s or 0.0
                name_groups = [
                    step.expressions,
                    *(w["values"] for w in step.waypoints if isinstance(w["values"], Mapping)),
                ]
                names.update(dict.fromkeys(str(name) for each in name_groups for name in each))
        entries = np.array(sorted({variable_of(space, name, "").entry for name in names}), np.intp)
    except (*REFUSALS, ValueError, NotTrustedError):
        return None
    return PlannedReference(space, reference, start_s, entries) if reference else None


def _trajectory_flown(states: ClusterStates, planned: PlannedReference, plan: ClusterPlan) -> Iterator[Shortfall]:
    """Yield a shortfall if a part of the plan's trajectory was not flown."""
    t_s, duration_s = states.t_ns / 1e9 - planned.start_s, planned.reference.duration_s
    run_s, land_s = float(t_s[-1]), np.inf if plan.land_s is None else plan.land_s - planned.start_s
    due_s = min(np.inf if duration_s is None else duration_s, land_s, run_s)
    if due_s <= 0.0:
        return  # the run ended before it, which is reported as early, or the landing is planned before it
    if duration_s is not None and run_s < min(duration_s, land_s):
        text = f"the run ended at {seconds_text(run_s)} of {seconds_text(duration_s)} s of its trajectory"
        yield _line(states, "early", run_s + planned.start_s, text)
    rows = _sampled(states, np.flatnonzero((t_s >= 0.0) & (t_s <= due_s)))
    at_s, is_followed = t_s[rows], planned.follows(states, rows)
    refusals = _refusal_text(states, "trajectory", planned.start_s)
    begin_s = 0.0
    if duration_s is None and is_followed.any() and not refusals:
        begin_s = float(at_s[is_followed][0])  # an endless trajectory is joined in motion once the formation reaches it
    flown_s = float(np.diff(np.r_[at_s, due_s])[is_followed].sum())
    if due_s - begin_s - flown_s <= LATE_MAX_S:
        return
    due = f"{seconds_text(due_s)} s"
    if not is_followed.any():
        text = f"none of the {due} of its trajectory was flown"
    else:
        stretches = np.split(at_s[is_followed], np.flatnonzero(np.diff(at_s[is_followed]) > 2 * SAMPLE_NS / 1e9) + 1)
        longest = max(stretches, key=len)
        span_s = (float(longest[0]), min(float(longest[-1]) + SAMPLE_NS / 1e9, due_s))
        is_interrupted = flown_s - (span_s[1] - span_s[0]) > LATE_MAX_S
        length = f"for {seconds_text(round(flown_s, 1))} s in all, at the longest " if is_interrupted else ""
        text = f"its trajectory was flown {length}from {seconds_text(span_s[0])} to {seconds_text(span_s[1])} of {due}"
    was_overridden = any(
        each.ok and each.op in DEVIATING_REQUESTS and each.t_ns / 1e9 < planned.start_s + due_s
        for each in states.requests
    )
    yield _line(states, "plan", planned.start_s, f"{text}{refusals}", not was_overridden)


def _target_reached(states: ClusterStates, planned: PlannedReference, plan: ClusterPlan) -> Iterator[Shortfall]:
    """Yield a shortfall if the reference reached the plan's target late, or the formation landed first."""
    engaged_ns = states.t_ns[states.phases.index("engaged")]
    rows = _sampled(states, np.flatnonzero(states.t_ns >= engaged_ns))
    is_followed = planned.follows(states, rows)
    was_overridden, engaged_s = (
        any(each.ok and each.op in DEVIATING_REQUESTS for each in states.requests),
        float(engaged_ns) / 1e9,
    )
    if not is_followed.any():
        if states.phases[-1] in ("landing", "idle"):
            yield _line(states, "plan", engaged_s, "it landed before it was at its target", not was_overridden)
    elif plan.target_over_s is not None:
        due_s = engaged_s + plan.target_over_s
        late_s = float(states.t_ns[rows[is_followed]][0]) / 1e9 - due_s
        if late_s > LATE_MAX_S:
            late_text = seconds_text(round(late_s, 1))
            text = (
                f"its reference was at the target {late_text} s after it was due{_refusal_text(states, 'target', 0.0)}"
            )
            yield _line(states, "plan", due_s, text, not was_overridden)


def _sampled(states: ClusterStates, rows: NDArray[np.intp], every_ns: int = SAMPLE_NS) -> NDArray[np.intp]:
    """Return the first of these rows in each interval of `every_ns`."""
    return rows[np.unique(states.t_ns[rows] // every_ns, return_index=True)[1]]


def _refusal_text(states: ClusterStates, op: str, from_s: float) -> str:
    """Describe when a step of the plan was refused after from_s, and why at first; empty if it was not."""
    rows = np.flatnonzero(states.t_ns / 1e9 >= from_s).tolist()
    steps = [(row, waiting_step(states.reasons[row])) for row in rows if states.phases[row] == "engaged"]
    refusals = [(row, step[1]) for row, step in steps if step and step[0] == op]
    if not refusals:
        return ""
    first, last = (float(states.t_ns[refusals[index][0]]) / 1e9 for index in (0, -1))
    return f"; it was refused from {span_text((first, last))}: {refusals[0][1]}"


def _outside(states: ClusterStates, window_s: tuple[float, float]) -> Iterator[Shortfall]:
    """Yield a shortfall if the formation was not engaged throughout the window."""
    t_s = states.t_ns / 1e9
    shares = phase_shares(t_s, states.phases, window_s)
    not_engaged = {phase: share for phase, share in shares.items() if phase != "engaged"}
    if not_engaged:
        other_phases = ", ".join(f"{phase} {percent_text(share)} %" for phase, share in not_engaged.items())
        part = f"engaged in {percent_text(shares.get('engaged', 0.0))} % of the window only ({other_phases})"
        text = part if "engaged" in shares else f"never engaged within the window ({other_phases})"
        rows = np.flatnonzero((t_s >= window_s[0]) & (t_s <= window_s[1])).tolist()
        first = next(row for row in rows if states.phases[row] != "engaged")
        yield _line(states, "window", float(t_s[first]), text)
