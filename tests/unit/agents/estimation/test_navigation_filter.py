"""The error-state filter: its growth and Jacobians against finite differences, its updates, its gates."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from zsim.scenario.scenario import ErrorModel, ImuConfig
from zsim_agents.estimation import aiding_models, dead_reckoning
from zsim_agents.estimation.error_state import BiasPrior, ProcessNoise
from zsim_agents.estimation.madgwick import LEVEL, rotation
from zsim_agents.estimation.navigation_filter import NavigationFilter, Stack
from zsim_agents.estimation.strapdown import Interval, Strapdown

G = 9.80665  # m/s^2
GATE_S = 0.02  # s
ZERO = (0.0, 0.0, 0.0)
NOISE = ProcessNoise(accel_sigma=0.35, gyro_sigma=2e-4, tilt_density=1e-7, levelling_s=60.0)
GYRO = {"gyro": BiasPrior(3, 1e-3, 1e-5)}
GATE_PROBABILITY = 0.9999
ARM, W = (0.11, -0.07, 0.05), (3.7, -2.0, 1.5)  # m, rad/s
LAG = 0.2  # s
RATE = (0.2, -0.1, 0.4)  # rad/s
FIELD = (-2.8, 17.8, 14.0)  # uT
MOUNT = Rotation.from_euler("ZYX", [40.0, -20.0, 10.0], degrees=True)
P_W, V_W = np.array([3.0, -4.0, 5.0]), np.array([1.5, -0.7, 0.4])
ATTITUDE = Rotation.from_euler("ZYX", [120.0, 15.0, -10.0], degrees=True)


def triple(values) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def flat(turned: Rotation):
    return tuple(turned.as_matrix().ravel().tolist())


def filter_of(biases: dict[str, BiasPrior] = GYRO) -> NavigationFilter:
    navigation = NavigationFilter(NOISE, biases, GATE_PROBABILITY)
    navigation.set_variance(slice(0, 9), 1.0)
    return navigation


def level_at_rest(with_accel_bias: bool = False) -> Strapdown:
    imu = ImuConfig(rate_hz=200.0, accel_m_s2=ErrorModel(noise=0.35))
    return Strapdown(imu, with_accel_bias, 0.35, 0.0, G, GATE_S)


def gps(H, p, v, R):
    return aiding_models.write_gps(H, 1, p, v, R, W, ARM, LAG)


def mag(H, p, v, R):
    return aiding_models.write_mag(H, 1, R, flat(MOUNT), FIELD)


def baro(H, p, v, R):
    return (aiding_models.write_baro(H, 1, p, R, ARM, LAG),)


def sonar(H, p, v, R):
    return (aiding_models.write_sonar(H, 1, p, R, ARM, triple(-MOUNT.as_matrix()[:, 2]), LAG),)


def flow(H, p, v, R):
    return aiding_models.write_flow(H, 1, v, R, W, ARM)


@pytest.mark.parametrize("model", [gps, mag, baro, sonar, flow])
def test_jacobians_are_the_derivatives_of_the_predictions(model: Callable):
    def predicted(error) -> np.ndarray:
        v = V_W + error[3:6]
        p = P_W + error[0:3] - LAG * error[3:6]  # the past position whose error `lag` maps
        turned = Rotation.from_rotvec(error[6:9]) * ATTITUDE
        return np.array(model(np.zeros((8, 12)), triple(p), triple(v), flat(turned)))

    H = np.zeros((8, 12))
    rows = len(model(H, triple(P_W), triple(V_W), flat(ATTITUDE)))
    h = 1e-6
    numeric = np.stack([(predicted(h * e) - predicted(-h * e)) / (2.0 * h) for e in np.eye(9)], 1)
    assert H[1 : 1 + rows, :9] == pytest.approx(numeric, abs=1e-7)
    assert not H[0].any()
    assert not H[1 + rows :].any()
    assert not H[:, 9:].any()


def test_predictions_are_what_the_geometry_says():
    H = np.zeros((8, 12))
    R = ATTITUDE.as_matrix()
    p, v = P_W + R @ ARM, V_W + R @ np.cross(W, ARM)
    yaw = Rotation.from_euler("z", ATTITUDE.as_euler("ZYX")[0])
    assert gps(H, triple(P_W), triple(V_W), flat(ATTITUDE)) == pytest.approx((*p, *v))
    assert baro(H, triple(P_W), triple(V_W), flat(ATTITUDE)) == pytest.approx((p[2],))
    assert flow(H, triple(P_W), triple(V_W), flat(ATTITUDE)) == pytest.approx(yaw.inv().apply(v))
    seen = (ATTITUDE * MOUNT).inv().apply(FIELD)
    assert mag(H, triple(P_W), triple(V_W), flat(ATTITUDE)) == pytest.approx(seen)
    ray = (ATTITUDE * MOUNT).apply([0.0, 0.0, -1.0])
    (distance,) = sonar(H, triple(P_W), triple(V_W), flat(ATTITUDE))
    assert (p + distance * ray)[2] == pytest.approx(0.0)


def test_a_sonar_that_looks_up_says_nothing():
    H = np.zeros((1, 12))
    up = (0.0, 0.0, 1.0)
    assert aiding_models.write_sonar(H, 0, (0.0, 0.0, 3.0), rotation(LEVEL), ZERO, up, 0.0) == 0.0
    assert not H.any()


def test_the_transition_is_the_derivative_of_dead_reckoning():
    dt, f_B = 0.005, (0.5, -0.3, 10.5)  # s, m/s^2

    def reckoned(error) -> dead_reckoning.Reckoning:
        """One step of a drone whose state and biases are off by `error`."""
        w, x, y, z = (Rotation.from_rotvec(error[6:9]) * ATTITUDE).as_quat(scalar_first=True).tolist()
        gyro_bias, accel_bias = triple(error[9:12]), triple(error[12:15])
        rate, force = dead_reckoning.plus(RATE, gyro_bias, -1.0), dead_reckoning.plus(f_B, accel_bias, -1.0)
        a = dead_reckoning.acceleration((w, x, y, z), force, G)
        start = (triple(P_W + error[0:3]), triple(V_W + error[3:6]), (w, x, y, z), a, rate, force)
        return dead_reckoning.reckon(start, f_B, RATE, accel_bias, gyro_bias, 0.0, G, dt)

    nominal = reckoned(np.zeros(15))

    def off(error) -> np.ndarray:
        p, v, q, *_ = reckoned(error)
        turned = Rotation.from_quat(q, scalar_first=True) * Rotation.from_quat(nominal[2], scalar_first=True).inv()
        return np.concatenate([np.subtract(p, nominal[0]), np.subtract(v, nominal[1]), turned.as_rotvec()])

    h = 1e-5
    numeric = np.stack([(off(h * e) - off(-h * e)) / (2.0 * h) for e in np.eye(15)], 1)
    F = np.eye(15)
    R = rotation(nominal[2])
    dead_reckoning.write_transition(F, triple(ATTITUDE.apply(f_B)), R, math.inf, True, dt)
    # The velocity's dependence on the gyroscope's bias is of second order in dt and left out.
    assert F[:9] == pytest.approx(numeric, abs=2e-4)
    assert F[6:9, 9:12] == pytest.approx(numeric[6:9, 9:12], abs=1e-5)
    assert F[9:] == pytest.approx(np.eye(15)[9:])


def test_madgwick_pull_shortens_tilt_but_not_heading_errors():
    F = np.eye(12)
    dead_reckoning.write_transition(F, (0.0, 0.0, G), rotation(LEVEL), 2.0, False, 0.02)
    assert np.diag(F)[6:9] == pytest.approx([math.exp(-0.01), math.exp(-0.01), 1.0], abs=1e-4)


def test_white_acceleration_becomes_a_random_walk_of_velocity():
    navigation = filter_of()
    navigation.set_variance(slice(0, 12), 0.0)
    strapdown = level_at_rest()
    for _ in range(500):
        navigation.advance(strapdown, Interval(GATE_S, ZERO, 4 * 0.005**2, 0.0, 0.0))
    density = 0.35**2 * 0.005  # m^2/s^3, of white noise at 200 Hz
    tilt = NOISE.tilt_density + NOISE.gyro_sigma**2 * 0.005
    assert navigation.P[5, 5] == pytest.approx(density * 10.0, rel=1e-6)
    assert navigation.P[2, 2] == pytest.approx(density * 10.0**3 / 3.0, rel=1e-3)
    assert density * 10.0 < navigation.P[3, 3] < density * 10.0 + tilt * G**2 * 10.0**3 / 3.0


def test_an_update_agrees_with_plain_filterpy():
    navigation, stack = filter_of(), Stack(12)
    plain = ExtendedKalmanFilter(12, 4)
    plain.x, plain.P = np.zeros(12), navigation.P.copy()
    z, H, R = [0.3, -0.2, 0.1, 0.5], np.zeros((4, 12)), np.diag([0.04, 0.09, 0.01, 0.25])
    H[:3, 3:6], H[3, 2] = np.eye(3), 1.0
    stack.H[:4] = H
    stack.add(z[:3], ZERO, (0.04, 0.09, 0.01))
    stack.add(z[3:], (0.0,), (0.25,))
    assert navigation.correct(stack) == [True, True]
    plain.update(np.array(z), lambda x: H, lambda x: np.zeros(4), R)
    assert navigation.take_error() == pytest.approx(plain.x)
    assert pytest.approx(plain.P) == navigation.P
    assert not navigation.x.any()


@pytest.mark.parametrize(("size", "inside"), [(1, True), (1, False), (3, True), (3, False), (6, True), (6, False)])
def test_a_gate_is_the_quantile_of_chi_square(size: int, inside: bool):
    navigation, stack = filter_of(), Stack(12)
    stack.H[:size, :size] = np.eye(size)
    limit = math.sqrt(chi2.ppf(GATE_PROBABILITY, size) * 1.25 / size)  # per row; variance 1 and noise 0.25
    z = [limit * (0.999 if inside else 1.001)] * size
    stack.add(z, [0.0] * size, [0.25] * size)
    before = navigation.P.copy()
    assert navigation.correct(stack) == [inside]
    assert (before == navigation.P).all() != inside


def test_a_refused_measurement_leaves_no_trace_on_those_beside_it():
    H = np.zeros((4, 12))
    H[0, 2], H[1:, 3:6] = 1.0, np.eye(3)
    alone, both = filter_of(), filter_of()
    stack = Stack(12)
    stack.H[:3] = H[1:]
    stack.add([0.1, 0.2, 0.3], ZERO, [0.01] * 3)
    alone.correct(stack)
    stack.clear()
    stack.H[:4] = H
    stack.add([50.0], [0.0], [0.01])
    stack.add([0.1, 0.2, 0.3], ZERO, [0.01] * 3)
    assert both.correct(stack) == [False, True]
    assert both.x == pytest.approx(alone.x)
    assert pytest.approx(alone.P) == both.P


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e300])
def test_what_is_not_a_number_is_refused(bad: float):
    navigation, stack = filter_of(), Stack(12)
    stack.H[0, 0] = 1.0
    stack.add([bad], [0.0], [1.0])
    before = navigation.P.copy()
    with np.errstate(over="ignore", invalid="ignore"):
        assert navigation.correct(stack) == [False]
    assert (before == navigation.P).all()
    assert not navigation.x.any()


def test_a_cleared_stack_is_empty():
    stack = Stack(12)
    stack.H[0, 0] = 1.0
    stack.add([1.0], [0.0], [1.0])
    assert not stack.has_room(32)
    stack.clear()
    assert stack.has_room(32)
    assert not stack.H.any()


def test_bias_states_follow_each_other_with_their_priors():
    navigation = filter_of(GYRO | {"accel": BiasPrior(3, 0.05, 0.01), "baro": BiasPrior(1, 0.5, 0.0)})
    assert navigation.bias_index == {"gyro": 9, "accel": 12, "baro": 15}
    assert np.sqrt(np.diag(navigation.P))[9:] == pytest.approx([1e-3] * 3 + [0.05] * 3 + [0.5])
    before = np.diag(navigation.P)[9:].copy()
    navigation.advance(level_at_rest(with_accel_bias=True), Interval(GATE_S, ZERO, 1e-4, 0.0, 0.0))
    gained = np.diag(navigation.P)[9:] - before
    assert gained == pytest.approx([1e-10 * 0.02] * 3 + [1e-4 * 0.02] * 3 + [0.0], abs=1e-18)


def test_the_sigma_of_the_heading_agrees_with_samples():
    rng = np.random.default_rng(6)
    root = rng.normal(size=(3, 3)) * 0.01
    P = np.zeros((12, 12))
    P[6:9, 6:9] = root @ root.T
    q = tuple(ATTITUDE.as_quat(scalar_first=True).tolist())
    yaw, sigma = dead_reckoning.heading_and_sigma(q, P)
    turned = Rotation.from_rotvec(rng.normal(size=(20_000, 3)) @ root.T) * ATTITUDE
    samples = turned.as_euler("ZYX")[:, 0] - yaw
    assert yaw == pytest.approx(math.radians(120.0))
    assert np.std(samples) == pytest.approx(sigma, rel=0.03)
