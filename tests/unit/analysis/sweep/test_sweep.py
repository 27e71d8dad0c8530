"""The screen of a sweep."""

import io
from collections.abc import Callable

from refused import has_terms
from rich.console import Console

from zsim_analysis.sweep.sweep import SweepScreen, span


def test_the_screen_tells_runs_per_hour_and_the_time_to_go() -> None:
    now_s = [100.0]
    clock: Callable[[], float] = lambda: now_s[0]  # noqa: E731
    screen = SweepScreen(100, 40, Console(file=io.StringIO()), clock)
    assert has_terms(screen.line(), "40 / 100", "first")
    now_s[0] = 136.0
    screen.finished(failed=False)
    screen.finished(failed=True)
    assert has_terms(screen.line(), "42 / 100", "200 runs/h", "17 min 24 s", "1 failed")


def test_times_in_words() -> None:
    assert [span(s) for s in (0.4, 59, 61, 3599, 3600, 90_060)] == [
        "0 s",
        "59 s",
        "1 min 01 s",
        "59 min 59 s",
        "1 h 00 min",
        "25 h 01 min",
    ]
