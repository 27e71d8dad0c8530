"""Refusals: their line, and which of them are events."""

from refused import has_terms

from zsim_world.run.outbox import EVENTS_MAX, REASONS_MAX, RefusalLog

MODE = "drone/d1/cmd/mode"


def test_the_first_of_each_are_events_and_all_are_counted():
    refusals = RefusalLog()
    texts = [refusals.add("a.one", MODE, "too late") for _ in range(EVENTS_MAX + 5)]
    assert texts[0] == f"{MODE}: too late"
    last = texts[EVENTS_MAX - 1] or ""
    assert last.startswith(f"{MODE}: too late")
    assert has_terms(last, "counted")
    assert texts[EVENTS_MAX:] == [None] * 5
    assert refusals.add("b.two", MODE, "too late") == texts[0]
    assert refusals.count == EVENTS_MAX + 6


def test_a_new_reason_is_an_event_after_many_of_another():
    refusals = RefusalLog()
    ages = [refusals.add("a.one", MODE, f"age is {500.5 + age} ms; must be <= 500 ms") for age in range(2 * EVENTS_MAX)]
    assert len([text for text in ages if text]) == EVENTS_MAX
    assert refusals.add("a.one", MODE, "landed") == f"{MODE}: landed"


def test_ever_new_reasons_do_not_make_events_for_ever():
    refusals = RefusalLog()
    texts = [refusals.add("a.one", MODE, "x" * length) for length in range(1, 1 + 100 * EVENTS_MAX)]
    assert len([text for text in texts if text]) == REASONS_MAX + EVENTS_MAX
    assert refusals.count == 100 * EVENTS_MAX
