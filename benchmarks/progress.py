"""What a person sees while measurements run: a line each, with the time to go."""

import sys
import time


class Progress:
    """Counts measurements of a part.

    Args:
        part: letter.
        total: number of measurements.
    """

    def __init__(self, part: str, total: int) -> None:
        self._part = part
        self._total = total
        self._done = 0
        self._start_s = time.monotonic()

    def tell(self, text: str) -> None:
        """Say what the next measurement gave."""
        self._done += 1
        spent_s = time.monotonic() - self._start_s
        left_s = spent_s / self._done * max(0, self._total - self._done)
        print(f"{self._part} {self._done}/{self._total}  {text}  ({left_s:.0f} s to go)", file=sys.stderr, flush=True)
