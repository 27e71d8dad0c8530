"""The errors of formations as tables, on the page and on the terminal: of a large formation first by groups."""

from collections.abc import Iterator, Sequence

import numpy as np
from msgspec import Struct
from rich.box import HEAVY_HEAD
from rich.console import Group
from rich.text import Text

from zsim.errors import printable
from zsim.presentation import Column, FittedTable
from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.reading.formation import ParameterErrors
from zsim_analysis.reading.verdict import NOT_AS_PLANNED, marks_of
from zsim_analysis.reading.window_text import span_text
from zsim_analysis.report.summary import ClusterErrors, RunSummary

PAPER_COLUMN = "paper std"
COLUMNS = ("parameter", PAPER_COLUMN, "est. std", "est. mean", "true std", "true RMS", "true mean")
TERMINAL_COLUMNS = {
    "parameter": Column("parameter", "name"),
    PAPER_COLUMN: Column("paper\nstd", worth=4, right=True),
    "est. std": Column("est.\nstd", worth=3, right=True),
    "est. mean": Column("est.\nmean", worth=1, right=True),
    "true std": Column("true\nstd", right=True),
    "true RMS": Column("true\nRMS", right=True),
    "true mean": Column("true\nmean", worth=2, right=True),
    "parameters": Column("parameters", "name"),
    "count": Column("count", worth=1, right=True),
    "est. RMS": Column("est.\nRMS", worth=2, right=True),
    "worst": Column("worst", worth=3, right=True),
    "of": Column("of", "name"),
}
GROUP_COLUMNS = ("parameters", "count", "est. RMS", "true RMS", "worst", "of")
SINGLY_MAX = 24  # parameters of a formation that need no table by groups: of 6 drones
FRAME = {"x_c": "position", "y_c": "position", "z_c": "position"} | dict.fromkeys(("roll", "pitch", "yaw"), "attitude")


class ErrorTable(Struct, frozen=True):
    """Columns and rows of text; `rest` has every parameter where the rows are of groups."""

    columns: list[str]
    rows: list[list[str]]
    rest: "ErrorTable | None" = None


def error_table(cluster: ClusterErrors) -> ErrorTable:
    """Return a cluster's errors: a row per parameter, or per group of them where there are many."""
    columns = [column for column in COLUMNS if column != PAPER_COLUMN or cluster.paper_std]  # beside Test 1 alone
    single = ErrorTable(columns, [_row(cluster, *item) for item in cluster.errors.items()])
    if len(cluster.errors) <= SINGLY_MAX:
        return single
    return ErrorTable(list(GROUP_COLUMNS), list(_group_rows(cluster)), single)


def _row(cluster: ClusterErrors, parameter: str, errors: ParameterErrors) -> list[str]:
    printed = cluster.paper_std.get(parameter)
    paper = ["" if printed is None else f"{printed:g}"] if cluster.paper_std else []
    values = (errors.est_std, errors.est_mean, errors.true_std, errors.true_rms, errors.true_mean)
    return [f"{parameter} ({unit(parameter)})", *paper, *map(_number, values)]


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4f}"


def _group_rows(cluster: ClusterErrors) -> Iterator[list[str]]:
    """Yield a row per group: how many, the root of their mean square errors, and the parameter that is worst."""
    groups: dict[tuple[str, str], list[str]] = {}
    for name in cluster.errors:
        kind = FRAME.get(name) or ("headings" if name.startswith("phi") else "shape")
        groups.setdefault((kind, unit(name)), []).append(name)
    for (kind, measure), names in groups.items():
        est, true = ([getattr(cluster.errors[name], each) for name in names] for each in ("est_rms", "true_rms"))
        known = {name: value for name, value in zip(names, true, strict=True) if value is not None}
        worst = max(known, key=lambda name: known[name]) if known else ""
        rest = (_number(_together(est)), _number(_together(true)), _number(known.get(worst)), worst or "–")
        yield [f"{kind} ({measure})", str(len(names)), *rest]


def _together(values: Sequence[float | None]) -> float | None:
    """Return the root of the mean square of values that are known."""
    known = [value for value in values if value is not None]
    return float(np.sqrt(np.mean(np.square(known)))) if known else None


def terminal_text(summary: RunSummary) -> Group:
    """Return what the flight did not do of its plan, and a table of errors for each cluster, for the terminal."""
    notes = [(f"note: {summary.window_note}", False)] if summary.window_note else []
    marks = [*marks_of(summary.shortfalls), *notes]
    lines = [Text(printable(mark), style="bold red" if fails else "yellow") for mark, fails in marks]
    return Group(*lines, *(table(summary, name) for name in summary.clusters))


def table(summary: RunSummary, cluster: str) -> FittedTable:
    """Return the errors of one cluster, with the paper's Table I beside Test 1, for the terminal."""
    judged = summary.clusters[cluster]
    content = error_table(judged)
    title = f"Formation errors of {cluster} from {span_text(summary.window_s)}"
    beside = ", beside Table I of the paper" if judged.paper_std else ""
    mark = "" if summary.as_planned else f" ({NOT_AS_PLANNED})"
    caption = "est. = estimate − desired, true = truth − desired"
    if judged.part:
        caption += f"; {judged.part}"
    if content.rest:
        caption += f"; all {len(content.rest.rows)} parameters: report.html, summary.json"
    columns = [TERMINAL_COLUMNS[column] for column in content.columns]
    return FittedTable(columns, content.rows, f"{title}{beside}{mark}", caption, lines=HEAVY_HEAD)
