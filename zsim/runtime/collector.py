"""Python's garbage collector while a run goes on, of which gates make no reference cycles."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager

ALLOCATIONS = 50_000  # between two collections, chosen: a gate allocates hundreds of objects and leaves no cycle


@contextmanager
def rare_collections() -> Iterator[None]:
    """Collect rarely, and never look through what was there before.

    By default Python collects after 700 allocations, every few gates, and now and then looks through all objects.
    """
    gc.collect()
    gc.freeze()
    thresholds = gc.get_threshold()
    gc.set_threshold(ALLOCATIONS, *thresholds[1:])
    try:
        yield
    finally:
        gc.set_threshold(*thresholds)
        gc.unfreeze()
