"""Which refusals are told."""

from zsim_world.refusals import TOLD, Refusals


def test_the_first_of_each_are_told_and_all_are_counted():
    refusals = Refusals()
    told = [refusals.text("a.one", "drone/d1/cmd/mode", "too late") for _ in range(TOLD + 5)]
    assert told[0] == "drone/d1/cmd/mode: too late"
    assert told[TOLD - 1] == "drone/d1/cmd/mode: too late (further ones are counted only)"
    assert told[TOLD:] == [None] * 5
    assert refusals.text("b.two", "drone/d1/cmd/mode", "too late") == told[0]
    assert refusals.count == TOLD + 6
