"""Into which folders a run flies."""

from pathlib import Path

import pytest
from refused import has_terms, refused
from synthetic_record import SCENARIOS

from zsim.errors import RunError
from zsim.scenario import scenario_file
from zsim_deploy.launch.run_folder import make_directory

STEP = scenario_file.load(SCENARIOS / "step.yaml")


def test_a_folder_with_other_files_is_refused_unless_forced(tmp_path: Path) -> None:
    for name in ("thesis.tex", "a", "b", "c"):
        (tmp_path / name).write_text("mine")
    with refused(RunError, str(tmp_path), "a, b, c, …", "--out", "--force"):
        make_directory(tmp_path, STEP)
    assert make_directory(tmp_path, STEP, force=True) == tmp_path
    assert (tmp_path / "thesis.tex").read_text() == "mine"


def test_what_a_run_leaves_that_never_flew_is_in_nobodys_way(tmp_path: Path) -> None:
    for name in ("scenario.yaml", "run.log", "up.log"):
        (tmp_path / name).write_text("left")
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "world.log").touch()
    assert make_directory(tmp_path, STEP) == tmp_path


@pytest.mark.parametrize("name", ["run.mcap", "logs/world.log"])
@pytest.mark.parametrize("force", [False, True])
def test_a_run_is_never_flown_over(tmp_path: Path, name: str, force: bool) -> None:
    (tmp_path / "logs").mkdir()
    (tmp_path / name).write_text("x")
    with pytest.raises(RunError) as caught:
        make_directory(tmp_path, STEP, force)
    assert has_terms(str(caught.value), str(tmp_path), "--out")


def test_a_folder_that_is_not_there_is_made(tmp_path: Path) -> None:
    assert make_directory(tmp_path / "runs" / "mine", STEP).is_dir()
