"""Curves of a formation's variables on the page: desired, estimated, true; only those that are chosen are sent."""

from typing import Any

import numpy as np
import viser
from viser import uplot

from zsim_agents.formation.spaces.cluster_space import ClusterSpace
from zsim_bridges.console.forms.slider_limits import SliderRange
from zsim_bridges.console.scene.variable_history import SERIES, SPAN_S, VariableHistory

PLOTS_SHOWN = 3  # plots
COLOURS = ("#868e96", "#1971c2", "#e8590c")  # of SERIES
HEIGHT_PX = 150
AXIS_PX = 56  # of figures such as -12.5, which would be clipped
NONE = "none"


class VariablePlots:
    """Plots of one formation, three variables at a time.

    Args:
        gui: viser's, in the place where they are to be.
        space: of the formation.
        ranges: of its variables.
    """

    def __init__(self, gui: viser.GuiApi, space: ClusterSpace, ranges: list[SliderRange]) -> None:
        self.history = VariableHistory(space.size)
        self._ranges = ranges
        self._in_degrees = [each.unit == "deg" for each in ranges]
        self._choices = {_title(ranges[k : k + PLOTS_SHOWN]): k for k in range(0, len(ranges), PLOTS_SHOWN)}
        self._choice = gui.add_dropdown("variables", [NONE, *self._choices], initial_value=next(iter(self._choices)))
        gui.add_markdown(f"<sub>{_legend()} over time [s], the last {SPAN_S:g} s</sub>")
        self._plots = [_plot(gui, each) for each in ranges[:PLOTS_SHOWN]]
        self._first: int | None = 0

    def draw(self) -> None:
        """Send the curves that are chosen."""
        first = self._choices.get(self._choice.value)
        if first != self._first:
            self._first = first
            self._retitle()
        if first is None:
            return
        for place, plot in enumerate(self._plots[: len(self._ranges) - first], start=first):
            curves = self.history.curves(place, self._in_degrees[place])
            if len(curves[0]) > 1:
                plot.data = curves

    def _retitle(self) -> None:
        shown = [] if self._first is None else self._ranges[self._first : self._first + PLOTS_SHOWN]
        for place, plot in enumerate(self._plots):
            plot.visible = place < len(shown)
            if plot.visible:
                plot.title = shown[place].label
                plot.data = tuple(np.zeros(2) for _ in range(1 + len(SERIES)))


def _title(ranges: list[SliderRange]) -> str:
    return ", ".join(each.name for each in ranges)


def _legend() -> str:
    return ", ".join(f"<span style='color:{c}'>{name}</span>" for name, c in zip(SERIES, COLOURS, strict=True))


def _plot(gui: viser.GuiApi, range_: SliderRange) -> Any:
    curves = [uplot.Series(label=n, stroke=c, width=1.5) for n, c in zip(SERIES, COLOURS, strict=True)]
    none = tuple(np.array([0.0, 1.0]) for _ in range(1 + len(SERIES)))
    return gui.add_uplot(
        none,
        (uplot.Series(label="t [s]"), *curves),
        title=range_.label,
        height=HEIGHT_PX,
        axes=(uplot.Axis(), uplot.Axis(size=AXIS_PX)),
        scales={"x": uplot.Scale(time=False, auto=True)},
        legend=uplot.Legend(show=False),
    )
