"""A process that a fault kills dies once, however late it steps and in whatever order the lists come."""

import sys
from pathlib import Path

import pytest

from zsim.contract import keys
from zsim.contract.messages import Fault, Faults, encode
from zsim.runtime.runner import Runner

sys.path.insert(0, str(Path(__file__).parent))
from test_runner import END, GATE_NS, ME, Judge, World, estimate, estimates, info

KILL = Fault(1, "process_kill", ME, {}, 2 * GATE_NS, 3 * GATE_NS, "tester.one")


def told(gate: int, seq: int, *faults: Fault) -> Faults:
    return Faults(gate * GATE_NS, seq, faults)


def last_gate(before_gate: int, *lists: Faults) -> int:
    """Return the last gate of a judge to whom some lists are said at once, before a gate."""

    def tell(world: World) -> None:
        for each in lists:
            world.deliver(keys.FAULTS, each)
        world.deliver(keys.estimate("d1"), estimate(before_gate))

    world = World({**estimates(range(END + 1)), before_gate: tell})
    runner = Runner(world, info(), Judge())  # type: ignore[arg-type]
    runner.run()
    said_bye = len(world.all(keys.process(ME, "bye")))
    assert said_bye == (0 if runner.killed else 1)
    return world.gates_done()[-1]


def test_a_kill_is_at_the_first_gate_in_which_it_acts():
    assert last_gate(1, told(0, 0, KILL)) == 3


@pytest.mark.parametrize("lists", [(told(2, 0, KILL), told(4, 1)), (told(4, 1), told(2, 0, KILL))], ids=["late", "old"])
def test_what_was_forgotten_before_a_late_process_heard_of_it(lists: tuple[Faults, Faults]):
    """Both lists are heard at once: one that names the kill, and the newer one, said when it was over."""
    died = lists[0].faults != ()
    assert last_gate(2, *lists) == (3 if died else END)


def test_a_kill_that_is_heard_of_too_late_still_kills():
    assert last_gate(5, told(2, 0, KILL)) == 5


def test_a_kill_that_is_cleared_kills_nobody():
    assert last_gate(1, told(0, 0, KILL), told(1, 1)) == END


def test_an_older_list_does_not_take_a_kill_away():
    assert last_gate(1, told(1, 1, KILL), told(0, 0)) == 3


class Second(Judge):
    """A judge that takes over the estimate that the world has for it."""

    def warm_start_keys(self) -> tuple[str, ...]:
        return (keys.estimate("d1"),)


@pytest.mark.parametrize(("former_gate", "killed"), [(2, True), (3, False), (4, False)])
def test_who_is_started_again_after_its_kill_lives(former_gate: int, killed: bool):
    """The former process of its name got as far as a gate; the kill is of gate 3."""
    world = World(estimates(range(END + 1)))
    world.last[keys.estimate("d1")] = encode(estimate(former_gate))
    world.last[keys.FAULTS] = encode(told(0, 0, KILL))
    runner = Runner(world, info(), Second())  # type: ignore[arg-type]
    runner.run()
    assert runner.killed == killed
    assert world.gates_done()[-1] == (3 if killed else END)
