"""The page that compares runs: one HTML file with everything in it, figures included."""

from collections.abc import Sequence
from pathlib import Path

from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.reading.formation_errors import Errors
from zsim_analysis.report.comparison.comparison import (
    ABSENT,
    Compared,
    Row,
    clusters,
    notes,
    parameters,
    runs_id,
    scenario_rows,
)
from zsim_analysis.report.figures.run_figures import Named
from zsim_analysis.report.report_page import data_uri, facts, template

STATISTICS = ("est. std", "true std", "true RMS", "true mean")


def comparison_page(runs: Sequence[Compared], figures: Sequence[Named], directory: Path) -> str:
    """Return the page; `directory` holds the figures' files."""
    return template("comparison.html.j2", "zsim_analysis.report.comparison").render(
        runs=runs,
        runs_id=runs_id([run.directory for run in runs]),
        facts=fact_rows(runs),
        notes=notes(runs),
        statistics=STATISTICS,
        tables={cluster: statistics_rows(runs, cluster) for cluster in clusters(runs)},
        scenario=scenario_rows(runs),
        without=[run.name for run in runs if run.flight.scenario is None],
        figures=[(figure, data_uri(directory / figure.name)) for figure in figures],
    )


def fact_rows(runs: Sequence[Compared]) -> list[Row]:
    """Return what the head of each run's own page says, and more that tells runs apart, a line for each word."""
    told = [dict([*facts(run.summary), *_more(run)]) for run in runs]
    return [Row(word, tuple(each[word] for each in told)) for word in told[0]]


def _more(run: Compared) -> list[tuple[str, str]]:
    summary, flight = run.summary, run.flight
    versions = ", ".join(dict.fromkeys(value for name, value in summary.versions.items() if name != "report"))
    return [
        ("Drones", f"{len(flight.tracks)}"),
        ("Clusters", ", ".join(f"{c.name} of {len(c.drones)}" for c in flight.clusters) or "none"),
        ("Versions", versions or "not known"),
        ("Scenario's hash", flight.info.scenario_sha256[:16] if flight.info else "not known"),
        ("Record", f"{summary.record.messages} messages{'' if summary.record.complete else ', cut short'}"),
    ]


def statistics_rows(runs: Sequence[Compared], cluster: str) -> list[Row]:
    """Return a line per variable of a cluster, with as many cells for each run as there are STATISTICS."""
    rows = []
    for name in parameters(runs, cluster):
        cells: list[str] = []
        for run in runs:
            found = run.summary.clusters.get(cluster)
            cells += _cells(found.errors.get(name) if found else None)
        rows.append(Row(f"{name} ({unit(name)})", tuple(cells)))
    return rows


def _cells(errors: Errors | None) -> list[str]:
    if errors is None:
        return [ABSENT] * len(STATISTICS)
    values = (errors.est_std, errors.true_std, errors.true_rms, errors.true_mean)
    return [ABSENT if value is None else f"{value:.4f}" for value in values]
