"""Ctrl-C where others' code may lose it."""

import signal
from contextlib import suppress

import pytest

from zsim_deploy.terminal.interrupts import interruptible


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_interrupts(number: signal.Signals) -> None:
    former = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt), interruptible():
        signal.raise_signal(number)
    assert signal.getsignal(number) is former


def test_what_a_library_makes_of_it_is_an_interrupt_still() -> None:
    def lose() -> None:
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        raise SystemError("returned NULL without setting an exception")

    with pytest.raises(KeyboardInterrupt), interruptible():
        lose()


def test_other_errors_are_what_they_are() -> None:
    with pytest.raises(SystemError), interruptible():
        raise SystemError("returned NULL without setting an exception")
