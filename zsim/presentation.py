"""Tables that fit a terminal, and a colour for each drone.

On a narrow terminal, a table omits columns instead of breaking names, units and numbers. A drone has the same colour in
reports, the console and exports, and the colours are distinguishable with every kind of colour vision. Up to six drones
have the colours of Okabe and Ito (2008); more have those of viridis (van der Walt, Smith 2015), in the order of the
scenario, without yellow, which is hard to see on white paper.
"""

import os
from collections.abc import Collection, Sequence
from functools import lru_cache
from typing import Literal, NamedTuple

from rich import box
from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from zsim.errors import printable
from zsim.runtime.progress import PipedConsole

NAME_WIDTH = 22  # characters; columns are omitted so that a name keeps this width
WORD_WIDTH_MAX = 40  # characters; columns are omitted so that words of text up to this width are not broken
TEXT_WIDTH_MIN = 18  # characters; columns are omitted so that text keeps this width
UNLIMITED = 10_000  # characters; wider than any table
NAME_MIN = 12  # characters that a name keeps in a table that is too wide: `…tor.drone12`


class Column(NamedTuple):
    """A column of a table.

    Attributes:
        header: header; its lines are never broken; a table with only empty headers has no header row.
        kind: kind of the cells; if space is short, a name keeps its end, text wraps between words, figures stay whole.
        worth: priority; columns of the lowest worth are omitted first; None: never omitted.
        right: whether cells are right-aligned.
    """

    header: str
    kind: Literal["name", "text", "figure"] = "figure"
    worth: int | None = None
    right: bool = False


class FittedTable:
    """A table that omits columns to fit the terminal; control codes are escaped.

    Args:
        rows: rows with a cell for each column.
        title, caption: texts above and below the table.
        one_line: whether a row is limited to one line, truncating what does not fit.
        lines: lines drawn around the cells; None for no lines.
    """

    def __init__(
        self,
        columns: Sequence[Column],
        rows: Sequence[Sequence[str]],
        title: str | None = None,
        caption: str | None = None,
        one_line: bool = False,
        lines: box.Box | None = None,
    ) -> None:
        self.columns, self._rows = columns, rows
        self.title, self._caption = title, caption
        self._one_line, self._lines = one_line, lines

    def left_out(self, width: int) -> list[str]:
        """Return the headers of the columns that are omitted at a width [characters]."""
        shown = self._shown(Console(width=width), width)
        return [" ".join(each.header.split()) for i, each in enumerate(self.columns) if i not in shown]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        if self.title is not None:
            yield Text(printable(self.title), style="table.title")
        yield self._table(self._shown(console, options.max_width))
        if self._caption is not None:
            yield Text(printable(self._caption), style="table.caption")

    def _shown(self, console: Console, width: int) -> list[int]:
        """Return the indices of the columns shown at a width [characters]."""
        shown = list(range(len(self.columns)))
        wide = console.options.update(width=UNLIMITED)
        while True:
            narrowest = self._empty()
            for index in shown:
                narrowest.add_column(width=self._min_width(index))
            spare = [index for index in shown if self.columns[index].worth is not None]
            if not spare or Measurement.get(console, wide, narrowest).minimum <= width:
                return shown
            shown.remove(min(spare, key=lambda index: (self.columns[index].worth, -index)))

    def _table(self, shown: Sequence[int]) -> Table:
        table = self._empty()
        for index in shown:
            column = self.columns[index]
            is_figure = column.kind == "figure"
            table.add_column(
                Text(printable(column.header), no_wrap=True),
                justify="right" if column.right else "left",
                no_wrap=is_figure,
                min_width=self._min_width(index) if is_figure else None,
            )
        for row in self._rows:
            cells: list[RenderableType] = []
            for index in shown:
                kind = self.columns[index].kind
                is_cut = self._one_line or kind == "figure"
                if kind == "name":
                    cells.append(NameCell(printable(row[index])))
                else:
                    overflow = "ellipsis" if is_cut else "fold"
                    cells.append(Text(printable(row[index]), no_wrap=is_cut, overflow=overflow))
            table.add_row(*cells)
        return table

    def _empty(self) -> Table:
        has_head = any(column.header for column in self.columns)
        return Table(box=self._lines, pad_edge=self._lines is not None, show_header=has_head)

    def _min_width(self, index: int) -> int:
        """Return the width of a column [characters] below which other columns are omitted."""
        column = self.columns[index]
        header = max(map(len, column.header.split("\n")))
        cells = [printable(row[index]) for row in self._rows]
        longest = max(map(len, cells), default=0)
        word = 0 if self._one_line else max((len(word) for cell in cells for word in cell.split()), default=0)
        limit = {"name": NAME_WIDTH, "text": max(TEXT_WIDTH_MIN, min(word, WORD_WIDTH_MAX)), "figure": longest}[
            column.kind
        ]
        return max(header, min(longest, limit))


def print_table(table: FittedTable) -> None:
    """Print a table to a terminal, or, with all columns and one row per line, to a file or pipe."""
    console = PipedConsole()
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = UNLIMITED
    console.print(table)


def shortened(name: str, width: int) -> str:
    """Return a name of at most `width` characters, truncated at its beginning."""
    return name if len(name) <= width else f"…{name[len(name) - width + 1 :]}"


class NameCell(NamedTuple):
    """A name, truncated at its beginning because the end distinguishes names such as `estimator.drone2`.

    Every character of a name is assumed to be one terminal cell wide.
    """

    name: str

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        return Measurement(min(len(self.name), NAME_MIN), len(self.name)).with_maximum(options.max_width)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield Text(printable(shortened(self.name, options.max_width)), no_wrap=True, overflow="crop")


FEW = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
# viridis from 0 to 0.8
MANY = ("#440154", "#482475", "#414487", "#355f8d", "#2a788e", "#21918c", "#22a884", "#44bf70", "#7ad151")


@lru_cache
def drone_colours(count: int) -> tuple[str, ...]:
    """Return the colours `#rrggbb` of `count` drones, in the order of the scenario."""
    if count <= len(FEW):
        return FEW[:count]
    colours = []
    for i in range(count):
        position = i / (count - 1) * (len(MANY) - 1)
        lower = min(int(position), len(MANY) - 2)
        mixed = (a + (position - lower) * (b - a) for a, b in zip(rgb(MANY[lower]), rgb(MANY[lower + 1]), strict=True))
        colours.append("#" + "".join(f"{round(part):02x}" for part in mixed))
    return tuple(colours)


def colours_of(drones: Collection[str]) -> dict[str, str]:
    """Return the colour of each drone by name, given the names in the order of the scenario."""
    return dict(zip(drones, drone_colours(len(drones)), strict=True))


def rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue, each 0 to 255, of a colour `#rrggbb`."""
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return red, green, blue
