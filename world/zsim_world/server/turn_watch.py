"""Whether a turn of the world's loop does not end: a put that does not return, unless the whole process stood."""

STUCK_NS = 2_000_000_000  # wall time in one turn from which on it is named; a turn takes milliseconds
STOOD_NS = 1_000_000_000  # between two looks, ten times as long as it takes: the process was stopped, or its host


class TurnWatch:
    """Looks at the present turn, on a thread of its own that a put does not hold up.

    Args:
        now_ns: monotonic wall time.
    """

    def __init__(self, now_ns: int) -> None:
        self._looked_ns = now_ns
        self._stood_until_ns = 0
        self._named_ns = 0

    def stuck_s(self, now_ns: int, turn_ns: int) -> float | None:
        """Return for how long a turn has been stuck, once every STUCK_NS; None where there is nothing to name.

        Args:
            now_ns: monotonic wall time.
            turn_ns: when the turn began, 0 when there is none.
        """
        if now_ns - self._looked_ns > STOOD_NS:
            self._stood_until_ns = now_ns
        self._looked_ns = now_ns
        since_ns = max(turn_ns, self._stood_until_ns)
        if not turn_ns or now_ns - max(since_ns, self._named_ns) <= STUCK_NS:
            return None
        self._named_ns = now_ns
        return (now_ns - since_ns) / 1e9
