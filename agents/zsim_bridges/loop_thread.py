"""An asyncio loop on a thread of its own, as long as something on it is open."""

import asyncio
import threading
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

Opened = TypeVar("Opened")


async def _end_others() -> None:
    """End what still runs: a loop that closes over it complains of each."""
    others = asyncio.all_tasks() - {asyncio.current_task()}
    for task in others:
        task.cancel()
    await asyncio.gather(*others, return_exceptions=True)


@contextmanager
def opened_on(
    loop: asyncio.AbstractEventLoop,
    name: str,
    enter: Callable[[], Coroutine[Any, Any, Opened]],
    leave: Callable[[Opened], Coroutine[Any, Any, None]],
) -> Iterator[None]:
    """Run a loop on a thread, open something on it, and close both at the end.

    Args:
        loop: is closed at the end.
        name: of the thread.
        enter, leave: open it, and close what was opened; what `enter` raises is raised here.
    """
    thread = threading.Thread(target=loop.run_forever, name=name, daemon=True)
    thread.start()
    try:
        opened = asyncio.run_coroutine_threadsafe(enter(), loop).result()
        try:
            yield
        finally:
            asyncio.run_coroutine_threadsafe(leave(opened), loop).result()
    finally:
        asyncio.run_coroutine_threadsafe(_end_others(), loop).result()
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()
