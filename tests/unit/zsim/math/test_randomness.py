"""Random streams: named, reproducible and independent of each other."""

import numpy as np

from zsim.math.randomness import stream

NAMES = [f"drone{n}/{sensor}" for n in (1, 2, 3) for sensor in ("imu", "gps", "mag", "wind")]


def draws(seed: int, name: str, count: int = 8) -> list[float]:
    return stream(seed, name).standard_normal(count).tolist()


def test_the_key_of_a_stream_is_the_hash_of_its_name():
    """First 16 bytes of `printf drone1/imu | sha256sum`, as four little-endian words."""
    digest = "047952e0fcbae3f73afb993fb46be5c8"
    words = [int.from_bytes(bytes.fromhex(digest[i : i + 8]), "little") for i in range(0, 32, 8)]
    wanted = np.random.Generator(np.random.PCG64(np.random.SeedSequence(7, spawn_key=tuple(words))))
    assert draws(7, "drone1/imu") == wanted.standard_normal(8).tolist()


def test_names_and_seeds_give_different_streams():
    firsts = {draws(seed, name)[0] for seed in (0, 1, 2**62) for name in NAMES}
    assert len(firsts) == 3 * len(NAMES)


def test_streams_are_not_correlated():
    columns = np.array([stream(1, name).standard_normal(4000) for name in NAMES])
    correlation = np.corrcoef(columns) - np.eye(len(NAMES))
    assert np.abs(correlation).max() < 5 / np.sqrt(4000)
