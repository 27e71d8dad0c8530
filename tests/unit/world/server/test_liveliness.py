"""Which processes have died, have fallen silent, or take nothing: what is reported of them, and when."""

from collections.abc import Callable

import pytest
from fake_link import FakeLink

from zsim.contract import keys, messages
from zsim.contract.run_messages import Health, Join
from zsim.runtime.membership import HealthMeter
from zsim.scenario import scenario_file
from zsim.scenario.roles import WORLD
from zsim.transport.link_watch import ClosedLink, SessionTokens
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
    """A world, one participant, and the monitor of its liveliness."""

    def __init__(self, name: str, period_ns: int = 0) -> None:
        self.name, self.period_ns = name, period_ns
        self.take_in: Callable[[], None] = lambda: None
        self.world = World(scenario_file.from_text(SCENARIO), run_id="run1")
        run, link = Run(self.world, HealthMeter(WORLD)), FakeLink()
        self.liveliness = LivelinessMonitor(link, run, lambda: self.take_in())  # type: ignore[arg-type]
        self.join(incarnation=1, pid=7)

    def join(self, incarnation: int, pid: int) -> None:
        join = Join(0, 0, "run1", incarnation, self.name.split(".")[0], "h", pid, self.period_ns)
        self.liveliness.before_join(self.name, join)
        self.world.handle(keys.process(self.name, "join"), join, 0)

    def events(self) -> list[str]:
        """Return the kinds of events about it."""
        pending = self.world.outbox.pending
        return [message.kind for key, message in pending if key == keys.EVENT and message.subject == self.name]

    def seconds(self, count: int) -> None:
        for _ in range(count):
            self.liveliness.count_second()


@pytest.mark.parametrize(
    ("name", "period_ns", "publisher", "dies"),
    [
        ("recorder", 0, "recorder", True),
        ("console.1", 0, "console.1", True),
        ("recorder", 0, None, False),  # it never published its health
        ("estimator.d1", GATE_NS, "estimator.d1", False),  # time stands for it
        ("recorder", 0, "somebody", False),
    ],
)
def test_a_reader_that_falls_silent_is_dead(name: str, period_ns: int, publisher: str | None, dies: bool) -> None:
    case = Case(name, period_ns)
    if publisher:
        case.liveliness.health_received(publisher)
    case.seconds(SILENT_S)
    assert "death" not in case.events()
    case.seconds(2)
    assert ("death" in case.events()) == dies
    assert (case.world.ended is not None) == (dies and name == "recorder")


def test_one_that_publishes_is_not() -> None:
    case = Case("recorder")
    for _ in range(3):
        case.liveliness.health_received("recorder")
        case.seconds(SILENT_S)
    assert "death" not in case.events()


@pytest.mark.parametrize(
    ("is_lost", "pid", "kinds"),
    [(True, 8, ["death", "restart"]), (True, 7, ["superseded"]), (False, 8, ["superseded"])],
)
def test_who_joins_in_place_of_one_whose_token_went_had_no_need_to_wait_for_its_death(
    is_lost: bool, pid: int, kinds: list[str]
) -> None:
    case = Case("estimator.d1", GATE_NS)
    if is_lost:
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
    case.watch.forget(ME)  # nothing is expected of one that has left
    case.looks(15 * S, 20 * S)
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


@pytest.mark.parametrize(
    ("closed", "host", "reads"), [(CONSOLE, "192.0.2.7", ["view/**", "world/event"]), (STRANGER, "laptop", [])]
)
def test_a_reader_is_named_by_what_is_known_of_it(
    readers: SlowReaders, closed: ClosedLink, host: str, reads: list[str]
) -> None:
    data = reported(readers, closed)
    found = (data["host"], data["process"], data["names"], data["reads"], data["times"])
    assert found == (host, closed.process, closed.names, reads, closed.times)


def test_ever_new_sessions_are_so_many_events_only(readers: SlowReaders) -> None:
    readers.watch.closed.extend(STRANGER._replace(address=f"127.0.0.1:{port}") for port in range(3 * STRANGERS_MAX))
    readers.report()
    events = [message for key, message in readers._run.world.take_outbox() if key == keys.EVENT]
    assert [event.kind for event in events] == ["slow_reader"] * STRANGERS_MAX
