"""What is asked for each drone, done in the order in which it was asked for, while others' waits for nothing."""

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, field

Act = Callable[[], None]


@dataclass
class _Line:
    """What is under way for one drone, and what waits for that."""

    busy: int = 0
    waiting: deque[Act] = field(default_factory=deque)


class Turns:
    """Lines of acts, one for each name.

    Args:
        hands: do what has its turn.
        urgent: do what waits for no turn.
    """

    def __init__(self, hands: Executor, urgent: Executor) -> None:
        self._hands = hands
        self._urgent = urgent
        self._lines: dict[str, _Line] = {}
        self._lock = threading.Lock()
        self._closed = False

    def close(self) -> None:
        """Begin nothing more."""
        with self._lock:
            self._closed = True
            self._lines.clear()

    def do(self, name: str, act: Act) -> None:
        """Do something after all that was asked for by that name before.

        Raises:
            RuntimeError: closed.
        """
        with self._lock:
            line = self._line(name)
            if line.busy:
                line.waiting.append(act)
            else:
                self._begin(self._hands, name, act)

    def do_at_once(self, name: str, act: Act) -> None:
        """Do something without waiting for what was asked for before; what is asked for later waits for it.

        Raises:
            RuntimeError: closed.
        """
        with self._lock:
            self._line(name)
            self._begin(self._urgent, name, act)

    def _line(self, name: str) -> _Line:
        if self._closed:
            raise RuntimeError("closed")
        return self._lines.setdefault(name, _Line())

    def _begin(self, hands: Executor, name: str, act: Act) -> None:
        def done() -> None:
            try:
                act()
            finally:
                self._end(name)

        hands.submit(done)
        self._lines[name].busy += 1

    def _end(self, name: str) -> None:
        with self._lock:
            line = self._lines.get(name)
            if line is None:
                return  # closed
            line.busy -= 1
            if line.busy:
                return
            if line.waiting:
                self._begin(self._hands, name, line.waiting.popleft())
            else:
                del self._lines[name]
