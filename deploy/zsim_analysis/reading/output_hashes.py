"""Hashes of the messages of a flight, by which two flights are compared.

OutputHashes    a hash of all outputs of agents on a key: whether the flights are identical
GateDigests     a checksum of each key at each gate, instead of a record: where they first differ
"""

import csv
import hashlib
import io
import zlib
from collections.abc import Iterator
from itertools import zip_longest
from typing import Any

from msgspec.structs import replace

from zsim.contract import keys, messages
from zsim.contract.run_messages import ClusterRequest

ALL = 0xFFFFFFFF
CAUSES = ("truth", "estimate")


def content_of(message: Any) -> bytes:
    """Return an agent's output as on the wire, but without its process, which agents may share."""
    return messages.encode(replace(message, **{"controller" if isinstance(message, ClusterRequest) else "source": ""}))


class OutputHashes:
    """SHA-256 of the outputs of agents up to an instant, by key.

    Args:
        until_ns: the last instant whose outputs count; outputs for later gates may be missing on record.
    """

    def __init__(self, until_ns: int) -> None:
        self._until_ns = until_ns
        self._of: dict[str, hashlib._Hash] = {}

    def add(self, key: str, t_ns: int, content: bytes) -> None:
        """Add an output, as `content_of` returns it, in the order of publication for each key."""
        if t_ns <= self._until_ns:
            self._of.setdefault(key, hashlib.sha256()).update(len(content).to_bytes(4, "little") + content)

    def hexdigests(self) -> dict[str, str]:
        return {key: digest.hexdigest() for key, digest in sorted(self._of.items())}


class GateDigests:
    """A checksum of the messages on each key at each gate. `until_ns` as in OutputHashes."""

    def __init__(self, until_ns: int) -> None:
        self._until_ns = until_ns
        self._sums: dict[int, dict[str, int]] = {}

    def add(self, key: str, t_ns: int, payload: bytes) -> None:
        if t_ns <= self._until_ns:
            at = self._sums.setdefault(t_ns, {})
            at[key] = at.get(key, 0) + zlib.crc32(payload) & ALL

    def csv(self) -> bytes:
        """Return a table: `t_ns`, then a column for each key, with 8 hex digits or empty."""
        names = sorted({key for at in self._sums.values() for key in at})
        file = io.StringIO()
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["t_ns", *names])
        for t_ns, at in sorted(self._sums.items()):
            writer.writerow([t_ns, *(f"{at[name]:08x}" if name in at else "" for name in names)])
        return file.getvalue().encode()


def first_difference(expected: bytes, found: bytes) -> tuple[int, str] | None:
    """Return the first instant [ns] and key at which two tables of `GateDigests.csv` differ; None if they are equal.

    Among the keys of an instant, the first is chosen in the order of cause: truth, estimates, others.

    Raises:
        ValueError: one is not such a table.
    """
    rows = zip_longest(_rows(expected), _rows(found), fillvalue=(0, dict[str, str]()))
    for (t_ns, a), (other_ns, b) in rows:
        if differing := [key for key in {*a, *b} if a.get(key, "") != b.get(key, "")]:
            return t_ns or other_ns, min(differing, key=lambda key: (*(keys.leaf(key) != each for each in CAUSES), key))
    return None


def _rows(table: bytes) -> Iterator[tuple[int, dict[str, str]]]:
    try:
        for row in csv.DictReader(io.StringIO(table.decode()), strict=True):
            yield int(row.pop("t_ns")), {key: digits for key, digits in row.items() if digits}
    except (csv.Error, KeyError, TypeError) as error:
        raise ValueError(f"not a table of digests: {error}") from error
