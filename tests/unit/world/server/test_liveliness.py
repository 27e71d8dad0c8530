"""Who has died: a reader that publishes nothing for long, and a process whose token is lost."""

from collections.abc import Callable
from typing import Any

import pytest
from fake_link import FakeLink

from zsim.contract import keys, messages
from zsim.contract.run_messages import Health, Join
from zsim.runtime.health import HealthMeter
from zsim.scenario import scenario_file
from zsim.scenario.rights import WORLD
from zsim.transport.link_watch import ClosedLink
from zsim.transport.session_tokens import SessionTokens
from zsim_world.run.inputs import Run
from zsim_world.run.outbox import STRANGERS_MAX
from zsim_world.run.world import World
from zsim_world.server.liveliness import SILENT_NS, SILENT_S, HealthWatch, LivelinessMonitor, SlowReaders

GATE_NS = 20_000_000
SCENARIO = """
name: one
duration_s: 1
drones: [{name: d1, position_m: [0, 0, 0]}]
processes: {expect: [], on_death: {recorder: end}}
"""


class Case:
    """A world, one participant, and who judges its death."""

    def __init__(self, name: str, period_ns: int = 0) -> None:
        self.name = name
        self.take_in: Callable[[], None] = lambda: None
        self.world = World(scenario_file.from_text(SCENARIO), run_id="run1")
        run, link = Run(self.world, HealthMeter(WORLD)), FakeLink()
        self.liveliness = LivelinessMonitor(link, run, lambda: self.take_in())  # type: ignore[arg-type]
        self.period_ns = period_ns
        self.join(incarnation=1, pid=7)

    def join(self, incarnation: int, pid: int) -> None:
        role = self.name.split(".")[0]
        join = Join(
            0, 0, run_id="run1", incarnation=incarnation, role=role, host="h", pid=pid, period_ns=self.period_ns
        )
        self.liveliness.before_join(self.name, join)
        self.world.handle(keys.process(self.name, "join"), join, 0)

    def events(self) -> list[str]:
        return [
            message.kind
            for key, message in self.world.outbox.pending
            if key == keys.EVENT and message.subject == self.name
        ]

    def seconds(self, count: int) -> None:
        for _ in range(count):
            self.liveliness.count_second()

    def deaths(self) -> list[Any]:
        return [message for key, message in self.world.outbox.pending if key == keys.EVENT and message.kind == "death"]


@pytest.mark.parametrize("name", ["recorder", "console.1"])
def test_a_silent_reader_is_dead(name: str) -> None:
    case = Case(name)
    case.liveliness.health_received(name)
    case.seconds(SILENT_S)
    assert case.deaths() == []
    case.seconds(2)
    assert [event.subject for event in case.deaths()] == [name]
    assert (case.world.ended is not None) == (name == "recorder")


def test_one_that_publishes_is_not() -> None:
    case = Case("recorder")
    for _ in range(3):
        case.liveliness.health_received("recorder")
        case.seconds(SILENT_S)
    assert case.deaths() == []


def test_nor_one_that_never_published_its_health() -> None:
    case = Case("recorder")
    case.seconds(3 * SILENT_S)
    assert case.deaths() == []


def test_nor_one_that_gates_since_time_stands_for_it() -> None:
    case = Case("estimator.d1", GATE_NS)
    case.liveliness.health_received("estimator.d1")
    case.seconds(3 * SILENT_S)
    assert case.deaths() == []


def test_nor_a_stranger() -> None:
    case = Case("recorder")
    case.liveliness.health_received("somebody")
    case.seconds(3 * SILENT_S)
    assert case.deaths() == []


@pytest.mark.parametrize(("pid", "kinds"), [(8, ["death", "restart"]), (7, ["superseded"])])
def test_who_joins_in_place_of_one_whose_token_went_had_no_need_to_wait_for_its_death(
    pid: int, kinds: list[str]
) -> None:
    case = Case("estimator.d1", GATE_NS)
    case.liveliness.token_lost(case.name)
    case.join(incarnation=2, pid=pid)
    assert case.events()[1:] == kinds


def test_a_join_that_arrives_while_a_token_is_checked_settles_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zsim_world.server.liveliness.BYE_NS", 0)
    case = Case("estimator.d1", GATE_NS)
    case.take_in = lambda: case.join(incarnation=2, pid=8)
    case.liveliness.token_lost(case.name)
    case.liveliness.check_due()
    assert case.events()[1:] == ["death", "restart"]


def test_who_joins_in_place_of_one_that_lives_takes_over() -> None:
    case = Case("estimator.d1", GATE_NS)
    case.join(incarnation=2, pid=8)
    assert case.events()[1:] == ["superseded"]


S = 1_000_000_000
LOOK_NS = S // 10
ME = "estimator.d1"


class Watched:
    """A watch, and what it reports."""

    def __init__(self) -> None:
        self.reports: list[tuple[str, int | None]] = []
        self.watch = HealthWatch(lambda name, since_ns: self.reports.append((name, since_ns)))

    def looks(self, from_ns: int, to_ns: int) -> None:
        for wall_ns in range(from_ns, to_ns + 1, LOOK_NS):
            self.watch.look(wall_ns)


def test_a_stopped_process_is_reported_once_within_two_seconds_and_when_it_is_back():
    case = Watched()
    case.watch.look(10 * S)
    case.watch.received(ME, 10 * S)
    case.looks(10 * S, 10 * S + SILENT_NS - LOOK_NS)
    assert case.reports == []
    case.looks(10 * S + SILENT_NS, 15 * S)
    assert case.reports == [(ME, 10 * S)]
    assert SILENT_NS + LOOK_NS < 2 * S
    case.watch.received(ME, 15 * S)
    assert case.reports[1:] == [(ME, None)]


def test_what_the_world_did_not_read_while_it_was_held_up_is_nobody_s_silence():
    case = Watched()
    case.watch.look(10 * S)
    case.watch.received(ME, 10 * S)
    case.watch.look(15 * S)
    assert case.reports == []


def test_nothing_is_expected_of_one_that_has_left():
    case = Watched()
    case.watch.look(10 * S)
    case.watch.received(ME, 10 * S)
    case.watch.forget(ME)
    case.looks(10 * S, 15 * S)
    assert case.reports == []


ONE = "{name: one, duration_s: 1, drones: [{name: d1, position_m: [0, 0, 0]}]}"
CONSOLE = ClosedLink("192.0.2.7:4000", "", ("console.1",), 400_000, 1)
STRANGER = ClosedLink("127.0.0.1:4000", "pid 7 (python reader.py)", (), 70_000, 2)


@pytest.fixture
def readers() -> SlowReaders:
    """Those of a run in which console.1 has published its health."""
    link = FakeLink()
    health = Health(0, 0, "console", "desk", 9, {}, 0, 0, 0, 0, reads=("view/**", "world/event"))
    run = Run(World(scenario_file.from_text(ONE), run_id="run1"), HealthMeter(WORLD))
    run.history.add(keys.process("console.1", "health"), messages.encode(health), 0)
    return SlowReaders(link, SessionTokens(link), run)  # type: ignore[arg-type]


def reported(readers: SlowReaders, closed: ClosedLink) -> dict[str, object]:
    """Return the data of the event of a closed link."""
    readers.watch.closed.append(closed)
    readers.report()
    events = [message for key, message in readers._run.world.take_outbox() if key == keys.EVENT]
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
    events = [message for key, message in readers._run.world.take_outbox() if key == keys.EVENT]
    assert [event.kind for event in events] == ["slow_reader"] * STRANGERS_MAX
