"""The random numbers of a fleet: one stream per drone and sensor, one of wind per drone, one of wind for all.

The kernel takes rows of standard normal numbers from one table; `refill` moves what is left to the front and draws the
rest. What a stream gives does not depend on the size of the table, nor on the other drones.
"""

import math

import numpy as np
from numpy.typing import NDArray

from zsim.math.compiled import kernel
from zsim.math.random_streams import stream
from zsim.scenario.scenario import Scenario
from zsim.sensors.stock_sensors import BOARD_RATE_HZ
from zsim_world.physics.normal_variates import WORDS, fill, words
from zsim_world.sensors.sensor_set import CHANNELS, CHANNELS_MAX, SENSORS, channels, noise_width, rate_of

GUST_WIDTH = 3  # numbers of a gust
STREAMS = tuple(zip(SENSORS, CHANNELS, strict=True))  # name and channels of each sensor


class NoiseTable:
    """Standard normal numbers for `gates` gates: `table` (N + 1, all streams), `at`, `width`, `cursor` for the kernel.

    `streams` has the words of the generators, uint64 (N + 1, S, WORDS.size).
    """

    def __init__(self, scenario: Scenario, gates: int) -> None:
        names = [drone.name for drone in scenario.drones]
        streams = [[stream(scenario.seed, f"{name}/{s}") for s in (*SENSORS, "wind")] for name in names]
        common = stream(scenario.seed, "wind")
        self._rows = np.array(_rows(scenario, gates))
        widths = [[noise_width(n, channels(drone.sensors, s)) for s, n in STREAMS] for drone in scenario.drones]
        least = [2 * n + 1 for _, n in STREAMS]  # of the last row, which has no sensors
        self.width = np.array([[*row, GUST_WIDTH] for row in (*widths, least)], dtype=np.int64)
        ends = np.cumsum(self._rows * self.width.max(axis=0))
        self.at = np.array([0, *ends[:-1]], dtype=np.int64)
        self.table = np.zeros((len(names) + 1, ends[-1]))
        self.cursor = np.zeros(self.width.shape, dtype=np.int64)
        self.bias = np.zeros((len(names), len(SENSORS), 2 * CHANNELS_MAX))
        self.gust = np.zeros((len(names), 3))
        self._draw_start(scenario, streams, common)
        self.streams = np.zeros((*self.width.shape, WORDS.size), dtype=np.uint64)
        self.streams[:-1] = [[words(rng) for rng in row] for row in streams]
        self.streams[-1, -1] = words(common)
        self.cursor[:-1], self.cursor[-1, -1] = self._rows, self._rows[-1]  # nothing drawn yet
        self.refill()

    def refill(self) -> None:
        """Draw as many rows as have been used."""
        refill(self.table, self.at, self._rows, self.width, self.cursor, self.streams)

    def _draw_start(
        self, scenario: Scenario, streams: list[list[np.random.Generator]], shared: np.random.Generator
    ) -> None:
        """Draw the biases and gusts at the start, first of each stream."""
        common = shared.standard_normal(3)
        share = scenario.environment.wind.gust_correlation
        for i, drone in enumerate(scenario.drones):
            for s, name in enumerate(SENSORS):
                models, n = channels(drone.sensors, name), CHANNELS[s]
                self.bias[i, s, :n] = [model.bias for model in models] * streams[i][s].standard_normal(n)
                if self.width[i, s] > 2 * n + 1:
                    sigma = [model.correlated_sigma for model in models]
                    self.bias[i, s, CHANNELS_MAX : CHANNELS_MAX + n] = sigma * streams[i][s].standard_normal(n)
            own = streams[i][-1].standard_normal(3)
            self.gust[i] = math.sqrt(share) * common + math.sqrt(1.0 - share) * own
        self.gust *= scenario.environment.wind.gust_m_s


@kernel(makes_arrays=False)
def refill(table: NDArray, at: NDArray, rows: NDArray, widths: NDArray, cursor: NDArray, streams: NDArray) -> None:
    """Move what is left of every stream to the front of its place in the table, and draw the rest.

    Args:
        table, at: as in NoiseRows; cursor: rows used of each stream, set to 0.
        rows: int64 (S,), rows of each stream in the table.
        widths: int64 (N + 1, S), numbers in a row of each.
        streams: uint64 (N + 1, S, WORDS.size), words of each.
    """
    for i in range(table.shape[0]):
        for s in range(at.shape[0]):
            used, size = cursor[i, s] * widths[i, s], rows[s] * widths[i, s]
            numbers = table[i, at[s] : at[s] + size]
            for k in range(size - used):
                numbers[k] = numbers[used + k]
            fill(numbers[size - used :], streams[i, s])
            cursor[i, s] = 0


def _rows(scenario: Scenario, gates: int) -> list[int]:
    """Return how many rows of each stream a table needs, the sample at t = 0 included."""
    span = gates * scenario.time.gate_ms / 1000.0
    rates = [max(rate_of(getattr(d.sensors, name), name) for d in scenario.drones) for name in SENSORS]
    return [math.ceil(span * rate) + 2 for rate in (*rates, BOARD_RATE_HZ)]
