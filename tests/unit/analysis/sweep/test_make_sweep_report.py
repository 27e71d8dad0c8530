"""The report of a sweep: summary, figures and page."""

import html
import io
import re
from pathlib import Path
from typing import Any

import matplotlib.image
import msgspec
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from refused import has_terms, without_tags
from rich.console import Console
from sweep_rows import made, plan, well

from zsim.errors import ReportError
from zsim.math.random_streams import stream
from zsim_analysis.sweep.design import SweepDesign, SweepPlan
from zsim_analysis.sweep.points import SweepResults
from zsim_analysis.sweep.report.field_names import field_name
from zsim_analysis.sweep.report.make_sweep_report import OVERVIEW, make_sweep_report, overview, without_data
from zsim_analysis.sweep.report.sweep_figures import BEYOND_AXIS, NEVER_AS_PLANNED, figures, slices
from zsim_analysis.sweep.report.terminal_tables import terminal_text
from zsim_analysis.sweep.sweep_folder import locked, read_table
from zsim_analysis.sweep.sweep_run import Row


def report_of(tmp_path: Path, of: SweepPlan, rows: list[Row]) -> str:
    with locked(tmp_path, of) as folder, folder.journal() as book:
        for each in rows:
            book.append(each)
    summary = make_sweep_report(tmp_path)
    console = Console(file=io.StringIO(), width=100)
    console.print(terminal_text(summary))
    return (tmp_path / "report.html").read_text()


@pytest.mark.parametrize("vary", ["seed", "duration_s=1,2,3"])
def test_figures_of_a_sweep_show_something(tmp_path: Path, vary: str) -> None:
    of = plan("seed", *({vary} - {"seed"}), runs=12)
    report_of(tmp_path, of, [well(of, run) for run in range(of.runs)])
    for path in (tmp_path / "figures").glob("*.png"):
        assert matplotlib.image.imread(path).std() > 0.01


@pytest.mark.usefixtures("unrendered")
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


@pytest.mark.usefixtures("unrendered")
def test_the_user_s_own_figures_come_first_and_pairs_have_their_differences(tmp_path: Path) -> None:
    of = plan("seed=paired", "duration_s=1,2", "wind.gust_m_s=uniform(0,1)", runs=10, report={"metrics": "mine:own_m"})
    of = msgspec.structs.replace(of, changed=("duration_s=9",))
    day = {"date": "2026-01-02T03:04:05Z"}
    rows = [{**well(of, run), **day, "metrics.own_m": run // 2 + 0.5 * (run % 2)} for run in range(10)]
    page = report_of(tmp_path, of, rows)
    heads = re.findall("<h2>(.*?)</h2>", page)
    assert [has_terms(head, term) for head, term in zip(heads, ("own", "Paired", "ended"), strict=False)] == [True] * 3
    assert "<td>0.5000 ± 0.0000 (n = 5)</td>" in page
    assert "<dt>Changed</dt><dd>duration_s=9</dd>" in page
    assert "<dt>Date</dt><dd>2026-01-02 03:04 UTC</dd>" in page
    results = SweepResults(SweepDesign(of), rows)
    drawn = list(figures(results))
    assert drawn[0].name == "metrics.png"
    against = next(each for each in drawn if each.name == "drawn_1.png").drawing
    assert against.axes[0].get_ylabel() == "own (m)"
    letters = [axes.get_title(loc="left") for axes in against.axes if axes.get_visible()]
    assert letters == [f"({letter})" for letter in "abcd"]
    console = Console(file=io.StringIO(), width=100)
    console.print(terminal_text(results.summary()))
    text = console.file.getvalue()  # pyright: ignore[reportAttributeAccessIssue]: a StringIO
    assert text.index("own (m)") < text.index("+0.5 ± 0 (n=5)") < text.index("ended")


@pytest.mark.usefixtures("unrendered")
def test_figures_in_other_formats_stand_beside_the_pictures_until_a_report_without_them(tmp_path: Path) -> None:
    of = plan("seed", runs=4)
    report_of(tmp_path, of, [well(of, run) for run in range(of.runs)])
    own = tmp_path / "figures" / "of_the_user.pdf"
    own.write_bytes(b"")
    make_sweep_report(tmp_path, formats=["pdf", "svg"])
    stems = {path.stem for path in (tmp_path / "figures").glob("*.png")}
    assert {path.stem for path in (tmp_path / "figures").glob("*.svg")} == stems
    assert (tmp_path / "figures" / "safety.pdf").is_file()
    make_sweep_report(tmp_path)
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {f"{stem}.png" for stem in stems} | {own.name}


@pytest.mark.usefixtures("unrendered")
def test_a_report_of_failures_and_of_what_is_not_finished(tmp_path: Path) -> None:
    of = plan("seed", "duration_s=1,2", runs=40)
    rows = [well(of, run) if run % 4 == 1 else made(of, run, failure="the <world> waits") for run in range(20)]
    page = report_of(tmp_path, of, rows)
    assert has_terms(without_tags(page), "15 of 20", "failed", "the &lt;world&gt waits")
    assert has_terms(without_tags(page), "20 runs", "not finished")
    summary = msgspec.json.decode((tmp_path / "summary.json").read_bytes())
    assert [point["ended_well"]["value"] for point in summary["points"]] == [0.0, 0.5]
    assert summary["points"][0]["spreads"] == {}
    assert summary["points"][1]["spreads"]["min_separation_m"]["runs"] == 5


@pytest.mark.usefixtures("unrendered")
def test_a_sweep_of_which_nothing_ended_well_has_a_report(tmp_path: Path) -> None:
    of = plan("seed", runs=3)
    page = report_of(tmp_path, of, [made(of, run, failure="no") for run in range(3)])
    assert has_terms(without_tags(page), "3 of 3", "failed", "no")


def test_there_is_no_report_of_nothing(tmp_path: Path) -> None:
    with (
        locked(tmp_path, plan("seed", runs=3)),
        pytest.raises(ReportError, match=f"^{tmp_path}: "),
    ):
        make_sweep_report(tmp_path)


def engaged(of: SweepPlan, run: int, **since_s: float | None) -> Row:
    """Return the row of a run with clusters that were engaged, or never."""
    begun = {f"clusters.{name}.engaged_s": value for name, value in since_s.items()}
    known = {name: 0.1 if value else None for name, value in since_s.items()}
    errors = {f"clusters.{name}.errors.x_c.true_rms": value for name, value in known.items() if name != "main"}
    flown = {**well(of, run), "engaged": None not in since_s.values()}
    for name in [name for name in flown if name.startswith("errors.") and not known["main"]]:
        flown[name] = None
    return {**flown, **begun, **errors}


@pytest.mark.usefixtures("unrendered")
def test_the_report_says_which_cluster_and_how_many_were_engaged(tmp_path: Path) -> None:
    of = plan("seed", "duration_s=1,2", runs=8)
    rows = [
        engaged(of, run, main=5.0 if run % 2 or run < 4 else None, errors=6.0 if run % 2 else None) for run in range(8)
    ]
    page = report_of(tmp_path, of, rows)
    assert "<th>main: x_c (m)</th>" in page
    assert "<th>errors: x_c (m)</th>" in page
    assert "<td>main: beta (rad)</td>" in page
    assert has_terms(without_tags(page), "4 runs", "never engaged")
    summary = msgspec.json.decode((tmp_path / "summary.json").read_bytes())
    assert [point["engaged"] for point in summary["points"]] == [0, 4]
    assert [point["spreads"]["errors.x_c.true_rms"]["runs"] for point in summary["points"]] == [2, 4]
    assert "clusters.errors.errors.x_c.true_rms" not in summary["points"][0]["spreads"]
    assert summary["not_engaged"] == 4
    with locked(tmp_path, of) as folder:
        again = folder.compact()
    assert [row["clusters.errors.engaged_s"] for row in again] == [None, 6.0] * 4
    assert (
        SweepResults(SweepDesign(of), read_table(tmp_path / "sweep.parquet")).summary().json()
        == (tmp_path / "summary.json").read_bytes()
    )


@pytest.mark.usefixtures("unrendered")
def test_a_sweep_marks_runs_that_left_their_plan_and_shows_window_and_errors(tmp_path: Path) -> None:
    of = plan("seed", "duration_s=1,2", runs=8)
    known = {"window_from_s": 5.0, "window_to_s": 9.0, "engaged": True}
    rows = [
        made(
            of,
            run,
            collisions=0,
            as_planned=run > 1,
            shortfall=None if run > 1 else "main: target refused",
            engaged_throughout=run != 2,
            **known,
        )
        for run in range(8)
    ]
    page = report_of(tmp_path, of, rows)
    summary = msgspec.json.decode((tmp_path / "summary.json").read_bytes())
    assert summary["not_as_planned"] == {"main: target refused": 2}
    assert summary["judged_unengaged"] == 1
    assert summary["windows_s"] == [5.0, 9.0]
    assert [point["as_planned"]["value"] for point in summary["points"]] == [0.75, 0.75]
    assert "target refused" in page
    assert "5 to 9 s" in page
    console = Console(file=io.StringIO(), width=80)
    console.print(terminal_text(SweepResults(SweepDesign(of), rows).summary()))
    assert isinstance(console.file, io.StringIO)
    text = console.file.getvalue()
    assert "target refused" in text
    assert "5 to 9 s" in text
    assert next(line for line in text.splitlines() if "x_c" in line).split()[1:] == ["x_c", "y_c", "beta"]


def test_an_axis_is_that_of_its_samples_not_of_an_interval_of_two_runs() -> None:
    of = plan("seed", "duration_s=1,2", runs=4)
    results = SweepResults(SweepDesign(of), [well(of, run) for run in range(4)])
    figure = next(each.drawing for each in figures(results) if each.name == "true_rms.png")
    samples = results.values("errors.x_c.true_rms")
    low, high = figure.axes[0].get_ylim()
    assert samples.min() - np.ptp(samples) < low < samples.min()
    assert samples.max() < high < samples.max() + np.ptp(samples)


def test_slices_of_a_drawn_value_hold_as_many_runs_each() -> None:
    x = stream(1, "x").uniform(0, 6, 600)
    found = slices(x, 10 * x)
    assert [len(samples) for _, samples in found] == [100] * 6
    for k, (middle, samples) in enumerate(found):
        assert middle == pytest.approx(k + 0.5, abs=0.25)
        assert samples.mean() == pytest.approx(10 * middle)


def drawn(of: SweepPlan, name: str, **known: Any) -> Figure:
    rows = [{**well(of, run), **known} for run in range(of.runs)]
    return next(each.drawing for each in figures(SweepResults(SweepDesign(of), rows)) if each.name == name)


def named(figure: Figure) -> set[str]:
    """Return the texts of a figure's legend."""
    return {text.get_text() for legend in figure.legends for text in legend.get_texts()}


def beyond(axes: Axes) -> list[tuple[str, float]]:
    """Return kind and y of the marks of intervals that leave an axis."""
    marks = [line for line in axes.lines if line.get_marker() in ("^", "v") and not line.get_clip_on()]
    return [(str(line.get_marker()), float(np.asarray(line.get_ydata())[0])) for line in marks]


@pytest.mark.usefixtures("unrendered")
def test_a_mean_does_not_profit_from_runs_that_fell_or_were_not_flown(tmp_path: Path) -> None:
    """Four of ten runs fall in the same way, at other times: they err by less and keep farther apart."""
    of = plan("seed", runs=10)
    flown = {"errors.x_c.true_rms": 0.2, "min_separation_m": 3.0, "metrics.effort": 2.0, "as_planned": True}
    rows = [{**well(of, run), **flown} for run in range(6)]
    better = {"errors.x_c.true_rms": 0.1, "min_separation_m": 9.0, "metrics.effort": 1.0}
    fall = {"as_planned": False, "crashed": True, **better}
    cut = {"window_note": "The run ended at 60 s, before the window 120 to 320 s."}
    for run in range(6, 10):
        text = f"drone1: emergency at {20 + run}.5 s (tilted too far)"
        rows.append({**well(of, run), **fall, **cut, "shortfall": text})
    rows[6]["min_separation_m"] = 1.0
    page = report_of(tmp_path, of, rows)
    summary = SweepResults(SweepDesign(of), rows).summary()
    (point,) = summary.points
    assert point.spreads["errors.x_c.true_rms"].mean.value == pytest.approx(0.2)
    assert point.spreads["min_separation_m"].mean.value == pytest.approx(3.0)
    effort = point.spreads["metrics.effort"]
    assert (effort.mean.value, effort.least, effort.p5, effort.median) == (2.0, 2.0, 2.0, 2.0)
    assert point.count("errors.x_c.true_rms") == point.count("metrics.effort") == "n = 6"
    assert point.excluded == 4
    assert "4 excluded" in dict(zip(OVERVIEW, overview(point), strict=True))["as planned"]
    console = Console(file=io.StringIO(), width=120)
    console.print(terminal_text(summary))
    assert "4 excluded" in console.file.getvalue()  # type: ignore[attr-defined]
    assert point.least_separation_m == 1.0
    assert point.without_collision is not None
    assert point.without_collision.value == pytest.approx(0.6)
    assert list(summary.not_as_planned.values()) == [4]  # in one line, whatever the time
    assert "26.5 s" in page
    assert summary.window_notes == {cut["window_note"]: 4}
    assert cut["window_note"] in page


@pytest.mark.usefixtures("unrendered")
def test_two_runs_are_shown_as_they_are(tmp_path: Path) -> None:
    of = plan("seed", runs=2)
    rows = [{**well(of, run), "errors.x_c.true_rms": value} for run, value in enumerate((0.044, 0.19))]
    page = report_of(tmp_path, of, rows)
    assert "0.0440, 0.1900" in page
    assert "± 0.9" not in page


def test_numbers_stand_at_their_value_under_their_full_name() -> None:
    figure = drawn(plan("seed", "sensors.gps.position_m.noise=0,1,4", runs=15), "true_rms.png")
    axes = figure.axes[0]
    assert axes.get_xlabel() == "GPS position noise (m)"
    assert has_terms(axes.get_ylabel().replace("\n", " "), "RMS", "$x_c$", "truth", "m")
    assert axes.get_xticks().tolist() == [0.0, 1.0, 4.0]
    low, high = axes.get_xlim()
    assert low < 0 < 4 < high < 5
    assert any(has_terms(text, "mean", "95 %", "5 seeds") for text in named(figure))
    few = named(drawn(plan("seed", "sensors.gps.position_m.noise=0,1,4", runs=6), "true_rms.png"))
    assert any(has_terms(text, "mean", "2 seeds") and "95 %" not in text for text in few)


def test_values_over_decades_have_a_logarithmic_axis() -> None:
    axes = drawn(plan("seed", "sensors.gps.position_m.noise=0.01,0.1,1,10", runs=8), "true_rms.png").axes[0]
    assert axes.get_xscale() == "log"
    assert axes.get_xticks().tolist() == [0.01, 0.1, 1, 10]
    assert drawn(plan("seed", "duration_s=1,2,3", runs=6), "true_rms.png").axes[0].get_xscale() == "linear"


def test_combinations_of_other_fields_have_a_colour_each_and_words_stand_side_by_side() -> None:
    both = drawn(plan("seed", "wind.gust_m_s=0,1,2", "estimation.flow=true,false", runs=12), "true_rms.png")
    assert {"estimation flow true", "estimation flow false"} <= named(both)
    words = drawn(plan("seed", "sensors.preset=paper,ardrone2", runs=4), "true_rms.png").axes[0]
    assert [text.get_text() for text in words.get_xticklabels()] == ["paper", "ardrone2"]
    assert words.get_xlabel() == "sensors preset"


def test_an_interval_that_leaves_its_axis_is_marked_there_and_named() -> None:
    """Five runs, all but one of them alike, give an interval that is wider than their spread."""
    of = plan("seed", "duration_s=1,2", runs=10)
    rows = [{**well(of, run), "errors.x_c.true_rms": 0.2 if run > 7 else 0.1} for run in range(of.runs)]
    figure = next(each.drawing for each in figures(SweepResults(SweepDesign(of), rows)) if each.name == "true_rms.png")
    axes = figure.axes[0]
    low, high = axes.get_ylim()
    ends = {"v": low, "^": high}
    assert beyond(axes)
    assert all(y == pytest.approx(ends[mark]) for mark, y in beyond(axes))
    assert BEYOND_AXIS in named(figure)
    many = drawn(plan("seed", "duration_s=1,2", runs=80), "true_rms.png")
    assert not any(beyond(axes) for axes in many.axes)
    assert BEYOND_AXIS not in named(many)


@pytest.mark.parametrize(
    "vary",
    [
        ("wind.gust_m_s=0,1,2",),
        ("sensors.gps.position_m.noise=0.1,1", "sensors.imu.accel_m_s2.bias_walk=0,1"),
        ("wind.gust_m_s=0,1", "duration_s=1,2", "estimation.flow=true,false", "sensors.preset=paper,ardrone2"),
    ],
)
def test_the_tables_of_a_terminal_of_80_columns_keep_every_name_and_number(vary: tuple[str, ...]) -> None:
    of = plan("seed", *vary, runs=32)
    rows = [{**well(of, run), "metrics.time_to_engagement_s": 1.0 + run} for run in range(of.runs)]
    console = Console(file=io.StringIO(), width=80)
    console.print(terminal_text(SweepResults(SweepDesign(of), rows).summary()))
    assert isinstance(console.file, io.StringIO)
    text = console.file.getvalue()
    assert "…" not in text
    assert max(len(line.rstrip()) for line in text.splitlines()) <= 80
    words = {word for path in SweepDesign(of).varied for word in str(field_name(path)).split()}
    assert words | {"x_c", "y_c", "beta", "collision", "separation", "engagement"} <= set(text.split())


@pytest.mark.usefixtures("unrendered")
def test_no_table_of_the_page_has_more_columns_than_fit_it(tmp_path: Path) -> None:
    of = plan("seed", "wind.gust_m_s=0,1", "sensors.gps.position_m.noise=1,4", runs=8)
    more = {f"errors.phi_{i}.true_rms": 0.1 for i in range(1, 13)}
    page = report_of(tmp_path, of, [{**well(of, run), **more, "metrics.overshoot_m": 0.5} for run in range(8)])
    heads = [re.findall(r"<th>(.*?)</th>", row) for row in page.split("<tr>") if "<th>" in row]
    tables = [head for head in heads if head[:2] == ["wind gust (m/s)", "GPS position noise (m)"]]
    assert ["overshoot (m)"] in [head[2:] for head in tables]
    assert {"x_c (m)", "phi_12 (rad)"} <= {column for head in tables for column in head}
    assert max(map(len, tables)) <= 9


def test_figures_of_the_user_s_own_are_drawn_and_summed_up() -> None:
    of = plan("seed", "wind.gust_m_s=0,1", runs=6, report={"metrics": "my_figures:overshoot"})
    figure = drawn(of, "metrics.png", **{"metrics.overshoot_m": 0.5})
    assert figure.axes[0].get_ylabel() == "overshoot (m)"
    rows = [{**well(of, run), "metrics.overshoot_m": float(run)} for run in range(5)]
    rows.append({**well(of, 5), "metrics_failure": "report.metrics my_figures:overshoot: KeyError: 'main'"})
    summary = SweepResults(SweepDesign(of), rows).summary()
    assert summary.points[0].spreads["metrics.overshoot_m"].mean.value == 2.0
    assert summary.points[1].spreads["metrics.overshoot_m"].runs == 2
    assert summary.unmeasured == {"report.metrics my_figures:overshoot: KeyError: 'main'": 1}


def crosses(axes: Axes) -> list[float]:
    """Return the x of the marks of points without a flight as planned."""
    marks = [line for line in axes.lines if line.get_marker() == "x"]
    return [float(x) for line in marks for x in np.asarray(line.get_xdata())]


def test_points_without_a_flight_as_planned_are_marked_and_their_share_is_drawn() -> None:
    of = plan("seed", "duration_s=1,2", runs=8)
    rows = [{**well(of, run), "as_planned": run % 2 == 1 and run > 1} for run in range(8)]
    results = SweepResults(SweepDesign(of), rows)
    drawings = {each.name: each.drawing for each in figures(results)}
    assert {tuple(crosses(axes)) for drawing in drawings.values() for axes in drawing.axes} == {(1.0,)}
    assert all(NEVER_AS_PLANNED in named(drawing) for drawing in drawings.values())
    shares = drawings["safety.png"].axes[0]
    diamonds = [line for line in shares.lines if line.get_marker() == "D"]
    assert [float(y) for line in diamonds for y in np.asarray(line.get_ydata())] == [0.0, 0.75]


def test_figures_of_a_sweep_without_a_flight_as_planned_say_so() -> None:
    one = plan("seed", runs=4)
    assert drawn(one, "safety.png", as_planned=False).get_suptitle() == NEVER_AS_PLANNED
    rows = [{**well(one, run), "as_planned": False} for run in range(one.runs)]
    assert [each.name for each in figures(SweepResults(SweepDesign(one), rows))] == ["safety.png"]  # no errors count
    assert drawn(one, "safety.png", as_planned=True).get_suptitle() == ""
    assert drawn(one, "safety.png").get_suptitle() == ""  # nothing to judge


def without_errors(of: SweepPlan, run: int) -> Row:
    """Return the row of a run whose plan was refused."""
    row = well(of, run)
    return {**row, **{name: None for name in row if name.startswith("errors.")}, "metrics.overshoot_m": None}


@pytest.mark.usefixtures("unrendered")
def test_what_no_run_has_is_neither_in_tables_nor_in_figures(tmp_path: Path) -> None:
    of = plan("seed", runs=2)
    rows = [without_errors(of, run) for run in range(2)]
    page = report_of(tmp_path, of, rows)
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {"safety.png"}
    assert page.count("<table") == 1
    assert has_terms(without_tags(page), "formation errors", "figures", "your own", "no figure")
    summary = SweepResults(SweepDesign(of), rows).summary()
    console = Console(file=io.StringIO(), width=200)
    console.print(terminal_text(summary))
    assert isinstance(console.file, io.StringIO)
    assert "overshoot" not in console.file.getvalue()
    assert without_data(summary) in console.file.getvalue()


@pytest.mark.usefixtures("unrendered")
def test_a_point_without_errors_has_a_sentence_in_place_of_a_table(tmp_path: Path) -> None:
    of = plan("seed", "duration_s=1,2", runs=4)
    rows = [without_errors(of, run) if run % 2 else well(of, run) for run in range(4)]
    page = report_of(tmp_path, of, rows)
    assert page.count("<table") == 3  # how runs ended, errors of all points, and of the first one
    assert has_terms(without_tags(page[page.index("duration 2 s") :]), "No", "formation errors", "here")


def test_quantities_without_data_have_no_panel() -> None:
    of = plan("seed", runs=4)
    assert [len(drawn(of, "true_rms.png", **{"errors.y_c.true_rms": None}).axes)] == [2]
    assert len(drawn(of, "safety.png", min_separation_m=None).axes) == 1
    partly = SweepResults(SweepDesign(of), [{**well(of, 0), "errors.y_c.true_rms": None, "errors.y_c.est_std": None}])
    assert has_terms(without_data(partly.summary()), "formation errors", "y_c (m)")
    assert without_data(SweepResults(SweepDesign(of), [well(of, 0)]).summary()) == ""


@pytest.mark.parametrize("vary", [(), ("clusters.main.plan.trajectory.waypoints[0].values.p=1,2",)])
def test_labels_of_panels_are_whole_and_do_not_touch(vary: tuple[str, ...]) -> None:
    of = plan("seed", *vary, runs=8)
    names = {f"errors.left.phi_{i}.est_std": 0.1 for i in range(3)}
    more = {f"metrics.time_to_the_first_engagement_{i}_s": float(i) for i in range(3)}
    for name in ("est_std.png", "metrics.png"):
        figure = drawn(of, name, **names, **more)
        figure.draw_without_rendering()
        shown = [axes for axes in figure.axes if axes.get_visible()]
        boxes = [text.get_window_extent() for axes in shown for text in (axes.xaxis.label, axes.yaxis.label)]
        edges = figure.bbox.padded(1)
        assert all(edges.contains(x, y) for box in boxes for x, y in box.corners())
        assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])


@pytest.mark.usefixtures("unrendered")
def test_values_that_begin_alike_have_rows_and_labels_that_differ(tmp_path: Path) -> None:
    of = plan("seed", f"faults={dropout('drone1')},{dropout('drone2')}", "wind.gust_m_s=0,1", runs=4)
    rows = [well(of, run) for run in range(4)]
    summary = SweepResults(SweepDesign(of), rows).summary()
    assert len({point.label for point in summary.points}) == 4
    page = without_tags(report_of(tmp_path, of, rows))
    assert all(point.names["faults"] in html.unescape(page) for point in summary.points)
    assert {"drone1", "drone2"} <= set(re.findall(r"drone\d", " ".join(named(drawn(of, "true_rms.png")))))


def dropout(drone: str) -> str:
    return f"[{{kind: gps_dropout, target: {drone}, at_s: 20}}]"


@pytest.mark.usefixtures("unrendered")
def test_windows_have_two_decimals_at_most(tmp_path: Path) -> None:
    of = plan("seed", runs=2)
    known = {"window_from_s": 40 / 3, "window_to_s": 1234567.0, "engaged_throughout": False}
    rows = [{**well(of, run), **known} for run in range(2)]
    page = report_of(tmp_path, of, rows)
    assert "13.33 to 1234567 s" in page
    assert "13.333" not in page
    captions = [each.caption for each in figures(SweepResults(SweepDesign(of), rows))]
    assert sum("13.33 to 1234567 s" in caption for caption in captions) == 2


def heads(text: str) -> list[list[str]]:
    """Return the last words of the heads of the tables on a terminal."""
    lines = text.splitlines()
    return [lines[place - 1].split() for place, line in enumerate(lines) if "──" in line]


@pytest.mark.parametrize("width", [50, 56, 62, 80])
def test_the_columns_of_a_terminal_are_shared_out_so_that_no_table_has_one(width: int) -> None:
    of = plan("seed", "clusters.main.plan.target.p=0.5,4", runs=4)
    more = {f"errors.v_{i}.true_rms": 0.1 for i in range(6)}
    rows = [{**well(of, run), **more} for run in range(4)]
    console = Console(file=io.StringIO(), width=width)
    console.print(terminal_text(SweepResults(SweepDesign(of), rows).summary()))
    assert isinstance(console.file, io.StringIO)
    tables = [head[1:] for head in heads(console.file.getvalue())]
    assert all(len(head) >= 2 for head in tables)


@pytest.mark.usefixtures("unrendered")
def test_the_columns_of_the_page_are_shared_out_so_that_no_table_has_one(tmp_path: Path) -> None:
    of = plan("seed", "duration_s=1,2", runs=4)
    more = {f"errors.v_{i}.true_rms": 0.1 for i in range(8)}
    page = report_of(tmp_path, of, [{**well(of, run), **more} for run in range(4)])
    part = page[page.index("Formation errors at") : page.index("<h2>Figures")]
    assert [row.count("<th>") - 1 for row in part.split("<tr>") if "<th>" in row] == [4, 4, 3]


def counts(axes: Axes) -> list[str]:
    """Return the numbers of runs that are written in a panel."""
    return [text.get_text() for text in axes.texts if text.get_text().startswith("n ")]


@pytest.mark.parametrize("vary", [(), ("duration_s=1,2",)])
def test_a_mean_of_fewer_runs_than_the_legend_says_has_its_number(vary: tuple[str, ...]) -> None:
    of = plan("seed", *vary, runs=2 * (1 + len(vary)))
    rows = [{**well(of, run), "metrics.settled_s": None if run == 0 else 10.3 + run} for run in range(of.runs)]
    results = SweepResults(SweepDesign(of), rows)
    drawings = {each.name: each.drawing for each in figures(results)}
    assert [counts(axes) for axes in drawings["metrics.png"].axes] == [["n = 1"]]
    assert not any(counts(axes) for axes in drawings["true_rms.png"].axes)
    summary = results.summary()
    assert summary.points[0].count("metrics.settled_s") == "n = 1"
    console = Console(file=io.StringIO(), width=80)
    console.print(terminal_text(summary))
    assert isinstance(console.file, io.StringIO)
    assert console.file.getvalue().count("(n=1)") == 1


@pytest.mark.usefixtures("unrendered")
def test_a_table_has_the_number_of_a_mean_of_fewer_runs(tmp_path: Path) -> None:
    of = plan("seed", "duration_s=1,2", runs=4)
    rows = [{**well(of, run), "metrics.settled_s": None if run == 0 else 10.3} for run in range(4)]
    page = report_of(tmp_path, of, rows)
    assert "<td>10.3000 (n = 1)</td>" in page
    assert page.count("(n = ") == 1
