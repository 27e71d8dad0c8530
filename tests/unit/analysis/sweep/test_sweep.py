"""A sweep as a whole: its folder, journal and table, and its screen."""

import errno
import io
import os
from collections.abc import Callable
from pathlib import Path

import msgspec
import pyarrow.parquet as pq
import pytest
from refused import has_terms, refused
from rich.console import Console
from sweep_rows import made, plan, well

from zsim.errors import ReportError, RunError
from zsim_analysis.sweep.design import SweepDesign, SweepPlan, is_sweep
from zsim_analysis.sweep.sweep import (
    PLAN_METADATA,
    Journal,
    SweepFolder,
    SweepScreen,
    duration_text,
    load,
    locked,
    read_journal,
    read_table,
    write_table,
)


def test_a_journal_keeps_finished_runs_and_drops_a_truncated_line(tmp_path: Path) -> None:
    with refused(RunError, "nowhere/journal.jsonl", os.strerror(errno.ENOENT)):
        Journal(tmp_path / "nowhere/journal.jsonl")
    of, path = plan("seed", runs=5), tmp_path / "journal.jsonl"
    assert read_journal(path) == []
    with Journal(path) as book:
        book.append(well(of, 0))
        book.append(well(of, 3))
    whole = path.read_bytes()
    for cut in (1, 17, len(whole) // 2 - 1):
        path.write_bytes(whole[:-cut])
        assert read_journal(path) == [well(of, 0)]
    with Journal(path) as book:
        book.append(well(of, 4))
    assert read_journal(path) == [well(of, 0), well(of, 4)]


def test_the_table_has_a_typed_column_for_every_quantity(tmp_path: Path) -> None:
    presets = "sensors.preset=paper,ardrone2"
    of = plan("seed", "duration_s=1,2.5", presets, "a=[1,2],[3]", "b=uniform(0,1)", "c=true,false", runs=32)
    rows = [made(of, 0, failure="diverged"), *(well(of, run) for run in range(1, 32))]
    path = tmp_path / "sweep.parquet"
    write_table(path, reversed(rows), of, SweepDesign(of).axes)
    found = pq.read_table(path)
    types = {field.name: str(field.type) for field in found.schema}
    assert list(types)[:9] == ["run", "point", "seed", "duration_s", "sensors.preset", "a", "b", "c", "failure"]
    assert list(types.values())[:9] == ["int64"] * 3 + ["double", "string", "string", "double", "bool", "string"]
    assert types["errors.x_c.true_rms"] == types["min_separation_m"] == "double"
    assert types["collisions"] == "int64"
    assert found.column("run").to_pylist() == list(range(32))
    assert found.column("a").to_pylist()[:4:2] == ["[1,2]", "[3]"]
    assert found.column("errors.x_c.true_rms").null_count == 1
    assert msgspec.json.decode(found.schema.metadata[PLAN_METADATA], type=SweepPlan) == of
    again, written = (
        [{name: value for name, value in each.items() if value is not None} for each in table]
        for table in (read_table(path), rows)
    )
    assert again == written
    path.write_bytes(b"PAR1")
    with pytest.raises(ReportError, match=r"sweep\.parquet: "):
        read_table(path)


def test_a_folder_continues_its_own_plan_and_refuses_any_other(tmp_path: Path) -> None:
    of, out = plan("seed", runs=4), tmp_path / "sweep"
    assert not is_sweep(out)
    with locked(out, of) as folder:
        with folder.journal() as book:
            book.append(well(of, 2))
        with pytest.raises(RunError, match=f"^{out}: "), locked(out, of):
            pass
        assert [each["run"] for each in folder.compact()] == [2]
        with folder.journal() as book:
            book.append(well(of, 0))
    longer = plan("seed", runs=6)
    with locked(out, longer) as folder:
        assert [each["run"] for each in folder.rows()] == [0, 2]
        assert folder.record(12) == out / "runs/000012"
    assert load(out).plan == longer
    for other in (of, plan("seed", runs=6, duration_s=3), plan(runs=6)):
        with pytest.raises(RunError, match=r"sweep: .*--out"), locked(out, other):
            pass
    (tmp_path / "run").mkdir()
    (tmp_path / "run/run.mcap").touch()
    with pytest.raises(RunError, match=r"run: .*--out"), locked(tmp_path / "run", of, force=True):
        pass
    (out / "plan.json").write_text("{}")
    with pytest.raises(RunError, match=r"plan\.json: "):
        load(out)


def test_a_folder_with_other_files_is_refused_unless_forced(tmp_path: Path) -> None:
    of, stranger = plan("seed", runs=1), tmp_path / "thesis.tex"
    stranger.write_text("mine")
    with refused(RunError, str(tmp_path), "thesis.tex", "--out", "--force"), locked(tmp_path, of):
        pass
    assert list(tmp_path.iterdir()) == [stranger]
    with locked(tmp_path, of, force=True):
        pass
    with locked(tmp_path, of):  # it is now the folder of a sweep, which continues
        pass
    assert stranger.read_text() == "mine"


def test_a_sweep_without_finished_runs_does_not_claim_its_folder(tmp_path: Path) -> None:
    with locked(tmp_path, plan("seed", runs=1_000_000)) as folder:
        folder.compact()
    with locked(tmp_path, plan("seed", "duration_s=1,2", runs=4)) as folder, folder.journal() as book:
        book.append(well(folder.plan, 1))
    with pytest.raises(RunError, match=f"^{tmp_path}: .*--out"), locked(tmp_path, plan("seed", runs=4)):
        pass
    with pytest.raises(RunError, match=r"plan\.json: .*'\\udcfc'"), locked(tmp_path / "b", plan("name=a\udcfc")):
        pass  # a plan that cannot be encoded as text


def test_a_crash_between_table_and_journal_duplicates_no_run(tmp_path: Path) -> None:
    of = plan("seed", runs=2)
    folder = SweepFolder(tmp_path, of)
    with folder.journal() as book:
        book.append(well(of, 1))
    kept = (tmp_path / "journal.jsonl").read_bytes()
    folder.compact()
    assert not (tmp_path / "journal.jsonl").exists()
    (tmp_path / "journal.jsonl").write_bytes(kept)
    assert [each["run"] for each in folder.rows()] == [1]


def test_the_screen_shows_runs_per_hour_and_the_remaining_time() -> None:
    now_s = [100.0]
    clock: Callable[[], float] = lambda: now_s[0]  # noqa: E731
    screen = SweepScreen(100, 40, Console(file=io.StringIO()), clock)
    assert has_terms(screen.line(), "40 / 100", "first")
    now_s[0] = 136.0
    screen.finished(failed=False)
    screen.finished(failed=True)
    assert has_terms(screen.line(), "42 / 100", "200 runs/h", "17 min 24 s", "1 failed")
    times = {0.4: "0 s", 59: "59 s", 61: "1 min 01 s", 3599: "59 min 59 s", 3600: "1 h 00 min", 90_060: "25 h 01 min"}
    assert {s: duration_text(s) for s in times} == times
