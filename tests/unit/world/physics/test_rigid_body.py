"""The rigid body against closed forms."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vehicle_rows import one_drone

from zsim_world.physics import rigid_body as body
from zsim_world.physics.fleet_arrays import STATE, VEHICLE

OFF = (0.0, 0.0, 0.0, 0.0)
ROTORS = one_drone()[1]
CALM = NOBODY = (0.0, 0.0, 0.0)
DT = 0.0025


@pytest.fixture
def row():
    return one_drone()[0]


@pytest.fixture
def state():
    state = np.zeros(STATE.size + 4)
    state[2] = 1e4
    state[STATE.q_WB] = 1.0
    return state


def fly(row, state, seconds, command=OFF, air=CALM, push=NOBODY, dt=DT):
    anchor, command = np.zeros((8, 2)), np.array(command)
    for _ in range(round(seconds / dt)):
        body.step(row, ROTORS, anchor, state, command, air, push, dt)
    return state


def test_free_fall_with_linear_drag_matches_the_closed_form(row, state):
    tau, g = row[VEHICLE.mass] / row[VEHICLE.drag], row[VEHICLE.gravity]
    state[3] = 4.0
    fly(row, state, 3.0)
    decay = math.exp(-3.0 / tau)
    assert math.isclose(state[5], -g * tau * (1 - decay), rel_tol=1e-9)
    assert math.isclose(state[2], 1e4 - g * tau * (3.0 - tau * (1 - decay)), rel_tol=1e-12)
    assert math.isclose(state[0], 4.0 * tau * (1 - decay), rel_tol=1e-9)


def test_wind_carries_a_falling_body_along(row, state):
    fly(row, state, 30.0, air=(3.0, -2.0, 0.0))
    terminal = row[VEHICLE.mass] * row[VEHICLE.gravity] / row[VEHICLE.drag]
    np.testing.assert_allclose(state[3:6], (3.0, -2.0, -terminal), rtol=1e-6)


def test_a_push_acts_as_a_force(row, state):
    row[VEHICLE.drag] = 0.0
    fly(row, state, 1.0, push=(0.429, 0.0, 0.0))
    np.testing.assert_allclose(state[3:6], (1.0, 0.0, -row[VEHICLE.gravity]), rtol=1e-9)


def test_torque_free_motion_keeps_energy_and_angular_momentum(row, state):
    inertia = row[VEHICLE.inertia : VEHICLE.inertia + 3]
    state[10:13] = (3.0, 5.0, -4.0)
    turn = Rotation.from_quat(state[6:10], scalar_first=True)
    momentum, energy = turn.apply(inertia * state[10:13]), inertia @ state[10:13] ** 2
    fly(row, state, 10.0)
    turn = Rotation.from_quat(state[6:10], scalar_first=True)
    np.testing.assert_allclose(turn.apply(inertia * state[10:13]), momentum, atol=2e-9)
    assert math.isclose(inertia @ state[10:13] ** 2, energy, rel_tol=2e-7)


def test_a_symmetric_top_precesses_at_the_predicted_rate(row, state):
    ix, iz = 2e-3, 5e-3
    row[VEHICLE.inertia : VEHICLE.inertia + 3] = (ix, ix, iz)
    wz, across, t = 6.0, 1.0, 2.0
    state[10:13] = (across, 0.0, wz)
    fly(row, state, t)
    omega = (iz - ix) / ix * wz  # Euler's equations: the body rate turns about z_B at this rate
    expected = (across * math.cos(omega * t), across * math.sin(omega * t), wz)
    np.testing.assert_allclose(state[10:13], expected, atol=2e-5)


def test_the_integration_step_is_of_fourth_order(row):
    def end(dt):
        state = np.zeros(STATE.size + 4)
        state[2], state[STATE.q_WB] = 100.0, 1.0
        state[10:13], state[13:17] = (4.0, -3.0, 8.0), (400.0, 350.0, 300.0, 380.0)
        return fly(row, state, 0.64, (200.0, 480.0, 300.0, 400.0), dt=dt)

    exact = end(0.00125)
    ratio = np.linalg.norm(end(0.02) - exact) / np.linalg.norm(end(0.01) - exact)
    assert 12.0 < ratio < 22.0


def test_hover_speed_carries_the_weight(row, state):
    speed = math.sqrt(row[VEHICLE.mass] * row[VEHICLE.gravity] / (4 * row[VEHICLE.thrust]))
    state[13:17] = speed
    fly(row, state, 2.0, (speed,) * 4)
    np.testing.assert_allclose(state[3:6], 0.0, atol=1e-9)
    np.testing.assert_allclose(state[:3], (0.0, 0.0, 1e4), atol=1e-6)


def test_the_rotor_step_response_is_exact_at_any_step(row, state):
    lag = row[VEHICLE.rotor_lag]
    for dt in (0.0025, 0.02):
        state[13:17] = 200.0
        fly(row, state, 0.06, (400.0,) * 4, dt=dt)
        np.testing.assert_allclose(state[13:17], 400.0 - 200.0 * math.exp(-0.06 / lag), rtol=1e-12)


def test_attitude_stays_a_unit_quaternion(row, state):
    state[10:13] = (20.0, -30.0, 25.0)
    fly(row, state, 2.0)
    assert math.isclose(np.linalg.norm(state[6:10]), 1.0, rel_tol=1e-14)
