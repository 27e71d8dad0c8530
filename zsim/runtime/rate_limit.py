"""Rate limiter for requests, refusals, joins and lines on a terminal.

Its clock is a parameter: simulated time where a rerun or a resumed world must behave identically, otherwise wall time.
"""

import time
from collections.abc import Callable

SUBJECTS_MAX = 10_000  # subjects remembered; bounds the memory that invented names can occupy


class RateLimit:
    """A token bucket per subject: initially full, it regains one token per `period`.

    Args:
        period: interval at which a token is added, in the clock's unit.
        burst: capacity of a bucket, in tokens.
        clock: the clock; by default monotonic wall time [s].
    """

    def __init__(self, period: float, burst: float = 1, clock: Callable[[], float] = time.monotonic) -> None:
        self.period = period
        self._burst = burst
        self._clock = clock
        self._spent: dict[str, tuple[float, float]] = {}  # by subject: tokens spent, and when the last was

    def knows(self, subject: str) -> bool:
        return subject in self._spent

    def allows(self, subject: str = "") -> bool:
        return self._counted(subject) <= self._burst - 1

    def spend(self, subject: str = "") -> bool:
        """Spend a token; return False if none is left."""
        now = self._clock()  # inlines `_counted` for speed: some callers spend a token at each gate
        spent, at = self._spent.get(subject, (0.0, 0))
        counted = max(0.0, spent - (now - at) / self.period)
        if counted > self._burst - 1:
            return False
        if len(self._spent) > SUBJECTS_MAX:
            self._spent.clear()
        self._spent[subject] = counted + 1, now
        return True

    def wait(self, subject: str = "") -> float:
        """Return the time until a subject has a token, in the clock's unit; 0 if it has one now."""
        return max(0.0, self._counted(subject) - (self._burst - 1)) * self.period

    def _counted(self, subject: str) -> float:
        spent, at = self._spent.get(subject, (0.0, 0))
        return max(0.0, spent - (self._clock() - at) / self.period)
