"""When gates are held back, so that several come at once, and when they are not."""

from typing import Any

import pytest

from zsim_world.server.pipelining import GATES_SENT, HOLD_NS, LAG_GATES, Burst

GATE_NS = 20_000_000


class Lagging:
    """A world of one agent that is through with `done` gates; the delay is five gates."""

    def __init__(self, delay: int = 5, mode: str = "lockstep", rate: float = 0.0) -> None:
        self.gate_ns, self.delay_ns = GATE_NS, delay * GATE_NS
        self.mode, self.rate = mode, rate
        self.now, self.done = 0, 0

    def owing(self, ahead_ns: int = 0) -> list[str]:
        needed = self.now - (self.delay_ns - ahead_ns) // GATE_NS
        return ["estimator.d1"] if self.done < needed else []

    def may_advance(self) -> bool:
        return not self.owing()


def burst_of(world: Lagging) -> Burst:
    made: Any = Burst
    return made(world)


def advance(world: Lagging, burst: Burst, wall_ns: int = 0) -> int:
    """Go on as the process does; return how many gates that were."""
    gates = 0
    while world.may_advance() and not burst.holds_back(wall_ns):
        world.now += 1
        gates += 1
    burst.end(wall_ns)
    return gates


def test_once_it_must_wait_it_goes_on_when_the_agent_has_nearly_caught_up() -> None:
    world = Lagging()
    burst = burst_of(world)
    assert advance(world, burst) == 6  # the first five need nothing
    held = []
    for _ in range(12):
        world.done += 1
        held.append(advance(world, burst))
    size = 5 - LAG_GATES + 1
    assert held[:8] == [0] * (size - 1) + [size] + [0] * (size - 1) + [size]
    assert world.now - world.done <= 5 + 1


def test_whoever_is_slow_gets_all_the_gates_that_it_may_have() -> None:
    world = Lagging()
    burst = burst_of(world)
    advance(world, burst)
    world.done += 1
    assert advance(world, burst, wall_ns=HOLD_NS // 2) == 0
    assert burst.owing() == ["estimator.d1"]
    assert advance(world, burst, wall_ns=2 * HOLD_NS) == 1


@pytest.mark.parametrize(
    "world", [Lagging(mode="realtime"), Lagging(rate=1.0), Lagging(delay=1), Lagging(delay=LAG_GATES)]
)
def test_a_paced_world_and_one_without_slack_hold_nothing_back(world: Lagging) -> None:
    burst = burst_of(world)
    advance(world, burst)
    for _ in range(10):
        world.done += 1
        assert advance(world, burst) == 1
        assert not burst.goes_on()


def test_what_is_said_is_sent_every_few_gates_and_when_the_next_may_not_come() -> None:
    world = Lagging(delay=9)
    burst = burst_of(world)
    sent = []
    while world.may_advance():
        world.now += 1
        sent.append(not burst.goes_on())
    assert sent == [(gate + 1) % GATES_SENT == 0 or gate == len(sent) - 1 for gate in range(len(sent))]
