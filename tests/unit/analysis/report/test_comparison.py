"""The comparison of runs: their reports side by side, and notes on what only some of them have."""

import base64
import errno
import io
import os
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import matplotlib.image
import msgspec
import numpy as np
import pytest
import synthetic_record
from matplotlib.colors import to_hex
from matplotlib.text import Text
from refused import has_terms, refused
from synthetic_record import Flown
from typer.testing import CliRunner

from zsim.contract.run_messages import Event
from zsim.errors import RecordError, ReportError
from zsim_analysis.report.comparison import (
    ABSENT,
    POINTS,
    STYLES,
    THERE,
    UNPLANNED,
    ComparedRun,
    clusters,
    compare,
    comparison_figures,
    comparison_page,
    comparison_path,
    fact_rows,
    flattened,
    notes,
    run_names,
    run_style,
    scenario_rows,
    statistics_rows,
)
from zsim_analysis.report.figure_style import ReportFigure
from zsim_analysis.report.summary import STATISTICS, judge
from zsim_deploy.cli.cli import app

WINDOW = "report.window_s=[2, 9.98]"
ERRORS = np.linspace(0.02, 0.2, 12)


def record(folder: Path, flight: Flown) -> Path:
    folder.mkdir(parents=True)
    synthetic_record.write(folder / "run.mcap", flight)
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return the folders of a calm run, a run with larger errors and another seed, and a run without a cluster."""
    home = tmp_path_factory.mktemp("runs")
    calm = Flown(duration_s=12.0, overrides=(WINDOW,), amplitude=ERRORS, est_amplitude=0.5 * ERRORS)
    rough = Flown(duration_s=12.0, overrides=(WINDOW, "seed=5"), amplitude=3 * ERRORS, est_amplitude=ERRORS)
    alone = Flown(duration_s=12.0, overrides=(WINDOW, "clusters=[]"))
    flights = {"calm": calm, "rough": rough, "alone": alone}
    return [record(home / name, flight) for name, flight in flights.items()]


def judged(directories: list[Path]) -> list[ComparedRun]:
    names = run_names(directories)
    return [ComparedRun(name, d, *judge(d / "run.mcap")) for name, d in zip(names, directories, strict=True)]


@pytest.fixture(scope="module")
def compared(runs: list[Path]) -> list[ComparedRun]:
    return judged(runs)


def test_statistics_are_shown_side_by_side(compared: list[ComparedRun]) -> None:
    rows = {row.name: row.cells for row in statistics_rows(compared, "main")}
    width = len(STATISTICS)
    for i, name in enumerate(["x_c (m)", "y_c (m)", "z_c (m)"]):
        sine = ERRORS[i] / np.sqrt(2)
        est_std, true_std, true_rms, true_mean = map(float, rows[name][:width])
        assert (est_std, true_std, true_rms) == pytest.approx((sine / 2, sine, sine), abs=1e-4)
        assert true_mean == pytest.approx(0, abs=1e-4)
        assert float(rows[name][width + 1]) == pytest.approx(3 * sine, abs=1e-4)
        assert rows[name][2 * width :] == (ABSENT,) * width


def test_facts_that_differ_are_marked(compared: list[ComparedRun]) -> None:
    rows = {row.name: row for row in fact_rows(compared)}
    assert rows["Scenario"].cells[:2] == ("step, seed 1", "step, seed 5")
    assert rows["Scenario"].differs
    assert not rows["Mode"].differs
    assert rows["Clusters"].cells == ("main of 3", "main of 3", "none")


def test_scenarios_differ_in_the_overridden_fields(compared: list[ComparedRun], tmp_path: Path) -> None:
    """Each fault is compared as a whole, and differences that rounding would hide are shown."""
    rows = {row.name: row.cells for row in scenario_rows(compared)}
    assert rows == {"seed": ("1", "5", "1"), "clusters.main": (THERE, THERE, ABSENT)}
    assert scenario_rows(compared[:1] * 2) == []
    faults = 'faults=[{"kind": "gps_bias", "target": "drone1", "at_s": 1, "for_s": 0.5, "value_m": [3, 0, 0]}]'
    gust, values = "environment.wind.gust_m_s", ("0.1234567", "0.12345671")
    near = [
        record(tmp_path / value, Flown(duration_s=2.0, overrides=(f"{gust}={value}", *more)))
        for value, more in zip(values, ((), (faults,)), strict=True)
    ]
    differing = {row.name: row.cells for row in scenario_rows(judged(near))}
    assert differing.keys() == {gust, "faults.0"}
    assert differing[gust] == values
    assert differing["faults.0"][0] == ABSENT
    fault = differing["faults.0"][1]
    assert has_terms(fault, "at_s 1", "for_s 0.5", "kind gps_bias", "target drone1", "value_m [3, 0, 0]")


def test_named_items_are_compared_by_name() -> None:
    one = dict(
        flattened({"drones": [{"name": "a", "x": 1}, {"name": "b", "x": 2}], "list": [1, 2], "map": {"k": None}})
    )
    assert one == {"drones.a": THERE, "drones.a.name": "a", "drones.a.x": 1, "drones.b": THERE, "drones.b.name": "b",
                   "drones.b.x": 2, "list": [1, 2], "map.k": None}  # fmt: skip


def test_notes_report_what_only_some_runs_have(runs: list[Path], tmp_path: Path) -> None:
    end = record(tmp_path / "short", Flown(duration_s=3.0, overrides=(WINDOW,), end=None))
    data = (runs[0] / "run.mcap").read_bytes()
    (tmp_path / "cut").mkdir()
    (tmp_path / "cut" / "run.mcap").write_bytes(data[: len(data) // 2])
    text = "\n".join(notes(judged([*runs, end, tmp_path / "cut"])))
    for terms in (
        ("main", "calm", "rough", "short", "cut"),
        ("windows", "calm", "2", "9.98"),
        ("short", "end"),
        ("cut", "record", "cut"),
    ):
        assert has_terms(text, *terms)
    assert not has_terms(text, "bit-identical")
    assert has_terms("\n".join(notes(twins(tmp_path, runs[0]))), "a/calm", "b/calm", "bit-identical")


def twins(folder: Path, run: Path) -> list[ComparedRun]:
    for name in ("a", "b"):
        (folder / name / "calm").mkdir(parents=True)
        (folder / name / "calm" / "run.mcap").write_bytes((run / "run.mcap").read_bytes())
    return judged([folder / "a" / "calm", folder / "b" / "calm"])


def test_notes_report_drones_of_only_one_run(runs: list[Path], tmp_path: Path) -> None:
    other = "drones=[{name: drone1, position_m: [0, 1.5, 0]}, {name: x, position_m: [5, 5, 0]}, {name: y, position_m: [9, 9, 0]}]"
    members = "clusters.main.drones=[drone1, x, y]"
    record(tmp_path / "others", Flown(duration_s=4.0, overrides=(other, members)))
    both = judged([runs[0], tmp_path / "others"])
    text = "\n".join(notes(both))
    assert has_terms(text, "drone2", "drone3", "calm only")
    assert has_terms(text, "x", "y", "others only")
    names = {row.name for row in scenario_rows(both)}
    assert {"drones.drone2", "drones.x"} <= names
    assert not any(name.startswith("drones.x.") for name in names)


@pytest.mark.usefixtures("undrawn")
def test_a_comparison_of_other_runs_is_not_replaced(runs: list[Path], tmp_path: Path) -> None:
    for place in ("A/one", "B/two", "C/two", "B/one"):
        (tmp_path / place).mkdir(parents=True)
        (tmp_path / place / "run.mcap").write_bytes((runs[2] / "run.mcap").read_bytes())

    def page(*places: str) -> str:
        directories = [tmp_path / place for place in places]
        path = comparison_path(directories)
        compare(directories, path)
        return str(path.relative_to(tmp_path))

    assert page("A/one", "B/one") == "A/compare-A-one-B-one.html"
    assert page("A/one", "B/two") == "A/compare-one-two.html"
    assert page("A/one", "C/two") == "A/compare-one-two-2.html"
    assert page("A/one", "B/two") == "A/compare-one-two.html"
    assert page("A/one", "C/two") == "A/compare-one-two-2.html"


def test_names_of_runs_are_distinct(tmp_path: Path) -> None:
    assert run_names([Path("runs/a"), Path("runs/b")]) == ["a", "b"]
    assert run_names([Path("one/a"), Path("two/a")]) == ["one/a", "two/a"]
    assert run_names([tmp_path / "a", tmp_path / "a"]) == ["a (1)", "a (2)"]
    assert comparison_path([tmp_path / name for name in "abcde"]) == tmp_path / "compare-a-b-c-and-2-more.html"


def test_line_styles_are_distinct_without_colour() -> None:
    looks = [(str(run_style(i).dashes), run_style(i).marker) for i in range(len(STYLES))]
    assert len({dashes for dashes, _ in looks}) == len({marker for _, marker in looks}) == len(STYLES)
    assert len({(run_style(i).color, str(run_style(i).dashes)) for i in range(24)}) == 24


def test_the_figures_show_every_run(compared: list[ComparedRun]) -> None:
    calm, rough, alone = (
        replace(run, summary=msgspec.structs.replace(run.summary, as_planned=run is not compared[1]))
        for run in compared
    )
    four = [calm, rough, alone, replace(calm, name="calm again")]
    assert [run.label.endswith(UNPLANNED) for run in four] == [False, True, False, False]
    assert clusters(four) == ["main"]
    drawn = {figure.name: figure.drawing for figure in comparison_figures(four)}
    of_cluster = ["rms_main", "figure_5_errors_main_0", "figure_5_errors_main_1"]
    of_cluster += ["figure_6_position_main", "figure_7_orientation_main", "figure_8_shape_main"]
    assert list(drawn) == [f"{name}.png" for name in (*of_cluster, "plan_view", "drones")]
    for name, figure in drawn.items():
        assert figure.get_size_inches()[0] * figure.dpi >= 1000
        assert any(axes.has_data() for axes in figure.axes), name
        is_marked = any(UNPLANNED in each.get_text() for each in figure.findobj(Text))
        assert is_marked == (name != "figure_5_errors_main_1.png")  # the figure of the last two runs
    labels = [axes.get_xlabel() for axes in drawn["rms_main.png"].axes]
    assert [text.rpartition("(")[2] for text in labels] == ["m)", "rad)"]
    lanes, _, x_true, x_measured = drawn["figure_6_position_main.png"].axes[:4]
    assert [text.get_text() for text in lanes.get_yticklabels()] == [run.label for run in four]
    largest = [float(np.nanmax(np.abs(np.asarray(line.get_ydata()) - 5.0))) for line in x_true.lines[::2][:3]]
    assert [line.get_label() for line in x_true.lines[::2][:3]] == [four[i].label for i in (0, 1, 3)]
    assert largest == pytest.approx([ERRORS[0], 3 * ERRORS[0], ERRORS[0]], rel=1e-3)
    assert len(x_measured.lines) == 9  # measured, desired and engagement of three runs
    plans = [axes.get_title() for axes in drawn["plan_view.png"].axes]
    assert plans == [f"({letter}) {run.label}" for letter, run in zip("abcd", four, strict=True)]


def test_overlaid_runs_have_marks_in_their_colours(tmp_path: Path) -> None:
    """The first run has a fault, the second a collision; both take off."""
    fault = (event(6.0, 0, "fault"), event(8.0, 1, "fault_end"))
    flights = {
        "first": Flown(duration_s=12.0, overrides=(WINDOW,), climb_s=4.0, events=fault),
        "second": Flown(duration_s=12.0, overrides=(WINDOW,), climb_s=6.0, events=(event(9.0, 0, "collision"),)),
    }
    both = judged([record(tmp_path / name, flight) for name, flight in flights.items()])
    figure = next(each.drawing for each in comparison_figures(both) if each.name == "figure_6_position_main.png")
    lanes, _, curves = figure.axes[:3]
    assert [text.get_text() for text in lanes.get_yticklabels()] == [run.label for run in both]
    colours = [run_style(index).color for index in range(2)]
    assert [text.get_color() for text in lanes.get_yticklabels()] == colours
    pointed = [line for line in lanes.lines if line.get_marker() in POINTS.values()]
    marks = {(line.get_marker(), line.get_color()): np.asarray(line.get_xydata())[0].tolist() for line in pointed}
    assert marks[POINTS["take-off"], colours[0]] == pytest.approx([0.4, 0])
    later = marks[POINTS["take-off"], colours[1]]
    assert later == pytest.approx([0.6, 1], abs=0.03)  # one gate later, if 0.6 s is not a gate
    assert marks[POINTS["collision"], colours[1]] == [9.0, 1]
    assert (POINTS["collision"], colours[0]) not in marks
    bars = [bar for bar in lanes.collections if to_hex(np.asarray(bar.get_facecolor())[0]) == colours[0]]
    times = [np.asarray(path.vertices)[:, 0] for bar in bars for path in bar.get_paths()]
    assert (6.0, 8.0) in [(each.min(), each.max()) for each in times]
    drawn = [(line.get_color(), np.asarray(line.get_xdata())) for line in curves.lines]
    upright = {(colour, x[0]) for colour, x in drawn if len(set(x)) == 1}
    assert (colours[1], 9.0) in upright
    named = {text.get_text() for legend in figure.legends for text in legend.get_texts()}
    assert {"take-off", "collision", "fault", "engagement"} <= named


def event(t_s: float, seq: int, kind: str) -> Event:
    return Event(round(t_s * 1e9), seq, kind, "world", "drone1", kind, {"id": 1})


def test_the_page_is_one_file_that_needs_no_network(
    runs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def two(runs: list[ComparedRun]) -> Iterator[ReportFigure]:
        return (each for each in comparison_figures(runs) if each.name in ("rms_main.png", "drones.png"))

    monkeypatch.setattr("zsim_analysis.report.comparison.comparison_figures", two)
    out, steps = tmp_path / "sub" / "page.html", []
    compared = compare(runs, out, steps.append)
    text = out.read_text()
    assert [path.name for path in out.parent.iterdir()] == ["page.html"]
    pictures = re.findall(r"data:image/png;base64,([^\"]+)", text)
    assert len(pictures) == 2
    for each in pictures:
        picture = matplotlib.image.imread(io.BytesIO(base64.b64decode(each)))[:, :, :3]
        assert picture.shape[1] == 1432  # 7.16 in, the width of a page of a paper, at 200 pixels per inch
        assert 0.003 < (picture < 0.9).any(axis=2).mean() < 0.6
    assert not re.search(r"https?:|@import|url\(|<script", text)
    assert has_terms(text, "<title>calm", "rough", "alone", "comparison</title>")
    assert has_terms("\n".join(steps), "calm", "reading")
    for run in compared:
        assert run.summary.truth_sha256 in text


def test_a_run_not_flown_as_planned_is_marked_in_every_table(compared: list[ComparedRun]) -> None:
    bad = replace(compared[1], summary=msgspec.structs.replace(compared[1].summary, as_planned=False))
    good = replace(compared[0], summary=msgspec.structs.replace(compared[0].summary, as_planned=True))
    text = comparison_page([good, bad], [])
    heads = re.findall(r"<th[^>]*>((?:calm|rough)[^<]*)</th>", text)
    assert heads == ["calm", f"rough {UNPLANNED}"] * 3
    assert UNPLANNED not in comparison_page([good, replace(good, name="again")], [])
    many = [replace(compared[0], name=f"run{number}") for number in range(5)]  # more runs than fit a table
    tables = re.findall(r'<table class="numbers">.*?</table>', comparison_page(many, []), re.DOTALL)
    assert [len(re.findall(r'colspan="4"', each)) for each in tables] == [2, 2, 1]
    for each in tables:
        assert len(re.findall(r"<td", each)) % (1 + 4 * each.count('colspan="4"')) == 0


@pytest.mark.usefixtures("undrawn")
def test_figures_in_other_formats_are_in_a_folder_beside_the_page(runs: list[Path], tmp_path: Path) -> None:
    page = tmp_path / "page"  # a name without an extension is allowed
    compare(runs[:2], page, formats=["svg"])
    written = sorted(path.suffix for path in (tmp_path / "page-figures").iterdir())
    assert written == [".svg"]
    compare(runs[:2], page)
    assert list((tmp_path / "page-figures").iterdir()) == []
    assert page.is_file()


@pytest.mark.usefixtures("undrawn")
def test_the_command_writes_a_comparison_with_figures(runs: list[Path], tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["report", *map(str, runs[:2]), "--format", "pdf"])
    page = runs[0].parent / "compare-calm-rough.html"
    assert done.exit_code == 0, done.output
    shutil.rmtree(page.with_name("compare-calm-rough-figures"))
    assert done.stdout == f"report: {page}\n"
    page.unlink()
    alone = CliRunner().invoke(app, ["report", str(runs[0]), "--out", str(tmp_path / "x.html")])
    assert alone.exit_code == 2
    assert has_terms(" ".join(alone.output.replace("│", " ").split()), "--out", "leave")


@pytest.mark.usefixtures("undrawn")
def test_runs_that_cannot_be_compared_are_refused(runs: list[Path], tmp_path: Path) -> None:
    with refused(RecordError, "run.mcap", os.strerror(errno.ENOENT)):
        compare([runs[0], tmp_path], tmp_path / "page.html")
    (tmp_path / "file").write_text("in the way")
    with refused(ReportError, "page.html"):
        compare(runs[:2], tmp_path / "file" / "page.html")
    record = runs[0] / "run.mcap"
    before = record.read_bytes()
    with refused(ReportError, "run.mcap", "--out"):  # the target is not an earlier comparison
        compare(runs[:2], record)
    assert record.read_bytes() == before
    with pytest.raises(ReportError, match="calm: "):
        compare([runs[0], runs[1], runs[0]], tmp_path / "page.html")
