"""How often sensors come, from counts that are seen now and then. Pure."""

from collections.abc import Mapping

SPAN_NS = 1_000_000_000  # simulated, over which at least a rate is taken

Counts = dict[str, tuple[int, int]]


class SensorRates:
    """Rates of one drone at a time: the one that is looked at."""

    def __init__(self) -> None:
        self._drone = ""
        self._marks: list[tuple[int, Counts]] = []

    def update(self, drone: str, t_ns: int, counts: Mapping[str, tuple[int, int]]) -> dict[str, float]:
        """Take the counts (used, refused) of a drone's sensors at an instant; return the rates [Hz] lately."""
        if drone != self._drone or self._has_restarted(t_ns, counts):
            self._drone, self._marks = drone, []
        if self._marks and self._marks[-1][0] == t_ns:
            self._marks.pop()  # the run stands still
        self._marks.append((t_ns, dict(counts)))
        while len(self._marks) > 2 and t_ns - self._marks[1][0] >= SPAN_NS:
            self._marks.pop(0)
        since_ns, before = self._marks[0]
        span_ns = t_ns - since_ns
        if span_ns <= 0:
            return {}
        return {kind: (sum(now) - sum(before.get(kind, now))) * 1e9 / span_ns for kind, now in counts.items()}

    def _has_restarted(self, t_ns: int, counts: Mapping[str, tuple[int, int]]) -> bool:
        """Tell whether a replay has gone back, or an estimator has begun anew."""
        if not self._marks:
            return False
        last_ns, last = self._marks[-1]
        return t_ns < last_ns or any(sum(counts.get(kind, (0, 0))) < sum(before) for kind, before in last.items())
