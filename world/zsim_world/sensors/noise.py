"""The random numbers of a fleet: one stream per drone and sensor, one of wind per drone, one of wind for all.

The kernel takes rows of standard normal numbers from one table; `refill` moves what is left to the front and draws the
rest. What a stream gives does not depend on the size of the table, nor on the other drones.
"""

import math
from typing import Any

import numpy as np
from numba.typed.typedlist import List
from numpy.typing import NDArray

from zsim.math.compiled import compiled, kernel
from zsim.math.random_streams import stream
from zsim.scenario.scenario import Scenario
from zsim.sensors.imu import BOARD_RATE_HZ
from zsim_world.sensors.sensor_set import CHANNELS, CHANNELS_MAX, NOISE_WIDTH, SENSORS, channels, rate_of

WIDTHS = (*NOISE_WIDTH, 3)  # numbers per row: of a sample, of a gust


class NoiseTable:
    """Standard normal numbers for `gates` gates: `table` (N + 1, all streams), `at` and `cursor` for the kernel."""

    def __init__(self, scenario: Scenario, gates: int) -> None:
        names = [drone.name for drone in scenario.drones]
        streams = [[stream(scenario.seed, f"{name}/{s}") for s in (*SENSORS, "wind")] for name in names]
        common = stream(scenario.seed, "wind")
        self._rows, self._widths = np.array(_rows(scenario, gates)), np.array(WIDTHS)
        ends = np.cumsum(self._rows * self._widths)
        self.at = np.array([0, *ends[:-1]], dtype=np.int64)
        self.table = np.zeros((len(names) + 1, ends[-1]))
        self.cursor = np.zeros((len(names) + 1, len(WIDTHS)), dtype=np.int64)
        self.bias = np.zeros((len(names), len(SENSORS), CHANNELS_MAX))
        self.gust = np.zeros((len(names), 3))
        self._draw_start(scenario, streams, common)
        self._streams = _list_of([rng for row in streams for rng in row])
        self._common = _list_of([common])
        self.cursor[:-1], self.cursor[-1, -1] = self._rows, self._rows[-1]  # nothing drawn yet
        self.refill()

    def refill(self) -> None:
        """Draw as many rows as have been used."""
        refill(self.table, self.at, self._rows, self._widths, self.cursor, self._streams, self._common)

    def _draw_start(
        self, scenario: Scenario, streams: list[list[np.random.Generator]], shared: np.random.Generator
    ) -> None:
        """Draw the biases and gusts at the start, first of each stream."""
        common = shared.standard_normal(3)
        share = scenario.environment.wind.gust_correlation
        for i, drone in enumerate(scenario.drones):
            for s, name in enumerate(SENSORS):
                sigma = [model.bias for model in channels(drone.sensors, name)]
                self.bias[i, s, : CHANNELS[s]] = sigma * streams[i][s].standard_normal(CHANNELS[s])
            own = streams[i][-1].standard_normal(3)
            self.gust[i] = math.sqrt(share) * common + math.sqrt(1.0 - share) * own
        self.gust *= scenario.environment.wind.gust_m_s


@kernel()
def _started(rng: np.random.Generator) -> Any:
    """Return a list of one generator: numba takes a list as one thing."""
    rngs = List()
    rngs.append(rng)
    return rngs


@kernel()
def _append(rngs: Any, rng: np.random.Generator) -> None:
    rngs.append(rng)


def _list_of(rngs: list[np.random.Generator]) -> Any:
    """Return generators as a list for compiled code."""
    made = _started(rngs[0])
    for rng in rngs[1:]:
        _append(made, rng)
    return made


@kernel()
def refill(
    table: NDArray, at: NDArray, rows: NDArray, widths: NDArray, cursor: NDArray, streams: Any, common: Any
) -> None:
    """Move what is left of every stream to the front of its place in the table, and draw the rest.

    Args:
        table, at: as in NoiseRows; cursor: rows used of each stream, set to 0.
        rows, widths: int64 (S,), rows of each stream in the table, numbers in each.
        streams: generators, S for each drone; common: that of the wind that all share.
    """
    drones, count = table.shape[0] - 1, at.shape[0]
    for i in range(drones + 1):
        for s in range(count if i < drones else 0):
            numbers = table[i, at[s] : at[s] + rows[s] * widths[s]]
            _draw(numbers, int(cursor[i, s] * widths[s]), streams[i * count + s])
            cursor[i, s] = 0
    last = count - 1
    wind = table[drones, at[last] : at[last] + rows[last] * widths[last]]
    _draw(wind, int(cursor[drones, last] * widths[last]), common[0])
    cursor[drones, last] = 0


@compiled
def _draw(numbers: NDArray, used: int, rng: np.random.Generator) -> None:
    """Move what is left of standard normal numbers to the front, and draw the rest."""
    left = numbers.shape[0] - used
    for k in range(left):
        numbers[k] = numbers[used + k]
    for k in range(left, numbers.shape[0]):
        numbers[k] = rng.standard_normal()


def _rows(scenario: Scenario, gates: int) -> list[int]:
    """Return how many rows of each stream a table needs, the sample at t = 0 included."""
    span = gates * scenario.time.gate_ms / 1000.0
    rates = [max(rate_of(getattr(d.sensors, name), name) for d in scenario.drones) for name in SENSORS]
    return [math.ceil(span * rate) + 2 for rate in (*rates, BOARD_RATE_HZ)]
