"""How the runs of a comparison are told apart in all its figures."""

from typing import Any, NamedTuple

from zsim_analysis.report.pages import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILION


class RunStyle(NamedTuple):
    """Colour, dashes and mark of a run of a comparison: runs are distinct in black and white as well."""

    color: str
    dashes: Any
    marker: str


STYLES = (
    RunStyle(BLUE, "-", "o"),
    RunStyle(VERMILION, (0, (6, 2)), "s"),
    RunStyle(GREEN, (0, (6, 2, 1.5, 2)), "^"),
    RunStyle(PURPLE, (0, (2.5, 1.5)), "D"),
    RunStyle(ORANGE, (0, (10, 3)), "v"),
    RunStyle(SKY, (0, (6, 2, 1.5, 2, 1.5, 2)), "P"),
)


def run_style(index: int) -> RunStyle:
    """Return how a run is drawn; from the seventh on colours repeat with other dashes."""
    repeats, place = divmod(index, len(STYLES))
    return STYLES[place]._replace(dashes=STYLES[(index + repeats) % len(STYLES)].dashes)
