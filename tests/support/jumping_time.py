"""An event loop whose time passes only while nothing is ready: a busy machine lets no timeout of a test expire early."""

import asyncio
import selectors
from collections.abc import Coroutine
from typing import Any

QUIET_S = 0.1  # wall time without anything ready, after which time jumps: what a kernel under load takes to hand over


class _Selector(selectors.DefaultSelector):
    now_s = 0.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Wait as long as asked at most, but no longer than QUIET_S; then the rest has passed."""
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
    """Do what `asyncio.run` does, in such time; for work whose every wait is for this process itself."""
    with asyncio.Runner(loop_factory=_Loop) as runner:
        return runner.run(work)
