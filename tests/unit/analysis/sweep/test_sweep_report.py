"""The report of a sweep: summary, figures, page, and tables for the terminal."""

import html
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
from sweep_rows import made, plan, printed, well

from zsim.errors import ReportError
from zsim.math.randomness import stream
from zsim_analysis.report import indented_json
from zsim_analysis.sweep.design import SweepDesign, SweepPlan
from zsim_analysis.sweep.sweep import locked, read_table
from zsim_analysis.sweep.sweep_figures import BEYOND_AXIS, NEVER_AS_PLANNED, figures, slices
from zsim_analysis.sweep.sweep_report import OVERVIEW, TerminalText, make_sweep_report, missing_data_text, overview
from zsim_analysis.sweep.sweep_run import Row
from zsim_analysis.sweep.sweep_summary import SweepResults, field_name

unrendered = pytest.mark.usefixtures("unrendered")
undrawn = pytest.mark.usefixtures("undrawn")
X_RMS = "errors.x_c.true_rms"


def flown(of: SweepPlan, **known: Any) -> list[Row]:
    """Return the rows of runs that ended well, with the known values in their columns."""
    return [{**well(of, run), **known} for run in range(of.runs)]


def judged(of: SweepPlan, rows: list[Row]) -> SweepResults:
    return SweepResults(SweepDesign(of), rows)


def terminal(of: SweepPlan, rows: list[Row], width: int = 80) -> str:
    return printed(TerminalText(judged(of, rows).summary()), width)


def report_of(folder: Path, of: SweepPlan, rows: list[Row]) -> tuple[str, Any]:
    """Write the report of a sweep and return its page and its summary, decoded from JSON."""
    with locked(folder, of) as sweep, sweep.journal() as book:
        for each in rows:
            book.append(each)
    printed(TerminalText(make_sweep_report(folder)), 100)
    return (folder / "report.html").read_text(), msgspec.json.decode((folder / "summary.json").read_bytes())


def drawn(of: SweepPlan, name: str, rows: list[Row] | None = None, **known: Any) -> Figure:
    results = judged(of, rows or flown(of, **known))
    return next(each.drawing for each in figures(results) if each.name == f"{name}.png")


def named(figure: Figure) -> set[str]:
    """Return the texts of a figure's legend."""
    return {text.get_text() for legend in figure.legends for text in legend.get_texts()}


def figures_in(folder: Path) -> set[str]:
    return {path.stem for path in (folder / "figures").iterdir()}


def test_figures_of_a_sweep_are_not_blank(tmp_path: Path) -> None:
    of = plan("seed", "duration_s=1,2,3", runs=12)
    report_of(tmp_path, of, flown(of))
    for path in (tmp_path / "figures").glob("*.png"):
        assert matplotlib.image.imread(path).std() > 0.01


@unrendered
@pytest.mark.parametrize(
    ("vary", "more"),
    [
        (("seed",), set()),
        (("seed", "duration_s=1,2,3"), set()),
        (("seed", "duration_s=1,2,3,4,5,6", "name=a,b,c,d,e"), set()),
        (("seed", "duration_s=uniform(1,9)"), {"drawn_1"}),
        ((), set()),
    ],
)
def test_the_report_has_figures_points_and_spreads(tmp_path: Path, vary: tuple[str, ...], more: set[str]) -> None:
    of = plan(*vary, runs=60 if vary else 1)
    page, summary = report_of(tmp_path, of, flown(of))
    assert figures_in(tmp_path) == {"true_rms", "est_std", "safety"} | more
    assert page.count("data:image/png;base64,") == 3 + len(more)
    assert sum(point["runs"] for point in summary["points"]) == of.runs
    first = summary["points"][0]
    samples = [well(of, run)[X_RMS] for run in range(0, of.runs, len(summary["points"]))]
    assert first["spreads"][X_RMS]["mean"]["value"] == pytest.approx(np.mean(samples), rel=1e-12)
    assert (first["ended_well"]["value"], summary["failed"]) == (1.0, {})


@undrawn
def test_the_user_s_metrics_come_first_and_pairs_have_differences(tmp_path: Path) -> None:
    of = plan("seed=paired", "duration_s=1,2", "wind.gust_m_s=uniform(0,1)", runs=10, report={"metrics": "mine:own_m"})
    of = msgspec.structs.replace(of, changed=("duration_s=9",))
    day = {"date": "2026-01-02T03:04:05Z"}
    rows = [{**well(of, run), **day, "metrics.own_m": run // 2 + 0.5 * (run % 2)} for run in range(10)]
    page, _ = report_of(tmp_path, of, rows)
    heads = re.findall("<h2>(.*?)</h2>", page)
    assert [has_terms(head, term) for head, term in zip(heads, ("own", "Paired", "ended"), strict=False)] == [True] * 3
    assert "<td>0.5000 ± 0.0000 (n = 5)</td>" in page
    assert "<dt>Changed</dt><dd>duration_s=9</dd>" in page
    assert "<dt>Date</dt><dd>2026-01-02 03:04 UTC</dd>" in page
    assert next(figures(judged(of, rows))).name == "metrics.png"
    against = drawn(of, "drawn_1", rows)
    assert against.axes[0].get_ylabel() == "own (m)"
    letters = [axes.get_title(loc="left") for axes in against.axes if axes.get_visible()]
    assert letters == [f"({letter})" for letter in "abcd"]
    text = terminal(of, rows, 100)
    assert text.index("own (m)") < text.index("+0.5 ± 0 (n=5)") < text.index("ended")


@unrendered
def test_figures_in_other_formats_last_until_a_report_without_them(tmp_path: Path) -> None:
    of = plan("seed", runs=4)
    report_of(tmp_path, of, flown(of))
    own = tmp_path / "figures" / "of_the_user.pdf"
    own.write_bytes(b"")
    make_sweep_report(tmp_path, formats=["pdf", "svg"])
    stems = {path.stem for path in (tmp_path / "figures").glob("*.png")}
    assert {path.stem for path in (tmp_path / "figures").glob("*.svg")} == stems
    assert (tmp_path / "figures" / "safety.pdf").is_file()
    make_sweep_report(tmp_path)
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {f"{stem}.png" for stem in stems} | {own.name}


@undrawn
def test_a_report_shows_failed_and_unfinished_runs(tmp_path: Path) -> None:
    of = plan("seed", "duration_s=1,2", runs=40)
    rows = [well(of, run) if run % 4 == 1 else made(of, run, failure="the <world> waits") for run in range(20)]
    page, summary = report_of(tmp_path / "some", of, rows)
    assert has_terms(without_tags(page), "15 of 20", "failed", "the &lt;world&gt waits")
    assert has_terms(without_tags(page), "20 runs", "not finished")
    assert [point["ended_well"]["value"] for point in summary["points"]] == [0.0, 0.5]
    assert summary["points"][0]["spreads"] == {}
    assert summary["points"][1]["spreads"]["min_separation_m"]["runs"] == 5
    of = plan("seed", runs=3)
    page, _ = report_of(tmp_path / "none", of, [made(of, run, failure="no") for run in range(3)])
    assert has_terms(without_tags(page), "3 of 3", "failed", "no")
    with locked(tmp_path / "nothing", of), pytest.raises(ReportError, match=f"^{tmp_path / 'nothing'}: "):
        make_sweep_report(tmp_path / "nothing")


def engaged(of: SweepPlan, run: int, **since_s: float | None) -> Row:
    """Return the row of a run whose clusters were engaged at these times, or never."""
    begun = {f"clusters.{name}.engaged_s": value for name, value in since_s.items()}
    known = {name: 0.1 if value else None for name, value in since_s.items()}
    errors = {f"clusters.{name}.{X_RMS}": value for name, value in known.items() if name != "main"}
    row = {**well(of, run), "engaged": None not in since_s.values()}
    own = {name: None for name in row if name.startswith("errors.") and not known["main"]}
    return {**row, **own, **begun, **errors}


@undrawn
def test_the_report_names_clusters_and_counts_engaged_runs(tmp_path: Path) -> None:
    of = plan("seed", "duration_s=1,2", runs=8)
    rows = [
        engaged(of, run, main=5.0 if run % 2 or run < 4 else None, errors=6.0 if run % 2 else None) for run in range(8)
    ]
    page, summary = report_of(tmp_path, of, rows)
    assert {"<th>main: x_c (m)</th>", "<th>errors: x_c (m)</th>"} <= set(re.findall("<th>.*?</th>", page))
    assert "<td>main: beta (rad)</td>" in page
    assert has_terms(without_tags(page), "4 runs", "never engaged")
    assert [point["engaged"] for point in summary["points"]] == [0, 4]
    assert [point["spreads"][X_RMS]["runs"] for point in summary["points"]] == [2, 4]
    assert f"clusters.errors.{X_RMS}" not in summary["points"][0]["spreads"]
    assert summary["not_engaged"] == 4
    with locked(tmp_path, of) as folder:
        again = folder.compact()
    assert [row["clusters.errors.engaged_s"] for row in again] == [None, 6.0] * 4
    read = judged(of, read_table(tmp_path / "sweep.parquet"))
    assert indented_json(read.summary()) == (tmp_path / "summary.json").read_bytes()


@undrawn
def test_a_report_marks_unplanned_runs_and_shows_window_and_errors(tmp_path: Path) -> None:
    of = plan("seed", "duration_s=1,2", runs=8)
    known = {"window_from_s": 40 / 3, "window_to_s": 1234567.0, "engaged": True, "collisions": 0, "as_planned": True}
    left = {**known, "as_planned": False, "shortfall": "main: target refused"}
    rows = [made(of, run, engaged_throughout=run != 2, **(known if run > 1 else left)) for run in range(8)]
    page, summary = report_of(tmp_path, of, rows)
    assert summary["not_as_planned"] == {"main: target refused": 2}
    assert (summary["judged_unengaged"], summary["windows_s"]) == (1, [40 / 3, 1234567.0])
    assert [point["as_planned"]["value"] for point in summary["points"]] == [0.75, 0.75]
    text = terminal(of, rows)
    for shown in (page, text):
        assert "target refused" in shown
        assert "13.33 to 1234567 s" in shown
        assert "13.333" not in shown
    captions = [each.caption for each in figures(judged(of, rows))]
    assert sum("13.33 to 1234567 s" in caption for caption in captions) == 2
    assert next(line for line in text.splitlines() if "x_c" in line).split()[1:] == ["x_c", "y_c", "beta"]


@undrawn
def test_a_mean_excludes_runs_that_crashed_or_were_cut_short(tmp_path: Path) -> None:
    """Four of ten runs crash alike, at different times; they have smaller errors and larger separations."""
    of = plan("seed", runs=10)
    rows = flown(of, **{X_RMS: 0.2, "min_separation_m": 3.0, "metrics.effort": 2.0, "as_planned": True})
    better = {X_RMS: 0.1, "min_separation_m": 9.0, "metrics.effort": 1.0}
    fall = {"as_planned": False, "crashed": True, **better}
    cut = {"window_note": "The run ended at 60 s, before the window 120 to 320 s."}
    for run in range(6, 10):
        text = f"drone1: emergency at {20 + run}.5 s (tilted too far)"
        rows[run] |= {**fall, **cut, "shortfall": text}
    rows[6]["min_separation_m"] = 1.0
    page, _ = report_of(tmp_path, of, rows)
    summary = judged(of, rows).summary()
    (point,) = summary.points
    assert point.spreads[X_RMS].mean.value == pytest.approx(0.2)
    assert point.spreads["min_separation_m"].mean.value == pytest.approx(3.0)
    effort = point.spreads["metrics.effort"]
    assert (effort.mean.value, effort.least, effort.p5, effort.median) == (2.0, 2.0, 2.0, 2.0)
    assert point.count(X_RMS) == point.count("metrics.effort") == "n = 6"
    assert point.excluded == 4
    assert "4 excluded" in dict(zip(OVERVIEW, overview(point), strict=True))["as planned"]
    assert "4 excluded" in terminal(of, rows, 120)
    assert point.least_separation_m == 1.0
    assert point.without_collision is not None
    assert point.without_collision.value == pytest.approx(0.6)
    assert list(summary.not_as_planned.values()) == [4]  # merged into one line whatever the time
    assert summary.window_notes == {cut["window_note"]: 4}
    assert "26.5 s" in page
    assert cut["window_note"] in page


# Axes of figures


def test_an_axis_spans_its_samples_not_the_interval_of_two_runs() -> None:
    of = plan("seed", "duration_s=1,2", runs=4)
    samples = judged(of, flown(of)).values(X_RMS)
    low, high = drawn(of, "true_rms").axes[0].get_ylim()
    assert samples.min() - np.ptp(samples) < low < samples.min()
    assert samples.max() < high < samples.max() + np.ptp(samples)


def test_slices_of_a_drawn_value_have_equally_many_runs() -> None:
    x = stream(1, "x").uniform(0, 6, 600)
    found = slices(x, 10 * x)
    assert [len(samples) for _, samples in found] == [100] * 6
    for k, (middle, samples) in enumerate(found):
        assert middle == pytest.approx(k + 0.5, abs=0.25)
        assert samples.mean() == pytest.approx(10 * middle)


def test_numbers_are_at_their_value_on_an_axis_with_a_full_name() -> None:
    figure = drawn(plan("seed", "sensors.gps.position_m.noise=0,1,4", runs=15), "true_rms")
    axes = figure.axes[0]
    assert axes.get_xlabel() == "GPS position noise (m)"
    assert has_terms(axes.get_ylabel().replace("\n", " "), "RMS", "true", "$x_c$", "m")
    assert axes.get_xticks().tolist() == [0.0, 1.0, 4.0]
    low, high = axes.get_xlim()
    assert low < 0 < 4 < high < 5
    assert any(has_terms(text, "mean", "95 %", "5 seeds") for text in named(figure))
    few = named(drawn(plan("seed", "sensors.gps.position_m.noise=0,1,4", runs=6), "true_rms"))
    assert any(has_terms(text, "mean", "2 seeds") and "95 %" not in text for text in few)
    decades = drawn(plan("seed", "sensors.gps.position_m.noise=0.01,0.1,1,10", runs=8), "true_rms").axes[0]
    assert (decades.get_xscale(), axes.get_xscale()) == ("log", "linear")
    assert decades.get_xticks().tolist() == [0.01, 0.1, 1, 10]


def test_each_combination_has_a_colour_and_words_are_side_by_side() -> None:
    both = drawn(plan("seed", "wind.gust_m_s=0,1,2", "estimation.flow=true,false", runs=12), "true_rms")
    assert {"estimation flow true", "estimation flow false"} <= named(both)
    words = drawn(plan("seed", "sensors.preset=paper,ardrone2", runs=4), "true_rms").axes[0]
    assert [text.get_text() for text in words.get_xticklabels()] == ["paper", "ardrone2"]
    assert words.get_xlabel() == "sensors preset"


def beyond(axes: Axes) -> list[tuple[str, float]]:
    """Return the kind and y of the marks of intervals that exceed the axis."""
    marks = [line for line in axes.lines if line.get_marker() in ("^", "v") and not line.get_clip_on()]
    return [(str(line.get_marker()), float(np.asarray(line.get_ydata())[0])) for line in marks]


def test_an_interval_that_exceeds_its_axis_is_marked_and_in_the_legend() -> None:
    """Five runs, all but one of them equal, give an interval that is wider than their spread."""
    of = plan("seed", "duration_s=1,2", runs=10)
    figure = drawn(of, "true_rms", [{**well(of, run), X_RMS: 0.2 if run > 7 else 0.1} for run in range(10)])
    ends = dict(zip("v^", figure.axes[0].get_ylim(), strict=True))
    assert beyond(figure.axes[0])
    assert all(y == pytest.approx(ends[mark]) for mark, y in beyond(figure.axes[0]))
    assert BEYOND_AXIS in named(figure)
    many = drawn(plan("seed", "duration_s=1,2", runs=80), "true_rms")
    assert not any(beyond(axes) for axes in many.axes)
    assert BEYOND_AXIS not in named(many)


def test_the_user_s_metrics_are_drawn_and_summarised() -> None:
    of = plan("seed", "wind.gust_m_s=0,1", runs=6, report={"metrics": "my_figures:overshoot"})
    assert drawn(of, "metrics", flown(of, **{"metrics.overshoot_m": 0.5})).axes[0].get_ylabel() == "overshoot (m)"
    failure = "report.metrics my_figures:overshoot: KeyError: 'main'"
    rows = [{**well(of, run), "metrics.overshoot_m": float(run)} for run in range(5)]
    summary = judged(of, [*rows, {**well(of, 5), "metrics_failure": failure}]).summary()
    assert summary.points[0].spreads["metrics.overshoot_m"].mean.value == 2.0
    assert summary.points[1].spreads["metrics.overshoot_m"].runs == 2
    assert summary.unmeasured == {failure: 1}


def test_points_without_a_planned_flight_are_marked_and_shares_drawn() -> None:
    of = plan("seed", "duration_s=1,2", runs=8)
    rows = [{**well(of, run), "as_planned": run % 2 == 1 and run > 1} for run in range(8)]
    drawings = {each.name: each.drawing for each in figures(judged(of, rows))}
    for drawing in drawings.values():
        assert NEVER_AS_PLANNED in named(drawing)
        for axes in drawing.axes:
            crosses = [line for line in axes.lines if line.get_marker() == "x"]
            assert [float(x) for line in crosses for x in np.asarray(line.get_xdata())] == [1.0]
    diamonds = [line for line in drawings["safety.png"].axes[0].lines if line.get_marker() == "D"]
    assert [float(y) for line in diamonds for y in np.asarray(line.get_ydata())] == [0.0, 0.75]


def test_figures_of_a_sweep_without_a_planned_flight_are_marked() -> None:
    one = plan("seed", runs=4)
    assert drawn(one, "safety", as_planned=False).get_suptitle() == NEVER_AS_PLANNED
    assert [each.name for each in figures(judged(one, flown(one, as_planned=False)))] == ["safety.png"]
    assert drawn(one, "safety", as_planned=True).get_suptitle() == ""
    assert drawn(one, "safety").get_suptitle() == ""  # nothing to judge


@pytest.mark.parametrize("vary", [(), ("clusters.main.plan.trajectory.waypoints[0].values.p=1,2",)])
def test_labels_of_panels_are_complete_and_do_not_overlap(vary: tuple[str, ...]) -> None:
    of = plan("seed", *vary, runs=8)
    names = {f"errors.left.phi_{i}.est_std": 0.1 for i in range(3)}
    more = {f"metrics.time_to_the_first_engagement_{i}_s": float(i) for i in range(3)}
    for name in ("est_std", "metrics"):
        figure = drawn(of, name, flown(of, **names, **more))
        figure.draw_without_rendering()
        shown = [axes for axes in figure.axes if axes.get_visible()]
        boxes = [text.get_window_extent() for axes in shown for text in (axes.xaxis.label, axes.yaxis.label)]
        edges = figure.bbox.padded(1)
        assert all(edges.contains(x, y) for box in boxes for x, y in box.corners())
        assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])


# Missing data


def without_errors(of: SweepPlan, run: int) -> Row:
    """Return the row of a run whose plan was refused."""
    row = well(of, run)
    return {**row, **{name: None for name in row if name.startswith("errors.")}, "metrics.overshoot_m": None}


@unrendered
def test_quantities_without_data_are_neither_in_tables_nor_in_figures(tmp_path: Path) -> None:
    of = plan("seed", runs=2)
    rows = [without_errors(of, run) for run in range(2)]
    page, _ = report_of(tmp_path, of, rows)
    assert figures_in(tmp_path) == {"safety"}
    assert page.count("<table") == 1
    assert has_terms(without_tags(page), "formation errors", "your own")
    text = terminal(of, rows, 200)
    assert "overshoot" not in text
    assert missing_data_text(judged(of, rows).summary()) in text
    of = plan("seed", "duration_s=1,2", runs=4)
    rows = [without_errors(of, run) if run % 2 else well(of, run) for run in range(4)]
    page, _ = report_of(tmp_path / "some", of, rows)
    assert page.count("<table") == 3  # ends of runs, errors of all points, errors of the first point
    assert has_terms(without_tags(page[page.index("duration 2 s") :]), "No", "formation errors", "here")


def test_quantities_without_data_have_no_panel() -> None:
    of = plan("seed", runs=4)
    assert len(drawn(of, "true_rms", flown(of, **{"errors.y_c.true_rms": None})).axes) == 2
    assert len(drawn(of, "safety", min_separation_m=None).axes) == 1
    partly = [{**well(of, 0), "errors.y_c.true_rms": None, "errors.y_c.est_std": None}]
    assert has_terms(missing_data_text(judged(of, partly).summary()), "formation errors", "y_c (m)")
    assert missing_data_text(judged(of, [well(of, 0)]).summary()) == ""


# Tables


@undrawn
def test_values_with_a_common_beginning_have_distinct_rows_and_labels(tmp_path: Path) -> None:
    dropouts = [f"[{{kind: gps_dropout, target: {drone}, at_s: 20}}]" for drone in ("drone1", "drone2")]
    of = plan("seed", f"faults={','.join(dropouts)}", "wind.gust_m_s=0,1", runs=4)
    summary = judged(of, flown(of)).summary()
    assert len({point.label for point in summary.points}) == 4
    page = html.unescape(without_tags(report_of(tmp_path, of, flown(of))[0]))
    assert all(point.names["faults"] in page for point in summary.points)
    assert {"drone1", "drone2"} <= set(re.findall(r"drone\d", " ".join(named(drawn(of, "true_rms")))))


@pytest.mark.parametrize(
    "vary",
    [
        ("wind.gust_m_s=0,1,2",),
        ("sensors.gps.position_m.noise=0.1,1", "sensors.imu.accel_m_s2.bias_walk=0,1"),
        ("wind.gust_m_s=0,1", "duration_s=1,2", "estimation.flow=true,false", "sensors.preset=paper,ardrone2"),
    ],
)
def test_tables_in_80_columns_keep_every_name_and_number(vary: tuple[str, ...]) -> None:
    of = plan("seed", *vary, runs=32)
    text = terminal(of, [{**well(of, run), "metrics.time_to_engagement_s": 1.0 + run} for run in range(32)])
    assert "…" not in text
    assert max(len(line.rstrip()) for line in text.splitlines()) <= 80
    words = {word for path in SweepDesign(of).varied for word in str(field_name(path)).split()}
    assert words | {"x_c", "y_c", "beta", "collision", "separation", "engagement"} <= set(text.split())


@pytest.mark.parametrize("width", [50, 56, 62, 80])
def test_no_table_in_the_terminal_has_a_single_column(width: int) -> None:
    of = plan("seed", "clusters.main.plan.target.p=0.5,4", runs=4)
    lines = terminal(of, flown(of, **{f"errors.v_{i}.true_rms": 0.1 for i in range(6)}), width).splitlines()
    heads = [lines[place - 1].split() for place, line in enumerate(lines) if "──" in line]  # the last line of each head
    assert all(len(head[1:]) >= 2 for head in heads)


@undrawn
def test_no_table_of_the_page_has_too_many_columns_or_only_one(tmp_path: Path) -> None:
    of = plan("seed", "wind.gust_m_s=0,1", "sensors.gps.position_m.noise=1,4", runs=8)
    more = {f"errors.phi_{i}.true_rms": 0.1 for i in range(1, 13)} | {"metrics.overshoot_m": 0.5}
    page, _ = report_of(tmp_path / "wide", of, flown(of, **more))
    heads = [re.findall(r"<th>(.*?)</th>", row) for row in page.split("<tr>") if "<th>" in row]
    tables = [head for head in heads if head[:2] == ["wind gust (m/s)", "GPS position noise (m)"]]
    assert ["overshoot (m)"] in [head[2:] for head in tables]
    assert {"x_c (m)", "phi_12 (rad)"} <= {column for head in tables for column in head}
    assert max(map(len, tables)) <= 9
    of = plan("seed", "duration_s=1,2", runs=4)
    page, _ = report_of(tmp_path / "shared", of, flown(of, **{f"errors.v_{i}.true_rms": 0.1 for i in range(8)}))
    part = page[page.index("Formation errors at") : page.index("<h2>Figures")]
    assert [row.count("<th>") - 1 for row in part.split("<tr>") if "<th>" in row] == [4, 4, 3]


@undrawn
@pytest.mark.parametrize("vary", [(), ("duration_s=1,2",)])
def test_a_mean_of_fewer_runs_than_the_legend_states_has_its_count(vary: tuple[str, ...], tmp_path: Path) -> None:
    def counts(axes: Axes) -> list[str]:
        return [text.get_text() for text in axes.texts if text.get_text().startswith("n ")]

    of = plan("seed", *vary, runs=2 * (1 + len(vary)))
    rows = [{**well(of, run), "metrics.settled_s": None if run == 0 else 10.3} for run in range(of.runs)]
    assert [counts(axes) for axes in drawn(of, "metrics", rows).axes] == [["n = 1"]]
    assert not any(counts(axes) for axes in drawn(of, "true_rms", rows).axes)
    assert judged(of, rows).summary().points[0].count("metrics.settled_s") == "n = 1"
    assert terminal(of, rows).count("(n=1)") == 1
    page, _ = report_of(tmp_path, of, rows)
    assert "<td>10.3000 (n = 1)</td>" in page
    assert page.count("(n = ") == 1
    assert f"{rows[0][X_RMS]:.4f}, {rows[len(rows) // 2][X_RMS]:.4f}" in page  # both runs are listed
