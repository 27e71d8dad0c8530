"""A run in one process whose state is no longer finite: the record is whole, the run has failed."""

import io
from pathlib import Path

import pytest
from refused import has_terms
from rich.console import Console
from short_flight import DIVERGED_NS, ONE, diverge

from zsim.contract import keys, messages
from zsim.record import RecordReader
from zsim.runtime.progress import Screen
from zsim.scenario import scenario_file
from zsim_deploy.launch import run


class NoStopChannel:
    """Leaves the signals to pytest."""

    def reason(self) -> None:
        return

    def stopped(self) -> bool:
        return False

    def restore_signals(self) -> None: ...


def test_a_diverged_run_in_one_process_has_failed_and_has_its_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    diverge(monkeypatch)
    monkeypatch.setattr(run, "StopChannel", NoStopChannel)
    options = run.RunOptions(scenario_file.from_text(ONE), tmp_path)
    outcome = run.run_in_process(options, Screen(1.0, Console(file=io.StringIO())))
    assert outcome.failed
    assert has_terms(outcome.reason, "d1", "0.120", "finite")
    with RecordReader(tmp_path / "run.mcap") as reader:
        recorded = [(m.key, messages.decode(m.key, m.payload)) for m in reader.messages()]
    assert [event.kind for key, event in recorded if key == keys.EVENT] == ["diverged", "end"]
    clocks = [clock for key, clock in recorded if key == keys.CLOCK]
    assert (clocks[-1].state, clocks[-1].t_ns) == ("stopped", DIVERGED_NS)
