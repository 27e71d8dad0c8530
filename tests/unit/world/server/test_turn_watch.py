"""Turns of the world's loop that do not end, and a process that was stopped as a whole."""

from collections.abc import Iterable

from zsim_world.server.world_process import TurnWatch

TICK_MS = 100


def looks(watch: TurnWatch, at_ms: Iterable[int], turn_ms: int) -> list[tuple[int, float]]:
    """Return when something was named, and for how long it had lasted."""
    found = [(ms, watch.stuck_s(ms * 1_000_000, turn_ms * 1_000_000)) for ms in at_ms]
    return [(ms, stuck_s) for ms, stuck_s in found if stuck_s is not None]


def test_a_turn_that_does_not_end_is_named_every_two_seconds() -> None:
    named = looks(TurnWatch(0), range(TICK_MS, 5_000, TICK_MS), turn_ms=100)
    assert named == [(2_200, 2.1), (4_300, 4.2)]


def test_no_turn_is_not_stuck() -> None:
    assert looks(TurnWatch(0), range(TICK_MS, 5_000, TICK_MS), turn_ms=0) == []


def test_a_process_that_stood_was_not_stuck() -> None:
    watch = TurnWatch(0)
    assert looks(watch, [100, 12_100, 12_200], turn_ms=50) == []
    assert looks(watch, range(12_300, 14_300, TICK_MS), turn_ms=50) == [(14_200, 2.1)]
