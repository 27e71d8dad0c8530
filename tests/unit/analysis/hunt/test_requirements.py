"""The requirements on a flight and their margins."""

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from refused import has_terms

from zsim.errors import ScenarioError
from zsim_analysis.hunt.requirements import BROKEN, LENGTH_MAX, Requirement, quantities_of

FIGURES: dict[str, Any] = {
    "min_separation_m": 2.0,
    "collisions": 0,
    "crashed": False,
    "ended": "over",
    "errors.p.true_rms": 0.4,
    "errors.q.true_rms": None,
}


@pytest.mark.parametrize(
    ("text", "holds", "value", "share"),
    [
        ("min_separation_m > 1.5", True, 0.5, 0.25),
        ("min_separation_m>=2", True, 0.0, 0.0),
        ("min_separation_m > 2", False, 0.0, 0.0),
        ("errors.p.true_rms < .3", False, -0.1, -0.25),
        ("0 <= collisions <= 0 and not crashed", True, 0.0, 0.0),
        ("crashed or min_separation_m > 1", True, 1.0, 0.5),
        ("crashed and min_separation_m > 1", False, -1.0, -1.0),
        ("not (min_separation_m > 1)", False, -1.0, -0.5),
        ("ended == 'over'", True, 1.0, 1.0),
        ("ended != 'over'", False, -1.0, -1.0),
        ("max(errors.p.true_rms, -1) + 2 * 3 <= abs(-7)", True, 0.6, 0.6 / 7),
        ("min_separation_m / collisions > 1", False, None, BROKEN),
        ("errors.q.true_rms < 1", False, None, BROKEN),
        ("not (errors.q.true_rms < 1)", False, None, BROKEN),
    ],
)
def test_the_margin_of_a_requirement_is_computed(text: str, holds: bool, value: float | None, share: float) -> None:
    margin = Requirement(text).margin(FIGURES)
    assert margin.holds is holds
    assert margin.value == (None if value is None else pytest.approx(value))
    assert margin.share == pytest.approx(share)


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.sampled_from(["<", "<=", ">", ">=", "==", "!="]))
def test_a_comparison_agrees_with_python_and_the_sign_of_its_margin(a: float, b: float, op: str) -> None:
    margin = Requirement(f"a {op} b").margin({"a": a, "b": b})
    assert margin.holds is eval(f"{a} {op} {b}")
    assert margin.value is not None
    assert margin.value >= 0 if margin.holds else margin.value <= 0
    assert math.copysign(1, margin.share) == math.copysign(1, margin.value)
    assert -2 <= margin.share <= 2


@pytest.mark.parametrize(
    ("text", "terms"),
    [
        ("min_seperation_m > 1", ("min_seperation_m", "min_separation_m?")),
        ("errors.p > 1", ("errors.p", "errors.p.true_rms")),
        ("min_separation_m", ("min_separation_m", "2.0")),
        ("ended > 1", ("'over'", ">", "1")),
        ("ended + 1 > 1", ("'over'",)),
        ("min_separation_m > > 1", ("20",)),
        ("__import__('os').system('true') == 0", ("must",)),
        ("[x for x in 'a'] == 1", ("must",)),
        ("collisions.__class__ == 1", ("collisions.__class__",)),
        ("min() > 1", ("'min()'",)),
        ("abs(*collisions) > 1", ("must",)),
        ("collisions ** 9 > 1", ("must",)),
        ("1 + 1", ("must",)),
        ("a > " + "1" * LENGTH_MAX, (str(LENGTH_MAX),)),
        ("(" * 500, ("must",)),
    ],
)
def test_an_invalid_requirement_is_refused_with_the_reason(text: str, terms: tuple[str, ...]) -> None:
    with pytest.raises(ScenarioError) as error:
        Requirement(text).margin(FIGURES)
    assert has_terms(error.value.faults[0], "--require", *terms)


def test_all_unknown_names_are_reported_at_once() -> None:
    lines = Requirement("colisions == 0 and crashd").faults(FIGURES)
    assert has_terms(lines[0], "collisions?")
    assert has_terms(lines[1], "crashed?")


def test_figures_of_a_summary_are_its_scalar_values_by_path() -> None:
    summary = {"a": {"b": 1.5, "c": None}, "d": "text", "e": [1, 2], "f": True}
    assert dict(quantities_of(summary)) == {"a.b": 1.5, "a.c": None, "d": "text", "f": True}
