"""The folders into which a run may write."""

from collections.abc import Iterable
from contextlib import nullcontext
from pathlib import Path

import pytest
from refused import refused
from synthetic_record import SCENARIOS

from zsim.errors import RunError
from zsim.record import RecordWriter
from zsim.scenario import scenario_file
from zsim_api.run_folder import make_directory, run_directory

STEP = scenario_file.load(SCENARIOS / "step.yaml")


def test_a_folder_with_other_files_is_refused_unless_forced(tmp_path: Path) -> None:
    for name in ("thesis.tex", "a", "b", "c"):
        (tmp_path / name).write_text("mine")
    with refused(RunError, str(tmp_path), "a, b, c, …", "--out", "--force"):
        make_directory(tmp_path, STEP)
    assert make_directory(tmp_path, STEP, force=True) == tmp_path
    assert (tmp_path / "thesis.tex").read_text() == "mine"


def test_remains_of_a_run_that_never_flew_are_not_in_the_way(tmp_path: Path) -> None:
    flown(tmp_path, ("scenario.yaml", "run.log", "up.log", "logs/world.log"))
    (tmp_path / "logs" / "world.log").write_text("")
    assert make_directory(tmp_path, STEP) == tmp_path
    assert make_directory(tmp_path / "runs" / "mine", STEP).is_dir()


OF_A_RUN = (
    *("scenario.yaml", "run.log", "summary.json", "report.html", "logs/world.log", "logs/recorder.log"),
    *("figures/errors.png", "figures/errors.pdf", "journal/0.entries", "journal/launch.json", "journal/truth"),
)
OF_OTHERS = ("thesis.tex", "logs/notes.txt", "figures/mine.tikz", "csv/truth.csv", "journal.md")


def flown(folder: Path, names: Iterable[str]) -> None:
    for name in names:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("x")


def files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", ["run.mcap", "logs/world.log"])
def test_a_run_is_replaced_only_if_forced(tmp_path: Path, name: str) -> None:
    flown(tmp_path, [name])
    with refused(RunError, str(tmp_path), "--force", "--out"):
        make_directory(tmp_path, STEP)
    assert files(tmp_path) == {name}


def test_force_removes_the_files_of_a_run_and_nothing_else(tmp_path: Path) -> None:
    RecordWriter(tmp_path / "run.mcap").close()
    flown(tmp_path, (*OF_A_RUN, *OF_OTHERS))
    assert make_directory(tmp_path, STEP, force=True) == tmp_path
    assert files(tmp_path) == set(OF_OTHERS)


@pytest.mark.parametrize("left", [("scenario.yaml", "logs/world.log"), ("journal/launch.json", "journal/0.entries")])
def test_force_removes_a_run_that_left_no_record(tmp_path: Path, left: tuple[str, ...]) -> None:
    flown(tmp_path, left)
    make_directory(tmp_path, STEP, force=True)
    assert files(tmp_path) == set()


def test_force_removes_nothing_from_a_folder_that_is_not_a_run(tmp_path: Path) -> None:
    mine = {"scenario.yaml", "logs/training.log", "figures/plot.png", "journal/monday", "summary.json"}
    flown(tmp_path, mine)
    make_directory(tmp_path, STEP, force=True)
    assert files(tmp_path) == mine


@pytest.mark.parametrize("is_under_way", [False, True])
def test_force_removes_neither_foreign_records_nor_runs_in_progress(tmp_path: Path, is_under_way: bool) -> None:
    flown(tmp_path, ["logs/world.log", "scenario.yaml", *([] if is_under_way else ["run.mcap"])])
    with RecordWriter(tmp_path / "run.mcap") if is_under_way else nullcontext():
        with refused(RunError, str(tmp_path if is_under_way else tmp_path / "run.mcap"), "--out"):
            make_directory(tmp_path, STEP, force=True)
        assert files(tmp_path) == {"run.mcap", "logs/world.log", "scenario.yaml"}


@pytest.mark.parametrize("force", [False, True])
def test_a_folder_is_locked_until_its_run_is_over(tmp_path: Path, force: bool) -> None:
    with run_directory(tmp_path, STEP) as folder, refused(RunError, str(tmp_path), "--out"):
        make_directory(folder, STEP, force)
    assert make_directory(tmp_path, STEP, force) == tmp_path


def test_runs_started_in_the_same_second_have_separate_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("zsim_api.run_folder.time.strftime", lambda _: "now")
    monkeypatch.setattr(Path, "exists", lambda _: False)  # as if all runs checked at the same time
    names = [make_directory(None, STEP).name for _ in range(3)]
    assert names == ["step-now", "step-now-2", "step-now-3"]
