"""Random streams that do not know of each other.

A stream belongs to a name such as "drone1/imu". Its seed is SeedSequence(seed, spawn_key = hash of the name),
so that adding a drone or a sensor changes no other stream.
"""

import hashlib

import numpy as np


def stream(seed: int, name: str) -> np.random.Generator:
    """Return the generator of `name` for a scenario's seed.

    The key is the first 16 bytes of SHA-256(name): stable over processes and versions, unlike `hash()`.
    """
    digest = hashlib.sha256(name.encode()).digest()[:16]
    key = tuple(int.from_bytes(digest[i : i + 4], "little") for i in range(0, 16, 4))
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


class NormalBlock:
    """Standard normal numbers of one stream, drawn in blocks: a call per sample costs more than the number.

    The sequence does not depend on the block's size.
    """

    def __init__(self, rng: np.random.Generator, width: int, rows: int = 256) -> None:
        self._rng = rng
        self._rows = rows
        self._width = width
        self._block = np.empty((0, width))
        self._next = 0

    def take(self, count: int) -> np.ndarray:
        """Return the next `count` rows, shape (count, width)."""
        while self._next + count > len(self._block):
            fresh = self._rng.standard_normal((self._rows, self._width))
            self._block = np.concatenate([self._block[self._next :], fresh])
            self._next = 0
        rows = self._block[self._next : self._next + count]
        self._next += count
        return rows
