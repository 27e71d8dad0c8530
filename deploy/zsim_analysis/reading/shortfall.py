"""What a flight did not do of its plan, and the incidents of its drones: so that no report hides them.

Pure. Order of this file: what is judged; drones (incidents, missions, collisions, overrides); formations
(engagement, holds, requests, the target and the trajectory of the plan, the window).
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from zsim.contract.run_messages import Event
from zsim.errors import NotTrustedError
from zsim.record.completeness import SECOND_NS
from zsim.scenario.rights import WORLD
from zsim.scenario.role_table import agent_names, lets_drop
from zsim.scenario.scenario import Cluster, ClusterPlan, Processes, Scenario
from zsim_agents.formation.flight_check import HELD_ON_REQUEST
from zsim_agents.formation.flight_plan import REFUSALS, Follow, MoveTo, plan_of, waiting_step
from zsim_agents.formation.spaces.cluster_space import ClusterSpace
from zsim_agents.formation.spaces.scenario_space import scenario_space
from zsim_agents.formation.trajectory import Hold, Reference, variable_of
from zsim_analysis.reading.recorded_flight import Array, ClusterStates, RecordedFlight
from zsim_analysis.reading.window_text import percent_text, seconds_text, span_text

ENGAGES_S = 20.0  # chosen: a formation engages 4 to 12 s after its take-off; a run may end before
MOVES_NS, MOVES_MIN = 500_000_000, 1e-3  # chosen: half a second, and m or rad by which a reference at rest never moves
HELD_MAX_S = 2.0  # chosen: four times what a formation waits after a fault; held for longer, it has left its plan
LATE_MAX_S = 1.0  # chosen: two tries of a step of the plan; what more is missing of a reference is reported
SAMPLE_NS = 100_000_000  # of a reference that is compared with the plan's
STRAYED_M, STRAYED_S = 5.0, 3  # chosen: twice the least distance of drones, and successive seconds so far away
SETTLED_S = 10.0  # chosen: from its engagement a formation may take so long until its drones are in their places
SAME = 1e-3  # m or rad within which the reference is the plan's: both are computed by the same formulas
CONTROLLER, CONSOLE = "controller.", "console"  # how names begin: of who flies by the plan, and of operators' programs
INCIDENTS = ("emergency", "flip", "impact", "touchdown", "battery", "landing")  # events of drones
CRASHES = ("emergency", "flip", "impact", "touchdown")  # of them those by which a drone comes down
ONE_HIT_NS = 500_000_000  # chosen: a touchdown is part of an impact that is found as near as this
LEADS = ("hold", "land", "target", "trajectory")  # requests by which a formation leaves its plan


class Shortfall(Struct, frozen=True):
    """One thing that a flight did not do, or that happened to it.

    Attributes:
        kind: of a drone: emergency, flip, impact, touchdown, battery, landing (its first incident), mission (not flown
            to its end), strayed (far from its place), override (others flew it); of a cluster: plan (a step refused to
            the end, or flown in part), engagement (never), held (for long), request (others led it), early (the run
            ended before it was due), window (it holds instants at which a cluster was not engaged); collision; process
            (one that was expected died, failed, or never came); record (not all of it is there).
        subject: the cluster, the drone, the process, or "record"; of a collision both, as "drone1, drone2".
        t_s: since when, simulated time.
        fails: the flight is no example of its plan; the command ends with code 1.
    """

    kind: str
    subject: str
    t_s: float
    text: str
    fails: bool


def shortfalls(flight: RecordedFlight, window_s: tuple[float, float]) -> list[Shortfall]:
    """Return what a flight did not do, what matters most first; empty for one that flew its plan."""
    lines = [*_incidents(flight), *_collisions(flight), *_missions(flight)]
    lines += [line for states in flight.clusters for line in _of_cluster(states, flight, window_s)]
    lines += [*_overrides(flight), *_of_processes(flight), *_of_record(flight)]
    return sorted(lines, key=lambda line: not line.fails)


def _of_record(flight: RecordedFlight) -> Iterator[Shortfall]:
    if not flight.completeness.complete:
        yield Shortfall("record", "record", flight.last_ns / 1e9, f"the record is {flight.completeness}", True)


def _of_processes(flight: RecordedFlight) -> Iterator[Shortfall]:
    """Yield the expected processes without which the run went on, or which ended it, unless the scenario says drop."""
    scenario = flight.scenario
    expected = {*scenario.expected(), *agent_names(scenario), WORLD} if scenario else set()
    actions = scenario.processes if scenario else Processes()
    dropped = {event.subject for event in flight.events if event.kind == "drop"}  # and nobody else does their work
    for event in flight.events:
        if event.kind == "end":
            return  # who dies after it has taken part
        if event.subject not in expected:
            continue
        is_death = event.kind == "death" and (event.data.get("on_death") == "end" or event.subject in dropped)
        allowed = actions.on_overdue or {} if event.kind == "overdue" else actions.on_death
        t_s = event.t_ns / 1e9
        if event.kind == "leave":
            yield Shortfall(
                "process", event.subject, t_s, f"{event.text}, at {t_s:.2f} s", bool(event.data.get("fails"))
            )
        elif (is_death or event.kind in ("failure", "overdue")) and not lets_drop(allowed, event.subject):
            text = event.text if event.kind == "failure" else f"{event.text}, at {t_s:.2f} s"
            yield Shortfall("process", event.subject, t_s, text, True)


# Drones


def _incidents(flight: RecordedFlight) -> Iterator[Shortfall]:
    """Yield a line for each drone that had an incident, with the first one of each kind in the order of time."""
    by_drone: dict[str, list[Event]] = {}
    for event in flight.events:
        if event.kind in INCIDENTS:
            by_drone.setdefault(event.subject, []).append(event)
    for drone, events in by_drone.items():
        first = {event.kind: event for event in reversed(events)}
        hit, touch = first.get("impact"), first.get("touchdown")
        if hit and touch and abs(hit.t_ns - touch.t_ns) <= ONE_HIT_NS:
            del first["touchdown"]
        parts = [_incident_text(event) for event in sorted(first.values(), key=lambda event: (event.t_ns, event.seq))]
        text = f"{drone}: {', '.join(parts)}{_active_faults(drone, (events[0].t_ns, events[0].seq), flight)}"
        fails = any(not _is_silence_of_others(event) for event in events)
        yield Shortfall(events[0].kind, drone, events[0].t_ns / 1e9, text, fails)
    reported = {*by_drone, *(event.subject for event in flight.events if event.data.get("mode") == "emergency")}
    for track in flight.tracks:  # a record of a version that has no such events
        if track.name not in reported and not track.external and track.states and track.states[-1] == "emergency":
            t_s = float(track.status_t_ns[-1]) / 1e9
            yield Shortfall("emergency", track.name, t_s, f"{track.name} ended in an emergency", True)


def _incident_text(event: Event) -> str:
    at, data = f"at {seconds_text(event.t_ns / 1e9)} s", event.data
    if event.kind == "emergency":
        if data.get("cause") == "command":
            whose = "operator's emergency" if event.source.startswith(CONSOLE) else "emergency"
            return f"ended by: {whose} {at} ({event.source})"
        return f"emergency {at} ({'its driver reported it' if data.get('cause') == 'driver' else 'tilted too far'})"
    if event.kind == "impact":
        return f"hit {data.get('other', 'something')} at {data.get('speed_m_s', 0.0):.1f} m/s {at}"
    if event.kind == "landing":
        charge = data.get("charge_percent")
        why = f"{data.get('commander') or 'its commander'} fell silent"
        return f"landed by itself {at} ({why if charge is None else f'{charge:.1f} % of charge left'})"
    if event.kind == "touchdown":
        return f"touched {data.get('other', 'something')} in flight {at}"
    return f"upside down {at}" if event.kind == "flip" else f"no charge left {at}"


def _is_silence_of_others(event: Event) -> bool:
    """Return whether a drone landed since a program that is no controller let it be."""
    commander = str(event.data.get("commander") or "")
    silent = event.kind == "landing" and event.data.get("cause") == "silence"
    return silent and not commander.startswith(CONTROLLER)


def _active_faults(drone: str, at: tuple[int, int], flight: RecordedFlight) -> str:
    """Return which injected faults of a drone, or of all, were active at an instant: (t_ns, number of the event)."""
    active: dict[object, str] = {}
    for each in flight.events:
        if (each.t_ns, each.seq) > at:
            break
        if each.kind == "fault" and each.data.get("target") in (drone, "world"):
            source = each.data.get("source") or "somebody"
            whose = "the scenario's" if source == "scenario" else f"{source}'s"
            active[each.data.get("id")] = (
                f"{whose} fault {each.data.get('kind')} since {seconds_text(each.t_ns / 1e9)} s"
            )
        elif each.kind in ("fault_end", "fault_clear"):
            active.pop(each.data.get("id"), None)
    return f"; {', '.join(active.values())}" if active else ""


def _collisions(flight: RecordedFlight) -> Iterator[Shortfall]:
    """Yield a line for each pair of drones, or of a drone and an obstacle, that touched."""
    pairs: dict[frozenset[object], list[Event]] = {}
    for event in flight.events:
        if event.kind == "collision":
            pairs.setdefault(frozenset((event.subject, event.data.get("other"))), []).append(event)
    for first, *others in pairs.values():
        t_s, more = first.t_ns / 1e9, f" ({1 + len(others)} contacts in all)" if others else ""
        pair = f"{first.subject}, {first.data.get('other', 'something')}"
        yield Shortfall("collision", pair, t_s, f"{first.text} at {seconds_text(t_s)} s{more}", True)


def _missions(flight: RecordedFlight) -> Iterator[Shortfall]:
    """Yield for each drone that its newest mission, of those that a bridge reported, was not flown to its end."""
    newest = {event.subject: event for event in flight.events if event.kind == "mission"}
    for drone, event in newest.items():
        data, t_s = event.data, event.t_ns / 1e9
        if data.get("state") == "finished":
            continue
        why = f"{data.get('reason')}, at {seconds_text(t_s)} s" if data.get("reason") else "the run ended"
        text = f"{drone}: flew {data.get('done')} of {data.get('items')} mission items; {why}"
        yield Shortfall("mission", drone, t_s, text, bool(data.get("failsafe")))


def _overrides(flight: RecordedFlight) -> Iterator[Shortfall]:
    """Yield for each drone of a cluster who beside its controller flew it, or had it land."""
    members = {drone for states in flight.clusters for drone in states.drones if _plan(flight.scenario, states.name)}
    for drone in sorted(members):
        parts = list(_interventions(drone, flight))
        if parts:
            more = f" (and {len(parts) - 1} more)" if len(parts) > 1 else ""
            yield Shortfall("override", drone, parts[0].from_ns / 1e9, f"{drone}: {parts[0].text}{more}", False)


class _Intervention(NamedTuple):
    """That another than its controller flew a drone, or had it land: from when until when [ns]."""

    from_ns: int
    until_ns: int
    text: str


def _interventions(drone: str, flight: RecordedFlight) -> Iterator[_Intervention]:
    """Yield who beside its controller flew a drone, or had it land, in the order of time."""
    own = [event for event in flight.events if event.subject == drone]
    for place, event in enumerate(own):
        if event.source.startswith(CONTROLLER):
            continue
        if event.kind == "commander":
            ends = (each.t_ns for each in own[place + 1 :] if each.kind in ("commander", "release"))
            until_ns = next(ends, flight.last_ns)
            text = f"flown by {event.source} from {span_text((event.t_ns / 1e9, until_ns / 1e9))}"
            yield _Intervention(event.t_ns, until_ns, text)
        elif event.kind == "mode" and event.data.get("mode") == "land":
            text = f"asked to land by {event.source} at {seconds_text(event.t_ns / 1e9)} s"
            yield _Intervention(event.t_ns, flight.last_ns, text)


# Formations


def _of_cluster(states: ClusterStates, flight: RecordedFlight, window_s: tuple[float, float]) -> Iterator[Shortfall]:
    if not states.phases:
        return
    refused = [*_refused(states)]
    yield from refused
    if "engaged" in states.phases:
        yield from _strayed(states, flight)
        yield from _held(states, flight)
        yield from _requests(states, flight.scenario)
        yield from _not_begun(states, flight)
        if not refused:
            yield from _reference_flown(states, flight)
        yield from _outside(states, window_s)
    else:
        yield from _never_engaged(states, takeoff_s(flight.scenario, states.name), flight.last_ns / 1e9)


def _refused(states: ClusterStates) -> Iterator[Shortfall]:
    """Yield the steps of the plan that were refused until the end, or until the landing that dropped them."""
    begun: tuple[str, float] | None = None
    for place, note in enumerate(states.reasons):
        step = waiting_step(note)
        if step is None:
            begun = None
            continue
        op, why = step
        begun = begun if begun and begun[0] == op else (op, float(states.t_ns[place]) / 1e9)
        last = place + 1 == len(states.reasons)
        engaged = states.phases[place] in ("engaged", "held")
        if engaged and (last or states.phases[place + 1] == "landing"):
            text = f"{states.name}: the {op} of the plan was refused to the end: {why}"
            yield Shortfall("plan", states.name, begun[1], text, True)


def _strayed(states: ClusterStates, flight: RecordedFlight) -> Iterator[Shortfall]:
    """Yield which drones truly were far from where their engaged formation wanted them, and for how long.

    Their estimates may say otherwise, and the controller believes these. What others flew meanwhile was theirs to
    decide.
    """
    cluster = _cluster(flight.scenario, states.name)
    if flight.scenario is None or cluster is None:
        return
    engaged = np.array([phase == "engaged" for phase in states.phases], bool)
    settled = states.t_ns >= states.t_ns[engaged][0] + round(SETTLED_S * 1e9)
    rows = _sampled(states, np.flatnonzero(engaged & settled), SECOND_NS)
    try:
        space = scenario_space(flight.scenario, cluster)
        places_W = np.array([space.inverse(c)[0] for c in states.desired[rows]] if space.names == states.names else [])
    except (*REFUSALS, ValueError):
        return
    tracks = {track.name: track for track in flight.tracks if not track.external}
    for i, drone in enumerate(states.drones if len(places_W) else ()):
        track = tracks.get(drone)
        if track is None:
            continue
        t_ns, at, mine = np.intersect1d(states.t_ns[rows], track.t_ns, assume_unique=True, return_indices=True)
        away_m = np.linalg.norm(track.p_W[mine] - places_W[at, i], axis=1)
        for act in _interventions(drone, flight):
            away_m[(act.from_ns <= t_ns) & (t_ns <= act.until_ns)] = 0.0
        stretches = np.split(np.arange(len(t_ns)), np.flatnonzero(np.diff(away_m > STRAYED_M)) + 1)
        long = [each for each in stretches if len(each) >= STRAYED_S and away_m[each[0]] > STRAYED_M]
        if long:
            from_ns, most_m = int(t_ns[long[0][0]]), max(float(away_m[each].max()) for each in long)
            text = f"{drone}: up to {most_m:.0f} m from its place in the formation, from {from_ns / 1e9:.0f} s on"
            text += _active_faults(drone, (from_ns, 0), flight)
            yield Shortfall("strayed", drone, from_ns / 1e9, text, True)


def _held(states: ClusterStates, flight: RecordedFlight) -> Iterator[Shortfall]:
    """Yield for how long, in all, a formation that had been engaged was held, but at its own request.

    What it was held while others than its controller flew a drone of it, or had one land, was theirs to decide.
    """
    phases = np.array(states.phases)
    rows = np.flatnonzero(phases == "held")
    rows = rows[[HELD_ON_REQUEST not in states.reasons[row] for row in rows]] if len(rows) else rows
    if not len(rows):
        return
    t_ns, nexts = states.t_ns[rows], np.minimum(rows + 1, len(phases) - 1)
    lengths_s = (states.t_ns[nexts] - t_ns) / 1e9
    acts = [act for drone in states.drones for act in _interventions(drone, flight)]
    by_others = np.any([(act.from_ns <= t_ns) & (t_ns <= act.until_ns) for act in acts], axis=0) if acts else t_ns < 0
    span_s = (float(t_ns[0]) / 1e9, float(states.t_ns[nexts[-1]]) / 1e9)
    length = seconds_text(float(lengths_s.sum()))
    text = f"{states.name}: held for {length} s, from {span_text(span_s)}: {states.reasons[rows[0]]}"
    if by_others.any():
        text += f"; {seconds_text(float(lengths_s[by_others].sum()))} s of it while others flew or landed its drones"
    yield Shortfall("held", states.name, span_s[0], text, float(lengths_s[~by_others].sum()) > HELD_MAX_S)


def _requests(states: ClusterStates, scenario: Scenario | None) -> Iterator[Shortfall]:
    """Yield what others than the plan asked of a formation that has one."""
    plan = _plan(scenario, states.name)
    asked = [each for each in states.requests if each.ok and each.op in LEADS]
    if asked and plan and plan.takeoff_s is not None:
        first = ", ".join(f"{each.op} at {seconds_text(each.t_ns / 1e9)} s ({each.source})" for each in asked[:3])
        more = f" and {len(asked) - 3} more" if len(asked) > 3 else ""
        yield Shortfall("request", states.name, asked[0].t_ns / 1e9, f"{states.name}: asked {first}{more}", False)


def _not_begun(states: ClusterStates, flight: RecordedFlight) -> Iterator[Shortfall]:
    """Yield the later steps of the plan that were not due before the run ended."""
    plan, end_s = _plan(flight.scenario, states.name), flight.last_ns / 1e9
    if plan is None or plan.takeoff_s is None:
        return
    steps = {"trajectory": plan.trajectory and plan.trajectory.start_s, "landing": plan.land_s}
    for step, due_s in steps.items():
        if due_s is not None and due_s >= end_s:
            text = f"{states.name}: the run ended before its {step} at {seconds_text(due_s)} s"
            yield Shortfall("early", states.name, end_s, text, False)
    follows = plan.trajectory is not None and plan.trajectory.start_s < end_s
    if plan.target and not follows and _moves(states):
        text = f"{states.name}: the run ended before its reference was at the target"
        yield Shortfall("early", states.name, end_s, text, False)


def _moves(states: ClusterStates) -> bool:
    """Return whether the reference moves at the end, and not since the guard parts drones, or the formation is held."""
    last = states.t_ns > states.t_ns[-1] - MOVES_NS
    phases = {phase for phase, row in zip(states.phases, last, strict=True) if row}
    moved = float(np.ptp(states.desired[last], axis=0).max())
    return phases == {"engaged"} and not states.reasons[-1] and moved > MOVES_MIN


class PlannedReference(NamedTuple):
    """What the plan leads a formation along: a reference from start_s on, in the variables (entries of c) it names."""

    space: ClusterSpace
    reference: Reference
    start_s: float
    entries: NDArray[np.intp]

    def flown(self, states: ClusterStates, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Return at which of these rows of its states an engaged formation was led along it."""
        t_s = (states.t_ns[rows] / 1e9 - self.start_s).tolist()
        return np.array([self._is_on(states, row, t) for row, t in zip(rows.tolist(), t_s, strict=True)], bool)

    def _is_on(self, states: ClusterStates, row: int, t_s: float) -> bool:
        if states.phases[row] != "engaged":
            return False
        off = self.space.difference(states.desired[row], self.reference.value(t_s)[0])
        return bool(np.abs(off[self.entries]).max(initial=0.0) <= SAME)


def _planned(states: ClusterStates, scenario: Scenario | None) -> PlannedReference | None:
    """Return the trajectory of a cluster's plan, else its target; None without one, or where it was refused."""
    cluster = _cluster(scenario, states.name)
    if scenario is None or cluster is None or cluster.plan.takeoff_s is None:
        return None
    steps = [each.request for each in plan_of(cluster) if isinstance(each.request, MoveTo | Follow)]
    try:
        space = scenario_space(scenario, cluster)
        if space.names != states.names or not steps:
            return None
        base = states.desired[states.phases.index("engaged")].copy()  # a formation is engaged where it is
        base[space.neutral] = 0.0
        names, reference, start_s = dict[str, None](), None, cluster.plan.takeoff_s
        for step in steps:
            if isinstance(step, MoveTo):
                base = step.goal(space, base)
                names.update(dict.fromkeys(step.values))
                reference = Hold(base)
            else:
                reference, start_s = step.trajectory(space, base), step.start_s or 0.0
                named = [step.expressions, *(w["values"] for w in step.waypoints if isinstance(w["values"], Mapping))]
                names.update(dict.fromkeys(str(name) for each in named for name in each))
        entries = np.array(sorted({variable_of(space, name, "").entry for name in names}), np.intp)
    except (*REFUSALS, ValueError, NotTrustedError):
        return None
    return PlannedReference(space, reference, start_s, entries) if reference else None


def _reference_flown(states: ClusterStates, flight: RecordedFlight) -> Iterator[Shortfall]:
    """Yield what is missing of the trajectory, or of the way to the target, that the plan asks for."""
    planned, plan = _planned(states, flight.scenario), _plan(flight.scenario, states.name)
    if planned is None or plan is None:
        return
    if plan.trajectory is not None:
        yield from _trajectory_flown(states, planned, plan)
    else:
        yield from _target_reached(states, planned, plan)


def _trajectory_flown(states: ClusterStates, planned: PlannedReference, plan: ClusterPlan) -> Iterator[Shortfall]:
    t_s, whole_s = states.t_ns / 1e9 - planned.start_s, planned.reference.duration_s
    run_s, land_s = float(t_s[-1]), np.inf if plan.land_s is None else plan.land_s - planned.start_s
    due_s = min(np.inf if whole_s is None else whole_s, land_s, run_s)
    if due_s <= 0.0:
        return  # the run ended before it, which is said elsewhere, or its landing is planned before it
    if whole_s is not None and run_s < min(whole_s, land_s):
        text = f"{states.name}: the run ended at {seconds_text(run_s)} of {seconds_text(whole_s)} s of its trajectory"
        yield Shortfall("early", states.name, run_s + planned.start_s, text, False)
    rows = _sampled(states, np.flatnonzero((t_s >= 0.0) & (t_s <= due_s)))
    at_s, on = t_s[rows], planned.flown(states, rows)
    refusals = _waits(states, "trajectory", planned.start_s)
    begin_s = 0.0
    if whole_s is None and on.any() and not refusals:
        begin_s = float(at_s[on][0])  # one without an end is joined in motion whenever the formation gets there
    flown_s = float(np.diff(np.r_[at_s, due_s])[on].sum())
    if due_s - begin_s - flown_s <= LATE_MAX_S:
        return
    of = f"{seconds_text(due_s)} s"
    if not on.any():
        text = f"nothing of the {of} of its trajectory was flown"
    else:
        stretches = np.split(at_s[on], np.flatnonzero(np.diff(at_s[on]) > 2 * SAMPLE_NS / 1e9) + 1)
        longest = max(stretches, key=len)
        span_s = (float(longest[0]), min(float(longest[-1]) + SAMPLE_NS / 1e9, due_s))
        parted = flown_s - (span_s[1] - span_s[0]) > LATE_MAX_S
        length = f"for {seconds_text(round(flown_s, 1))} s in all, at the longest " if parted else ""
        text = f"its trajectory was flown {length}from {seconds_text(span_s[0])} to {seconds_text(span_s[1])} of {of}"
    if refusals:
        first_s, last_s, why = refusals
        text += f"; it was refused from {span_text((first_s, last_s))}: {why}"
    led = any(each.ok and each.op in LEADS and each.t_ns / 1e9 < planned.start_s + due_s for each in states.requests)
    yield Shortfall("plan", states.name, planned.start_s, f"{states.name}: {text}", not led)


def _target_reached(states: ClusterStates, planned: PlannedReference, plan: ClusterPlan) -> Iterator[Shortfall]:
    engaged_ns = states.t_ns[states.phases.index("engaged")]
    rows = np.flatnonzero(states.t_ns >= engaged_ns)
    on = planned.flown(states, rows := _sampled(states, rows))
    name, led = states.name, any(each.ok and each.op in LEADS for each in states.requests)
    due_s = None if plan.target_over_s is None else float(engaged_ns) / 1e9 + plan.target_over_s
    if on.any():
        late_s = 0.0 if due_s is None else float(states.t_ns[rows[on]][0]) / 1e9 - due_s
        if late_s > LATE_MAX_S and due_s is not None:
            waits = _waits(states, "target", 0.0)
            why = f"; it was refused from {span_text(waits[:2])}: {waits[2]}" if waits else ""
            text = f"{name}: its reference was at the target {seconds_text(round(late_s, 1))} s after it was due{why}"
            yield Shortfall("plan", name, due_s, text, not led)
    elif states.phases[-1] in ("landing", "idle"):
        yield Shortfall(
            "plan", name, float(engaged_ns) / 1e9, f"{name}: it landed before it was at its target", not led
        )


def _sampled(states: ClusterStates, rows: NDArray[np.intp], every_ns: int = SAMPLE_NS) -> NDArray[np.intp]:
    """Return of these rows the first in every so many nanoseconds."""
    return rows[np.unique(states.t_ns[rows] // every_ns, return_index=True)[1]]


def _waits(states: ClusterStates, op: str, from_s: float) -> tuple[float, float, str] | None:
    """Return from when to when [s], and why at first, a step of the plan was refused after from_s; None if never."""
    rows = np.flatnonzero(states.t_ns / 1e9 >= from_s)
    found = [(row, step[1]) for row in rows.tolist() if (step := waiting_step(states.reasons[row])) and step[0] == op]
    found = [each for each in found if states.phases[each[0]] == "engaged"]
    if not found:
        return None
    return float(states.t_ns[found[0][0]]) / 1e9, float(states.t_ns[found[-1][0]]) / 1e9, found[0][1]


def _outside(states: ClusterStates, window_s: tuple[float, float]) -> Iterator[Shortfall]:
    shares = phase_shares(states.t_ns / 1e9, states.phases, window_s)
    others = {phase: share for phase, share in shares.items() if phase != "engaged"}
    if others:
        rest = ", ".join(f"{phase} {percent_text(share)} %" for phase, share in others.items())
        part = f"engaged in {percent_text(shares.get('engaged', 0.0))} % of the window only ({rest})"
        text = part if "engaged" in shares else f"never engaged within the window ({rest})"
        t_s = states.t_ns / 1e9
        rows = np.flatnonzero((t_s >= window_s[0]) & (t_s <= window_s[1]))
        first = next(row for row in rows.tolist() if states.phases[row] != "engaged")
        yield Shortfall("window", states.name, float(t_s[first]), f"{states.name}: {text}", False)


def phase_shares(t_s: Array, phases: list[str], window_s: tuple[float, float]) -> dict[str, float]:
    """Return at which shares of a window's instants a formation was in each of its phases, the greatest first."""
    rows = np.flatnonzero((t_s >= window_s[0]) & (t_s <= window_s[1])).tolist()
    return {phase: count / len(rows) for phase, count in Counter(phases[row] for row in rows).most_common()}


def _never_engaged(states: ClusterStates, due_s: float | None, end_s: float) -> Iterator[Shortfall]:
    name, phase = states.name, states.phases[-1]
    if due_s is None:
        yield Shortfall("window", name, 0.0, f"{name}: never engaged; it has no plan to take off by", False)
    elif due_s >= end_s:
        text = f"{name}: the run ended before its take-off at {seconds_text(due_s)} s"
        yield Shortfall("early", name, end_s, text, False)
    elif end_s - due_s < ENGAGES_S:
        text = f"{name}: never engaged; the run ended {seconds_text(end_s - due_s)} s after its take-off, {phase}"
        yield Shortfall("early", name, end_s, text, False)
    else:
        why = f": {states.reasons[-1]}" if states.reasons[-1] else ""
        text = f"{name}: never engaged, {phase} to the end{why}"
        yield Shortfall("engagement", name, due_s, text, True)


def takeoff_s(scenario: Scenario | None, cluster: str) -> float | None:
    """Return when a cluster's plan takes it off [s]; None without a plan."""
    plan = _plan(scenario, cluster)
    return plan.takeoff_s if plan else None


def _plan(scenario: Scenario | None, cluster: str) -> ClusterPlan | None:
    found = _cluster(scenario, cluster)
    return found.plan if found else None


def _cluster(scenario: Scenario | None, name: str) -> Cluster | None:
    return next((each for each in scenario.clusters if each.name == name), None) if scenario else None
