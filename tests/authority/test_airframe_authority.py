"""Airframes as the literature has them: off-centre rotors are trimmed, drag and thrust follow the flow past them.

Sources: RotorS (Furrer et al. 2016) for the Iris; RotorPy (Folk et al. 2023) and Svacha, Mohta and Kumar (ICUAS 2017)
for k_d, k_z, k_h and quadratic drag; Faessler, Franchi and Scaramuzza (RA-L 2018) for drag by axis.
"""

import math
from typing import Any

import numpy as np
import pytest

from zsim.math.frames import quaternion_from_rpy
from zsim.scenario.scenario_file import resolve
from zsim.vehicles.vehicle import allocation, lift_shares
from zsim.vehicles.vehicle_catalogue import vehicle_of
from zsim_world.fleet.fleet import Fleet
from zsim_world.physics.fleet_arrays import STATE, VEHICLE

pytestmark = pytest.mark.xdist_group("airframes")  # so that no worker waits for another that compiles the kernel

ROTORS = slice(STATE.size, STATE.size + 4)  # of drone a: with the Iris there is a column more


def fleet_of(**drone: Any) -> Fleet:
    """Return a fleet of one drone.

    Rotors that are no cross, and aerodynamics, have kernels of their own, each a minute's compilation. So where there
    are some, an Iris with aerodynamics stands far away: one kernel does for all.
    """
    drones = [{"name": "a", "position_m": [0, 0, 0], **drone}]
    if "model" in drone or any(drone.get("aerodynamics", {}).values()):
        far = {"name": "b", "position_m": [100, 0, 0], "model": "iris"}
        drones.append({**far, "aerodynamics": {"rotor_drag_n_s2_m": 1e-4}})
    return Fleet(resolve({"name": "t", "duration_s": 1, "sensors": {"preset": "paper"}, "drones": drones}))


def advance(fleet: Fleet, seconds: float, steer: Any = None) -> None:
    for _ in range(round(seconds / 0.02)):
        if steer:
            steer()
        fleet.advance()


def thrown(
    fleet: Fleet, v: Any, q: Any = (1.0, 0.0, 0.0, 0.0), rotor: float = 0.0, seconds: float = 0.02
) -> np.ndarray:
    """Let a drone with its rotors at a speed go through still air high up, and return the state after some gates."""
    state = fleet.bodies.state[0]
    state[:] = 0.0
    state[2], state[3:6], state[6:10], state[ROTORS] = 1e4, v, q, rotor
    advance(fleet, seconds)
    return fleet.bodies.state[0]


def test_the_iris_of_rotors_hovers_level_with_its_rear_rotors_faster() -> None:
    """Moments about the centre: the thrust of each rotor times its arm sums to zero, in closed form x_f / x_r."""
    vehicle = vehicle_of("iris")
    shares = lift_shares(vehicle)
    np.testing.assert_allclose(allocation(vehicle) @ shares, 0.0, atol=1e-9)
    x = np.array([rotor.x_m for rotor in vehicle.rotors])
    np.testing.assert_allclose(shares[0] / shares[2], -x[2] / x[0], rtol=1e-9)
    fleet = fleet_of(model="iris")
    assert fleet.takeoff(0) is None
    advance(fleet, 8.0)
    assert fleet.status(0)[0] == "hovering"
    squares, tilts = [], []
    for _ in range(200):
        fleet.advance()
        squares.append(fleet.truth().rotor_rad_s[0, :4] ** 2)
        w, x_, y, z = fleet.truth().orientation_wxyz[0]
        tilts.append((w * x_ + y * z, w * y - x_ * z))
    mean = np.mean(squares, axis=0)
    np.testing.assert_allclose(mean / mean.mean(), shares, rtol=0.01)
    assert vehicle.thrust_n_s2 * mean.sum() == pytest.approx(vehicle.mass_kg * 9.80665, rel=0.01)
    assert np.degrees(np.abs(np.mean(tilts, axis=0)) * 2).max() < 0.5
    assert fleet.truth().position_m[0, 2] == pytest.approx(vehicle.takeoff_height_m, abs=0.1)
    advance(fleet, 8.0, lambda: fleet.set_velocity(0, (2.0, 0.0, 0.0), 0.5))
    assert np.hypot(*fleet.truth().velocity_m_s[0, :2]) == pytest.approx(2.0, abs=0.3)
    assert fleet.land(0) is None
    advance(fleet, 10.0)
    assert fleet.status(0)[0] == "landed"


def test_terminal_velocity_with_quadratic_drag() -> None:
    """m g = c v^2: a fall with still rotors, and the same on its side with another coefficient."""
    drag = {"quadratic_drag_n_s2_m2": [0.02, 0.02, 0.08]}
    for rpy, c in (((0.0, 0.0, 0.0), 0.08), ((math.pi / 2, 0.0, 0.0), 0.02)):
        fleet = fleet_of(drag_n_s_m=0.0, aerodynamics=drag)
        state = thrown(fleet, (0.0, 0.0, 0.0), quaternion_from_rpy(rpy), seconds=12.0)
        assert -state[5] == pytest.approx(math.sqrt(0.429 * 9.80665 / c), rel=1e-3)


def test_linear_drag_by_axis_turns_with_the_body() -> None:
    """dv/dt = -R D R^T v / m - g (Faessler et al.), for a body yawed by 30 deg in level flight."""
    fleet = fleet_of(drag_n_s_m=0.0, aerodynamics={"linear_drag_n_s_m": [0.3, 0.6, 0.1]})
    v, yaw = np.array([3.0, 1.0, 0.0]), math.radians(30.0)
    end = thrown(fleet, v, quaternion_from_rpy((0.0, 0.0, yaw)))[3:6]
    turn = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
    rate = -turn @ np.diag([0.3, 0.6, 0.1]) @ turn.T / 0.429
    expected = v + 0.02 * (rate @ v)
    np.testing.assert_allclose(end[:2], expected[:2], atol=2e-3)  # second order: (0.6 / 0.429 * 0.02)^2 / 2 of 3 m/s
    assert abs(end[0] - v[0]) > 0.02


@pytest.mark.parametrize(
    ("coefficients", "v", "force"),
    [
        # four rotors at 400 rad/s: -k_d w u across, (k_h u^2 - k_z w u_z) along (RotorPy, compute_body_wrench)
        ({"rotor_drag_n_s2_m": 1e-4}, (3.0, -2.0, 0.0), (-4 * 1e-4 * 400 * 3.0, 4 * 1e-4 * 400 * 2.0, 0.0)),
        ({"rotor_inflow_n_s2_m": 1e-4}, (0.0, 0.0, 2.0), (0.0, 0.0, -4 * 1e-4 * 400 * 2.0)),
        ({"rotor_lift_n_s2_m2": 5e-3}, (3.0, 4.0, 0.0), (0.0, 0.0, 4 * 5e-3 * 25.0)),
    ],
    ids=["k_d", "k_z", "k_h"],
)
def test_thrust_depends_on_the_flow_past_the_rotors(coefficients: Any, v: Any, force: Any) -> None:
    rotor = 400.0
    plain, flown = fleet_of(drag_n_s_m=0.0), fleet_of(drag_n_s_m=0.0, aerodynamics=coefficients)
    accel = []
    for fleet in (plain, flown):
        state = fleet.bodies.state[0]
        state[:] = 0.0
        state[2], state[3:6], state[6], state[ROTORS] = 1e4, v, 1.0, rotor
        fleet._integrate(0)  # the accelerations of the present state
        accel.append(fleet.bodies.accel[0, :3].copy())
    np.testing.assert_allclose(0.429 * (accel[1] - accel[0]), force, rtol=1e-9, atol=1e-12)


def test_a_rotor_that_stands_still_gives_no_lift_in_a_wind() -> None:
    fleet = fleet_of(drag_n_s_m=0.0, aerodynamics={"rotor_lift_n_s2_m2": 0.05})
    assert thrown(fleet, (8.0, 0.0, 0.0), seconds=0.2)[5] == pytest.approx(-9.80665 * 0.2, rel=1e-6)


def test_turning_rotors_damp_a_roll_by_their_inflow() -> None:
    """M = -k_z w y^2 p for each rotor at y: a lever arm, not a force at the centre."""
    k_z, rate = 1e-4, 2.0
    fleet = fleet_of(drag_n_s_m=0.0, aerodynamics={"rotor_inflow_n_s2_m": k_z})
    state = fleet.bodies.state[0]
    state[:] = 0.0
    state[2], state[6], state[10], state[ROTORS] = 1e4, 1.0, rate, 400.0
    fleet._integrate(0)
    y = fleet.bodies.vehicle[0, VEHICLE.rotor_unit]
    expected = -4 * k_z * 400.0 * y * y * rate / fleet.bodies.vehicle[0, VEHICLE.inertia]
    assert fleet.bodies.accel[0, 3] == pytest.approx(expected, rel=1e-9)


def test_without_aerodynamics_they_are_no_part_of_the_kernel() -> None:
    plain, none = fleet_of(), fleet_of(aerodynamics={"rotor_drag_n_s2_m": 0.0})
    assert plain.bodies.aero_parts == none.bodies.aero_parts == (0,)
    for fleet in (plain, none):
        fleet.takeoff(0)
        advance(fleet, 2.0)
    assert (plain.bodies.state == none.bodies.state).all()
    assert STATE.size + 4 == plain.bodies.state.shape[1]


def test_it_flies_with_all_of_them() -> None:
    """RotorPy's figures of the Crazyflie and of the Hummingbird's body, on the AR.Drone: it holds its hover and speed."""
    given = {
        "quadratic_drag_n_s2_m2": [0.005, 0.005, 0.01],
        "rotor_drag_n_s2_m": 1.19e-4,
        "rotor_inflow_n_s2_m": 2.32e-4,
        "rotor_lift_n_s2_m2": 3.39e-3,
    }
    fleet = fleet_of(drag_n_s_m=0.0, aerodynamics=given)
    assert fleet.takeoff(0) is None
    advance(fleet, 8.0)
    assert fleet.status(0)[0] == "hovering"
    advance(fleet, 6.0, lambda: fleet.set_velocity(0, (3.0, 0.0, 0.0), 0.0, "world"))
    assert fleet.truth().velocity_m_s[0, 0] == pytest.approx(3.0, abs=0.4)
    assert fleet.truth().position_m[0, 2] == pytest.approx(1.0, abs=0.3)
