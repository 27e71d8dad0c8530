"""Readers that take nothing: the event names host, process and keys, as far as they are known."""

import pytest
from fake_link import FakeLink

from zsim.contract import keys, messages
from zsim.contract.run_messages import Health
from zsim.scenario import scenario_file
from zsim.transport.link_watch import ClosedLink, SessionTokens
from zsim_world.flight.budgets import STRANGERS_MAX
from zsim_world.flight.world import World
from zsim_world.journal.run_journal import RunJournal
from zsim_world.server.message_history import MessageHistory
from zsim_world.server.slow_readers import SlowReaders

SCENARIO = "{name: one, duration_s: 1, drones: [{name: d1, position_m: [0, 0, 0]}]}"
CONSOLE = ClosedLink("192.0.2.7:4000", "", ("console.1",), 400_000, 1)
STRANGER = ClosedLink("127.0.0.1:4000", "pid 7 (python reader.py)", (), 70_000, 2)


@pytest.fixture
def readers() -> SlowReaders:
    """Those of a run in which console.1 has published its health."""
    link, history = FakeLink(), MessageHistory()
    health = Health(0, 0, "console", "desk", 9, {}, 0, 0, 0, 0, reads=("view/**", "world/event"))
    history.add(keys.process("console.1", "health"), messages.encode(health), 0)
    world = World(scenario_file.from_text(SCENARIO), run_id="run1")
    return SlowReaders(link, SessionTokens(link), world, history, RunJournal(None))  # type: ignore[arg-type]


def reported(readers: SlowReaders, closed: ClosedLink) -> dict[str, object]:
    """Return the data of the event of a closed link."""
    readers.watch.closed.append(closed)
    readers.report()
    events = [message for key, message in readers._world.take_outbox() if key == keys.EVENT]
    (event,) = [event for event in events if event.kind == "slow_reader"]
    assert all(str(name) in event.text for name in (closed.address, *closed.names))
    return event.data


def test_a_process_of_the_run_is_named_with_what_it_reads(readers: SlowReaders) -> None:
    data = reported(readers, CONSOLE)
    assert (data["host"], data["names"], data["reads"]) == ("192.0.2.7", ("console.1",), ["view/**", "world/event"])


def test_a_stranger_on_this_machine_is_named_by_its_command(readers: SlowReaders) -> None:
    data = reported(readers, STRANGER)
    assert (data["host"], data["process"], data["reads"], data["times"]) == ("laptop", STRANGER.process, [], 2)


def test_ever_new_sessions_are_so_many_events_only(readers: SlowReaders) -> None:
    readers.watch.closed.extend(STRANGER._replace(address=f"127.0.0.1:{port}") for port in range(3 * STRANGERS_MAX))
    readers.report()
    events = [message for key, message in readers._world.take_outbox() if key == keys.EVENT]
    assert [event.kind for event in events] == ["slow_reader"] * STRANGERS_MAX
