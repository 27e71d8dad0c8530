"""The comparison of several runs: the differences of their scenarios and results, and their page."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from hashlib import sha256
from os.path import relpath
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from zsim.errors import ReportError
from zsim.output_folder import RECORD
from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.reading.shortfall import span_text
from zsim_analysis.report.comparison_figures import UNPLANNED, ComparedRun, clusters, comparison_figures, parameters
from zsim_analysis.report.make_report import Picture, facts, sources, template, write_page
from zsim_analysis.report.summary import STATISTICS, judge

ABSENT = "–"
RUNS_PER_TABLE = 2  # side by side with all their statistics: as many as fit the page
THERE = "there"  # cell of a named item, such as a drone, that another run does not have
NAMED, NAMES_MAX = 3, 100  # runs in the page's file name, and characters of their names
MARK, MARK_WITHIN = b": comparison</title>", 4_000  # identifies our pages, within their first bytes


def compare(
    directories: Sequence[Path],
    out: Path,
    progress: Callable[[str], None] = lambda _: None,
    formats: Sequence[str] = (),
) -> list[ComparedRun]:
    """Read the records of several runs and write the page that compares them; arguments as of `write_page`.

    Raises:
        RecordError: one of them has no record, or no truth of any drone on it.
        ReportError: a run is given twice, or the page cannot be written, or would replace something else.
    """
    places = [directory.resolve() for directory in directories]
    for number, directory in enumerate(directories):
        if places[number] in places[:number]:
            raise ReportError(f"{directory}: is given twice; a run is compared with others")
    if out.exists() and MARK not in _head(out):
        raise ReportError(f"{out}: exists and is not a comparison of runs; give --out another path")
    runs = []
    for name, directory in zip(run_names(directories), directories, strict=True):
        judged = judge(directory / RECORD, lambda text, name=name: progress(f"{name}: {text}"))
        runs.append(ComparedRun(name, directory, *judged))
    write_page(out, comparison_figures(runs), partial(comparison_page, runs), progress, formats)
    return runs


def comparison_path(directories: Sequence[Path]) -> Path:
    """Return the default path of a comparison: beside the first run, with a unique name."""
    names = [name.replace("/", "-") for name in run_names(directories)]
    more = f"-and-{len(names) - NAMED}-more" if len(names) > NAMED else ""
    stem = f"compare-{'-'.join(names[:NAMED])[:NAMES_MAX]}{more}"
    folder, own = directories[0].resolve().parent, runs_id(directories).encode()
    path, number = folder / f"{stem}.html", 1
    while MARK in (head := _head(path)) and own not in head:
        number += 1
        path = folder / f"{stem}-{number}.html"
    return path


def _head(page: Path) -> bytes:
    """Return the first bytes of a file, empty if it does not exist."""
    if not page.is_file():
        return b""
    with page.open("rb") as file:
        return file.read(MARK_WITHIN)


def run_names(directories: Sequence[Path]) -> list[str]:
    """Return short unique names: folder names with as many parents as needed, or else with a number.

    Bytes that are not UTF-8 become question marks, since matplotlib cannot draw them.
    """
    paths = [directory.resolve() for directory in directories]
    longest = max(len(path.parts) for path in paths)
    for depth in range(1, longest + 1):
        names = ["/".join(path.parts[-depth:]).encode(errors="replace").decode() for path in paths]
        if len(set(names)) == len(names):
            return names
    return [f"{path.name} ({number})" for number, path in enumerate(paths, start=1)]


def runs_id(directories: Sequence[Path]) -> str:
    """Return an identifier of these runs in this order; it does not change if their folders are moved together."""
    paths = [directory.resolve() for directory in directories]
    places = "\0".join(relpath(path, paths[0].parent) for path in paths)
    return sha256(places.encode(errors="surrogateescape")).hexdigest()[:16]


def comparison_page(runs: Sequence[ComparedRun], pictures: Sequence[Picture]) -> str:
    groups = [runs[start : start + RUNS_PER_TABLE] for start in range(0, len(runs), RUNS_PER_TABLE)]
    return template("comparison.html.j2").render(
        runs=runs,
        runs_id=runs_id([run.directory for run in runs]),
        facts=fact_rows(runs),
        notes=notes(runs),
        statistics=list(STATISTICS),
        unplanned=UNPLANNED if any(not run.summary.as_planned for run in runs) else "",
        tables={name: [(group, statistics_rows(group, name)) for group in groups] for name in clusters(runs)},
        scenario=scenario_rows(runs),
        without=[run.name for run in runs if run.flight.scenario is None],
        figures=sources(pictures),
    )


class ComparisonRow(NamedTuple):
    """A row of a table with a cell per run."""

    name: str
    cells: tuple[str, ...]

    @property
    def differs(self) -> bool:
        return len(set(self.cells)) > 1


def fact_rows(runs: Sequence[ComparedRun]) -> list[ComparisonRow]:
    """Return the facts of each run's page, and further ones that may differ, a row for each label."""
    columns = [
        dict(facts(run.summary))
        | {
            "Drones": f"{len(run.flight.tracks)}",
            "Clusters": ", ".join(f"{c.name} of {len(c.drones)}" for c in run.flight.clusters) or "none",
            "Scenario's hash": run.flight.info.scenario_sha256[:16] if run.flight.info else "not known",
            "Messages": f"{run.summary.record.messages}",
        }
        for run in runs
    ]
    names = dict.fromkeys(name for column in sorted(columns, key=len, reverse=True) for name in column)
    return [ComparisonRow(name, tuple(column.get(name, ABSENT) for column in columns)) for name in names]


def statistics_rows(runs: Sequence[ComparedRun], cluster: str) -> list[ComparisonRow]:
    """Return a row per variable of a cluster, with a cell for each of the STATISTICS of each run."""
    rows = []
    for name in parameters(runs, cluster):
        judged = [run.summary.clusters.get(cluster) for run in runs]
        errors = [each.errors.get(name) if each else None for each in judged]
        values = [getattr(each, statistic, None) for each in errors for statistic in STATISTICS.values()]
        cells = tuple(ABSENT if value is None else f"{value:.4f}" for value in values)
        rows.append(ComparisonRow(f"{name} ({unit(name)})", cells))
    return rows


def scenario_rows(runs: Sequence[ComparedRun]) -> list[ComparisonRow]:
    """Return the fields in which the resolved scenarios differ, by path; a field missing in a run is ABSENT there.

    Named items that some runs lack, such as drones, are listed without their fields.
    """
    flat = [dict(flattened(msgspec.to_builtins(run.flight.scenario))) if run.flight.scenario else {} for run in runs]
    paths = dict.fromkeys(path for each in flat for path in each)
    partial_paths = [path for path in paths if any(path not in each for each in flat)]
    items = tuple(f"{path}." for path in partial_paths if any(each.get(path) == THERE for each in flat))
    return [
        ComparisonRow(path, tuple(_text(each[path]) if path in each else ABSENT for each in flat))
        for path in paths
        if not path.startswith(items)
        and (path in partial_paths or any(each[path] != flat[0][path] for each in flat))  # their texts may be alike
    ]


def flattened(value: Any, path: str = "") -> Iterable[tuple[str, Any]]:
    """Yield path and value of every leaf; named items are identified by their names, independent of order.

    Items without names are identified by their numbers, each with all its fields as one value; empty lists are omitted.
    """
    if isinstance(value, Mapping):
        for name, item in value.items():
            yield from flattened(item, f"{path}.{name}" if path else str(name))
    elif isinstance(value, list | tuple) and value and all(isinstance(item, Mapping) for item in value):
        for number, item in enumerate(value):
            if "name" in item:
                yield f"{path}.{item['name']}", THERE
                yield from flattened(item, f"{path}.{item['name']}")
            else:
                yield f"{path}.{number}", item
    elif value != [] and value != ():
        yield path, value


def _text(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_text, value))}]"
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_text(item)}" for name, item in value.items() if item is not None)
    return "none" if value is None else str(value)


def notes(runs: Sequence[ComparedRun]) -> list[str]:
    """Return remarks: shortfalls, identical flights, drones and clusters of only some runs, notes of each run."""
    lines = [
        f"{run.name}: {'not as planned: ' * each.fails}{each.text}" for run in runs for each in run.summary.shortfalls
    ]
    by_hash: dict[str, list[str]] = {}
    for run in runs:
        by_hash.setdefault(run.summary.truth_sha256, []).append(run.name)
    lines += [f"{_listed(names)} flew the same bits." for names in by_hash.values() if len(names) > 1]
    lines += _missing("Drone", {run.name: [track.name for track in run.flight.tracks] for run in runs})
    lines += _missing("Cluster", {run.name: [formation.name for formation in run.formations] for run in runs})
    for cluster in clusters(runs):
        if len({each.names for run in runs if (each := run.formation(cluster))}) > 1:
            lines.append(f"Cluster {cluster} does not have the same variables in all runs; each has its own.")
    if len({run.summary.window_s for run in runs}) > 1:
        ranges = "; ".join(f"{run.name}: {span_text(run.summary.window_s)}" for run in runs)
        lines.append(f"The windows of the statistics differ ({ranges}).")
    return [*lines, *(f"{run.name}: {note}" for run in runs for note in run.summary.notes)]


def _missing(what: str, there: Mapping[str, Sequence[str]]) -> list[str]:
    """Return a line for each set of drones or clusters that only some runs have."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for name in dict.fromkeys(name for names in there.values() for name in names):
        having = tuple(run for run, names in there.items() if name in names)
        if len(having) < len(there):
            groups.setdefault(having, []).append(name)
    return [
        f"{what}{'s' * (len(names) > 1)} {_listed(names)}: in {_listed(having)} only."
        for having, names in groups.items()
    ]


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
