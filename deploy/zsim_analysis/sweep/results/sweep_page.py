"""report.html of a sweep: tables per point of the grid, distributions, and what the intervals mean."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.report import paper
from zsim_analysis.report.figures.run_figures import Named
from zsim_analysis.report.report_page import data_uri, template
from zsim_analysis.sweep.results.intervals import Interval
from zsim_analysis.sweep.results.points import Parameter, Point, Spread, SweepSummary

POINTS_MAX = 200  # in a table of the page; sweep.parquet has all
DETAILED_MAX = 24  # points with a table of their own
OVERVIEW = ("runs", "ended well", "engaged", "no collision", "separation (m)", "least (m)")
DETAILS = ("parameter", "paper std", "est. std", "true std", "true RMS", "true mean", "true RMS, 5 to 95 %")


def page(summary: SweepSummary, figures: Sequence[Named], directory: Path) -> str:
    """Return the page; `directory` holds the figures' files."""
    shown = summary.flown[:POINTS_MAX]
    known = {column for point in shown for column in point.spreads}
    names = {prefix: each for prefix, each in summary.parameters.items() if f"{prefix}.true_rms" in known}
    return template("sweep.html.j2", "zsim_analysis.sweep.results").render(
        summary=summary,
        facts=facts(summary),
        notes=notes(summary),
        overview=[summary.grid, *OVERVIEW],
        points=[(point.label, *overview(point)) for point in shown],
        parameters=[_titled(each) for each in names.values()],
        errors=[(point.label, *(_mean(point, f"{p}.true_rms") for p in names)) for point in shown],
        left_out=len(summary.flown) - len(shown),
        details=DETAILS,
        tables=[(point, details(point, names)) for point in shown[:DETAILED_MAX]],
        paper_note=paper.NOTE,
        figures=[(figure, data_uri(directory / figure.name)) for figure in figures],
    )


def facts(summary: SweepSummary) -> list[tuple[str, str]]:
    """Return what the head of the page says, as pairs of a word and its value."""
    well = summary.finished - sum(summary.failed.values())
    hosts = ", ".join(f"{host} ({count})" for host, count in summary.hosts.items())
    return [
        ("Scenario", f"{summary.scenario}, seed {summary.seed}"),
        ("Varied", " ".join(summary.vary) or "nothing"),
        ("Runs", f"{summary.finished} of {summary.runs} finished, {well} of them ended well"),
        ("Flown", f"{summary.flown_wall_s:.0f} s of wall time in all, on {hosts or 'no host'}"),
        ("Fingerprint", ", ".join(summary.fingerprints) or "not known"),
        ("Version", summary.version),
    ]


def notes(summary: SweepSummary) -> list[str]:
    """Return what a reader has to know of the figures."""
    found = []
    if summary.finished < summary.runs:
        found.append(f"{summary.runs - summary.finished} runs are not finished; the same command goes on with them.")
    found += [f"{count} of {summary.finished} runs failed: {reason}" for reason, count in summary.failed.items()]
    if summary.not_engaged:
        found.append(
            f"In {summary.not_engaged} runs that ended well a cluster was never engaged within the judged window; "
            "its errors are left out."
        )
    if len(summary.fingerprints) > 1:
        found.append("The hosts compute with different numeric fingerprints; the same bits are not promised.")
    return found


def overview(point: Point) -> list[str]:
    """Return one row of the table of all points, without its label."""
    separation = point.spreads.get("min_separation_m")
    least = "–" if separation is None else f"{separation.least:.2f}"
    engaged = "–" if point.engaged is None else str(point.engaged)
    well, apart = _share(point.ended_well), _share(point.without_collision)
    return [str(point.runs), well, engaged, apart, _spread(separation), least]


def details(point: Point, names: dict[str, Parameter]) -> list[list[str]]:
    """Return the table of one point, a row per formation parameter."""
    rows = []
    for prefix, parameter in names.items():
        printed = paper.TABLE_1.get(parameter.name)
        rms = point.spreads.get(f"{prefix}.true_rms")
        span = "–" if rms is None else f"{rms.p5:.4f} to {rms.p95:.4f}"
        means = [_mean(point, f"{prefix}.{each}") for each in ("est_std", "true_std", "true_rms", "true_mean")]
        rows.append([_titled(parameter), "" if printed is None else f"{printed:g}", *means, span])
    return rows


def _titled(parameter: Parameter) -> str:
    return parameter.labelled(f"{parameter.name} ({unit(parameter.name)})")


def _mean(point: Point, column: str) -> str:
    return _spread(point.spreads.get(column), 4)


def _spread(found: Spread | None, digits: int = 2) -> str:
    """Return a mean with half the width of its interval."""
    if found is None:
        return "–"
    half = found.mean.high - found.mean.value
    return f"{found.mean.value:.{digits}f}" + (f" ± {half:.{digits}f}" if np.isfinite(half) else "")


def _share(found: Interval | None) -> str:
    """Return a share in percent with its interval."""
    if found is None:
        return "–"
    return f"{100 * found.value:.3g} % [{100 * found.low:.3g}, {100 * found.high:.3g}]"
