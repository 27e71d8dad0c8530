"""Where the points of a grid stand on the x axis of a figure: numbers at their value, everything else side by side."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullLocator
from msgspec import Struct

from zsim_analysis.report.pages import BLACK, BLUE, GREEN, ORANGE, PAPER_PT, PURPLE, SKY, VERMILION
from zsim_analysis.sweep.axes import Grid
from zsim_analysis.sweep.design import SweepDesign
from zsim_analysis.sweep.report.field_names import field_name
from zsim_analysis.sweep.report.labels import LEVEL_LETTERS, wrapped

POINTS_MAX = 24  # beside each other in one panel; the tables have all
SERIES = (BLUE, GREEN, PURPLE, ORANGE, SKY, BLACK)  # colours of the combinations of the other fields
DECADES_MIN = 30.0  # ratio of the greatest and the least value from which an axis is logarithmic
TURNED_FROM = 34  # characters of all labels, with a space each, that stand side by side in a panel
ABOVE = 1.1  # of the height of axes: clear of runs, and of the marks of intervals that leave the axes
MARK = VERMILION
TICKS_MAX = 8  # values that are written at an axis; of more, some


class Place(Struct, frozen=True):
    """Where a point of the grid is drawn.

    Attributes:
        x: of its middle.
        room: from the least to the greatest x that is its own, so that runs can be spread over it.
        series: which combination of the other fields it belongs to.
    """

    x: float
    room: tuple[float, float]
    series: int = 0


class GridAxis:
    """The x axis of a sweep over a grid.

    Args:
        design: of more than one point.

    Attributes:
        field: whose numbers the axis has; None where the points stand side by side.
        series: texts of the combinations of the other fields, one "" where there are none.
        places: by point.
    """

    def __init__(self, design: SweepDesign) -> None:
        self._design = design
        self._at = [design.at(point) for point in range(design.points)]
        self._names = [design.names(point) for point in range(design.points)]
        self.field = _numeric_field(design, self._at)
        self.series = list(dict.fromkeys(self._combination(names) for names in self._names)) if self.field else [""]
        self.is_logarithmic = bool(self.field) and _has_decades(self._numbers())
        self.places = self._on_numbers() if self.field else self._side_by_side()

    def colour(self, place: Place) -> str:
        """Return the colour of the runs at a place."""
        return SERIES[place.series]

    @property
    def label(self) -> str:
        """Return the full name of what the axis shows, with its unit."""
        return str(field_name(self.field)) if self.field else " · ".join(str(field_name(path)) for path in self._at[0])

    @property
    def is_turned(self) -> bool:
        """Return whether the labels are too long to stand side by side."""
        return not self.field and sum(len(text) + 1 for text in self._labels()) > TURNED_FROM

    def mark(self, axes: Axes, points: Sequence[int]) -> None:
        """Draw a cross above axes where some points stand."""
        style: dict[str, Any] = {"color": MARK, "ms": 6, "mew": 1.6, "clip_on": False}
        for place in (self.places[point] for point in points if point in self.places):
            axes.plot([place.x], [ABOVE], "x", transform=axes.get_xaxis_transform(), **style)

    def dress(self, axes: Axes) -> None:
        """Give axes this x axis, when all is drawn."""
        if self.field:
            self._dress_numbers(axes)
        else:
            turned = self.is_turned
            axes.set_xticks(
                range(len(self.places)),
                self._labels(),
                rotation=45 if turned else 0,
                ha="right" if turned else "center",
            )
            axes.grid(False, axis="x")
            axes.set_xlim(-0.6, len(self.places) - 0.2)
            axes.tick_params(axis="x", labelsize=PAPER_PT - 1.5 if turned else PAPER_PT - 1)
        axes.set_xlabel(wrapped(self.label, LEVEL_LETTERS), fontsize=PAPER_PT)

    def _dress_numbers(self, axes: Axes) -> None:
        names = dict(zip(self._numbers(), (each[self.field or ""] for each in self._names), strict=True))
        if self.is_logarithmic:
            axes.set_xscale("log")
            axes.xaxis.set_minor_locator(NullLocator())
        ticks = sorted(names)[:: -(-len(names) // TICKS_MAX)]
        axes.set_xticks(ticks, [names[tick] for tick in ticks])
        rooms = [end for place in self.places.values() for end in place.room]
        low, high = (float(self._space(np.array(end))) for end in (min(rooms), max(rooms)))
        axes.set_xlim(*(float(self._value(end)) for end in (low - 0.03 * (high - low), high + 0.03 * (high - low))))

    def _labels(self) -> list[str]:
        return [" · ".join(names.values()) for names in self._names[:POINTS_MAX]]

    def _numbers(self) -> list[float]:
        return [float(at[self.field]) for at in self._at] if self.field else []

    def _combination(self, names: dict[str, str]) -> str:
        return ", ".join(field_name(path).at(value) for path, value in names.items() if path != self.field)

    def _space(self, values: Any) -> Any:
        return np.log10(values) if self.is_logarithmic else values

    def _value(self, places: Any) -> Any:
        return 10.0**places if self.is_logarithmic else places

    def _on_numbers(self) -> dict[int, Place]:
        numbers = self._space(np.array(self._numbers()))
        distinct = np.unique(numbers)
        width = 0.6 * min(float(np.diff(distinct).min()), float(np.ptp(distinct)) / 6)
        each = width / len(self.series)
        places = {}
        for point, (number, names) in enumerate(zip(numbers, self._names, strict=True)):
            series = self.series.index(self._combination(names))
            left = number - width / 2 + series * each
            x, low, high = (float(self._value(left + share * each)) for share in (0.5, 0.15, 0.85))
            places[point] = Place(x, (low, high), series)
        return places

    def _side_by_side(self) -> dict[int, Place]:
        shown_points = range(min(len(self._at), POINTS_MAX))
        return {point: Place(float(point), (point - 0.18, point + 0.18)) for point in shown_points}


def _numeric_field(design: SweepDesign, at: Sequence[dict[str, Any]]) -> str | None:
    """Return the path with the most numbers, None if there is none, or too many combinations of the others."""
    grids = [axis for axis in design.axes if isinstance(axis, Grid) and len(axis.values) > 1]
    numeric = [grid for grid in grids if all(type(value) in (int, float) for value in grid.values)]
    if not numeric:
        return None
    chosen = max(numeric, key=lambda grid: len(grid.values))
    return chosen.path if len(at) <= len(chosen.values) * len(SERIES) else None


def _has_decades(values: Sequence[float]) -> bool:
    """Return whether values are seen better on a logarithmic axis: positive, over decades, most of them small."""
    distinct = sorted(set(values))
    if distinct[0] <= 0 or distinct[-1] < DECADES_MIN * distinct[0]:
        return False
    steps = [b - a for a, b in pairwise(distinct)]
    return max(steps) > 2 * min(steps)
