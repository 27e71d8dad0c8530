"""The ground: drones stand, slide, settle, and gain no energy from it."""

import math

import numpy as np
import pytest
from vehicle_rows import one_drone

from zsim.math.frames import quaternion_from_rpy, rpy_from_quaternion
from zsim.vehicles.ardrone2 import VEHICLE as ARDRONE2
from zsim_world.physics import rigid_body as body
from zsim_world.physics.fleet_arrays import STATE, VEHICLE, four, vector
from zsim_world.physics.surfaces import contact, drag_anchors

OFF, CALM = np.zeros(4), (0.0, 0.0, 0.0)
DT = 0.0025


FRAME = ARDRONE2.airframe
STAND_HEIGHT_M = FRAME.foot_depth_m - FRAME.foot_sag_m
ROTORS = one_drone()[1]


@pytest.fixture
def row():
    return one_drone()[0]


def placed(height=STAND_HEIGHT_M, rpy=(0.0, 0.0, 0.0)):
    state = np.zeros(STATE.size + 4)
    state[2], state[6:10] = height, quaternion_from_rpy(rpy)
    return state


def stand(row, state, seconds, push=CALM):
    anchor = np.zeros((8, 2))
    drag_anchors(row, anchor, vector(state, 0), four(state, 6))
    track = []
    for _ in range(round(seconds / DT)):
        body.step(row, ROTORS, anchor, state, OFF, CALM, push, DT)
        drag_anchors(row, anchor, vector(state, 0), four(state, 6))
        track.append(state.copy())
    return np.array(track)


def test_feet_carry_the_weight_at_their_sag(row):
    state = placed()
    stand(row, state, 2.0)
    np.testing.assert_allclose(state[:3], (0.0, 0.0, STAND_HEIGHT_M), atol=1e-6)
    np.testing.assert_allclose(state[3:6], 0.0, atol=1e-6)


def test_a_drop_settles_and_never_gains_energy(row):
    state = placed(0.5, (0.2, -0.3, 1.0))
    track = stand(row, state, 4.0)
    inertia = row[VEHICLE.inertia : VEHICLE.inertia + 3]
    kinetic = 0.5 * row[VEHICLE.mass] * (track[:, 3:6] ** 2).sum(1) + 0.5 * (inertia * track[:, 10:13] ** 2).sum(1)
    energy = kinetic + row[VEHICLE.mass] * row[VEHICLE.gravity] * track[:, 2]
    assert energy.max() <= row[VEHICLE.mass] * row[VEHICLE.gravity] * 0.5 * 1.001
    assert kinetic[-1] < 1e-6
    assert abs(state[2] - STAND_HEIGHT_M) < 1e-3
    np.testing.assert_allclose(rpy_from_quaternion(state[6:10])[:2], 0.0, atol=1e-3)


@pytest.mark.parametrize(("share", "moves"), [(0.9, False), (1.1, True)])
def test_friction_holds_up_to_the_cone(row, share, moves):
    weight = row[VEHICLE.mass] * row[VEHICLE.gravity]
    state = placed()
    stand(row, state, 2.0, (share * FRAME.friction * weight, 0.0, 0.0))
    if moves:  # slides with what friction leaves, against the drag of still air
        left = (share - 1.0) * FRAME.friction * weight
        tau = row[VEHICLE.mass] / row[VEHICLE.drag]
        expected = left / row[VEHICLE.drag] * (1 - math.exp(-2.0 / tau))
        assert math.isclose(state[3], expected, rel_tol=0.1)
    else:
        assert abs(state[0]) < 0.01
        assert abs(state[3]) < 1e-6


def test_a_held_push_does_not_creep(row):
    state = placed()
    track = stand(row, state, 20.0, (0.15, -0.1, 0.0))
    np.testing.assert_allclose(track[-1, :2], track[2000, :2], atol=1e-9)


def test_lying_on_its_back_it_rests_on_its_rim(row):
    state = placed(0.3, (math.pi, 0.0, 0.0))
    stand(row, state, 3.0)
    assert abs(state[2] - (FRAME.rim_height_m - FRAME.foot_sag_m)) < 2e-3


def test_no_force_in_the_air(row):
    anchor = np.zeros((8, 2))
    force, moment = contact(row, anchor, (0.0, 0.0, 0.2), CALM, (1.0, 0.0, 0.0, 0.0), CALM)
    assert force == CALM
    assert moment == CALM


def test_ground_never_pulls(row):
    anchor = np.zeros((8, 2))
    force, _ = contact(row, anchor, (0.0, 0.0, 0.0599), (0.0, 0.0, 5.0), (1.0, 0.0, 0.0, 0.0), CALM)
    assert force == CALM
