"""Random streams by name, such as "drone1/imu": adding a drone or a sensor changes no other stream."""

import hashlib

import numpy as np


def stream(seed: int, name: str) -> np.random.Generator:
    """Return the generator with SeedSequence(seed, spawn_key = first 16 bytes of SHA-256(name)).

    That key is stable over processes and versions, unlike `hash()`.
    """
    digest = hashlib.sha256(name.encode()).digest()[:16]
    key = tuple(int.from_bytes(digest[i : i + 4], "little") for i in range(0, 16, 4))
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
