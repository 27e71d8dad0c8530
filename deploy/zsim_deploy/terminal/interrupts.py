"""The signals by which a person or a system asks for an end, and what is said of them."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

REASONS: dict[int, str] = {signal.SIGINT: "interrupted by Ctrl-C", signal.SIGTERM: "terminated"}
INTERRUPTED = 130  # exit code of a shell for a program that Ctrl-C ended
IMPATIENT = "interrupted twice, nobody was waited for"


@contextmanager
def handled_by(handler: Callable[[int, Any], None]) -> Iterator[None]:
    """Hand these signals to a function, and afterwards to whom they went before."""
    former = {number: signal.signal(number, handler) for number in REASONS}
    try:
        yield
    finally:
        for number, before in former.items():
            signal.signal(number, before)


@contextmanager
def interruptible() -> Iterator[None]:
    """Raise KeyboardInterrupt at these signals, also where a library in between loses it and fails in another way."""
    asked = False

    def on_signal(*_: object) -> None:
        nonlocal asked
        asked = True
        raise KeyboardInterrupt

    with handled_by(on_signal):
        try:
            yield
        except Exception as error:
            if asked:
                raise KeyboardInterrupt from error
            raise
