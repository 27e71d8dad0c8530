"""How much of a numbered stream is lost. Pure."""

from collections import deque

WINDOW = 1000  # numbers that count, a few seconds of telemetry


class StreamLoss:
    """Counts gaps in numbers that go up by one, modulo some power of two.

    Args:
        modulus: at which they begin again.
    """

    def __init__(self, modulus: int) -> None:
        self._modulus = modulus
        self._last: int | None = None
        self._steps: deque[int] = deque(maxlen=WINDOW)

    def add(self, number: int) -> bool:
        """Take the number of a message; return whether it is newer than those before."""
        step = 1 if self._last is None else (number - self._last) % self._modulus
        if step == 0 or step > self._modulus // 2:
            return False  # again, or overtaken
        self._last = number
        self._steps.append(step)
        return True

    def restart(self) -> None:
        """The sender counts from the beginning."""
        self._last = None

    @property
    def percent(self) -> float | None:
        """Return the share of what was sent that has not come; None before the first message."""
        sent = sum(self._steps)
        return 100.0 * (1.0 - len(self._steps) / sent) if sent else None
