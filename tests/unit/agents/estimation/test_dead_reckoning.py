"""Dead reckoning: how its small errors grow, against finite differences and samples."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from zsim.math.rotation import LEVEL, matrix, subtract
from zsim_agents.estimation import dead_reckoning
from zsim_agents.estimation.kalman_update import predicted_covariance

G = 9.80665  # m/s^2
GATE_S = 0.02  # s
ZERO = (0.0, 0.0, 0.0)
RATE = (0.2, -0.1, 0.4)  # rad/s
P_W, V_W = np.array([3.0, -4.0, 5.0]), np.array([1.5, -0.7, 0.4])
ATTITUDE = Rotation.from_euler("ZYX", [120.0, 15.0, -10.0], degrees=True)


def triple(values) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def test_the_transition_is_the_derivative_of_dead_reckoning():
    dt, f_B = 0.005, (0.5, -0.3, 10.5)  # s, m/s^2

    def reckoned(error) -> dead_reckoning.Reckoning:
        """One step of a drone whose state and biases are off by `error`."""
        w, x, y, z = (Rotation.from_rotvec(error[6:9]) * ATTITUDE).as_quat(scalar_first=True).tolist()
        gyro_bias, accel_bias = triple(error[9:12]), triple(error[12:15])
        rate, force = subtract(RATE, gyro_bias), subtract(f_B, accel_bias)
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
    R = matrix(nominal[2])
    dead_reckoning.write_transition(F, triple(ATTITUDE.apply(f_B)), R, math.inf, True, dt)
    # The velocity's dependence on the gyroscope's bias is of second order in dt and left out.
    assert F[:9] == pytest.approx(numeric, abs=2e-4)
    assert F[6:9, 9:12] == pytest.approx(numeric[6:9, 9:12], abs=1e-5)
    assert F[9:] == pytest.approx(np.eye(15)[9:])


def test_madgwick_pull_shortens_tilt_but_not_heading_errors():
    F = np.eye(12)
    dead_reckoning.write_transition(F, (0.0, 0.0, G), matrix(LEVEL), 2.0, False, 0.02)
    assert np.diag(F)[6:9] == pytest.approx([math.exp(-0.01), math.exp(-0.01), 1.0], abs=1e-4)


def test_white_acceleration_becomes_a_random_walk_of_velocity():
    accel_variance, tilt_variance = 0.35**2 * 4 * 0.005**2, 1e-9  # over a gate: m^2/s^2 of four samples, rad^2
    rest = (ZERO, ZERO, LEVEL, ZERO, ZERO, (0.0, 0.0, G))
    P, variances = np.zeros((12, 12)), (accel_variance, tilt_variance, tilt_variance)
    for _ in range(500):
        F, Q = np.eye(12), np.zeros((12, 12))
        dead_reckoning.write_prediction(F, Q, np.zeros(12), rest, ZERO, G, 60.0, False, variances, GATE_S)
        P = predicted_covariance(P, F, Q)
    density = 0.35**2 * 0.005  # m^2/s^3, of white noise at 200 Hz
    assert P[5, 5] == pytest.approx(density * 10.0, rel=1e-6)
    assert P[2, 2] == pytest.approx(density * 10.0**3 / 3.0, rel=1e-3)
    assert density * 10.0 < P[3, 3] < density * 10.0 + tilt_variance / GATE_S * G**2 * 10.0**3 / 3.0


def test_bias_states_gain_their_random_walk():
    rest = (ZERO, ZERO, LEVEL, ZERO, ZERO, (0.0, 0.0, G))
    walk = np.array([0.0] * 9 + [1e-10] * 3 + [1e-4] * 3 + [0.0])
    F, Q = np.eye(16), np.zeros((16, 16))
    dead_reckoning.write_prediction(F, Q, walk, rest, ZERO, G, 60.0, True, (1e-4, 1e-9, 1e-9), GATE_S)
    gained = np.diag(predicted_covariance(np.zeros((16, 16)), F, Q))[9:]
    assert gained == pytest.approx(walk[9:] * GATE_S, abs=1e-18)


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
