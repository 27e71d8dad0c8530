"""Makes the report of a run: record in; summary.json, figures/*.png and report.html out.

report.html is one page with everything in it, figures included; it loads nothing from the network.
"""

import base64
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, Template
from rich.table import Table

from zsim.errors import RecordError, ReportError
from zsim.record.run_folder import RECORD
from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.reading.flight import RecordedFlight, read_flight
from zsim_analysis.reading.formation import Formation, ParameterErrors, formations_of
from zsim_analysis.report.canvas import ReportFigure
from zsim_analysis.report.report_figures import figures
from zsim_analysis.report.summary import PAPER_NOTE, PAPER_TABLE_1, RunSummary, summarise

COLUMNS = ("parameter", "paper std", "est. std", "est. mean", "true std", "true RMS", "true mean")

Picture = tuple[ReportFigure, bytes]  # a figure and its PNG file


def judge(
    record: Path, progress: Callable[[str], None] = lambda _: None
) -> tuple[RecordedFlight, list[Formation], RunSummary]:
    """Return what a record holds and its figures of merit; nothing is written.

    Raises:
        RecordError: there is no record, or it holds no truth of any drone.
    """
    progress("reading the record")
    flight = read_flight(record)
    if all(len(track.t_ns) == 0 for track in flight.tracks):
        damaged = f" ({flight.damaged} of its chunks are damaged)" if flight.damaged else ""
        content = f"holds {flight.messages} messages and no truth" if flight.messages else "holds no message"
        raise RecordError(f"{record}: {content}{damaged}; there is nothing to report")
    progress("computing the formation's errors")
    formations = formations_of(flight)
    return flight, formations, summarise(flight, formations, record)


def make_report(directory: Path, progress: Callable[[str], None] = lambda _: None) -> RunSummary:
    """Read DIR/run.mcap, write DIR/summary.json, DIR/figures/*.png and DIR/report.html.

    Args:
        directory: the run directory.
        progress: called with a text at each step.

    Raises:
        RecordError: there is no record, or it holds no truth of any drone.
        ReportError: the directory cannot be written.
    """
    flight, formations, summary = judge(directory / RECORD, progress)
    drawings = figures(flight, formations, summary.window_s)
    write_report(directory, summary.json(), drawings, partial(page, summary), progress)
    return summary


def write_report(
    directory: Path,
    summary: bytes,
    figures: Iterable[ReportFigure],
    page: Callable[[Sequence[Picture]], str],
    progress: Callable[[str], None],
) -> None:
    """Write DIR/summary.json, DIR/figures/*.png and DIR/report.html, all or none of them.

    Args:
        directory: of the run or the sweep.
        summary: content of summary.json.
        figures: drawn one by one.
        page: makes the page of the pictures.
        progress: called with a text at each step.

    Raises:
        ReportError: the directory cannot be written.
    """
    try:
        with TemporaryDirectory(dir=directory, prefix=".report-") as folder:
            new = Path(folder)
            pictures = render(figures, progress)
            progress("writing the page")
            (new / "figures").mkdir()
            for figure, png in pictures:
                (new / "figures" / figure.name).write_bytes(png)
            (new / "summary.json").write_bytes(summary)
            (new / "report.html").write_text(page(pictures), encoding="utf-8")
            _put_in_place(new, directory)
    except OSError as error:
        raise ReportError(f"{directory}: the report cannot be written ({error.strerror})") from error


def _put_in_place(new: Path, directory: Path) -> None:
    """Move a report to its place when all of it is made: a full disk or Ctrl-C leaves no half of one."""
    (directory / "figures").mkdir(exist_ok=True)
    for path in sorted(new.rglob("*.*")):
        path.replace(directory / path.relative_to(new))


def render(figures: Iterable[ReportFigure], progress: Callable[[str], None]) -> list[Picture]:
    """Draw figures one by one; one that is rendered keeps no drawing in memory."""
    pictures = []
    for figure in figures:
        progress(f"drawing {figure.name}")
        pictures.append((figure, figure.png()))
    return pictures


def page(summary: RunSummary, pictures: Sequence[Picture]) -> str:
    """Return report.html."""
    tables = {
        name: [cells(parameter, errors, PAPER_TABLE_1.get(parameter)) for parameter, errors in cluster.errors.items()]
        for name, cluster in summary.clusters.items()
    }
    return template("page.html.j2").render(
        summary=summary,
        facts=facts(summary),
        columns=COLUMNS,
        tables=tables,
        paper_note=PAPER_NOTE,
        figures=sources(pictures),
    )


def facts(summary: RunSummary) -> list[tuple[str, str]]:
    """Return the lines at the head of the page: pairs of a label and its value."""
    age = summary.command_age_ms
    ages = f"p50 {age['p50']:.2f} ms, p99 {age['p99']:.2f} ms, max {age['max']:.2f} ms" if age else "not known"
    factor = "not known" if summary.real_time_factor is None else f"{summary.real_time_factor:.1f}"
    seed = "–" if summary.seed is None else summary.seed
    separation = summary.min_separation_m
    return [
        ("Scenario", f"{summary.scenario or 'not known'}, seed {seed}"),
        ("Mode", summary.mode or "not known"),
        ("Ended", summary.ended),
        ("Simulated", f"{summary.sim_s:.2f} s in {summary.wall_s:.2f} s of wall time, real-time factor {factor}"),
        ("Deadlines missed", _misses(summary)),
        ("Command age", ages),
        ("Least separation", "no two drones in the air" if separation is None else f"{separation:.2f} m in truth"),
        ("Truth", f"SHA-256 {summary.truth_sha256}"),
        ("Fingerprint", summary.fingerprint or "not known"),
    ]


def _misses(summary: RunSummary) -> str:
    if summary.deadline_misses is None:
        return "not known"
    by = ", ".join(f"{name} {count}" for name, count in summary.deadline_misses_by.items() if count)
    return f"{summary.deadline_misses} of {summary.deadlines or 0}{f' ({by})' if by else ''}"


def template(name: str, package: str = "zsim_analysis.report") -> Template:
    """Return a page's template; what it includes may stand beside it or here."""
    return Environment(
        loader=ChoiceLoader([PackageLoader(package, "."), PackageLoader("zsim_analysis.report", ".")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    ).get_template(name)


def sources(pictures: Iterable[Picture]) -> list[tuple[ReportFigure, str]]:
    """Return each figure with its PNG file as a data URI, which needs no file beside the page."""
    return [(figure, "data:image/png;base64," + base64.b64encode(png).decode()) for figure, png in pictures]


def table(summary: RunSummary, cluster: str | None = None) -> Table:
    """Return the errors of one cluster, by default of the first, beside the paper's Table I, for the terminal."""
    name = cluster or next(iter(summary.clusters), None)
    start, end = summary.window_s
    whose = f" of {name}" if name else ""
    title = f"Formation errors{whose} from {start:g} to {end:g} s, beside Table I of the paper"
    shown = Table(title=title, caption="est. = estimate − desired, true = truth − desired", title_justify="left")
    for column in COLUMNS:
        shown.add_column(column, justify="left" if column == "parameter" else "right")
    for parameter, errors in (summary.clusters[name].errors if name else {}).items():
        shown.add_row(*cells(parameter, errors, summary.paper_table_1.get(parameter)))
    return shown


def cells(parameter: str, errors: ParameterErrors, paper_std: float | None) -> list[str]:
    """Return one row of the table of errors, on the page and on the terminal."""
    values = (errors.est_std, errors.est_mean, errors.true_std, errors.true_rms, errors.true_mean)
    return [
        f"{parameter} ({unit(parameter)})",
        "" if paper_std is None else f"{paper_std:g}",
        *("–" if value is None else f"{value:.4f}" for value in values),
    ]
