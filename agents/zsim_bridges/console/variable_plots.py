"""Plots of a formation's variables and of its drones' flight, three at a time."""

import math
import threading
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import viser
from viser import uplot

from zsim.contract.flight_messages import EstimateView
from zsim.math import frames
from zsim.scenario.scenario import Cluster
from zsim_bridges.console.histories import SERIES, SPAN_S, VariableHistory
from zsim_bridges.console.operator_input import SliderRange
from zsim_bridges.console.picture import Array, DronePoses

PLOTS_SHOWN = 3  # plots
COLOURS = ("#868e96", "#1971c2", "#e8590c")  # of SERIES
HEIGHT_PX = 150
PADDING_PX = (8, 24, 0, 0)  # at the top, for the whole of the highest figure; at the right as viser's
AXIS_PX = 56  # wide enough for figures such as -12.5
CURSOR_COLOUR = "#7048e8"  # of the instant that a replay shows
BLANK = (np.array([0.0, 1.0]), *(np.full(2, np.nan) for _ in SERIES))  # of a plot without points yet
NONE = "none"
STEPS_PER_WINDOW = 6  # of the time axis; chosen: plots are recreated every 30 s at most
LEAST_POINTS = 2  # of a curve
VALUES_LEAST = 0.01  # least range of values, in their unit
WINDOWS_S = (SPAN_S, 60.0, 20.0)  # simulated
FLIGHT = {"x": "m", "y": "m", "z": "m", "yaw": "deg", "roll": "deg", "pitch": "deg"}  # of each drone, with units
ESTIMATED = 4  # the first of them: views of estimates have no roll and pitch
DESIRED, TRUE = SERIES.index("desired"), SERIES.index("true")


class PlottedVariable(NamedTuple):
    """A variable that can be plotted."""

    history: VariableHistory
    column: int  # in the history
    label: str  # with its unit
    angular: bool
    reference: int  # index in SERIES of the curve that errors are relative to


class FlightHistory:
    """Points of all drones of a run, each with the variables of FLIGHT; `around`: of a record."""

    def __init__(self, names: Sequence[str], around: bool = False) -> None:
        self.names = tuple(names)
        self.history = VariableHistory(len(names) * len(FLIGHT), around)

    def add(self, drones: DronePoses, estimates: Mapping[str, EstimateView]) -> None:
        """Add the drones' true and estimated poses, if the last point is old enough."""
        if not self.history.is_due(drones.t_ns / 1e9):
            return
        believed = np.full((len(self.names), len(FLIGHT)), np.nan)
        for i, name in enumerate(self.names):
            if name in estimates:
                believed[i, :ESTIMATED] = *estimates[name].position_m, estimates[name].yaw_rad
        rpy = frames.rpy_from_quaternion(drones.q_WB)
        true = np.column_stack((drones.p_W, rpy[:, [2, 0, 1]]))
        true[~drones.present] = np.nan
        self.history.add(drones.t_ns / 1e9, None, believed.ravel(), true.ravel())

    def variables(self, name: str) -> list[PlottedVariable]:
        first = self.names.index(name) * len(FLIGHT)
        return [
            PlottedVariable(self.history, first + k, f"{variable} of {name} [{unit}]", unit == "deg", TRUE)
            for k, (variable, unit) in enumerate(FLIGHT.items())
        ]


class VariablePlots:
    """Plots of one formation and of its drones, three variables at a time.

    The curves of a record that is replayed extend beyond the shown instant.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        cluster: Cluster,
        ranges: list[SliderRange],
        flights: FlightHistory,
        replayed: bool = False,
    ) -> None:
        self.history = VariableHistory(len(ranges), around=replayed)
        self._cursor_s: float | None = 0.0 if replayed else None
        of_all = [
            PlottedVariable(self.history, k, each.label, each.unit == "deg", DESIRED) for k, each in enumerate(ranges)
        ]
        self._choices = _triples("", of_all)
        for name in cluster.drones:
            self._choices |= _triples(f"{name}: ", flights.variables(name))
        self._choice = gui.add_dropdown("variables", [NONE, *self._choices], initial_value=next(iter(self._choices)))
        windows = {f"{span_s:g} s around" if replayed else f"the last {span_s:g} s": span_s for span_s in WINDOWS_S}
        self._window = gui.add_dropdown("window", list(windows))
        self._windows = windows
        self._errors = gui.add_checkbox("Errors", False, hint="Against what is desired; of a drone, against truth")
        self._still = gui.add_checkbox(
            "Stand still", False, hint="Drag over a plot to zoom, double click for all of it"
        )
        gui.add_markdown(f"<sub>{_legend(replayed)} over time [s]; below a plot, the values at the cursor</sub>")
        self._plots = [_plot(gui, each, replayed) for each in of_all[:PLOTS_SHOWN]]
        self._shown: tuple[PlottedVariable, ...] = tuple(of_all[:PLOTS_SHOWN])
        self._scales: dict[int, dict[str, uplot.Scale]] = {}  # by plot
        self._lock = threading.Lock()
        for control in (self._choice, self._window, self._errors):
            control.on_update(lambda _: self._redraw())

    def draw(self, t_s: float = 0.0) -> None:
        """Send the chosen curves, unless they are to stand still; t_s is the instant that a replay shows."""
        if self._cursor_s is not None:
            self._cursor_s = t_s
        if not self._still.value:
            self._redraw()

    def _redraw(self) -> None:
        """Send the chosen curves; after the end of a run, too."""
        with self._lock:
            shown = self._choices.get(self._choice.value, ())
            if shown != self._shown:
                self._shown = shown
                for index, plot in enumerate(self._plots):
                    plot.visible = index < len(shown)
                    if plot.visible:
                        plot.title = shown[index].label
            for index, each in enumerate(shown):
                self._send(index, each)

    def _send(self, index: int, each: PlottedVariable) -> None:
        plot, span_s = self._plots[index], self._windows[self._window.value]
        less = each.reference if self._errors.value else None
        at_s = self._cursor_s
        curves = each.history.curves(each.column, each.angular, span_s, less, at_s)
        if len(curves[0]) < LEAST_POINTS:
            plot.data = BLANK if at_s is None else (*BLANK, BLANK[1])
            return
        scales = {"x": uplot.Scale(time=False, range=AxisRange.of_times(curves[0], span_s, at_s))}
        values = AxisRange.of_values(curves[1:], always=at_s is not None)
        if values is not None:
            scales["y"] = uplot.Scale(time=False, range=values)
        if at_s is not None:
            curves = _with_cursor(curves, at_s, values or AxisRange(0.0, 1.0))
        if scales != self._scales.get(index):
            self._scales[index] = plot.scales = scales
        plot.data = curves


class AxisRange(NamedTuple):
    """The shown range of an axis, in whole steps, since viser recreates a plot when its range changes."""

    low: float
    high: float

    @classmethod
    def of_times(cls, t_s: Array, span_s: float, at_s: float | None = None) -> "AxisRange":
        """Return the range of points of these times (M,) [s], M > 0, in a window of `span_s`, around at_s if given.

        viser derives an automatic range from the previous data before the first range is committed: a page that draws
        slowly would show a stretch without data for ever.
        """
        step_s = span_s / STEPS_PER_WINDOW
        if at_s is not None:
            low_s = math.floor((at_s - span_s / 2.0) / step_s) * step_s
            return cls(low_s, low_s + span_s + step_s)
        return cls(math.floor(t_s[0] / step_s) * step_s, (math.floor(t_s[-1] / step_s) + 1) * step_s)

    @classmethod
    def of_values(cls, values: Sequence[Array], always: bool = False) -> "AxisRange | None":
        """Return the range of curves (M,) of one unit, NaN where unknown; None where uPlot finds it itself.

        It does not where a curve is entirely unknown; `always`: return the range of other curves, too.
        """
        known = np.concatenate(values)
        known = known[np.isfinite(known)]
        if not len(known) or not (always or any(np.isnan(each).all() for each in values)):
            return None
        least, greatest = float(known.min()), float(known.max())
        step = 10.0 ** math.floor(math.log10(max(greatest - least, VALUES_LEAST)))
        return cls((math.floor(least / step) - 0.5) * step, (math.ceil(greatest / step) + 0.5) * step)


def _with_cursor(curves: Sequence[Array], at_s: float, values: AxisRange) -> tuple[Array, ...]:
    """Return curves with one more, a line across the range of values at an instant."""
    place = int(np.searchsorted(curves[0], at_s))
    nearest = min(place, len(curves[0]) - 1)
    cursor = np.full(len(curves[0]) + 2, np.nan)
    cursor[place : place + 2] = values
    doubled = (np.insert(each, place, (each[nearest], each[nearest])) for each in curves[1:])
    return np.insert(curves[0], place, (at_s, at_s)), *doubled, cursor


def _triples(of: str, variables: list[PlottedVariable]) -> dict[str, tuple[PlottedVariable, ...]]:
    triples = [variables[k : k + PLOTS_SHOWN] for k in range(0, len(variables), PLOTS_SHOWN)]
    return {of + ", ".join(each.label.partition(" ")[0] for each in triple): tuple(triple) for triple in triples}


def _legend(replayed: bool) -> str:
    lines = [*zip(SERIES, COLOURS, strict=True), *([("shown instant", CURSOR_COLOUR)] if replayed else [])]
    return ", ".join(f"<span style='color:{c}'>{name}</span>" for name, c in lines)


def _plot(gui: viser.GuiApi, variable: PlottedVariable, replayed: bool) -> Any:
    curves = [uplot.Series(label=n, stroke=c, width=1.5) for n, c in zip(SERIES, COLOURS, strict=True)]
    curves += [uplot.Series(label="shown", stroke=CURSOR_COLOUR, width=2.0)] if replayed else []
    return gui.add_uplot(
        (*BLANK, BLANK[1]) if replayed else BLANK,
        (uplot.Series(label="t [s]"), *curves),
        title=variable.label,
        height=HEIGHT_PX,
        padding=PADDING_PX,
        axes=(uplot.Axis(), uplot.Axis(size=AXIS_PX)),
        scales={"x": uplot.Scale(time=False, range=(0.0, 1.0))},
        legend=uplot.Legend(show=True, live=True),
    )
