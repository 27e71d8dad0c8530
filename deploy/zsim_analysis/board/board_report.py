"""Makes the report page of a board, with its tables and figures, and the tables for the terminal.

Figures: all measures of all laws, the paths of the drones from above, and shape errors over time.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from rich.console import Group

from zsim.presentation import Column, FittedTable, drone_colours
from zsim_analysis.board.board import (
    MEASURES,
    Board,
    about,
    board_of,
    cells,
    heads,
    planned_figure,
    resolve_scenario,
    write_tables,
)
from zsim_analysis.board.board import BoardRequest as Request
from zsim_analysis.report import figure_style as style
from zsim_analysis.report.flight_figures import draw_obstacles
from zsim_analysis.report.make_report import Picture, rendered, write_report
from zsim_analysis.sweep.sweep_run import Row

COLOURS = (style.BLUE, style.ORANGE, style.GREEN, style.VERMILION, style.SKY, style.PURPLE, style.BLACK, style.GREY)
MARKERS = "osD^vP*X"
ROW_IN, MARGIN_IN = 0.42, 0.9  # height of a law's row in a panel, and of everything around the axes
PANEL_MIN_IN = 0.5  # minimum height of a row of path panels


def make_board_report(
    request: Request,
    rows: Sequence[Row],
    progress: Callable[[str], None] = lambda _: None,
    formats: Sequence[str] = (),
) -> Board:
    """Write all files of a board except its journal; return the board; raise ReportError if `out` is not writable."""
    board = board_of(request, rows)
    write_tables(request.out, board, rows)
    figures = board_figures(board, rows)
    write_report(request.out, board, figures, partial(page, board), progress, formats)
    return board


def page(board: Board, pictures: Sequence[Picture]) -> str:
    tables = [
        (each, about(each), [(law, *cells(board.entry(each, law))) for law in board.laws]) for each in board.scenarios
    ]
    failed = sum(entry.failed for entry in board.entries)
    values = {"board": board, "heads": ["law", *heads()], "tables": tables, "failed": failed}
    return rendered("board.html.j2", pictures, "zsim_analysis.board", **values)


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


def board_figures(board: Board, rows: Sequence[Row]) -> Iterator[style.ReportFigure]:
    """Yield the figures of a board; paths and shape errors over time are those of the first seed."""
    yield _measures(board)
    first_seed_rows = {
        (row["scenario"], row["law"]): row for row in rows if row["seed"] == 1 and row["failure"] is None
    }
    if first_seed_rows:
        yield _paths(board, first_seed_rows)
        yield _shapes(board, first_seed_rows)


def _measures(board: Board) -> style.ReportFigure:
    shown = [each for each in MEASURES if any(entry.means[each.name] is not None for entry in board.entries)]
    columns = 4
    lines = -(-len(shown) // columns)
    figure = style.new_figure(style.PAGE_IN, lines * (MARGIN_IN + ROW_IN * len(board.laws)) * 0.75)
    panels = figure.subplots(lines, columns, sharey=True, squeeze=False)
    for axes in panels.flat[len(shown) :]:
        axes.set_visible(False)
    for axes, measure in zip(panels.flat, shown, strict=False):
        for index, scenario in enumerate(board.scenarios):
            offset = 0.7 * ((index + 0.5) / len(board.scenarios) - 0.5)
            for row, law in enumerate(board.laws):
                entry = board.entry(scenario, law)
                mean = entry.means[measure.name]
                if mean is None:
                    continue
                colour, y = COLOURS[index % len(COLOURS)], row + offset
                axes.plot([entry.least[measure.name], entry.greatest[measure.name]], [y, y], color=colour, lw=1.0)
                axes.plot(
                    mean, y, MARKERS[index % len(MARKERS)], color=colour, ms=3.2, label=scenario.replace("_", " ")
                )
        style.dress(axes)
        axes.margins(x=0.08)
        axes.set_xlim(0.0, max(axes.get_xlim()[1], 10.0**-measure.digits))
        unit = f" ({measure.unit})" if measure.unit else ""
        axes.set_xlabel(f"{measure.title}{unit}", fontsize=style.PAPER_PT)
        axes.set_yticks(range(len(board.laws)), [law.replace("_", " ") for law in board.laws])
        axes.set_ylim(len(board.laws) - 0.5, -0.5)
    style.letter_panels(list(panels.flat[: len(shown)]))
    style.legend_above(figure, panels[0, 0])
    spread = f"Means over {board.seeds} seeds; lines from the minimum to the maximum."
    caption = f"{spread} No mark: the law has no such measure, or all its flights failed."
    return style.ReportFigure("measures.png", "What the laws achieve", caption, figure)


def _paths(board: Board, first_seed_rows: dict[tuple[str, str], Row]) -> style.ReportFigure:
    boxes = [_box(board, scenario, first_seed_rows) for scenario in board.scenarios]
    width_in = (style.PAGE_IN - 0.4) / len(board.laws)
    heights = [max(width_in * (high[1] - low[1]) / (high[0] - low[0]), PANEL_MIN_IN) for low, high in boxes]
    figure = style.new_figure(style.PAGE_IN, 0.5 + sum(heights) + 0.08 * len(heights))
    shape = {"squeeze": False, "height_ratios": heights}
    panels = figure.subplots(len(board.scenarios), len(board.laws), **shape)
    for line, (scenario, (low, high)) in enumerate(zip(board.scenarios, boxes, strict=True)):
        plan, obstacle_scenario = (
            planned_figure(scenario),
            resolve_scenario("consensus", scenario, 1),
        )  # same obstacles for all laws
        for axes, law in zip(panels[line], board.laws, strict=True):
            axes.set_aspect("equal")
            axes.set_xlim(low[0], high[0])
            axes.set_ylim(low[1], high[1])
            axes.set_xticks([])
            axes.set_yticks([])
            axes.spines[:].set_color(style.GREY)
            draw_obstacles(axes, obstacle_scenario)
            if line == 0:
                axes.set_title(law.replace("_", "\n"), fontsize=style.PAPER_PT - 2)
            if (row := first_seed_rows.get((scenario, law))) is None:
                continue
            t_s, p = np.array(row["track_t_s"]), np.array(row["track_m"], float)
            centre = np.array([plan.reference.at(float(t)).p_W for t in t_s])
            axes.plot(*centre.T, color=style.GREY, lw=0.8, ls=(0, (3, 2)))
            for drone, colour in enumerate(drone_colours(p.shape[1])):
                axes.plot(*p[:, drone].T, color=colour, lw=0.6)
                aloft = np.flatnonzero(np.isfinite(p[:, drone, 0]))
                if len(aloft):
                    axes.plot(*p[aloft[-1], drone], "o", color=colour, ms=2.2)
        panels[line, 0].set_ylabel(scenario.replace("_", " "), fontsize=style.PAPER_PT)
    caption = (
        "Seen from above, x to the right; each drone in its colour, with a dot where it was last in the air; dashed: "
        "path of the reference's centre. All panels of a row have the same scale. No path: the flight failed."
    )
    return style.ReportFigure("paths.png", "Paths of the drones, first seed", caption, figure)


def _box(board: Board, scenario: str, first_seed_rows: dict[tuple[str, str], Row]) -> tuple[Any, Any]:
    """Return the lower and upper corners [m] of the box around all paths of a scenario, with a margin of 1 m."""
    rows = [first_seed_rows[scenario, law] for law in board.laws if (scenario, law) in first_seed_rows]
    positions = np.concatenate([np.zeros((1, 2)), *(np.array(row["track_m"], float).reshape(-1, 2) for row in rows)])
    return np.nanmin(positions, axis=0) - 1.0, np.nanmax(positions, axis=0) + 1.0


def _shapes(board: Board, first_seed_rows: dict[tuple[str, str], Row]) -> style.ReportFigure:
    columns = min(2, len(board.scenarios))
    lines = -(-len(board.scenarios) // columns)
    figure = style.new_figure(style.PAGE_IN, 0.4 + 1.7 * lines)
    panels = figure.subplots(lines, columns, sharex=True, squeeze=False)
    for axes in panels.flat[len(board.scenarios) :]:
        axes.set_visible(False)
    for axes, scenario in zip(panels.flat, board.scenarios, strict=False):
        for index, law in enumerate(board.laws):
            row = first_seed_rows.get((scenario, law))
            errors = np.array(row["track_shape_m"] if row else [], float)
            if row and np.isfinite(errors).any():
                name = law.replace("_", " ")
                axes.plot(row["track_t_s"], errors, color=COLOURS[index % len(COLOURS)], lw=0.8, label=name)
        style.dress(axes, "shape error (m)")
        axes.set_yscale("log")
        axes.set_title(scenario.replace("_", " "), fontsize=style.PAPER_PT, color=style.DARK)
    for axes in panels[-1]:
        axes.set_xlabel("simulated time (s)", fontsize=style.PAPER_PT)
    style.legend_above(figure, panels[0, 0])
    descriptions = "; ".join(f"{each.replace('_', ' ')}: {about(each)}" for each in board.scenarios)
    caption = (
        "Root mean square distance of the drones from their desired positions, after the best fit of what the law "
        "leaves open; laws without desired positions, or whose flight failed, are not shown. "
        f"{descriptions[0].upper()}{descriptions[1:]}."
    )
    return style.ReportFigure("shapes.png", "Shape error over time, first seed", caption, figure)
