"""Random streams by name, such as "drone1/imu", and single draws: adding a drone or a sensor changes no other."""

import hashlib

import numpy as np


def stream(seed: int, name: str) -> np.random.Generator:
    """Return the generator with SeedSequence(seed, spawn_key = first 16 bytes of SHA-256(name)).

    That key is stable over processes and versions, unlike `hash()`.
    """
    digest = hashlib.sha256(name.encode()).digest()[:16]
    key = tuple(int.from_bytes(digest[i : i + 4], "little") for i in range(0, 16, 4))
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


def uniform(*what: object) -> float:
    """Return the number in [0, 1) that is drawn for something by what it is, whenever and wherever.

    The first 53 bits of BLAKE2b of the texts of its parts: as even as a double can be, and the same on every machine.
    """
    digest = hashlib.blake2b("|".join(map(str, what)).encode(), digest_size=8).digest()
    return (int.from_bytes(digest, "big") >> 11) * 2.0**-53
