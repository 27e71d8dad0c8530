"""How all figures look: colours, axes, legends, the points of a line, and the file of a figure."""

import io
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from msgspec import Struct

from zsim_agents.formation.spaces.cluster_space import unit
from zsim_analysis.reading.flight import Array

DPI = 120
POINTS = 2000  # per line: more than a page has pixels
# Okabe and Ito's colours, distinct with every kind of colour vision.
BLACK, ORANGE, SKY, GREEN = "#000000", "#e69f00", "#56b4e9", "#009e73"
BLUE, VERMILION, PURPLE = "#0072b2", "#d55e00", "#cc79a7"
GREY, DARK = "#8c959f", "#444c56"
DRONES = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
DESIRED: dict[str, Any] = {"color": BLACK, "lw": 1.2, "ls": (0, (5, 3)), "zorder": 4}
MEASURED: dict[str, Any] = {"color": ORANGE, "lw": 0.8, "zorder": 3}
TRUE: dict[str, Any] = {"color": BLUE, "lw": 1.1, "zorder": 2}


SYMBOLS = {
    "x_c": "$x_c$",
    "y_c": "$y_c$",
    "z_c": "$z_c$",
    "roll": "roll",
    "pitch": "pitch",
    "yaw": "yaw",
    "p": "$p$",
    "q": "$q$",
    "beta": "$\\beta$",
}
GREEK = {"phi": "\\phi", "rho": "\\rho"}


class ReportFigure(Struct, frozen=True):
    """A figure with its file name, and its title and caption on the page."""

    name: str
    title: str
    caption: str
    drawing: Figure

    def png(self) -> bytes:
        """Return the figure as a PNG file."""
        file = io.BytesIO()
        self.drawing.savefig(file, format="png")
        return file.getvalue()


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure that lays itself out; nothing of matplotlib's global state is used."""
    return Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained")


def dress(axes: Axes, label: str = "") -> None:
    """Give axes their grid and the label of their y axis."""
    axes.grid(True, color="#d8dee4", lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=9)
    axes.margins(x=0.01)
    if label:
        axes.set_ylabel(label, fontsize=10)


def label_time(axes: Iterable[Axes]) -> None:
    """Label the time axis of axes."""
    for each in axes:
        each.set_xlabel("simulated time (s)", fontsize=10)


def label(name: str) -> str:
    """Return the label of a parameter at an axis, with its unit."""
    stem, _, number = name.partition("_")
    greek = f"${GREEK[stem]}_{{{number}}}$" if stem in GREEK else name
    return f"{SYMBOLS.get(name, greek)} ({unit(name)})"


def line(axes: Axes, x: Array, y: Array, **style: Any) -> None:
    """Draw a line with no more points than are visible."""
    axes.plot(*thinned(x, y), **style)


def legend_above(figure: Figure, axes: Axes, columns: int = 6) -> None:
    """Put the legend of some axes above all axes of the figure, where it covers no data."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        figure.legend(
            handles,
            labels,
            loc="outside upper center",
            ncols=min(columns, len(handles)),
            frameon=False,
            fontsize=10,
        )


def thinned(x: Array, y: Array, points: int = POINTS) -> tuple[Array, Array]:
    """Return a line of at most `points` points: the least and the greatest of each bin, no extreme lost."""
    if len(x) <= points:
        return x, y
    size = -(-len(x) // (points // 2))
    starts = range(0, len(x), size)
    kept = np.unique([index for start in starts for index in _extremes(y[start : start + size], start)])
    return x[kept], y[kept]


def _extremes(y: Array, start: int) -> Sequence[int]:
    if not np.isfinite(y).any():
        return (start,)
    return (start + int(np.nanargmin(y)), start + int(np.nanargmax(y)))


def drone_colour(index: int) -> str:
    return DRONES[index % len(DRONES)]


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
