"""The content of summary.json: facts and errors of a flight; and its error tables, for the page and the terminal.

Errors in the paper's Test 1 are shown beside those printed in the paper: I. Mas, S. Curi, R. Sanchez Pena, Open-source
Multi-UAV Simulator for the ROS Environment.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET, Struct
from rich.box import HEAVY_HEAD
from rich.console import Group
from rich.text import Text

from zsim import __version__
from zsim.contract.fingerprint import TruthHash
from zsim.errors import RecordError, printable
from zsim.presentation import Column, FittedTable
from zsim.scenario.scenario import Cluster, ClusterPlan, Drone, Scenario
from zsim.scenario.surroundings import Surroundings
from zsim.sensors.sensor_catalogue import AS_PRINTED, PRESETS, STOCK
from zsim_agents.formation.expression import Expression, ExpressionError
from zsim_agents.formation.spaces.cluster_space import unit
from zsim_agents.formation.spaces.scenario_space import cluster_space
from zsim_agents.formation.trajectory import TrajectoryError, named_values
from zsim_analysis.reading.drone_errors import Tracking, reference_errors, tracking_of
from zsim_analysis.reading.formation import Formation, ParameterErrors, cluster_of, formations_of, min_separation_m
from zsim_analysis.reading.recorded_flight import TRUTH_WIDTH, RadioSummary, RecordedFlight, read_flight
from zsim_analysis.reading.recorded_run import DriverLink, command_age_ms, driver_links
from zsim_analysis.reading.shortfall import (
    NOT_AS_PLANNED,
    Shortfall,
    marks_of,
    percent_text,
    phase_shares,
    shortfalls,
    span_text,
    window_of,
)

STATISTICS = {"est. std": "est_std", "true std": "true_std", "true RMS": "true_rms", "true mean": "true_mean"}
EVENTS_PER_KIND = 100  # maximum number of events of a kind, so that many refusals do not crowd out a restart
EVENTS_MAX = 1000


class EventLine(Struct, frozen=True):
    """One event of the run."""

    t_s: float
    kind: str
    source: str
    subject: str
    text: str


class ClusterErrors(Struct, frozen=True):
    """The errors of one cluster within the window."""

    drones: tuple[str, ...]  # names of the cluster's drones
    # over the samples of the window in which the cluster was engaged; values are None if it never was
    errors: dict[str, ParameterErrors]
    paper_std: dict[str, float] = {}  # the paper's Table I for a flight of Test 1, otherwise empty
    engaged_share: float | None = None  # share of the window's samples in which it was engaged; None without samples
    phases: dict[str, float] = {}  # shares of the window's samples by phase

    @property
    def part(self) -> str:
        """The part of the window that the errors cover, in words; empty if they cover all of it."""
        if self.engaged_share in (None, 1.0):
            return ""
        if not self.engaged_share:
            return "it was never engaged within the window: there are no errors"
        return f"errors are over the {percent_text(self.engaged_share)} % of the window in which it was engaged"


class RecordFacts(Struct, frozen=True):
    """The record from which the report was made."""

    messages: int
    complete: bool  # neither a message of the world nor the end of the run is missing
    state: str  # the same in words, with what is missing
    gates: int  # number of gates in the record
    gates_missing: int  # according to the clocks
    gaps: list[dict[str, float]]  # stretches of missing gates: number of gates, time of the first and the last
    messages_missing: int  # messages of the world that are missing according to sequence numbers
    undecoded: int  # messages that do not match the type of their key
    truth_instants: int  # truth messages in the hash: those of simulated drones
    truth_missing: int  # further truth messages that a complete run of this length would have
    truth_sha256: str  # TruthHash of all truth messages, by time, then in the order of the drones


class RunSummary(Struct, frozen=True):
    """The content of summary.json; a value is None if the record does not show it."""

    scenario: str | None
    seed: int | None
    mode: str | None
    run_id: str | None
    date: str | None  # when the run was flown, to the second in UTC (ISO 8601)
    changed: list[str] | None  # overrides `a.b.c=value` applied to the scenario's file
    versions: dict[str, str]
    fingerprint: str | None
    real_time_factor: float | None
    wall_s: float
    sim_s: float
    ended: str
    as_planned: bool  # whether the flight followed its plan until the end of the run; see `shortfalls`
    shortfalls: list[Shortfall]
    deadlines: int | None
    deadline_misses: int | None
    deadline_misses_by: dict[str, int]
    command_age_ms: dict[str, float] | None
    links: dict[str, DriverLink]  # links to the aircraft that flew as external drones, by drone
    window_s: tuple[float, float]
    window_note: str  # why the window is not the scenario's; empty if it is
    errors: dict[str, ParameterErrors]
    clusters: dict[str, ClusterErrors]
    min_separation_m: float | None
    obstacle_distance_m: dict[
        str, float
    ]  # least distance of each drone's centre from obstacles and surfaces; empty without these
    tracking: dict[str, Tracking]  # errors against the references of single drones within the window
    radio: RadioSummary | None  # reception within the window; None if the scenario has no radio
    paper_table_1: dict[str, float]
    events: list[EventLine]
    events_left_out: dict[str, int]
    participants: list[dict[str, Any]]
    truth_sha256: str
    record: RecordFacts
    notes: list[str]


def judge(
    record: Path, progress: Callable[[str], None] = lambda _: None, answers: bool = False
) -> tuple[RecordedFlight, list[Formation], RunSummary]:
    """Return the flight of a record, its formations and its summary.

    With `answers`, the flight includes the drones' estimates and velocity commands. `progress` is called with a text at
    each step.

    Raises:
        RecordError: there is no record, or it contains no truth of any drone.
    """
    progress("reading the record")
    flight = read_flight(record, answers)
    if all(len(track.t_ns) == 0 for track in flight.tracks):
        content = f"contains {flight.messages} messages but no truth" if flight.messages else "contains no messages"
        raise RecordError(f"{record}: {content} ({flight.completeness}); there is nothing to report")
    progress("computing the formation's errors")
    formations = formations_of(flight)
    return flight, formations, summarise(flight, formations, record)


def summarise(flight: RecordedFlight, formations: list[Formation], record: Path) -> RunSummary:
    """Return the summary of a flight; values that the world did not report at its end are computed from the record."""
    end, info = flight.end or {}, flight.info
    facts = _record_facts(flight, end.get("last_ns", flight.last_ns))
    window_s, window_note = window_of(flight)
    shortfall_lines = shortfalls(flight, window_s)
    as_planned = not any(each.fails for each in shortfall_lines)
    clusters = {
        f.name: ClusterErrors(
            f.drones,
            f.errors(window_s),
            dict(paper_table_of(flight, f, window_s) if as_planned else {}),
            f.engaged_share(window_s),
            phase_shares(f.t_s, f.phases, window_s),
        )
        for f in formations
    }
    wall_s, span_s = end.get("wall_s", flight.wall_s), (flight.last_ns - flight.first_ns) / 1e9
    ended = str(end.get("reason", "ended"))
    if not flight.end:  # a record without an end event does not show which process died
        end_text, is_cut = f"{flight.last_ns / 1e9:.2f} s", not flight.completeness.closed
        ended = f"the record {'was cut after' if is_cut else 'ends at'} {end_text}: it has no end event"
    lines: list[EventLine] = []
    kept_counts, omitted = Counter[str](), Counter[str]()
    for event in flight.events:
        if kept_counts[event.kind] >= EVENTS_PER_KIND or len(lines) >= EVENTS_MAX:
            omitted[event.kind] += 1
        else:
            kept_counts[event.kind] += 1
            lines.append(EventLine(event.t_ns / 1e9, event.kind, event.source, event.subject, event.text))
    participant = ("name", "role", "host", "pid", "incarnations", "left")
    start_date = datetime.fromtimestamp(flight.began_ns // 10**9, UTC).isoformat() if flight.began_ns else None
    return RunSummary(
        scenario=flight.scenario.name if flight.scenario else None,
        seed=info.seed if info else None,
        mode=info.mode if info else None,
        run_id=info.run_id if info else None,
        date=start_date.replace("+00:00", "Z") if start_date else None,
        changed=list(info.changed) if info and info.changed is not UNSET else None,
        versions={
            **({"world": info.version} if info else {}),
            **{process.name: process.version for process in flight.processes if process.version},
            "report": __version__,
        },
        fingerprint=info.fingerprint if info else None,
        real_time_factor=end.get("real_time_factor", span_s / wall_s if wall_s > 0 else None),
        wall_s=wall_s,
        sim_s=end.get("sim_s", span_s if flight.replay_of else flight.last_ns / 1e9),
        ended=ended,
        as_planned=as_planned,
        shortfalls=shortfall_lines,
        deadlines=end.get("deadlines"),
        deadline_misses=end.get("deadline_misses"),
        deadline_misses_by=end.get("deadline_misses_by", {}),
        command_age_ms=end["command_age_ms"] if "command_age_ms" in end else command_age_ms(record),
        links=driver_links(record) if any(track.external for track in flight.tracks) else {},
        window_s=window_s,
        window_note=window_note,
        errors=next((cluster.errors for cluster in clusters.values()), {}),
        clusters=clusters,
        min_separation_m=min_separation_m(flight.tracks),
        obstacle_distance_m=obstacle_distances_m(flight),
        tracking={name: tracking_of(each, window_s) for name, each in reference_errors(flight).items()},
        radio=flight.radio.summary(window_s) if flight.radio else None,
        paper_table_1=PAPER_TABLE_1,
        events=lines,
        events_left_out=dict(omitted),
        participants=[{name: getattr(each, name) for name in participant} for each in flight.processes],
        truth_sha256=end.get("truth_sha256", facts.truth_sha256),
        record=facts,
        notes=list(_notes(flight, facts, formations, window_s, window_note)),
    )


def obstacle_distances_m(flight: RecordedFlight) -> dict[str, float]:
    """Return the least true distance of each drone's centre from obstacles and surfaces [m], < 0 inside an obstacle."""
    if flight.scenario is None:
        return {}
    around = Surroundings(flight.scenario.environment)
    tracks = [track for track in flight.tracks if not around.is_empty and len(track.t_ns)]
    return {track.name: float(around.distances_m(track.p_W).min()) for track in tracks}


def _record_facts(flight: RecordedFlight, last_ns: int) -> RecordFacts:
    """Return the facts of the record of a flight whose last known instant is `last_ns`."""
    tracks, state = [track for track in flight.tracks if not track.external], flight.completeness
    t_ns = np.concatenate([track.t_ns for track in tracks] or [np.zeros(0, np.int64)])
    states = np.concatenate([track.truth for track in tracks] or [np.zeros((0, TRUTH_WIDTH))])
    drone = np.repeat(np.arange(len(tracks)), [len(track.t_ns) for track in tracks])
    order, truth = np.lexsort((drone, t_ns)), TruthHash(len(t_ns))
    truth.add(t_ns[order], states[order])
    gate_ns, missing = flight.info.gate_ns if flight.info else None, 0
    if gate_ns and len(t_ns):  # a flight has truth from 0 or from the first gate on, a replay from its start on
        first_ns = flight.first_ns if flight.replay_of else min(flight.first_ns, gate_ns)
        missing = max(0, len(tracks) * ((last_ns - first_ns) // gate_ns + 1) - len(t_ns))
    return RecordFacts(
        messages=flight.messages,
        complete=state.complete,
        state=str(state),
        gates=state.gates,
        gates_missing=state.gates_missing,
        gaps=[{"gates": g.gates, "from_s": g.from_ns / 1e9, "to_s": g.to_ns / 1e9} for g in state.gaps],
        messages_missing=state.messages_missing,
        undecoded=flight.undecoded,
        truth_instants=len(t_ns),
        truth_missing=missing,
        truth_sha256=truth.hexdigest(),
    )


def _notes(
    flight: RecordedFlight, record: RecordFacts, formations: list[Formation], window_s: tuple[float, float], note: str
) -> Iterator[str]:
    """Yield remarks for readers of the figures."""
    if flight.replay_of:
        yield f"This is a replay of run {flight.replay_of}, not a flight of its own."
    if flight.end is None:
        yield "The world did not report the run's end; times and command age are computed from the record."
    if not flight.completeness.complete:
        yield f"The record is {flight.completeness}."
    if flight.undecoded:
        yield f"{flight.undecoded} messages in the record do not match the type of their key and were skipped."
    if flight.info is None:
        yield "The record has no world/info: scenario, seed and the order of the drones are not known."
    elif flight.scenario is None:
        yield "The recorded scenario cannot be read by this version."
    if record.truth_missing:
        expected = record.truth_missing + record.truth_instants
        yield f"{record.truth_missing} of {expected} truth messages are not in the record."
    reported = (flight.end or {}).get("truth_sha256")
    if reported and reported != record.truth_sha256:
        yield f"The recorded truth has the hash {record.truth_sha256}, but the world reported {reported}."
    if note:
        yield note
    judged = {formation.name for formation in formations}
    external = {track.name for track in flight.tracks if track.external}
    for cluster in flight.clusters:
        if own := [drone for drone in cluster.drones if drone in external]:
            are = f"{', '.join(own)}, whose {'body is' if len(own) == 1 else 'bodies are'} external"
            yield f"Cluster {cluster.name} has {are}: its truth is not known, so it has no true errors."
        if cluster.name not in judged:
            yield f"Cluster {cluster.name} published no state that can be judged; it has no table."
    for formation in formations:
        if not formation.within(window_s).any():
            yield f"Cluster {formation.name} published no state inside the window."
    if not flight.clusters and not flight.references:
        yield "The scenario has no cluster: there is no table of errors."
    own = flight.info.fingerprint if flight.info else ""
    if other_processes := [p.name for p in flight.processes if own and p.fingerprint and p.fingerprint != own]:
        text = "computed with different code from the world's (fingerprint); the same bits are not guaranteed."
        yield f"{', '.join(other_processes)} {text}"


# Tables of errors; that of a large formation begins with groups of parameters

PAPER_COLUMN = "paper std"
COLUMNS = {  # by name on the page: column heading in the terminal, and statistic
    "parameter": (Column("parameter", "name"), ""),
    PAPER_COLUMN: (Column("paper\nstd", worth=4, right=True), ""),
    "est. std": (Column("est.\nstd", worth=3, right=True), "est_std"),
    "est. mean": (Column("est.\nmean", worth=1, right=True), "est_mean"),
    "true std": (Column("true\nstd", right=True), "true_std"),
    "true RMS": (Column("true\nRMS", right=True), "true_rms"),
    "true mean": (Column("true\nmean", worth=2, right=True), "true_mean"),
}
GROUP_COLUMNS = {
    "parameters": (Column("parameters", "name"), ""),
    "count": (Column("count", worth=1, right=True), ""),
    "est. RMS": (Column("est.\nRMS", worth=2, right=True), "est_rms"),
    "true RMS": COLUMNS["true RMS"],
    "worst": (Column("worst", worth=3, right=True), ""),
    "of": (Column("of", "name"), ""),
}
SINGLY_MAX = 24  # maximum number of parameters with a row each, those of 6 drones; more are shown in groups
FRAME = {"x_c": "position", "y_c": "position", "z_c": "position"} | dict.fromkeys(("roll", "pitch", "yaw"), "attitude")


class ErrorTable(Struct, frozen=True):
    """Columns and rows of text; if the rows are groups, `rest` has every parameter."""

    columns: list[str]
    rows: list[list[str]]
    rest: "ErrorTable | None" = None


def error_table(cluster: ClusterErrors) -> ErrorTable:
    """Return a cluster's errors: a row per parameter, or per group of them if there are many."""
    columns = [column for column in COLUMNS if column != PAPER_COLUMN or cluster.paper_std]
    rows = []
    for name, errors in cluster.errors.items():
        printed = cluster.paper_std.get(name)
        paper = ["" if printed is None else f"{printed:g}"] if cluster.paper_std else []
        values = [getattr(errors, statistic) for _, statistic in COLUMNS.values() if statistic]
        rows.append([f"{name} ({unit(name)})", *paper, *map(_number, values)])
    single = ErrorTable(columns, rows)
    if len(cluster.errors) <= SINGLY_MAX:
        return single
    # for each group: its size, its RMS errors, and the parameter with the largest RMS
    rows = []
    groups: dict[tuple[str, str], list[str]] = {}
    for name in cluster.errors:
        kind = FRAME.get(name) or ("headings" if name.startswith("phi") else "shape")
        groups.setdefault((kind, unit(name)), []).append(name)
    for (kind, measure), names in groups.items():
        est = {name: value for name in names if (value := cluster.errors[name].est_rms) is not None}
        true = {name: value for name in names if (value := cluster.errors[name].true_rms) is not None}
        means = (float(np.sqrt(np.mean(np.square([*each.values()])))) if each else None for each in (est, true))
        worst = max(true, key=lambda name: true[name], default="")
        rows.append([f"{kind} ({measure})", str(len(names)), *map(_number, (*means, true.get(worst))), worst or "–"])
    return ErrorTable(list(GROUP_COLUMNS), rows, single)


TRACKING_COLUMNS = {  # by name on the page: column heading in the terminal
    "drone": Column("drone", "name"),
    "true RMS (m)": Column("true\nRMS (m)", right=True),
    "on path (m)": Column("on\npath (m)", worth=3, right=True),
    "greatest (m)": Column("greatest\n(m)", worth=2, right=True),
    "heading (rad)": Column("heading\n(rad)", worth=1, right=True),
}


def tracking_table(summary: RunSummary) -> ErrorTable:
    """Return the errors of single drones against their references, a row each; only the worst if there are many."""
    ranked = sorted(summary.tracking.items(), key=lambda item: -(item[1].true_rms_m or 0.0))
    shown = dict(ranked[:SINGLY_MAX])
    rows = [
        [name, *map(_number, (each.true_rms_m, each.path_rms_m, each.true_max_m, each.yaw_rms_rad))]
        for name, each in summary.tracking.items()
        if name in shown
    ]
    return ErrorTable(list(TRACKING_COLUMNS), rows)


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4f}"


def terminal_text(summary: RunSummary) -> Group:
    """Return the shortfalls of a flight and a table of errors for each cluster, for the terminal."""
    notes = [(f"note: {summary.window_note}", False)] if summary.window_note else []
    marks = [*marks_of(summary.shortfalls), *notes]
    lines = [Text(printable(mark), style="bold red" if fails else "yellow") for mark, fails in marks]
    tables = [table(summary, name) for name in summary.clusters]
    if summary.tracking:
        title = f"Errors against the drones' references from {span_text(summary.window_s)}"
        caption = "true = truth − reference, in the air; on path: neither on the way to it nor holding a position"
        content = tracking_table(summary)
        columns = [TRACKING_COLUMNS[name] for name in content.columns]
        tables.append(FittedTable(columns, content.rows, title, caption, lines=HEAVY_HEAD))
    return Group(*lines, *tables)


def table(summary: RunSummary, cluster: str) -> FittedTable:
    """Return the errors of one cluster for the terminal; for Test 1, beside the paper's Table I."""
    errors = summary.clusters[cluster]
    content = error_table(errors)
    title = f"Formation errors of {cluster} from {span_text(summary.window_s)}"
    comparison = ", beside Table I of the paper" if errors.paper_std else ""
    mark = "" if summary.as_planned else f" ({NOT_AS_PLANNED})"
    caption = "est. = estimate − desired, true = truth − desired"
    if errors.part:
        caption += f"; {errors.part}"
    if content.rest:
        caption += f"; all {len(content.rest.rows)} parameters: report.html, summary.json"
    columns = [{**COLUMNS, **GROUP_COLUMNS}[column][0] for column in content.columns]
    return FittedTable(columns, content.rows, f"{title}{comparison}{mark}", caption, lines=HEAVY_HEAD)


# The paper's printed values, and which flights are comparable with them, judged by their scenarios

# Table I: standard deviations of the formation parameters in Test 1 after reaching steady state; m and rad.
PAPER_TABLE_1 = {
    "x_c": 0.11, "y_c": 0.22, "z_c": 0.13, "roll": 0.004, "pitch": 0.0025, "yaw": 0.044,
    "p": 0.032, "q": 0.035, "beta": 0.012,
}  # fmt: skip

PAPER_NOTE = (
    "With GPS errors of 2.0 m that are independent from drone to drone, the error of a distance between two "
    "drones is √6 = 2.45 times the error of a coordinate of their centroid, whatever filter each of them "
    "uses on its own. In Table I p and q are 0.15 to 0.32 times x_c and y_c. So these figures cannot be "
    "reached in truth with the set-up that the paper describes; they can be read as deviations of the "
    "estimate from the desired value, which a controller makes small even when the estimate is wrong. "
    "Compare the column est. std with the paper, and judge the flight by the columns of the truth."
)

# Equation (3): the final position of Test 1; m and rad.
TEST_1_TARGET = {
    "x_c": 5.0, "y_c": -5.0, "z_c": 15.0, "roll": 0.0, "pitch": 0.0, "yaw": math.pi / 2,
    "p": 4.0, "q": 4.0, "beta": math.pi / 4,
}  # fmt: skip
# Equation (4): the trajectory of Test 2 in t [s]; m and rad.
TEST_2_F_HZ = 0.01
TEST_2_REFERENCE = {
    "x_c": "5*cos(2*pi*f*t)",
    "y_c": "-5*(1 + 1/2*sin(4*pi*f*t))",
    "z_c": "15 + 5/2*(1 - cos(3*pi*f*t))",
    "yaw": "0.1*t",
    "p": "4",
    "q": "4",
    "beta": "pi/4",
}
COMPARED_S = (0.0, 7.0, 31.0, 88.0, 140.0)  # expressions equal at these times count as the same; design choice
ROBOTS = 3
TOLERANCE = 1e-3  # m or rad, as values may be written with fewer digits
# shortest time from the take-off to the window, and shortest window, as in scenarios/step.yaml
SETTLED_S, JUDGED_S = 100.0, 200.0
GUST_MAX_M_S = 0.5  # as in scenarios/step.yaml; the paper names no wind


def paper_table_of(flight: RecordedFlight, formation: Formation, window_s: tuple[float, float]) -> Mapping[str, float]:
    """Return Table I for a formation that flew Test 1 over a complete window; empty for any other flight."""
    scenario, is_complete = flight.scenario, flight.completeness.complete
    faults = any(event.kind == "fault" for event in flight.events)
    if not is_complete or faults or scenario is None or scenario.report.window_s != window_s:
        return {}
    return paper_table(scenario, formation.name) if formation.engaged_share(window_s) == 1.0 else {}


def paper_table(scenario: Scenario, cluster: str) -> Mapping[str, float]:
    """Return Table I for a cluster whose scenario is Test 1 and lasts long enough; empty for any other."""
    own, window_s = cluster_of(scenario, cluster), scenario.report.window_s
    if own is None or window_s is None or own.plan.takeoff_s is None:
        return {}
    # the window lies within the run, after the formation has settled, and is at least as long as the paper's
    start, end = window_s
    over_s = min(scenario.duration_s, scenario.duration_s if own.plan.land_s is None else own.plan.land_s)
    is_judged = start >= own.plan.takeoff_s + SETTLED_S and end - start >= JUDGED_S and end <= over_s
    return PAPER_TABLE_1 if is_judged and _is_set_up(scenario, own) and _is_led(own) else {}


def flies_paper_test(flight: RecordedFlight, cluster: str) -> bool:
    """Return whether a cluster flew one of the paper's tests, regardless of duration and window."""
    scenario = flight.scenario
    if scenario is None or any(event.kind == "fault" for event in flight.events):
        return False
    own = cluster_of(scenario, cluster)
    return own is not None and _is_set_up(scenario, own) and (_is_led(own) or _is_along_equation_4(own.plan))


def _is_set_up(scenario: Scenario, cluster: Cluster) -> bool:
    """Return whether a cluster of ROBOTS has the paper's drones and sensors, calm air and no faults."""
    wind = scenario.environment.wind
    calm = not any(wind.steady_m_s) and wind.gust_m_s <= GUST_MAX_M_S
    as_printed = all(_is_printed(scenario.drone(name)) for name in cluster.drones)
    return len(cluster.drones) == ROBOTS and calm and not scenario.faults and as_printed


def _is_along_equation_4(plan: ClusterPlan) -> bool:
    """Return whether a plan's trajectory is equivalent to equation (4)."""
    trajectory = plan.trajectory
    if trajectory is None or trajectory.waypoints or set(trajectory.expressions) != set(TEST_2_REFERENCE):
        return False
    try:
        return all(
            math.isclose(
                Expression(name, str(text), trajectory.constants)(t_s)[0],
                Expression(name, TEST_2_REFERENCE[name], {"f": TEST_2_F_HZ})(t_s)[0],
                abs_tol=TOLERANCE,
            )
            for name, text in trajectory.expressions.items()
            for t_s in COMPARED_S
        )
    except ExpressionError:
        return False  # the trajectory was refused in flight


def _is_printed(drone: Drone) -> bool:
    """Return whether a drone is an unmodified AR.Drone with the paper's sensor noise and no detector."""
    sensors = drone.sensors
    unmodified = Drone(name=drone.name, position_m=drone.position_m, yaw_deg=drone.yaw_deg, sensors=sensors)
    has_extras = sensors.own is not UNSET or sensors.sightings is not UNSET
    overrides = AS_PRINTED if sensors.as_printed else {}
    printed = {
        name: msgspec.convert({**section, **overrides.get(name, {})}, STOCK[name].settings)
        for name, section in PRESETS["paper"].items()
    }
    return drone == unmodified and not has_extras and {name: getattr(sensors, name) for name in STOCK} == printed


def _is_led(cluster: Cluster) -> bool:
    """Return whether the plan of a cluster of ROBOTS leads from the ground to the target of equation (3)."""
    plan = cluster.plan
    if plan.takeoff_s is None or plan.trajectory is not None:
        return False
    space = cluster_space(ROBOTS)
    try:
        target = named_values(space, plan.target, "target", np.full(len(space.names), np.inf))
    except (TrajectoryError, ExpressionError):
        return False  # the target was refused in flight
    expected = [TEST_1_TARGET.get(name, np.nan) for name in space.names]
    return all(abs(target[k] - value) <= TOLERANCE for k, value in enumerate(expected) if not np.isnan(value))
