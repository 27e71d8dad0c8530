"""The recent past of a run, in memory: trails of its drones, and points of variables as plots show them. Pure.

Of a flight both go back a few minutes, and begin anew when time goes back. Of a replayed record they hold whatever was
read of it, in any order, until it is far from the shown instant.
"""

import math
import threading
from bisect import bisect_left
from collections.abc import Sequence
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from zsim_bridges.console.picture import Array

Row = TypeVar("Row")

SPAN_S = 180.0  # simulated; how far trails and curves go back at most
INTERVAL_S = 0.25  # simulated, between two points of a curve; a formation answers within seconds
HISTORY_POINTS_MAX = int(SPAN_S / INTERVAL_S)
SERIES = ("desired", "estimated", "true")

TRAIL_POINTS_MAX = 6_000  # of all trails together: 144 kB for a browser each time
TRAILS_S = (10.0, 30.0, 60.0, SPAN_S)  # selectable lengths of trails, simulated
TRAIL_S = 60.0  # initial length
SPACING_M = 0.08  # between two points of a trail: a sixth of a hull
SPACING_S = 0.05  # simulated, and in time: as often as pictures come at 1 × real time
RECORD_GAP_S = 5.0  # simulated; between points of a record farther apart it was not read yet, so nothing is drawn
STILL_M = 1e-3  # of a segment: a drone that does not move leaves no trail


class _TimedRows(Generic[Row]):
    """Rows ordered by their time [s]."""

    def __init__(self) -> None:
        self.times: list[float] = []
        self.rows: list[Row] = []

    def is_near(self, t_s: float, within_s: float) -> bool:
        """Return whether there is a row less than that far away in time."""
        place = bisect_left(self.times, t_s)
        return any(abs(other_s - t_s) < within_s for other_s in self.times[max(0, place - 1) : place + 1])

    def insert(self, t_s: float, row: Row) -> None:
        place = bisect_left(self.times, t_s)
        self.times.insert(place, t_s)
        self.rows.insert(place, row)

    def keep(self, from_s: float, to_s: float = math.inf) -> None:
        old, late = bisect_left(self.times, from_s), bisect_left(self.times, to_s)
        del self.times[late:], self.rows[late:], self.times[:old], self.rows[:old]


class CanvasTrails:
    """The trails of N drones: where each was within the last seconds.

    Args:
        count: N.
        around: whether they are of a record.

    Attributes:
        length_s: how far trails go back, simulated.
        number: changes whenever trails are not the previous ones plus what was added.
    """

    def __init__(self, count: int, around: bool = False) -> None:
        self._count = count
        self._around = around
        self._points = _TimedRows[NDArray[np.float32]]()
        self.length_s = TRAIL_S
        self.number = 0

    def add(self, t_s: float, p_W: Array) -> None:
        """Add positions (N, 3) [m] of an instant, NaN of a drone that is not in the view.

        Those of a flight are left out while no drone has moved on.
        """
        points = self._points
        if not self._around and points.times and t_s < points.times[-1]:
            self._points = points = _TimedRows()
            self.number += 1
        if points.is_near(t_s, SPACING_S * 0.99):
            return
        if not self._around and points.rows:
            away_m = np.linalg.norm(p_W - points.rows[-1], axis=1)
            appears = np.isfinite(p_W[:, 0]) & ~np.isfinite(points.rows[-1][:, 0])
            if not (appears | (away_m >= SPACING_M)).any():
                return
        points.insert(t_s, p_W.astype(np.float32))
        if not self._around:
            points.keep(t_s - SPAN_S)

    def keep(self, from_s: float, to_s: float) -> None:
        self._points.keep(from_s, to_s)

    def choose_length(self, length_s: float) -> None:
        """Let trails go back so far [s, simulated]."""
        self.length_s = length_s
        self.number += 1

    def segments(self, t_s: float, p_W: Array) -> tuple[Array, NDArray[np.int64], Array]:
        """Return M segments that end at the drones' present positions (N, 3); of many points, evenly spaced ones.

        Returns:
            ends (M, 2, 3), indices of the drones (M,), times at which they begin (M,).
        """
        points = self._points
        begin, end = bisect_left(points.times, t_s - self.length_s), bisect_left(points.times, t_s)
        times = np.array(points.times[begin:end])
        rows = np.arange(len(times))
        if len(times) * self._count > TRAIL_POINTS_MAX:
            # A step that hardly ever changes, and points that stay the same: else trails would tremble.
            step_s = 2.0 ** math.ceil(math.log2((times[-1] - times[0]) * self._count / TRAIL_POINTS_MAX))
            rows = np.flatnonzero(np.diff(np.floor(times / step_s), prepend=-math.inf))
        times = np.append(times[rows], t_s)
        way = np.stack([*(points.rows[begin + k] for k in rows), p_W]).astype(float)
        lines = np.stack((way[:-1], way[1:]), axis=2).transpose(1, 0, 2, 3)  # drone, instant, end, axis
        drawn = np.linalg.norm(lines[:, :, 1] - lines[:, :, 0], axis=2) > STILL_M  # False for NaN
        drawn &= np.isfinite(p_W[:, :1])
        drawn &= (np.diff(times) < RECORD_GAP_S) | (not self._around)
        owners, instants = np.nonzero(drawn)
        return lines[drawn], owners, times[instants]


class VariableHistory:
    """Points of some variables, each with the values of `SERIES`.

    Args:
        around: whether they are of a record.
    """

    def __init__(self, size: int, around: bool = False) -> None:
        self._size = size
        self._around = around
        self._points = _TimedRows[Array]()
        self._lock = threading.Lock()  # pages' threads ask for curves, too

    def is_due(self, t_s: float) -> bool:
        """Return whether a point of that time [s] would be added."""
        if self._around:
            return not self._points.is_near(t_s, INTERVAL_S / 2.0)
        times = self._points.times
        return not times or not 0.0 <= t_s - times[-1] < INTERVAL_S

    def add(
        self, t_s: float, desired: Sequence[float] | None, value: Sequence[float] | Array, true: Array | None
    ) -> bool:
        """Add a point of an instant, simulated, unless one is hardly older; return whether it was added.

        `desired`, `value` and `true` have shape (size,), m and rad; None where unknown.
        """
        unknown = np.full(self._size, np.nan)
        row = np.array([unknown if each is None else np.asarray(each, float) for each in (desired, value, true)])
        with self._lock:
            points = self._points
            if not self._around and points.times and t_s < points.times[-1]:
                self._points = points = _TimedRows()
            if not self.is_due(t_s):
                return False
            points.insert(t_s, row)
            if not self._around:
                points.keep(max(t_s - SPAN_S, points.times[-HISTORY_POINTS_MAX:][0]))  # a fast run's are far apart
        return True

    def keep(self, from_s: float, to_s: float) -> None:
        with self._lock:
            self._points.keep(from_s, to_s)

    def curves(
        self,
        index: int,
        angular: bool,
        span_s: float = SPAN_S,
        less: int | None = None,
        at_s: float | None = None,
    ) -> tuple[Array, ...]:
        """Return times (M,) and the three curves (M,) of a variable, as `SERIES`; angles in degrees, wrapped.

        A curve is broken (NaN) where an angle wraps around.

        Args:
            span_s: length of the curves.
            less: the one of `SERIES` that is subtracted, for errors; None for values.
            at_s: the middle of the curves; None: they end with the newest point.
        """
        with self._lock:
            t = np.array(self._points.times)
            table = np.array([row[:, index] for row in self._points.rows]).reshape(-1, len(SERIES))
        shown = t >= (t[-1] if len(t) else 0.0) - span_s if at_s is None else abs(t - at_s) <= span_s / 2.0
        t, table = t[shown], table[shown]
        if less is not None:
            table = table - table[:, [less]]
        if angular:
            table = np.degrees(np.arctan2(np.sin(table), np.cos(table)))
            wraps = np.abs(np.diff(table, axis=0, prepend=table[:1])) > 180.0
            table = np.where(wraps, np.nan, table)
        return t, *table.T
