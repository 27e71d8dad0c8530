"""The cluster variables of the last minutes: desired, estimated and true, for plots. Pure."""

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SPAN_S = 180.0  # simulated
INTERVAL_S = 0.25  # simulated, between two points; a formation answers within seconds
POINTS_MAX = int(SPAN_S / INTERVAL_S)
SERIES = ("desired", "estimated", "true")


class VariableHistory:
    """Points of one formation.

    Args:
        size: number of variables.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._times: deque[float] = deque(maxlen=POINTS_MAX)
        self._rows: deque[Array] = deque(maxlen=POINTS_MAX)

    def add(self, t_s: float, desired: Sequence[float] | None, value: Sequence[float], true: Array | None) -> bool:
        """Take a point, unless the last one is hardly older; return whether it was taken.

        Args:
            t_s: simulated time; back in time, as a replay may go, everything is forgotten.
            desired, value, true: (size,) each, m and rad; None for what is not known.
        """
        if self._times and t_s < self._times[-1]:
            self._times.clear()
            self._rows.clear()
        if self._times and t_s - self._times[-1] < INTERVAL_S:
            return False
        unknown = np.full(self._size, np.nan)
        columns = (unknown if each is None else np.asarray(each, dtype=float) for each in (desired, value, true))
        self._times.append(t_s)
        self._rows.append(np.array(list(columns)))
        while t_s - self._times[0] > SPAN_S:  # points of a fast run are far apart
            self._times.popleft()
            self._rows.popleft()
        return True

    def curves(self, place: int, angular: bool) -> tuple[Array, ...]:
        """Return the times (M,) and the three curves (M,) of a variable, as `SERIES`; angles in degrees, wrapped.

        A curve is broken (NaN) where an angle goes round.
        """
        t = np.array(self._times)
        table = np.array(self._rows)[:, :, place] if self._rows else np.zeros((0, 3))
        if angular:
            table = np.degrees(np.arctan2(np.sin(table), np.cos(table)))
            around = np.abs(np.diff(table, axis=0, prepend=table[:1])) > 180.0
            table = np.where(around, np.nan, table)
        return t, *table.T
