"""Trails and curves: how far back they go, what a record adds, and how plots show them."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_gui import Gui

from zsim.contract.flight_messages import EstimateView
from zsim.math import frames
from zsim.scenario import scenario_file
from zsim_bridges.console.histories import (
    HISTORY_POINTS_MAX,
    INTERVAL_S,
    SPACING_M,
    SPAN_S,
    STEPS_PER_WINDOW,
    TRAIL_POINTS_MAX,
    TRAILS_S,
    WINDOWS_S,
    AxisRange,
    CanvasTrails,
    FlightHistory,
    VariableHistory,
    VariablePlots,
)
from zsim_bridges.console.picture import DronePoses

CLUSTER = scenario_file.load(Path(__file__).parents[4] / "scenarios" / "step.yaml").clusters[0]
NAMES = ("x_c", "y_c", "z_c", "p")

# Trails


def test_a_trail_has_the_chosen_length():
    trails = CanvasTrails(2)
    for k in range(300):
        trails.add(k * 0.5, np.array([(k * 2 * SPACING_M, 0.0, 1.0), (5.0, 5.0, 1.0)]))
    now = np.array([(1000.0, 0.0, 1.0), (5.0, 5.0, 1.0)])
    for length_s in TRAILS_S[:3]:
        number = trails.number
        trails.choose_length(length_s)
        assert trails.number != number  # a map with trails of the old length requests them again
        segments, whose, since_s = trails.segments(150.0, now)
        assert set(whose) == {0}  # a drone that does not move has no trail
        assert len(segments) == 2 * length_s
        assert since_s[0] == 150.0 - length_s
        assert segments[0, 0, 0] == pytest.approx(2 * (150.0 - length_s) * 2 * SPACING_M)
        assert segments[-1, 1].tolist() == [1000.0, 0.0, 1.0]


def test_an_absent_drone_has_no_trail():
    trails = CanvasTrails(2)
    nowhere = (np.nan, np.nan, np.nan)
    for k in range(5):
        trails.add(k * 1.0, np.array([(float(k), 0.0, 1.0), nowhere]))
    segments, whose, _ = trails.segments(5.0, np.array([(9.0, 0.0, 1.0), nowhere]))
    assert whose.tolist() == [0] * 5
    assert np.isfinite(segments).all()
    trails.add(0.0, np.zeros((2, 3)))  # going back in time clears the trails
    assert trails.segments(0.0, np.zeros((2, 3)))[0].shape == (0, 2, 3)


@pytest.mark.parametrize("count", [3, 50])
def test_long_trails_are_thinned_out_consistently(count: int):
    trails = CanvasTrails(count)
    trails.choose_length(180.0)
    kept: list[set[float]] = []
    for k in range(3600):
        trails.add(k * 0.05, np.full((count, 3), k * 1.0))
        if k in (3500, 3502):
            segments, _, since_s = trails.segments(k * 0.05, np.full((count, 3), k * 1.0))
            assert 0.4 * TRAIL_POINTS_MAX < len(segments) <= TRAIL_POINTS_MAX + count
            kept.append(set(since_s))
    assert len(kept[0] ^ kept[1]) <= 3


def test_trails_of_a_record_cover_all_pieces_that_were_read():
    trails, here = CanvasTrails(1, is_replay=True), np.array([(100.0, 0.0, 1.0)])
    for t_s in (*np.arange(60.0, 80.0, 0.25), *np.arange(0.0, 20.0, 0.25)):  # one piece, then an earlier one
        trails.add(t_s, np.array([(t_s, 0.0, 1.0)]))
    trails.choose_length(30.0)
    for at_s in (79.9, 19.9):
        segments, _, since_s = trails.segments(at_s, here)
        assert len(segments) > 70
        assert since_s.min() >= at_s - 30.0
    assert trails.segments(45.0, here)[0][:, 1, 0].max() < 20.0  # no line crosses the gap that was not read
    trails.keep(50.0, 70.0)
    assert len(trails.segments(19.9, here)[0]) == 0


# Curves


def curve(*points: tuple[float, float, float, Any], is_replay: bool = False) -> VariableHistory:
    """Return the history of one variable, with points (t [s], desired, estimated, true)."""
    history = VariableHistory(1, is_replay)
    for t_s, desired, estimated, true in points:
        history.add(t_s, (desired,), (estimated,), None if true is None else np.array([true]))
    return history


def test_curves_of_a_record_surround_the_shown_instant():
    pieces = (*np.arange(100.0, 110.0, INTERVAL_S), *np.arange(80.0, 90.0, INTERVAL_S), 105.01)
    history = curve(*((t_s, t_s, t_s, None) for t_s in pieces), is_replay=True)
    t, desired, *_ = history.curves(0, angular=False, span_s=60.0, at_s=95.0)
    assert (t[0], t[-1], len(t)) == (80.0, 109.75, 80)
    assert (desired == t).all()
    t, *_ = history.curves(0, angular=False, span_s=20.0, at_s=85.0)
    assert (t[0], t[-1]) == (80.0, 89.75)
    history.keep(100.0, 200.0)
    assert history.curves(0, angular=False, span_s=60.0, at_s=95.0)[0][0] == 100.0


def test_curves_keep_the_last_minutes():
    history = VariableHistory(2)
    for k in range(HISTORY_POINTS_MAX + 10):
        assert history.add(k * INTERVAL_S, (1.0, 0.0), (2.0, 0.0), np.array([3.0, 0.0]))
    assert not history.add((HISTORY_POINTS_MAX + 9.5) * INTERVAL_S, (1.0, 0.0), (2.0, 0.0), None)
    t, desired, estimated, true = history.curves(0, angular=False)
    assert len(t) == HISTORY_POINTS_MAX
    assert (desired[-1], estimated[-1], true[-1]) == (1.0, 2.0, 3.0)
    history.add(0.0, (1.0, 0.0), (2.0, 0.0), None)
    t, _, _, true = history.curves(0, angular=False)
    assert len(t) == 1
    assert np.isnan(true[0])


def test_curves_of_a_fast_run_keep_the_same_span_of_time():
    t, *_ = curve(*((k * SPAN_S / 10, 1.0, 2.0, None) for k in range(100))).curves(0, angular=False)
    assert len(t) == 11
    assert t[-1] - t[0] == pytest.approx(SPAN_S)
    t, desired, *_ = curve(*((float(k), 1.0, 2.0, None) for k in range(100))).curves(0, angular=False, span_s=20.0)
    assert t.tolist() == list(range(79, 100))
    assert len(desired) == 21


def test_a_wrapping_angle_breaks_the_curve_but_not_its_error():
    turning = curve(*((float(k), angle, 0.0, None) for k, angle in enumerate((3.0, 3.1, 3.2, 3.3))))
    _, desired, _, _ = turning.curves(0, angular=True)
    assert np.isnan(desired[2])
    assert desired[3] == pytest.approx(math.degrees(3.3) - 360)
    apart = curve(*((float(k), 3.1, yaw, yaw - 0.1) for k, yaw in enumerate((3.0, 3.1, -3.1))))
    _, desired, estimated, true = apart.curves(0, angular=True, subtracted=0)
    assert desired == pytest.approx([0.0, 0.0, 0.0])
    assert np.radians(estimated) == pytest.approx([-0.1, 0.0, math.tau - 6.2])
    assert np.radians(true) == pytest.approx([-0.2, -0.1, math.tau - 6.3])


# Plots


def poses(t_s: float) -> DronePoses:
    """Return poses with drone1 at (1, 2, 3), yawed by 30 degrees and rolled by 6; drone2 is not in the view."""
    p_W = np.array([(1.0, 2.0, 3.0), (math.nan,) * 3, (7.0, 8.0, 9.0)])
    q_WB = frames.quaternion_from_rpy(np.radians([(6.0, 0.0, 30.0)] * 3))
    return DronePoses(round(t_s * 1e9), tuple(CLUSTER.drones), p_W, q_WB, np.zeros((3, 8)), np.zeros(3))


def filled(seconds: int) -> FlightHistory:
    flights = FlightHistory(CLUSTER.drones)
    estimate = EstimateView("drone1", (1.5, 2.0, 3.0), (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), math.radians(32.0), 0.1, {})
    for t in range(seconds):
        flights.add(poses(float(t)), {"drone1": estimate})
    return flights


class Plotted:
    """The plots of a formation and its drones, with a history of some seconds."""

    def __init__(self, seconds: int = 100) -> None:
        self.gui: Any = Gui()
        self.flights = filled(seconds)
        self.plots = VariablePlots(self.gui, CLUSTER, NAMES, self.flights)
        self.choice = self.gui.at["variables"]

    def choose(self, drone: str) -> None:
        self.choice.put(next(each for each in self.choice.options if each.startswith(drone)))


def test_every_drone_has_its_true_and_estimated_flight():
    flights = filled(3)
    shown = {each.label.partition(" ")[0]: each for each in flights.variables("drone1")}
    last = {name: [c[-1] for c in each.history.curves(each.column, each.angular)[1:]] for name, each in shown.items()}
    assert last["x"][1:] == pytest.approx([1.5, 1.0])
    assert last["yaw"][1:] == pytest.approx([32.0, 30.0])
    assert last["roll"][2] == pytest.approx(6.0)
    assert math.isnan(last["roll"][1])
    gone = flights.variables("drone2")[0]
    assert np.isnan(gone.history.curves(gone.column, False)[3]).all()


def test_any_variable_can_be_plotted_with_its_error_and_window():
    shown = Plotted()
    assert len(shown.choice.options) == 1 + 2 + 2 * len(CLUSTER.drones)
    shown.choose("drone1")
    shown.plots.draw()
    assert [plot.visible for plot in shown.gui.plots] == [True] * 3
    assert shown.gui.plots[0].data[2][-1] == pytest.approx(1.5)
    shown.gui.at["Errors"].value = True
    window = shown.gui.at["window"]
    window.value = window.options[-1]
    shown.plots.draw()
    assert shown.gui.plots[0].data[2][-1] == pytest.approx(0.5)
    assert np.ptp(shown.gui.plots[0].data[0]) < SPAN_S / 2


def test_frozen_plots_keep_their_data():
    shown = Plotted()
    shown.choice.value = shown.choice.options[-1]
    shown.plots.draw()
    shown.plots.draw()
    shown.gui.at["Freeze"].value = True
    before = shown.gui.plots[0].data
    shown.flights.add(poses(100.0), {})
    shown.plots.draw()
    assert shown.gui.plots[0].data is before


def test_the_time_axis_contains_all_points_and_moves_in_whole_steps():
    span_s = WINDOWS_S[0]
    ends = np.arange(1.0, 900.0, 0.5)
    times = [np.array([max(0.0, end - span_s), end]) for end in ends]
    found = [AxisRange.of_times(t, span_s) for t in times]
    assert all(each.low <= t[0] and t[-1] <= each.high for each, t in zip(found, times, strict=True))
    assert max(each.high - each.low for each in found) <= span_s * (1.0 + 2.0 / STEPS_PER_WINDOW)
    assert len(set(found)) == math.ceil(ends[-1] / (span_s / STEPS_PER_WINDOW))


def test_values_get_an_explicit_range_when_a_curve_is_unknown():
    unknown, known = np.full(3, np.nan), np.array([np.nan, -1.0, 4.0])
    assert AxisRange.of_values((unknown, unknown)) is None
    assert AxisRange.of_values((known, known)) is None
    found = AxisRange.of_values((unknown, known, known + 0.5))
    assert found is not None
    assert found.low < -1.0 < 4.5 < found.high


def test_a_plot_is_recreated_only_when_its_time_axis_moves():
    shown = Plotted(10)
    shown.choose("drone1")
    scales = shown.gui.plots[0].scales
    low, high = scales["x"]["range"]
    shown.flights.add(poses(10.0), {})
    shown.plots.draw()
    assert shown.gui.plots[0].scales is scales
    assert low <= shown.gui.plots[0].data[0][-1] == 10.0 <= high
    shown.flights.add(poses(high + 1.0), {})
    shown.plots.draw()
    assert shown.gui.plots[0].scales["x"]["range"][1] > high


def test_a_choice_is_plotted_at_once_even_without_new_data():
    shown = Plotted()
    shown.choose("drone3")
    assert shown.gui.plots[0].data[3][-1] == pytest.approx(7.0)
    shown.gui.at["Errors"].put(True)
    assert shown.gui.plots[0].data[3][-1] == pytest.approx(0.0)
    empty = Plotted(0)
    empty.choice.put(empty.choice.options[-1])
    assert all(np.isnan(plot.data[1:]).all() for plot in empty.gui.plots)
