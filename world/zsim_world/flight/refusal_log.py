"""Refusals of a run: all are counted, not all are told."""

import re

TOLD = 20  # events per source, subject and reason; what follows is counted only
REASONS = 10  # of a source and subject that are told apart; all further ones count as one
KEPT_MAX = 10_000  # sources and subjects

_FIGURE = re.compile(r"\d[\d.e+-]*")


class Refusals:
    """Counts refusals, and says what is told of each.

    Attributes:
        count: of all of them.
    """

    def __init__(self) -> None:
        self.count = 0
        self._told: dict[tuple[str, str], dict[str, int]] = {}

    def text(self, source: str, subject: str, reason: str) -> str | None:
        """Count a refusal; return what is told of it, None where enough has been told.

        Reasons that differ in figures only, such as an age, are one.
        """
        self.count += 1
        if len(self._told) > KEPT_MAX:
            self._told.clear()
        by_reason = self._told.setdefault((source, subject), {})
        alike = _FIGURE.sub("#", reason)
        if alike not in by_reason and len(by_reason) >= REASONS:
            alike = ""
        told = by_reason.get(alike, 0)
        by_reason[alike] = told + 1
        last = " (further ones are counted only)" if told == TOLD - 1 else ""
        return f"{subject}: {reason}{last}" if told < TOLD else None
