"""The kernel's normal numbers are those of numpy's generators."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from zsim.math.compiled import kernel
from zsim.math.randomness import stream
from zsim.scenario.scenario_file import resolve
from zsim_world.sensors.noise import WORDS, NoiseTable, fill, words
from zsim_world.sensors.sensor_set import CHANNELS, SENSORS

IMU = 0


def noise(gates: int) -> NoiseTable:
    drones: list[dict[str, Any]] = [{"name": name, "position_m": [3 * k, 0, 0]} for k, name in enumerate("ab")]
    return NoiseTable(resolve({"name": "t", "duration_s": 1, "seed": 3, "drones": drones}), gates)


@pytest.mark.parametrize("used", [0, 1, 7])
def test_a_stream_continues_where_it_was_left(used: int):
    table = noise(gates=2)
    rng = stream(3, "b/imu")
    rng.standard_normal(CHANNELS[IMU])  # the bias at the start
    width = table.width[1, IMU]
    rows = (table.at[IMU + 1] - table.at[IMU]) // width
    expected = rng.standard_normal((rows + used, width))
    np.testing.assert_array_equal(table.table[1, : rows * width], expected[:rows].ravel())
    table.cursor[:-1, IMU] = used
    table.refill()
    assert not table.cursor.any()
    np.testing.assert_array_equal(table.table[1, : rows * width], expected[used:].ravel())


def test_all_drones_share_one_wind_stream():
    table = noise(gates=2)
    rng = stream(3, "wind")
    rng.standard_normal(3)  # the gust at the start
    at = table.at[len(SENSORS)]
    np.testing.assert_array_equal(table.table[-1, at:], rng.standard_normal(table.table.shape[1] - at))


@kernel(makes_arrays=False)
def drawn(out: NDArray, stream: NDArray) -> None:
    fill(out, stream)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_million_numbers_match_numpy(seed: int):
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
