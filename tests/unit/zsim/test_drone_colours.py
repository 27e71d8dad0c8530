"""One palette for reports, console and exports: few drones are distinct with every colour vision, many are in order."""

import ast
import re
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest

from zsim.drone_colours import drone_colours, rgb

HOME = Path(__file__).parents[3]
DRAWN_IN = (
    "agents/zsim_bridges/console/scene.py",
    "deploy/zsim_analysis/export/foxglove_messages.py",
    "deploy/zsim_analysis/report/drone_figures.py",
    "deploy/zsim_analysis/report/comparison_figures.py",
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
def test_few_drones_are_distinct_with_every_colour_vision(count: int, seen: np.ndarray) -> None:
    looks = [lab(seen @ linear(each)) for each in drone_colours(count)]
    assert min(np.linalg.norm(a - b) for a, b in combinations(looks, 2)) > DISTINCT


@pytest.mark.parametrize("count", [7, 30, 100])
@pytest.mark.parametrize("seen", [np.eye(3), *DICHROMATS])
def test_many_drones_go_from_dark_to_light(count: int, seen: np.ndarray) -> None:
    colours = drone_colours(count)
    assert len(set(colours)) == count
    assert all(re.fullmatch("#[0-9a-f]{6}", each) for each in colours)
    lightness = [lab(seen @ linear(each))[0] for each in colours]
    assert all(a < b for a, b in pairwise(lightness))
    assert lightness[-1] < 80  # of white 100: it is seen on paper


@pytest.mark.parametrize("place", DRAWN_IN)
def test_all_that_draws_drones_takes_this_palette(place: str) -> None:
    tree = ast.parse((HOME / place).read_text())
    taken = [node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    assert "zsim.drone_colours" in taken
