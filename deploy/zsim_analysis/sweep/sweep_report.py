"""Makes the report of a sweep from its table: summary.json, figures/*.png, report.html, and tables for the terminal.

Every table has a row for each point of the grid. On the page, tables show intervals and are split to fit its width; on
a terminal, they are brief and split into as few as the width allows without truncating names.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from textwrap import wrap
from typing import NamedTuple

import numpy as np
from msgspec import Struct
from rich.box import SIMPLE_HEAD
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

from zsim.errors import ReportError, printable
from zsim.runtime.progress import cell
from zsim_analysis.reading.shortfall import span_text
from zsim_analysis.report.make_report import Picture, changed_text, date_text, rendered, write_report
from zsim_analysis.report.summary import PAPER_COLUMN, PAPER_NOTE, STATISTICS
from zsim_analysis.sweep.sweep import load
from zsim_analysis.sweep.sweep_figures import figures
from zsim_analysis.sweep.sweep_summary import (
    OBSTACLE_DISTANCE,
    RUNS_MIN,
    SEPARATION,
    Distribution,
    FieldName,
    FormationParameter,
    GridPoint,
    SweepResults,
    SweepSummary,
    field_name,
)

POINTS_MAX = 200  # maximum number of points in a table on the page; sweep.parquet has them all
DETAILED_MAX = 24  # maximum number of points with a table of their own
OVERVIEW = ("runs", "ended well", "as planned", "engaged", "no collision", "separation (m)", "least (m)")
OWN = "your own metrics"
BLOCK_COLUMNS = 6  # maximum number of columns that fit the page, including those of the grid's fields
QUANTILES = "true RMS, 5 to 95 %"


def make_sweep_report(
    directory: Path, progress: Callable[[str], None] = lambda _: None, formats: Sequence[str] = ()
) -> SweepSummary:
    """Write the report of a sweep, which may still be running; see `write_report`.

    Raises:
        RunError: the directory does not hold a sweep.
        ReportError: no run is finished yet, or the directory cannot be written.
    """
    sweep = load(directory)
    rows = sweep.rows()
    if not rows:
        raise ReportError(f"{directory}: no run of this sweep is finished yet; there is nothing to report")
    results = SweepResults(sweep.design, rows)
    summary = results.summary()
    write_report(directory, summary, figures(results), partial(page, summary), progress, formats)
    return summary


class PointTable(NamedTuple):
    """Column headings and a row of cells for each point, without the grid's fields."""

    heads: list[str]
    rows: list[list[str]]
    title: str = ""
    caption: str = ""


def _table(
    points: Sequence[GridPoint], titles: Mapping[str, str], text: Callable[[GridPoint, str], str], *about: str
) -> PointTable:
    """Return the table of the columns in `titles`; `text` formats a cell; `about` is its title and caption."""
    return PointTable(list(titles.values()), [[text(p, column) for column in titles] for p in points], *about)


def page(summary: SweepSummary, pictures: Sequence[Picture]) -> str:
    points, axes = summary.flown[:POINTS_MAX], axes_of(summary)
    names = {prefix: each for prefix, each in summary.parameters.items() if f"{prefix}.true_rms" in summary.known}
    errors = {f"{prefix}.true_rms": each.titled for prefix, each in names.items()}
    own = {column: str(field_name(column)) for column in summary.metrics if column in summary.known}
    differing_points = [each for each in points if each.differences]
    columns = ["parameter", *([PAPER_COLUMN] if summary.paper_std else []), *STATISTICS, QUANTILES]
    return rendered(
        "sweep.html.j2",
        pictures,
        "zsim_analysis.sweep",
        summary=summary,
        facts=facts(summary),
        notes=notes(summary),
        runs_min=RUNS_MIN,
        overview=[*map(str, axes), *OVERVIEW],
        points=[(*values_of(point), *overview(point)) for point in points],
        parameters=list(names),
        errors=_blocks(points, axes, _table(points, errors, _mean)),
        metrics=_blocks(points, axes, _table(points, own, _mean)),
        differences=_blocks(differing_points, axes, _table(differing_points, compared_columns(summary), _difference)),
        reference=heading_of(summary.points[0]),
        without_data=missing_data_text(summary),
        left_out=len(summary.flown) - len(points),
        window=windows_of(summary),
        paper_column=PAPER_COLUMN,
        details=columns,
        tables=[(heading_of(point), details(point, names, summary.paper_std)) for point in points[:DETAILED_MAX]],
        paper_note=PAPER_NOTE if summary.paper_std else "",
    )


def axes_of(summary: SweepSummary) -> list[FieldName]:
    """Return the names of the grid's fields; if there are none, the heading of a single column for the point."""
    return [field_name(path) for path in summary.points[0].values] or [FieldName("point")]


def values_of(point: GridPoint) -> list[str]:
    return list(point.names.values()) or [point.label]


def heading_of(point: GridPoint) -> str:
    """Return the fields of a point with their values, as text."""
    return ", ".join(field_name(path).at(value) for path, value in point.names.items()) or point.label


def compared_columns(summary: SweepSummary) -> dict[str, str]:
    """Return the titles of the columns that have paired differences, by column, the user's metrics first."""
    errors = {f"{prefix}.true_rms": f"RMS of {each.titled}" for prefix, each in summary.parameters.items()}
    own = {column: str(field_name(column)) for column in summary.metrics}
    titles = {**own, **errors, SEPARATION: "separation (m)", OBSTACLE_DISTANCE: "from obstacles (m)"}
    compared = {column for point in summary.points for column in point.differences}
    return {column: title for column, title in titles.items() if column in compared}


def _blocks(
    points: Sequence[GridPoint], axes: Sequence[FieldName], table: PointTable
) -> list[tuple[list[str], list[list[str]]]]:
    """Split a table into blocks of columns that fit the page; return headings and rows, each with the grid's fields."""
    across = max(2, BLOCK_COLUMNS - len(axes))
    blocks = []
    for part in np.array_split(np.arange(len(table.heads)), max(1, -(-len(table.heads) // across))):
        heads = [*map(str, axes), *(table.heads[i] for i in part)]
        rows = [[*values_of(point), *(row[i] for i in part)] for point, row in zip(points, table.rows, strict=True)]
        blocks.append((heads, rows))
    return blocks if table.heads else []


def facts(summary: SweepSummary) -> list[tuple[str, str]]:
    """Return the label and value of each line at the top of the page."""
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
    return span_text(summary.windows_s) if summary.windows_s else "not known"


def marks_of(summary: SweepSummary) -> list[str]:
    """Return a line for each way in which runs deviated from their plan."""
    runs = f"of {summary.finished} runs"
    lines = [f"{count} {runs} not as planned: {text}" for text, count in summary.not_as_planned.items()]
    if summary.judged_unengaged:
        lines.append(
            f"{summary.judged_unengaged} {runs} were judged while a cluster was not engaged "
            f"(window {windows_of(summary)}); give a window after the engagement, report.window_s"
        )
    return lines + [f"{count} {runs}: {text}" for text, count in summary.window_notes.items()]


def notes(summary: SweepSummary) -> list[str]:
    lines = []
    if summary.finished < summary.runs:
        lines.append(f"{summary.runs - summary.finished} runs are not finished; the same command continues with them.")
    lines += [f"{count} of {summary.finished} runs failed: {reason}" for reason, count in summary.failed.items()]
    lines += marks_of(summary)
    if summary.not_engaged:
        lines.append(
            f"In {summary.not_engaged} runs that ended well, a cluster was never engaged within the judged window; "
            "its errors are left out."
        )
    lines += [f"{count} of {summary.finished} runs have no {OWN}: {why}" for why, count in summary.unmeasured.items()]
    if len(summary.fingerprints) > 1:
        lines.append("The hosts have different code (fingerprints); the same bits are not guaranteed.")
    return lines


def missing_data_text(summary: SweepSummary) -> str:
    """Return a sentence that names the quantities missing from every run; empty if there are none."""
    errors = {each.titled: prefix for prefix, each in summary.parameters.items()}
    own = {str(field_name(column)): column for column in summary.metrics}
    available = summary.known | {column.rpartition(".")[0] for column in summary.known}
    parts = []
    for kind, columns in (("formation errors", errors), (OWN, own)):
        names = [name for name, column in columns.items() if column not in available]
        if names:
            parts.append(kind if len(names) == len(columns) else f"{kind} of {', '.join(names)}")
    return f"No run has {' or '.join(parts)}; these appear in no table or figure." if parts else ""


def details(point: GridPoint, names: dict[str, FormationParameter], paper_std: dict[str, float]) -> list[list[str]]:
    """Return the table of one point, with a row per formation parameter; empty if no run there has errors."""
    rows: list[list[str]] = []
    if not any(f"{prefix}.true_rms" in point.spreads for prefix in names):
        return rows
    for prefix, parameter in names.items():
        printed = paper_std.get(parameter.name)
        paper = ["" if printed is None else f"{printed:g}"] if paper_std else []
        rms = point.spreads.get(f"{prefix}.true_rms")
        span = "–" if rms is None or rms.samples else f"{rms.p5:.4f} to {rms.p95:.4f}"
        means = [_mean(point, f"{prefix}.{statistic}") for statistic in STATISTICS.values()]
        rows.append([parameter.titled, *paper, *means, span])
    return rows


def overview(point: GridPoint, brief: bool = False) -> list[str]:
    shares = []  # in percent, with the interval unless brief
    for share in (point.ended_well, point.as_planned, point.without_collision):
        interval = f" [{100 * share.low:.3g}, {100 * share.high:.3g}]" if share and not brief else ""
        shares.append(f"{100 * share.value:.3g} %{interval}" if share else "–")
    well, planned, no_collision = shares
    excluded = f"{point.excluded} excluded" if point.excluded else ""
    engaged = "–" if point.engaged is None else str(point.engaged)
    min_separation = "–" if point.least_separation_m is None else f"{point.least_separation_m:.2f}"
    separation = _mean(point, SEPARATION, ".2f", brief)
    return [str(point.runs), well, _with_note(planned, excluded), engaged, no_collision, separation, min_separation]


def _mean(point: GridPoint, column: str, form: str = ".4f", brief: bool = False) -> str:
    """Return the mean of a column, with its interval unless `brief`, and the number of runs if some are left out."""
    spread = point.spreads.get(column)
    if spread is None:
        return "–"
    if brief:
        return _with_note(f"{spread.mean.value:{form}}", point.count(column).replace(" ", ""))
    return _with_note(_spread(spread, form), point.count(column))


def _difference(point: GridPoint, column: str, brief: bool = False) -> str:
    """Return the mean of the paired differences, with its interval and the number of pairs."""
    spread = point.differences.get(column)
    if spread is None:
        return "–"
    if not brief:
        return _with_note(_spread(spread, ".4f"), f"n = {spread.runs}")
    if spread.samples:  # too few for an interval
        return ", ".join(f"{each:+.3g}" for each in spread.samples)
    return f"{spread.mean.value:+.3g} ± {spread.mean.high - spread.mean.value:.2g} (n={spread.runs})"


def _spread(spread: Distribution, form: str) -> str:
    """Return a mean with half the width of its interval, or all samples if they are too few for an interval."""
    if spread.samples:
        return ", ".join(f"{each:{form}}" for each in spread.samples)
    half = spread.mean.high - spread.mean.value
    return f"{spread.mean.value:{form}}" + (f" ± {half:{form}}" if np.isfinite(half) else "")


def _with_note(text: str, note: str) -> str:
    return f"{text} ({note})" if note else text


# Terminal

TERMINAL_POINTS_MAX = 40
BETWEEN = 3  # width between two columns of a table [characters]
EDGE = 1  # width saved after a table's last column, net of the table's edges [characters]
ERRORS_MAX = 9  # maximum number of parameters shown on a terminal, as many as in the paper's Table I
HEAD = 8  # smallest width to which a heading is wrapped [characters]
AXES_MAX = 3  # maximum number of grid fields with a column each; if there are more, all share one


class TerminalColumn(Struct, frozen=True):
    """A column: a heading, wrapped only between words, and a cell for each point."""

    head: str
    cells: tuple[str, ...]

    @property
    def lines(self) -> list[str]:
        return wrap(self.head, max(map(len, (*self.cells, "x" * HEAD))), break_long_words=False, break_on_hyphens=False)

    @property
    def width(self) -> int:
        """The width in characters, with the space before the next column."""
        return max(map(len, (*self.lines, *self.cells))) + BETWEEN


class TerminalText(Struct, frozen=True):
    """Text for the terminal, fitted to its width: deviations from the plan, then tables."""

    summary: SweepSummary

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield from (Text(printable(mark), style="bold red") for mark in marks_of(self.summary))
        for table in terminal_tables(self.summary):
            if table.heads:
                yield from _fitted(table, self.summary, options.max_width)
        if missing := missing_data_text(self.summary):
            yield cell(missing)


def terminal_tables(summary: SweepSummary) -> list[PointTable]:
    """Return the tables of user metrics, paired differences, ends of runs, and errors; some may have no columns."""
    points, level = summary.flown[:TERMINAL_POINTS_MAX], f"{100 * summary.level:g} %"
    own = {column: str(field_name(column)) for column in summary.metrics if column in summary.known}
    columns = {f"{prefix}.true_rms": each for prefix, each in summary.parameters.items()}
    available = {column: each for column, each in columns.items() if column in summary.known}
    cluster = next((each.cluster for each in available.values()), None)
    # the first parameters of the first cluster, without headings (phi_…): for Test 1, those of the paper
    candidates = [(column, each.name) for column, each in available.items() if each.cluster == cluster]
    errors = dict([(column, name) for column, name in candidates if not name.startswith("phi_")][:ERRORS_MAX])
    compared = {  # differences of the user's metrics if there are any, otherwise of the errors
        column: title
        for column, title in compared_columns(summary).items()
        if column in summary.metrics or (not summary.metrics and column in errors)
    }
    cluster = cluster if errors else None
    of_cluster = f" of {cluster}" if cluster else ""
    title = f"RMS of truth − desired{of_cluster} from {windows_of(summary)}, means over the runs as planned"
    title_own = "Your own metrics, means over the runs as planned"
    title_pairs = f"Differences from {heading_of(summary.points[0])} of runs with the same seed"
    caption_pairs = f"means ± half of the {level} interval, of n pairs; if pairs are few, each difference is listed\n"
    title_ends = f"{summary.scenario}: {summary.finished} of {summary.runs} runs"
    caption_ends = f"means over the runs as planned; minima over all runs; {level} intervals are in the report\n"
    ends = [overview(point, brief=True) for point in points]
    return [
        _table(points, own, partial(_mean, form=".4g", brief=True), title_own),
        _table(points, compared, partial(_difference, brief=True), title_pairs, caption_pairs),
        PointTable(list(OVERVIEW), ends, title_ends, caption_ends),
        _table(points, errors, partial(_mean, form=".3f", brief=True), title, "in m; angles in rad\n"),
    ]


def _fitted(table: PointTable, summary: SweepSummary, width: int) -> Iterator[Text | Table]:
    """Yield title, tables and caption; tables are at most `width` characters wide if each column fits on its own."""
    names = [str(name) for name in axes_of(summary)]
    values = [values_of(point) for point in summary.flown[:TERMINAL_POINTS_MAX]]
    if len(names) > AXES_MAX:
        names, values = [" · ".join(names)], [[" · ".join(row)] for row in values]
    axes = [TerminalColumn(name, tuple(row[i] for row in values)) for i, name in enumerate(names)]
    cells = zip(*table.rows, strict=True) if table.rows else [()] * len(table.heads)
    columns = [TerminalColumn(head, tuple(each)) for head, each in zip(table.heads, cells, strict=True)]
    yield cell(table.title)
    for part in _split_columns(columns, width + EDGE - sum(column.width for column in axes)):
        grid = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1))
        for index, column in enumerate([*axes, *part]):
            justify = "left" if index < len(axes) else "right"
            grid.add_column(cell("\n".join(column.lines)), justify=justify, vertical="bottom", no_wrap=True)
        for row in zip(*(column.cells for column in [*axes, *part]), strict=True):
            grid.add_row(*map(cell, row))
        yield grid
    omitted = len(summary.flown) - TERMINAL_POINTS_MAX
    hint = f"{omitted} more points are in the report. " if omitted > 0 else ""
    yield cell(f"{hint}{table.caption}".strip())


def _split_columns(columns: Sequence[TerminalColumn], room: int) -> list[Sequence[TerminalColumn]]:
    """Split columns into the fewest parts of similar size that each fit `room` characters, or are a single column."""
    for count in range(1, len(columns) + 1):
        ends = np.linspace(0, len(columns), count + 1).round().astype(int).tolist()
        parts = [columns[start:end] for start, end in pairwise(ends)]
        if all(len(part) == 1 or sum(column.width for column in part) <= room for part in parts):
            return parts
    return []
