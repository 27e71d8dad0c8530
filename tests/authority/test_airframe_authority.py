"""Airframes against the literature: off-centre rotors are trimmed; drag and thrust depend on the air flow past them.

Sources: RotorS (Furrer et al. 2016) for the Iris; RotorPy (Folk et al. 2023) and Svacha, Mohta and Kumar (ICUAS 2017)
for k_d, k_z, k_h and quadratic drag; Faessler, Franchi and Scaramuzza (RA-L 2018) for drag by axis.
"""

import math
from typing import Any

import numpy as np
import pytest

from zsim.math.frames import quaternion_from_rpy
from zsim.scenario.scenario import Scenario
from zsim.scenario.scenario_file import resolve
from zsim.vehicles.vehicle import allocation, lift_shares, vehicle_of
from zsim_world.fleet.fleet import Fleet, _initial_arrays
from zsim_world.physics import simd
from zsim_world.physics.fleet_arrays import STATE, VEHICLE, Bodies
from zsim_world.sensors.noise import NoiseTable
from zsim_world.sensors.sensor_set import fleet_sensors

pytestmark = pytest.mark.usefixtures("interpreted")

ROTORS = slice(STATE.size, STATE.size + 4)  # speeds of drone a's rotors; with the Iris, a state has one more column
FAR_IRIS = {"name": "b", "position_m": [100, 0, 0], "model": "iris", "aerodynamics": {"rotor_drag_n_s2_m": 1e-4}}
GRAVITY_M_S2, MASS_KG = 9.80665, 0.429


def scenario_of(*more: dict[str, Any], **drone: Any) -> Scenario:
    drones = [{"name": "a", "position_m": [0, 0, 0], **drone}, *more]
    return resolve({"name": "t", "duration_s": 1, "sensors": {"preset": "paper"}, "drones": drones})


def bodies_of(**drone: Any) -> Bodies:
    """Return the bodies of a drone and of a distant Iris with aerodynamics.

    Aerodynamics and rotors that do not form a cross need code of their own; with the Iris, one kernel serves all.
    """
    scenario = scenario_of(FAR_IRIS, **drone)
    vehicles = [vehicle_of(each.model) for each in scenario.drones]
    return _initial_arrays(scenario, vehicles, fleet_sensors(scenario), NoiseTable(scenario, 1)).bodies


def thrown(
    v: Any, q: Any = (1.0, 0.0, 0.0, 0.0), rate: float = 0.0, rotors: Any = 0.0, **drone: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Return the linear [m/s^2] and angular [rad/s^2] accelerations of a drone high up in still air.

    Args:
        v, q: velocity [m/s] and attitude; rate: roll rate [rad/s]; rotors: steady rotor speeds [rad/s].
    """
    bodies = bodies_of(**drone)
    state = bodies.state[0]
    state[:] = 0.0
    state[2], state[3:6], state[6:10], state[10], state[ROTORS] = 1e4, v, q, rate, rotors
    bodies.command[0, :4] = rotors
    simd.line_up(bodies)
    simd.accelerate(bodies)
    return bodies.accel[0, :3].copy(), bodies.accel[0, 3:].copy()


def advance(fleet: Fleet, seconds: float, steer: Any = None) -> None:
    for _ in range(round(seconds / 0.02)):
        if steer:
            steer()
        fleet.advance()


def test_the_iris_hovers_level_with_faster_rear_rotors() -> None:
    """The moments of thrust about the centre of mass sum to zero, so the ratio of thrusts is that of the lever arms."""
    vehicle = vehicle_of("iris")
    shares = lift_shares(vehicle)
    np.testing.assert_allclose(allocation(vehicle) @ shares, 0.0, atol=1e-9)
    x = np.array([rotor.x_m for rotor in vehicle.rotors])
    np.testing.assert_allclose(shares[0] / shares[2], -x[2] / x[0], rtol=1e-9)
    squares = vehicle.mass_kg * GRAVITY_M_S2 / vehicle.thrust_n_s2 * shares / shares.sum()
    accel, turning = thrown((0.0, 0.0, 0.0), rotors=np.sqrt(squares), model="iris")
    np.testing.assert_allclose(accel, 0.0, atol=1e-6)
    np.testing.assert_allclose(turning, 0.0, atol=1e-6)


@pytest.mark.soak
def test_the_iris_flies_with_faster_rear_rotors() -> None:
    vehicle = vehicle_of("iris")
    shares = lift_shares(vehicle)
    fleet = Fleet(scenario_of(FAR_IRIS, model="iris"))
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
    """m g = c v^2 in a fall with stopped rotors, upright and on its side, where another coefficient applies."""
    drag = {"quadratic_drag_n_s2_m2": [0.02, 0.02, 0.08]}
    for rpy, c in (((0.0, 0.0, 0.0), 0.08), ((math.pi / 2, 0.0, 0.0), 0.02)):
        v = (0.0, 0.0, -math.sqrt(MASS_KG * GRAVITY_M_S2 / c))
        accel, _ = thrown(v, quaternion_from_rpy(rpy), drag_n_s_m=0.0, aerodynamics=drag)
        np.testing.assert_allclose(accel, 0.0, atol=1e-9)


def test_linear_drag_by_axis_rotates_with_the_body() -> None:
    """dv/dt = -R D R^T v / m - g (Faessler et al.), for a body yawed by 30 deg in level flight."""
    drag = {"linear_drag_n_s_m": [0.3, 0.6, 0.1]}
    v, yaw = np.array([3.0, 1.0, 0.0]), math.radians(30.0)
    accel, _ = thrown(v, quaternion_from_rpy((0.0, 0.0, yaw)), drag_n_s_m=0.0, aerodynamics=drag)
    turn = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
    rate = -turn @ np.diag([0.3, 0.6, 0.1]) @ turn.T / MASS_KG
    np.testing.assert_allclose(accel, rate @ v - (0.0, 0.0, GRAVITY_M_S2), rtol=1e-9, atol=1e-9)
    assert abs(accel[0]) > 1.0


@pytest.mark.parametrize(
    ("coefficients", "v", "force"),
    [
        # four rotors at 400 rad/s: -k_d w u across the axis, (k_h u^2 - k_z w u_z) along (RotorPy, compute_body_wrench)
        ({"rotor_drag_n_s2_m": 1e-4}, (3.0, -2.0, 0.0), (-4 * 1e-4 * 400 * 3.0, 4 * 1e-4 * 400 * 2.0, 0.0)),
        ({"rotor_inflow_n_s2_m": 1e-4}, (0.0, 0.0, 2.0), (0.0, 0.0, -4 * 1e-4 * 400 * 2.0)),
        ({"rotor_lift_n_s2_m2": 5e-3}, (3.0, 4.0, 0.0), (0.0, 0.0, 4 * 5e-3 * 25.0)),
    ],
    ids=["k_d", "k_z", "k_h"],
)
def test_rotor_forces_depend_on_the_flow_past_the_rotors(coefficients: Any, v: Any, force: Any) -> None:
    plain, _ = thrown(v, rotors=400.0, drag_n_s_m=0.0)
    flown, _ = thrown(v, rotors=400.0, drag_n_s_m=0.0, aerodynamics=coefficients)
    np.testing.assert_allclose(MASS_KG * (flown - plain), force, rtol=1e-9, atol=1e-12)


def test_a_stopped_rotor_gives_no_lift_in_an_air_flow() -> None:
    accel, _ = thrown((8.0, 0.0, 0.0), drag_n_s_m=0.0, aerodynamics={"rotor_lift_n_s2_m2": 0.05})
    np.testing.assert_allclose(accel, (0.0, 0.0, -GRAVITY_M_S2), rtol=1e-9, atol=1e-12)


def test_rotor_inflow_damps_a_roll() -> None:
    """M = -k_z w y^2 p for each rotor at y: the force acts on a lever arm, not at the centre."""
    k_z, rate = 1e-4, 2.0
    _, turning = thrown((0.0, 0.0, 0.0), rate=rate, rotors=400.0, aerodynamics={"rotor_inflow_n_s2_m": k_z})
    vehicle = bodies_of().vehicle[0]
    expected = -4 * k_z * 400.0 * vehicle[VEHICLE.rotor_unit] ** 2 * rate / vehicle[VEHICLE.inertia]
    assert turning[0] == pytest.approx(expected, rel=1e-9)


def test_the_kernel_omits_aerodynamics_with_zero_coefficients() -> None:
    plain, none = (Fleet(scenario_of(**drone)) for drone in ({}, {"aerodynamics": {"rotor_drag_n_s2_m": 0.0}}))
    assert plain.bodies.aero_parts == none.bodies.aero_parts == (0,)
    for fleet in (plain, none):
        fleet.takeoff(0)
        advance(fleet, 2.0)
    assert (plain.bodies.state == none.bodies.state).all()
    assert STATE.size + 4 == plain.bodies.state.shape[1]


@pytest.mark.soak
def test_a_drone_flies_with_all_aerodynamic_effects() -> None:
    """With RotorPy's coefficients of the Crazyflie and the Hummingbird's body, the AR.Drone holds hover and speed."""
    given = {
        "quadratic_drag_n_s2_m2": [0.005, 0.005, 0.01],
        "rotor_drag_n_s2_m": 1.19e-4,
        "rotor_inflow_n_s2_m": 2.32e-4,
        "rotor_lift_n_s2_m2": 3.39e-3,
    }
    fleet = Fleet(scenario_of(FAR_IRIS, drag_n_s_m=0.0, aerodynamics=given))
    assert fleet.takeoff(0) is None
    advance(fleet, 8.0)
    assert fleet.status(0)[0] == "hovering"
    advance(fleet, 6.0, lambda: fleet.set_velocity(0, (3.0, 0.0, 0.0), 0.0, "world"))
    assert fleet.truth().velocity_m_s[0, 0] == pytest.approx(3.0, abs=0.4)
    assert fleet.truth().position_m[0, 2] == pytest.approx(1.0, abs=0.3)
