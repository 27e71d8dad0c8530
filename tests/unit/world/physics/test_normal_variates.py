"""The compiled generator against numpy's own."""

import numpy as np
import pytest
from refused import refused

from zsim.math.random_streams import stream
from zsim_world.physics import normal_variates


def drawn(words, rows, width, used, table):
    """Refill one stream of which so many rows are used; return its place in the table."""
    cursor = np.full((1, 1), used)
    normal_variates.refill(table, np.array([0]), np.array([rows]), np.array([width]), cursor, words)
    assert cursor[0, 0] == 0
    return table[0].copy()


@pytest.mark.parametrize("seed", range(4))
def test_numbers_are_those_of_numpy_also_after_leaving_some(seed):
    """800 000 numbers: some 200 of them come from the tail, and 10 000 from the edge of a layer."""
    rng, width, rows = stream(seed, "drone1/imu"), 13, 60_000
    words = np.array([[normal_variates.words(rng)]], dtype=np.uint64)
    table = np.zeros((1, rows * width))
    numbers = rng.standard_normal((rows, width))
    np.testing.assert_array_equal(drawn(words, rows, width, rows, table), numbers.ravel())
    assert np.abs(numbers).max() > 3.66, "no number of the tail"
    for used in (0, 1, 777):
        numbers = np.concatenate((numbers[used:], rng.standard_normal((used, width))))
        np.testing.assert_array_equal(drawn(words, rows, width, used, table), numbers.ravel())
    assert words[0, 0].tolist() == normal_variates.words(rng)


def test_another_generator_is_refused():
    with refused(ValueError, "MT19937", "PCG64"):
        normal_variates.words(np.random.Generator(np.random.MT19937(1)))
