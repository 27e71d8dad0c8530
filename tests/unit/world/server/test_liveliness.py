"""Who has died: a reader that publishes nothing for long, and a process whose token is lost."""

from collections.abc import Callable
from typing import Any

import pytest
from fake_link import FakeLink

from zsim.contract import keys
from zsim.contract.run_messages import Join
from zsim.runtime.health import HealthMeter
from zsim.scenario import scenario_file
from zsim.scenario.rights import WORLD
from zsim_world.run.inputs import Run
from zsim_world.run.world import World
from zsim_world.server.liveliness import SILENT_S, LivelinessMonitor

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
