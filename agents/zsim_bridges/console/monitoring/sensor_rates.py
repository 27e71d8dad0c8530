"""Rates of a drone's sensors, from what its estimator has counted of them."""

from collections.abc import Mapping

SPAN_NS = 1_000_000_000  # simulated, over which at least a rate is taken

Counts = Mapping[str, tuple[int, int]]
"""Measurements (used, refused) by sensor."""


class SensorRates:
    """Sensor rates of one drone at a time, from counts that are sampled now and then."""

    def __init__(self) -> None:
        self._drone = ""
        self._samples: list[tuple[int, Counts]] = []

    def update(self, drone: str, t_ns: int, counts: Counts) -> dict[str, float]:
        """Add the counts (used, refused) of a drone's sensors at an instant; return the latest rates [Hz]."""
        if drone != self._drone or self._has_restarted(t_ns, counts):
            self._drone, self._samples = drone, []
        if self._samples and self._samples[-1][0] == t_ns:
            self._samples.pop()  # the run stands still
        self._samples.append((t_ns, dict(counts)))
        while len(self._samples) > 2 and t_ns - self._samples[1][0] >= SPAN_NS:
            self._samples.pop(0)
        since_ns, before = self._samples[0]
        span_ns = t_ns - since_ns
        if span_ns <= 0:
            return {}
        return {kind: (sum(now) - sum(before.get(kind, now))) * 1e9 / span_ns for kind, now in counts.items()}

    def _has_restarted(self, t_ns: int, counts: Counts) -> bool:
        """Return whether a replay has gone back, or an estimator has restarted."""
        if not self._samples:
            return False
        last_ns, last = self._samples[-1]
        return t_ns < last_ns or any(sum(counts.get(kind, (0, 0))) < sum(before) for kind, before in last.items())
