"""An event loop whose time advances only while nothing is ready, so that no timeout expires early on a busy machine."""

import asyncio
import selectors
from collections.abc import Coroutine
from typing import Any

QUIET_S = 0.1  # wall time without events before time jumps: the time a kernel under load takes to deliver them


class _Selector(selectors.DefaultSelector):
    now_s = 0.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Wait for the timeout, but at most QUIET_S; if nothing is ready, advance the time by the whole timeout."""
        found = super().select(timeout if timeout is None else min(timeout, QUIET_S))
        if timeout is not None and not found:
            self.now_s += max(0.0, timeout)
        return found


class _Loop(asyncio.SelectorEventLoop):
    def __init__(self) -> None:
        self._jumping = _Selector()
        super().__init__(self._jumping)

    def time(self) -> float:
        return self._jumping.now_s


def run_jumping(work: Coroutine[Any, Any, Any]) -> Any:
    """Run a coroutine like `asyncio.run`, but with jumping time; it may wait only for this process."""
    with asyncio.Runner(loop_factory=_Loop) as runner:
        return runner.run(work)
