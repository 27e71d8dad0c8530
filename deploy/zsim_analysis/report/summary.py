"""summary.json: what a run was and how well it flew, beside what the paper printed."""

from collections import Counter
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
from msgspec import UNSET, Struct

from zsim import __version__
from zsim.contract.run_messages import Event
from zsim_analysis.reading.driver_links import DriverLink, driver_links
from zsim_analysis.reading.formation import Formation, ParameterErrors, min_separation_m
from zsim_analysis.reading.recorded_flight import RecordedFlight, RecordedProcess
from zsim_analysis.reading.recorded_run import command_age_ms
from zsim_analysis.reading.shortfall import Shortfall, phase_shares, shortfalls
from zsim_analysis.reading.verdict import window_of
from zsim_analysis.reading.window_text import percent_text
from zsim_analysis.report.paper import PAPER_TABLE_1, paper_table_of
from zsim_analysis.report.record_facts import RecordFacts, facts_of_record

EVENTS_PER_KIND = 100  # a flood of refusals must not push a restart out of the list
EVENTS_MAX = 1000


class EventLine(Struct, frozen=True):
    """One event of the run."""

    t_s: float
    kind: str
    source: str
    subject: str
    text: str


class ClusterErrors(Struct, frozen=True):
    """How one cluster flew within the window.

    Attributes:
        drones: of the cluster.
        errors: over the instants of the window at which it was engaged; None each where it never was.
        paper_std: Table I beside a flight of Test 1, else empty.
        engaged_share: of the window's instants, those at which it was engaged; None without any.
        phases: shares of the window's instants by phase.
    """

    drones: tuple[str, ...]
    errors: dict[str, ParameterErrors]
    paper_std: dict[str, float] = {}
    engaged_share: float | None = None
    phases: dict[str, float] = {}

    @property
    def part(self) -> str:
        """Return of which part of the window the errors are; empty where they are of all of it."""
        if self.engaged_share in (None, 1.0):
            return ""
        if not self.engaged_share:
            return "it was never engaged within the window: there are no errors"
        return f"errors are over the {percent_text(self.engaged_share)} % of the window in which it was engaged"


class RunSummary(Struct, frozen=True):
    """The content of summary.json; None where the record does not show a value.

    Attributes:
        date: when it was flown, to the second in UTC (ISO 8601).
        changed: texts `a.b.c=value` by which the scenario was changed against its file.
        as_planned: the flight did what its plan says, as far as the run went; `shortfalls` has what it did not do.
        links: to the aircraft that flew as external drones, by drone.
        window_note: why the window is not that of the scenario, empty where it is.
    """

    scenario: str | None
    seed: int | None
    mode: str | None
    run_id: str | None
    date: str | None
    changed: list[str] | None
    versions: dict[str, str]
    fingerprint: str | None
    real_time_factor: float | None
    wall_s: float
    sim_s: float
    ended: str
    as_planned: bool
    shortfalls: list[Shortfall]
    deadlines: int | None
    deadline_misses: int | None
    deadline_misses_by: dict[str, int]
    command_age_ms: dict[str, float] | None
    links: dict[str, DriverLink]
    window_s: tuple[float, float]
    window_note: str
    errors: dict[str, ParameterErrors]
    clusters: dict[str, ClusterErrors]
    min_separation_m: float | None
    paper_table_1: dict[str, float]
    events: list[EventLine]
    events_left_out: dict[str, int]
    participants: list[dict[str, Any]]
    truth_sha256: str
    record: RecordFacts
    notes: list[str]

    def json(self) -> bytes:
        """Return the text of summary.json."""
        return msgspec.json.format(msgspec.json.encode(self), indent=2) + b"\n"


def summarise(flight: RecordedFlight, formations: list[Formation], record: Path) -> RunSummary:
    """Return the summary of a flight; what the world did not report before it ended is computed from the record."""
    end = flight.end or {}
    info = flight.info
    record_facts = facts_of_record(flight, end.get("last_ns", flight.last_ns))
    window_s, window_note = window_of(flight)
    short = shortfalls(flight, window_s)
    as_planned = not any(each.fails for each in short)
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
    sim_s = end.get("sim_s", span_s if flight.replay_of else flight.last_ns / 1e9)
    lines, left_out = _lines(flight.events)
    return RunSummary(
        scenario=flight.scenario.name if flight.scenario else None,
        seed=info.seed if info else None,
        mode=info.mode if info else None,
        run_id=info.run_id if info else None,
        date=_date(flight.began_ns) if flight.began_ns else None,
        changed=list(info.changed) if info and info.changed is not UNSET else None,
        versions=_versions(flight),
        fingerprint=info.fingerprint if info else None,
        real_time_factor=end.get("real_time_factor", span_s / wall_s if wall_s > 0 else None),
        wall_s=wall_s,
        sim_s=sim_s,
        ended=_ended(flight),
        as_planned=as_planned,
        shortfalls=short,
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
        paper_table_1=PAPER_TABLE_1,
        events=lines,
        events_left_out=left_out,
        participants=[_participant(process) for process in flight.processes],
        truth_sha256=end.get("truth_sha256", record_facts.truth_sha256),
        record=record_facts,
        notes=_notes(flight, record_facts, formations, window_s, window_note),
    )


def _date(wall_ns: int) -> str:
    return datetime.fromtimestamp(wall_ns // 10**9, UTC).isoformat().replace("+00:00", "Z")


def _notes(
    flight: RecordedFlight,
    record: RecordFacts,
    formations: list[Formation],
    window_s: tuple[float, float],
    window_note: str,
) -> list[str]:
    """Return what a reader has to know of the figures."""
    notes = [
        *_record_notes(flight),
        *_truth_notes(record, (flight.end or {}).get("truth_sha256")),
        window_note,
        *_formation_notes(flight, formations, window_s),
        *_fingerprint_notes(flight),
    ]
    return [note for note in notes if note]


def _ended(flight: RecordedFlight) -> str:
    """Return why the run ended; a record without an end does not show which process died."""
    if flight.end:
        return str(flight.end.get("reason", "ended"))
    at = f"{flight.last_ns / 1e9:.2f} s"
    return f"the record {'ends here at' if flight.completeness.closed else 'was cut after'} {at}: no end is on record"


def _lines(events: list[Event]) -> tuple[list[EventLine], dict[str, int]]:
    """Return the first events of every kind, and how many of each kind were left out."""
    kept: Counter[str] = Counter()
    left_out: Counter[str] = Counter()
    lines = []
    for event in events:
        if kept[event.kind] >= EVENTS_PER_KIND or len(lines) >= EVENTS_MAX:
            left_out[event.kind] += 1
            continue
        kept[event.kind] += 1
        lines.append(EventLine(event.t_ns / 1e9, event.kind, event.source, event.subject, event.text))
    return lines, dict(left_out)


def _versions(flight: RecordedFlight) -> dict[str, str]:
    world = {"world": flight.info.version} if flight.info else {}
    own = {process.name: process.version for process in flight.processes if process.version}
    return {**world, **own, "report": __version__}


def _participant(process: RecordedProcess) -> dict[str, Any]:
    return {name: getattr(process, name) for name in ("name", "role", "host", "pid", "incarnations", "left")}


def _record_notes(flight: RecordedFlight) -> list[str]:
    notes = []
    if flight.replay_of:
        notes.append(f"This is a replay of run {flight.replay_of}, no flight of its own.")
    if flight.end is None:
        notes.append("The world did not report the run's end; times and command age are worked out from the record.")
    if not flight.completeness.complete:
        notes.append(f"The record is {flight.completeness}.")
    if flight.undecoded:
        notes.append(f"{flight.undecoded} messages on record are not what their key promises and were passed over.")
    if flight.info is None:
        notes.append("world/info is not on record: scenario, seed and the order of the drones are not known.")
    elif flight.scenario is None:
        notes.append("The scenario on record cannot be read by this version.")
    return notes


def _truth_notes(record: RecordFacts, reported: str | None) -> list[str]:
    notes = []
    if record.truth_missing:
        expected = record.truth_missing + record.truth_instants
        notes.append(f"{record.truth_missing} of {expected} truth messages are not on record.")
    if reported and reported != record.truth_sha256:
        notes.append(f"The truth on record has the hash {record.truth_sha256}, the world reported {reported}.")
    return notes


def _formation_notes(flight: RecordedFlight, formations: list[Formation], window_s: tuple[float, float]) -> list[str]:
    notes = []
    judged = {formation.name for formation in formations}
    external = {track.name for track in flight.tracks if track.external}
    for cluster in flight.clusters:
        if own := [drone for drone in cluster.drones if drone in external]:
            are = f"{', '.join(own)}, whose {'body is' if len(own) == 1 else 'bodies are'} external"
            notes.append(f"Cluster {cluster.name} has {are}: nobody knows its truth, and no figure is against it.")
        if cluster.name not in judged:
            notes.append(f"Cluster {cluster.name} published no state that can be judged: no table of it.")
    for formation in formations:
        if not formation.within(window_s).any():
            notes.append(f"Cluster {formation.name} published no state inside the window.")
    if not flight.clusters:
        notes.append("The scenario has no cluster: there is no table of errors.")
    return notes


def _fingerprint_notes(flight: RecordedFlight) -> list[str]:
    own = flight.info.fingerprint if flight.info else ""
    others = [p.name for p in flight.processes if own and p.fingerprint and p.fingerprint != own]
    text = "computed with another numeric fingerprint than the world; the same bits are not promised."
    return [f"{', '.join(others)} {text}"] if others else []
