"""Which time of another clock is which of this one's, by the messages that arrive."""

import time
from collections import deque
from collections.abc import Callable

WINDOW_NS = 5_000_000_000  # chosen: long against queues, short against the drift of two clocks (50 ppm: 0.25 ms)


class ClockOffset:
    """The offset of another clock from this one.

    The least difference between arrival and stamp within a window counts, since what a link or a busy process adds is
    never negative. What the fastest way takes is known where round trips are measured.

    Args:
        window_ns: how long a difference counts.
    """

    def __init__(self, window_ns: int = WINDOW_NS) -> None:
        self._window_ns = window_ns
        self._least: deque[tuple[int, int]] = deque()  # arrivals and differences; both increase
        self._round_trips: deque[tuple[int, int]] = deque()

    def add(self, stamp_ns: int, arrival_ns: int) -> None:
        """Take a message that the other clock stamped and that arrived by this one."""
        _keep_least(self._least, arrival_ns, arrival_ns - stamp_ns, self._window_ns)

    def add_round_trip(self, duration_ns: int, arrival_ns: int) -> None:
        """Take how long a request and its answer took together."""
        _keep_least(self._round_trips, arrival_ns, duration_ns, self._window_ns)

    @property
    def offset_ns(self) -> int:
        """Return this clock's time minus the other's; 0 while it is not known."""
        return self._least[0][1] - self.round_trip_ns // 2 if self._least else 0

    @property
    def ahead_ms(self) -> float | None:
        """Return the other clock's time minus this one's, None while it is not known."""
        return -self.offset_ns / 1e6 if self._least else None

    @property
    def round_trip_ms(self) -> float | None:
        """Return the shortest round trip of the window, None where none was measured."""
        return self._round_trips[0][1] / 1e6 if self._round_trips else None

    @property
    def round_trip_ns(self) -> int:
        """Return the shortest round trip of the window; 0 where none was measured."""
        return self._round_trips[0][1] if self._round_trips else 0

    def to_local(self, stamp_ns: int) -> int:
        """Return when the other clock showed a time, by this one."""
        return stamp_ns + self.offset_ns

    def to_remote(self, local_ns: int) -> int:
        """Return what the other clock shows at a time of this one."""
        return local_ns - self.offset_ns


def _keep_least(kept: deque[tuple[int, int]], now_ns: int, value: int, window_ns: int) -> None:
    """Add a value to a queue whose first entry is the least within a window."""
    while kept and kept[-1][1] >= value:
        kept.pop()
    kept.append((now_ns, value))
    while now_ns - kept[0][0] > window_ns:
        kept.popleft()


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
