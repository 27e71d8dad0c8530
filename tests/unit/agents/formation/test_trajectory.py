"""References: expressions with exact rates, waypoints, ramps and refusals."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refused import has_terms, refused

from zsim.contract.snapshot import pack, unpack
from zsim_agents.formation.control_law import FormationGains
from zsim_agents.formation.expression import Expression, ExpressionError
from zsim_agents.formation.flight_check import ShapeLimits
from zsim_agents.formation.guidance import RampPlanner
from zsim_agents.formation.spaces.scenario_space import cluster_space
from zsim_agents.formation.trajectory import (
    ExpressionTrajectory,
    Hold,
    Shifted,
    TrajectoryError,
    WaypointTrajectory,
    named_values,
    ramp_onto,
    reference_of,
    state_of,
)

SPACE = cluster_space(3)
ZERO = np.zeros(12)
GOAL = np.array([5, -5, 15, 0, 0, math.pi / 2, 0, 0, 0, 4, 4, math.pi / 4])  # paper, equation (3)
PAPER_4 = {
    "x_c": "5*cos(2*pi*f*t)", "y_c": "-5*(1 + 1/2*sin(4*pi*f*t))", "z_c": "15 + 5/2*(1 - cos(3*pi*f*t))",
    "yaw": "0.1*t", "p": 4, "q": 4, "beta": "pi/4",
}  # fmt: skip


def numeric_rate(reference, t_s, step=1e-5):
    return (reference.value(t_s + step)[0] - reference.value(t_s - step)[0]) / (2 * step)


# Expressions


@pytest.mark.parametrize(
    ("text", "value", "rate"),
    [
        ("3", 3, 0),
        ("t", 2, 1),
        ("-t + +1", -1, -1),
        ("t**3", 8, 12),
        ("2**t", 4, 4 * math.log(2)),
        ("t**t", 4, 4 * (math.log(2) + 1)),
        ("1/t", 0.5, -0.25),
        ("t*(t - 5)", -6, -1),
        ("sin(w*t)", math.sin(6), 3 * math.cos(6)),
        ("cos(w*t)", math.cos(6), -3 * math.sin(6)),
        ("tan(t)", math.tan(2), 1 / math.cos(2) ** 2),
        ("asin(t/4)", math.asin(0.5), 0.25 / math.sqrt(0.75)),
        ("acos(t/4)", math.acos(0.5), -0.25 / math.sqrt(0.75)),
        ("atan(t)", math.atan(2), 0.2),
        ("sqrt(t)", math.sqrt(2), 0.5 / math.sqrt(2)),
        ("exp(-t)", math.exp(-2), -math.exp(-2)),
        ("log(t)", math.log(2), 0.5),
        ("abs(1 - t)", 1, 1),
        ("min(t, 3, t**2)", 2, 1),
        ("max(t, 3*t, 1)", 6, 3),
        ("2*pi*e", 2 * math.pi * math.e, 0),
        ("sqrt(0)*t", 0, 0),
        ("0**2*t", 0, 0),
        ("+".join(["t"] * 90), 180, 90),
    ],
)
def test_expressions_have_the_expected_value_and_rate_at_2_s(text, value, rate):
    found = Expression("x_c", text, {"w": 3.0})(2.0)
    assert found == pytest.approx((value, rate), abs=1e-15, rel=1e-14)


@settings(deadline=None, max_examples=200, derandomize=True)
@given(st.floats(0.1, 50.0), st.floats(0.05, 3.0))
def test_rates_of_nested_expressions_agree_with_finite_differences(t, w):
    expression = Expression("x", "exp(-t/20)*sin(w*t)**2/(1 + t**1.5) + log(2 + cos(t))*atan(w*t)", {"w": w})
    step = 1e-5
    numeric = (expression(t + step)[0] - expression(t - step)[0]) / (2 * step)
    assert expression(t)[1] == pytest.approx(numeric, abs=1e-7)


@pytest.mark.parametrize(
    ("text", "terms"),
    [
        ("5*foo(t)", ("calls", "'foo'")),
        ("2*g", ("uses", "'g'")),
        ("__import__('os').system('true')", ("calls",)),
        ("t.real", ("contains", "'t.real'")),
        ("(lambda: 1)()", ("calls",)),
        ("[t]", ("contains", "'[t]'")),
        ("t if t else 1", ("contains",)),
        ("t > 1", ("contains", "'t > 1'")),
        ("2^t", ("contains", "'2^t'", "**")),
        ("'a'", ("contains", "'a'")),
        ("True", ("contains", "'True'")),
        ("1j", ("contains", "'1j'")),
        ("t = 3", ("read",)),
        ("", ("read",)),
        ("sin(t", ("read",)),
        ("sin()", ("0", "arguments", "1")),
        ("min(t)", ("1", "arguments", "2", "16")),
        ("sin(x=t)", ("calls", "'sin'")),
        ("sin(*t)", ("contains",)),
        ("1/0", ("without", "value")),
        ("sqrt(-1)*t", ("without", "value")),
        ("9**9**9**9", ("without", "value")),
        ("1e400", ("contains", "'inf'")),
        ("1e308*10", ("value", "inf")),
        ("9" * 400, ("contains", "'999…")),
        ("t+" * 600 + "t", ("1201", "1000")),
        ("-" * 990 + "t", ()),  # too deep for Python's parser or for this one
        ("(" * 300 + "t" + ")" * 300, ("read",)),
        ("not " * 240 + "t", ("contains",)),
        ("t\0", ("read",)),
    ],
)
def test_an_invalid_expression_is_refused_in_one_line(text, terms):
    with refused(ExpressionError, *terms) as caught:
        Expression("x_c", text)
    assert str(caught.value).startswith("x_c: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "t"),
    [("1/(t - 1)", 1.0), ("log(5 - t)", 6.0), ("exp(t)", 1e4), ("sqrt(t)", 0.0), ("t*1e308", 100)],
)
def test_a_value_that_is_not_finite_is_refused_with_its_time(text, t):
    with refused(ExpressionError, "x_c", f"{t:g}"):
        Expression("x_c", text)(t)


@pytest.mark.parametrize(
    ("constants", "terms"),
    [
        ({"t": 1.0}, ("constant", "'t'")),
        ({"pi": 3.0}, ("constant", "'pi'")),
        ({"sin": 3.0}, ("constant", "'sin'")),
        ({"a b": 3.0}, ("constant", "'a b'")),
        ({"f": math.nan}, ("constant f", "'nan'")),
        ({"f": "0.01"}, ("constant f", "'0.01'")),
        ({"f": True}, ("constant f", "'True'")),
        ({"f": 10**400}, ("constant f", "'1000…")),
        ({"f" * 41: 1.0}, ("constant", f"'{'f' * 40}'", "40")),
        ({f"f{i}": 1.0 for i in range(101)}, ("constants", "101", "100")),
    ],
)
def test_bad_constants_are_refused(constants, terms):
    with refused(ExpressionError, *terms):
        Expression("x_c", "t", constants)


def test_the_paper_s_trajectory_has_the_values_of_the_paper():
    f, w = 0.01, 0.02 * math.pi
    trajectory = ExpressionTrajectory(SPACE, PAPER_4, ZERO, {"f": f})
    assert trajectory.duration_s is None
    for t in np.linspace(0.1, 400.0, 50).tolist():
        c, c_dot = trajectory.value(t)
        y, z = -5 * (1 + 0.5 * math.sin(2 * w * t)), 15 + 2.5 * (1 - math.cos(1.5 * w * t))
        assert c == pytest.approx([5 * math.cos(w * t), y, z, 0, 0, 0.1 * t, 0, 0, 0, 4, 4, math.pi / 4], abs=1e-12)
        assert c_dot == pytest.approx(numeric_rate(trajectory, t), abs=1e-7)


def test_an_expression_trajectory_is_constant_outside_its_time():
    trajectory = ExpressionTrajectory(SPACE, {"x_c": "2*t"}, GOAL, duration_s=10.0)
    for t, x in ((-5.0, 0.0), (4.0, 8.0), (50.0, 20.0)):
        c, c_dot = trajectory.value(t)
        assert (c[0], c_dot[0]) == (x, 2.0 if t == 4.0 else 0.0)
        assert (c[1:] == GOAL[1:]).all()


@pytest.mark.parametrize(
    ("expressions", "terms"),
    [
        ({"x": "t"}, ("'x'", "unknown", "x_c")),
        ({"p": math.inf}, ("p", "'inf'")),
        ({"p": [1]}, ("p", "'[1]'")),
        ({"yaw": "90"}, ("yaw", "90", "rad")),
        ({"yaw": "0.1*t", "yaw_deg": "6*t"}, ("expressions", "yaw_deg", "yaw")),
        *[(duration_s, ("duration_s", f"{duration_s}")) for duration_s in (0.0, -1.0, math.nan, math.inf)],
    ],
)
def test_bad_expression_trajectories_are_refused(expressions, terms):
    with refused(ValueError, *terms):
        if isinstance(expressions, float):
            ExpressionTrajectory(SPACE, {}, ZERO, duration_s=expressions)
        else:
            ExpressionTrajectory(SPACE, expressions, ZERO)


# Waypoints


def waypoints(*pairs):
    return [{"at_s": at_s, "values": values} for at_s, values in pairs]


def test_waypoints_are_reached_and_joined_smoothly():
    trajectory = WaypointTrajectory(
        SPACE,
        waypoints((2.0, {"x_c": 1.0}), (5.0, {"x_c": 4.0, "z_c": 10.0}), (9.0, {"x_c": 12.0}), (12.0, {"z_c": 8.0})),
        GOAL,
    )
    assert trajectory.duration_s == 12.0
    met = [trajectory.value(t)[0][[0, 2]].tolist() for t in (2.0, 5.0, 9.0, 12.0)]
    assert met == [[1.0, 15.0], [4.0, 10.0], [12.0, 10.0], [12.0, 8.0]]
    for t in np.linspace(0.0, 14.0, 141).tolist():
        assert trajectory.value(t)[1] == pytest.approx(numeric_rate(trajectory, t), abs=2e-4)
    for knot in (2.0, 5.0, 9.0, 12.0):
        left, right = trajectory.value(knot - 1e-9)[1], trajectory.value(knot + 1e-9)[1]
        assert left == pytest.approx(right, abs=1e-7)
    assert trajectory.value(5.0)[1][0] > 0.5  # it does not stop at an intermediate waypoint


def test_waypoints_do_not_overshoot_and_turn_the_short_way():
    trajectory = WaypointTrajectory(SPACE, waypoints((0, {"x_c": 0}), (1, {"x_c": 10}), (9, {"x_c": 10.1})), ZERO)
    x = [trajectory.value(t)[0][0] for t in np.linspace(0, 9, 200)]
    assert (min(x), max(x)) == (0.0, pytest.approx(10.1))
    assert (np.diff(x) > -1e-12).all()
    trajectory = WaypointTrajectory(SPACE, waypoints((0, {"yaw": 3.0}), (10, {"yaw": -3.0})), ZERO)
    assert trajectory.value(5.0)[0][5] == pytest.approx(math.pi)
    assert trajectory.value(20.0)[0][5] == pytest.approx(2 * math.pi - 3.0)
    assert trajectory.value(-1.0)[0][5] == 3.0
    for t in (-1.0, 20.0):
        assert not trajectory.value(t)[1].any()
    c, c_dot = WaypointTrajectory(SPACE, waypoints((3.0, {"x_c": 1.0})), GOAL).value(100.0)
    assert (c[:2].tolist(), c_dot.any()) == ([1.0, -5.0], False)  # a single waypoint is a fixed point


@pytest.mark.parametrize(
    ("points", "terms"),
    [
        ([], ("0", "waypoints")),
        (waypoints((0, {"x_c": 0})) * 10_001, ("10001", "waypoints")),
        (waypoints((1, {"x_c": 0}), (1, {"x_c": 1})), ("waypoint 2", "at_s", "1", "above", "1")),
        (waypoints((-1, {})), ("waypoint 1", "at_s", "-1")),
        (waypoints((math.nan, {})), ("waypoint 1", "at_s", "nan")),
        (waypoints((0, {"u": 0})), ("waypoint 1", "'u'", "unknown")),
        (waypoints((0, {"x_c": math.nan})), ("waypoint 1", "x_c", "nan")),
        (waypoints((0, {"x_c": "t"})), ("waypoint 1", "x_c", "t")),
        (waypoints((0, {"x_c": 1, "yaw": 45})), ("waypoint 1", "yaw", "45", "rad", "yaw_deg")),
        (waypoints((0, 5)), ("waypoint 1", "'5'")),
        ([{"values": {}}], ("waypoint 1", "at_s", "None")),
        ([{"at_s": 0, "x_c": 1}], ("waypoint 1", "'x_c'", "unknown")),
        ([7], ("waypoint 1", "at_s", "7")),
    ],
)
def test_bad_waypoints_are_refused(points, terms):
    with refused(TrajectoryError, *terms):
        WaypointTrajectory(SPACE, points, ZERO)


# Angles in degrees


def test_the_suffix_deg_of_a_name_gives_an_angle_in_degrees():
    named = named_values(SPACE, {"yaw_deg": 90, "beta_deg": 45, "p": "2*2"}, "target", ZERO)
    assert [named[SPACE.index(name)] for name in ("yaw", "beta", "p")] == pytest.approx([math.pi / 2, math.pi / 4, 4])
    reference = ExpressionTrajectory(SPACE, {"yaw_deg": "6*t", "beta_deg": 45}, ZERO)
    c, c_dot = reference.value(20.0)
    assert (c[5], c_dot[5], c[11]) == pytest.approx((math.radians(120), math.radians(6), math.pi / 4))
    assert WaypointTrajectory(SPACE, waypoints((0, {"yaw_deg": 180})), ZERO).value(0.0)[0][5] == pytest.approx(math.pi)
    assert ExpressionTrajectory(SPACE, {"yaw": "0.1*t"}, ZERO).value(900.0)[0][5] == pytest.approx(90.0)


@pytest.mark.parametrize(
    ("values", "terms"),
    [
        ({"yaw": 90}, ("target", "yaw", "90", "rad", "yaw_deg")),
        ({"beta": 45}, ("target", "beta", "45", "rad", "beta_deg")),
        ({"yaw_deg": 450}, ("target", "yaw_deg", "450", "deg")),
        ({"yaw": 1, "yaw_deg": 57}, ("target", "yaw_deg", "yaw")),
        ({"z_c_deg": 5}, ("target", "'z_c_deg'", "z_c")),
        ({"yaw": "0.1*t"}, ("target", "yaw", "0.1*t")),
    ],
)
def test_a_target_probably_in_the_wrong_unit_is_refused_with_the_unit(values, terms):
    with refused(TrajectoryError, *terms):
        named_values(SPACE, values, "target", ZERO)


# Ramps


def test_a_ramp_from_rest_is_the_minimum_jerk_move():
    start = GOAL - 3.0
    ramp = ramp_onto(SPACE, start, ZERO, Hold(GOAL), 10.0, 8.0)
    for t, share in ((0.0, 0.0), (10.0, 0.0), (14.0, 0.5), (18.0, 1.0), (30.0, 1.0)):
        assert ramp.value(t)[0] == pytest.approx(start + 3.0 * share)
    assert ramp.value(14.0)[1] == pytest.approx(np.full(12, 3.0 / 8.0 * 15 / 8))
    assert ramp.duration_s == 18.0
    start, goal = GOAL.copy(), GOAL.copy()
    start[5], goal[5] = -3.0, 3.0  # the short way round
    yaw = [ramp_onto(SPACE, start, ZERO, Hold(goal), 0.0, 5.0).value(t)[0][5] for t in np.linspace(0, 5, 20)]
    assert max(yaw) - min(yaw) == pytest.approx(2 * math.pi - 6.0)


def test_a_ramp_onto_a_moving_reference_is_smooth_at_both_ends():
    onto = Shifted(ExpressionTrajectory(SPACE, PAPER_4, ZERO, {"f": 0.01}), 5.0)
    c, c_dot = GOAL + 0.5, np.linspace(-0.2, 0.2, 12)
    ramp = ramp_onto(SPACE, c, c_dot, onto, 20.0, 10.0)
    assert SPACE.wrapped(ramp.value(20.0)[0] - c) == pytest.approx(ZERO, abs=1e-12)
    assert ramp.value(20.0)[1] == pytest.approx(c_dot)
    for part in (0, 1):
        assert ramp.value(30.0)[part] == pytest.approx(onto.value(30.0)[part])
    for t in np.linspace(20.1, 31.0, 60).tolist():
        assert ramp.value(t)[1] == pytest.approx(numeric_rate(ramp, t), abs=1e-7)
    before, after = ramp.value(30.0 - 1e-6)[1], ramp.value(30.0 + 1e-6)[1]
    assert before == pytest.approx(after, abs=1e-5)


def test_a_planned_ramp_uses_the_allowed_speed_and_no_more():
    gains, limits = FormationGains(), ShapeLimits()
    onto = ExpressionTrajectory(SPACE, {"x_c": "5*sin(t)"}, GOAL)
    assert has_terms(RampPlanner(SPACE, gains, limits).reference_fault(onto, 0.0, 60.0) or "", "limits", "0.8")
    start = GOAL.copy()
    start[2] = 5.0
    ramp = RampPlanner(SPACE, gains, limits).ramp((start, ZERO), Hold(GOAL), 0.0)
    climb = max(ramp.value(t)[1][2] for t in np.linspace(0, ramp.over_s, 400))
    allowed = limits.share * gains.climb_max_m_s
    assert 0.9 * allowed < climb <= 1.03 * allowed


@pytest.mark.parametrize(
    ("changes", "over_s", "terms"),
    [
        ({}, 1.0, ("over_s", "1", "2…")),
        ({}, math.nan, ("over_s", "nan")),
        ({}, 1e9, ("over_s", "1e+09")),
        ({"x_c": 5e5}, None, ("reached", "3600")),
        ({"x_c": 1e300}, None, ("x_c", "1e+300")),
        ({"beta": 0.1}, None, ("sin(beta)", "min(p, q)", "0…")),
        ({"beta": -0.8}, None, ("beta", "-0.8")),
        ({"p": 0.0}, None, ("p", "0", "between", "0", "inf")),
        ({"p": 2.2, "q": 2.2}, None, ("robots", "2", "3", "1…", "2")),
        ({"roll": 0.7}, None, ("roll", "40.1", "below", "30")),
        ({"pitch": -0.7}, None, ("pitch", "-40.1")),
        ({"z_c": -3.0}, None, ("robot", "z", "0.5")),
    ],
)
def test_ramps_to_an_invalid_formation_are_refused(changes, over_s, terms):
    start, goal = GOAL.copy(), GOAL.copy()
    start[2] = 5.0
    for name, value in changes.items():
        goal[SPACE.index(name)] = value
    with refused(TrajectoryError, *terms):
        RampPlanner(SPACE, FormationGains(), ShapeLimits()).ramp((start, ZERO), Hold(goal), 0.0, over_s)


def test_a_ramp_through_an_invalid_formation_is_refused():
    """Start and end are valid, but robot 4 swings round robot 1 through the position of robot 2."""
    space = cluster_space(4)
    start = np.array([0, 0, 10, 0, 0, 0, 0, 0, 0, 0, 5, 5, math.pi / 2, 5.0, 1.2, 0.0])
    goal = start.copy()
    goal[14] = math.pi
    for end in (start, goal):
        assert RampPlanner(space, FormationGains(), ShapeLimits()).reference_fault(Hold(end), 0.0, 1.0) is None
    with refused(TrajectoryError, "robots", "2", "4", "apart"):
        RampPlanner(space, FormationGains(), ShapeLimits()).ramp((start, np.zeros(16)), Hold(goal), 0.0)


# State


FOLLOWED = ExpressionTrajectory(SPACE, PAPER_4, GOAL, {"f": 0.01}, 60.0)
BETWEEN = WaypointTrajectory(SPACE, [{"at_s": t, "values": {"z_c": 5 + t}} for t in (0.0, 5.0, 9.0)], GOAL)


@pytest.mark.parametrize(
    "reference",
    [
        Hold(GOAL),
        Hold(GOAL, None),
        Shifted(Hold(GOAL, 3.0), 2.5),
        FOLLOWED,
        BETWEEN,
        Shifted(BETWEEN, 1.25),
        ramp_onto(SPACE, ZERO, 0.1 * GOAL, Shifted(FOLLOWED, 0.7), 1.0, 4.0),
    ],
    ids=lambda reference: type(reference).__name__,
)
def test_a_reference_restored_from_its_state_is_identical_to_the_bit(reference):
    again = reference_of(SPACE, unpack(pack(state_of(reference))))
    assert type(again) is type(reference)
    assert again.duration_s == reference.duration_s
    for t_s in np.linspace(0.0, 12.0, 49):
        for part, same in zip(reference.value(t_s), again.value(t_s), strict=True):
            assert np.array_equal(part, same)


def test_only_references_of_this_module_have_a_state():
    with refused(TypeError, "reference", "float"):
        state_of(1.0)  # type: ignore[arg-type]
