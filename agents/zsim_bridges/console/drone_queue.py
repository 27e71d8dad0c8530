"""What is asked for each drone, done in the order in which it was asked for, while others' waits for nothing."""

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, field

Task = Callable[[], None]


@dataclass
class _DroneTasks:
    """What is under way for one drone, and what waits for that."""

    busy: int = 0
    waiting: deque[Task] = field(default_factory=deque)


class DroneQueue:
    """Lines of acts, one for each name.

    Args:
        hands: do what has its turn.
        urgent: do what waits for no turn.
    """

    def __init__(self, hands: Executor, urgent: Executor) -> None:
        self._pool = hands
        self._urgent = urgent
        self._tasks: dict[str, _DroneTasks] = {}
        self._lock = threading.Lock()
        self._closed = False

    def close(self) -> None:
        """Begin nothing more."""
        with self._lock:
            self._closed = True
            self._tasks.clear()

    def submit(self, name: str, act: Task) -> None:
        """Do something after all that was asked for by that name before.

        Raises:
            RuntimeError: closed.
        """
        with self._lock:
            line = self._tasks_of(name)
            if line.busy:
                line.waiting.append(act)
            else:
                self._start(self._pool, name, act)

    def submit_urgent(self, name: str, act: Task) -> None:
        """Do something without waiting for what was asked for before; what is asked for later waits for it.

        Raises:
            RuntimeError: closed.
        """
        with self._lock:
            self._tasks_of(name)
            self._start(self._urgent, name, act)

    def _tasks_of(self, name: str) -> _DroneTasks:
        if self._closed:
            raise RuntimeError("closed")
        return self._tasks.setdefault(name, _DroneTasks())

    def _start(self, hands: Executor, name: str, act: Task) -> None:
        def done() -> None:
            try:
                act()
            finally:
                self._end(name)

        hands.submit(done)
        self._tasks[name].busy += 1

    def _end(self, name: str) -> None:
        with self._lock:
            line = self._tasks.get(name)
            if line is None:
                return  # closed
            line.busy -= 1
            if line.busy:
                return
            if line.waiting:
                self._start(self._pool, name, line.waiting.popleft())
            else:
                del self._tasks[name]
