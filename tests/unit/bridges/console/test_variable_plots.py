"""What can be plotted, and what a plot shows."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_gui import Gui

from zsim.contract.views import EstimateView
from zsim.math import frames
from zsim.scenario import scenario_file
from zsim_bridges.console.histories import SPAN_S
from zsim_bridges.console.operator_input import SliderRange
from zsim_bridges.console.picture import DronePoses
from zsim_bridges.console.variable_plots import (
    STEPS_PER_WINDOW,
    WINDOWS_S,
    AxisRange,
    FlightHistory,
    VariablePlots,
    flight_history,
)

CLUSTER = scenario_file.load(Path(__file__).parents[4] / "scenarios" / "step.yaml").clusters[0]
RANGES = [SliderRange(name, "m", 0.0, 9.0, 0.1) for name in ("x_c", "y_c", "z_c", "p")]


def poses(t_s: float) -> DronePoses:
    """drone1 at (1, 2, 3), turned by 30 degrees and rolled by 6; drone2 is not in the view."""
    p_W = np.array([(1.0, 2.0, 3.0), (math.nan,) * 3, (7.0, 8.0, 9.0)])
    q_WB = frames.quaternion_from_rpy(np.radians([(6.0, 0.0, 30.0)] * 3))
    return DronePoses(round(t_s * 1e9), tuple(CLUSTER.drones), p_W, q_WB, np.zeros((3, 8)), np.zeros(3))


def filled(seconds: int) -> FlightHistory:
    flights = flight_history(CLUSTER.drones)
    estimate = EstimateView("drone1", (1.5, 2.0, 3.0), (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), math.radians(32.0), 0.1, {})
    for t in range(seconds):
        flights.add(poses(float(t)), {"drone1": estimate})
    return flights


def test_every_drone_has_its_flight_true_and_estimated():
    flights = filled(3)
    shown = {each.label.partition(" ")[0]: each for each in flights.variables("drone1")}
    last = {name: [c[-1] for c in each.history.curves(each.column, each.angular)[1:]] for name, each in shown.items()}
    assert last["x"][1:] == pytest.approx([1.5, 1.0])
    assert last["yaw"][1:] == pytest.approx([32.0, 30.0])
    assert last["roll"][2] == pytest.approx(6.0)
    assert math.isnan(last["roll"][1])
    gone = flights.variables("drone2")[0]
    assert np.isnan(gone.history.curves(gone.column, False)[3]).all()


def test_any_variable_of_any_drone_can_be_chosen_with_its_error_and_its_window():
    gui: Any = Gui()
    plots = VariablePlots(gui, CLUSTER, RANGES, filled(100))
    choice = gui.at["variables"]
    assert len(choice.options) == 1 + 2 + 2 * len(CLUSTER.drones)
    choice.value = next(each for each in choice.options if each.startswith("drone1"))
    plots.draw()
    assert [plot.visible for plot in gui.plots] == [True] * 3
    assert gui.plots[0].data[2][-1] == pytest.approx(1.5)
    gui.at["Errors"].value = True
    window = gui.at["window"]
    window.value = window.options[-1]
    plots.draw()
    assert gui.plots[0].data[2][-1] == pytest.approx(0.5)
    assert np.ptp(gui.plots[0].data[0]) < SPAN_S / 2


def test_plots_that_stand_still_keep_what_they_show():
    gui: Any = Gui()
    flights = filled(100)
    plots = VariablePlots(gui, CLUSTER, RANGES, flights)
    gui.at["variables"].value = gui.at["variables"].options[-1]
    plots.draw()
    plots.draw()
    gui.at["Stand still"].value = True
    before = gui.plots[0].data
    flights.add(poses(100.0), {})
    plots.draw()
    assert gui.plots[0].data is before


def test_the_time_axis_holds_all_points_and_moves_on_by_whole_steps():
    span_s = WINDOWS_S[0]
    ends = np.arange(1.0, 900.0, 0.5)
    times = [np.array([max(0.0, end - span_s), end]) for end in ends]
    found = [AxisRange.of_times(t, span_s) for t in times]
    assert all(each.low <= t[0] and t[-1] <= each.high for each, t in zip(found, times, strict=True))
    assert max(each.high - each.low for each in found) <= span_s * (1.0 + 2.0 / STEPS_PER_WINDOW)
    assert len(set(found)) == math.ceil(ends[-1] / (span_s / STEPS_PER_WINDOW))


def test_values_have_a_range_of_their_own_where_a_curve_is_not_known_at_all():
    unknown, known = np.full(3, np.nan), np.array([np.nan, -1.0, 4.0])
    assert AxisRange.of_values((unknown, unknown)) is None
    assert AxisRange.of_values((known, known)) is None
    found = AxisRange.of_values((unknown, known, known + 0.5))
    assert found is not None
    assert found.low < -1.0
    assert found.high > 4.5


def test_a_plot_is_made_anew_only_where_its_time_axis_moves_on():
    gui: Any = Gui()
    flights = filled(10)
    plots = VariablePlots(gui, CLUSTER, RANGES, flights)
    gui.at["variables"].put(next(each for each in gui.at["variables"].options if "drone1" in each))
    scales = gui.plots[0].scales
    low, high = scales["x"]["range"]
    flights.add(poses(10.0), {})
    plots.draw()
    assert gui.plots[0].scales is scales
    assert low <= gui.plots[0].data[0][-1] == 10.0 <= high
    flights.add(poses(high + 1.0), {})
    plots.draw()
    assert gui.plots[0].scales["x"]["range"][1] > high


def test_what_is_chosen_is_shown_though_nothing_is_drawn_any_more():
    gui: Any = Gui()
    VariablePlots(gui, CLUSTER, RANGES, filled(100))
    gui.at["variables"].put(next(each for each in gui.at["variables"].options if "drone3" in each))
    assert gui.plots[0].data[3][-1] == pytest.approx(7.0)
    gui.at["Errors"].put(True)
    assert gui.plots[0].data[3][-1] == pytest.approx(0.0)


def test_a_variable_of_which_nothing_is_known_has_no_curve():
    gui: Any = Gui()
    VariablePlots(gui, CLUSTER, RANGES, filled(0))
    gui.at["variables"].put(gui.at["variables"].options[-1])
    assert all(np.isnan(plot.data[1:]).all() for plot in gui.plots)
