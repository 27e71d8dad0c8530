"""Which of a participant's kept outputs have not come: those of gates that it is through with, each once."""

import pytest
from msgspec import Struct

from zsim.contract import keys, messages
from zsim.contract.messages import Done, Velocity
from zsim.transport.session import Sample
from zsim_world.server.lost_outputs import unheard
from zsim_world.server.message_history import History

VELOCITY = keys.command("d1", "velocity")


def command(t_ns: int, seq: int, source: str = "a.b", speed: float = 0.0) -> Velocity:
    return Velocity(t_ns, seq, source, (speed, 0.0, 0.0), 0.0)


def kept(*outputs: Struct, key: str = VELOCITY) -> list[list[object]]:
    return [[key, messages.encode(output)] for output in outputs]


def history(*came: Velocity) -> History:
    made = History()
    for each in came:
        made.add(VELOCITY, messages.encode(each), each.t_ns)
    return made


def samples(*outputs: Velocity) -> list[Sample]:
    return [Sample(VELOCITY, messages.encode(output)) for output in outputs]


def test_what_has_not_come_is_found():
    first, second, third = (command(t_ns, t_ns) for t_ns in (1, 2, 3))
    assert unheard(kept(first, second, third), 3, history(second)) == samples(first, third)


def test_what_its_next_done_counts_is_on_its_way():
    assert unheard(kept(command(2, 2), command(3, 3)), 2, history()) == samples(command(2, 2))


def test_what_it_kept_twice_comes_once():
    assert unheard(kept(command(1, 1), command(1, 1)), 1, history()) == samples(command(1, 1))


@pytest.mark.parametrize("other", [command(1, 1, "c.d"), command(1, 2)])
def test_what_another_said_or_it_said_besides_does_not_stand_in_for_it(other: Velocity):
    assert unheard(kept(command(1, 1)), 1, history(other)) == samples(command(1, 1))


def test_only_outputs_that_can_be_read_are_taken():
    done = kept(Done(1, 1, "r", 1, 1, 0), key="process/a.b/done")
    assert unheard([*done, [VELOCITY, b"\xc1"], [keys.estimate("d1"), b"\x80"], ["of/mine", b""]], 1, history()) == []
