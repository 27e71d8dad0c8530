"""On which keys clients may publish, what may be left out of their messages, and what is refused. Pure."""

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from zsim.contract import keys, messages
from zsim.errors import DecodeError, ZsimError

COUNTED_KEYS = (keys.command("*", "*"), keys.estimate("*"), keys.cluster_state("*"))  # contract: `sent` of a done
CLIENT_KEYS = (*COUNTED_KEYS, keys.cluster_view("*"), keys.estimates_view("*"))
"""Keys of the contract on which clients publish."""
CONTROL_KEYS = (keys.CONTROL, keys.cluster_control("*"))  # requests go there
RESERVED_KEYS = (
    "world/**",
    keys.CLOCK,
    "process/**",
    keys.VIEW_DRONES,
    "drone/*/sensor/**",
    keys.truth("*"),
    CONTROL_KEYS[1],
    keys.cluster_request("*"),
)
"""Keys on which the world, or a process in its own name, publishes: a client's message would be taken for theirs."""


class ForbiddenError(ZsimError):
    """A key or a page that the client may not use."""


class TooManyError(ZsimError):
    """More requests, clients or subscriptions than the gateway takes at once."""


class UnknownError(ZsimError):
    """A drone or a cluster that the run does not have."""


class MethodError(ZsimError):
    """An HTTP method that a key does not have.

    Args:
        text: of the error.
        allowed: HTTP methods that it has.
    """

    def __init__(self, text: str, allowed: tuple[str, ...]) -> None:
        super().__init__(text)
        self.allowed = allowed


def is_counted_key(key: str) -> bool:
    """Return whether a done counts the messages of a key."""
    return _matches_any(COUNTED_KEYS, key)


def is_client_key(key: str) -> bool:
    """Return whether a key is one of the contract's on which clients publish."""
    return _matches_any(CLIENT_KEYS, key)


def is_control_key(key: str) -> bool:
    """Return whether requests go to a key."""
    return _matches_any(CONTROL_KEYS, key)


def is_reserved(key: str) -> bool:
    """Return whether clients may not publish on a key."""
    return _matches_any(RESERVED_KEYS, key) or key.startswith("@") or "/@" in key


def check_not_reserved(key: str) -> None:
    """Refuse a key on which clients may not publish.

    Raises:
        DecodeError: it is no key.
        ForbiddenError: it is reserved.
    """
    if "*" in key or not key:
        raise DecodeError(f"{key[:80]!r}: is no key; must be names with / between them")
    if is_reserved(key):
        raise ForbiddenError(
            f"{key[:80]}: only the process that this is about speaks here; a client may speak on "
            f"{', '.join(CLIENT_KEYS).replace('*', '…')} and keys of its own"
        )


def _matches_any(expressions: Sequence[str], key: str) -> bool:
    return any(keys.matches(expression, key) for expression in expressions)


class MessageDefaults:
    """Fills in time, sequence number and source of one client's messages.

    Args:
        source: name under which the client publishes.
    """

    def __init__(self, source: str) -> None:
        self._source = source
        self._next_seq: Counter[str] = Counter()

    def fill(self, key: str, value: Any, now_ns: int) -> Any:
        """Return a value with `t_ns`, `seq` and `source` where its message has them and the value does not.

        Args:
            key: on which it is published.
            value: plain data; what is no map is returned as it is.
            now_ns: simulated time of the newest gate [ns].
        """
        kind = messages.type_of(key)
        if kind is None or not isinstance(value, dict):
            return value
        defaults = {"t_ns": now_ns, "seq": self._next_seq[key], "source": self._source}
        if "seq" not in value:
            self._next_seq[key] += 1
        fields = messages.fields(kind)
        return {**{name: default for name, default in defaults.items() if name in fields}, **value}

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Undo the counting of what is filled in meanwhile if anything is refused: numbers have no gaps."""
        before = self._next_seq.copy()
        try:
            yield
        except BaseException:
            self._next_seq = before
            raise
