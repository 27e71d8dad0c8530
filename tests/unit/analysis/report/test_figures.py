"""Figures for a paper: few drones are drawn one by one, many as a spread; marks and ranges of the time axes."""

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import synthetic_record
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text
from msgspec.structs import replace
from synthetic_record import Flown

from zsim.contract.flight_messages import ClusterState
from zsim.contract.run_messages import Event, RadioLinks
from zsim.presentation import drone_colours
from zsim.scenario.scenario_file import resolve
from zsim.scenario.surroundings import packed
from zsim_analysis.reading.drone_errors import Distances, EstimateErrors, Separations, VelocityResponse
from zsim_analysis.reading.formation import Formation, ParameterErrors, formations_of, goal_errors
from zsim_analysis.reading.recorded_flight import RadioHistory, RecordedFlight
from zsim_analysis.report import FORMATS, make_report
from zsim_analysis.report.figure_style import (
    ALPHA,
    COLOURS,
    COLUMN_IN,
    DARK,
    FAULT,
    GRID,
    PAGE_IN,
    PAPER_PT,
    SPREAD_INSTANTS,
    WINDOW,
    WINDOW_GREY,
    ReportFigure,
    TimeMarks,
    draw_spread,
    new_figure,
    time_marks,
)
from zsim_analysis.report.flight_figures import (
    BAND_GREY,
    ROWS_MAX,
    curves,
    draw_distances,
    draw_drones,
    draw_errors,
    draw_estimates,
    draw_obstacles,
    draw_parameters,
    draw_plan,
    draw_radio,
    draw_velocities,
)
from zsim_analysis.report.make_report import figures, page
from zsim_analysis.report.summary import ClusterErrors, error_table, summarise

PAGE_HEIGHT_IN = 9.25  # text height of an IEEE page
READABLE_PT = 6.0  # smallest text in IEEE figures after reduction
WINDOW_S, MARKS = (4.0, 10.0), TimeMarks(1.0, 3.0)
T_S = np.arange(0.0, 12.0, 0.1)


def names(count: int) -> list[str]:
    return [f"drone{i + 1}" for i in range(count)]


def colours(count: int) -> dict[str, str]:
    return dict(zip(names(count), drone_colours(count), strict=True))


def estimates(count: int) -> dict[str, EstimateErrors]:
    rng, size = np.random.default_rng(3), (len(T_S), 4)
    return {
        name: EstimateErrors(T_S, 0.1 * rng.standard_normal(size), np.full(size, 0.1), rng.chisquare(6, len(T_S)))
        for name in names(count)
    }


def responses(count: int) -> dict[str, VelocityResponse]:
    rng, size = np.random.default_rng(4), (len(T_S), 4)
    return {name: VelocityResponse(T_S, np.zeros(size), rng.standard_normal(size)) for name in names(count)}


def apart(count: int) -> Distances:
    pairs = (("drone1", "drone2"), ("drone1", "drone3"), ("drone2", "drone3")) if count == 3 else ()
    return Distances(T_S, pairs, np.full((len(T_S), len(pairs)), 3.0), np.full((len(T_S), count), 3.0))


def large(count: int) -> Formation:
    """Return a formation of `count` drones in which variable k has an error of k · 10⁻³."""
    own = [f"{what}_{i}" for i in range(1, count) for what in ("w", "h", "v", "phi")]
    named = ("x_c", "y_c", "z_c", "roll", "pitch", "yaw", *own)[: 4 * count]
    error = np.tile(1e-3 * np.arange(len(named)), (len(T_S), 1)).astype(np.float64)
    desired = np.outer(T_S, np.arange(len(named), 0, -1.0))
    pair = (desired, desired + error, desired + error, error, error)
    return Formation("main", tuple(names(count)), named, T_S, *pair, ["engaged"] * len(T_S))


def radio(count: int) -> RadioHistory:
    """Return the links of `count` drones in a chain that breaks halfway through the run."""
    path = tuple(tuple(j for j in (i - 1, i + 1) if 0 <= j < count) for i in range(count))
    broken = ((), *path[1:])
    return RadioHistory([RadioLinks(round(t * 1e9), 0, path if t < T_S.mean() else broken) for t in T_S], count)


def test_the_radio_figure_shows_when_the_network_is_not_connected() -> None:
    figure = draw_radio(radio(3), names(3), MARKS)
    assert {"drone1", "drone2", "drone3", "not connected"} <= legend_of(figure)
    share = np.asarray(figure.axes[0].images[0].get_array())
    assert share[1, 0] == pytest.approx(100)
    assert 40 < share[0, 1] < 60


def legend_of(figure: Figure) -> set[str]:
    """Return the labels in the legends of a figure, which must be unique."""
    texts = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    assert len(set(texts)) == len(texts)
    return set(texts)


@pytest.mark.parametrize("count", [30, 100])
def test_figures_of_many_drones_have_unclipped_dots_and_a_legend(count: int) -> None:
    figure = draw_estimates(estimates(count), colours(count), WINDOW_S, MARKS)
    titles = [axes.get_title(loc="left") or axes.get_title() for axes in figure.axes]
    assert [title[:3] for title in titles] == ["(a)", "(b)", "(c)", "(d)"]
    dots = [dots for axes in (figure.axes[1], figure.axes[3]) for dots in axes.collections]
    assert len(dots) == 2
    assert not any(each.get_clip_on() for each in dots)
    assert {"σ as stated", "95 % of χ²", "median", "5 to 95 %"} < legend_of(figure)


def fits(figure: Figure) -> None:
    """Assert that a figure fits the page and that its text is neither too large nor too small."""
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


@pytest.mark.parametrize("count", [4, 100])  # the most drones with a column each, and drones drawn as a spread
def test_figures_of_drones_fit_a_page(count: int) -> None:
    for figure in (
        draw_estimates(estimates(count), colours(count), WINDOW_S, MARKS),
        draw_velocities(responses(count), colours(count), MARKS),
        draw_distances(apart(min(count, 3)), Separations(2.0, 1.5, 0.52), colours(count), MARKS),
        draw_radio(radio(count), names(count), MARKS),
    ):
        fits(figure)
        assert len(figure.axes) <= 20
        assert sum(len(axes.lines) for axes in figure.axes) < 100


def test_drones_have_their_colours_and_flown_curves_are_on_top() -> None:
    drawn = draw_velocities(responses(3), colours(3), MARKS)
    assert [axes.lines[0].get_color() for axes in drawn.axes[:3]] == list(colours(3).values())
    for axes in drawn.axes:
        order = {str(line.get_label()): line.get_zorder() for line in axes.lines}
        assert order["flown"] > order["commanded"]
    pairs = draw_distances(apart(3), Separations(None, None, None), colours(3), MARKS).axes[0].lines
    assert pairs[1].get_color() == colours(3)["drone1"]
    assert pairs[1].get_gapcolor() == colours(3)["drone3"]  # type: ignore[attr-defined]


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
    assert not any(axes.texts for axes in figure.axes)  # texts would cover the curves


def test_the_axes_of_estimates_include_all_errors_since_engagement() -> None:
    """A large error before the window belongs to the flight; one before the engagement is initial noise."""
    errors = estimates(3)
    first = errors["drone1"].error
    first[np.searchsorted(T_S, 3.5), 3], first[np.searchsorted(T_S, 0.5), 3] = 2.0, 50.0
    yaw = draw_estimates(errors, colours(3), WINDOW_S, MARKS).axes[3 * 3]
    assert 2.0 < yaw.get_ylim()[1] < 3.0


@pytest.mark.parametrize("count", [3, 30])
def test_the_time_axis_of_velocities_spans_the_run_with_its_marks(count: int) -> None:
    late = {name: VelocityResponse(*(each[T_S >= 5.0] for each in one)) for name, one in responses(count).items()}
    figure = draw_velocities(late, colours(count), replace(MARKS, span_s=(0.0, 20.0)))
    for axes in figure.axes:
        low, high = axes.get_xlim()
        assert -1.0 < low <= 0.0
        assert 20.0 <= high < 21.0
        along = [np.asarray(line.get_xdata()).tolist() for line in axes.lines]
        assert [each for each in along if len(each) == 2] == [[1.0, 1.0], [3.0, 3.0]]


@pytest.mark.parametrize("count", [4, 30])
def test_figures_of_formations_fit_a_page(count: int) -> None:
    formation = large(count)
    shape = list(formation.names[6:])
    for figure in (draw_errors(formation, WINDOW_S, MARKS), draw_parameters(formation, shape, MARKS)):
        fits(figure)
        assert len(figure.axes) <= 2 * ROWS_MAX


def test_errors_from_the_goal_are_beside_those_from_the_reference() -> None:
    flight = synthetic_record.flight(synthetic_record.traffic(Flown(duration_s=12.0, climb_s=4.0)))
    (formation,) = formations_of(flight)
    goal = goal_errors(formation, flight.scenario)
    row = 3 * formation.column("z_c")
    against_goal, against_reference = draw_errors(formation, WINDOW_S, MARKS, goal).axes[row : row + 2]
    assert against_goal.lines[1].get_ydata()[0] == pytest.approx(-15)  # type: ignore[index]
    assert np.abs(np.asarray(against_reference.lines[1].get_ydata())).max() < 1e-9
    assert len(draw_errors(formation, WINDOW_S, MARKS).axes) == 2 * len(formation.names)


def test_a_spread_keeps_every_extreme() -> None:
    rng = np.random.default_rng(2)
    values = rng.standard_normal((5 * SPREAD_INSTANTS + 3, 40))
    values[1234, 5], values[777, 6] = 50.0, -60.0
    axes = new_figure(COLUMN_IN, 2.0).subplots()
    draw_spread(axes, np.arange(len(values), dtype=float), values, "#000000")
    drawn = [np.asarray(each.get_ydata()) for each in axes.lines]
    assert (max(each.max() for each in drawn), min(each.min() for each in drawn)) == (50.0, -60.0)
    assert all(len(each) <= SPREAD_INSTANTS for each in drawn)


def test_a_large_formation_has_a_table_by_groups_and_a_full_one() -> None:
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


def test_vector_files_have_no_type_3_fonts_and_are_reproducible() -> None:
    def written() -> dict[str, bytes]:
        drawing = draw_distances(apart(3), Separations(2.0, 1.5, 0.52), colours(3), MARKS)
        return {form: ReportFigure("distances.png", "", "", drawing).vector(form) for form in FORMATS}

    files = written()
    assert files == written()
    assert files["pdf"].startswith(b"%PDF")
    assert b"/Type3" not in files["pdf"]
    size = re.search(rb'<svg [^>]*width="([\d.]+)pt"', files["svg"])
    assert size is not None
    assert float(size[1]) == pytest.approx(72 * COLUMN_IN)


def test_the_page_of_a_large_formation_ends_with_all_parameters() -> None:
    each = ParameterErrors(0.1, 0.1, 0.0, 0.2, 0.2, 0.0)
    flight = synthetic_record.flight(
        synthetic_record.traffic(Flown(duration_s=2.0, end={"reason": "over", "command_age_ms": None}))
    )
    summary = summarise(flight, formations_of(flight), Path())
    cluster = ClusterErrors(tuple(names(10)), dict.fromkeys(large(10).names, each))
    text = page(msgspec.structs.replace(summary, clusters={"main": cluster}), [])
    groups, figures, every = (text.index(mark) for mark in (">headings (rad)<", "<h2>Figures</h2>", ">phi_3 (rad)<"))
    assert groups < figures < every
    assert 'href="#all-main"' in text
    assert 'id="all-main"' in text


ROLL, ENGAGED_S = 3, 4.0
ROWS = ("t_s", "desired", "value", "true", "est_error", "true_error", "phases")  # fields with a row per instant
OBSTACLES = (
    "environment.obstacles=[{name: mast, shape: cylinder, position_m: [1, 2, 0], radius_m: 0.5, height_m: 9}, "
    "{name: wall, shape: box, position_m: [3, 3, 0], size_m: [4, 1, 2], yaw_deg: 30}]",
)
EVENTS = (
    Event(5 * 10**9, 0, "fault", "world", "drone2", "begins", {"id": 1}),
    Event(6 * 10**9, 1, "fault_end", "world", "drone2", "is over", {"id": 1}),
    Event(7 * 10**9, 2, "commander", "eve", "drone1", "eve flies drone1"),
    Event(8 * 10**9, 3, "release", "eve", "drone1", "released"),
)


def states(flown: Flown) -> Iterator[tuple[str, Any, int]]:
    """Yield a flight whose first estimates of roll wrap around, as noise makes them do in small formations."""
    for key, message, wall_ns in synthetic_record.traffic(flown):
        t_s = message.t_ns / 1e9
        if isinstance(message, ClusterState) and t_s < ENGAGED_S:
            noisy = list(message.value)
            noisy[ROLL] = (3.0, -1.5, -3.0, 1.5)[message.seq % 4] if t_s < 1 else 0.0
            phase = "assembling" if t_s >= 2 else "idle"
            message = msgspec.structs.replace(message, value=tuple(noisy), desired=tuple(noisy), phase=phase)
        yield key, message, wall_ns


@pytest.fixture(scope="module")
def flight() -> RecordedFlight:
    flown = Flown(duration_s=12.0, amplitude=np.full(12, 0.02), overrides=OBSTACLES, events=EVENTS)
    return synthetic_record.flight(states(flown))


@pytest.fixture(scope="module")
def formation(flight: RecordedFlight) -> Formation:
    """Return the flight's formation with only four variables: drawing all would test nothing more."""
    whole = formations_of(flight)[0]
    some = {
        name: getattr(whole, name)[:, : ROLL + 1] for name in ("desired", "value", "true", "est_error", "true_error")
    }
    return dataclasses.replace(whole, names=whole.names[: ROLL + 1], **some)


def test_angles_are_unwrapped_from_the_engagement_on(formation: Formation) -> None:
    assert formation.engaged_s == ENGAGED_S
    for line in curves(formation, "roll"):
        assert np.abs(line[formation.since_engaged]).max() < 0.1
        assert np.abs(line[~formation.since_engaged]).max() <= np.pi + 1e-9


def test_noise_before_the_engagement_does_not_set_the_scale(flight: RecordedFlight, formation: Formation) -> None:
    marks = time_marks(flight, formation)
    (axes,) = draw_parameters(formation, ["roll"], marks).axes
    assert max(map(abs, axes.get_ylim())) < 0.1
    whole = draw_errors(formation, (5.0, 11.0), marks).axes[2 * ROLL]
    assert max(map(abs, whole.get_ylim())) < 0.1


def test_marks_are_drawn_on_every_time_axis(flight: RecordedFlight, formation: Formation) -> None:
    marks = time_marks(flight, formation)
    assert [(band.kind, band.from_s, band.to_s) for band in marks.bands] == [
        ("fault", 5.0, 6.0),
        ("taken over", 7.0, 8.0),
        ("assembly", 2.0, pytest.approx(ENGAGED_S)),
    ]
    for figure in (
        draw_errors(formation, (0.0, 12.0), marks),
        draw_parameters(formation, ["x_c", "y_c"], marks),
        draw_drones(flight, marks),
    ):
        assert all(len(bands_of(figure, place)) >= 3 for place in range(len(figure.axes)))


def test_time_axes_span_the_run_except_that_of_the_window(flight: RecordedFlight, formation: Formation) -> None:
    marks = time_marks(flight, formation)
    assert marks.span_s == (0.0, 12.0)
    late = dataclasses.replace(formation, **{name: getattr(formation, name)[300:] for name in ROWS})
    whole, window = draw_errors(late, (8.0, 10.0), marks).axes[:2]
    assert whole.get_xlim() == pytest.approx((-0.12, 12.12))
    assert window.get_xlim() == pytest.approx((7.98, 10.02))


def test_the_statistics_beside_the_window_are_those_of_the_table(flight: RecordedFlight, formation: Formation) -> None:
    marks = time_marks(flight, formation)
    errors = formation.errors((2.0, 10.0))["roll"]
    est, true = (text.get_text() for text in draw_errors(formation, (2.0, 10.0), marks).axes[2 * ROLL + 1].texts)
    assert est.startswith(f"std {errors.est_std:.3g}\n")
    assert true.startswith(f"std {errors.true_std:.3g}\n")
    before = draw_errors(formation, (1.0, 3.0), marks).axes[2 * ROLL + 1].texts
    assert [text.get_text().split() for text in before] == [["not", "engaged"]] * 2


def flight_of(*events: Event) -> RecordedFlight:
    return synthetic_record.flight(states(Flown(duration_s=12.0, events=events)))


def spans(flight: RecordedFlight) -> list[tuple[str, float, float]]:
    return [(band.kind, band.from_s, band.to_s) for band in time_marks(flight).bands]


def seconds(t_s: float) -> int:
    return round(t_s * 1e9)


def test_overlapping_take_overs_and_faults_are_marked_once() -> None:
    """As with a console, each drone is acquired, flown and released; then the controller continues."""
    done = [
        Event(seconds(t_s + 0.5 * i), i, "control", "eve", op, "done", {"args": {"drone": f"drone{i + 1}"}, "ok": True})
        for t_s, op in ((5.0, "acquire"), (7.0, "release"))
        for i in range(3)
    ]
    refused = Event(seconds(9.0), 9, "control", "bob", "acquire", "no", {"args": {"drone": "drone1"}, "ok": False})
    assert spans(flight_of(*done, refused)) == [("taken over", 5.0, 8.0)]
    assert spans(flight_of(*done[:3])) == [("taken over", 5.0, 12.0)]
    faults = [Event(seconds(t_s), i, "fault", "world", "drone1", "", {"id": i}) for i, t_s in enumerate((5.0, 6.0))]
    ends = [Event(seconds(t_s), i, "fault_end", "world", "drone1", "", {"id": i}) for i, t_s in enumerate((7.0, 8.0))]
    assert spans(flight_of(*faults, *ends)) == [("fault", 5.0, 8.0)]


def test_the_restart_of_a_killed_process_ends_its_fault() -> None:
    kill = Event(seconds(5.0), 0, "fault", "world", "estimator.drone2", "killed", {"id": 1, "kind": "process_kill"})
    done = {"done_ns": seconds(5.02)}
    back = Event(seconds(5.14), 1, "restart", "estimator.drone2", "estimator.drone2", "", done)
    other = Event(seconds(5.1), 1, "restart", "estimator.drone1", "estimator.drone1", "", done)
    flight = flight_of(kill, back)
    assert spans(flight) == [("fault", 5.0, 5.02)]
    assert spans(flight_of(kill, other)) == [("fault", 5.0, 12.0)]
    (axes,) = draw_parameters(formations_of(flight)[0], ["x_c"], time_marks(flight)).axes
    lines = [line for line in axes.lines if line.get_color() == COLOURS[FAULT]]
    (x,) = (float(np.asarray(line.get_xdata())[0]) for line in lines)
    assert x == pytest.approx(5.01)  # a band of 0.02 s is visible only as a line


def test_bands_are_in_the_legend_truth_is_on_top_and_panels_have_letters(flight: RecordedFlight) -> None:
    (formation,) = formations_of(flight)
    marks = time_marks(flight, formation)
    kinds = {band.kind for band in marks.bands}
    goal = goal_errors(formation, flight.scenario)
    assert goal is not None
    unknown = goal._replace(goal=np.full_like(goal.goal, np.nan))  # nothing is drawn in the first column
    for figure, more in (
        (draw_errors(formation, (5.0, 11.0), marks, unknown), {WINDOW, "true", "measured (estimates)"}),
        (draw_parameters(formation, ["x_c", "y_c"], marks), {"true", "measured", "desired"}),
        (draw_drones(flight, marks), set[str]()),
    ):
        assert kinds | more <= legend_of(figure)
    errors, position = draw_errors(formation, (5.0, 11.0), marks), draw_parameters(formation, ["x_c", "y_c"], marks)
    for axes in (errors.axes[0], position.axes[0]):
        order = {str(line.get_label()).split()[0]: line.get_zorder() for line in axes.lines}
        assert order["true"] > order["measured"]
    assert [axes.get_title()[:4] for axes in errors.axes[:2]] == ["(a) ", "(b) "]
    assert [axes.get_title(loc="left") for axes in position.axes] == ["(a)", "(b)"]
    assert draw_parameters(formation, ["roll"], marks).axes[0].get_title(loc="left") == ""


def test_greys_are_distinguishable() -> None:
    """Window, grid, band of an estimate and lines differ by about a tenth of the range from black to white."""
    greys = sorted(float(np.mean(to_rgb(colour))) for colour in ("#ffffff", WINDOW_GREY, GRID, BAND_GREY, DARK))
    assert min(np.diff(greys)) > 0.06


def test_captions_name_the_paper_only_for_its_own_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    for draw in ("draw_errors", "draw_parameters"):
        monkeypatch.setattr(make_report, draw, lambda *_: new_figure(COLUMN_IN, 1.0))

    def titles(*events: Event, overrides: tuple[str, ...] = ()) -> list[str]:
        end = {"reason": "over", "command_age_ms": None}  # with it, no record is read
        flown = synthetic_record.flight(states(Flown(duration_s=12.0, events=events, overrides=overrides, end=end)))
        summary = summarise(flown, formations_of(flown), Path())
        return [each.title for each in figures(flown, formations_of(flown), summary)]

    assert any("Figure 5" in title for title in titles())
    acquired = Event(seconds(5.0), 0, "control", "eve", "acquire", "", {"args": {"drone": "drone1"}, "ok": True})
    for other in (titles(acquired), titles(EVENTS[0]), titles(overrides=("environment.wind.gust_m_s=2",))):
        assert "Formation parameters' errors" in other
        assert not any("paper" in title for title in other)


def bands_of(figure: Figure, place: int) -> list[Any]:
    return [patch for patch in figure.axes[place].patches if patch.get_alpha() == pytest.approx(ALPHA)]


def test_the_plan_view_draws_surfaces_with_the_highest_on_top() -> None:
    low, high = [0, 0, 0, 2, 0, 0, 0, 1, 0], [0, 0, 3, 2, 0, 3, 0, 1, 3]
    roof = {"name": "roof", "triangles": packed(np.array([high, low], float)), "position_m": [5, 6, 0]}
    drones = [{"name": "drone1", "position_m": [0, 0, 0]}]
    document = {"name": "roof", "duration_s": 1, "drones": drones, "environment": {"surfaces": [roof]}}
    axes = Figure().subplots()
    draw_obstacles(axes, resolve(document))
    drawn: Any = axes.collections[0]
    assert [path.vertices[0].tolist() for path in drawn.get_paths()] == [[5.0, 6.0]] * 2
    assert drawn.get_array().tolist() == [0.0, 3.0]


def test_the_plan_view_draws_obstacles(flight: RecordedFlight, formation: Formation) -> None:
    (axes,) = draw_plan(flight, [formation]).axes
    assert [type(patch).__name__ for patch in axes.patches][:2] == ["Circle", "Rectangle"]
    ends = [line for line in axes.lines if line.get_marker() in ("s", "o")]
    assert len(ends) == 6
    assert not any(line.get_clip_on() for line in ends)
