"""The kernel's standard normal numbers are numpy's, bit by bit."""

import numpy as np
import pytest
from numpy.typing import NDArray

from zsim.math.compiled import kernel
from zsim_world.sensors.noise import WORDS, fill, words


@kernel(makes_arrays=False)
def drawn(out: NDArray, stream: NDArray) -> None:
    fill(out, stream)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_million_numbers_are_numpys(seed: int):
    """About 270 of them are from the tail, and 12 000 from the layers' edges."""
    rng = np.random.default_rng(seed)
    stream, out = np.array(words(rng), dtype=np.uint64), np.zeros(1_000_000)
    drawn(out, stream)
    np.testing.assert_array_equal(out, rng.standard_normal(len(out)))
    assert np.abs(out).max() > 3.66
    assert stream.tolist() == words(rng)


def test_another_generator_is_refused():
    assert len(words(np.random.default_rng(0))) == WORDS.size
    with pytest.raises(ValueError, match="MT19937"):
        words(np.random.Generator(np.random.MT19937(0)))
