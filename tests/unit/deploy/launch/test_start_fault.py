"""A run in one process whose state is no longer finite: the record is whole, the run has failed."""

import io
from pathlib import Path

import pytest
from refused import has_terms
from rich.console import Console

from zsim.contract import keys, messages
from zsim.record import RecordReader
from zsim.runtime.progress import Screen
from zsim.scenario import scenario_file
from zsim_deploy.launch import run
from zsim_world.fleet.fleet import DivergedError, Fleet

GATE_NS = 20_000_000
SCENARIO = """
name: one
seed: 3
duration_s: 1
drones: [{name: d1, position_m: [0, 0, 0]}]
processes: {expect: []}
"""


class NoStopChannel:
    """Leaves the signals to pytest."""

    def reason(self) -> None:
        return

    def stopped(self) -> bool:
        return False

    def restore_signals(self) -> None: ...


def test_a_diverged_run_in_one_process_has_failed_and_has_its_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    advance = Fleet.advance

    def diverge(fleet: Fleet) -> None:
        if fleet.t_ns == 5 * GATE_NS:
            raise DivergedError("d1", 0.12)
        advance(fleet)

    monkeypatch.setattr(Fleet, "advance", diverge)
    monkeypatch.setattr(run, "StopChannel", NoStopChannel)
    options = run.RunOptions(scenario_file.from_text(SCENARIO), tmp_path)
    outcome = run.run_in_process(options, Screen(1.0, Console(file=io.StringIO())))
    assert outcome.failed
    assert has_terms(outcome.reason, "d1", "0.120", "finite")
    with RecordReader(tmp_path / "run.mcap") as reader:
        recorded = [(m.key, messages.decode(m.key, m.payload)) for m in reader.messages()]
    assert [event.kind for key, event in recorded if key == keys.EVENT] == ["diverged", "end"]
    clocks = [clock for key, clock in recorded if key == keys.CLOCK]
    assert (clocks[-1].state, clocks[-1].t_ns) == ("stopped", 5 * GATE_NS)
