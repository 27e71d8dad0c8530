"""The recent past of a run, in memory: trails of its drones, and points of variables, with the plots that show them.

In a flight, both cover a few minutes, and restart when time goes back. In a replay, they contain what has been read
from the record near the shown time, in whatever order it was read.
"""

import math
import threading
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import viser
from numpy.typing import NDArray
from viser import uplot

from zsim.contract.flight_messages import EstimateView
from zsim.math import frames
from zsim.scenario.scenario import Cluster
from zsim_agents.formation.spaces.cluster_space import unit
from zsim_bridges.console.picture import PLAN_DIGITS, Array, DronePoses

Row = TypeVar("Row")

SPAN_S = 180.0  # simulated; maximum length of trails and curves
INTERVAL_S = 0.25  # simulated; minimum time between two points of a curve; formations take seconds to respond
HISTORY_POINTS_MAX = int(SPAN_S / INTERVAL_S)
SERIES = ("desired", "estimated", "true")

TRAIL_POINTS_MAX = 6_000  # maximum number of points of all trails together: 144 kB sent to a browser at each update
TRAILS_S = (10.0, 30.0, 60.0, SPAN_S)  # selectable lengths of trails, simulated
TRAIL_S = 60.0  # initial length of trails, simulated
SPACING_M = 0.08  # minimum distance between two points of a trail: a sixth of the width of a hull
SPACING_S = 0.05  # simulated; minimum time between two points of a trail: the period of pictures at 1 × real time
RECORD_GAP_S = 5.0  # simulated; a larger gap in a record has not been read yet, so nothing is drawn across it
SEGMENT_MIN_M = 1e-3  # minimum length of a segment that is drawn: a stationary drone leaves no trail
PLOTS_SHOWN = 3  # number of plots shown at once
COLOURS = ("#868e96", "#1971c2", "#e8590c")  # colours of SERIES
HEIGHT_PX = 150
PADDING_PX = (8, 24, 0, 0)  # clockwise from the top, where the topmost number needs space; on the right as in viser
AXIS_PX = 56  # wide enough for numbers such as -12.5
CURSOR_COLOUR = "#7048e8"  # colour of the line at the time that a replay shows
BLANK = (np.array([0.0, 1.0]), *(np.full(2, np.nan) for _ in SERIES))  # data of a plot that has no points yet
NONE = "none"
STEPS_PER_WINDOW = 6  # number of steps in which a time axis advances by its length; plots are recreated at each step
CURVE_POINTS_MIN = 2  # minimum number of points of a curve that is drawn
VALUE_RANGE_MIN = 0.01  # minimum range of values from which the steps of an axis are derived, in the values' unit
WINDOWS_S = (SPAN_S, 60.0, 20.0)  # selectable lengths of plots, simulated
FLIGHT_UNITS = {
    "x": "m",
    "y": "m",
    "z": "m",
    "yaw": "deg",
    "roll": "deg",
    "pitch": "deg",
}  # variables of each drone, with units
ESTIMATED_COUNT = 4  # number of these that are estimated, the first ones: views of estimates have no roll or pitch
DESIRED, TRUE = SERIES.index("desired"), SERIES.index("true")


class _TimedRows(Generic[Row]):
    """Rows ordered by their time [s]."""

    def __init__(self) -> None:
        self.times: list[float] = []
        self.rows: list[Row] = []

    def is_near(self, t_s: float, within_s: float) -> bool:
        """Return whether there is a row less than `within_s` from a time."""
        index = bisect_left(self.times, t_s)
        return any(abs(other_s - t_s) < within_s for other_s in self.times[max(0, index - 1) : index + 1])

    def insert(self, t_s: float, row: Row) -> None:
        index = bisect_left(self.times, t_s)
        self.times.insert(index, t_s)
        self.rows.insert(index, row)

    def keep(self, from_s: float, to_s: float = math.inf) -> None:
        begin, end = bisect_left(self.times, from_s), bisect_left(self.times, to_s)
        del self.times[end:], self.rows[end:], self.times[:begin], self.rows[:begin]


class CanvasTrails:
    """The trails of N drones: the recent positions of each.

    Args:
        count: N.
        is_replay: whether the trails are those of a record, which is read on both sides of the shown time.

    Attributes:
        length_s: length of the trails, simulated.
        number: changes whenever the trails change other than by extension.
    """

    def __init__(self, count: int, is_replay: bool = False) -> None:
        self._count = count
        self._is_replay = is_replay
        self._points = _TimedRows[NDArray[np.float32]]()
        self.length_s = TRAIL_S
        self.number = 0

    def add(self, t_s: float, p_W: Array) -> None:
        """Add positions (N, 3) [m] at a simulated time, NaN for a drone that is not in the view.

        Positions are skipped within SPACING_S of others; in a flight, also while no drone has moved by SPACING_M.
        """
        points = self._points
        if not self._is_replay and points.times and t_s < points.times[-1]:
            self._points = points = _TimedRows()
            self.number += 1
        if points.is_near(t_s, SPACING_S * 0.99):
            return
        if not self._is_replay and points.rows:
            moved_m = np.linalg.norm(p_W - points.rows[-1], axis=1)
            appears = np.isfinite(p_W[:, 0]) & ~np.isfinite(points.rows[-1][:, 0])
            if not (appears | (moved_m >= SPACING_M)).any():
                return
        points.insert(t_s, p_W.astype(np.float32))
        if not self._is_replay:
            points.keep(t_s - SPAN_S)

    def keep(self, from_s: float, to_s: float) -> None:
        self._points.keep(from_s, to_s)

    def choose_length(self, length_s: float) -> None:
        """Set the length of the trails [s, simulated]."""
        self.length_s = length_s
        self.number += 1

    def segments(self, t_s: float, p_W: Array) -> tuple[Array, NDArray[np.int64], Array]:
        """Return the trails, which end at positions (N, 3) at `t_s`, as M segments; excess points are thinned evenly.

        Returns:
            the segments' ends (M, 2, 3), indices of their drones (M,), and times at which they begin (M,).
        """
        points = self._points
        begin, end = bisect_left(points.times, t_s - self.length_s), bisect_left(points.times, t_s)
        times = np.array(points.times[begin:end])
        rows = np.arange(len(times))
        if len(times) * self._count > TRAIL_POINTS_MAX:
            # Trails would flicker if the step changed often, or if other points were selected each time.
            step_s = 2.0 ** math.ceil(math.log2((times[-1] - times[0]) * self._count / TRAIL_POINTS_MAX))
            rows = np.flatnonzero(np.diff(np.floor(times / step_s), prepend=-math.inf))
        times = np.append(times[rows], t_s)
        path = np.stack([*(points.rows[begin + k] for k in rows), p_W]).astype(float)
        lines = np.stack((path[:-1], path[1:]), axis=2).transpose(1, 0, 2, 3)  # drone, time, end, axis
        drawn = np.linalg.norm(lines[:, :, 1] - lines[:, :, 0], axis=2) > SEGMENT_MIN_M  # False for NaN
        drawn &= np.isfinite(p_W[:, :1])
        drawn &= (np.diff(times) < RECORD_GAP_S) | (not self._is_replay)
        owners, begins = np.nonzero(drawn)
        return lines[drawn], owners, times[begins]

    def lines(self, t_s: float, p_W: Array) -> list[list[list[float]]]:
        """Return the segments of each drone's trail in plan view: x and y [m; W] and time [s] at which each begins."""
        segments, owners, times = self.segments(t_s, p_W)
        points = np.round(np.column_stack((segments[:, 0, :2], times)), PLAN_DIGITS)
        return [points[owners == i].tolist() for i in range(self._count)]


class VariableHistory:
    """Points of some variables, each with the values of `SERIES`.

    Args:
        is_replay: whether the points are those of a record, which is read on both sides of the shown time.
    """

    def __init__(self, size: int, is_replay: bool = False) -> None:
        self._size = size
        self._is_replay = is_replay
        self._points = _TimedRows[Array]()
        self._lock = threading.Lock()  # pages read curves in their own threads

    def is_due(self, t_s: float) -> bool:
        """Return whether a point at a time [s] would be added."""
        if self._is_replay:
            return not self._points.is_near(t_s, INTERVAL_S / 2.0)
        times = self._points.times
        return not times or not 0.0 <= t_s - times[-1] < INTERVAL_S

    def add(
        self, t_s: float, desired: Sequence[float] | None, value: Sequence[float] | Array, true: Array | None
    ) -> bool:
        """Add a point at a simulated time, unless another one is too close in time; return whether it was added.

        `desired`, `value` and `true` have shape (size,), m and rad; None where unknown.
        """
        unknown = np.full(self._size, np.nan)
        row = np.array([unknown if each is None else np.asarray(each, float) for each in (desired, value, true)])
        with self._lock:
            points = self._points
            if not self._is_replay and points.times and t_s < points.times[-1]:
                self._points = points = _TimedRows()
            if not self.is_due(t_s):
                return False
            points.insert(t_s, row)
            if not self._is_replay:
                # by age as well as by number, since the points of a fast run are sparse
                points.keep(max(t_s - SPAN_S, points.times[-HISTORY_POINTS_MAX:][0]))
        return True

    def keep(self, from_s: float, to_s: float) -> None:
        with self._lock:
            self._points.keep(from_s, to_s)

    def curves(
        self,
        index: int,
        angular: bool,
        span_s: float = SPAN_S,
        subtracted: int | None = None,
        at_s: float | None = None,
    ) -> tuple[Array, ...]:
        """Return times (M,) and three curves (M,) of a variable, in the order of `SERIES`; angles in degrees, wrapped.

        A curve is interrupted (NaN) where an angle wraps.

        Args:
            span_s: length of the curves.
            subtracted: index in `SERIES` of the curve that is subtracted, for errors; None for values.
            at_s: time at the centre of the curves; None: they end at the newest point.
        """
        with self._lock:
            t = np.array(self._points.times)
            table = np.array([row[:, index] for row in self._points.rows]).reshape(-1, len(SERIES))
        shown = t >= (t[-1] if len(t) else 0.0) - span_s if at_s is None else abs(t - at_s) <= span_s / 2.0
        t, table = t[shown], table[shown]
        if subtracted is not None:
            table = table - table[:, [subtracted]]
        if angular:
            table = np.degrees(np.arctan2(np.sin(table), np.cos(table)))
            wraps = np.abs(np.diff(table, axis=0, prepend=table[:1])) > 180.0
            table = np.where(wraps, np.nan, table)
        return t, *table.T


class PlottedVariable(NamedTuple):
    """A variable that can be plotted."""

    history: VariableHistory
    column: int  # its index in the history
    label: str  # its name and unit
    angular: bool
    reference: int  # index in SERIES of the curve to which errors are relative


class FlightHistory:
    """Points of all drones of a run, each with the variables of FLIGHT_UNITS; `is_replay` as in `VariableHistory`."""

    def __init__(self, names: Sequence[str], is_replay: bool = False) -> None:
        self.names = tuple(names)
        self.history = VariableHistory(len(names) * len(FLIGHT_UNITS), is_replay)

    def add(self, drones: DronePoses, estimates: Mapping[str, EstimateView]) -> None:
        """Add the drones' true and estimated poses, if the last point is old enough."""
        if not self.history.is_due(drones.t_ns / 1e9):
            return
        estimated = np.full((len(self.names), len(FLIGHT_UNITS)), np.nan)
        for i, name in enumerate(self.names):
            if name in estimates:
                estimated[i, :ESTIMATED_COUNT] = *estimates[name].position_m, estimates[name].yaw_rad
        rpy = frames.rpy_from_quaternion(drones.q_WB)
        true = np.column_stack((drones.p_W, rpy[:, [2, 0, 1]]))
        true[~drones.present] = np.nan
        self.history.add(drones.t_ns / 1e9, None, estimated.ravel(), true.ravel())

    def variables(self, name: str) -> list[PlottedVariable]:
        first = self.names.index(name) * len(FLIGHT_UNITS)
        return [
            PlottedVariable(self.history, first + k, f"{variable} of {name} [{unit}]", unit == "deg", TRUE)
            for k, (variable, unit) in enumerate(FLIGHT_UNITS.items())
        ]


class VariablePlots:
    """Plots of one formation and of its drones, three variables at a time.

    The curves of a replay extend beyond the shown time.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        cluster: Cluster,
        names: Sequence[str],
        flights: FlightHistory,
        is_replay: bool = False,
    ) -> None:
        self.history = VariableHistory(len(names), is_replay=is_replay)
        self._cursor_s: float | None = 0.0 if is_replay else None
        formation_variables = [
            PlottedVariable(self.history, k, f"{name} [{shown_unit(name)}]", shown_unit(name) == "deg", DESIRED)
            for k, name in enumerate(names)
        ]
        self._choices = _triples("", formation_variables)
        for name in cluster.drones:
            self._choices |= _triples(f"{name}: ", flights.variables(name))
        self._choice = gui.add_dropdown("variables", [NONE, *self._choices], initial_value=next(iter(self._choices)))
        windows = {
            f"{span_s:g} s around the shown time" if is_replay else f"the last {span_s:g} s": span_s
            for span_s in WINDOWS_S
        }
        self._window = gui.add_dropdown("window", list(windows))
        self._windows = windows
        self._errors = gui.add_checkbox("Errors", False, hint="Relative to desired values; for a drone, to true ones")
        self._freeze = gui.add_checkbox(
            "Freeze", False, hint="Drag over a plot to zoom, double-click to reset the zoom"
        )
        gui.add_markdown(f"<sub>{_legend(is_replay)} over time [s]; below a plot, the values at the cursor</sub>")
        self._plots = [_plot(gui, each, is_replay) for each in formation_variables[:PLOTS_SHOWN]]
        self._shown: tuple[PlottedVariable, ...] = tuple(formation_variables[:PLOTS_SHOWN])
        self._scales: dict[int, dict[str, uplot.Scale]] = {}  # by plot
        self._lock = threading.Lock()
        for control in (self._choice, self._window, self._errors):
            control.on_update(lambda _: self._redraw())

    def draw(self, t_s: float = 0.0) -> None:
        """Send the chosen curves, unless they are frozen; t_s is the time that a replay shows [s]."""
        if self._cursor_s is not None:
            self._cursor_s = t_s
        if not self._freeze.value:
            self._redraw()

    def _redraw(self) -> None:
        """Send the chosen curves; operators may choose others even after the end of a run."""
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
        subtracted = each.reference if self._errors.value else None
        at_s = self._cursor_s
        curves = each.history.curves(each.column, each.angular, span_s, subtracted, at_s)
        if len(curves[0]) < CURVE_POINTS_MIN:
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


def shown_unit(variable: str) -> str:
    """Return the unit in which pages show a variable of a formation: deg for an angle, otherwise m."""
    return "deg" if unit(variable) == "rad" else "m"


class AxisRange(NamedTuple):
    """The shown range of an axis, which changes in steps, since viser recreates a plot at each change."""

    low: float
    high: float

    @classmethod
    def of_times(cls, t_s: Array, span_s: float, at_s: float | None = None) -> "AxisRange":
        """Return the range of times (M,) [s], M > 0, in a window of `span_s`, around `at_s` if given.

        Without a range, viser would first derive one from the previous data, and a page that draws slowly would keep
        showing an empty interval.
        """
        step_s = span_s / STEPS_PER_WINDOW
        if at_s is not None:
            low_s = math.floor((at_s - span_s / 2.0) / step_s) * step_s
            return cls(low_s, low_s + span_s + step_s)
        return cls(math.floor(t_s[0] / step_s) * step_s, (math.floor(t_s[-1] / step_s) + 1) * step_s)

    @classmethod
    def of_values(cls, values: Sequence[Array], always: bool = False) -> "AxisRange | None":
        """Return the range of curves (M,) in one unit, NaN where unknown; None if uPlot can derive it.

        uPlot cannot derive it if a curve is entirely unknown. `always`: return it even if uPlot can derive it. If no
        value is known, return None.
        """
        known = np.concatenate(values)
        known = known[np.isfinite(known)]
        if not len(known) or not (always or any(np.isnan(each).all() for each in values)):
            return None
        lowest, highest = float(known.min()), float(known.max())
        step = 10.0 ** math.floor(math.log10(max(highest - lowest, VALUE_RANGE_MIN)))
        return cls((math.floor(lowest / step) - 0.5) * step, (math.ceil(highest / step) + 0.5) * step)


def _with_cursor(curves: Sequence[Array], at_s: float, values: AxisRange) -> tuple[Array, ...]:
    """Return the curves with a vertical line at a time as an additional curve."""
    index = int(np.searchsorted(curves[0], at_s))
    nearest = min(index, len(curves[0]) - 1)
    cursor = np.full(len(curves[0]) + 2, np.nan)
    cursor[index : index + 2] = values
    doubled = (np.insert(each, index, (each[nearest], each[nearest])) for each in curves[1:])
    return np.insert(curves[0], index, (at_s, at_s)), *doubled, cursor


def _triples(prefix: str, variables: list[PlottedVariable]) -> dict[str, tuple[PlottedVariable, ...]]:
    triples = [variables[k : k + PLOTS_SHOWN] for k in range(0, len(variables), PLOTS_SHOWN)]
    return {prefix + ", ".join(each.label.partition(" ")[0] for each in triple): tuple(triple) for triple in triples}


def _legend(is_replay: bool) -> str:
    lines = [*zip(SERIES, COLOURS, strict=True), *([("shown time", CURSOR_COLOUR)] if is_replay else [])]
    return ", ".join(f"<span style='color:{c}'>{name}</span>" for name, c in lines)


def _plot(gui: viser.GuiApi, variable: PlottedVariable, is_replay: bool) -> Any:
    curves = [uplot.Series(label=n, stroke=c, width=1.5) for n, c in zip(SERIES, COLOURS, strict=True)]
    curves += [uplot.Series(label="shown", stroke=CURSOR_COLOUR, width=2.0)] if is_replay else []
    return gui.add_uplot(
        (*BLANK, BLANK[1]) if is_replay else BLANK,
        (uplot.Series(label="t [s]"), *curves),
        title=variable.label,
        height=HEIGHT_PX,
        padding=PADDING_PX,
        axes=(uplot.Axis(), uplot.Axis(size=AXIS_PX)),
        scales={"x": uplot.Scale(time=False, range=(0.0, 1.0))},
        legend=uplot.Legend(show=True, live=True),
    )
