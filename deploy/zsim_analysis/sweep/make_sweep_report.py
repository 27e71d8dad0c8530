"""Makes the report of a sweep: table in; summary.json, figures/*.png and report.html out."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.table import Table
from rich.text import Text

from zsim.errors import ReportError, printable
from zsim.runtime.progress import cell
from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.report.pages import Picture, sources, template, write_report
from zsim_analysis.report.paper import PAPER_NOTE
from zsim_analysis.sweep.intervals import ConfidenceInterval
from zsim_analysis.sweep.points import (
    Distribution,
    FormationParameter,
    GridPoint,
    SweepResults,
    SweepSummary,
)
from zsim_analysis.sweep.sweep_figures import figures
from zsim_analysis.sweep.sweep_folder import load

POINTS_MAX = 200  # in a table of the page; sweep.parquet has all
DETAILED_MAX = 24  # points with a table of their own
OVERVIEW = ("runs", "ended well", "as planned", "engaged", "no collision", "separation (m)", "least (m)")
PAPER_COLUMN = "paper std"
DETAILS = ("parameter", PAPER_COLUMN, "est. std", "true std", "true RMS", "true mean", "true RMS, 5 to 95 %")


def page(summary: SweepSummary, pictures: Sequence[Picture]) -> str:
    """Return report.html."""
    shown = summary.flown[:POINTS_MAX]
    known = {column for point in shown for column in point.spreads}
    names = {prefix: each for prefix, each in summary.parameters.items() if f"{prefix}.true_rms" in known}
    return template("sweep.html.j2", "zsim_analysis.sweep").render(
        summary=summary,
        facts=facts(summary),
        notes=notes(summary),
        overview=[summary.grid, *OVERVIEW],
        points=[(point.label, *overview(point)) for point in shown],
        parameters=[_titled(each) for each in names.values()],
        errors=[(point.label, *(_mean(point, f"{p}.true_rms") for p in names)) for point in shown],
        left_out=len(summary.flown) - len(shown),
        window=window_text(summary),
        paper_column=PAPER_COLUMN,
        details=[column for column in DETAILS if column != PAPER_COLUMN or summary.paper_std],
        tables=[(point, details(point, names, summary.paper_std)) for point in shown[:DETAILED_MAX]],
        paper_note=PAPER_NOTE if summary.paper_std else "",
        figures=sources(pictures),
    )


def facts(summary: SweepSummary) -> list[tuple[str, str]]:
    """Return the lines at the head of the page: pairs of a label and its value."""
    well = summary.finished - sum(summary.failed.values())
    hosts = ", ".join(f"{host} ({count})" for host, count in summary.hosts.items())
    return [
        ("Scenario", f"{summary.scenario}, seed {summary.seed}"),
        ("Varied", " ".join(summary.vary) or "nothing"),
        ("Runs", f"{summary.finished} of {summary.runs} finished, {well} of them ended well"),
        ("Flown", f"{summary.flown_wall_s:.0f} s of wall time in all, on {hosts or 'no host'}"),
        ("Window", window_text(summary)),
        ("Fingerprint", ", ".join(summary.fingerprints) or "not known"),
        ("Version", summary.version),
    ]


def window_text(summary: SweepSummary) -> str:
    """Return the judged windows of all runs in words."""
    return "{:g} to {:g} s".format(*summary.windows_s) if summary.windows_s else "not known"


def marks_of(summary: SweepSummary) -> list[str]:
    """Return what the runs did not do of their plan, a line each."""
    runs = f"of {summary.finished} runs"
    lines = [f"{count} {runs} not as planned: {text}" for text, count in summary.not_as_planned.items()]
    if summary.judged_unengaged:
        lines.append(
            f"{summary.judged_unengaged} {runs} were judged while a cluster was not engaged "
            f"(window {window_text(summary)}); give a window after the engagement, report.window_s"
        )
    return lines


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
    if len(summary.fingerprints) > 1:
        lines.append("The hosts compute with different numeric fingerprints; the same bits are not promised.")
    return lines


def overview(point: GridPoint) -> list[str]:
    """Return one row of the table of all points, without its label."""
    separation = point.spreads.get("min_separation_m")
    least = "–" if separation is None else f"{separation.least:.2f}"
    engaged = "–" if point.engaged is None else str(point.engaged)
    well, planned, apart = map(_share, (point.ended_well, point.as_planned, point.without_collision))
    return [str(point.runs), well, planned, engaged, apart, _spread(separation), least]


def details(point: GridPoint, names: dict[str, FormationParameter], paper_std: dict[str, float]) -> list[list[str]]:
    """Return the table of one point, a row per formation parameter."""
    rows = []
    for prefix, parameter in names.items():
        printed = paper_std.get(parameter.name)
        paper = ["" if printed is None else f"{printed:g}"] if paper_std else []
        rms = point.spreads.get(f"{prefix}.true_rms")
        span = "–" if rms is None else f"{rms.p5:.4f} to {rms.p95:.4f}"
        means = [_mean(point, f"{prefix}.{each}") for each in ("est_std", "true_std", "true_rms", "true_mean")]
        rows.append([_titled(parameter), *paper, *means, span])
    return rows


def _titled(parameter: FormationParameter) -> str:
    return parameter.labelled(f"{parameter.name} ({unit(parameter.name)})")


def _mean(point: GridPoint, column: str) -> str:
    return _spread(point.spreads.get(column), 4)


def _spread(samples: Distribution | None, digits: int = 2) -> str:
    """Return a mean with half the width of its interval."""
    if samples is None:
        return "–"
    half = samples.mean.high - samples.mean.value
    return f"{samples.mean.value:.{digits}f}" + (f" ± {half:.{digits}f}" if np.isfinite(half) else "")


def _share(share: ConfidenceInterval | None) -> str:
    """Return a share in percent with its interval."""
    if share is None:
        return "–"
    return f"{100 * share.value:.3g} % [{100 * share.low:.3g}, {100 * share.high:.3g}]"


SHOWN_MAX = 40  # points on a terminal
ERRORS_MAX = 9  # parameters on a terminal of 80 columns


def make_sweep_report(directory: Path, progress: Callable[[str], None] = lambda _: None) -> SweepSummary:
    """Read the finished runs, write DIR/summary.json, DIR/figures/*.png and DIR/report.html.

    The sweep may be at work meanwhile.

    Args:
        directory: of the sweep.
        progress: called with a text at each step.

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
    write_report(directory, summary.json(), figures(results), partial(page, summary), progress)
    return summary


def terminal_text(summary: SweepSummary) -> Group:
    """Return what the runs did not do, the table of all points, and that of the errors, for the terminal."""
    marks = [Text(printable(mark), style="bold red") for mark in marks_of(summary)]
    names = errors_of_terminal(summary)
    return Group(*marks, table(summary), *([errors_table(summary, names)] if names else []))


def table(summary: SweepSummary) -> Table:
    """Return the table of all points, for the terminal."""
    caption = f"± and [ ]: {100 * summary.level:g} % confidence intervals"
    return _terminal_table(
        summary, f"{summary.scenario}: {summary.finished} of {summary.runs} runs", caption, OVERVIEW, overview
    )


def errors_of_terminal(summary: SweepSummary) -> dict[str, FormationParameter]:
    """Return the parameters whose errors stand on a terminal: the paper's, else the first ones that are no heading."""
    known = {column for point in summary.flown for column in point.spreads}
    flown = {prefix: each for prefix, each in summary.parameters.items() if f"{prefix}.true_rms" in known}
    first = dict.fromkeys(each.cluster for each in flown.values())
    own = {prefix: each for prefix, each in flown.items() if each.cluster == next(iter(first), None)}
    return dict([(prefix, each) for prefix, each in own.items() if not each.name.startswith("phi_")][:ERRORS_MAX])


def errors_table(summary: SweepSummary, names: dict[str, FormationParameter]) -> Table:
    """Return the means of the RMS errors at each point, for the terminal."""
    cluster = next(iter(names.values())).cluster
    title = (
        f"RMS of truth − desired{f' of {cluster}' if cluster else ''} from {window_text(summary)}, means over the runs"
    )
    return _terminal_table(
        summary,
        title,
        "in m; angles in rad",
        [each.name for each in names.values()],
        lambda point: [_short_mean(point, f"{prefix}.true_rms") for prefix in names],
    )


def _short_mean(point: GridPoint, column: str) -> str:
    samples = point.spreads.get(column)
    return "–" if samples is None else f"{samples.mean.value:.3f}"


def _terminal_table(
    summary: SweepSummary,
    title: str,
    caption: str,
    columns: Sequence[str],
    cells: Callable[[GridPoint], Sequence[str]],
) -> Table:
    """Return a table with a row per point, no more of them than a terminal shows; no name is broken."""
    shown = Table(title=cell(title), caption=cell(caption), title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    shown.add_column(cell(summary.grid), no_wrap=True)
    for column in columns:
        shown.add_column(column, justify="right")
    for point in summary.flown[:SHOWN_MAX]:
        shown.add_row(cell(point.label), *cells(point))
    if len(summary.flown) > SHOWN_MAX:
        shown.add_row(f"… and {len(summary.flown) - SHOWN_MAX} more")
    return shown
