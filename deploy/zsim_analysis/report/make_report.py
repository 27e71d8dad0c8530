"""Makes the report of a run: record in; summary.json, figures/*.png and report.html out. Makes comparisons of several.

A page has everything in it, figures included; it loads nothing from the network.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import count
from pathlib import Path

from zsim.errors import RecordError, ReportError
from zsim.output_folder import RECORD
from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.reading.driver_links import link_text
from zsim_analysis.reading.flight import read_flight
from zsim_analysis.reading.formation import Formation, ParameterErrors, formations_of
from zsim_analysis.reading.recorded_flight import RecordedFlight
from zsim_analysis.reading.window_text import seconds_text, span_text
from zsim_analysis.report.comparison import (
    ABSENT,
    UNPLANNED,
    ComparedRun,
    ComparisonRow,
    clusters,
    notes,
    parameters,
    run_names,
    runs_id,
    scenario_rows,
    table_groups,
)
from zsim_analysis.report.figures.comparison_figures import comparison_figures
from zsim_analysis.report.figures.report_figures import figures
from zsim_analysis.report.pages import Picture, sources, template, write_page, write_report
from zsim_analysis.report.paper import PAPER_NOTE
from zsim_analysis.report.summary import EventLine, RunSummary, summarise
from zsim_analysis.report.tables import PAPER_COLUMN, error_table

STATISTICS = ("est. std", "true std", "true RMS", "true mean")
FAULTS_MAX = 6  # at the head of a page
NAMED, NAMES_MAX = 3, 100  # runs whose names the page's own name holds, and characters of them
MARK, MARK_WITHIN = b": comparison</title>", 4_000  # of a page of ours, within its first bytes


def judge(
    record: Path, progress: Callable[[str], None] = lambda _: None, answers: bool = False
) -> tuple[RecordedFlight, list[Formation], RunSummary]:
    """Return what a record holds, with the drones' estimates and commands if asked for, and its figures of merit.

    Raises:
        RecordError: there is no record, or it holds no truth of any drone.
    """
    progress("reading the record")
    flight = read_flight(record, answers)
    if all(len(track.t_ns) == 0 for track in flight.tracks):
        content = f"holds {flight.messages} messages and no truth" if flight.messages else "holds no message"
        raise RecordError(f"{record}: {content} ({flight.completeness}); there is nothing to report")
    progress("computing the formation's errors")
    formations = formations_of(flight)
    return flight, formations, summarise(flight, formations, record)


def make_report(
    directory: Path, progress: Callable[[str], None] = lambda _: None, formats: Sequence[str] = ()
) -> RunSummary:
    """Read DIR/run.mcap, write DIR/summary.json, DIR/figures/*.png and DIR/report.html.

    Args:
        directory: the run directory.
        progress: called with a text at each step.
        formats: of `zsim_analysis.report.FORMATS`, in which each figure is written too.

    Raises:
        RecordError: there is no record, or it holds no truth of any drone.
        ReportError: the directory cannot be written.
    """
    flight, formations, summary = judge(directory / RECORD, progress, answers=True)
    drawings = figures(flight, formations, summary)
    write_report(directory, summary.json(), drawings, partial(page, summary), progress, formats)
    return summary


def page(summary: RunSummary, pictures: Sequence[Picture]) -> str:
    """Return report.html."""
    return template("page.html.j2").render(
        summary=summary,
        facts=facts(summary),
        window=span_text(summary.window_s),
        paper_column=PAPER_COLUMN,
        tables={name: error_table(cluster) for name, cluster in summary.clusters.items()},
        paper_note=PAPER_NOTE if any(cluster.paper_std for cluster in summary.clusters.values()) else "",
        figures=sources(pictures),
    )


def facts(summary: RunSummary) -> list[tuple[str, str]]:
    """Return the lines at the head of the page: pairs of a label and its value."""
    age = summary.command_age_ms
    ages = f"p50 {age['p50']:.2f} ms, p99 {age['p99']:.2f} ms, max {age['max']:.2f} ms" if age else "not known"
    factor = "not known" if summary.real_time_factor is None else f"{summary.real_time_factor:.1f}"
    seed = "–" if summary.seed is None else summary.seed
    separation = summary.min_separation_m
    versions = dict.fromkeys(version for name, version in summary.versions.items() if name != "report")
    return [
        ("Scenario", f"{summary.scenario or 'not known'}, seed {seed}"),
        ("Changed", changed_text(summary.changed)),
        ("Date", date_text(summary.date)),
        ("Version", ", ".join(versions) or "not known"),
        ("Mode", summary.mode or "not known"),
        ("Ended", summary.ended),
        ("Flown as planned", _planned(summary)),
        *(("Injected faults", text) for text in _faults(summary.events)),
        ("Record", summary.record.state),
        ("Simulated", f"{summary.sim_s:.2f} s in {summary.wall_s:.2f} s of wall time, real-time factor {factor}"),
        ("Deadlines missed", _misses(summary)),
        ("Command age", ages),
        *((f"Link of {drone}", link_text(link)) for drone, link in summary.links.items()),
        ("Least separation", "no two drones in the air" if separation is None else f"{separation:.2f} m in truth"),
        ("Truth", f"SHA-256 {summary.truth_sha256}"),
        ("Fingerprint", summary.fingerprint or "not known"),
    ]


def changed_text(changed: Sequence[str] | None) -> str:
    """Return what was changed of a scenario's file, in words."""
    return "not known" if changed is None else ", ".join(changed) or "nothing: as in its file"


def date_text(date: str | None) -> str:
    """Return a date of ISO 8601 as a reader has it, to the minute."""
    return f"{date[:16].replace('T', ' ')} UTC" if date else "not known"


def _planned(summary: RunSummary) -> str:
    if not summary.as_planned:
        return "no"
    kinds = {each.kind for each in summary.shortfalls}
    parts = {
        "as far as the run went": "early" in kinds,
        "but for what others asked or flew": bool(kinds & {"override", "request"}),
        "but for a short hold": "held" in kinds,
    }
    return ", ".join(part for part, holds in parts.items() if holds) or "yes"


def _faults(events: Sequence[EventLine]) -> Iterator[str]:
    """Yield in one text which faults were injected, and when, if any were."""
    begun = [event for event in events if event.kind == "fault"]
    faults = [f"{event.text.removesuffix(' begins')} at {seconds_text(event.t_s)} s" for event in begun[:FAULTS_MAX]]
    more = [f"{len(begun) - FAULTS_MAX} more"] if len(begun) > FAULTS_MAX else []
    if faults:
        yield ", ".join([*faults, *more])


def _misses(summary: RunSummary) -> str:
    if summary.deadline_misses is None:
        return "not known"
    by = ", ".join(f"{name} {count}" for name, count in summary.deadline_misses_by.items() if count)
    return f"{summary.deadline_misses} of {summary.deadlines or 0}{f' ({by})' if by else ''}"


def comparison_page(runs: Sequence[ComparedRun], pictures: Sequence[Picture]) -> str:
    """Return the page."""
    return template("comparison.html.j2").render(
        runs=runs,
        runs_id=runs_id([run.directory for run in runs]),
        facts=fact_rows(runs),
        notes=notes(runs),
        statistics=STATISTICS,
        unplanned=UNPLANNED if any(not run.summary.as_planned for run in runs) else "",
        tables={cluster: _statistics_tables(runs, cluster) for cluster in clusters(runs)},
        scenario=scenario_rows(runs),
        without=[run.name for run in runs if run.flight.scenario is None],
        figures=sources(pictures),
    )


def fact_rows(runs: Sequence[ComparedRun]) -> list[ComparisonRow]:
    """Return the lines at the head of each run's own page, and more in which runs differ, a line for each label."""
    columns = [dict([*facts(run.summary), *_more(run)]) for run in runs]
    names = dict.fromkeys(name for column in sorted(columns, key=len, reverse=True) for name in column)
    return [ComparisonRow(name, tuple(column.get(name, ABSENT) for column in columns)) for name in names]


def _more(run: ComparedRun) -> list[tuple[str, str]]:
    summary, flight = run.summary, run.flight
    return [
        ("Drones", f"{len(flight.tracks)}"),
        ("Clusters", ", ".join(f"{c.name} of {len(c.drones)}" for c in flight.clusters) or "none"),
        ("Scenario's hash", flight.info.scenario_sha256[:16] if flight.info else "not known"),
        ("Messages", f"{summary.record.messages}"),
    ]


def _statistics_tables(
    runs: Sequence[ComparedRun], cluster: str
) -> list[tuple[Sequence[ComparedRun], list[ComparisonRow]]]:
    """Return the runs and the lines of each table of a cluster's errors."""
    return [(group, statistics_rows(group, cluster)) for group in table_groups(runs)]


def statistics_rows(runs: Sequence[ComparedRun], cluster: str) -> list[ComparisonRow]:
    """Return a line per variable of a cluster, with as many cells for each run as there are STATISTICS."""
    rows = []
    for name in parameters(runs, cluster):
        cells: list[str] = []
        for run in runs:
            judged = run.summary.clusters.get(cluster)
            cells += _cells(judged.errors.get(name) if judged else None)
        rows.append(ComparisonRow(f"{name} ({unit(name)})", tuple(cells)))
    return rows


def _cells(errors: ParameterErrors | None) -> list[str]:
    if errors is None:
        return [ABSENT] * len(STATISTICS)
    values = (errors.est_std, errors.true_std, errors.true_rms, errors.true_mean)
    return [ABSENT if value is None else f"{value:.4f}" for value in values]


def comparison_path(directories: Sequence[Path]) -> Path:
    """Return where the comparison of runs is written: beside the first of them, by a name that no other one has."""
    names = [name.replace("/", "-") for name in run_names(directories)]
    more = f"-and-{len(names) - NAMED}-more" if len(names) > NAMED else ""
    stem = f"compare-{'-'.join(names[:NAMED])[:NAMES_MAX]}{more}"
    folder = directories[0].resolve().parent
    numbered = (folder / f"{stem}{'' if number == 1 else f'-{number}'}.html" for number in count(1))
    return next(path for path in numbered if not _is_of_other_runs(path, directories))


def _is_of_other_runs(page: Path, directories: Sequence[Path]) -> bool:
    """Return whether an existing page compares other runs than these."""
    head = _head(page)
    return MARK in head and runs_id(directories).encode() not in head


def _head(page: Path) -> bytes:
    """Return the beginning of a file, empty where there is none."""
    if not page.is_file():
        return b""
    with page.open("rb") as file:
        return file.read(MARK_WITHIN)


def compare(
    directories: Sequence[Path],
    out: Path,
    progress: Callable[[str], None] = lambda _: None,
    formats: Sequence[str] = (),
) -> list[ComparedRun]:
    """Read the records of several runs and write the page that compares them.

    Args:
        directories: of the runs, at least two.
        out: of the page; an earlier one is replaced when the new one is whole.
        progress: called with a text at each step.
        formats: of `zsim_analysis.report.FORMATS`, in which each figure is written into a folder beside the page.

    Raises:
        RecordError: one of them has no record, or no drone moves on it.
        ReportError: a run is given twice, or the page cannot be written, or would replace something else.
    """
    _check(directories, out)
    runs = []
    for name, directory in zip(run_names(directories), directories, strict=True):
        judged = judge(directory / RECORD, lambda text, name=name: progress(f"{name}: {text}"))
        runs.append(ComparedRun(name, directory, *judged))
    write_page(out, comparison_figures(runs), partial(comparison_page, runs), progress, formats)
    return runs


def _check(directories: Sequence[Path], out: Path) -> None:
    """Refuse to compare a run with itself, and to replace a file that is no comparison."""
    places = [directory.resolve() for directory in directories]
    for place, directory in enumerate(directories):
        if places[place] in places[:place]:
            raise ReportError(f"{directory}: is given twice; a run is compared with others")
    if out.exists() and MARK not in _head(out):
        raise ReportError(f"{out}: exists and is no comparison of runs; give --out another place")
