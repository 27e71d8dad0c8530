"""Madgwick's filter against closed forms and scipy's rotations; the growth of errors of dead reckoning."""

import math
import os
import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from zsim.math.rotation import LEVEL, Quaternion, Vector, heading, matrix, subtract
from zsim_agents.estimation import strapdown
from zsim_agents.estimation.filter_state import Reckoning
from zsim_agents.estimation.kalman_update import predicted_covariance
from zsim_agents.estimation.strapdown import madgwick_step

G = 9.80665  # m/s^2
DT, GATE_S = 0.005, 0.02  # s
ZERO = (0.0, 0.0, 0.0)
RATE = (0.2, -0.1, 0.4)  # rad/s
P_W, V_W = np.array([3.0, -4.0, 5.0]), np.array([1.5, -0.7, 0.4])
ATTITUDE = Rotation.from_euler("ZYX", [120.0, 15.0, -10.0], degrees=True)


def quaternion(rotation: Rotation) -> Quaternion:
    w, x, y, z = rotation.as_quat(scalar_first=True).tolist()
    return w, x, y, z


def as_rotation(q: Quaternion) -> Rotation:
    return Rotation.from_quat(q, scalar_first=True)


def tilt(q: Quaternion) -> float:
    """Return the angle between the body's z axis and the vertical [rad]."""
    return math.acos(min(1.0, as_rotation(q).as_matrix()[2, 2]))


def triple(values) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.36, 0.48, 0.8)])
def test_a_constant_rate_turns_about_the_body_axis_by_rate_times_time(axis):
    rate, steps = 3.0, 400  # rad/s; 2 s
    start = Rotation.from_euler("ZYX", [100.0, 20.0, -30.0], degrees=True)
    q = quaternion(start)
    for _ in range(steps):
        q = madgwick_step(q, triple(np.multiply(rate, axis)), ZERO, 0.1, DT)
    expected = start * Rotation.from_rotvec(np.array(axis) * rate * steps * DT)
    assert (as_rotation(q) * expected.inv()).magnitude() < 1e-9


def test_the_gradient_is_the_derivative_of_the_objective():
    rng = np.random.default_rng(2)

    def objective(q, f):
        w, x, y, z = q
        seen = np.array([2 * (x * z - w * y), 2 * (w * x + y * z), 1 - 2 * (x * x + y * y)])
        return 0.5 * np.sum((seen - f / np.linalg.norm(f)) ** 2)

    for _ in range(20):
        q, f = rng.normal(size=4), rng.normal(size=3)
        q /= np.linalg.norm(q)
        h = 1e-6
        numeric = [(objective(q + h * e, f) - objective(q - h * e, f)) / (2 * h) for e in np.eye(4)]
        assert strapdown.gravity_gradient(tuple(q), tuple(f)) == pytest.approx(numeric, abs=1e-8)


def test_the_accelerometer_levels_at_twice_beta_and_keeps_the_heading():
    beta, steps = 0.1, 100
    true = Rotation.from_euler("ZYX", [40.0, 0.0, 0.0], degrees=True)
    start = Rotation.from_rotvec([0.2, 0.1, 0.0]) * true
    q = quaternion(start)
    for _ in range(steps):
        q = madgwick_step(q, ZERO, triple(true.inv().apply([0.0, 0.0, G])), beta, DT)
    lost = tilt(quaternion(start)) - tilt(q)
    assert lost == pytest.approx(2.0 * beta * steps * DT, rel=0.02)  # a small part of the step is along q itself
    assert heading(q) == pytest.approx(start.as_euler("ZYX")[0], abs=0.005)


def test_the_tilt_decays_with_the_levelling_time_under_noise():
    sigma, levelling = 0.35 / G, 2.0  # rad, s
    beta = strapdown.beta_for(levelling, sigma)
    assert strapdown.levelling_time_s(beta, sigma) == pytest.approx(levelling)
    rng = np.random.default_rng(3)
    left = []
    for _ in range(40):
        q = quaternion(Rotation.from_rotvec([0.02, 0.0, 0.0]))  # rad, within the noise
        for noise in rng.normal(scale=0.35, size=(round(levelling / DT), 3)):
            q = madgwick_step(q, ZERO, (noise[0], noise[1], noise[2] + G), beta, DT)
        left.append(as_rotation(q).as_rotvec()[0])
    assert np.mean(left) == pytest.approx(0.02 * math.exp(-1.0), rel=0.15)


def test_only_the_gyroscope_counts_without_gain_or_specific_force():
    q = quaternion(Rotation.from_rotvec([0.3, 0.0, 0.0]))
    by_gyro = madgwick_step(q, (0.0, 0.0, 1.0), ZERO, 0.5, DT)
    assert madgwick_step(q, (0.0, 0.0, 1.0), (1.0, 2.0, 9.0), 0.0, DT) == by_gyro
    assert strapdown.levelling_time_s(0.0, 0.03) == math.inf
    rng = np.random.default_rng(4)
    for w, f in zip(rng.normal(size=(5000, 3)), rng.normal(size=(5000, 3)), strict=True):
        q = madgwick_step(q, tuple(w), tuple(f), 0.2, DT)
    assert math.fsum(x * x for x in q) == pytest.approx(1.0, abs=1e-14)


PATH = """
import numpy as np
from zsim_agents.estimation.strapdown import reckon
rng = np.random.default_rng(5)
zero = (0.0, 0.0, 0.0)
state = (zero, zero, (1.0, 0.0, 0.0, 0.0), zero, zero, zero)
for f, w in zip(rng.normal(size=(2000, 3)), rng.normal(size=(2000, 3))):
    state = reckon(state, tuple((f + (0, 0, 9.8)).tolist()), tuple(w.tolist()), zero, zero, 0.05, 9.8, 0.005)
print([x.hex() for part in state for x in part])
"""


def test_compiled_and_plain_python_give_identical_results():
    pytest.importorskip("numba")
    outputs = set()
    for disabled in ("0", "1"):
        env = {**os.environ, "NUMBA_DISABLE_JIT": disabled}
        run = subprocess.run([sys.executable, "-c", PATH], env=env, capture_output=True, text=True, check=True)
        outputs.add(run.stdout)
    assert len(outputs) == 1
    assert "0x" in outputs.pop()


# Growth of errors


def test_the_transition_is_the_derivative_of_dead_reckoning():
    dt, f_B = 0.005, (0.5, -0.3, 10.5)  # s, m/s^2

    def reckoned(error) -> Reckoning:
        """Return one step of a drone whose state and biases differ by `error`."""
        w, x, y, z = (Rotation.from_rotvec(error[6:9]) * ATTITUDE).as_quat(scalar_first=True).tolist()
        gyro_bias, accel_bias = triple(error[9:12]), triple(error[12:15])
        rate, force = subtract(RATE, gyro_bias), subtract(f_B, accel_bias)
        a = strapdown.acceleration((w, x, y, z), force, G)
        start = (triple(P_W + error[0:3]), triple(V_W + error[3:6]), (w, x, y, z), a, rate, force)
        return strapdown.reckon(start, f_B, RATE, accel_bias, gyro_bias, 0.0, G, dt)

    nominal = reckoned(np.zeros(15))

    def off(error) -> np.ndarray:
        p, v, q, *_ = reckoned(error)
        turned = Rotation.from_quat(q, scalar_first=True) * Rotation.from_quat(nominal[2], scalar_first=True).inv()
        return np.concatenate([np.subtract(p, nominal[0]), np.subtract(v, nominal[1]), turned.as_rotvec()])

    h = 1e-5
    numeric = np.stack([(off(h * e) - off(-h * e)) / (2.0 * h) for e in np.eye(15)], 1)
    F = np.eye(15)
    R = matrix(nominal[2])
    strapdown.write_transition(F, triple(ATTITUDE.apply(f_B)), R, math.inf, True, dt)
    # The dependence of velocity on gyroscope bias is of second order in dt and neglected.
    assert F[:9] == pytest.approx(numeric, abs=2e-4)
    assert F[6:9, 9:12] == pytest.approx(numeric[6:9, 9:12], abs=1e-5)
    assert F[9:] == pytest.approx(np.eye(15)[9:])
    F = np.eye(12)  # Madgwick's correction reduces errors of the tilt, but not of the heading
    strapdown.write_transition(F, (0.0, 0.0, G), matrix(LEVEL), 2.0, False, 0.02)
    assert np.diag(F)[6:9] == pytest.approx([math.exp(-0.01), math.exp(-0.01), 1.0], abs=1e-4)


def test_white_acceleration_noise_becomes_a_random_walk_of_velocity():
    accel_variance, tilt_variance = 0.35**2 * 4 * 0.005**2, 1e-9  # per gate: m^2/s^2 from four samples, rad^2
    rest = (ZERO, ZERO, LEVEL, ZERO, ZERO, (0.0, 0.0, G))
    P, variances = np.zeros((12, 12)), (accel_variance, tilt_variance, tilt_variance)
    for _ in range(500):
        F, Q = np.eye(12), np.zeros((12, 12))
        strapdown.write_prediction(F, Q, np.zeros(12), rest, ZERO, G, 60.0, False, variances, GATE_S)
        P = predicted_covariance(P, F, Q)
    density = 0.35**2 * 0.005  # m^2/s^3, density of white noise sampled at 200 Hz
    assert P[5, 5] == pytest.approx(density * 10.0, rel=1e-6)
    assert P[2, 2] == pytest.approx(density * 10.0**3 / 3.0, rel=1e-3)
    assert density * 10.0 < P[3, 3] < density * 10.0 + tilt_variance / GATE_S * G**2 * 10.0**3 / 3.0
    walk = np.array([0.0] * 9 + [1e-10] * 3 + [1e-4] * 3 + [0.0])
    F, Q = np.eye(16), np.zeros((16, 16))
    strapdown.write_prediction(F, Q, walk, rest, ZERO, G, 60.0, True, (1e-4, 1e-9, 1e-9), GATE_S)
    gained = np.diag(predicted_covariance(np.zeros((16, 16)), F, Q))[9:]
    assert gained == pytest.approx(walk[9:] * GATE_S, abs=1e-18)


def test_the_sigma_of_the_heading_agrees_with_samples():
    rng = np.random.default_rng(6)
    root = rng.normal(size=(3, 3)) * 0.01
    P = np.zeros((12, 12))
    P[6:9, 6:9] = root @ root.T
    q = tuple(ATTITUDE.as_quat(scalar_first=True).tolist())
    yaw, sigma = strapdown.heading_and_sigma(q, P)
    turned = Rotation.from_rotvec(rng.normal(size=(20_000, 3)) @ root.T) * ATTITUDE
    samples = turned.as_euler("ZYX")[:, 0] - yaw
    assert yaw == pytest.approx(math.radians(120.0))
    assert np.std(samples) == pytest.approx(sigma, rel=0.03)
