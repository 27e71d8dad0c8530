"""The console of a run: it goes on until the report is there, and ends whatever happens."""

import signal
from typing import Any

import pytest

from zsim_bridges.console.console_server import OFFER_S
from zsim_deploy.launch.console_process import COPIED_S, INTERRUPTED_S, SLOW_S, RunConsole
from zsim_deploy.launch.supervisor import Outcome

REASON = "over"


class LateConsole:
    """A console that ends so long after it is asked to stop; meanwhile a signal may come."""

    name = "console.run"

    def __init__(self, ends_after_s: float, signal_number: int = 0) -> None:
        self.left_s = ends_after_s
        self.waited_s = 0.0
        self.stopped_for = ""
        self.closed = False
        self._signal_number = signal_number

    def request_stop(self, reason: str) -> None:
        self.stopped_for = reason

    def wait(self, timeout_s: float) -> bool:
        assert self.stopped_for
        if self._signal_number:
            signal.raise_signal(self._signal_number)
        waited_s = min(timeout_s, self.left_s)
        self.waited_s += waited_s
        self.left_s -= waited_s
        return self.left_s <= 0.0

    def close(self) -> None:
        self.closed = True


def end(console: LateConsole, interrupted: bool = False, error: BaseException | None = None) -> None:
    """End a run with a console, or break its report off."""
    process: Any = console
    with RunConsole() as run_console:
        run_console.own(process)
        run_console.outcome = Outcome(REASON, interrupted=interrupted)
        if error:
            raise error
        assert not console.stopped_for


@pytest.mark.parametrize(
    ("ends_after_s", "interrupted", "waited_s", "named"),
    [
        (0.5, False, 0.5, False),
        (SLOW_S + 3.0, False, SLOW_S + 3.0, True),
        (1000.0, False, COPIED_S, True),
        (1000.0, True, INTERRUPTED_S, False),
    ],
)
def test_a_console_is_asked_to_stop_when_the_report_is_there_and_waited_for_so_long(
    capfd: pytest.CaptureFixture[str], ends_after_s: float, interrupted: bool, waited_s: float, named: bool
) -> None:
    console = LateConsole(ends_after_s)
    end(console, interrupted=interrupted)
    assert (console.name in capfd.readouterr().err) is named
    assert (console.stopped_for, console.waited_s, console.closed) == (REASON, waited_s, True)
    assert COPIED_S > OFFER_S


@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit(130)])
def test_who_interrupts_the_report_waits_no_longer_than_in_flight(error: BaseException) -> None:
    console = LateConsole(1000.0)
    with pytest.raises(type(error)):
        end(console, error=error)
    assert (console.waited_s, console.closed) == (INTERRUPTED_S, True)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_wait_and_the_run_has_ended_as_it_did(number: int) -> None:
    console = LateConsole(1000.0, number)
    end(console)
    assert (console.waited_s, console.closed) == (0.0, True)
    failed = LateConsole(1000.0, number)
    with pytest.raises(ValueError, match="the run failed"):
        end(failed, error=ValueError("the run failed"))


def test_a_run_that_is_broken_off_before_it_has_an_outcome_leaves_nothing() -> None:
    console = LateConsole(1000.0)
    process: Any = console

    def run() -> None:
        with RunConsole() as run_console:
            run_console.own(process)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run()
    assert (console.waited_s, console.closed) == (INTERRUPTED_S, True)


def test_the_console_of_a_run_whose_port_was_taken_makes_way() -> None:
    first, second = LateConsole(0.5), LateConsole(0.5)
    processes: Any = [first, second]
    with RunConsole() as run_console:
        assert run_console.process is None
        for process in processes:
            run_console.own(process)
        assert (first.closed, second.closed) == (True, False)
    assert second.closed
