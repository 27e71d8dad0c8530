"""Refusals of a run: all are counted, not all are told."""

TOLD = 20  # events per source and subject; what follows is counted only
KEPT_MAX = 10_000  # sources and subjects


class Refusals:
    """Counts refusals, and says what is told of each.

    Attributes:
        count: of all of them.
    """

    def __init__(self) -> None:
        self.count = 0
        self._told: dict[tuple[str, str], int] = {}

    def text(self, source: str, subject: str, reason: str) -> str | None:
        """Count a refusal; return what is told of it, None where enough has been told."""
        self.count += 1
        told = self._told.get((source, subject), 0)
        if len(self._told) > KEPT_MAX:
            self._told.clear()
        self._told[source, subject] = told + 1
        last = " (further ones are counted only)" if told == TOLD - 1 else ""
        return f"{subject}: {reason}{last}" if told < TOLD else None
