"""Madgwick's filter against closed forms and scipy's rotations."""

import math
import os
import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from zsim.math.rotation import LEVEL, Quaternion, Vector, heading
from zsim_agents.estimation import dead_reckoning

G = 9.80665  # m/s^2
DT = 0.005  # s, 200 Hz


def quaternion(rotation: Rotation) -> Quaternion:
    w, x, y, z = rotation.as_quat(scalar_first=True).tolist()
    return w, x, y, z


def as_rotation(q: Quaternion) -> Rotation:
    return Rotation.from_quat(q, scalar_first=True)


def tilt(q: Quaternion) -> float:
    """Angle between the body's z axis and the vertical [rad]."""
    return math.acos(min(1.0, as_rotation(q).as_matrix()[2, 2]))


def at_rest(q_true: Rotation) -> Vector:
    x, y, z = (q_true.inv().apply([0.0, 0.0, G])).tolist()
    return x, y, z


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.36, 0.48, 0.8)])
def test_a_constant_rate_turns_by_rate_times_time(axis):
    rate, steps = 3.0, 400  # rad/s; 2 s
    q = LEVEL
    w = (rate * axis[0], rate * axis[1], rate * axis[2])
    for _ in range(steps):
        q = dead_reckoning.madgwick_step(q, w, (0.0, 0.0, 0.0), 0.1, DT)
    expected = Rotation.from_rotvec(np.array(axis) * rate * steps * DT)
    assert (as_rotation(q) * expected.inv()).magnitude() < 1e-9


def test_body_rates_multiply_on_the_right():
    start = Rotation.from_euler("ZYX", [100.0, 20.0, -30.0], degrees=True)
    q = dead_reckoning.madgwick_step(quaternion(start), (10.0, -20.0, 30.0), (0.0, 0.0, 0.0), 0.0, DT)
    expected = start * Rotation.from_rotvec(np.array([10.0, -20.0, 30.0]) * DT)
    assert (as_rotation(q) * expected.inv()).magnitude() < 1e-12


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
        assert dead_reckoning.gravity_gradient(tuple(q), tuple(f)) == pytest.approx(numeric, abs=1e-8)


def test_the_accelerometer_levels_by_two_beta_and_keeps_the_heading():
    beta, steps = 0.1, 100
    true = Rotation.from_euler("ZYX", [40.0, 0.0, 0.0], degrees=True)
    start = Rotation.from_rotvec([0.2, 0.1, 0.0]) * true
    q = quaternion(start)
    for _ in range(steps):
        q = dead_reckoning.madgwick_step(q, (0.0, 0.0, 0.0), at_rest(true), beta, DT)
    lost = tilt(quaternion(start)) - tilt(q)
    assert lost == pytest.approx(2.0 * beta * steps * DT, rel=0.02)  # a little of the step is along q itself
    assert heading(q) == pytest.approx(start.as_euler("ZYX")[0], abs=0.005)


def test_under_noise_the_tilt_decays_with_the_levelling_time():
    sigma, levelling = 0.35 / G, 2.0  # rad, s
    beta = dead_reckoning.beta_for(levelling, sigma)
    assert dead_reckoning.levelling_time_s(beta, sigma) == pytest.approx(levelling)
    rng = np.random.default_rng(3)
    left = []
    for _ in range(40):
        q = quaternion(Rotation.from_rotvec([0.02, 0.0, 0.0]))  # rad, within the noise
        for noise in rng.normal(scale=0.35, size=(round(levelling / DT), 3)):
            q = dead_reckoning.madgwick_step(q, (0.0, 0.0, 0.0), (noise[0], noise[1], noise[2] + G), beta, DT)
        left.append(as_rotation(q).as_rotvec()[0])
    assert np.mean(left) == pytest.approx(0.02 * math.exp(-1.0), rel=0.15)


def test_without_gain_or_force_only_the_gyroscope_counts():
    q = quaternion(Rotation.from_rotvec([0.3, 0.0, 0.0]))
    by_gyro = dead_reckoning.madgwick_step(q, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 0.5, DT)
    assert dead_reckoning.madgwick_step(q, (0.0, 0.0, 1.0), (1.0, 2.0, 9.0), 0.0, DT) == by_gyro
    assert dead_reckoning.levelling_time_s(0.0, 0.03) == math.inf


def test_the_length_stays_one_over_many_steps():
    rng = np.random.default_rng(4)
    q = LEVEL
    for w, f in zip(rng.normal(size=(5000, 3)), rng.normal(size=(5000, 3)), strict=True):
        q = dead_reckoning.madgwick_step(q, tuple(w), tuple(f), 0.2, DT)
    assert math.fsum(x * x for x in q) == pytest.approx(1.0, abs=1e-14)


PATH = """
import numpy as np
from zsim_agents.estimation.dead_reckoning import reckon
rng = np.random.default_rng(5)
zero = (0.0, 0.0, 0.0)
state = (zero, zero, (1.0, 0.0, 0.0, 0.0), zero, zero, zero)
for f, w in zip(rng.normal(size=(2000, 3)), rng.normal(size=(2000, 3))):
    state = reckon(state, tuple((f + (0, 0, 9.8)).tolist()), tuple(w.tolist()), zero, zero, 0.05, 9.8, 0.005)
print([x.hex() for part in state for x in part])
"""


def test_compiled_and_plain_python_give_the_same_bits():
    pytest.importorskip("numba")
    outputs = set()
    for disabled in ("0", "1"):
        ran = subprocess.run(
            [sys.executable, "-c", PATH],
            env={**os.environ, "NUMBA_DISABLE_JIT": disabled},
            capture_output=True,
            text=True,
            check=True,
        )
        outputs.add(ran.stdout)
    assert len(outputs) == 1
    assert "0x" in outputs.pop()
