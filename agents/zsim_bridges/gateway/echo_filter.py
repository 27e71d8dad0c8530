"""What clients have said here and the world has not handed out yet: its echo is no news. Pure."""

from collections import deque

WAITING_MAX = 256  # of a key; a world that is paused hands out nothing, and clients may go on
DELETED = None


class EchoFilter:
    """Knows what is still to come back, by key, in the order in which it was said.

    Who says two values in a row hears the first from the world when the second is there already; who says one and
    deletes it hears it afterwards. An echo that never comes is forgotten with the next of its key.

    Args:
        keys_max: of how many keys it is known.
    """

    def __init__(self, keys_max: int) -> None:
        self._keys_max = keys_max
        self._waiting: dict[str, deque[int | None]] = {}

    def add(self, key: str, payload: bytes) -> None:
        """Note that a payload is on its way to the world."""
        if key in self._waiting or len(self._waiting) < self._keys_max:
            self._waiting.setdefault(key, deque(maxlen=WAITING_MAX)).append(hash(payload))

    def add_deletion(self, key: str) -> None:
        """Note that what is on its way has no value any more."""
        if key in self._waiting:
            self._waiting[key].append(DELETED)

    def is_stale(self, key: str, payload: bytes) -> bool:
        """Tell whether what the world hands out is an echo of what has been followed by something since."""
        waiting = [*self._waiting.get(key, ())]
        if hash(payload) not in waiting:
            return False
        del self._waiting[key]
        rest = waiting[waiting.index(hash(payload)) + 1 :]
        if any(mark is not DELETED for mark in rest):
            self._waiting[key] = deque(rest, maxlen=WAITING_MAX)
        return bool(rest)
