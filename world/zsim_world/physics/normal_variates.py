"""Standard normal numbers of numpy's default generator, compiled: PCG64 and the ziggurat, the same bits.

numpy draws a number in 10 ns, most of which is the way from one of its parts to the other; in one loop it is 3 ns. The
tables of the ziggurat are numpy's, as numba holds them for its own generators. A test compares the two.

The generator: M. O'Neill, HMC-CS-2014-0905 (2014), PCG XSL-RR 128/64. The ziggurat: G. Marsaglia and W. W. Tsang,
J. Stat. Softw. 5 (2000), with numpy's use of the bits.
"""

import math

import numpy as np
from numba.np.random._constants import fi_double, ki_double, wi_double, ziggurat_nor_inv_r, ziggurat_nor_r
from numpy.typing import NDArray

from zsim.math.compiled import inlined, kernel

# Columns of the words of a stream, uint64
STATE_HIGH, STATE_LOW, STEP_HIGH, STEP_LOW = 0, 1, 2, 3
COLUMNS = 4

_MULTIPLIER_HIGH, _MULTIPLIER_LOW = np.uint64(0x2360ED051FC65DA4), np.uint64(0x4385DF649FCCF645)  # O'Neill, for 128 bit
_HALF, _HALF_BITS = np.uint64(0xFFFFFFFF), np.uint64(32)
_TURN_SHIFT, _TURN_MASK = np.uint64(58), np.uint64(63)  # the six highest bits say how far the word is turned
_LAYER_MASK, _SIGN_SHIFT, _SIZE_SHIFT = np.uint64(0xFF), np.uint64(8), np.uint64(9)  # of a word: layer, sign, size
_ONE, _SIZE_MASK = np.uint64(1), np.uint64(0x000FFFFFFFFFFFFF)
_UNIT_SHIFT, _UNIT = np.uint64(11), 1.0 / 9007199254740992.0  # 53 bits make a number in [0, 1)
_TAIL_SIGN_SHIFT = np.uint64(8)

Words = tuple[np.uint64, np.uint64]  # high, low


def words(rng: np.random.Generator) -> list[int]:
    """Return the words of a stream, (COLUMNS,), from where numpy's generator stands."""
    found = rng.bit_generator.state
    if found["bit_generator"] != "PCG64":
        raise ValueError(f"numpy's generator is {found['bit_generator']}; must be PCG64")
    state, step = found["state"]["state"], found["state"]["inc"]
    return [state >> 64, state & (2**64 - 1), step >> 64, step & (2**64 - 1)]


@inlined
def _high_product(a: np.uint64, b: np.uint64) -> np.uint64:
    """Return the upper 64 bits of a b."""
    a0, a1, b0, b1 = a & _HALF, a >> _HALF_BITS, b & _HALF, b >> _HALF_BITS
    middle = a1 * b0 + ((a0 * b0) >> _HALF_BITS)
    carried = a0 * b1 + (middle & _HALF)
    return a1 * b1 + (middle >> _HALF_BITS) + (carried >> _HALF_BITS)


@inlined
def _advanced(state: Words, step: Words) -> Words:
    """Return state * multiplier + step, of 128 bit."""
    product = state[1] * _MULTIPLIER_LOW
    high = _high_product(state[1], _MULTIPLIER_LOW) + state[1] * _MULTIPLIER_HIGH + state[0] * _MULTIPLIER_LOW
    low = product + step[1]
    return high + step[0] + (_ONE if low < product else np.uint64(0)), low


@inlined
def _word(state: Words) -> np.uint64:
    """Return the 64 random bits of a state."""
    mixed, turn = state[0] ^ state[1], state[0] >> _TURN_SHIFT
    return (mixed >> turn) | (mixed << ((np.uint64(64) - turn) & _TURN_MASK))


@inlined
def _unit(state: Words) -> float:
    """Return a number in [0, 1)."""
    return (_word(state) >> _UNIT_SHIFT) * _UNIT


@inlined
def _tail(state: Words, step: Words, negative: bool) -> tuple[float, Words]:
    """Return a number beyond the lowest layer, and the state after it."""
    while True:
        state = _advanced(state, step)
        across = -ziggurat_nor_inv_r * math.log1p(-_unit(state))
        state = _advanced(state, step)
        up = -math.log1p(-_unit(state))
        if up + up > across * across:
            return (-(ziggurat_nor_r + across) if negative else ziggurat_nor_r + across), state


@kernel(makes_arrays=False)
def refill(table: NDArray, at: NDArray, rows: NDArray, widths: NDArray, cursor: NDArray, streams: NDArray) -> None:
    """Move what is left of every stream to the front of its place in the table, and draw the rest.

    Args:
        table, at: as in arrays.Noise; cursor: rows used of each stream, set to 0.
        rows, widths: int64 (S,), rows of each stream in the table, numbers in each.
        streams: uint64 (N + 1, S, COLUMNS), words of each.
    """
    for i in range(table.shape[0]):
        for s in range(at.shape[0]):
            used, size = cursor[i, s] * widths[s], rows[s] * widths[s]
            numbers = table[i, at[s] : at[s] + size]
            for k in range(size - used):
                numbers[k] = numbers[used + k]
            fill(numbers[size - used :], streams[i, s])
            cursor[i, s] = 0


@inlined
def fill(out: NDArray, stream: NDArray) -> None:
    """Draw standard normal numbers into out (n,), and move the stream's words (COLUMNS,) on."""
    state, step = (stream[STATE_HIGH], stream[STATE_LOW]), (stream[STEP_HIGH], stream[STEP_LOW])
    drawn = 0
    while drawn < out.shape[0]:
        state = _advanced(state, step)
        word = _word(state)
        layer, size = word & _LAYER_MASK, (word >> _SIZE_SHIFT) & _SIZE_MASK
        x = size * wi_double[layer]
        if (word >> _SIGN_SHIFT) & _ONE:
            x = -x
        kept = size < ki_double[layer]
        if not kept and layer == 0:
            x, state = _tail(state, step, ((size >> _TAIL_SIGN_SHIFT) & _ONE) != 0)
            kept = True
        elif not kept:
            state = _advanced(state, step)
            above, here = fi_double[layer - _ONE], fi_double[layer]
            kept = (above - here) * _unit(state) + here < math.exp(-0.5 * x * x)
        if kept:
            out[drawn] = x
            drawn += 1
    stream[STATE_HIGH], stream[STATE_LOW] = state
