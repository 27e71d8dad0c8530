"""The formation's errors beside the paper's Table I, for the terminal."""

from rich.table import Table

from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.reading.formation_errors import Errors
from zsim_analysis.report.summary import Summary

COLUMNS = ("parameter", "paper std", "est. std", "est. mean", "true std", "true RMS", "true mean")


def table(summary: Summary, cluster: str | None = None) -> Table:
    """Return the table of one cluster, by default of the first."""
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


def cells(parameter: str, errors: Errors, printed: float | None) -> list[str]:
    """Return one row of the table, also the one of the page."""
    values = (errors.est_std, errors.est_mean, errors.true_std, errors.true_rms, errors.true_mean)
    return [
        f"{parameter} ({unit(parameter)})",
        "" if printed is None else f"{printed:g}",
        *map(_number, values),
    ]


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4f}"
