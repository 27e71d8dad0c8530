"""Elementary functions against mpmath with 40 digits, distributions against scipy, linear algebra against LAPACK."""

import math
from collections.abc import Callable
from typing import Any

import mpmath
import numpy as np
import pytest
import scipy.linalg
import scipy.special

from zsim.math import elementary as el
from zsim.math import linear, randomness

COUNT = 1500
RNG = np.random.default_rng(7)
ULP_MAX = 2.0  # the bound that zsim.math.elementary promises


def even(low: float, high: float) -> list[float]:
    return RNG.uniform(low, high, COUNT).tolist()


def wide(low: float, high: float) -> list[float]:
    """Return numbers of both signs whose exponents of ten are uniformly distributed."""
    return (RNG.choice([-1.0, 1.0], COUNT) * 10.0 ** RNG.uniform(low, high, COUNT)).tolist()


def positive(numbers: list[float]) -> list[float]:
    return [abs(number) for number in numbers]


def ulps(found: float, true: Any) -> float:
    return float(abs(mpmath.mpf(found) - true) / mpmath.mpf(math.ulp(float(true))))


ANGLES = [*even(-10, 10), *wide(-12, 5.9), *(k * math.pi / 4 for k in range(-40, 41))]


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("sin", ANGLES),
        ("cos", ANGLES),
        ("tan", ANGLES),
        ("asin", [*even(-1, 1), *wide(-12, 0), 1.0, -1.0]),
        ("acos", [*even(-1, 1), 1.0 - 1e-15, -1.0]),
        ("atan", [*even(-3, 3), *wide(-12, 12)]),
        ("exp", [*even(-3, 3), *even(-700, 700), *wide(-12, 0)]),
        ("log", [*positive(wide(-300, 300)), *even(0.5, 2), *even(0.99, 1.01)]),
        ("log1p", [*even(-0.999, 1), *positive(wide(-17, 5)), *wide(-17, -1)]),
    ],
)
def test_functions_are_within_two_units_in_the_last_place(name: str, arguments: list[float]) -> None:
    own, exact = getattr(el, name), getattr(mpmath, name)
    with mpmath.workdps(40):
        worst = max((ulps(own(x), exact(mpmath.mpf(x))), x) for x in arguments if exact(mpmath.mpf(x)) != 0)
    assert worst[0] < ULP_MAX, worst


def test_atan2_is_within_two_units_in_the_last_place_in_every_quadrant() -> None:
    pairs = [*zip(even(-3, 3), even(-3, 3), strict=True), *zip(wide(-9, 9), wide(-9, 9), strict=True)]
    with mpmath.workdps(40):
        worst = max((ulps(el.atan2(y, x), mpmath.atan2(mpmath.mpf(y), mpmath.mpf(x))), y, x) for y, x in pairs)
    assert worst[0] < ULP_MAX, worst


def test_powers_are_within_their_bound() -> None:
    pairs = zip(even(0.1, 5), even(-8, 8), strict=True)
    with mpmath.workdps(40):
        for x, y in pairs:
            bound = 2.0 + 2.0 * abs(y * math.log(x))
            assert ulps(el.power(x, y), mpmath.mpf(x) ** mpmath.mpf(y)) < bound


@pytest.mark.parametrize("name", ["sin", "cos", "tan", "asin", "acos", "atan", "exp", "log", "log1p"])
@pytest.mark.parametrize("x", [0.0, -0.0, 1.0, -1.0, 2.0, math.inf, -math.inf, math.nan, 5e-324, 1e300, -1e300])
def test_functions_match_numpy_at_special_values(name: str, x: float) -> None:
    """The sign of zero is the same, too."""
    with np.errstate(all="ignore"):
        wanted = float(getattr(np, {"asin": "arcsin", "acos": "arccos", "atan": "arctan"}.get(name, name))(x))
    found = getattr(el, name)(x)
    if abs(x) == 1e300 and name in ("sin", "cos", "tan"):  # neighbouring doubles are many periods apart
        assert math.isfinite(found)
    else:
        assert (math.isnan(found) and math.isnan(wanted)) or found == pytest.approx(wanted, rel=4e-16, abs=0.0)
        assert math.copysign(1.0, found) == math.copysign(1.0, wanted) or math.isnan(wanted)


@pytest.mark.parametrize("y", [0.0, -0.0, 1.0, -1.0, math.inf, -math.inf, math.nan])
@pytest.mark.parametrize("x", [0.0, -0.0, 1.0, -1.0, math.inf, -math.inf, math.nan])
def test_atan2_matches_the_c_library_at_special_values(y: float, x: float) -> None:
    found, wanted = el.atan2(y, x), math.atan2(y, x)
    assert found == pytest.approx(wanted, rel=4e-16, nan_ok=True)
    assert math.copysign(1.0, found) == math.copysign(1.0, wanted) or math.isnan(wanted)


@pytest.mark.parametrize("name", ["sin_cos", "atan2", "exp", "log", "log1p", "power"])
def test_plain_python_gives_the_same_bits_as_compiled_code(name: str) -> None:
    """Without numba, the functions run as plain Python."""
    own = getattr(el, name)
    arguments = list(zip(positive(even(-4, 4)), even(-4, 4), strict=True))[:300]
    source: Callable[..., Any] = getattr(own, "py_func", own)
    for x, y in arguments:
        given = (x, y) if name in ("atan2", "power") else (x,)
        assert own(*given) == source(*given)


@pytest.mark.parametrize("x", [709.0, 709.7, 709.78, 709.782712893384, 709.79, 1000.0, 1099.9])
def test_exp_overflows_to_inf_in_plain_python_too(x: float) -> None:
    with np.errstate(over="ignore"):
        wanted = float(np.exp(x))
    source: Callable[..., Any] = getattr(el.exp, "py_func", el.exp)
    assert el.exp(x) == source(x) == pytest.approx(wanted, rel=4e-16)


def test_distributions_match_scipy() -> None:
    x = np.linspace(-9, 9, 1001)
    found = [randomness.normal_probability(each) for each in x.tolist()]
    np.testing.assert_allclose(found, scipy.special.ndtr(x), atol=1e-15)
    p = [1e-6, 1e-3, 0.02, 0.3, 0.5, 0.9, 0.999, 1.0 - 1e-9]
    np.testing.assert_allclose([randomness.normal_quantile(each) for each in p], scipy.special.ndtri(p), atol=1e-7)
    for dof in (1, 2, 3, 6, 11, 24):
        wanted = scipy.special.chdtri(dof, 1.0 - np.array(p))
        np.testing.assert_allclose([randomness.chi_square_quantile(each, dof) for each in p], wanted, rtol=1e-7)
    ends = [randomness.normal_quantile(each) for each in (0.0, 1.0)]
    assert ends == [-math.inf, math.inf]


@pytest.mark.parametrize("n", [1, 2, 4, 7, 12, 20])
def test_linear_algebra_matches_lapack(n: int) -> None:
    rng = np.random.default_rng(n)
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, 3))

    def same(found: Any, wanted: Any, tolerance: float = 1e-9) -> None:
        np.testing.assert_allclose(found, wanted, rtol=tolerance, atol=0.01 * tolerance)

    same(linear.product(A, B), A @ B)
    same(linear.product(A.T, B[:, 0]), A.T @ B[:, 0])
    same(linear.solve(A, B), np.linalg.solve(A, B))
    values, vectors = linear.eigen(A + A.T)
    same(values, np.linalg.eigvalsh(A + A.T))
    same(vectors * values @ vectors.T, A + A.T)
    same(linear.singular_values(A), np.linalg.svd(A, compute_uv=False))
    wide_ = np.vstack([B.T, rng.normal(size=(1, n))])[: max(1, min(3, n))]
    same(linear.pseudo_inverse(wide_), np.linalg.pinv(wide_))
    np.testing.assert_allclose(linear.exponential(A), scipy.linalg.expm(A), rtol=1e-9, atol=1e-9)


def test_banded_systems_have_the_solutions_of_full_ones() -> None:
    rng = np.random.default_rng(3)
    n, below, above = 40, 5, 2
    A = np.triu(np.tril(rng.normal(size=(n, n)), above), -below)
    diagonals = np.zeros((n, below + 1 + above))
    for i, j in zip(*np.nonzero(A), strict=True):
        diagonals[i, j - i + below] = A[i, j]
    B = rng.normal(size=(n, 3))
    np.testing.assert_allclose(linear.solve_banded(diagonals, below, B), np.linalg.solve(A, B), rtol=1e-8, atol=1e-9)


def test_singular_matrices_have_a_zero_singular_value_and_no_solution() -> None:
    A = np.array([[1.0, 2.0, 3.0], [2.0, 4.0, 6.0], [0.0, 1.0, 1.0]])
    assert linear.singular_values(A)[-1] == pytest.approx(0.0, abs=1e-15)
    assert not np.isfinite(linear.solve(A, np.ones(3))).all()
    values, vectors = linear.eigen(np.zeros((3, 3)))
    assert values.tolist() == [0.0, 0.0, 0.0]
    assert vectors.tolist() == np.eye(3).tolist()
