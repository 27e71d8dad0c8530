"""What a person sees of a sweep: one live line on a terminal, a line now and then elsewhere."""

import time
from collections.abc import Callable

from rich.console import Console
from rich.live import Live
from rich.text import Text

from zsim.runtime.progress import Throttle

PLAIN_S = 10.0  # wall time between two lines where no terminal is
BAR = 20  # characters


class SweepScreen:
    """Shows how far a sweep is, while it is entered.

    Args:
        total: runs of the plan.
        done: of them before this start.
        now_s: monotonic wall time.
    """

    def __init__(
        self, total: int, done: int, console: Console | None = None, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self.console = console or Console(stderr=True)
        self._total = total
        self._before = self._done = done
        self._failed = 0
        self._now_s = now_s
        self._start_s = now_s()
        self._throttle = Throttle(PLAIN_S)
        self._live = Live(console=self.console, get_renderable=self._text, refresh_per_second=5, transient=True)

    def __enter__(self) -> "SweepScreen":
        self._start_s = self._now_s()
        if self.console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.console.is_terminal:
            self._live.stop()
        elif self._done > self._before:
            self.say(self.line())

    def say(self, text: str) -> None:
        """Show a line that stays."""
        self.console.print(text, highlight=False, markup=False, soft_wrap=True)

    def finished(self, failed: bool) -> None:
        """Count a run."""
        self._done += 1
        self._failed += failed
        if not self.console.is_terminal and self._done < self._total and self._throttle.passes():
            self.say(self.line())

    def line(self) -> str:
        """Return runs done, runs per hour since the start, and time to go at that rate."""
        filled = int(BAR * self._done / self._total)
        text = f"{'█' * filled}{'░' * (BAR - filled)} {self._done} / {self._total} runs"
        flown, elapsed_s = self._done - self._before, self._now_s() - self._start_s
        if flown and elapsed_s > 0:
            text += f"  {3600 * flown / elapsed_s:,.0f} runs/h"
            if self._done < self._total:
                text += f"  {span((self._total - self._done) * elapsed_s / flown)} to go"
        elif self._done < self._total:
            text += f"  the first ones are flying, {span(elapsed_s)}"
        return text + (f"  {self._failed} failed" if self._failed else "")

    def _text(self) -> Text:
        return Text(self.line())


def span(seconds: float) -> str:
    """Return a time in words, to the second below an hour."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
