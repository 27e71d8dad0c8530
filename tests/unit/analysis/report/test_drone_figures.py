"""Figures for a paper: of few drones one by one, of many as their spread; each fits the page of a conference paper."""

import re
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import synthetic_record
from matplotlib.figure import Figure
from matplotlib.text import Text
from msgspec.structs import replace
from synthetic_record import Flown

from zsim.presentation import drone_colours
from zsim_analysis.reading.distances import Distances, Separations
from zsim_analysis.reading.drone_errors import EstimateErrors, VelocityResponse
from zsim_analysis.reading.flight import FlightReader
from zsim_analysis.reading.formation import Formation, ParameterErrors, formations_of
from zsim_analysis.reading.goal import goal_errors
from zsim_analysis.report import FORMATS
from zsim_analysis.report.figures.estimate_figures import draw_estimates
from zsim_analysis.report.figures.formation_figures import ROWS_MAX, draw_errors, draw_parameters
from zsim_analysis.report.figures.motion_figures import draw_distances, draw_velocities
from zsim_analysis.report.figures.spread import INSTANTS, draw_spread
from zsim_analysis.report.figures.time_marks import TimeMarks
from zsim_analysis.report.make_report import page
from zsim_analysis.report.pages import COLUMN_IN, PAGE_IN, PAPER_PT, ReportFigure, new_figure
from zsim_analysis.report.summary import ClusterErrors, summarise
from zsim_analysis.report.tables import error_table

PAGE_HEIGHT_IN = 9.25  # of the text of an IEEE page
READABLE_PT = 6.0  # least size of text in IEEE's figures after reduction
WINDOW_S, MARKS = (4.0, 10.0), TimeMarks(1.0, 3.0)
T_S = np.arange(0.0, 12.0, 0.1)


def names(count: int) -> list[str]:
    return [f"drone{i + 1}" for i in range(count)]


def colours(count: int) -> dict[str, str]:
    return dict(zip(names(count), drone_colours(count), strict=True))


def estimates(count: int) -> dict[str, EstimateErrors]:
    rng = np.random.default_rng(3)
    size = (len(T_S), 4)
    return {
        name: EstimateErrors(T_S, 0.1 * rng.standard_normal(size), np.full(size, 0.1), rng.chisquare(6, len(T_S)))
        for name in names(count)
    }


def responses(count: int) -> dict[str, VelocityResponse]:
    rng = np.random.default_rng(4)
    size = (len(T_S), 4)
    return {name: VelocityResponse(T_S, np.zeros(size), rng.standard_normal(size)) for name in names(count)}


def apart(count: int) -> Distances:
    ones = np.ones((len(T_S), count))
    if count == 3:
        return Distances(T_S, (("drone1", "drone2"), ("drone1", "drone3"), ("drone2", "drone3")), 3 * ones, 3 * ones)
    return Distances(T_S, (), np.zeros((len(T_S), 0)), 3 * ones)


def large(count: int) -> Formation:
    """Return a formation of so many drones whose variables err by their number in millimetres."""
    own = [f"{what}_{i}" for i in range(1, count) for what in ("w", "h", "v", "phi")]
    named = ("x_c", "y_c", "z_c", "roll", "pitch", "yaw", *own)[: 4 * count]
    error = np.tile(1e-3 * np.arange(len(named)), (len(T_S), 1)).astype(np.float64)
    desired = np.outer(T_S, np.arange(len(named), 0, -1.0))
    pair = (desired, desired + error, desired + error, error, error)
    return Formation("main", tuple(names(count)), named, T_S, *pair, ["engaged"] * len(T_S))


def legend_of(figure: Figure) -> set[str]:
    """Return what the legend above a figure names, each once."""
    texts = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    assert len(set(texts)) == len(texts)
    return set(texts)


def test_what_was_flown_lies_over_what_was_commanded() -> None:
    for axes in draw_velocities(responses(3), colours(3), MARKS).axes:
        order = {str(line.get_label()): line.get_zorder() for line in axes.lines}
        assert order["flown"] > order["commanded"]


@pytest.mark.parametrize("count", [30, 100])
def test_marks_of_many_drones_are_whole_and_named(count: int) -> None:
    figure = draw_estimates(estimates(count), colours(count), WINDOW_S, MARKS)
    titles = [axes.get_title(loc="left") or axes.get_title() for axes in figure.axes]
    assert [title[:3] for title in titles] == ["(a)", "(b)", "(c)", "(d)"]
    dots = [dots for axes in (figure.axes[1], figure.axes[3]) for dots in axes.collections]
    assert len(dots) == 2
    assert not any(each.get_clip_on() for each in dots)
    assert {"σ as stated", "95 % of χ²", "median", "5 to 95 %"} < legend_of(figure)


def fits(figure: Figure) -> None:
    """Judge that a figure fits the page, and that its text is neither too large nor too small for it."""
    width, height = figure.get_size_inches()
    assert width in (COLUMN_IN, PAGE_IN)
    assert height <= PAGE_HEIGHT_IN
    figure.draw_without_rendering()
    sizes = {float(text.get_fontsize()) for text in figure.findobj(Text) if isinstance(text, Text) and text.get_text()}
    assert READABLE_PT <= min(sizes) <= max(sizes) <= PAPER_PT
    box = figure.bbox
    for legend in figure.legends:
        extent = legend.get_window_extent()
        assert box.x0 - 1 <= extent.x0 <= extent.x1 <= box.x1 + 1


@pytest.mark.parametrize("count", [2, 3, 4, 30, 100])
def test_figures_of_drones_fit_a_page(count: int) -> None:
    for figure in (
        draw_estimates(estimates(count), colours(count), WINDOW_S, MARKS),
        draw_velocities(responses(count), colours(count), MARKS),
        draw_distances(apart(count), Separations(2.0, 1.5, 0.52), colours(count), MARKS),
    ):
        fits(figure)
        assert len(figure.axes) <= 20
        assert sum(len(axes.lines) for axes in figure.axes) < 100


def test_few_drones_have_a_column_each_with_band_and_nees() -> None:
    figure = draw_estimates(estimates(3), colours(3), WINDOW_S, MARKS)
    assert len(figure.axes) == 5 * 3
    titles = [axes.get_title(loc="left") for axes in figure.axes[:3]]
    assert titles == ["(a) drone1", "(b) drone2", "(c) drone3"]
    assert {"±2σ as stated", "95 % of χ²", "estimate − truth", "take-off", "engagement"} == legend_of(figure)
    for axes in figure.axes[: 4 * 3]:
        assert len(axes.collections) == 1  # the band
        assert "2σ" in axes.get_title(loc="right")
    assert all(axes.get_yscale() == "log" for axes in figure.axes[4 * 3 :])
    assert not any(axes.texts for axes in figure.axes)  # which would stand upon the curves


def test_the_axes_of_estimates_hold_all_since_the_engagement() -> None:
    """An error that is large before the window belongs to the flight; one before the engagement is the start's noise."""
    errors = estimates(3)
    first = errors["drone1"].error
    first[np.searchsorted(T_S, 3.5), 3], first[np.searchsorted(T_S, 0.5), 3] = 2.0, 50.0
    yaw = draw_estimates(errors, colours(3), WINDOW_S, MARKS).axes[3 * 3]
    assert 2.0 < yaw.get_ylim()[1] < 3.0


@pytest.mark.parametrize("count", [3, 30])
def test_the_time_axis_of_velocities_is_that_of_the_run_with_its_marks(count: int) -> None:
    late = {name: VelocityResponse(*(each[T_S >= 5.0] for each in one)) for name, one in responses(count).items()}
    figure = draw_velocities(late, colours(count), replace(MARKS, span_s=(0.0, 20.0)))
    for axes in figure.axes:
        low, high = axes.get_xlim()
        assert -1.0 < low <= 0.0
        assert 20.0 <= high < 21.0
        along = [np.asarray(line.get_xdata()).tolist() for line in axes.lines]
        assert [each for each in along if len(each) == 2] == [[1.0, 1.0], [3.0, 3.0]]


def test_a_drone_is_drawn_in_its_colour() -> None:
    drawn = draw_velocities(responses(3), colours(3), MARKS)
    assert [axes.lines[0].get_color() for axes in drawn.axes[:3]] == list(colours(3).values())
    pairs = draw_distances(apart(3), Separations(None, None, None), colours(3), MARKS).axes[0].lines
    assert pairs[1].get_color() == colours(3)["drone1"]
    assert pairs[1].get_gapcolor() == colours(3)["drone3"]  # type: ignore[attr-defined]


@pytest.mark.parametrize("count", [4, 30])
def test_figures_of_formations_fit_a_page(count: int) -> None:
    formation = large(count)
    shape = list(formation.names[6:])
    for figure in (draw_errors(formation, WINDOW_S, MARKS), draw_parameters(formation, shape, MARKS)):
        fits(figure)
        assert len(figure.axes) <= 2 * ROWS_MAX


def test_the_goal_stands_beside_the_reference() -> None:
    reader = FlightReader()
    for key, message, wall_ns in synthetic_record.traffic(Flown(duration_s=12.0, climb_s=4.0)):
        reader.add_message(key, message, wall_ns)
    flight = reader.flight()
    (formation,) = formations_of(flight)
    goal = goal_errors(formation, flight.scenario)
    row = 3 * formation.column("z_c")
    against_goal, against_reference = draw_errors(formation, WINDOW_S, MARKS, goal).axes[row : row + 2]
    assert against_goal.lines[1].get_ydata()[0] == pytest.approx(-15)  # type: ignore[index]
    assert np.abs(np.asarray(against_reference.lines[1].get_ydata())).max() < 1e-9
    assert len(draw_errors(formation, WINDOW_S, MARKS).axes) == 2 * len(formation.names)


def test_a_spread_keeps_every_extreme() -> None:
    rng = np.random.default_rng(2)
    values = rng.standard_normal((5 * INSTANTS + 3, 40))
    values[1234, 5], values[777, 6] = 50.0, -60.0
    axes = new_figure(COLUMN_IN, 2.0).subplots()
    draw_spread(axes, np.arange(len(values), dtype=float), values, "#000000")
    drawn = [np.asarray(each.get_ydata()) for each in axes.lines]
    assert (max(each.max() for each in drawn), min(each.min() for each in drawn)) == (50.0, -60.0)
    assert all(len(each) <= INSTANTS for each in drawn)


def test_a_large_formation_has_a_table_by_groups_first() -> None:
    each = [ParameterErrors(0.1, 0.1, 0.0, 0.2, 0.01 * i, 0.0) for i in range(40)]
    named = [*large(10).names]
    table = error_table(ClusterErrors(tuple(names(10)), dict(zip(named, each, strict=True))))
    rows = {row[0]: row[1:] for row in table.rows}
    assert rows["position (m)"] == ["3", "0.1000", f"{np.sqrt(5e-4 / 3):.4f}", "0.0200", "z_c"]
    assert sum(int(row[0]) for row in rows.values()) == 40
    assert table.rest is not None
    assert [row[0].split(" ")[0] for row in table.rest.rows] == named
    few = error_table(ClusterErrors(tuple(names(3)), dict(zip(named[:12], each, strict=False))))
    assert few.rest is None


def written(figure: Any) -> dict[str, bytes]:
    return {form: figure.vector(form) for form in FORMATS}


def test_vector_files_have_true_fonts_and_the_same_bytes_each_time() -> None:
    def figure() -> ReportFigure:
        drawing = draw_distances(apart(3), Separations(2.0, 1.5, 0.52), colours(3), MARKS)
        return ReportFigure("distances.png", "", "", drawing)

    files = written(figure())
    assert files == written(figure())
    assert files["pdf"].startswith(b"%PDF")
    assert b"/Type3" not in files["pdf"]
    size = re.search(rb'<svg [^>]*width="([\d.]+)pt"', files["svg"])
    assert size is not None
    assert float(size[1]) == pytest.approx(72 * COLUMN_IN)


def test_a_page_of_a_large_formation_has_all_its_parameters_behind_the_figures() -> None:
    each = ParameterErrors(0.1, 0.1, 0.0, 0.2, 0.2, 0.0)
    reader = FlightReader()
    for key, message, wall_ns in synthetic_record.traffic(
        Flown(duration_s=2.0, end={"reason": "over", "command_age_ms": None})
    ):
        reader.add_message(key, message, wall_ns)
    flight = reader.flight()
    summary = summarise(flight, formations_of(flight), Path())
    cluster = ClusterErrors(tuple(names(10)), dict.fromkeys(large(10).names, each))
    text = page(msgspec.structs.replace(summary, clusters={"main": cluster}), [])
    groups, figures, every = (text.index(mark) for mark in (">headings (rad)<", "<h2>Figures</h2>", ">phi_3 (rad)<"))
    assert groups < figures < every
    assert 'href="#all-main"' in text
    assert 'id="all-main"' in text
