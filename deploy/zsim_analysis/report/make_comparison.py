"""Makes a comparison: records of several runs in; one HTML page, figures included, out."""

from collections.abc import Callable, Sequence
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory

from zsim.errors import ReportError
from zsim.record.record_reader import RECORD
from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.reading.formation import ParameterErrors
from zsim_analysis.report.comparison import (
    ABSENT,
    ComparedRun,
    ComparisonRow,
    clusters,
    notes,
    parameters,
    run_names,
    runs_id,
    scenario_rows,
)
from zsim_analysis.report.comparison_figures import comparison_figures
from zsim_analysis.report.make_report import Picture, facts, judge, render, sources, template

STATISTICS = ("est. std", "true std", "true RMS", "true mean")


def comparison_page(runs: Sequence[ComparedRun], pictures: Sequence[Picture]) -> str:
    """Return the page."""
    return template("comparison.html.j2").render(
        runs=runs,
        runs_id=runs_id([run.directory for run in runs]),
        facts=fact_rows(runs),
        notes=notes(runs),
        statistics=STATISTICS,
        tables={cluster: statistics_rows(runs, cluster) for cluster in clusters(runs)},
        scenario=scenario_rows(runs),
        without=[run.name for run in runs if run.flight.scenario is None],
        figures=sources(pictures),
    )


def fact_rows(runs: Sequence[ComparedRun]) -> list[ComparisonRow]:
    """Return the lines at the head of each run's own page, and more in which runs differ, a line for each label."""
    columns = [dict([*facts(run.summary), *_more(run)]) for run in runs]
    return [ComparisonRow(name, tuple(column[name] for column in columns)) for name in columns[0]]


def _more(run: ComparedRun) -> list[tuple[str, str]]:
    summary, flight = run.summary, run.flight
    versions = ", ".join(dict.fromkeys(value for name, value in summary.versions.items() if name != "report"))
    return [
        ("Drones", f"{len(flight.tracks)}"),
        ("Clusters", ", ".join(f"{c.name} of {len(c.drones)}" for c in flight.clusters) or "none"),
        ("Versions", versions or "not known"),
        ("Scenario's hash", flight.info.scenario_sha256[:16] if flight.info else "not known"),
        ("Record", f"{summary.record.messages} messages{'' if summary.record.complete else ', cut short'}"),
    ]


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


NAMED, NAMES_MAX = 3, 100  # runs whose names the page's own name holds, and characters of them
MARK, MARK_WITHIN = b": comparison</title>", 4_000  # of a page of ours, within its first bytes


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
    directories: Sequence[Path], out: Path, progress: Callable[[str], None] = lambda _: None
) -> list[ComparedRun]:
    """Read the records of several runs and write the page that compares them.

    Args:
        directories: of the runs, at least two.
        out: of the page; an earlier one is replaced when the new one is whole.
        progress: called with a text at each step.

    Raises:
        RecordError: one of them has no record, or no drone moves on it.
        ReportError: a run is given twice, or the page cannot be written, or would replace something else.
    """
    _check(directories, out)
    runs = []
    for name, directory in zip(run_names(directories), directories, strict=True):
        judged = judge(directory / RECORD, lambda text, name=name: progress(f"{name}: {text}"))
        runs.append(ComparedRun(name, directory, *judged))
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=out.parent, prefix=".report-") as folder:
            pictures = render(comparison_figures(runs), progress)
            progress("writing the page")
            page = Path(folder) / "new.html"
            page.write_text(comparison_page(runs, pictures), encoding="utf-8")
            page.replace(out)
    except OSError as error:
        raise ReportError(f"{out}: the report cannot be written ({error.strerror})") from error
    return runs


def _check(directories: Sequence[Path], out: Path) -> None:
    """Refuse to compare a run with itself, and to replace a file that is no comparison."""
    places = [directory.resolve() for directory in directories]
    for place, directory in enumerate(directories):
        if places[place] in places[:place]:
            raise ReportError(f"{directory}: is given twice; a run is compared with others")
    if out.exists() and MARK not in _head(out):
        raise ReportError(f"{out}: exists and is no comparison of runs; give --out another place")
