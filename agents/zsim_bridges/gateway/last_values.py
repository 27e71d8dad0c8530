"""The last value of every key, as far as it passed the world. Pure."""

import threading
from collections.abc import Sequence

from zsim.contract import keys, messages
from zsim.contract.framing import GateMessages, key_table
from zsim_bridges.gateway.echo_filter import Echoes

OWN_BYTES_MAX = 64_000_000  # of the values on keys that are none of the contract's
KEYS_MAX = 200_000  # kept; 1000 drones have about 12 000


class Values:
    """Filled by what passes the world; payloads are taken out of a gate's messages when somebody asks.

    Args:
        drones: their names, as `world/info` gives them.
    """

    def __init__(self, drones: Sequence[str]) -> None:
        self._table = key_table(drones)
        self._places = {key: place for place, key in enumerate(self._table)}
        self._said: dict[str, bytes] = {}
        self._own_bytes = 0
        self._lock = threading.Lock()  # clients' thread and the world's both add to what is counted
        self._encodings: dict[str, tuple[bytes, str]] = {}
        self._echoes = Echoes(KEYS_MAX)
        self._of_gates: dict[int, tuple[GateMessages, int]] = {}

    def add(self, key: str, payload: bytes, encoding: str = "") -> None:
        """Take one message; of an encoding that is not its key's where one is given."""
        with self._lock:
            self._add(key, payload, encoding)

    def say(self, key: str, payload: bytes, encoding: str = "") -> None:
        """Take one message that is said here, and that the world will hand out, too."""
        with self._lock:
            self._echoes.said(key, payload)
            self._add(key, payload, encoding)

    def _add(self, key: str, payload: bytes, encoding: str) -> None:
        if messages.type_of(key) is None and not self._has_room(key, payload):
            self._drop(key)
        elif key in self._said or len(self._said) < KEYS_MAX:
            self._said[key] = payload
            if encoding:
                self._encodings[key] = (payload, encoding)

    def _has_room(self, key: str, payload: bytes) -> bool:
        """Tell whether a value of a key of somebody's own may be kept."""
        before = len(self._said.get(key, b""))
        more = len(payload) - before
        has = self._own_bytes + more <= OWN_BYTES_MAX and (key in self._said or len(self._said) < KEYS_MAX)
        self._own_bytes += more if has else 0
        return has

    def drop(self, key: str) -> None:
        """Forget the value of a key that is deleted here."""
        with self._lock:
            self._echoes.deleted(key)
            self._drop(key)

    def _drop(self, key: str) -> None:
        gone = self._said.pop(key, b"")
        if messages.type_of(key) is None:
            self._own_bytes -= len(gone)
        self._encodings.pop(key, None)

    def encoding(self, key: str) -> str:
        """Return the encoding of a key's last value."""
        payload, encoding = self._encodings.get(key, (None, ""))
        return encoding if encoding and payload == self._said.get(key) else messages.encoding(key)

    def add_passed(self, key: str, payload: bytes) -> None:
        """Take one message that has passed the world."""
        with self._lock:
            if not self._echoes.is_old(key, payload):
                self._add(key, payload, "")

    def add_gate(self, gate: GateMessages) -> None:
        """Take the world's messages of a gate, whose columns have been checked."""
        for m, place in enumerate(gate.which.tolist()):
            self._of_gates[place] = (gate, m)

    def of(self, expression: str, prefix: str = "") -> list[tuple[str, bytes]]:
        """Return keys and payloads that an expression takes, in order of the keys.

        Args:
            expression: of keys with the prefix.
            prefix: that is put before each key to compare it; what is returned is without it.
        """
        if "*" not in expression:
            key = expression.removeprefix(prefix)
            payload = self._payload(key) if expression.startswith(prefix) else None
            return [(key, payload)] if payload is not None else []
        known = {*self._said, *(self._table[place] for place in list(self._of_gates))}  # filled in another thread
        taken = sorted(key for key in known if keys.matches(expression, prefix + key))
        return [(key, payload) for key in taken if (payload := self._payload(key)) is not None]

    def _payload(self, key: str) -> bytes | None:
        gate, m = self._of_gates.get(self._places.get(key, -1), (None, 0))
        return gate.payload(m) if gate else self._said.get(key)
