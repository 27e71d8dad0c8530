"""report.html: one page with everything in it, figures included, that asks nothing of the network."""

import base64
from collections.abc import Sequence
from pathlib import Path

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, Template

from zsim_analysis.report import paper
from zsim_analysis.report.error_table import COLUMNS, cells
from zsim_analysis.report.figures.run_figures import Named
from zsim_analysis.report.summary import Summary


def page(summary: Summary, figures: Sequence[Named], directory: Path) -> str:
    """Return the page; `directory` holds the figures' files."""
    tables = {
        name: [cells(parameter, errors, paper.TABLE_1.get(parameter)) for parameter, errors in cluster.errors.items()]
        for name, cluster in summary.clusters.items()
    }
    return template("page.html.j2").render(
        summary=summary,
        facts=facts(summary),
        columns=COLUMNS,
        tables=tables,
        paper_note=paper.NOTE,
        figures=[(figure, data_uri(directory / figure.name)) for figure in figures],
    )


def facts(summary: Summary) -> list[tuple[str, str]]:
    """Return what the head of the page says, as pairs of a word and its value."""
    age = summary.command_age_ms
    ages = f"p50 {age['p50']:.2f} ms, p99 {age['p99']:.2f} ms, max {age['max']:.2f} ms" if age else "not known"
    factor = "not known" if summary.real_time_factor is None else f"{summary.real_time_factor:.1f}"
    return [
        (
            "Scenario",
            f"{summary.scenario or 'not known'}, seed {'–' if summary.seed is None else summary.seed}",
        ),
        ("Mode", summary.mode or "not known"),
        ("Ended", summary.ended),
        (
            "Simulated",
            f"{summary.sim_s:.2f} s in {summary.wall_s:.2f} s of wall time, real-time factor {factor}",
        ),
        ("Deadlines missed", _misses(summary)),
        ("Command age", ages),
        ("Least separation", _metres(summary.min_separation_m)),
        ("Truth", f"SHA-256 {summary.truth_sha256}"),
        ("Fingerprint", summary.fingerprint or "not known"),
    ]


def _misses(summary: Summary) -> str:
    if summary.deadline_misses is None:
        return "not known"
    by = ", ".join(f"{name} {count}" for name, count in summary.deadline_misses_by.items() if count)
    return f"{summary.deadline_misses} of {summary.deadlines or 0}{f' ({by})' if by else ''}"


def _metres(value: float | None) -> str:
    return "no two drones in the air" if value is None else f"{value:.2f} m in truth"


def template(name: str, package: str = "zsim_analysis.report") -> Template:
    """Return a page's template; what it includes may stand beside it or here."""
    return Environment(
        loader=ChoiceLoader([PackageLoader(package, "."), PackageLoader("zsim_analysis.report", ".")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    ).get_template(name)


def data_uri(path: Path) -> str:
    """Return a picture as a page holds it within itself."""
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()
