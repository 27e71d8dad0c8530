"""Something that is done again and again while a test looks on."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def meanwhile(act: Callable[[], object], period_s: float) -> Iterator[None]:
    """Act at once and then again after every period of wall time, in a thread, until the block is left."""
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
