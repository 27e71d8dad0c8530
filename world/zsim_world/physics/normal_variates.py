"""Standard normal numbers of numpy's default generator, compiled: PCG64 and the ziggurat, the same bits.

In one loop a number takes 2.7 ns; from numpy's generator, called by compiled code, it takes 4 ns (docs/decisions/0017).
A test compares the two.

The generator: M. O'Neill, HMC-CS-2014-0905 (2014), PCG XSL-RR 128/64. The ziggurat: G. Marsaglia and W. W. Tsang,
J. Stat. Softw. 5 (2000), with numpy's use of the bits. Its tables follow from a recurrence, but rounding along it is
numpy's own: so they are read from numpy's generator, whose state is set to give the word that asks for an entry.
"""

import math
from bisect import bisect_left
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.math.compiled import Field, columns, inlined

WORDS = columns("StreamWords", (Field("state", "1", 2), Field("step", "1", 2)))  # of a stream, uint64: high, low

_LAYERS, _SIZES = 256, 2**52  # of the ziggurat; of the numbers that a word may ask for in a layer
_TAIL, _TAIL_INVERSE = 3.6541528853610087963519472518, 1.0 / 3.6541528853610087963519472518  # where the tail begins
_MULTIPLIER = 0x2360ED051FC65DA44385DF649FCCF645  # O'Neill, for 128 bit
_MODULUS = 2**128
_MULTIPLIER_INVERSE = pow(_MULTIPLIER, -1, _MODULUS)
_ROUNDING = 8  # sizes, more than what rounding makes of the first that is not inside
_MULTIPLIER_HIGH, _MULTIPLIER_LOW = np.uint64(_MULTIPLIER >> 64), np.uint64(_MULTIPLIER & (2**64 - 1))
_HALF, _HALF_BITS = np.uint64(0xFFFFFFFF), np.uint64(32)
_TURN_SHIFT, _TURN_MASK = np.uint64(58), np.uint64(63)  # the six highest bits say how far the word is turned
_LAYER_MASK, _SIGN_SHIFT, _SIZE_SHIFT = np.uint64(0xFF), np.uint64(8), np.uint64(9)  # of a word: layer, sign, size
_ONE, _SIZE_MASK = np.uint64(1), np.uint64(_SIZES - 1)
_UNIT_SHIFT, _UNIT = np.uint64(11), 1.0 / 9007199254740992.0  # 53 bits make a number in [0, 1)
_TAIL_SIGN_SHIFT = np.uint64(8)

_Words = tuple[np.uint64, np.uint64]  # high, low


class Ziggurat(NamedTuple):
    """Tables of the ziggurat, (256,) each."""

    width: NDArray[np.float64]  # number per size
    inside: NDArray[np.uint64]  # sizes below it are wholly under the curve
    height: NDArray[np.float64]  # of the curve at the layer's end


def _read_tables() -> Ziggurat:
    """Read the tables of numpy's ziggurat from what it draws."""
    rng = np.random.Generator(np.random.PCG64(0))
    width = np.array([_drawn(rng, layer, 1)[0] for layer in range(_LAYERS)])
    inside = np.zeros(_LAYERS, dtype=np.uint64)  # of layer 1: none, it is the cap
    for layer in (0, *range(2, _LAYERS)):
        near = round(width[layer - 1] / width[layer] * _SIZES)
        sizes = range(near - _ROUNDING, near + _ROUNDING)
        inside[layer] = sizes[bisect_left(sizes, True, key=lambda size, at=layer: not _drawn(rng, at, size)[1])]
    height = np.array([1.0, *(math.exp(-0.5 * (x * _SIZES) ** 2) for x in width[1:].tolist())])
    return Ziggurat(width, inside, height)


def _drawn(rng: np.random.Generator, layer: int, size: int) -> tuple[float, bool]:
    """Return the number that numpy makes of a word, and whether it needed no other."""
    bits, state = rng.bit_generator, layer | size << int(_SIZE_SHIFT)  # without high bits, the word is the low ones
    held = bits.state
    step = held["state"]["inc"]
    before = (state - step) * _MULTIPLIER_INVERSE % _MODULUS
    bits.state = {**held, "state": {"state": before, "inc": step}}
    number = rng.standard_normal()
    return number, bits.state["state"]["state"] == state


_WIDTH, _INSIDE, _HEIGHT = _read_tables()


def words(rng: np.random.Generator) -> list[int]:
    """Return the words of a stream, (WORDS.size,), from where numpy's generator stands.

    Raises:
        ValueError: it is not a PCG64.
    """
    held = rng.bit_generator.state
    if held["bit_generator"] != "PCG64":
        raise ValueError(f"numpy's generator is {held['bit_generator']}; must be PCG64")
    state, step = held["state"]["state"], held["state"]["inc"]
    return [state >> 64, state & (2**64 - 1), step >> 64, step & (2**64 - 1)]


def place(rng: np.random.Generator, stream: Sequence[int]) -> None:
    """Let numpy's generator stand where the words of a stream do, (WORDS.size,)."""
    state = stream[WORDS.state] << 64 | stream[WORDS.state + 1]
    step = stream[WORDS.step] << 64 | stream[WORDS.step + 1]
    rng.bit_generator.state = {**rng.bit_generator.state, "state": {"state": state, "inc": step}}


@inlined
def fill(out: NDArray, stream: NDArray) -> None:
    """Draw standard normal numbers into out (n,), and move the stream's words (WORDS.size,) on."""
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
        kept = size < _INSIDE[layer]
        if not kept and layer == 0:
            x, state = _tail(state, step, ((size >> _TAIL_SIGN_SHIFT) & _ONE) != 0)
            kept = True
        elif not kept:
            state = _advanced(state, step)
            above, here = _HEIGHT[layer - _ONE], _HEIGHT[layer]
            kept = (above - here) * _unit(state) + here < math.exp(-0.5 * x * x)
        if kept:
            out[drawn] = x
            drawn += 1
    stream[WORDS.state], stream[WORDS.state + 1] = state


@inlined
def _high_product(a: np.uint64, b: np.uint64) -> np.uint64:
    """Return the upper 64 bits of a b."""
    a0, a1, b0, b1 = a & _HALF, a >> _HALF_BITS, b & _HALF, b >> _HALF_BITS
    middle = a1 * b0 + ((a0 * b0) >> _HALF_BITS)
    carried = a0 * b1 + (middle & _HALF)
    return a1 * b1 + (middle >> _HALF_BITS) + (carried >> _HALF_BITS)


@inlined
def _advanced(state: _Words, step: _Words) -> _Words:
    """Return state * multiplier + step, of 128 bit."""
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
        across = -_TAIL_INVERSE * math.log1p(-_unit(state))
        state = _advanced(state, step)
        up = -math.log1p(-_unit(state))
        if up + up > across * across:
            return (-(_TAIL + across) if negative else _TAIL + across), state
