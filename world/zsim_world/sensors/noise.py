"""The random numbers of a fleet: one stream per drone and sensor, one wind stream per drone, one wind stream for all.

The kernel takes rows of standard normal variates from one table; `refill` moves the unused rows to the front and draws
the rest. A stream does not depend on the size of the table, nor on the other drones.

The numbers are those of numpy's default generator (PCG64, ziggurat), compiled here, with the same bits (a test
compares them): 2.7 ns per number in a loop, against 4 ns when compiled code calls numpy's (docs/decisions/0017).
The generator: M. O'Neill, HMC-CS-2014-0905 (2014), PCG XSL-RR 128/64. The ziggurat: G. Marsaglia and W. W. Tsang, J.
Stat. Softw. 5 (2000), with numpy's use of the bits. Its tables depend on numpy's rounding, so they are read from
numpy's generator by setting its state to produce the word that selects an entry.
"""

import math
from bisect import bisect_left
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.math import elementary as el
from zsim.math.compiled import Field, columns, inlined, kernel
from zsim.math.randomness import stream
from zsim.scenario.scenario import Scenario
from zsim.sensors.stock_sensors import BOARD_RATE_HZ
from zsim_world.sensors.sensor_set import CHANNELS, CHANNELS_MAX, SENSORS, channels, noise_width, rate_of

GUST_WIDTH = 3  # numbers per gust
STREAMS = tuple(zip(SENSORS, CHANNELS, strict=True))  # name and channels of each sensor


class NoiseTable:
    """Standard normal variates for `gates` gates: `table`, `at`, `width` and `cursor` as in NoiseRows.

    `streams` has the words of the generators, uint64 (N + 1, S, WORDS.size).
    """

    def __init__(self, scenario: Scenario, gates: int) -> None:
        names = [drone.name for drone in scenario.drones]
        streams = [[stream(scenario.seed, f"{name}/{s}") for s in (*SENSORS, "wind")] for name in names]
        common = stream(scenario.seed, "wind")
        # Number of rows of each stream, including the sample at t = 0.
        span = gates * scenario.time.gate_ms / 1000.0
        rates = [max(rate_of(getattr(d.sensors, name), name) for d in scenario.drones) for name in SENSORS]
        self._rows = np.array([math.ceil(span * rate) + 2 for rate in (*rates, BOARD_RATE_HZ)])
        widths = [[noise_width(n, channels(drone.sensors, s)) for s, n in STREAMS] for drone in scenario.drones]
        last_widths = [2 * n + 1 for _, n in STREAMS]  # widths of the last row, which has no sensors
        self.width = np.array([[*row, GUST_WIDTH] for row in (*widths, last_widths)], dtype=np.int64)
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
        self.cursor[:-1], self.cursor[-1, -1] = (
            self._rows,
            self._rows[-1],
        )  # all rows count as used, so that the table is filled
        self.refill()

    def refill(self) -> None:
        """Replace the used rows with fresh ones."""
        with np.errstate(over="ignore"):  # words wrap around; numpy warns of it if this is not compiled
            refill(self.table, self.at, self._rows, self.width, self.cursor, self.streams)

    def _draw_start(
        self, scenario: Scenario, streams: list[list[np.random.Generator]], shared: np.random.Generator
    ) -> None:
        """Draw the initial biases and gusts, from the first numbers of each stream."""
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
    """Move the unused rows of every stream to the front of its part of the table, and draw the rest.

    Args:
        table, at: as in NoiseRows; cursor: number of used rows of each stream, reset to 0.
        rows: int64 (S,), rows of each stream in the table.
        widths: int64 (N + 1, S), numbers in a row of each stream.
        streams: uint64 (N + 1, S, WORDS.size), words of each stream.
    """
    for i in range(table.shape[0]):
        for s in range(at.shape[0]):
            used, size = cursor[i, s] * widths[i, s], rows[s] * widths[i, s]
            numbers = table[i, at[s] : at[s] + size]
            for k in range(size - used):
                numbers[k] = numbers[used + k]
            fill(numbers[size - used :], streams[i, s])
            cursor[i, s] = 0


WORDS = columns(
    "StreamWords", (Field("state", "1", 2), Field("step", "1", 2))
)  # state and increment of a stream, uint64: high, low

_LAYERS, _SIZES = 256, 2**52  # layers of the ziggurat; possible sizes in a layer
_TAIL, _TAIL_INVERSE = 3.6541528853610087963519472518, 1.0 / 3.6541528853610087963519472518  # start of the tail
_MULTIPLIER = 0x2360ED051FC65DA44385DF649FCCF645  # O'Neill: multiplier for 128 bits
_MODULUS = 2**128
_MULTIPLIER_INVERSE = pow(_MULTIPLIER, -1, _MODULUS)
_ROUNDING = 8  # in sizes; exceeds the rounding error of the estimate of the first size that is not inside
_MULTIPLIER_HIGH, _MULTIPLIER_LOW = np.uint64(_MULTIPLIER >> 64), np.uint64(_MULTIPLIER & (2**64 - 1))
_HALF, _HALF_BITS = np.uint64(0xFFFFFFFF), np.uint64(32)
_TURN_SHIFT, _TURN_MASK = np.uint64(58), np.uint64(63)  # the six highest bits give the rotation of the word
_LAYER_MASK, _SIGN_SHIFT, _SIZE_SHIFT = (
    np.uint64(0xFF),
    np.uint64(8),
    np.uint64(9),
)  # fields of a word: layer, sign, size
_ONE, _SIZE_MASK = np.uint64(1), np.uint64(_SIZES - 1)
_UNIT_SHIFT, _UNIT = np.uint64(11), 1.0 / 9007199254740992.0  # 53 bits make a number in [0, 1)
_TAIL_SIGN_SHIFT = np.uint64(8)

_Words = tuple[np.uint64, np.uint64]  # high, low


class Ziggurat(NamedTuple):
    """Tables of the ziggurat, (256,) each."""

    width: NDArray[np.float64]  # number per unit of size
    inside: NDArray[np.uint64]  # smaller sizes are entirely under the curve
    height: NDArray[np.float64]  # height of the curve at the end of the layer


def _read_tables() -> Ziggurat:
    """Read the tables of numpy's ziggurat from the numbers that it draws."""
    rng = np.random.Generator(np.random.PCG64(0))
    width = np.array([_numpy_draw(rng, layer, 1)[0] for layer in range(_LAYERS)])
    inside = np.zeros(_LAYERS, dtype=np.uint64)  # 0 for layer 1, which is the cap
    for layer in (0, *range(2, _LAYERS)):
        estimate = round(width[layer - 1] / width[layer] * _SIZES)
        sizes = range(estimate - _ROUNDING, estimate + _ROUNDING)
        inside[layer] = sizes[bisect_left(sizes, True, key=lambda size, at=layer: not _numpy_draw(rng, at, size)[1])]
    height = np.array([1.0, *(el.exp(-0.5 * el.square(x * _SIZES)) for x in width[1:].tolist())])
    return Ziggurat(width, inside, height)


def _numpy_draw(rng: np.random.Generator, layer: int, size: int) -> tuple[float, bool]:
    """Return the number that numpy draws for a word, and whether it used only this word."""
    bits, state = (
        rng.bit_generator,
        layer | size << int(_SIZE_SHIFT),
    )  # if the high bits are 0, the word equals the low bits
    original = bits.state
    step = original["state"]["inc"]
    previous = (state - step) * _MULTIPLIER_INVERSE % _MODULUS
    bits.state = {**original, "state": {"state": previous, "inc": step}}
    number = rng.standard_normal()
    return number, bits.state["state"]["state"] == state


_WIDTH, _INSIDE, _HEIGHT = _read_tables()


def words(rng: np.random.Generator) -> list[int]:
    """Return the words of a stream, (WORDS.size,), for the current state of numpy's generator.

    Raises:
        ValueError: the generator is not a PCG64.
    """
    current = rng.bit_generator.state
    if current["bit_generator"] != "PCG64":
        raise ValueError(f"numpy's generator is {current['bit_generator']}; must be PCG64")
    state, step = current["state"]["state"], current["state"]["inc"]
    return [state >> 64, state & (2**64 - 1), step >> 64, step & (2**64 - 1)]


def set_generator(rng: np.random.Generator, stream: Sequence[int]) -> None:
    """Set the state of numpy's generator to the words of a stream, (WORDS.size,)."""
    state = stream[WORDS.state] << 64 | stream[WORDS.state + 1]
    step = stream[WORDS.step] << 64 | stream[WORDS.step + 1]
    rng.bit_generator.state = {**rng.bit_generator.state, "state": {"state": state, "inc": step}}


@inlined
def fill(out: NDArray, stream: NDArray) -> None:
    """Draw standard normal variates into out (n,), and advance the stream's words (WORDS.size,)."""
    state = (stream[WORDS.state], stream[WORDS.state + 1])
    step = (stream[WORDS.step], stream[WORDS.step + 1])
    drawn = 0
    while drawn < out.shape[0]:
        state = _advanced(state, step)
        word = _word(state)
        layer, size = word & _LAYER_MASK, (word >> _SIZE_SHIFT) & _SIZE_MASK
        x = size * _WIDTH[layer]
        if (word >> _SIGN_SHIFT) & _ONE:
            x = -x
        is_accepted = size < _INSIDE[layer]
        if not is_accepted and layer == 0:
            x, state = _tail(state, step, ((size >> _TAIL_SIGN_SHIFT) & _ONE) != 0)
            is_accepted = True
        elif not is_accepted:
            state = _advanced(state, step)
            upper, lower = _HEIGHT[layer - _ONE], _HEIGHT[layer]
            is_accepted = (upper - lower) * _unit(state) + lower < el.exp(-0.5 * x * x)
        if is_accepted:
            out[drawn] = x
            drawn += 1
    stream[WORDS.state], stream[WORDS.state + 1] = state


@inlined
def _high_product(a: np.uint64, b: np.uint64) -> np.uint64:
    """Return the upper 64 bits of a * b."""
    a0, a1, b0, b1 = a & _HALF, a >> _HALF_BITS, b & _HALF, b >> _HALF_BITS
    middle = a1 * b0 + ((a0 * b0) >> _HALF_BITS)
    carried = a0 * b1 + (middle & _HALF)
    return a1 * b1 + (middle >> _HALF_BITS) + (carried >> _HALF_BITS)


@inlined
def _advanced(state: _Words, step: _Words) -> _Words:
    """Return state * multiplier + step, modulo 2^128."""
    product = state[1] * _MULTIPLIER_LOW
    high = _high_product(state[1], _MULTIPLIER_LOW) + state[1] * _MULTIPLIER_HIGH + state[0] * _MULTIPLIER_LOW
    low = product + step[1]
    return high + step[0] + (_ONE if low < product else np.uint64(0)), low


@inlined
def _word(state: _Words) -> np.uint64:
    """Return the 64 random bits of a state."""
    mixed, turn = state[0] ^ state[1], state[0] >> _TURN_SHIFT
    return (mixed >> turn) | (mixed << ((np.uint64(64) - turn) & _TURN_MASK))


@inlined
def _unit(state: _Words) -> float:
    """Return a number in [0, 1)."""
    return (_word(state) >> _UNIT_SHIFT) * _UNIT


@inlined
def _tail(state: _Words, step: _Words, negative: bool) -> tuple[float, _Words]:
    """Return a number beyond the lowest layer, and the state after it."""
    while True:
        state = _advanced(state, step)
        across = -_TAIL_INVERSE * el.log1p(-_unit(state))
        state = _advanced(state, step)
        up = -el.log1p(-_unit(state))
        if up + up > across * across:
            return (-(_TAIL + across) if negative else _TAIL + across), state
