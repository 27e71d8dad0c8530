"""Random streams and draws by name, and the normal and chi-square distributions, bit-identical on every machine.

Adding a drone or sensor does not change the draws of the others. scipy is not used, since its results differ between
machines in their last bits (see `zsim.math.elementary`).
"""

import hashlib
import math
from collections.abc import Callable

import numpy as np

from zsim.math import elementary as el
from zsim.math.compiled import deferred


def stream(seed: int, name: str) -> np.random.Generator:
    """Return the generator with SeedSequence(seed, spawn_key = first 16 bytes of SHA-256(name)).

    Unlike `hash()`, this key is the same in all processes and versions.
    """
    digest = hashlib.sha256(name.encode()).digest()[:16]
    key = tuple(int.from_bytes(digest[i : i + 4], "little") for i in range(0, 16, 4))
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


def uniform(*what: object) -> float:
    """Return a random number in [0, 1) that depends only on the arguments.

    It is the first 53 bits of the BLAKE2b hash of their texts: uniform to the resolution of a double, and the same on
    every machine.
    """
    digest = hashlib.blake2b("|".join(map(str, what)).encode(), digest_size=8).digest()
    return (int.from_bytes(digest, "big") >> 11) * 2.0**-53


_ROOT_2_PI = math.sqrt(2.0 * math.pi)
_SIGMAS_MAX = 38.0  # standard deviations; beyond this, the density is below the smallest normal double


@deferred(makes_arrays=False)
def normal_probability(x: float) -> float:
    """Return the probability that a standard normal variable is below x, within 1e-15.

    It is 1/2 + density times (x + x^3/3 + x^5/(3 5) + ...), a series whose terms all have the same sign (G. Marsaglia,
    Evaluating the normal distribution, J. Statistical Software 11 (2004) 4).
    """
    if not abs(x) < _SIGMAS_MAX:
        return math.nan if math.isnan(x) else 1.0 if x > 0.0 else 0.0
    term, total, odd = x, x, 1.0
    while abs(term) > 1e-17 * abs(total):
        odd += 2.0
        term *= x * x / odd
        total += term
    return min(max(0.5 + total * el.exp(-0.5 * x * x) / _ROOT_2_PI, 0.0), 1.0)


def normal_quantile(probability: float) -> float:
    """Return the value below which a standard normal variable lies with the given probability, in [0, 1]."""
    if not 0.0 < probability < 1.0:
        return -math.inf if probability == 0.0 else math.inf if probability == 1.0 else math.nan
    return _bisected(normal_probability, probability, -_SIGMAS_MAX, _SIGMAS_MAX)


def chi_square_probability(x: float, dof: int) -> float:
    """Return the probability that a chi-square variable with `dof` degrees of freedom is below x >= 0.

    By the series of the incomplete gamma function, whose terms all have the same sign (Abramowitz and Stegun, 6.5.29).
    """
    a, half = 0.5 * dof, 0.5 * x
    gamma = 1.0 if dof % 2 == 0 else math.sqrt(math.pi)  # gamma(1) or gamma(1/2), raised below to gamma(a + 1)
    at = 1.0 if dof % 2 == 0 else 0.5
    while at <= a:
        gamma *= at
        at += 1.0
    term = total = 1.0
    n = 0
    while term > 1e-17 * total:
        n += 1
        term *= half / (a + n)
        total += term
    power = el.power(half, float(dof // 2)) * (math.sqrt(half) if dof % 2 else 1.0)
    return min(power * el.exp(-half) / gamma * total, 1.0)


def chi_square_quantile(probability: float, dof: int) -> float:
    """Return the value below which a chi-square variable lies with the given probability, in [0, 1)."""
    return _bisected(lambda x: chi_square_probability(x, dof), probability, 0.0, 700.0)


def _bisected(function: Callable[[float], float], value: float, low: float, high: float) -> float:
    """Return the argument at which an increasing function reaches a value, by bisection to the last bit."""
    while True:
        middle = 0.5 * (low + high)
        if not low < middle < high:
            return middle
        if function(middle) < value:
            low = middle
        else:
            high = middle
