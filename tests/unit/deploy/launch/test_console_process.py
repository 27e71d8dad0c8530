"""A console that goes on after its run, until pages have what that left behind."""

from collections.abc import Callable
from typing import Any

import pytest

from zsim_deploy.launch.console_process import COPIED_S, SLOW_S, ending_after
from zsim_deploy.launch.supervisor import INTERRUPT_S, Outcome


class LateConsole:
    """A console that ends so long after it is asked to stop."""

    name = "console.run"

    def __init__(self, ends_after_s: float) -> None:
        self.left_s = ends_after_s
        self.waited_s = 0.0
        self.stopped_for = ""
        self.closed = False

    def request_stop(self, reason: str) -> None:
        self.stopped_for = reason

    def wait(self, timeout_s: float) -> bool:
        assert self.stopped_for
        waited_s = min(timeout_s, self.left_s)
        self.waited_s += waited_s
        self.left_s -= waited_s
        return self.left_s <= 0.0

    def close(self) -> None:
        self.closed = True


def end(console: LateConsole, interrupted: bool = False, report: Callable[[], None] = lambda: None) -> list[str]:
    """End a run with a console; return what was printed."""
    said: list[str] = []
    remaining: Any = [console]
    with ending_after(Outcome("the duration is over", interrupted=interrupted, remaining=remaining), said.append):
        assert not console.stopped_for
        report()
    return said


def test_a_console_is_asked_to_stop_when_the_report_is_there() -> None:
    console = LateConsole(0.5)
    assert end(console) == []
    assert (console.stopped_for, console.waited_s, console.closed) == ("the duration is over", 0.5, True)


def test_what_is_waited_for_long_is_named() -> None:
    console = LateConsole(SLOW_S + 3.0)
    assert "console.run" in end(console)[0]
    assert console.waited_s == SLOW_S + 3.0


@pytest.mark.parametrize("interrupted", [True, False])
def test_nobody_is_waited_for_without_an_end(interrupted: bool) -> None:
    console = LateConsole(1000.0)
    end(console, interrupted)
    assert console.waited_s == (INTERRUPT_S if interrupted else COPIED_S)
    assert console.closed


def raises(error: BaseException) -> Callable[[], None]:
    def report() -> None:
        raise error

    return report


@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit(130)])
def test_who_interrupts_the_report_waits_no_longer_than_in_flight(error: BaseException) -> None:
    console = LateConsole(1000.0)
    with pytest.raises(type(error)):
        end(console, report=raises(error))
    assert (console.waited_s, console.closed) == (INTERRUPT_S, True)
