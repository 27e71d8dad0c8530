"""A world that goes on from a journal: it publishes what comes next, and nothing that was published before."""

from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest
from fake_link import FakeLink

from zsim.contract import keys, messages
from zsim.contract.flight_messages import Mode
from zsim.contract.run_messages import Event
from zsim.errors import RunError
from zsim.runtime.membership import HealthMeter
from zsim.scenario import scenario_file
from zsim.scenario.roles import WORLD
from zsim_world.run.inputs import Entry, Published, Run
from zsim_world.run.world import World
from zsim_world.server import run_journal
from zsim_world.server.run_journal import RunJournal
from zsim_world.server.world_process import WorldProcess

GATE_NS = 20_000_000
GATES = 600
SCENARIO = f"""
name: one
seed: 3
duration_s: {GATES * GATE_NS / 1e9}
drones: [{{name: d1, position_m: [0, 0, 0]}}]
processes: {{expect: []}}
"""


class AtOnce:
    """An executor, as of `ThreadPoolExecutor`, that does not let a flight overtake the disk."""

    def __init__(self, *_: Any) -> None: ...

    def submit(self, act: Callable[..., None], *arguments: Any) -> Future[None]:
        act(*arguments)
        done: Future[None] = Future()
        done.set_result(None)
        return done

    def shutdown(self, *_: Any, **__: Any) -> None: ...


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let checkpoints come so often that each part of these short flights has some."""
    monkeypatch.setattr(run_journal, "ThreadPoolExecutor", AtOnce)
    monkeypatch.setattr(run_journal, "CHECKPOINT_NS", 1_000_000_000)
    monkeypatch.setattr(run_journal, "CHECKPOINT_WALL_NS", 0)


def fly(folder: Path | None, until: int = GATES + 1, scenario: str = SCENARIO) -> FakeLink:
    """Run a world until a gate is there; d1 is asked to take off before the first."""
    made, link = World(scenario_file.from_text(scenario), run_id="run1"), FakeLink()
    link.deliver(keys.command("d1", "mode"), Mode(0, 0, "somebody", "takeoff"))
    journal = RunJournal(folder, "run1", "a" * 64)
    ended = lambda: "enough" if made.now_ns >= until * GATE_NS else None  # noqa: E731
    WorldProcess(link, made, ended, journal=journal).run()  # type: ignore[arg-type]
    return link


def end(link: FakeLink) -> dict[str, Any]:
    return next(event for event in _events(link) if event.kind == "end").data


def _events(link: FakeLink) -> list[Event]:
    return link.published_on(keys.EVENT)


def _drone(link: FakeLink) -> list[tuple[str, bytes]]:
    return [(key, payload) for key, payload in link.published if key.startswith("drone/") and "/cmd/" not in key]


def test_a_world_goes_on_where_another_one_ended(tmp_path: Path):
    whole = fly(None)
    parts = [fly(tmp_path / "journal", until) for until in (40, 290, 560, GATES + 1)]
    assert [end(part)["last_ns"] // GATE_NS for part in parts] == [40, 290, 560, GATES]
    assert [pair for part in parts for pair in _drone(part)] == _drone(whole)
    assert end(parts[-1])["truth_sha256"] == end(whole)["truth_sha256"]
    assert next(event.seq for event in _events(parts[-1])) > 0
    assert not (tmp_path / "journal").exists()


def test_a_long_flight_goes_on_from_a_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(run_journal, "CHECKPOINT_WALL_NS", 0)
    fly(tmp_path, 560)
    again = RunJournal(tmp_path, "run1", "a" * 64)
    checkpoint = again.open()
    again.close()
    assert checkpoint is not None
    assert checkpoint.state is not None


def test_a_checkpoint_of_another_fleet_is_refused(tmp_path: Path):
    fly(tmp_path, 560)
    with pytest.raises(RunError, match="does not fit"):
        fly(tmp_path, scenario=SCENARIO.replace("[{name: d1", "[{name: d2, position_m: [3, 0, 0]}, {name: d1"))


@pytest.mark.parametrize("is_complete", [True, False])
def test_what_follows_an_end_is_noted_after_the_last_gate_only(is_complete: bool):
    """Continuing a run undoes an end before its last gate; its recorder must not read of that end."""
    noted: list[Entry] = []
    run = Run(World(scenario_file.from_text(SCENARIO), run_id="run1"), HealthMeter(WORLD), noted.append)
    end = run.world.clock.complete if is_complete else run.world.clock.stop
    end("the launcher is gone")
    run.world.publish_end()
    clock = run.world.clock_message(())
    run.enter(Published(keys.CLOCK, clock.seq, messages.encode(clock)))
    assert clock.state == "stopped"
    assert [type(entry) for entry in noted] == [Published] * is_complete
