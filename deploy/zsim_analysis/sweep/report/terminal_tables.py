"""The tables of a sweep on a terminal: as many columns in each as fit it, every name whole."""

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from textwrap import wrap

import numpy as np
from msgspec import Struct
from rich.box import SIMPLE_HEAD
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

from zsim.errors import printable
from zsim.runtime.progress import cell
from zsim_analysis.sweep.intervals import ConfidenceInterval
from zsim_analysis.sweep.report.field_names import field_name
from zsim_analysis.sweep.report.make_sweep_report import (
    axes_of,
    differing,
    heading_of,
    marks_of,
    values_of,
    windows_of,
    without_data,
)
from zsim_analysis.sweep.sweep_summary import FormationParameter, GridPoint, SweepSummary

POINTS_MAX = 40  # on a terminal
BETWEEN = 3  # characters between two columns of a table
EDGE = 1  # of them that no table has after its last column, and its edges beside
ERRORS_MAX = 9  # parameters, as many as the paper's Table I has
HEAD = 8  # characters of a head, at least, that stand in one line
AXES_MAX = 3  # fields of the grid with a column each; more of them share one


class TerminalColumn(Struct, frozen=True):
    """A column with its head, which is broken between its words alone, and a cell for each point."""

    head: str
    cells: tuple[str, ...]

    @property
    def lines(self) -> list[str]:
        """Return the head in lines."""
        return wrap(self.head, max(map(len, (*self.cells, "x" * HEAD))), break_long_words=False, break_on_hyphens=False)

    @property
    def width(self) -> int:
        """Return how many characters it needs."""
        return max(map(len, (*self.lines, *self.cells)))


class TerminalText(Struct, frozen=True):
    """What the runs did not do; at each point the figures of the user's own, how the runs ended, and their errors."""

    summary: SweepSummary

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield from (Text(printable(mark), style="bold red") for mark in marks_of(self.summary))
        parts = (own_figures, differences, overview, errors)
        for part in (each(self.summary) for each in parts):
            if part.columns:
                yield from part.lines(self.summary, options.max_width)
        if missing := without_data(self.summary):
            yield cell(missing)


def terminal_text(summary: SweepSummary) -> TerminalText:
    """Return what a terminal shows of a sweep, in tables that fit it."""
    return TerminalText(summary)


class PointTable(Struct, frozen=True):
    """Columns beside the fields of the grid, in as many tables as it takes; without columns it is none."""

    title: str
    caption: str
    columns: tuple[TerminalColumn, ...]

    def lines(self, summary: SweepSummary, width: int) -> Iterator[Text | Table]:
        """Yield title, tables and caption, no table wider than `width` characters if its first columns are not."""
        axes = _axis_columns(summary)
        yield cell(self.title)
        for part in _parted(self.columns, width + EDGE - sum(column.width + BETWEEN for column in axes)):
            yield _table([*axes, *part], len(axes))
        left_out = len(summary.flown) - POINTS_MAX
        yield cell(f"{f'{left_out} more points are in the report. ' if left_out > 0 else ''}{self.caption}".strip())


def overview(summary: SweepSummary) -> PointTable:
    """Return how the runs ended at each point."""
    title = f"{summary.scenario}: {summary.finished} of {summary.runs} runs"
    columns = (
        _column(summary, "runs", lambda point: str(point.runs)),
        _column(summary, "ended well", lambda point: _percent(point.ended_well)),
        _column(summary, "as planned", _planned),
        _column(summary, "engaged", lambda point: "–" if point.engaged is None else str(point.engaged)),
        _column(summary, "no collision", lambda point: _percent(point.without_collision)),
        _column(summary, "separation (m)", lambda point: _mean(point, "min_separation_m", 2)),
        _column(summary, "least (m)", _least),
    )
    intervals = f"{100 * summary.level:g} % intervals are in the report"
    caption = f"means are of the runs as planned, not of those excluded; least of all; {intervals}\n"
    return PointTable(title, caption, columns)


def errors(summary: SweepSummary) -> PointTable:
    """Return the means of the RMS errors at each point."""
    names = errors_of_terminal(summary)
    cluster = next((each.cluster for each in names.values()), None)
    of = f" of {cluster}" if cluster else ""
    columns = [
        _column(summary, each.name, lambda point, prefix=prefix: _mean(point, f"{prefix}.true_rms"))
        for prefix, each in names.items()
    ]
    title = f"RMS of truth − desired{of} from {windows_of(summary)}, means over the runs as planned"
    return PointTable(title, "in m; angles in rad\n", tuple(columns))


def own_figures(summary: SweepSummary) -> PointTable:
    """Return the means of the figures of the user's own at each point."""
    columns = [
        _column(summary, str(field_name(name)), lambda point, name=name: _significant(point, name))
        for name in summary.metrics
        if name in summary.known
    ]
    return PointTable("Figures of your own, means over the runs as planned", "", tuple(columns))


def differences(summary: SweepSummary) -> PointTable:
    """Return the paired differences from the first point: of figures of the user's own, else of the errors."""
    shown = errors_of_terminal(summary)
    titles = {
        column: title
        for column, title in differing(summary).items()
        if column in summary.metrics or (not summary.metrics and column.rpartition(".")[0] in shown)
    }
    columns = [
        _column(summary, title, lambda point, column=column: _difference(point, column))
        for column, title in titles.items()
    ]
    title = f"Differences from {heading_of(summary.points[0])} of runs with the same seed"
    caption = f"means ± half of the {100 * summary.level:g} % interval, of n pairs; of few pairs each one\n"
    return PointTable(title, caption, tuple(columns))


def errors_of_terminal(summary: SweepSummary) -> dict[str, FormationParameter]:
    """Return the parameters whose errors stand on a terminal: the paper's, else the first ones that are no heading."""
    flown = {prefix: each for prefix, each in summary.parameters.items() if f"{prefix}.true_rms" in summary.known}
    first = next((each.cluster for each in flown.values()), None)
    own = {prefix: each for prefix, each in flown.items() if each.cluster == first}
    return dict([(prefix, each) for prefix, each in own.items() if not each.name.startswith("phi_")][:ERRORS_MAX])


def _column(summary: SweepSummary, head: str, text: Callable[[GridPoint], str]) -> TerminalColumn:
    return TerminalColumn(head, tuple(text(point) for point in summary.flown[:POINTS_MAX]))


def _percent(share: ConfidenceInterval | None) -> str:
    return "–" if share is None else f"{100 * share.value:.3g} %"


def _planned(point: GridPoint) -> str:
    excluded = f" ({point.excluded} excluded)" if point.excluded else ""
    return f"{_percent(point.as_planned)}{excluded}"


def _mean(point: GridPoint, column: str, digits: int = 3) -> str:
    samples = point.spreads.get(column)
    return "–" if samples is None else f"{samples.mean.value:.{digits}f}{_count(point, column)}"


def _significant(point: GridPoint, column: str) -> str:
    samples = point.spreads.get(column)
    return "–" if samples is None else f"{samples.mean.value:.4g}{_count(point, column)}"


def _difference(point: GridPoint, column: str) -> str:
    spread = point.differences.get(column)
    if spread is None:
        return "–"
    if spread.samples:  # too few for an interval
        return ", ".join(f"{each:+.3g}" for each in spread.samples)
    return f"{spread.mean.value:+.3g} ± {spread.mean.high - spread.mean.value:.2g} (n={spread.runs})"


def _count(point: GridPoint, column: str) -> str:
    """Return of how many runs a mean is, where they are fewer than ended well."""
    count = point.count(column).replace(" ", "")
    return f" ({count})" if count else ""


def _least(point: GridPoint) -> str:
    return "–" if point.least_separation_m is None else f"{point.least_separation_m:.2f}"


def _axis_columns(summary: SweepSummary) -> list[TerminalColumn]:
    """Return a column for each field of the grid, or one for all of them where they are many."""
    names = [str(name) for name in axes_of(summary)]
    rows = [values_of(point) for point in summary.flown[:POINTS_MAX]]
    if len(names) <= AXES_MAX:
        return [
            TerminalColumn(name, cells)
            for name, cells in zip(names, zip(*rows, strict=True) if rows else [()] * len(names), strict=True)
        ]
    return [TerminalColumn(" · ".join(names), tuple(" · ".join(row) for row in rows))]


def _parted(columns: Sequence[TerminalColumn], room: int) -> list[Sequence[TerminalColumn]]:
    """Return columns in as few parts of like number as fit a room in characters; one that does not fit stands alone."""
    for count in range(1, len(columns) + 1):
        ends = np.linspace(0, len(columns), count + 1).round().astype(int).tolist()
        parts = [columns[start:end] for start, end in pairwise(ends)]
        if all(len(part) == 1 or _width(part) <= room for part in parts):
            return parts
    return []


def _width(columns: Sequence[TerminalColumn]) -> int:
    return sum(column.width + BETWEEN for column in columns)


def _table(columns: Sequence[TerminalColumn], axes: int) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1))
    for place, column in enumerate(columns):
        head = cell("\n".join(column.lines))
        table.add_column(head, justify="left" if place < axes else "right", vertical="bottom", no_wrap=True)
    for row in zip(*(column.cells for column in columns), strict=True):
        table.add_row(*map(cell, row))
    return table
