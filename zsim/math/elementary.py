"""Elementary functions that give the same bits on every processor, C library and version of Python.

The functions of libm, numpy and numba differ in their last bits between processors and versions. Here, each is a fixed
sequence of additions, multiplications, divisions and square roots in double precision, which IEEE 754 defines to the
bit; none of them is fused. Whatever affects the flight of a drone or the output of an agent uses these:

    sin cos sin_cos tan asin acos atan atan2 exp log log1p power hypot length distance square
    elementwise(sin)(array)                     for arrays of any shape

Results are within 2 units in the last place (ULP) of the true values, those of `power` within 2 + 2 |y ln x|:
tests/authority/test_elementary_authority.py. Beyond 1e6 rad, sin, cos and tan lose accuracy in proportion to the
angle. As in numba, and unlike in Python's `math`, arguments outside the domain give nan, and overflow gives inf.

Methods: reduction of angles by pi/2 in three parts (W. J. Cody, W. Waite, Software Manual for the Elementary
Functions, 1980); exp and atan from tables between whose points short Taylor series suffice (P. T. P. Tang, ACM
Transactions on Mathematical Software 15 (1989) 144-157); log by the series of atanh, arranged as in fdlibm (Sun
Microsystems, 1993). The tables are computed with Python's decimal arithmetic, which is the same everywhere.
"""

import math
from collections.abc import Callable, Iterable
from decimal import Decimal, localcontext
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zsim.math.compiled import deferred

_CELLS = 32  # cells of the tables of 2^x and of atan over [0, 1]; half a cell is small enough for the series below


class _Tables(NamedTuple):
    """Constants, each as a sum of doubles of decreasing size."""

    half_pi: tuple[float, float, float]
    ln2: tuple[float, float]
    exp2: NDArray[np.float64]  # 2^(k / _CELLS), (_CELLS, 2)
    atan: NDArray[np.float64]  # atan(k / _CELLS), (_CELLS + 1, 2)


def _tables() -> _Tables:
    def head(number: Decimal, bits: int) -> float:
        """Return the leading bits of a number between 1/2 and 2; products with integers of 53 - bits bits are exact."""
        return int(number * 2**bits) / 2**bits

    def split(number: Decimal) -> tuple[float, float]:
        return float(number), float(number - Decimal(float(number)))

    def atan_of(x: Decimal) -> Decimal:
        """Return atan(x) by Euler's series, in which each term is less than half of the one before."""
        term = x / (1 + x * x)
        total, n = term, 0
        while term > Decimal("1e-50"):
            n += 1
            term *= 2 * n * x * x / ((2 * n + 1) * (1 + x * x))
            total += term
        return total

    with localcontext() as context:
        context.prec = 60
        half_pi = 2 * atan_of(Decimal(1))
        first = head(half_pi, 32)
        second = head((half_pi - Decimal(first)) * 2**33, 32) / 2**33
        ln2 = Decimal(2).ln()
        long = head(ln2, 32)
        return _Tables(
            (first, second, float(half_pi - Decimal(first) - Decimal(second))),
            (long, float(ln2 - Decimal(long))),
            np.array([split(2 ** (Decimal(k) / _CELLS)) for k in range(_CELLS)]),
            np.array([split(atan_of(Decimal(k) / _CELLS)) for k in range(_CELLS + 1)]),
        )


_TABLES = _tables()
_PI_A, _PI_B, _PI_C = _TABLES.half_pi
_HALF_PI_LOW = float((Decimal(_PI_A) - Decimal(math.pi / 2)) + Decimal(_PI_B) + Decimal(_PI_C))  # pi/2 minus its double
_LN2_A, _LN2_B = _TABLES.ln2
_CELLS_PER_E = _CELLS / (_LN2_A + _LN2_B)  # cells of the table of 2^x per unit of x in e^x
_EXP2, _ATAN = _TABLES.exp2, _TABLES.atan
_scalar = deferred(makes_arrays=False)
_LARGEST_EXPONENT = 1100.0  # beyond it, e^x exceeds the range of doubles
_ACCURATE_RAD = 1e6  # up to it, products of the number of quarter turns and the parts of pi / 2 are exact
_SQRT_HALF = math.sqrt(0.5)


@_scalar
def sin_cos(x: float) -> tuple[float, float]:
    """Return the sine and cosine of an angle [rad]."""
    if not abs(x) < math.inf:
        return math.nan, math.nan
    if x == 0.0:
        return x, 1.0  # preserves the sign of the zero
    if abs(x) > _ACCURATE_RAD:
        x = x % (2.0 * math.pi)
    turns = math.floor(x * (2.0 / math.pi) + 0.5)
    a = x - turns * _PI_A
    b = turns * _PI_B
    r = a - b
    remainder = ((a - r) - b) - turns * _PI_C  # the reduced angle is r + remainder, |r| <= pi / 4
    z = r * r
    odd = z * (1.0 / 6227020800.0 + z * (-1.0 / 1307674368000.0 + z / 355687428096000.0))
    odd = z * z * (1.0 / 120.0 + z * (-1.0 / 5040.0 + z * (1.0 / 362880.0 + z * (-1.0 / 39916800.0 + odd))))
    sine = r + (r * (z * (-1.0 / 6.0) + odd) + remainder * (1.0 - 0.5 * z))
    even = z * (1.0 / 479001600.0 + z * (-1.0 / 87178291200.0 + z / 20922789888000.0))
    even = z * z * (1.0 / 24.0 + z * (-1.0 / 720.0 + z * (1.0 / 40320.0 + z * (-1.0 / 3628800.0 + even))))
    leading = 1.0 - 0.5 * z
    cosine = leading + (((1.0 - leading) - 0.5 * z) + (even - r * remainder))
    quadrant = turns - 4.0 * math.floor(0.25 * turns)
    if quadrant == 0.0:
        return sine, cosine
    if quadrant == 1.0:
        return cosine, -sine
    if quadrant == 2.0:
        return -sine, -cosine
    return -cosine, sine


@_scalar
def sin(x: float) -> float:
    return sin_cos(x)[0]


@_scalar
def cos(x: float) -> float:
    return sin_cos(x)[1]


@_scalar
def tan(x: float) -> float:
    s, c = sin_cos(x)
    return s / c


@_scalar
def atan2(y: float, x: float) -> float:
    """Return the angle [rad] of the point (x, y) in [-pi, pi]."""
    if math.isnan(x) or math.isnan(y):
        return math.nan
    low, high = min(abs(x), abs(y)), max(abs(x), abs(y))
    if math.isinf(high):
        low, high = (1.0 if math.isinf(low) else 0.0), 1.0
    angle = 0.0
    if high > 0.0:
        cell = int(low / high * _CELLS + 0.5)
        slope = cell / _CELLS
        t = (low - slope * high) / (high + slope * low)  # tan(a - b) from tan a and tan b
        z = t * t
        series = z * (-1.0 / 3.0 + z * (1.0 / 5.0 + z * (-1.0 / 7.0 + z * (1.0 / 9.0 - z / 11.0))))
        angle = _ATAN[cell, 0] + (t + (t * series + _ATAN[cell, 1]))
    if abs(y) > abs(x):
        angle = 0.5 * math.pi - (angle - _HALF_PI_LOW)
    if math.copysign(1.0, x) < 0.0:
        angle = math.pi - (angle - 2.0 * _HALF_PI_LOW)
    return math.copysign(angle, y)


@_scalar
def atan(x: float) -> float:
    return atan2(x, 1.0)


@_scalar
def asin(x: float) -> float:
    return atan2(x, math.sqrt((1.0 - x) * (1.0 + x))) if abs(x) <= 1.0 else math.nan


@_scalar
def acos(x: float) -> float:
    return atan2(math.sqrt((1.0 - x) * (1.0 + x)), x) if abs(x) <= 1.0 else math.nan


@_scalar
def exp(x: float) -> float:
    if not abs(x) < _LARGEST_EXPONENT:
        return math.nan if math.isnan(x) else math.inf if x > 0.0 else 0.0
    cells = math.floor(x * _CELLS_PER_E + 0.5)
    a = x - cells * (_LN2_A / _CELLS)
    b = cells * (_LN2_B / _CELLS)
    r = a - b  # |r| <= ln 2 / (2 _CELLS)
    power = math.floor(cells / _CELLS)
    cell = int(cells - _CELLS * power)
    series = r * r * (0.5 + r * (1.0 / 6.0 + r * (1.0 / 24.0 + r * (1.0 / 120.0 + r * (1.0 / 720.0)))))
    growth = r + (((a - r) - b) + series)  # e^r - 1
    significand = _EXP2[cell, 0] + (_EXP2[cell, 0] * growth + _EXP2[cell, 1])
    if power >= 1024.0:  # where Python's ldexp raises an error, but numba's does not
        return math.inf if power > 1024.0 else 2.0 * math.ldexp(significand, 1023)
    return math.ldexp(significand, int(power))


@_scalar
def log(x: float) -> float:
    """Return the natural logarithm; of 0 it is -inf."""
    if not 0.0 < x < math.inf:
        return -math.inf if x == 0.0 else x if x > 0.0 else math.nan
    part, power = math.frexp(x)
    if part < _SQRT_HALF:
        part, power = 2.0 * part, power - 1
    f = part - 1.0  # exact
    s = f / (2.0 + f)
    z = s * s
    series = z * (2.0 / 15.0 + z * (2.0 / 17.0 + z * (2.0 / 19.0 + z * (2.0 / 21.0 + z * (2.0 / 23.0)))))
    series = z * (2.0 / 5.0 + z * (2.0 / 7.0 + z * (2.0 / 9.0 + z * (2.0 / 11.0 + z * (2.0 / 13.0 + series)))))
    series = z * (2.0 / 3.0 + series)
    half = 0.5 * f * f
    return power * _LN2_A - ((half - (s * (half + series) + power * _LN2_B)) - f)


@_scalar
def log1p(x: float) -> float:
    """Return log(1 + x), accurate for small x."""
    u = 1.0 + x
    if u == 1.0 or not 0.0 < u < math.inf:
        return x if u == 1.0 else log(u)
    lost = x - (u - 1.0) if abs(x) < 1.0 else 1.0 - (u - x)
    return log(u) + lost / u


@_scalar
def power(x: float, y: float) -> float:
    """Return x to the power of y; for whole y from -64 to 64, by multiplications."""
    is_whole = y % 1.0 == 0.0
    if is_whole and abs(y) <= 64.0:
        remaining, product, factor = int(abs(y)), 1.0, x
        while remaining > 0:
            if remaining & 1:
                product *= factor
            factor *= factor
            remaining >>= 1
        return product if y >= 0.0 else 1.0 / product if product != 0.0 else math.copysign(math.inf, product)
    if x == 0.0:
        return 0.0 if y > 0.0 else math.inf
    if x < 0.0 and not is_whole:
        return math.nan
    size = exp(y * log(abs(x)))
    return -size if x < 0.0 and y % 2.0 != 0.0 else size


@_scalar
def square(x: float) -> float:
    return x * x


@_scalar
def hypot(x: float, y: float, z: float = 0.0) -> float:
    """Return the length of a vector; unlike libm's, inf beyond 1e154."""
    return math.sqrt(x * x + y * y + z * z)


def length(components: Iterable[float]) -> float:
    """Return the length of a vector of any size, summed from the first component to the last."""
    total = 0.0
    for component in components:
        total += component * component
    return math.sqrt(total)


def distance(a: Iterable[float], b: Iterable[float]) -> float:
    """Return the distance between two points."""
    return length(p - q for p, q in zip(a, b, strict=True))


def elementwise(function: Callable[..., float]) -> Callable[..., NDArray[np.float64]]:
    """Return a function of numbers as a function of arrays, which are broadcast against each other."""

    def of_arrays(*arrays: ArrayLike) -> NDArray[np.float64]:
        vectorized = np.frompyfunc(function, len(arrays), 1)
        return np.asarray(vectorized(*(np.asarray(a, dtype=float) for a in arrays)), dtype=float)

    return of_arrays
