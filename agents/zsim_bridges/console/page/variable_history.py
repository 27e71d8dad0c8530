"""Points of variables over time, as plots show them. Pure."""

import threading
from collections import deque
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
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._times: deque[float] = deque(maxlen=HISTORY_POINTS_MAX)
        self._rows: deque[Array] = deque(maxlen=HISTORY_POINTS_MAX)
        self._lock = threading.Lock()  # curves are also asked for in threads of pages

    def is_due(self, t_s: float) -> bool:
        """Return whether a point of that time [s] would be added."""
        return not self._times or not 0.0 <= t_s - self._times[-1] < INTERVAL_S

    def add(
        self, t_s: float, desired: Sequence[float] | None, value: Sequence[float] | Array, true: Array | None
    ) -> bool:
        """Add a point, unless the last one is hardly older; return whether it was added.

        Args:
            t_s: simulated time; back in time, as a replay may go, all points are removed.
            desired, value, true: (size,) each, m and rad; None for what is not known.
        """
        unknown = np.full(self._size, np.nan)
        columns = (unknown if each is None else np.asarray(each, dtype=float) for each in (desired, value, true))
        with self._lock:
            if self._times and t_s < self._times[-1]:
                self._times.clear()
                self._rows.clear()
            if not self.is_due(t_s):
                return False
            self._times.append(t_s)
            self._rows.append(np.array(list(columns)))
            while t_s - self._times[0] > SPAN_S:  # points of a fast run are far apart
                self._times.popleft()
                self._rows.popleft()
        return True

    def curves(self, index: int, angular: bool, span_s: float = SPAN_S, less: int | None = None) -> tuple[Array, ...]:
        """Return the times (M,) and the three curves (M,) of a variable, as `SERIES`; angles in degrees, wrapped.

        A curve is broken (NaN) where an angle goes round.

        Args:
            index: of the variable.
            angular: whether it is an angle.
            span_s: how far the curves go back.
            less: the one of `SERIES` whose values are taken off the others, which then are errors; None for values.
        """
        with self._lock:
            t = np.array(self._times)
            table = np.array([row[:, index] for row in self._rows]).reshape(-1, len(SERIES))
        recent = t >= (t[-1] if len(t) else 0.0) - span_s
        t, table = t[recent], table[recent]
        if less is not None:
            table = table - table[:, [less]]
        if angular:
            table = np.degrees(np.arctan2(np.sin(table), np.cos(table)))
            around = np.abs(np.diff(table, axis=0, prepend=table[:1])) > 180.0
            table = np.where(around, np.nan, table)
        return t, *table.T
