"""Gusts, contacts between hulls, and downwash."""

import math

import numpy as np
import pytest

from zsim.scenario.scenario_file import resolve
from zsim.vehicles.ardrone2 import VEHICLE as ARDRONE2
from zsim_world.fleet.fleet import Fleet
from zsim_world.physics import contacts
from zsim_world.physics.contacts import JET_WIDTHS, WIND, downwash, hull_force, meet_drones
from zsim_world.physics.fleet_arrays import STATE, VEHICLE, NearPairs

pytestmark = pytest.mark.usefixtures("interpreted")
RADIUS = ARDRONE2.airframe.hull_radius_m


def bodies_at(positions, velocities=None, rotor=0.0):
    n = len(positions)
    drones = [{"name": f"d{k}", "position_m": [2 * k, 0, 0]} for k in range(n)]
    made = Fleet(resolve({"name": "t", "duration_s": 1, "drones": drones})).bodies
    made.state[:, :3], made.state[:, STATE.size :] = positions, rotor
    if velocities is not None:
        made.state[:, 3:6] = velocities
    made.air[:], made.push[:], made.touching[:], made.touched[:] = 0.0, 0.0, 0, 0
    made.near.origin[:] = np.inf
    return made


def meet(positions, velocities=None, rotor=0.0):
    met = bodies_at(positions, velocities, rotor)
    least = meet_drones(met)
    return least, met.air, met.push, met.touching, met.touched


def test_the_least_distance_of_all_pairs_is_returned():
    least, _, push, touching, _ = meet([(0, 0, 5), (3, 4, 5), (3, 4, 6)])
    assert least == 1.0
    assert not push.any()
    assert not touching.any()


def test_touching_hulls_push_each_other_apart_and_keep_momentum():
    _, _, push, touching, touched = meet([(0, 0, 5), (2 * RADIUS - 0.02, 0, 5), (9, 9, 9)])
    np.testing.assert_allclose(push.sum(0), 0.0, atol=1e-12)
    assert math.isclose(push[1, 0], bodies_at([(0, 0, 5)]).vehicle[0, VEHICLE.hull_stiffness] * 0.02, rel_tol=1e-9)
    assert push[0, 0] < 0
    assert touching[0, 1] == touched[0, 1] == 1
    assert touching.sum() == 1


def test_a_hull_resists_closing_and_never_attracts():
    assert hull_force(1000.0, 10.0, 0.02, 1.0) == pytest.approx(1000.0 * 0.02 + 10.0)
    assert hull_force(1000.0, 10.0, 0.01, -5.0) == 0.0
    assert hull_force(1000.0, 10.0, 0.0, 5.0) == 0.0


def test_a_head_on_collision_rebounds_and_loses_energy():
    """Two free bodies approach each other at 3 m/s, without drag and gravity."""
    met = bodies_at([(0.0, 0.0, 50.0), (0.6, 0.0, 50.0)])
    met.vehicle[:, VEHICLE.drag] = met.vehicle[:, VEHICLE.gravity] = 0.0
    state, least, step_s = met.state, 9.0, 0.0025
    state[:, STATE.q_WB : STATE.size], state[:, STATE.q_WB], state[:, 3] = 0.0, 1.0, (1.5, -1.5)
    for _ in range(400):
        met.push[:] = 0.0
        least = min(least, meet_drones(met))
        state[:, 3:6] += step_s * met.push / met.vehicle[:, [VEHICLE.mass]]
        state[:, :3] += step_s * state[:, 3:6]
    assert abs(state[:, 3].sum()) < 1e-9
    assert 0.3 < (state[1, 3] - state[0, 3]) / 3.0 < 0.7
    assert 2 * RADIUS - 0.06 < least < 2 * RADIUS


def test_two_drones_at_the_same_place_give_no_nan():
    _, air, push, _, _ = meet([(0, 0, 5), (0, 0, 5), (9, 9, 9)], rotor=360.0)
    assert np.isfinite(push).all()
    assert np.isfinite(air).all()


@pytest.mark.parametrize("below", [0.0, 0.5, 3.0])
def test_downwash_carries_the_thrust(below):
    """The momentum of the jet, integrated over a plane below, equals the thrust at every depth."""
    radii = np.linspace(0.0, 4.0, 20001)
    speed = np.array([downwash(4.2, 1.225, 0.2, below, r) for r in radii])
    flux = np.trapezoid(1.225 * speed**2 * 2 * np.pi * radii, radii)
    assert math.isclose(flux, 4.2, rel_tol=1e-3)


def test_downwash_at_the_disc_is_twice_the_induced_speed():
    induced = math.sqrt(4.2 / (2 * 1.225 * 4 * math.pi * 0.1**2))
    assert math.isclose(downwash(4.2, 1.225, 0.2, 0.0, 0.0), 2 * induced, rel_tol=1e-12)


def test_downwash_acts_only_on_the_lower_drone():
    _, air, _, _, _ = meet([(0, 0, 6), (0.1, 0, 4), (8, 0, 4)], rotor=361.6)
    assert air[1, 2] < -2.0
    assert air[0, 2] == air[2, 2] == 0.0


def test_downwash_ends_beside_the_jet():
    assert downwash(4.2, 1.225, 0.2, 2.0, JET_WIDTHS * 0.43) == 0.0


def all_pairs(state):
    """Return every pair as a near one, wherever the drones go next."""
    n = len(state)
    pairs = np.array([(i, j) for i in range(n) for j in range(i + 1, n)], dtype=np.int32)
    above, eye = np.zeros(len(state), dtype=np.int8), np.zeros((len(state), 3))
    return NearPairs(pairs, np.array([len(pairs)]), state[:, :3].copy(), above, eye)


@pytest.mark.parametrize(
    ("size_m", "speed_m_s"), [((3.0, 3.0, 3.0), 1.0), ((15.0, 15.0, 40.0), 8.0), ((0.5, 9.0, 9.0), 3.0)]
)
def test_near_pairs_give_the_same_bits_as_all_pairs(size_m, speed_m_s):
    """Drones of two sizes in a box, for 3 s: every touch, every jet and the least distance are found."""
    rng = np.random.default_rng(7)
    n, searches = 12, 0
    one = bodies_at(np.zeros((n, 3)), rotor=350.0)
    one.vehicle[::3, [VEHICLE.rotor_radius, VEHICLE.hull_radius]] *= 1.7
    one.state[:, :3] = rng.uniform(0.0, size_m, (n, 3))
    other = one._replace(**{name: getattr(one, name).copy() for name in ("air", "push", "touching", "touched")})
    for _ in range(300):
        one.state[:, 3:6] = rng.normal(0.0, speed_m_s, (n, 3))
        one.state[:, :3] += 0.01 * one.state[:, 3:6]
        for each in (one, other):
            each.air[:], each.push[:] = 0.0, 0.0
        before = one.near.origin.copy()
        least = meet_drones(one)
        searches += not np.array_equal(before, one.near.origin)
        assert least == meet_drones(other._replace(near=all_pairs(one.state)))
        for name in ("air", "push", "touching", "touched"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert 1 < searches < 300
    assert one.near.number[0] > 0


CALM = (0.0, 0.0, 0.0)


def parameters(gust=1.0, length=10.0, slowest=2.0, correlation=0.5, steady=CALM):
    row = np.zeros(WIND.size)
    row[WIND.steady : WIND.steady + 3] = steady
    row[WIND.gust], row[WIND.length] = gust, length
    row[WIND.speed_min], row[WIND.correlation] = slowest, correlation
    return row


@pytest.mark.parametrize(("airspeed", "tau"), [(0.0, 5.0), (1.9, 5.0), (4.0, 2.5)])
def test_correlation_time_is_length_over_airspeed(airspeed, tau):
    assert math.isclose(contacts.gust_decay(10.0, airspeed, 2.0, 0.1), math.exp(-0.1 / tau), rel_tol=1e-12)


def test_without_fresh_noise_a_gust_decays():
    gust = np.array([1.0, -2.0, 0.5])
    contacts.advance_gust(parameters(), CALM, gust, CALM, CALM, 0.5)
    # airspeed 2.29 m/s: correlation time 10 / 2.29
    decay = math.exp(-0.5 * math.sqrt(1 + 4 + 0.25) / 10.0)
    np.testing.assert_allclose(gust, np.array([1.0, -2.0, 0.5]) * decay, rtol=1e-12)


def test_steady_wind_and_motion_count_as_airspeed():
    gust = np.array([1.0, 0.0, 0.0])
    contacts.advance_gust(parameters(steady=(6.0, 0.0, 0.0)), (-1.0, 0.0, 0.0), gust, CALM, CALM, 0.5)
    assert math.isclose(gust[0], math.exp(-0.5 * 8.0 / 10.0), rel_tol=1e-12)


def test_the_gust_variance_is_independent_of_the_step():
    """sigma^2 = decay^2 sigma^2 + fresh^2: a normal number of 1 adds sigma sqrt(1 - decay^2)."""
    for dt in (0.005, 0.1, 20.0):
        gust = np.zeros(3)
        contacts.advance_gust(parameters(gust=0.7, correlation=0.0), CALM, gust, CALM, (1.0, 1.0, 1.0), dt)
        decay = math.exp(-dt / 5.0)
        np.testing.assert_allclose(gust, 0.7 * math.sqrt(1 - decay**2), rtol=1e-12)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_shared_noise_has_unit_variance_and_the_requested_share(share):
    assert contacts.gust_noise(share, 1.0, 0.0) ** 2 == pytest.approx(share)
    assert contacts.gust_noise(share, 1.0, 0.0) ** 2 + contacts.gust_noise(share, 0.0, 1.0) ** 2 == pytest.approx(1.0)
