"""What a run measures of itself: rate, lag, command age, deadline misses."""

from collections import deque

import numpy as np

GATES_KEPT = 1024  # gates whose publication time is remembered for the age of commands
AGES_KEPT = 1_000_000  # ages kept for the percentiles; 8 MB


class Ages:
    """Wall time from a gate's publication to the arrival of a command that answers it."""

    def __init__(self) -> None:
        self._published: dict[int, int] = {}
        self._ages_ns: deque[int] = deque(maxlen=AGES_KEPT)

    def published(self, t_ns: int, wall_ns: int) -> None:
        self._published[t_ns] = wall_ns
        if len(self._published) > GATES_KEPT:
            del self._published[next(iter(self._published))]

    def arrived(self, t_ns: int, wall_ns: int) -> None:
        published = self._published.get(t_ns)
        if published is not None:
            self._ages_ns.append(wall_ns - published)

    def summary_ms(self) -> dict[str, float] | None:
        """Return p50, p99 and max in milliseconds, None when no command came."""
        if not self._ages_ns:
            return None
        ages = np.array(self._ages_ns) / 1e6
        p50, p99 = np.percentile(ages, [50, 99])
        return {"p50": float(p50), "p99": float(p99), "max": float(ages.max())}


class Rate:
    """Simulated per wall seconds, over the last wall second and over the run."""

    def __init__(self) -> None:
        self._marks: deque[tuple[int, int]] = deque()
        self._start_wall_ns: int | None = None
        self._last_wall_ns = 0

    def gate(self, t_ns: int, wall_ns: int) -> None:
        if self._start_wall_ns is None:
            self._start_wall_ns = wall_ns
        self._last_wall_ns = wall_ns
        self._marks.append((t_ns, wall_ns))
        while len(self._marks) > 2 and wall_ns - self._marks[0][1] > 1_000_000_000:
            self._marks.popleft()

    def now(self) -> float:
        """Return the factor over the last wall second."""
        if len(self._marks) < 2:
            return 0.0
        (t0, w0), (t1, w1) = self._marks[0], self._marks[-1]
        return (t1 - t0) / (w1 - w0) if w1 > w0 else 0.0

    @property
    def wall_s(self) -> float:
        """Return the wall time from the first gate to the last."""
        return (self._last_wall_ns - (self._start_wall_ns or self._last_wall_ns)) / 1e9
