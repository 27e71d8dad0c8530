"""Figures over time: angles from the engagement on, axes that noise before it does not set, marks on every axis."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import synthetic_record
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from synthetic_record import Flown

from zsim.contract.flight_messages import ClusterState
from zsim.contract.run_messages import Event
from zsim_analysis.reading.flight import FlightReader
from zsim_analysis.reading.formation import Formation, formations_of
from zsim_analysis.reading.goal import goal_errors
from zsim_analysis.reading.recorded_flight import RecordedFlight
from zsim_analysis.report.figures.drone_panels import draw_drones
from zsim_analysis.report.figures.estimate_figures import BAND_GREY
from zsim_analysis.report.figures.formation_figures import curves, draw_errors, draw_parameters
from zsim_analysis.report.figures.plan_view import draw_plan
from zsim_analysis.report.figures.report_figures import figures
from zsim_analysis.report.figures.time_marks import (
    ALPHA,
    COLOURS,
    FAULT,
    WINDOW,
    WINDOW_GREY,
    time_marks,
)
from zsim_analysis.report.pages import DARK, GRID
from zsim_analysis.report.summary import summarise

ROLL, ENGAGED_S = 3, 4.0
ROWS = ("t_s", "desired", "value", "true", "est_error", "true_error", "phases")  # of a formation, an instant each
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
    """Yield a flight whose first estimates turn roll by whole rounds, as noise does with small formations."""
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
    reader = FlightReader()
    for key, message, wall_ns in states(flown):
        reader.add_message(key, message, wall_ns)
    return reader.flight()


@pytest.fixture(scope="module")
def formation(flight: RecordedFlight) -> Formation:
    return formations_of(flight)[0]


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


def test_marks_stand_on_every_time_axis(flight: RecordedFlight, formation: Formation) -> None:
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


def test_time_axes_are_those_of_the_run_but_for_that_of_the_window(
    flight: RecordedFlight, formation: Formation
) -> None:
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
    reader = FlightReader()
    for key, message, wall_ns in states(Flown(duration_s=12.0, events=events)):
        reader.add_message(key, message, wall_ns)
    return reader.flight()


def spans(flight: RecordedFlight) -> list[tuple[str, float, float]]:
    return [(band.kind, band.from_s, band.to_s) for band in time_marks(flight).bands]


def seconds(t_s: float) -> int:
    return round(t_s * 1e9)


def test_a_take_over_of_all_drones_is_marked_once_from_acquisition_to_release() -> None:
    """As a console does it: each drone is acquired, flown, and released again; the controller goes on."""
    done = [
        Event(seconds(t_s + 0.5 * i), i, "control", "eve", op, "done", {"args": {"drone": f"drone{i + 1}"}, "ok": True})
        for t_s, op in ((5.0, "acquire"), (7.0, "release"))
        for i in range(3)
    ]
    refused = Event(seconds(9.0), 9, "control", "bob", "acquire", "no", {"args": {"drone": "drone1"}, "ok": False})
    assert spans(flight_of(*done, refused)) == [("taken over", 5.0, 8.0)]
    assert spans(flight_of(*done[:3])) == [("taken over", 5.0, 12.0)]


def test_a_killed_process_that_is_back_ends_its_fault() -> None:
    kill = Event(seconds(5.0), 0, "fault", "world", "estimator.drone2", "killed", {"id": 1, "kind": "process_kill"})
    done = {"done_ns": seconds(5.02)}
    back = Event(seconds(5.14), 1, "restart", "estimator.drone2", "estimator.drone2", "", done)
    other = Event(seconds(5.1), 1, "restart", "estimator.drone1", "estimator.drone1", "", done)
    flight = flight_of(kill, back)
    assert spans(flight) == [("fault", 5.0, 5.02)]
    assert spans(flight_of(kill, other)) == [("fault", 5.0, 12.0)]
    (axes,) = draw_parameters(formations_of(flight)[0], ["x_c"], time_marks(flight)).axes
    lines = [line for line in axes.lines if line.get_color() == COLOURS[FAULT]]
    assert [float(np.asarray(line.get_xdata())[0]) for line in lines] == [
        pytest.approx(5.01)
    ]  # of .02 s nothing else is seen


def test_faults_that_overlap_are_one_band() -> None:
    faults = [Event(seconds(t_s), i, "fault", "world", "drone1", "", {"id": i}) for i, t_s in enumerate((5.0, 6.0))]
    ends = [Event(seconds(t_s), i, "fault_end", "world", "drone1", "", {"id": i}) for i, t_s in enumerate((7.0, 8.0))]
    assert spans(flight_of(*faults, *ends)) == [("fault", 5.0, 8.0)]


def test_every_band_has_its_entry_in_the_legend(flight: RecordedFlight, formation: Formation) -> None:
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
        named = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
        assert kinds | more <= set(named)
        assert len(set(named)) == len(named)


def test_truth_lies_over_estimates_and_panels_have_letters(flight: RecordedFlight, formation: Formation) -> None:
    marks = time_marks(flight, formation)
    errors, position = draw_errors(formation, (5.0, 11.0), marks), draw_parameters(formation, ["x_c", "y_c"], marks)
    for axes in (errors.axes[0], position.axes[0]):
        order = {str(line.get_label()).split()[0]: line.get_zorder() for line in axes.lines}
        assert order["true"] > order["measured"]
    assert [axes.get_title()[:4] for axes in errors.axes[:2]] == ["(a) ", "(b) "]
    assert [axes.get_title(loc="left") for axes in position.axes] == ["(a)", "(b)"]
    assert draw_parameters(formation, ["roll"], marks).axes[0].get_title(loc="left") == ""


def test_greys_are_told_apart() -> None:
    """Of window, grid, band of an estimate, and lines: each is a tenth of the way from black to white from the next."""
    greys = sorted(float(np.mean(to_rgb(colour))) for colour in ("#ffffff", WINDOW_GREY, GRID, BAND_GREY, DARK))
    assert min(np.diff(greys)) > 0.06


def test_captions_name_the_paper_beside_its_tests_alone(flight: RecordedFlight, formation: Formation) -> None:
    def titles(*events: Event, overrides: tuple[str, ...] = ()) -> list[str]:
        reader = FlightReader()
        end = {"reason": "over", "command_age_ms": None}  # with which no record is looked into
        for key, message, wall_ns in states(Flown(duration_s=12.0, events=events, overrides=overrides, end=end)):
            reader.add_message(key, message, wall_ns)
        flown = reader.flight()
        summary = summarise(flown, formations_of(flown), Path())
        return [each.title for each in figures(flown, formations_of(flown), summary)]

    assert any("Figure 5" in title for title in titles())
    acquired = Event(seconds(5.0), 0, "control", "eve", "acquire", "", {"args": {"drone": "drone1"}, "ok": True})
    for other in (titles(acquired), titles(EVENTS[0]), titles(overrides=("environment.wind.gust_m_s=2",))):
        assert "Formation parameters' errors" in other
        assert not any("paper" in title for title in other)


def bands_of(figure: Figure, place: int) -> list[Any]:
    return [patch for patch in figure.axes[place].patches if patch.get_alpha() == pytest.approx(ALPHA)]


def test_obstacles_stand_in_the_plan_view(flight: RecordedFlight, formation: Formation) -> None:
    (axes,) = draw_plan(flight, [formation]).axes
    assert [type(patch).__name__ for patch in axes.patches][:2] == ["Circle", "Rectangle"]
    ends = [line for line in axes.lines if line.get_marker() in ("s", "o")]
    assert len(ends) == 6
    assert not any(line.get_clip_on() for line in ends)
