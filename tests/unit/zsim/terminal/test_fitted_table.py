"""Tables in terminals of any width: neither a name, nor a unit, nor a figure is broken."""

import io

import pytest
from rich.console import Console

from zsim.presentation import Column, FittedTable

COLUMNS = (
    Column("role", "name"),
    Column("state", "text"),
    Column("lag", worth=2, right=True),
    Column("round\ntrip", worth=1, right=True),
)
ROWS = [
    (f"estimator.formation-alpha-drone-{i}", "waited for 12 s by all the others", "1234 ms", "123.4 ms")
    for i in range(3)
]


def lines(table: FittedTable, width: int) -> list[str]:
    console = Console(file=io.StringIO(), width=width)
    console.print(table)
    return [line.rstrip() for line in console.file.getvalue().splitlines()]  # type: ignore[attr-defined]


@pytest.mark.parametrize("width", range(30, 121, 3))
def test_figures_and_headers_are_whole_or_left_out(width: int) -> None:
    table = FittedTable(COLUMNS, ROWS)
    text = lines(table, width)
    assert max(map(len, text)) <= width
    for column, figure in ((2, "1234 ms"), (3, "123.4 ms")):
        is_shown = " ".join(COLUMNS[column].header.split()) not in table.left_out(width)
        assert sum(figure in line for line in text) == (len(ROWS) if is_shown else 0)


def test_what_is_worth_least_goes_first() -> None:
    table = FittedTable(COLUMNS, ROWS)
    left = [tuple(table.left_out(width)) for width in (120, 55, 45)]
    assert left == [(), ("round trip",), ("lag", "round trip")]


@pytest.mark.parametrize("width", [30, 45, 80, 120])
def test_names_keep_their_ends(width: int) -> None:
    names = [line.split()[0] for line in lines(FittedTable(COLUMNS, ROWS, one_line=True), width)[-len(ROWS) :]]
    assert len(set(names)) == len(ROWS)
    assert all(row[0].endswith(name.removeprefix("…")) for name, row in zip(names, ROWS, strict=True))


def test_a_row_of_one_line_is_cut_at_its_end() -> None:
    text = lines(FittedTable(COLUMNS, ROWS, one_line=True), 60)
    assert len(text) == 1 + len(ROWS)
    assert all("…" in line for line in text[-len(ROWS) :])


def test_codes_of_a_terminal_are_written_out() -> None:
    table = FittedTable([Column("\x1b[2J", "name"), Column("b", "text")], [("\x1b[2J", "\x07")], "\x1b", "\x9b")
    assert not {"\x1b", "\x07", "\x9b"} & set("".join(lines(table, 80)))
