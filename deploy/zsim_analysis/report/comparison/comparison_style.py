"""How the runs of a comparison are told apart, and how they stand beside each other.

Runs differ in colour, in the dashes of their lines and in the marks of their points, so that they can be told apart in
black and white as well.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

from zsim_analysis.report.comparison.comparison import Compared
from zsim_analysis.report.figures.canvas import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILION

COLUMNS = 3  # runs beside each other in a row of a figure, at most
WIDTH_IN = 12.0  # of the figures on the page


class Style(NamedTuple):
    """How a run is drawn."""

    color: str
    dashes: Any
    marker: str


STYLES = (
    Style(BLUE, "-", "o"),
    Style(VERMILION, (0, (6, 2)), "s"),
    Style(GREEN, (0, (6, 2, 1.5, 2)), "^"),
    Style(PURPLE, (0, (2.5, 1.5)), "D"),
    Style(ORANGE, (0, (10, 3)), "v"),
    Style(SKY, (0, (6, 2, 1.5, 2, 1.5, 2)), "P"),
)


def style(index: int) -> Style:
    """Return how a run is drawn; from the seventh on colours come again with other dashes."""
    turn = index // len(STYLES)
    found = STYLES[index % len(STYLES)]
    return found if not turn else found._replace(dashes=STYLES[(index + turn) % len(STYLES)].dashes)


def columns(runs: Sequence[Compared]) -> int:
    """Return how many runs stand beside each other: rows as full as can be."""
    rows = -(-len(runs) // COLUMNS)
    return -(-len(runs) // rows)
