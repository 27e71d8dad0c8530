"""Figures over time: angles from the engagement on, axes that noise before it does not set, marks on every axis."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pytest
import synthetic_record
from matplotlib.figure import Figure
from synthetic_record import Flown

from zsim.contract.flight_messages import ClusterState
from zsim.contract.run_messages import Event
from zsim_analysis.reading.flight import FlightReader
from zsim_analysis.reading.formation import Formation, formations_of
from zsim_analysis.reading.recorded_flight import RecordedFlight
from zsim_analysis.report.figures.drone_panels import draw_drones
from zsim_analysis.report.figures.formation_figures import curves, draw_errors, draw_parameters
from zsim_analysis.report.figures.plan_view import draw_plan
from zsim_analysis.report.figures.time_marks import time_marks

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


def bands_of(figure: Figure, place: int) -> list[Any]:
    return [patch for patch in figure.axes[place].patches if patch.get_alpha() == pytest.approx(0.16)]


def test_obstacles_stand_in_the_plan_view(flight: RecordedFlight, formation: Formation) -> None:
    (axes,) = draw_plan(flight, [formation]).axes
    assert [type(patch).__name__ for patch in axes.patches][:2] == ["Circle", "Rectangle"]
