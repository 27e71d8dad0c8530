"""The last value of every key, as far as it passed the world. Pure."""

import threading
from collections.abc import Sequence

from zsim.contract import batch, keys, messages
from zsim.contract.bundle import Bundle, table_of, unpacked
from zsim.errors import DecodeError
from zsim_bridges.gateway.echo_filter import EchoFilter

OWN_BYTES_MAX = 64_000_000  # of the values on keys that are none of the contract's
KEYS_MAX = 200_000  # kept; 1000 drones have about 12 000


class LastValues:
    """Filled by the batches that the world hands out; unpacked when somebody asks.

    Args:
        drones: their names, as `world/info` gives them.

    Attributes:
        refused: batches and bundles that were none.
    """

    def __init__(self, drones: Sequence[str]) -> None:
        self._table = table_of(drones)
        self._indices = {key: place for place, key in enumerate(self._table)}
        self._payloads: dict[str, bytes] = {}
        self._own_bytes = 0
        self._lock = threading.Lock()  # clients' thread and the world's both add to what is counted
        self._encodings: dict[str, tuple[bytes, str]] = {}
        self._echoes = EchoFilter(KEYS_MAX)
        self._bundled: dict[int, tuple[Bundle, int]] = {}
        self.refused = 0

    def add(self, key: str, payload: bytes, encoding: str = "") -> None:
        """Take one message; of an encoding that is not its key's where one is given."""
        with self._lock:
            self._add(key, payload, encoding)

    def add_own(self, key: str, payload: bytes, encoding: str = "") -> None:
        """Take one message that is said here, and that the world will hand out, too."""
        with self._lock:
            self._echoes.add(key, payload)
            self._add(key, payload, encoding)

    def _add(self, key: str, payload: bytes, encoding: str) -> None:
        if messages.type_of(key) is None and not self._has_room(key, payload):
            self._drop(key)
        elif key in self._payloads or len(self._payloads) < KEYS_MAX:
            self._payloads[key] = payload
            if encoding:
                self._encodings[key] = (payload, encoding)

    def _has_room(self, key: str, payload: bytes) -> bool:
        """Tell whether a value of a key of somebody's own may be kept."""
        before = len(self._payloads.get(key, b""))
        more = len(payload) - before
        has = self._own_bytes + more <= OWN_BYTES_MAX and (key in self._payloads or len(self._payloads) < KEYS_MAX)
        self._own_bytes += more if has else 0
        return has

    def drop(self, key: str) -> None:
        """Forget the value of a key that is deleted here."""
        with self._lock:
            self._echoes.add_deletion(key)
            self._drop(key)

    def _drop(self, key: str) -> None:
        gone = self._payloads.pop(key, b"")
        if messages.type_of(key) is None:
            self._own_bytes -= len(gone)
        self._encodings.pop(key, None)

    def encoding(self, key: str) -> str:
        """Return the encoding of a key's last value."""
        payload, encoding = self._encodings.get(key, (None, ""))
        return encoding if encoding and payload == self._payloads.get(key) else messages.encoding(key)

    def add_batch(self, payload: bytes) -> list[tuple[str, bytes]]:
        """Take everything that passed the world since the last time; return what came beside the drones' messages."""
        try:
            passed = batch.decode(payload)
        except DecodeError:
            self.refused += 1
            return []
        alone = [(key, said) for key, said in passed if key != batch.GATE]
        for key, said in passed:
            if key == batch.GATE:
                self._add_bundle(said)
            else:
                self._add_received(key, said)
        return alone

    def _add_received(self, key: str, payload: bytes) -> None:
        with self._lock:
            if not self._echoes.is_stale(key, payload):
                self._add(key, payload, "")

    def _add_bundle(self, payload: bytes) -> None:
        try:
            bundle = unpacked(payload, self._table)
        except DecodeError:
            self.refused += 1
            return
        if not bundle.is_sound():
            self.refused += 1
            return
        for m, place in enumerate(bundle.which.tolist()):
            self._bundled[place] = (bundle, m)

    def matching(self, expression: str, prefix: str = "") -> list[tuple[str, bytes]]:
        """Return keys and payloads that an expression takes, in order of the keys.

        Args:
            expression: of keys with the prefix.
            prefix: that is put before each key to compare it; what is returned is without it.
        """
        if "*" not in expression:
            key = expression.removeprefix(prefix)
            payload = self._payload(key) if expression.startswith(prefix) else None
            return [(key, payload)] if payload is not None else []
        known = {*self._payloads, *(self._table[place] for place in list(self._bundled))}  # filled in another thread
        taken = sorted(key for key in known if keys.matches(expression, prefix + key))
        return [(key, payload) for key in taken if (payload := self._payload(key)) is not None]

    def _payload(self, key: str) -> bytes | None:
        found = self._bundled.get(self._indices.get(key, -1))
        return found[0].payload(found[1]) if found else self._payloads.get(key)
