"""Makes the report of a sweep: table in; summary.json, figures/*.png and report.html out."""

from collections.abc import Callable, Container, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from zsim.errors import ReportError
from zsim_analysis.reading.window_text import span_text
from zsim_analysis.report.make_report import changed_text, date_text
from zsim_analysis.report.pages import Picture, sources, template, write_report
from zsim_analysis.report.paper import PAPER_NOTE
from zsim_analysis.sweep.intervals import RUNS_MIN, ConfidenceInterval
from zsim_analysis.sweep.points import SweepResults
from zsim_analysis.sweep.report.field_names import FieldName, field_name
from zsim_analysis.sweep.report.sweep_figures import figures
from zsim_analysis.sweep.sweep_folder import load
from zsim_analysis.sweep.sweep_summary import Distribution, FormationParameter, GridPoint, SweepSummary

POINTS_MAX = 200  # in a table of the page; sweep.parquet has all
DETAILED_MAX = 24  # points with a table of their own
OVERVIEW = ("runs", "ended well", "as planned", "engaged", "no collision", "separation (m)", "least (m)")
OWN = "figures of your own"
BLOCK_COLUMNS = 6  # of a table that fits the page, those of the grid's fields among them
Block = tuple[list[str], list[list[str]]]
PAPER_COLUMN = "paper std"
DETAILS = ("parameter", PAPER_COLUMN, "est. std", "true std", "true RMS", "true mean", "true RMS, 5 to 95 %")


def page(summary: SweepSummary, pictures: Sequence[Picture]) -> str:
    """Return report.html."""
    points = summary.flown[:POINTS_MAX]
    names = {prefix: each for prefix, each in summary.parameters.items() if f"{prefix}.true_rms" in summary.known}
    own = {column: str(field_name(column)) for column in summary.metrics if column in summary.known}
    axes = axes_of(summary)
    return template("sweep.html.j2", "zsim_analysis.sweep.report").render(
        summary=summary,
        facts=facts(summary),
        notes=notes(summary),
        runs_min=RUNS_MIN,
        overview=[*map(str, axes), *OVERVIEW],
        points=[(*values_of(point), *overview(point)) for point in points],
        parameters=list(names),
        errors=_blocks(points, axes, {f"{prefix}.true_rms": each.titled for prefix, each in names.items()}),
        metrics=_blocks(points, axes, own),
        differences=_blocks([each for each in points if each.differences], axes, differing(summary), _difference),
        reference=heading_of(summary.points[0]),
        without_data=without_data(summary),
        left_out=len(summary.flown) - len(points),
        window=windows_of(summary),
        paper_column=PAPER_COLUMN,
        details=[column for column in DETAILS if column != PAPER_COLUMN or summary.paper_std],
        tables=[(heading_of(point), details(point, names, summary.paper_std)) for point in points[:DETAILED_MAX]],
        paper_note=PAPER_NOTE if summary.paper_std else "",
        figures=sources(pictures),
    )


def axes_of(summary: SweepSummary) -> list[FieldName]:
    """Return the full names of the fields of the grid; of none, that of a column which holds all runs."""
    return [field_name(path) for path in summary.points[0].values] or [FieldName("point")]


def values_of(point: GridPoint) -> list[str]:
    """Return the values of a point, as many as `axes_of` has names."""
    return list(point.names.values()) or [point.label]


def heading_of(point: GridPoint) -> str:
    """Return the fields of a point with their values, in words."""
    return ", ".join(field_name(path).at(value) for path, value in point.names.items()) or point.label


def differing(summary: SweepSummary) -> dict[str, str]:
    """Return the titles of the columns of which points have paired differences, the user's own first."""
    errors = {f"{prefix}.true_rms": f"RMS of {each.titled}" for prefix, each in summary.parameters.items()}
    own = {column: str(field_name(column)) for column in summary.metrics}
    titles = {**own, **errors, "min_separation_m": "separation (m)"}
    known = {column for point in summary.points for column in point.differences}
    return {column: title for column, title in titles.items() if column in known}


def _blocks(
    points: Sequence[GridPoint],
    axes: Sequence[FieldName],
    titles: dict[str, str],
    cell: Callable[[GridPoint, str], str] | None = None,
) -> list[Block]:
    """Return some columns at each point, by default their means, in tables that fit the page: heads and rows."""
    cell = cell or _mean
    columns, across = list(titles), max(2, BLOCK_COLUMNS - len(axes))
    parts = np.array_split(np.array(columns, object), max(1, -(-len(columns) // across))) if columns else []
    return [
        (
            [*map(str, axes), *(titles[column] for column in part)],
            [[*values_of(point), *(cell(point, column) for column in part)] for point in points],
        )
        for part in parts
    ]


def facts(summary: SweepSummary) -> list[tuple[str, str]]:
    """Return the lines at the head of the page: pairs of a label and its value."""
    well = summary.finished - sum(summary.failed.values())
    hosts = ", ".join(f"{host} ({count})" for host, count in summary.hosts.items())
    return [
        ("Scenario", f"{summary.scenario}, seed {summary.seed}"),
        ("Changed", changed_text(summary.changed)),
        ("Varied", " ".join(summary.vary) or "nothing"),
        ("Runs", f"{summary.finished} of {summary.runs} finished, {well} of them ended well"),
        ("Date", " to ".join(dict.fromkeys(map(date_text, summary.dates or (None,))))),
        ("Flown", f"{summary.flown_wall_s:.0f} s of wall time in all, on {hosts or 'no host'}"),
        ("Window", windows_of(summary)),
        ("Fingerprint", ", ".join(summary.fingerprints) or "not known"),
        ("Version", summary.version),
    ]


def windows_of(summary: SweepSummary) -> str:
    """Return the judged windows of all runs in words."""
    return span_text(summary.windows_s) if summary.windows_s else "not known"


def marks_of(summary: SweepSummary) -> list[str]:
    """Return what the runs did not do of their plan, a line each."""
    runs = f"of {summary.finished} runs"
    lines = [f"{count} {runs} not as planned: {text}" for text, count in summary.not_as_planned.items()]
    if summary.judged_unengaged:
        lines.append(
            f"{summary.judged_unengaged} {runs} were judged while a cluster was not engaged "
            f"(window {windows_of(summary)}); give a window after the engagement, report.window_s"
        )
    return lines + [f"{count} {runs}: {text}" for text, count in summary.window_notes.items()]


def notes(summary: SweepSummary) -> list[str]:
    """Return what a reader has to know of the figures."""
    lines = []
    if summary.finished < summary.runs:
        lines.append(f"{summary.runs - summary.finished} runs are not finished; the same command goes on with them.")
    lines += [f"{count} of {summary.finished} runs failed: {reason}" for reason, count in summary.failed.items()]
    lines += marks_of(summary)
    if summary.not_engaged:
        lines.append(
            f"In {summary.not_engaged} runs that ended well a cluster was never engaged within the judged window; "
            "its errors are left out."
        )
    lines += [f"{count} of {summary.finished} runs have no {OWN}: {why}" for why, count in summary.unmeasured.items()]
    if len(summary.fingerprints) > 1:
        lines.append("The hosts compute with different numeric fingerprints; the same bits are not promised.")
    return lines


def without_data(summary: SweepSummary) -> str:
    """Return in a sentence which quantities no run has, "" where all are known."""
    errors = {each.titled: prefix for prefix, each in summary.parameters.items()}
    own = {str(field_name(column)): column for column in summary.metrics}
    kinds = (("formation errors", errors), (OWN, own))
    known = summary.known | {column.rpartition(".")[0] for column in summary.known}
    parts = [part for what, columns in kinds if (part := _missing(what, columns, known))]
    return f"No run has {', nor '.join(parts)}; they are in no table and no figure." if parts else ""


def _missing(what: str, columns: Mapping[str, str], known: Container[str]) -> str:
    names = [name for name, column in columns.items() if column not in known]
    if not names:
        return ""
    return what if len(names) == len(columns) else f"{what} of {', '.join(names)}"


def overview(point: GridPoint) -> list[str]:
    """Return one row of the table of all points, without its label."""
    separation = point.spreads.get("min_separation_m")
    least = "–" if point.least_separation_m is None else f"{point.least_separation_m:.2f}"
    engaged = "–" if point.engaged is None else str(point.engaged)
    well, planned, apart = map(_share, (point.ended_well, point.as_planned, point.without_collision))
    mean = _noted(_spread(separation), point.count("min_separation_m"))
    excluded = f"{point.excluded} excluded" if point.excluded else ""
    return [str(point.runs), well, _noted(planned, excluded), engaged, apart, mean, least]


def details(point: GridPoint, names: dict[str, FormationParameter], paper_std: dict[str, float]) -> list[list[str]]:
    """Return the table of one point, a row per formation parameter; no row where no run there has errors."""
    rows = []
    if not any(f"{prefix}.true_rms" in point.spreads for prefix in names):
        return rows
    for prefix, parameter in names.items():
        printed = paper_std.get(parameter.name)
        paper = ["" if printed is None else f"{printed:g}"] if paper_std else []
        rms = point.spreads.get(f"{prefix}.true_rms")
        span = "–" if rms is None or rms.samples else f"{rms.p5:.4f} to {rms.p95:.4f}"
        means = [_mean(point, f"{prefix}.{each}") for each in ("est_std", "true_std", "true_rms", "true_mean")]
        rows.append([parameter.titled, *paper, *means, span])
    return rows


def _mean(point: GridPoint, column: str) -> str:
    return _noted(_spread(point.spreads.get(column), 4), point.count(column))


def _difference(point: GridPoint, column: str) -> str:
    """Return the mean of paired differences with its interval, and of how many pairs it is."""
    spread = point.differences.get(column)
    return _noted(_spread(spread, 4), f"n = {spread.runs}" if spread else "")


def _noted(text: str, count: str) -> str:
    return f"{text} ({count})" if count else text


def _spread(samples: Distribution | None, digits: int = 2) -> str:
    """Return a mean with half the width of its interval, and the runs themselves where they are too few for one."""
    if samples is None:
        return "–"
    if samples.samples:
        return ", ".join(f"{each:.{digits}f}" for each in samples.samples)
    half = samples.mean.high - samples.mean.value
    return f"{samples.mean.value:.{digits}f}" + (f" ± {half:.{digits}f}" if np.isfinite(half) else "")


def _share(share: ConfidenceInterval | None) -> str:
    """Return a share in percent with its interval."""
    if share is None:
        return "–"
    return f"{100 * share.value:.3g} % [{100 * share.low:.3g}, {100 * share.high:.3g}]"


def make_sweep_report(
    directory: Path, progress: Callable[[str], None] = lambda _: None, formats: Sequence[str] = ()
) -> SweepSummary:
    """Read the finished runs, write DIR/summary.json, DIR/figures/*.png and DIR/report.html.

    The sweep may be at work meanwhile.

    Args:
        directory: of the sweep.
        progress: called with a text at each step.
        formats: of `zsim_analysis.report.FORMATS`, in which each figure is written too.

    Raises:
        RunError: it holds no sweep.
        ReportError: no run is finished yet, or the directory cannot be written.
    """
    sweep = load(directory)
    rows = sweep.rows()
    if not rows:
        raise ReportError(f"{directory}: no run of this sweep is finished yet; there is nothing to report")
    results = SweepResults(sweep.design, rows)
    summary = results.summary()
    write_report(directory, summary.json(), figures(results), partial(page, summary), progress, formats)
    return summary
