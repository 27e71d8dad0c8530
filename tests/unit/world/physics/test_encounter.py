"""Hulls that touch, and downwash."""

import math

import numpy as np
import pytest

from zsim.scenario.scenario_file import resolve
from zsim_world.fleet.initial_state import near
from zsim_world.physics import rigid_body as body
from zsim_world.physics.encounter import JET_WIDTHS, downwash, encounters, hull_force
from zsim_world.state import vehicle
from zsim_world.state.fleet_arrays import Near

RADIUS = vehicle.HULL_RADIUS_M


@pytest.fixture(scope="module")
def rows():
    drones = [{"name": f"d{k}", "position_m": [2 * k, 0, 0]} for k in range(3)]
    scenario = resolve({"name": "t", "duration_s": 1, "drones": drones})
    return np.array([vehicle.parameters(drone, scenario.environment) for drone in scenario.drones])


def meet(rows, positions, velocities=None, rotor=0.0):
    n = len(positions)
    state = np.zeros((n, body.COLUMNS))
    state[:, :3], state[:, body.ATTITUDE], state[:, body.ROTOR :] = positions, 1.0, rotor
    if velocities is not None:
        state[:, 3:6] = velocities
    air, push = np.zeros((n, 3)), np.zeros((n, 3))
    touching, touched = np.zeros((n, n), np.int8), np.zeros((n, n), np.int8)
    least = encounters(rows[:n], state, air, push, touching, touched, near(n))
    return least, air, push, touching, touched


def test_least_distance_of_all_pairs(rows):
    least, _, push, touching, _ = meet(rows, [(0, 0, 5), (3, 4, 5), (3, 4, 6)])
    assert least == 1.0
    assert not push.any()
    assert not touching.any()


def test_touching_hulls_push_each_other_apart_and_keep_momentum(rows):
    _, _, push, touching, touched = meet(rows, [(0, 0, 5), (2 * RADIUS - 0.02, 0, 5), (9, 9, 9)])
    np.testing.assert_allclose(push.sum(0), 0.0, atol=1e-12)
    assert math.isclose(push[1, 0], rows[0, vehicle.HULL_STIFFNESS] * 0.02, rel_tol=1e-9)
    assert push[0, 0] < 0
    assert touching[0, 1] == touched[0, 1] == 1
    assert touching.sum() == 1


def test_hull_resists_closing_and_never_attracts():
    assert hull_force(1000.0, 10.0, 0.02, 1.0) == pytest.approx(1000.0 * 0.02 + 10.0)
    assert hull_force(1000.0, 10.0, 0.01, -5.0) == 0.0
    assert hull_force(1000.0, 10.0, 0.0, 5.0) == 0.0


def test_head_on_collision_rebounds_and_loses_energy(rows):
    """Two free bodies at 3 m/s towards each other; drag and gravity off."""
    rows = rows.copy()
    rows[:, vehicle.DRAG] = rows[:, vehicle.GRAVITY] = 0.0
    state = np.zeros((2, body.COLUMNS))
    state[:, body.ATTITUDE] = 1.0
    state[:, :3] = [(0.0, 0.0, 50.0), (0.6, 0.0, 50.0)]
    state[:, 3] = (1.5, -1.5)
    air, push = np.zeros((2, 3)), np.zeros((2, 3))
    touching, touched = np.zeros((2, 2), np.int8), np.zeros((2, 2), np.int8)
    anchor, least, pairs = np.zeros((8, 2)), 9.0, near(2)
    for _ in range(400):
        push[:] = 0.0
        least = min(least, encounters(rows[:2], state, air, push, touching, touched, pairs))
        for i in range(2):
            body.step(rows[i], anchor, state[i], (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), body.vector(push[i], 0), 0.0025)
    assert abs(state[:, 3].sum()) < 1e-9
    assert 0.3 < (state[1, 3] - state[0, 3]) / 3.0 < 0.7
    assert 2 * RADIUS - 0.06 < least < 2 * RADIUS


def test_two_drones_in_one_place_give_no_nan(rows):
    _, air, push, _, _ = meet(rows, [(0, 0, 5), (0, 0, 5), (9, 9, 9)], rotor=360.0)
    assert np.isfinite(push).all()
    assert np.isfinite(air).all()


@pytest.mark.parametrize("below", [0.0, 0.5, 3.0])
def test_downwash_carries_the_thrust(below):
    """The momentum of the jet, integrated over a plane below, is the thrust at every depth."""
    radii = np.linspace(0.0, 4.0, 20001)
    speed = np.array([downwash(4.2, 1.225, 0.1, below, r) for r in radii])
    flux = np.trapezoid(1.225 * speed**2 * 2 * np.pi * radii, radii)
    assert math.isclose(flux, 4.2, rel_tol=1e-3)


def test_downwash_at_the_disc_is_twice_the_induced_speed():
    induced = math.sqrt(4.2 / (2 * 1.225 * 4 * math.pi * 0.1**2))
    assert math.isclose(downwash(4.2, 1.225, 0.1, 0.0, 0.0), 2 * induced, rel_tol=1e-12)


def test_downwash_blows_on_the_lower_drone_only(rows):
    _, air, _, _, _ = meet(rows, [(0, 0, 6), (0.1, 0, 4), (8, 0, 4)], rotor=361.6)
    assert air[1, 2] < -2.0
    assert air[0, 2] == air[2, 2] == 0.0


def test_downwash_ends_beside_the_jet():
    assert downwash(4.2, 1.225, 0.1, 2.0, JET_WIDTHS * 0.43) == 0.0


def all_pairs(state):
    """Return every pair as near, wherever the drones go next."""
    n = len(state)
    pairs = np.array([(i, j) for i in range(n) for j in range(i + 1, n)], dtype=np.int32)
    return Near(pair=pairs, noted=np.array([len(pairs)]), origin=state[:, :3].copy())


@pytest.mark.parametrize(
    ("size_m", "speed_m_s"), [((3.0, 3.0, 3.0), 1.0), ((15.0, 15.0, 40.0), 8.0), ((0.5, 9.0, 9.0), 3.0)]
)
def test_near_pairs_give_the_bits_of_all_pairs(rows, size_m, speed_m_s):
    """Drones of two sizes in a box, for 3 s: every touch, every jet and the least distance are found."""
    rng = np.random.default_rng(7)
    n, found = 12, 0
    rows = np.repeat(rows[:1], n, axis=0)
    rows[::3, [vehicle.ROTOR_RADIUS, vehicle.HULL_RADIUS]] *= 1.7
    state = np.zeros((n, body.COLUMNS))
    state[:, body.ATTITUDE], state[:, body.ROTOR :] = 1.0, 350.0
    state[:, :3] = rng.uniform(0.0, size_m, (n, 3))
    pairs, ours, theirs = near(n), *(np.zeros((2, n, n), np.int8) for _ in range(2))
    for _ in range(300):
        state[:, 3:6] = rng.normal(0.0, speed_m_s, (n, 3))
        state[:, :3] += 0.01 * state[:, 3:6]
        (air, push), (other_air, other_push) = np.zeros((2, n, 3)), np.zeros((2, n, 3))
        before = pairs.origin.copy()
        least = encounters(rows, state, air, push, ours[0], ours[1], pairs)
        found += not np.array_equal(before, pairs.origin)
        assert least == encounters(rows, state, other_air, other_push, theirs[0], theirs[1], all_pairs(state))
        for one, other in ((air, other_air), (push, other_push), (ours, theirs)):
            np.testing.assert_array_equal(one, other)
    assert 1 < found < 300
    assert pairs.noted[0] > 0
