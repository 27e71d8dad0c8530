"""Makes the page of a board, its tables and figures; and its table for the terminal."""

from collections.abc import Callable, Sequence
from functools import partial

from rich.console import Group

from zsim.presentation import Column, FittedTable
from zsim_analysis.board.board import Board, board_of, cells, heads, summary_of, write_tables
from zsim_analysis.board.board import BoardRequest as Request
from zsim_analysis.board.board_figures import board_figures
from zsim_analysis.board.entries import about
from zsim_analysis.report.make_report import Picture, sources, template, write_report
from zsim_analysis.sweep.sweep_run import Row


def make_board_report(
    request: Request,
    rows: Sequence[Row],
    progress: Callable[[str], None] = lambda _: None,
    formats: Sequence[str] = (),
) -> Board:
    """Write all files of a board but its journal; return its means. ReportError: the folder cannot be written."""
    board = board_of(request, rows)
    write_tables(request.out, board, rows)
    figures = board_figures(board, rows)
    write_report(request.out, summary_of(board), figures, partial(page, board), progress, formats)
    return board


def page(board: Board, pictures: Sequence[Picture]) -> str:
    tables = [
        (each, about(each), [(law, cells(board.entry(each, law))) for law in board.laws]) for each in board.scenarios
    ]
    failed = sum(entry.failed for entry in board.entries)
    return template("board.html.j2", "zsim_analysis.board").render(
        board=board, heads=heads(), tables=tables, failed=failed, figures=sources(pictures)
    )


def terminal_text(board: Board) -> Group:
    """Return a table for each scenario."""
    columns = [
        Column("law", "name"),
        *(Column(head.replace(" (", "\n("), right=True, worth=-i) for i, head in enumerate(heads())),
    ]
    tables = []
    for scenario in board.scenarios:
        rows = [[law, *cells(board.entry(scenario, law))] for law in board.laws]
        tables.append(FittedTable(columns, rows, title=f"\n{scenario}: {about(scenario)}"))
    return Group(*tables)
