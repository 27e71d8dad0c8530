"""What is kept of a sweep and said of it: journal, table, intervals, distributions, the page."""

import io
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.image
import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest
import scipy.stats
from rich.console import Console

from zsim.errors import ReportError, RunError
from zsim.math.random_streams import stream
from zsim_analysis.sweep.design import Design
from zsim_analysis.sweep.results import intervals, journal, sweep_table
from zsim_analysis.sweep.results.make_sweep_report import make_sweep_report
from zsim_analysis.sweep.results.make_sweep_report import table as shown_table
from zsim_analysis.sweep.results.points import Parameter, Results, parameters, spread
from zsim_analysis.sweep.results.row import Result, Row, row
from zsim_analysis.sweep.results.sweep_figures import slices
from zsim_analysis.sweep.screen import SweepScreen, span
from zsim_analysis.sweep.sweep_folder import Folder, load, locked
from zsim_analysis.sweep.sweep_plan import Plan, is_sweep

NAMES = ("x_c", "y_c", "beta")


def plan(*vary: str, runs: int = 1, **values: Any) -> Plan:
    return Plan(source="s.yaml", document={"name": "s", **values}, vary=vary, runs=runs)


def made(of: Plan, run: int, failure: str | None = None, **known: Any) -> Row:
    """Return a row as a flight would make it, its errors being a function of the run."""
    design = Design(of)
    values = design.values(run)
    result = Result(run=run, point=design.point(run), seed=values.get("seed", 1), failure=failure, host="h", **known)
    rng = stream(run, "error")
    errors = {f"errors.{name}.{each}": abs(rng.normal(0.1, 0.02)) for name in NAMES for each in ("est_std", "true_rms")}
    return row(result, {path: values[path] for path in design.varied}, {} if failure else errors)


def well(of: Plan, run: int) -> Row:
    more = {"ended": "over", "sim_s": 5.0, "wall_s": 0.5, "real_time_factor": 10.0}
    return made(of, run, truth_sha256=f"{run:064x}", min_separation_m=2 + 0.1 * (run % 7), collisions=0, **more)


# Intervals


@pytest.mark.parametrize("n", [2, 3, 10, 200])
@pytest.mark.parametrize("level", [0.9, 0.95, 0.99])
def test_the_interval_of_a_mean_is_student_s(n: int, level: float) -> None:
    samples = stream(n, "samples").normal(3.0, 2.0, n)
    found = intervals.mean(samples, level)
    wanted = scipy.stats.t.interval(level, n - 1, samples.mean(), scipy.stats.sem(samples))
    assert (found.low, found.high) == pytest.approx(wanted, rel=1e-12)
    assert found.value == samples.mean()


def test_one_sample_has_a_mean_and_no_interval() -> None:
    found = intervals.mean(np.array([4.0]))
    assert found.value == 4.0
    assert math.isnan(found.low)
    assert math.isnan(found.high)


@pytest.mark.parametrize(("count", "of"), [(0, 1), (1, 1), (0, 30), (30, 30), (1, 30), (17, 30), (999, 1000)])
@pytest.mark.parametrize("level", [0.9, 0.95])
def test_the_interval_of_a_share_is_the_exact_one(count: int, of: int, level: float) -> None:
    found = intervals.share(count, of, level)
    wanted = scipy.stats.binomtest(count, of).proportion_ci(level, "exact")
    assert (found.low, found.high) == pytest.approx((wanted.low, wanted.high), rel=1e-9)
    if count == 0:
        assert found.high == pytest.approx(1 - ((1 - level) / 2) ** (1 / of), rel=1e-12)


def test_intervals_cover_what_they_promise() -> None:
    """Of 2000 repetitions, as many intervals hold the true value as their level says, within four deviations."""
    rng = stream(1, "coverage")
    held = sum(found.low <= 0.5 <= found.high for found in (intervals.mean(rng.normal(0.5, 1, 8)) for _ in range(2000)))
    assert held / 2000 == pytest.approx(0.95, abs=4 * math.sqrt(0.95 * 0.05 / 2000))
    counts = rng.binomial(20, 0.3, 2000)
    exact = [intervals.share(int(count), 20) for count in counts]
    assert sum(found.low <= 0.3 <= found.high for found in exact) / 2000 >= 0.95


def test_a_spread() -> None:
    found = spread(np.array([1.0, 2.0, 3.0, 4.0, np.nan, np.inf]))
    assert found is not None
    assert (found.runs, found.median, found.least, found.greatest) == (4, 2.5, 1.0, 4.0)
    assert found.std == pytest.approx(math.sqrt(5 / 3))
    assert spread(np.array([np.nan])) is None


# Journal and table


def test_a_journal_keeps_what_was_finished_and_drops_a_cut_line(tmp_path: Path) -> None:
    of, path = plan("seed", runs=5), tmp_path / "journal.jsonl"
    assert journal.read(path) == []
    with journal.Journal(path) as book:
        book.append(well(of, 0))
        book.append(well(of, 3))
    whole = path.read_bytes()
    for cut in (1, 17, len(whole) // 2 - 1):
        path.write_bytes(whole[:-cut])
        assert journal.read(path) == [well(of, 0)]
    with journal.Journal(path) as book:
        book.append(well(of, 4))
    assert journal.read(path) == [well(of, 0), well(of, 4)]


def test_a_journal_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"nowhere/journal\.jsonl: cannot be written \(No such file or directory\)"):
        journal.Journal(tmp_path / "nowhere/journal.jsonl")


def test_the_table_has_a_typed_column_for_all_that_is_known(tmp_path: Path) -> None:
    vary = (
        "seed",
        "duration_s=1,2.5",
        "sensors.preset=paper,ardrone2",
        "a=[1,2],[3]",
        "b=uniform(0,1)",
        "c=true,false",
    )
    of = plan(*vary, runs=32)
    rows = [made(of, 0, failure="diverged"), *(well(of, run) for run in range(1, 32))]
    path = tmp_path / "sweep.parquet"
    sweep_table.write(path, reversed(rows), of, Design(of).axes)
    found = pq.read_table(path)
    types = {field.name: str(field.type) for field in found.schema}
    assert list(types)[:9] == ["run", "point", "seed", "duration_s", "sensors.preset", "a", "b", "c", "failure"]
    assert list(types.values())[:9] == ["int64"] * 3 + ["double", "string", "string", "double", "bool", "string"]
    assert types["errors.x_c.true_rms"] == types["min_separation_m"] == "double"
    assert types["collisions"] == "int64"
    assert found.column("run").to_pylist() == list(range(32))
    assert found.column("a").to_pylist()[:4:2] == ["[1,2]", "[3]"]
    assert found.column("errors.x_c.true_rms").null_count == 1
    assert msgspec.json.decode(found.schema.metadata[sweep_table.PLAN], type=Plan) == of
    again = sweep_table.read(path)
    assert [{name: value for name, value in each.items() if value is not None} for each in again] == [
        {name: value for name, value in each.items() if value is not None} for each in rows
    ]


def test_a_table_that_is_none(tmp_path: Path) -> None:
    path = tmp_path / "sweep.parquet"
    path.write_bytes(b"PAR1")
    with pytest.raises(ReportError, match=r"sweep\.parquet: cannot be read"):
        sweep_table.read(path)


# The folder


def test_a_folder_goes_on_with_its_own_plan_and_refuses_any_other(tmp_path: Path) -> None:
    of, out = plan("seed", runs=4), tmp_path / "sweep"
    assert not is_sweep(out)
    with locked(out, of) as folder:
        with folder.journal() as book:
            book.append(well(of, 2))
        with pytest.raises(RunError, match="another sweep is at work there"), locked(out, of):
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
        with (
            pytest.raises(RunError, match=r"sweep: holds another sweep \(.*\); give --out another folder"),
            locked(out, other),
        ):
            pass
    (tmp_path / "run").mkdir()
    (tmp_path / "run/run.mcap").touch()
    with pytest.raises(RunError, match="holds something else already"), locked(tmp_path / "run", of):
        pass
    (out / "plan.json").write_text("{}")
    with pytest.raises(RunError, match=r"plan\.json: cannot be read"):
        load(out)


def test_a_sweep_of_which_nothing_is_finished_claims_no_folder(tmp_path: Path) -> None:
    with locked(tmp_path, plan("seed", runs=1_000_000)) as folder:
        folder.compact()
    with locked(tmp_path, plan("seed", "duration_s=1,2", runs=4)) as folder, folder.journal() as book:
        book.append(well(folder.plan, 1))
    with pytest.raises(RunError, match="holds another sweep"), locked(tmp_path, plan("seed", runs=4)):
        pass


def test_a_plan_that_is_no_text_is_refused_in_a_line(tmp_path: Path) -> None:
    with (
        pytest.raises(RunError, match=r"plan\.json: cannot be written \('\\udcfc' is no character\)"),
        locked(tmp_path, plan("name=a\udcfc")),
    ):
        pass


def test_a_crash_between_table_and_journal_doubles_nothing(tmp_path: Path) -> None:
    of = plan("seed", runs=2)
    folder = Folder(tmp_path, of)
    with folder.journal() as book:
        book.append(well(of, 1))
    kept = (tmp_path / "journal.jsonl").read_bytes()
    folder.compact()
    assert not (tmp_path / "journal.jsonl").exists()
    (tmp_path / "journal.jsonl").write_bytes(kept)
    assert [each["run"] for each in folder.rows()] == [1]


# The report


def report_of(tmp_path: Path, of: Plan, rows: list[Row]) -> str:
    with locked(tmp_path, of) as folder, folder.journal() as book:
        for each in rows:
            book.append(each)
    summary = make_sweep_report(tmp_path)
    for path in (tmp_path / "figures").glob("*.png"):
        assert matplotlib.image.imread(path).std() > 0.01
    console = Console(file=io.StringIO(), width=100)
    console.print(shown_table(summary))
    return (tmp_path / "report.html").read_text()


@pytest.mark.parametrize(
    ("vary", "figures"),
    [
        (("seed",), {"true_rms", "est_std", "safety"}),
        (("seed", "duration_s=1,2,3"), {"true_rms", "est_std", "safety"}),
        (("seed", "duration_s=1,2,3,4,5,6", "name=a,b,c,d,e"), {"true_rms", "est_std", "safety"}),
        (("seed", "duration_s=uniform(1,9)"), {"true_rms", "est_std", "safety", "drawn_1"}),
        ((), {"true_rms", "est_std", "safety"}),
    ],
)
def test_the_report_of_a_sweep(tmp_path: Path, vary: tuple[str, ...], figures: set[str]) -> None:
    of = plan(*vary, runs=60 if vary else 1)
    page = report_of(tmp_path, of, [well(of, run) for run in range(of.runs)])
    assert {path.stem for path in (tmp_path / "figures").iterdir()} == figures
    assert page.count("data:image/png;base64,") == len(figures)
    summary = msgspec.json.decode((tmp_path / "summary.json").read_bytes())
    assert sum(point["runs"] for point in summary["points"]) == of.runs
    assert summary["failed"] == {}
    first = summary["points"][0]
    samples = [well(of, run)["errors.x_c.true_rms"] for run in range(0, of.runs, len(summary["points"]))]
    assert first["spreads"]["errors.x_c.true_rms"]["mean"]["value"] == pytest.approx(np.mean(samples), rel=1e-12)
    assert first["ended_well"]["value"] == 1.0


def test_a_report_of_failures_and_of_what_is_not_finished(tmp_path: Path) -> None:
    of = plan("seed", "duration_s=1,2", runs=40)
    rows = [well(of, run) if run % 4 == 1 else made(of, run, failure="the <world> waits") for run in range(20)]
    page = report_of(tmp_path, of, rows)
    assert "15 of 20 runs failed: the &lt;world&gt; waits" in page
    assert "20 runs are not finished; the same command goes on with them" in page
    summary = msgspec.json.decode((tmp_path / "summary.json").read_bytes())
    assert [point["ended_well"]["value"] for point in summary["points"]] == [0.0, 0.5]
    assert summary["points"][0]["spreads"] == {}
    assert summary["points"][1]["spreads"]["min_separation_m"]["runs"] == 5


def test_a_sweep_of_which_nothing_ended_well_has_a_report(tmp_path: Path) -> None:
    of = plan("seed", runs=3)
    assert "3 of 3 runs failed: no" in report_of(tmp_path, of, [made(of, run, failure="no") for run in range(3)])


def test_there_is_no_report_of_nothing(tmp_path: Path) -> None:
    with (
        locked(tmp_path, plan("seed", runs=3)),
        pytest.raises(ReportError, match="no run of this sweep is finished yet"),
    ):
        make_sweep_report(tmp_path)


def test_slices_of_a_drawn_value_hold_as_many_runs_each() -> None:
    x = stream(1, "x").uniform(0, 6, 600)
    found = slices(x, 10 * x)
    assert [len(samples) for _, samples in found] == [100] * 6
    for k, (middle, samples) in enumerate(found):
        assert middle == pytest.approx(k + 0.5, abs=0.25)
        assert samples.mean() == pytest.approx(10 * middle)


def test_parameters_are_found_in_the_names_of_columns() -> None:
    columns = [
        "errors.x_c.est_std",
        "errors.x_c.true_rms",
        "errors.left.p.true_rms",
        "clusters.a.b.errors.yaw.true_rms",
    ]
    found = parameters(columns, ["main", "a.b"])
    assert found == {
        "errors.x_c": Parameter("x_c", "main"),
        "errors.left.p": Parameter("left.p", "main"),
        "clusters.a.b.errors.yaw": Parameter("yaw", "a.b"),
    }
    assert parameters(columns[:1], ["main"]) == parameters(columns[:1], []) == {"errors.x_c": Parameter("x_c")}
    hostile = parameters(["clusters.errors.errors.x_c.est_std"], ["a", "errors"])
    assert hostile == {"clusters.errors.errors.x_c": Parameter("x_c", "errors")}
    assert [each.labelled("x_c (m)") for each in hostile.values()] == ["errors: x_c (m)"]


def engaged(of: Plan, run: int, **since_s: float | None) -> Row:
    """Return the row of a run with clusters that were engaged, or never."""
    begun = {f"clusters.{name}.engaged_s": value for name, value in since_s.items()}
    known = {name: 0.1 if value else None for name, value in since_s.items()}
    errors = {f"clusters.{name}.errors.x_c.true_rms": value for name, value in known.items() if name != "main"}
    flown = {**well(of, run), "engaged": None not in since_s.values()}
    for name in [name for name in flown if name.startswith("errors.") and not known["main"]]:
        flown[name] = None
    return {**flown, **begun, **errors}


def test_the_report_says_which_cluster_and_how_many_were_engaged(tmp_path: Path) -> None:
    of = plan("seed", "duration_s=1,2", runs=8)
    rows = [
        engaged(of, run, main=5.0 if run % 2 or run < 4 else None, errors=6.0 if run % 2 else None) for run in range(8)
    ]
    page = report_of(tmp_path, of, rows)
    assert "<th>main: x_c (m)</th>" in page
    assert "<th>errors: x_c (m)</th>" in page
    assert "<td>main: beta (rad)</td>" in page
    assert "In 4 runs that ended well a cluster was never engaged within the judged window" in page
    summary = msgspec.json.decode((tmp_path / "summary.json").read_bytes())
    assert [point["engaged"] for point in summary["points"]] == [0, 4]
    assert [point["spreads"]["errors.x_c.true_rms"]["runs"] for point in summary["points"]] == [2, 4]
    assert "clusters.errors.errors.x_c.true_rms" not in summary["points"][0]["spreads"]
    assert summary["not_engaged"] == 4
    with locked(tmp_path, of) as folder:
        again = folder.compact()
    assert [row["clusters.errors.engaged_s"] for row in again] == [None, 6.0] * 4
    assert (
        Results(Design(of), sweep_table.read(tmp_path / "sweep.parquet")).summary().json()
        == (tmp_path / "summary.json").read_bytes()
    )


def test_columns_of_a_failed_run_are_no_samples() -> None:
    of = plan("seed", runs=3)
    results = Results(Design(of), [well(of, 0), made(of, 1, failure="x", min_separation_m=0.1), well(of, 2)])
    assert results.values("min_separation_m").tolist() == [2.0, 2.2]
    assert results.ended_well(0) == (2, 3)
    assert results.without_collision(0) == (2, 2)


# The screen


def test_the_screen_tells_runs_per_hour_and_the_time_to_go() -> None:
    now_s = [100.0]
    clock: Callable[[], float] = lambda: now_s[0]  # noqa: E731
    screen = SweepScreen(100, 40, Console(file=io.StringIO()), clock)
    assert "40 / 100 runs  the first ones are flying" in screen.line()
    now_s[0] = 136.0
    screen.finished(failed=False)
    screen.finished(failed=True)
    assert screen.line().endswith("42 / 100 runs  200 runs/h  17 min 24 s to go  1 failed")


def test_times_in_words() -> None:
    assert [span(s) for s in (0.4, 59, 61, 3599, 3600, 90_060)] == [
        "0 s",
        "59 s",
        "1 min 01 s",
        "59 min 59 s",
        "1 h 00 min",
        "25 h 01 min",
    ]
