"""An action that is repeated while a test observes its effects."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def meanwhile(act: Callable[[], object], period_s: float) -> Iterator[None]:
    """Act at once and then once per period of wall time, in a thread, until the block ends."""
    over = threading.Event()

    def repeat() -> None:
        while not over.is_set():
            act()
            over.wait(period_s)

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
