"""Which refusals are told."""

from zsim_world.flight.refusal_log import REASONS, TOLD, Refusals

MODE = "drone/d1/cmd/mode"


def test_the_first_of_each_are_told_and_all_are_counted():
    refusals = Refusals()
    told = [refusals.text("a.one", MODE, "too late") for _ in range(TOLD + 5)]
    assert told[0] == f"{MODE}: too late"
    assert told[TOLD - 1] == f"{MODE}: too late (further ones are counted only)"
    assert told[TOLD:] == [None] * 5
    assert refusals.text("b.two", MODE, "too late") == told[0]
    assert refusals.count == TOLD + 6


def test_a_new_reason_is_told_after_many_of_another():
    refusals = Refusals()
    ages = [refusals.text("a.one", MODE, f"age is {500.5 + age} ms; must be <= 500 ms") for age in range(2 * TOLD)]
    assert len([text for text in ages if text]) == TOLD
    assert refusals.text("a.one", MODE, "d1 is landed") == f"{MODE}: d1 is landed"


def test_somebody_who_thinks_up_reasons_is_not_told_for_ever():
    refusals = Refusals()
    told = [refusals.text("a.one", MODE, "x" * length) for length in range(1, 1 + 100 * TOLD)]
    assert len([text for text in told if text]) == REASONS + TOLD
    assert refusals.count == 100 * TOLD
