"""Points of variables over time, as plots show them. Pure."""

import threading
from bisect import bisect_left
from collections.abc import Sequence

import numpy as np

from zsim_bridges.console.scene.picture import Array

SPAN_S = 180.0  # simulated
INTERVAL_S = 0.25  # simulated, between two points; a formation answers within seconds
HISTORY_POINTS_MAX = int(SPAN_S / INTERVAL_S)
SERIES = ("desired", "estimated", "true")


class VariableHistory:
    """Points of one formation.

    Args:
        size: number of variables.
        around: whether points of any time are kept, in whatever order they come, as of a record; else those of the last
            minutes.
    """

    def __init__(self, size: int, around: bool = False) -> None:
        self._size = size
        self._around = around
        self._times: list[float] = []
        self._rows: list[Array] = []
        self._lock = threading.Lock()  # curves are also asked for in threads of pages

    def is_due(self, t_s: float) -> bool:
        """Return whether a point of that time [s] would be added."""
        if not self._around:
            return not self._times or not 0.0 <= t_s - self._times[-1] < INTERVAL_S
        place = bisect_left(self._times, t_s)
        return all(abs(other_s - t_s) >= INTERVAL_S / 2.0 for other_s in self._times[max(0, place - 1) : place + 1])

    def add(
        self, t_s: float, desired: Sequence[float] | None, value: Sequence[float] | Array, true: Array | None
    ) -> bool:
        """Add a point, unless one is hardly older; return whether it was added.

        Args:
            t_s: simulated time; back in time, all points are removed, but for those of a record.
            desired, value, true: (size,) each, m and rad; None for what is not known.
        """
        unknown = np.full(self._size, np.nan)
        columns = (unknown if each is None else np.asarray(each, dtype=float) for each in (desired, value, true))
        with self._lock:
            if not self._around and self._times and t_s < self._times[-1]:
                self._drop(len(self._times))
            if not self.is_due(t_s):
                return False
            place = bisect_left(self._times, t_s)
            self._times.insert(place, t_s)
            self._rows.insert(place, np.array(list(columns)))
            if not self._around:
                too_old = bisect_left(self._times, t_s - SPAN_S)  # points of a fast run are far apart
                self._drop(max(too_old, len(self._times) - HISTORY_POINTS_MAX))
        return True

    def keep(self, from_s: float, to_s: float) -> None:
        """Remove the points of other times."""
        with self._lock:
            self._drop(bisect_left(self._times, from_s))
            late = bisect_left(self._times, to_s)
            del self._times[late:], self._rows[late:]

    def _drop(self, count: int) -> None:
        del self._times[:count], self._rows[:count]

    def curves(
        self,
        index: int,
        angular: bool,
        span_s: float = SPAN_S,
        less: int | None = None,
        at_s: float | None = None,
    ) -> tuple[Array, ...]:
        """Return the times (M,) and the three curves (M,) of a variable, as `SERIES`; angles in degrees, wrapped.

        A curve is broken (NaN) where an angle goes round.

        Args:
            index: of the variable.
            angular: whether it is an angle.
            span_s: how far the curves go back.
            at_s: the middle of the curves; None where they end with the newest point.
            less: the one of `SERIES` whose values are taken off the others, which then are errors; None for values.
        """
        with self._lock:
            t = np.array(self._times)
            table = np.array([row[:, index] for row in self._rows]).reshape(-1, len(SERIES))
        shown = t >= (t[-1] if len(t) else 0.0) - span_s if at_s is None else abs(t - at_s) <= span_s / 2.0
        t, table = t[shown], table[shown]
        if less is not None:
            table = table - table[:, [less]]
        if angular:
            table = np.degrees(np.arctan2(np.sin(table), np.cos(table)))
            around = np.abs(np.diff(table, axis=0, prepend=table[:1])) > 180.0
            table = np.where(around, np.nan, table)
        return t, *table.T
