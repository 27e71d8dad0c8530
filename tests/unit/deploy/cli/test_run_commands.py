"""What is shown at the end of a run, and the exit code."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import synthetic_record
import typer
from refused import has_terms, without_tags
from typer.testing import CliRunner

from zsim.contract import keys, run_messages
from zsim.errors import RecordError
from zsim.record import RecordWriter
from zsim_deploy.cli import run_commands
from zsim_deploy.cli.cli import app
from zsim_deploy.launch.supervisor import Outcome

INTERRUPTED = Outcome("interrupted by Ctrl-C", interrupted=True)
DIED = Outcome("the world died", failed=True)
NO_MESSAGE = RecordError("run.mcap: contains no messages")


@pytest.fixture(autouse=True)
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zsim_analysis.report.make_report.figures", lambda *_: ())


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    (tmp_path / "run.mcap").touch()
    return tmp_path


def raising(error: BaseException) -> Any:
    def report(_: Path) -> None:
        raise error

    return report


@pytest.mark.parametrize("where", ["before", "flight", "report"])
def test_ctrl_c_exits_with_130_and_names_a_record(
    recorded: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, where: str
):
    record = recorded / "run.mcap"
    record.unlink() if where == "before" else None
    monkeypatch.setattr(run_commands, "_report", raising(KeyboardInterrupt()))
    with pytest.raises(SystemExit, match="130"):
        run_commands.conclude(Outcome("over") if where == "report" else INTERRUPTED, recorded, True)
    err = capsys.readouterr().err
    if where == "before":
        assert err == f"ended: {INTERRUPTED.reason}\n"
    else:
        assert has_terms(err, "record", f"zsim report {recorded}")


def test_a_failed_run_without_messages_has_no_report_but_its_reason(
    recorded: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(run_commands, "_report", raising(NO_MESSAGE))
    with pytest.raises(typer.Exit) as ended:
        run_commands.conclude(DIED, recorded, True)
    assert ended.value.exit_code == 1
    lines = capsys.readouterr().err.splitlines()
    assert (str(NO_MESSAGE) in lines, lines[-1]) == (True, f"ended: {DIED.reason}")
    with pytest.raises(RecordError):
        run_commands.conclude(Outcome("ended"), recorded, True)


def write(path: Path, missing: range = range(0), gates: int = 50, end: bool = True) -> Path:
    """Write the record of a run with a number of gates, some of which may be missing."""
    flown = synthetic_record.Flown(duration_s=(gates - 1) * 0.02)
    with RecordWriter(path / "run.mcap") as writer:
        for key, message, wall_ns in synthetic_record.traffic(flown):
            if message.t_ns // synthetic_record.GATE_NS not in missing or key == keys.INFO:
                writer.add_message(key, message, wall_ns)
        if end:
            last = gates - 1
            clock = run_messages.Clock(last * synthetic_record.GATE_NS, gates, "run", last, "stopped", 1.0)
            writer.add_message(keys.CLOCK, clock, 1)
    return path


class Judged(NamedTuple):
    """What is shown of a record: the exit code, the terminal output, summary.json and the page of the report."""

    code: int
    out: str
    err: str
    summary: dict[str, Any]
    page: str


def judged(
    folder: Path, capsys: pytest.CaptureFixture[str], outcome: Outcome | None = None, report: bool = True
) -> Judged:
    code = 0
    try:
        run_commands.conclude(outcome or Outcome("the scenario's duration is over"), folder, report)
    except typer.Exit as ended:
        code = ended.exit_code
    shown = capsys.readouterr()
    if not report:
        return Judged(code, shown.out, shown.err, {}, "")
    summary = json.loads((folder / "summary.json").read_text())
    return Judged(code, shown.out, shown.err, summary["record"], without_tags((folder / "report.html").read_text()))


CASES = {
    "whole": ({}, ("complete", "50")),
    "gap": ({"missing": range(20, 24)}, ("incomplete", "4", "50", "0.40", "0.46")),
    "no end": ({"end": False}, ("incomplete", "end", "0.98")),
}


@pytest.mark.parametrize("case", CASES)
def test_summary_page_terminal_and_exit_code_agree(tmp_path: Path, capsys: pytest.CaptureFixture[str], case: str):
    options, terms = CASES[case]
    without = judged(write(tmp_path, **options), capsys, report=False)
    assert without.code == (case != "whole")
    assert has_terms(without.out, "record", *terms)
    assert case == "whole" or has_terms(without.err.splitlines()[-1], *terms)
    shown = judged(tmp_path, capsys)
    assert has_terms(shown.summary["state"], *terms)
    assert (shown.summary["complete"], shown.code) == ((True, 0) if case == "whole" else (False, 1))
    assert shown.summary["state"] in shown.page
    (line,) = [line for line in shown.out.splitlines() if line.startswith("record: ")]
    assert line.partition(" (")[0] == f"record: {shown.summary['state']}"
    if case != "whole":
        assert shown.err.splitlines()[-1].endswith(shown.summary["state"])
    if case == "gap":
        assert (shown.summary["gates"], shown.summary["gates_missing"]) == (46, 4)
        assert shown.summary["gaps"] == [{"gates": 4, "from_s": 0.4, "to_s": 0.46}]


@pytest.mark.parametrize("report", [True, False])
def test_the_last_line_gives_the_reason_of_a_failure(tmp_path: Path, capsys: pytest.CaptureFixture[str], report: bool):
    (tmp_path / "logs").mkdir()
    shown = judged(write(tmp_path, end=False), capsys, DIED, report)
    assert shown.code == 1
    assert has_terms(shown.out, "ended", DIED.reason, "record", str(tmp_path / "run.mcap"))
    assert has_terms(shown.err.splitlines()[-1], DIED.reason)


def test_a_run_without_a_record_has_failed(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    shown = judged(tmp_path, capsys, report=False)
    assert shown.code == 1
    assert has_terms(shown.err.splitlines()[-1], "nothing", "recorded")


def test_a_failed_rerun_or_sweep_ends_with_the_reason(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.setattr("zsim_analysis.rerun.rerun_record", lambda *_: "truth differs")
    with pytest.raises(typer.Exit) as ended:
        run_commands.rerun(tmp_path)
    assert (ended.value.exit_code, capsys.readouterr().err.splitlines()[-1]) == (1, "truth differs")
    with pytest.raises(typer.Exit) as ended:
        run_commands._conclude(tmp_path, ["too heavy", "too heavy"], 2, report=False)
    assert ended.value.exit_code == 1
    assert has_terms(capsys.readouterr().err.splitlines()[-1], "2", "too heavy")


@pytest.mark.parametrize("options", [("--install",), ("--python",), ("--install", "--python")])
def test_options_of_an_environment_are_refused_by_name_without_a_bundle(options: tuple[str, ...], tmp_path: Path):
    with pytest.raises(typer.BadParameter) as raised:
        run_commands.rerun(
            tmp_path, install="--install" in options, python=Path("python3.11") if "--python" in options else None
        )
    assert raised.value.message.endswith(f"leave out {' and '.join(options)}")


@pytest.mark.parametrize("options", [("--laws",), ("--format",), ("--laws", "--scenarios", "--format")])
def test_only_the_given_options_are_refused_for_the_figures_of_papers(options: tuple[str, ...]):
    laws, scenarios = (f"of {option}" if option in options else None for option in ("--laws", "--scenarios"))
    with pytest.raises(typer.BadParameter) as raised:
        run_commands.board(laws, scenarios, formats="pdf" if "--format" in options else None, papers=True)
    assert raised.value.message.endswith(f"leave out {' and '.join(options)}")


@pytest.fixture
def formats(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, ...]]:
    """Return the requested formats of reports, none of which is made."""
    asked: list[tuple[str, ...]] = []
    monkeypatch.setattr(run_commands, "_report", lambda _, wanted=(): asked.append(tuple(wanted)))
    return asked


def report(*arguments: str) -> int:
    return CliRunner().invoke(app, ["report", *arguments]).exit_code


def test_figures_can_be_requested_in_other_formats(recorded: Path, formats: list[tuple[str, ...]]) -> None:
    assert report(str(recorded)) == report(str(recorded), "--format", "svg") == 0
    assert report(str(recorded), "--format", "pdf,svg") == 0
    assert formats == [(), ("svg",), ("pdf", "svg")]


@pytest.mark.parametrize("wrong", ["png", "pdf svg", "pdf,", ","])
def test_invalid_formats_are_refused(wrong: str, recorded: Path, formats: list[tuple[str, ...]]) -> None:
    assert report(str(recorded), "--format", wrong) == 2
    assert formats == []
