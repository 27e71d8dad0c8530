"""Trails and curves: how far they go back, and what a record adds."""

import math
from pathlib import Path

import numpy as np
import pytest

from zsim_bridges.console import picture as pic
from zsim_bridges.console.histories import (
    HISTORY_POINTS_MAX,
    INTERVAL_S,
    SPACING_M,
    SPAN_S,
    TRAIL_POINTS_MAX,
    TRAILS_S,
    CanvasTrails,
    VariableHistory,
)

SCENARIOS = Path(__file__).parents[4] / "scenarios"
LEVEL = (1.0, 0.0, 0.0, 0.0)
RNG = np.random.default_rng(4)


def some_attitudes(count: int) -> np.ndarray:
    q = RNG.normal(size=(count, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def drones(p_W: np.ndarray, q_WB: np.ndarray, t_ns: int = 0) -> pic.DronePoses:
    names = tuple(f"drone{i}" for i in range(len(p_W)))
    return pic.DronePoses(t_ns, names, p_W, q_WB, np.full((len(p_W), 4), 300.0), np.zeros(3))


def test_a_trail_goes_back_as_far_as_is_chosen():
    trails = CanvasTrails(2)
    for k in range(300):
        trails.add(k * 0.5, np.array([(k * 2 * SPACING_M, 0.0, 1.0), (5.0, 5.0, 1.0)]))
    now = np.array([(1000.0, 0.0, 1.0), (5.0, 5.0, 1.0)])
    for length_s in TRAILS_S[:3]:
        number = trails.number
        trails.choose_length(length_s)
        assert trails.number != number  # a map that has trails of another length asks for them anew
        segments, whose, since_s = trails.segments(150.0, now)
        assert set(whose) == {0}  # one that stands has no trail
        assert len(segments) == 2 * length_s
        assert since_s[0] == 150.0 - length_s
        assert segments[0, 0, 0] == pytest.approx(2 * (150.0 - length_s) * 2 * SPACING_M)
        assert segments[-1, 1].tolist() == [1000.0, 0.0, 1.0]


def test_a_drone_that_is_not_there_leaves_no_trail():
    trails = CanvasTrails(2)
    nowhere = (np.nan, np.nan, np.nan)
    for k in range(5):
        trails.add(k * 1.0, np.array([(float(k), 0.0, 1.0), nowhere]))
    segments, whose, _ = trails.segments(5.0, np.array([(9.0, 0.0, 1.0), nowhere]))
    assert whose.tolist() == [0] * 5
    assert np.isfinite(segments).all()
    trails.add(0.0, np.zeros((2, 3)))  # back in time, all begins anew
    assert trails.segments(0.0, np.zeros((2, 3)))[0].shape == (0, 2, 3)


@pytest.mark.parametrize("count", [3, 50])
def test_many_points_are_thinned_out_the_same_ones_each_time(count: int):
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


def test_trails_of_a_record_are_there_on_both_sides_of_what_was_read_last():
    trails, here = CanvasTrails(1, around=True), np.array([(100.0, 0.0, 1.0)])
    for t_s in (*np.arange(60.0, 80.0, 0.25), *np.arange(0.0, 20.0, 0.25)):  # a piece, and an earlier one
        trails.add(t_s, np.array([(t_s, 0.0, 1.0)]))
    trails.choose_length(30.0)
    for at_s in (79.9, 19.9):
        segments, _, since_s = trails.segments(at_s, here)
        assert len(segments) > 70
        assert since_s.min() >= at_s - 30.0
    assert trails.segments(45.0, here)[0][:, 1, 0].max() < 20.0  # nothing is drawn across what was not read
    trails.keep(50.0, 70.0)
    assert len(trails.segments(19.9, here)[0]) == 0


def test_curves_of_a_record_stand_around_the_shown_instant():
    history = VariableHistory(1, around=True)
    for t_s in (*np.arange(100.0, 110.0, INTERVAL_S), *np.arange(80.0, 90.0, INTERVAL_S), 105.01):
        history.add(t_s, (t_s,), (t_s,), None)
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


def test_curves_of_a_fast_run_go_back_no_further():
    history = VariableHistory(1)
    for k in range(100):
        history.add(k * SPAN_S / 10, (1.0,), (2.0,), None)
    t, *_ = history.curves(0, angular=False)
    assert len(t) == 11
    assert t[-1] - t[0] == pytest.approx(SPAN_S)


def test_an_angle_that_goes_round_breaks_the_curve():
    history = VariableHistory(1)
    for k, angle in enumerate((3.0, 3.1, 3.2, 3.3)):
        history.add(k * 1.0, (angle,), (0.0,), None)
    _, desired, _, _ = history.curves(0, angular=True)
    assert np.isnan(desired[2])
    assert desired[3] == pytest.approx(math.degrees(3.3) - 360)


def test_errors_are_counted_from_what_is_desired():
    history = VariableHistory(1)
    for k, yaw in enumerate((3.0, 3.1, -3.1)):
        history.add(float(k), (3.1,), (yaw,), np.array([yaw - 0.1]))
    _, desired, estimated, true = history.curves(0, angular=True, less=0)
    assert desired == pytest.approx([0.0, 0.0, 0.0])
    assert np.radians(estimated) == pytest.approx([-0.1, 0.0, math.tau - 6.2])
    assert np.radians(true) == pytest.approx([-0.2, -0.1, math.tau - 6.3])


def test_a_window_shows_the_newest_of_the_curves():
    history = VariableHistory(1)
    for k in range(100):
        history.add(float(k), (1.0,), (2.0,), None)
    t, desired, *_ = history.curves(0, angular=False, span_s=20.0)
    assert t.tolist() == list(range(79, 100))
    assert len(desired) == 21
