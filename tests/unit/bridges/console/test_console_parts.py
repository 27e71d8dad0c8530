"""The console's pure parts: what is drawn, how far a slider goes, what is typed, who may pass, the texts."""

import math
import re
import socket
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from refused import has_terms, refused, without_tags

from zsim.contract.run_messages import Event
from zsim.contract.views import DroneView, EstimateView, ViewCluster, ViewDrones
from zsim.errors import RunError
from zsim.math import frames
from zsim.scenario import scenario_file
from zsim_agents.formation.spaces.scenario_space import cluster_space, scenario_space
from zsim_agents.formation.trajectory import ExpressionTrajectory
from zsim_bridges.console import console_tables, operator_input
from zsim_bridges.console import picture as pic
from zsim_bridges.console.alarms import DroneCondition, drone_alarms
from zsim_bridges.console.console_tables import SensorRates
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
from zsim_bridges.console.operator_input import primary_variables, slider_ranges
from zsim_bridges.console.page_server import OPERATOR, VIEWER, ListenAddress, PageRequest, PageTokens
from zsim_bridges.console.private_viser import PageControls, ViewerCamera, is_permitted
from zsim_bridges.console.view_buffer import EventRow

SCENARIOS = Path(__file__).parents[4] / "scenarios"
LEVEL = (1.0, 0.0, 0.0, 0.0)
RNG = np.random.default_rng(4)


def some_attitudes(count: int) -> np.ndarray:
    q = RNG.normal(size=(count, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def drones(p_W: np.ndarray, q_WB: np.ndarray, t_ns: int = 0) -> pic.DronePoses:
    names = tuple(f"drone{i}" for i in range(len(p_W)))
    return pic.DronePoses(t_ns, names, p_W, q_WB, np.full((len(p_W), 4), 300.0), np.zeros(3))


# The picture


def test_a_view_becomes_arrays():
    views = tuple(DroneView(f"d{i}", (i, 2.0, 3.0), LEVEL, (1.0, 2.0, 3.0, 4.0), "flying", 80.0) for i in range(2))
    found = pic.drone_poses(ViewDrones(7, 0, views, ((1.0, 0.0, 0.0), (3.0, 0.0, 0.0))), ("d0", "d1"))
    assert found.t_ns == 7
    assert found.names == ("d0", "d1")
    assert found.p_W.tolist() == [[0, 2, 3], [1, 2, 3]]
    assert found.rotor.tolist() == [[1, 2, 3, 4, 0, 0, 0, 0]] * 2
    assert found.wind_W.tolist() == [2, 0, 0]


def test_a_view_of_some_drones_keeps_their_places():
    some = tuple(
        DroneView(name, (1.0, 2.0, 3.0), LEVEL, (1.0, 2.0, 3.0, 4.0), "flying", 80.0) for name in ("d2", "stranger")
    )
    found = pic.drone_poses(ViewDrones(7, 0, some), ("d0", "d1", "d2"))
    assert found.present.tolist() == [False, False, True]
    assert found.p_W[2].tolist() == [1, 2, 3]
    assert found.q_WB.shape == (3, 4)
    assert not pic.drone_poses(ViewDrones(7, 0, ()), ("d0",)).present.any()


def test_many_names_are_shown_by_what_tells_them_apart():
    assert pic.short_names(["drone1", "drone2", "drone30"]) == ["1", "2", "30"]
    assert pic.short_names(["drone10", "drone11"]) == ["10", "11"]
    assert pic.short_names(["north", "south"]) == ["north", "south"]
    assert pic.short_names(["drone", "drone2"]) == ["drone", "drone2"]


def test_rotors_stand_on_their_drone_and_turn_about_its_axis():
    hubs = np.array([(0.1, 0.1, 0.03), (0.1, -0.1, 0.03), (-0.1, -0.1, 0.03), (-0.1, 0.1, 0.03)])
    q = some_attitudes(5)
    p = RNG.normal(size=(5, 3))
    owners = np.repeat(np.arange(5), 4)
    places, turns = pic.rotor_poses(p[owners], q[owners], np.tile(hubs, (5, 1)), RNG.uniform(0, 6, 20))
    R = frames.rotation_matrix(q)
    for n in range(5):
        for k in range(4):
            assert places[4 * n + k] == pytest.approx(p[n] + R[n] @ hubs[k])
            assert frames.rotation_matrix(turns)[4 * n + k][:, 2] == pytest.approx(R[n][:, 2])


def test_rotors_turn_so_slowly_that_eyes_see_which_way():
    fastest, ways = np.full(4, 503.0), np.array([1.0, -1.0, 1.0, -1.0])  # rad/s, of the AR.Drone
    turned = pic.rotor_angles(np.zeros(4), fastest, ways, 0.1)  # ten pictures a second, the fewest
    steps = np.abs((turned + math.pi) % math.tau - math.pi)
    assert (steps > 0.1).all()
    assert (steps < math.pi / 2).all()  # a propeller of two blades looks the same after half a turn
    assert pic.rotor_angles(turned, fastest, ways, 0.0) == pytest.approx(turned)


def test_an_ellipsoid_is_the_covariance_at_two_sigma():
    R = frames.rotation_matrix(some_attitudes(1))[0]
    P = R @ np.diag([0.04, 0.25, 1.0]) @ R.T
    estimate = EstimateView("d", (1.0, 2.0, 3.0), tuple(P[np.triu_indices(3)]), 0.0, 0.1, {})
    balls = pic.ellipsoids([estimate])
    assert balls.p_W.tolist() == [[1, 2, 3]]
    assert sorted(balls.half_m[0]) == pytest.approx([0.4, 1.0, 2.0])
    axes = frames.rotation_matrix(balls.wxyz)[0]
    assert axes @ np.diag(balls.half_m[0] / 2) ** 2 @ axes.T == pytest.approx(P)


def test_what_an_ellipsoid_holds_is_said_rightly():
    samples = np.linalg.norm(RNG.normal(size=(200_000, 3)), axis=1)
    assert pytest.approx(float((samples < pic.SIGMAS).mean()), abs=0.004) == pic.SHARE_WITHIN
    assert f"{pic.SHARE_WITHIN:.0%}" == "74%"


def test_without_estimates_there_are_no_ellipsoids():
    balls = pic.ellipsoids([])
    assert balls.p_W.shape == (0, 3)
    assert balls.wxyz.shape == (0, 4)


@pytest.mark.parametrize("name", ["step", "ring10", "triads", "grid30"])
def test_ghosts_stand_where_the_formation_is_to_be(name: str):
    scenario = scenario_file.load(SCENARIOS / f"{name}.yaml")
    cluster = scenario.clusters[0]
    space = scenario_space(scenario, cluster)
    c = space.specimen(4.0)
    view = ViewCluster(0, 0, "engaged", space.names, tuple(c), tuple(c), "")
    found = pic.ghosts(space, view)
    assert found is not None
    p_W, q = found
    assert space.difference(space.forward(p_W, frames.heading(q)), c) == pytest.approx(np.zeros(space.size), abs=1e-6)
    assert pic.ghosts(space, msgspec.structs.replace(view, phase="idle")) is None


def test_a_triangle_is_drawn_with_its_sides_and_its_corner():
    p_W = np.array([(0.0, 0.0, 2.0), (3.0, 0.0, 2.0), (0.0, 4.0, 2.0)])
    found = pic.formation_shape(cluster_space(3), p_W, np.zeros(3))
    assert found is not None
    assert [side.name for side in found.sides] == ["p 3.00 m", "q 4.00 m", ""]
    assert found.sides[1].ends_W.tolist() == p_W[[0, 2]].tolist()
    assert found.corner is not None
    assert found.corner[1] == "β 90.0°"
    assert found.p_c == pytest.approx(p_W.mean(axis=0))


def test_a_formation_in_line_has_no_frame():
    line = np.array([(0.0, 0.0, 2.0), (3.0, 0.0, 2.0), (6.0, 0.0, 2.0)])
    assert pic.formation_shape(cluster_space(3), line, np.zeros(3)) is None


def test_a_pair_has_one_side():
    found = pic.formation_shape(cluster_space(2), np.array([(0.0, 0.0, 2.0), (3.0, 0.0, 2.0)]), np.zeros(2))
    assert found is not None
    assert [side.name for side in found.sides] == ["p 3.00 m"]
    assert found.corner is None


# Trails and plots


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


def test_rates_follow_from_counts():
    rates = SensorRates()
    assert rates.update("d1", 0, {"gps": (10, 0)}) == {}
    assert rates.update("d1", 2_000_000_000, {"gps": (19, 1)})["gps"] == pytest.approx(5.0)
    assert rates.update("d2", 2_000_000_000, {"gps": (50, 1)}) == {}


def test_a_run_that_stands_still_adds_nothing_to_the_rates():
    rates = SensorRates()
    rates.update("d1", 0, {"gps": (0, 0)})
    for _ in range(1000):
        assert rates.update("d1", 500_000_000, {"gps": (5, 0)})["gps"] == pytest.approx(10.0)
    assert len(rates._samples) == 2


def test_a_sensor_of_the_user_s_has_a_row_counted_or_not():
    """The stock estimator counts none; an estimator of the user's own may."""
    own = {"pitot": 20.0, "my_uwb": 10.0}
    table = console_tables.sensor_table("drone1", {"gps": (5, 0), "my_uwb": (7, 1)}, {}, "", own)
    rows = [without_tags(row.replace("</td>", " ")).split() for row in table.split("<tr>")[2:]]
    assert rows == [["gps", "5", "0", "–"], ["my_uwb", "7", "1", "–"], ["pitot", "–", "–", "20", "Hz", "as", "set"]]


def test_rates_begin_anew_with_a_fresh_estimator():
    rates = SensorRates()
    rates.update("d1", 0, {"gps": (100, 0), "imu": (9, 0)})
    assert rates.update("d1", 1_000_000_000, {"imu": (10, 0)}) == {}
    assert rates.update("d1", 2_000_000_000, {"gps": (5, 0), "imu": (20, 0)})["imu"] == pytest.approx(10.0)
    assert rates.update("d1", 3_000_000_000, {"gps": (2, 0), "imu": (30, 0)}) == {}


# Limits


def test_every_variable_has_a_range_in_its_unit():
    scenario = scenario_file.load(SCENARIOS / "step.yaml")
    cluster = scenario.clusters[0]
    space = scenario_space(scenario, cluster)
    found = {each.name: each for each in slider_ranges(space, cluster, scenario)}
    assert list(found) == list(space.names)
    assert found["p"].low == cluster.gains.separation_min_m
    assert found["yaw"].unit == "deg"
    assert found["yaw"].to_si(90.0) == pytest.approx(math.pi / 2)
    assert found["yaw"].to_display(math.pi / 2 + math.tau) == 90.0
    assert found["z_c"].low > 0
    assert found["beta"].low > 0
    assert found["beta"].high < 180
    goal = {name: float(value) for name, value in cluster.plan.target.items()}
    assert all(found[n].refusal(found[n].to_display(v)) is None for n, v in goal.items())


def test_what_is_out_of_range_is_refused_with_what_is_allowed():
    scenario = scenario_file.load(SCENARIOS / "step.yaml")
    space = scenario_space(scenario, scenario.clusters[0])
    found = {each.name: each for each in slider_ranges(space, scenario.clusters[0], scenario)}
    assert has_terms(found["p"].refusal(0.5) or "", "p", "0.5")
    assert found["p"].refusal(math.nan) is not None
    assert found["p"].to_display(1.0) == 1.0  # as it is: only what is asked for must be within


@pytest.mark.parametrize(
    ("altitude_m", "separation_m"), [(100.0, 0.0), (1.0, 20.0), (0.8, 25.0), (1e-3, 1e9), (10_000.0, 19.95)]
)
def test_every_range_has_room_whatever_the_scenario_allows(altitude_m: float, separation_m: float):
    given = {"drones.drone1.limits.altitude_m": altitude_m, "clusters.main.gains.separation_min_m": separation_m}
    scenario = scenario_file.load(SCENARIOS / "step.yaml", [f"{path}={value}" for path, value in given.items()])
    cluster = scenario.clusters[0]
    for found in slider_ranges(scenario_space(scenario, cluster), cluster, scenario):
        assert found.low < found.high, found.name
        assert found.low <= found.start <= found.high


def test_of_many_variables_those_of_the_whole_are_shown():
    scenario = scenario_file.load(SCENARIOS / "grid30.yaml")
    space = scenario_space(scenario, scenario.clusters[0])
    assert primary_variables(space.names)[:6] == ["x_c", "y_c", "z_c", "roll", "pitch", "yaw"]
    assert len(primary_variables(space.names)) < 16


# What is typed


def test_expressions_are_read_with_their_constants():
    text = "# a circle\nx_c = R*cos(0.1*t)\n\ny_c = R*sin(0.1*t)\nR = 5"
    assert operator_input.parse_expressions(text, ("x_c", "y_c")) == {
        "expressions": {"x_c": "R*cos(0.1*t)", "y_c": "R*sin(0.1*t)"},
        "constants": {"R": 5.0},
    }


def test_expressions_of_angles_are_in_degrees_as_the_sliders_are():
    scenario = scenario_file.load(SCENARIOS / "step.yaml")
    space = scenario_space(scenario, scenario.clusters[0])
    text = "yaw = 90 + 6*t\nroll_deg = A\nx_c = 1\nA = 5"
    read = operator_input.parse_expressions(text, space.names, ("roll", "pitch", "yaw"))
    c, c_dot = ExpressionTrajectory(space, read["expressions"], np.zeros(space.size), read["constants"]).value(5.0)
    found = {name: c[space.index(name)] for name in ("yaw", "roll", "x_c")}
    assert found == pytest.approx({"yaw": math.radians(120.0), "roll": math.radians(5.0), "x_c": 1.0})
    assert c_dot[space.index("yaw")] == pytest.approx(math.radians(6.0))


def test_waypoints_are_read():
    assert operator_input.parse_waypoints("0: x_c = 1, p=4\n20.5: x_c=2", {}) == {
        "waypoints": [{"at_s": 0.0, "values": {"x_c": 1.0, "p": 4.0}}, {"at_s": 20.5, "values": {"x_c": 2.0}}]
    }


@pytest.mark.parametrize(
    ("text", "terms"),
    [
        ("x_c", ("line 1", "'x_c'")),
        ("x_c = 5\nyc = 6", ("yc", "x_c")),
        ("x_c = 1\nradius = wide", ("line 2", "radius", "'wide'")),
        ("", ("trajectory",)),
    ],
)
def test_an_invalid_expression_is_refused_by_line_and_value(text: str, terms: tuple[str, ...]):
    with refused(operator_input.InputError, *terms):
        operator_input.parse_expressions(text, ("x_c",))


@pytest.mark.parametrize("text", ["x_c = 1", "0 x_c=1", "0: 5", "a: x_c = 1", ""])
def test_a_waypoint_that_is_none_is_refused_in_words(text: str):
    with pytest.raises(operator_input.InputError):
        operator_input.parse_waypoints(text, {})


# Who may pass


def asked(path: str = "/", host: str = "127.0.0.1:8080", origin: str | None = None, token: str = "", **cookies: str):
    return PageRequest(path, host, origin, token, cookies)


def test_on_this_machine_alone_no_token_is_asked_for():
    guard = PageTokens("127.0.0.1", 8080, None, "look")
    assert guard.role_of(asked()) == OPERATOR
    assert guard.role_of(asked("/view/state")) == VIEWER
    assert guard.role_of(asked(origin="http://127.0.0.1:8080")) == OPERATOR


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("evil.example:8080", None),
        ("127.0.0.1:8080", "http://evil.example"),
        ("127.0.0.1:8080", "http://127.0.0.1:9000"),
        ("127.0.0.1:8080", "null"),
        ("[::1:8080", None),
    ],
)
def test_a_stranger_s_page_may_not_ask(host: str, origin: str | None):
    assert PageTokens("127.0.0.1", 8080, None, "look").role_of(asked(host=host, origin=origin)) is None


def test_with_a_token_only_who_shows_it_comes_in():
    guard = PageTokens("0.0.0.0", 8080, "steer", "look")
    assert guard.role_of(asked(host="lab:8080")) is None
    assert guard.role_of(asked(token="wrong")) is None
    assert guard.role_of(asked(token="steer")) == OPERATOR
    assert guard.role_of(asked(zsim_operator_8080="steer")) == OPERATOR
    assert guard.role_of(asked(zsim_operator_8081="steer")) is None
    assert guard.role_of(asked(origin="http://evil.example", zsim_operator_8080="steer")) is None
    assert guard.role_of(asked(origin="http://[bad", zsim_operator_8080="steer")) is None


def test_the_viewers_token_opens_the_viewers_page_alone():
    guard = PageTokens("0.0.0.0", 8080, "steer", "look")
    assert guard.role_of(asked("/view", token="look")) == VIEWER
    assert guard.role_of(asked("/view", zsim_viewer_8080="look")) == VIEWER
    assert guard.role_of(asked("/view", token="steer")) == VIEWER
    assert guard.role_of(asked("/", token="look")) is None
    assert guard.role_of(asked("/", zsim_viewer_8080="look", zsim_operator_8080="look")) is None


def test_others_need_a_token():
    with pytest.raises(RunError, match=r"0\.0\.0\.0"):
        PageTokens("0.0.0.0", 8080, None, "look")
    with pytest.raises(RunError, match="token"):
        PageTokens("127.0.0.1", 8080, "", "look")


CAMERA = msgspec.to_builtins(
    ViewerCamera((1, 0, 0, 0), (1.0, 2.5, 3.0), 1.3, 0.01, 1000, 600, 800, (0, 0, 0), (0, 0, 1))
)
UPDATE = {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": True}}


def test_a_viewer_steers_nothing_but_its_own_page():
    packed = msgspec.msgpack.encode
    there = controls(a=True)
    assert is_permitted(packed(CAMERA), VIEWER, there)
    assert not is_permitted(packed(UPDATE), VIEWER, there)
    assert is_permitted(packed(UPDATE), OPERATOR, there)


CLICK = {
    "type": "ScenePointerMessage",
    "event_type": "click",
    "ray_origin": (0.0, 0.0, 1.0),
    "ray_direction": (0.0, 1.0, 0.0),
    "screen_pos": ((0.5, 0.5),),
    "modifier": None,
}


@pytest.mark.parametrize("role", [OPERATOR, VIEWER])
def test_every_page_may_click_into_its_scene(role: str):
    def permitted(**fields: Any) -> bool:
        return is_permitted(msgspec.msgpack.encode({**CLICK, **fields}), role, controls())

    assert permitted()
    assert permitted(modifier="shift")
    assert not permitted(type="SceneNodeClickMessage", name="/drones")
    assert not permitted(event_type="rect-select")
    assert not permitted(ray_origin=(0.0, float("nan"), 0.0))
    assert not permitted(ray_direction=None)
    assert not permitted(screen_pos=())
    assert not permitted(modifier="x" * 65)


def controls(**values: Any) -> PageControls:
    """Return what is known of controls that hold such values; a list is that of a dropdown."""
    handles = {
        uuid: SimpleNamespace(value=now[0], options=now) if isinstance(now, list) else SimpleNamespace(value=now)
        for uuid, now in values.items()
    }
    gui: Any = SimpleNamespace(_gui_input_handle_from_uuid=handles)
    return PageControls(gui)


@pytest.mark.parametrize(
    ("now", "good", "bad"),
    [
        (False, [True], [1, 0.5, "x"]),
        (1, [2, 0.5, -3], [True, "x", "", 1e300]),
        (0.5, [2, 0.5], [False, "0.5"]),
        ("drone1", ["", "anything"], [True, 1]),
        (["gust", "updraught"], ["gust"], ["Gust", "", 1, True]),
    ],
)
def test_a_control_takes_what_its_page_could_put_into_it(now: Any, good: list[Any], bad: list[Any]):
    there = controls(a=now)
    change = {value: msgspec.msgpack.encode({**UPDATE, "updates": {"value": value}}) for value in good}
    assert all(is_permitted(change[value], OPERATOR, there) for value in good)
    for value in bad:
        assert not is_permitted(msgspec.msgpack.encode({**UPDATE, "updates": {"value": value}}), OPERATOR, there)
    assert not is_permitted(change[good[0]], OPERATOR, controls(b=now))


@pytest.mark.parametrize(
    "change",
    [
        msgspec.msgpack.encode({"type": "ShareUrlRequest"}),  # would show the page on the Internet
        msgspec.msgpack.encode({"type": "FileTransferStartUpload"}),
        msgspec.msgpack.encode({"type": ["GuiUpdateMessage"]}),
        msgspec.msgpack.encode({"type": "ViewerCameraMessage"}),
        msgspec.msgpack.encode({**CAMERA, "position": None}),
        msgspec.msgpack.encode({**CAMERA, "fov": float("nan")}),
        msgspec.msgpack.encode({**UPDATE, "updates": {"value": None}}),
        msgspec.msgpack.encode({**UPDATE, "updates": {"value": [1]}}),
        msgspec.msgpack.encode({**UPDATE, "updates": {"label": "x"}}),
        msgspec.msgpack.encode({**UPDATE, "updates": {"value": "x" * 3_000}}),
        msgspec.msgpack.encode([1, 2]),
        msgspec.msgpack.encode({}),
        b"\xc1",
        b"",
        msgspec.msgpack.encode({**UPDATE, "updates": {"value": "x" * 200_000}}),
    ],
)
def test_nobody_says_what_no_control_says(change: bytes):
    assert not is_permitted(change, OPERATOR, controls(a=True))


# In words


def test_tables_show_text_of_others_as_text():
    row = console_tables.DroneRow(
        DroneCondition("d1", "flying", 9.0, 400.0, commander="<script>"), "3 / 1", ("gps_dropout",)
    )
    html = console_tables.drone_table([row])
    assert "<script>" not in html
    assert "&lt;script&gt;" in html
    assert "gps_dropout" in html
    assert html.count(console_tables.AMBER) == 2  # late, and a fault
    assert has_terms(without_tags(html), "flying", "9 %", "lag 400 ms")
    assert console_tables.RED in html  # the battery
    event = Event(1_500_000_000, 0, "refused", "x", "y", "<b>no</b>")
    events = console_tables.event_table([EventRow(event, 3, False)])
    assert "1.50" in events
    assert html_marks(events) == html_marks(console_tables.event_table([EventRow(event, 4, False)]))
    assert "&lt;b&gt;no" in events
    assert has_terms(without_tags(events), "3 ×")


def html_marks(html: str) -> list[str]:
    """Return by which rows of events are known to the page."""
    found = re.findall("data-zsim-event='([0-9a-f]+)'", html)
    assert found
    return found


@pytest.mark.parametrize(
    ("percent", "colour"),
    [(20.0, "inherit"), (17.0, console_tables.AMBER), (10.0, console_tables.AMBER), (9.0, console_tables.RED)],
)
def test_a_battery_has_the_colour_of_its_alarm(percent: float, colour: str):
    html = console_tables.drone_table([console_tables.DroneRow(DroneCondition("d1", "flying", percent))])
    assert f"<span style='color:{colour}'>{percent:.0f} %" in html
    alarms = drone_alarms(DroneCondition("d1", "flying", percent))
    assert [console_tables.SEVERITY_COLOURS[each.severity] for each in alarms] == [c for c in [colour] if c[0] == "#"]


def test_many_formations_leave_room_for_the_emergency_button():
    html = console_tables.formation_lines({f"c{i}": ("taking_off", "<waits>") for i in range(16)})
    assert console_tables.FEW_LINES in html
    assert html.count("<br>") == 15
    assert has_terms(without_tags(html), "taking off", "&lt;waits&gt")


def test_acting_faults_are_listed():
    assert console_tables.NO_FAULT in console_tables.fault_lines([])
    lines = console_tables.fault_lines(["gust of world", "link_cut of a/<b>"], ["gps_stuck of drone1"])
    assert has_terms(without_tags(lines), "gust of world", "link_cut of a/&lt;b&gt;", "over", "gps_stuck of drone1")
    assert "<b>" not in lines


# Where it is


def test_a_link_names_this_machine_where_all_may_come():
    assert ListenAddress("127.0.0.1", 8080).url() == "http://127.0.0.1:8080/"
    assert ListenAddress("::1", 8080).url("/view") == "http://[::1]:8080/view"
    for everywhere in ("0.0.0.0", "::"):
        assert ListenAddress(everywhere, 8080).url("/", "a b&#").endswith(":8080/?token=a%20b%26%23")
        address = ListenAddress(everywhere, 8080).url("/", "steer")
        assert address == f"http://{socket.gethostname()}:8080/?token=steer"
