"""When gates are delayed, so that several come at once, and when they are not."""

from collections.abc import Iterable
from typing import Any

import pytest

from zsim_world.server.world_process import DELAY_MAX_NS, GATES_SENT, LAG_GATES, Pipelining, TurnWatch

GATE_NS = 20_000_000


class Lagging:
    """A world of one agent that is through with `done` gates; the delay is five gates."""

    def __init__(self, delay: int = 5, mode: str = "lockstep", rate: float = 0.0) -> None:
        self.gate_ns, self.ahead_ns = GATE_NS, delay * GATE_NS
        self.mode, self.rate = mode, rate
        self.clock = self
        self.now, self.done = 0, 0

    def blocking(self, ahead_ns: int = 0) -> list[str]:
        needed = self.now - (self.ahead_ns - ahead_ns) // GATE_NS
        return ["estimator.d1"] if self.done < needed else []

    def may_advance(self) -> bool:
        return not self.blocking()


def pipelining_of(world: Lagging) -> Pipelining:
    made: Any = Pipelining
    return made(world)


def advance(world: Lagging, pipelining: Pipelining, wall_ns: int = 0) -> int:
    """Go on as the process does; return how many gates that were."""
    gates = 0
    while world.may_advance() and not pipelining.delays(wall_ns):
        world.now += 1
        gates += 1
    pipelining.pause(wall_ns)
    return gates


def test_once_it_must_wait_it_goes_on_when_the_agent_has_nearly_caught_up() -> None:
    world = Lagging()
    pipelining = pipelining_of(world)
    assert advance(world, pipelining) == 6  # the first five need nothing
    gates = []
    for _ in range(12):
        world.done += 1
        gates.append(advance(world, pipelining))
    size = 5 - LAG_GATES + 1
    assert gates[:8] == [0] * (size - 1) + [size] + [0] * (size - 1) + [size]
    assert world.now - world.done <= 5 + 1


def test_whoever_is_slow_gets_all_the_gates_that_it_may_have() -> None:
    world = Lagging()
    pipelining = pipelining_of(world)
    advance(world, pipelining)
    world.done += 1
    assert advance(world, pipelining, wall_ns=DELAY_MAX_NS // 2) == 0
    assert pipelining.blocking() == ["estimator.d1"]
    assert advance(world, pipelining, wall_ns=2 * DELAY_MAX_NS) == 1


@pytest.mark.parametrize(
    "world", [Lagging(mode="realtime"), Lagging(rate=1.0), Lagging(delay=1), Lagging(delay=LAG_GATES)]
)
def test_a_paced_world_and_one_without_slack_hold_nothing_back(world: Lagging) -> None:
    pipelining = pipelining_of(world)
    advance(world, pipelining)
    for _ in range(10):
        world.done += 1
        assert advance(world, pipelining) == 1
        assert not pipelining.continues()


def test_messages_are_sent_every_few_gates_and_when_the_next_may_not_come() -> None:
    world = Lagging(delay=9)
    pipelining = pipelining_of(world)
    sent = []
    while world.may_advance():
        world.now += 1
        sent.append(not pipelining.continues())
    assert sent == [(gate + 1) % GATES_SENT == 0 or gate == len(sent) - 1 for gate in range(len(sent))]


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
