"""Tables keep names, units and figures whole at any width; colours of drones are distinct for any colour vision."""

import ast
import io
import re
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from zsim.presentation import Column, FittedTable, drone_colours, rgb

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


def test_the_least_important_columns_are_dropped_first() -> None:
    table = FittedTable(COLUMNS, ROWS)
    left = [tuple(table.left_out(width)) for width in (120, 55, 45)]
    assert left == [(), ("round trip",), ("lag", "round trip")]


@pytest.mark.parametrize("width", [30, 45, 80, 120])
def test_names_keep_their_ends(width: int) -> None:
    names = [line.split()[0] for line in lines(FittedTable(COLUMNS, ROWS, one_line=True), width)[-len(ROWS) :]]
    assert len(set(names)) == len(ROWS)
    assert all(row[0].endswith(name.removeprefix("…")) for name, row in zip(names, ROWS, strict=True))


def test_a_one_line_row_is_truncated_at_its_end() -> None:
    text = lines(FittedTable(COLUMNS, ROWS, one_line=True), 60)
    assert len(text) == 1 + len(ROWS)
    assert all("…" in line for line in text[-len(ROWS) :])


def test_terminal_control_codes_are_escaped() -> None:
    table = FittedTable([Column("\x1b[2J", "name"), Column("b", "text")], [("\x1b[2J", "\x07")], "\x1b", "\x9b")
    assert not {"\x1b", "\x07", "\x9b"} & set("".join(lines(table, 80)))


HOME = Path(__file__).parents[3]
DRAWN_IN = (
    "agents/zsim_bridges/console/scene.py",
    "deploy/zsim_analysis/export/foxglove_messages.py",
    "deploy/zsim_analysis/report/flight_figures.py",
    "deploy/zsim_analysis/report/comparison.py",
)
# Linear RGB as dichromats see it [Viénot, Brettel, Mollon 1999]: without L cones, and without M cones.
DICHROMATS = (
    np.array([[0.11238, 0.88762, 0.0], [0.11238, 0.88762, 0.0], [0.00401, -0.00401, 1.0]]),
    np.array([[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]]),
)
DISTINCT = 10.0  # ΔE*ab; 2.3 is just noticeable


def lab(colour: np.ndarray) -> np.ndarray:
    """Return CIE L*a*b* of linear RGB."""
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    x, y, z = np.cbrt(to_xyz @ np.clip(colour, 1e-6, 1) / to_xyz.sum(axis=1))
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def linear(text: str) -> np.ndarray:
    return (np.array(rgb(text)) / 255) ** 2.2


@pytest.mark.parametrize("count", [2, 3, 6])
@pytest.mark.parametrize("seen", [np.eye(3), *DICHROMATS])
def test_few_drones_are_distinct_for_every_colour_vision(count: int, seen: np.ndarray) -> None:
    looks = [lab(seen @ linear(each)) for each in drone_colours(count)]
    assert min(np.linalg.norm(a - b) for a, b in combinations(looks, 2)) > DISTINCT


@pytest.mark.parametrize("count", [7, 30, 100])
@pytest.mark.parametrize("seen", [np.eye(3), *DICHROMATS])
def test_colours_of_many_drones_run_from_dark_to_light(count: int, seen: np.ndarray) -> None:
    colours = drone_colours(count)
    assert len(set(colours)) == count
    assert all(re.fullmatch("#[0-9a-f]{6}", each) for each in colours)
    lightness = [lab(seen @ linear(each))[0] for each in colours]
    assert all(a < b for a, b in pairwise(lightness))
    assert lightness[-1] < 80  # white is 100, so that the colour is visible on paper


@pytest.mark.parametrize("place", DRAWN_IN)
def test_every_module_that_draws_drones_uses_this_palette(place: str) -> None:
    tree = ast.parse((HOME / place).read_text())
    taken = [node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    assert "zsim.presentation" in taken
