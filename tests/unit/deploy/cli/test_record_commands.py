"""What is said, and with which exit code, when a run is over."""

from pathlib import Path
from typing import Any

import pytest
import typer
from refused import has_terms

from zsim.errors import RecordError
from zsim_deploy.cli import record_commands
from zsim_deploy.launch.supervisor import Outcome

INTERRUPTED = Outcome("interrupted by Ctrl-C", interrupted=True)
DIED = Outcome("the world died", failed=True)
NO_MESSAGE = RecordError("run.mcap: holds no message")


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    (tmp_path / "run.mcap").touch()
    return tmp_path


def raising(error: BaseException) -> Any:
    def report(_: Path) -> None:
        raise error

    return report


def test_ctrl_c_before_there_is_a_record(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit, match="130"):
        record_commands.conclude(INTERRUPTED, tmp_path, True)
    assert capsys.readouterr().err == f"ended: {INTERRUPTED.reason}\n"


def test_ctrl_c_in_flight(recorded: Path, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit, match="130"):
        record_commands.conclude(INTERRUPTED, recorded, True)
    assert has_terms(capsys.readouterr().err, "record", str(recorded / "run.mcap"))


def test_ctrl_c_in_the_report(recorded: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(record_commands, "_report", raising(KeyboardInterrupt()))
    with pytest.raises(SystemExit, match="130"):
        record_commands.conclude(Outcome("over"), recorded, True)
    assert has_terms(capsys.readouterr().err, "interrupted", "complete", f"zsim report {recorded}")


def test_a_failed_run_of_which_nothing_can_be_reported(
    recorded: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(record_commands, "_report", raising(NO_MESSAGE))
    with pytest.raises(typer.Exit) as ended:
        record_commands.conclude(DIED, recorded, True)
    assert ended.value.exit_code == 1
    assert f"ended: {DIED.reason}\n{NO_MESSAGE}\n" in capsys.readouterr().err
    with pytest.raises(RecordError):
        record_commands.conclude(Outcome("ended"), recorded, True)
