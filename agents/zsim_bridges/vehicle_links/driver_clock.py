"""The clock of a driver, and what the run's shows at its times."""

import time
from collections.abc import Callable

from zsim_bridges.vehicle_links.clock_offset import ClockOffset


class DriverClock:
    """The clock of the driver, which goes as fast as the run's, and what the run's shows.

    Args:
        rate: simulated per wall seconds.
        wall_ns: monotonic wall time.
    """

    def __init__(self, rate: float, wall_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._rate, self._wall_ns = rate, wall_ns
        self._offset = ClockOffset()

    def now_ns(self) -> int:
        return round(self._wall_ns() * self._rate)

    def on_gate(self, t_ns: int) -> None:
        """A clock of the run has just arrived."""
        self._offset.add(t_ns, self.now_ns())

    def to_simulated(self, now_ns: int) -> int:
        """Return simulated time at a time of this clock."""
        return self._offset.to_remote(now_ns)
