"""What a flight did not do of its plan, so that no report of it can be mistaken for that of a flight that did. Pure."""

from collections.abc import Iterator

import numpy as np
from msgspec import Struct

from zsim.scenario.scenario import ClusterPlan, Scenario
from zsim_agents.formation.flight_plan import waiting_step
from zsim_analysis.reading.recorded_flight import ClusterStates, RecordedFlight
from zsim_analysis.reading.window_text import percent_text, seconds_text

ENGAGES_S = 20.0  # chosen: a formation engages 4 to 12 s after its take-off; a run may end before


MOVES_NS, MOVES_MIN = 500_000_000, 1e-3  # chosen: half a second, and m or rad by which a reference at rest never moves


class Shortfall(Struct, frozen=True):
    """One thing that a flight did not do.

    Attributes:
        kind: plan (a step refused to the end), engagement (never), early (the run ended before it was due), window
            (it holds instants at which a cluster was not engaged), collision, record (not all of it is there).
        subject: the cluster, the drone, or "record".
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
    lines = [line for states in flight.clusters for line in _of_cluster(states, flight, window_s)]
    lines += [*_collisions(flight), *_of_record(flight)]
    return sorted(lines, key=lambda line: not line.fails)


def _of_record(flight: RecordedFlight) -> Iterator[Shortfall]:
    if not flight.completeness.complete:
        yield Shortfall("record", "record", flight.last_ns / 1e9, f"the record is {flight.completeness}", True)


def _collisions(flight: RecordedFlight) -> Iterator[Shortfall]:
    contacts = [event for event in flight.events if event.kind == "collision"]
    if contacts:
        first = contacts[0]
        more = f" ({len(contacts)} contacts in all)" if len(contacts) > 1 else ""
        t_s = first.t_ns / 1e9
        yield Shortfall("collision", first.subject, t_s, f"{first.text} at {t_s:.2f} s{more}", True)


def _of_cluster(states: ClusterStates, flight: RecordedFlight, window_s: tuple[float, float]) -> Iterator[Shortfall]:
    if not states.phases:
        return
    yield from _refused(states)
    if "engaged" in states.phases:
        yield from _not_begun(states, flight)
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


def _outside(states: ClusterStates, window_s: tuple[float, float]) -> Iterator[Shortfall]:
    t_s = states.t_ns / 1e9
    rows = np.flatnonzero((t_s >= window_s[0]) & (t_s <= window_s[1]))
    out = [row for row in rows if states.phases[row] != "engaged"]
    if out:
        share, phase = 1 - len(out) / len(rows), states.phases[out[0]]
        part = f"engaged in {percent_text(share)} % of the window only ({phase} else)"
        text = part if share else f"never engaged within the window, but {phase}"
        yield Shortfall("window", states.name, float(t_s[out[0]]), f"{states.name}: {text}", False)


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
    clusters = scenario.clusters if scenario else ()
    return next((each.plan for each in clusters if each.name == cluster), None)
