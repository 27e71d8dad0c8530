"""The rate limiter for requests, refusals, joins and terminal output.

Its clock is a parameter: simulated time if a rerun or resumed world must behave the same, otherwise wall time.
"""

import time
from collections.abc import Callable

SUBJECTS_MAX = 10_000  # maximum number of subjects; limits the memory that invented names can use


class RateLimit:
    """A token bucket per subject: `burst` at once, then one per `period`.

    Args:
        period: interval at which one more is allowed, in the clock's unit.
        burst: number allowed at once.
        now: the clock; by default monotonic wall time [s].
    """

    def __init__(self, period: float, burst: float = 1, now: Callable[[], float] = time.monotonic) -> None:
        self.period = period
        self._burst = burst
        self._now = now
        self._spent: dict[str, tuple[float, float]] = {}  # by subject: amount spent, and the time of the last spending

    def knows(self, subject: str) -> bool:
        return subject in self._spent

    def allows(self, subject: str = "") -> bool:
        return self._counted(subject) <= self._burst - 1

    def spend(self, subject: str = "") -> bool:
        """Spend one; return False if none was left."""
        now = self._now()  # inlines `_counted`, since this is called at each gate
        spent, at = self._spent.get(subject, (0.0, 0))
        counted = max(0.0, spent - (now - at) / self.period)
        if counted > self._burst - 1:
            return False
        if len(self._spent) > SUBJECTS_MAX:
            self._spent.clear()
        self._spent[subject] = counted + 1, now
        return True

    def wait(self, subject: str = "") -> float:
        """Return the time until a subject may spend one more; 0 if it may now."""
        return max(0.0, self._counted(subject) - (self._burst - 1)) * self.period

    def _counted(self, subject: str) -> float:
        spent, at = self._spent.get(subject, (0.0, 0))
        return max(0.0, spent - (self._now() - at) / self.period)
