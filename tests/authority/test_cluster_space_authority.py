"""The paper's cluster and its controller against figures from outside this code.

Authorities: the paper's equations (3) and (4); positions, determinant, condition numbers and tracking errors that
another implementation computed for this project, to its printed digits; scipy's rotations.
"""

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from zsim_agents.formation.control_law import FormationGains, ProportionalLaw
from zsim_agents.formation.flight_check import ShapeLimits
from zsim_agents.formation.guidance import RampPlanner
from zsim_agents.formation.spaces.cluster_space import Array, closest_pair
from zsim_agents.formation.spaces.scenario_space import cluster_space
from zsim_agents.formation.trajectory import ExpressionTrajectory, Hold, Reference

SPACE = cluster_space(3)
C_DES = np.array([5, -5, 15, 0, 0, math.pi / 2, 0, 0, 0, 4, 4, math.pi / 4])  # paper, equation (3)
EQUATION_4 = {
    "x_c": "5*cos(2*pi*f*t)",
    "y_c": "-5*(1 + 1/2*sin(4*pi*f*t))",
    "z_c": "15 + 5/2*(1 - cos(3*pi*f*t))",
    "yaw": "0.1*t",
    "p": "4",
    "q": "4",
    "beta": "pi/4",
}
GATE_S = 0.02
TRIANGLE = np.array([(0.0, 1.5, 1.5), (-1.5, -1.5, 1.5), (1.5, -1.5, 1.5)])


def changed(**values: float) -> Array:
    c = C_DES.copy()
    for name, value in values.items():
        c[SPACE.index(name)] = value
    return c


# Kinematics


def test_the_paper_s_formation_matches_the_reference_positions():
    p_W, yaw = SPACE.inverse(C_DES)
    assert np.round(p_W, 3).tolist() == [[5.0, -2.536, 15.0], [3.469, -6.232, 15.0], [6.531, -6.232, 15.0]]
    assert yaw == pytest.approx(np.full(3, math.pi / 2))
    distance, i, j = closest_pair(p_W)
    assert (round(distance, 2), i + 1, j + 1) == (3.06, 2, 3)


def test_the_cluster_frame_matches_scipy_s_z_y_x_euler_angles():
    """Each triangle is built from p, q and beta, rotated by scipy and then measured."""
    rng = np.random.default_rng(3)
    for _ in range(2000):
        p, q, beta = rng.uniform(0.5, 8.0), rng.uniform(0.5, 8.0), rng.uniform(0.1, 3.0)
        roll, pitch, yaw = rng.uniform(-3.1, 3.1), rng.uniform(-1.5, 1.5), rng.uniform(-3.1, 3.1)
        flat = np.array([(0.0, 0.0), (p, 0.0), (q * math.cos(beta), q * math.sin(beta))])
        flat -= flat.mean(axis=0)
        to_robot_1 = math.atan2(flat[0, 1], flat[0, 0])
        turn = np.array([(math.cos(to_robot_1), -math.sin(to_robot_1)), (math.sin(to_robot_1), math.cos(to_robot_1))])
        places_C = np.column_stack([flat @ turn, np.zeros(3)])
        centre = rng.normal(scale=20.0, size=3)
        p_W = Rotation.from_euler("ZYX", [yaw, pitch, roll]).apply(places_C) + centre
        expected = [*centre, roll, pitch, yaw, *[-yaw] * 3, p, q, beta]
        assert np.abs(SPACE.difference(SPACE.forward(p_W, np.zeros(3)), np.array(expected))).max() < 1e-9


def test_inverse_undoes_forward_for_ten_thousand_formations():
    rng = np.random.default_rng(4)
    worst = 0.0
    for _ in range(10_000):
        p_W, yaw = rng.normal(scale=4.0, size=(3, 3)), rng.uniform(-math.pi, math.pi, 3)
        c = SPACE.forward(p_W, yaw)
        if SPACE.margin(c) > 0.05:
            worst = max(worst, float(np.abs(SPACE.inverse(c)[0] - p_W).max()))
    assert 0.0 < worst < 5e-12


def test_the_determinant_matches_its_closed_form():
    rng = np.random.default_rng(5)
    for _ in range(500):
        c = np.concatenate(
            [rng.normal(size=3), rng.uniform(-1.4, 1.4, 6), rng.uniform(0.5, 6, 2), [rng.uniform(0.1, 3)]]
        )
        p, q, beta, pitch = c[9], c[10], c[11], c[4]
        determinant = np.linalg.det(SPACE.inverse_jacobian(c))
        assert determinant == pytest.approx(-(p**2) * q**2 * math.sin(beta) * math.cos(pitch), rel=1e-9)


@pytest.mark.parametrize(
    ("c", "condition"),
    [
        (C_DES, 6.9),
        (changed(beta=math.radians(5.0)), 15),
        (changed(beta=math.radians(1.0)), 76),
        (changed(beta=math.radians(175.0)), 335),
        (changed(pitch=math.radians(89.0)), 143),
    ],
    ids=["c_des", "beta 5", "beta 1", "beta 175", "pitch 89"],
)
def test_condition_numbers_match_the_reference(c, condition):
    assert SPACE.condition(c) == pytest.approx(condition, rel=0.04)


def test_the_jacobian_matches_central_differences():
    rng, step = np.random.default_rng(6), 1e-5
    for _ in range(300):
        p_W, yaw = rng.normal(scale=4.0, size=(3, 3)), rng.uniform(-math.pi, math.pi, 3)
        if SPACE.margin(SPACE.forward(p_W, yaw)) < 1.0:
            continue
        numeric = np.zeros((12, 12))
        for k in range(12):
            move = np.zeros((3, 4))
            move[k // 4, k % 4] = step
            after = SPACE.forward(p_W + move[:, :3], yaw + move[:, 3])
            before = SPACE.forward(p_W - move[:, :3], yaw - move[:, 3])
            numeric[:, k] = SPACE.difference(after, before) / (2 * step)
        assert np.abs(numeric - SPACE.jacobian(p_W, yaw)).max() < 1e-7


# Flights of ideal robots with a velocity lag, a delay of one gate, and optional noise and wind


@dataclasses.dataclass
class Flight:
    """Result of a flight: instants, true and desired clusters, and the least distance between robots."""

    t_s: Array
    c: Array
    c_des: Array
    closest_m: float

    def rms(self, from_s: float, to_s: float) -> dict[str, float]:
        """Return the root mean square of true - desired in a window, by variable."""
        window = (self.t_s >= from_s) & (self.t_s <= to_s)
        error = SPACE.wrapped(self.c[window] - self.c_des[window])
        return dict(zip(SPACE.names, np.sqrt((error**2).mean(axis=0)).tolist(), strict=True))


def fly(
    reference: Reference,
    seconds: float,
    *,
    start: tuple[Array, Array],
    gains: FormationGains | None = None,
    lag_s: float = 0.3,
    noise_m: float = 0.0,
    wind_W: tuple[float, float, float] = (0.0, 0.0, 0.0),
    feed_forward: bool = True,
) -> Flight:
    """Fly three robots whose velocities follow the commands of the previous gate with a first-order lag.

    noise_m is the standard deviation of the position estimates, correlated over 1 s like a filter's errors.
    """
    law, rng = ProportionalLaw(SPACE, gains), np.random.default_rng(11)
    p_W, yaw = start[0].copy(), start[1].copy()
    v_W, yaw_rate = np.zeros((3, 3)), np.zeros(3)
    waiting = (np.zeros((3, 3)), np.zeros(3))
    noise, keep = np.zeros((3, 3)), math.exp(-GATE_S)
    steps = round(seconds / GATE_S)
    c_true, c_des, closest_m = np.zeros((steps, 12)), np.zeros((steps, 12)), math.inf
    for k in range(steps):
        c_des[k], rate = reference.value(k * GATE_S)
        c_true[k] = SPACE.forward(p_W, yaw)
        closest_m = min(closest_m, closest_pair(p_W)[0])
        noise = keep * noise + math.sqrt(1 - keep**2) * noise_m * rng.normal(size=(3, 3))
        c = SPACE.forward(p_W + noise, yaw)
        command = law.command(c, p_W + noise, v_W, c_des[k], rate if feed_forward else 0.0 * rate, GATE_S)
        v_W = v_W + (waiting[0] - v_W) * min(1.0, GATE_S / lag_s)
        yaw_rate = yaw_rate + (waiting[1] - yaw_rate) * min(1.0, GATE_S / lag_s)
        p_W = p_W + (v_W + wind_W) * GATE_S
        yaw = yaw + yaw_rate * GATE_S
        waiting = (command.v_W, command.yaw_rate)
    return Flight(np.linspace(0.0, (steps - 1) * GATE_S, steps), c_true, c_des, closest_m)


def from_the_ground_triangle(**kwargs) -> Flight:
    """Fly from TRIANGLE to equation (3) on the ramp that the controller plans."""
    start = (TRIANGLE, np.zeros(3))
    c = SPACE.forward(*start)
    ramp = RampPlanner(SPACE, FormationGains(), ShapeLimits()).ramp((c, np.zeros(12)), Hold(C_DES), 0.0)
    return fly(ramp, 100.0, start=start, **kwargs)


def on_equation_4(**kwargs) -> Flight:
    """Fly equation (4) for 150 s, starting at rest at its first point."""
    trajectory = ExpressionTrajectory(SPACE, EQUATION_4, np.zeros(12), {"f": 0.01})
    return fly(trajectory, 150.0, start=SPACE.inverse(trajectory.value(0.0)[0]), **kwargs)


def test_equation_3_is_reached_with_the_robots_far_apart():
    flight = from_the_ground_triangle()
    assert flight.closest_m > 2.9
    rms = flight.rms(60.0, 100.0)
    assert max(rms.values()) < 0.001
    assert np.abs(SPACE.difference(flight.c[-1], C_DES)).max() < 1e-4


def test_equation_3_is_reached_with_noisy_estimates():
    flight = from_the_ground_triangle(noise_m=0.15)  # a Kalman filter on GPS and flow leaves 0.152 m
    assert flight.closest_m > 2.0
    rms = flight.rms(60.0, 100.0)
    # the robots follow k / (k + 1/tau) of the estimate's variance: rms about 0.15 sqrt(0.6/1.6)/sqrt(3) = 0.053 m
    assert max(rms["x_c"], rms["y_c"], rms["z_c"]) < 0.09
    assert max(rms["p"], rms["q"]) < 0.25


def test_integral_action_removes_the_offset_of_wind_over_gain():
    wind_W = (0.4, -0.3, 0.1)
    without = from_the_ground_triangle(wind_W=wind_W, gains=FormationGains(integral_1_s2=0.0)).rms(80.0, 100.0)
    assert [without[name] for name in ("x_c", "y_c", "z_c")] == pytest.approx([0.4 / 0.6, 0.5, 0.1 / 0.6], rel=0.01)
    assert max(from_the_ground_triangle(wind_W=wind_W).rms(80.0, 100.0).values()) < 0.001


def test_equation_4_is_tracked_as_well_as_by_another_implementation():
    flight = on_equation_4()
    rms = flight.rms(50.0, 150.0)
    for name, most in {
        "x_c": 0.014,
        "y_c": 0.024,
        "z_c": 0.018,
        "yaw": 0.004,
        "p": 0.034,
        "q": 0.034,
    }.items():
        assert rms[name] <= most, name
    assert flight.closest_m > 3.0


def test_equation_4_without_feed_forward_lags_by_its_rate_over_the_gain():
    gains = FormationGains(k_1_s=0.5, integral_1_s2=0.0)
    rms = on_equation_4(feed_forward=False, gains=gains).rms(50.0, 150.0)
    for name, lag in {"x_c": 0.45, "y_c": 0.44, "z_c": 0.34, "yaw": 0.20}.items():
        assert rms[name] == pytest.approx(lag, rel=0.05), name


def test_equation_4_is_tracked_with_noisy_estimates():
    flight = on_equation_4(noise_m=0.15)
    assert flight.closest_m > 2.0
    rms = flight.rms(50.0, 150.0)
    assert max(rms["x_c"], rms["y_c"], rms["z_c"]) < 0.09


def test_saturated_robots_keep_their_shape_on_a_step_across_the_field():
    start = SPACE.inverse(changed(x_c=-15.0, y_c=12.0, z_c=4.0, yaw=-0.5))
    flight = fly(Hold(C_DES), 60.0, start=start)
    speed = np.hypot(*np.diff(flight.c[:, :2], axis=0).T) / GATE_S
    assert speed.max() > 0.85 * FormationGains().speed_max_m_s  # the step does saturate the speed
    # another implementation: 0.07 m of shape error in transit with a common factor, 1.25 m with clipping per axis
    assert np.abs(flight.c[:, 9:11] - 4.0).max() < 0.15
    assert flight.closest_m > 2.5
    assert np.abs(SPACE.difference(flight.c[-1], C_DES)).max() < 0.05
