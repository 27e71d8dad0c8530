"""Vehicles fly by their parameters alone: each stock one, a fleet of several, and one of six rotors.

What flies with six rotors is compiled for these tests alone, which takes longer than all others here: it is for the soak.
"""

import math
from typing import Any

import numpy as np
import pytest

from zsim.math.frames import heading
from zsim.scenario.scenario_file import resolve
from zsim.vehicles.vehicle import MODELS, vehicle_of
from zsim_world.fleet.fleet import Fleet
from zsim_world.fleet.publication import GatePublication

GATE_S = 0.02
six_rotors = pytest.mark.soak
ALL_MODELS = [*MODELS, pytest.param("hexacopter", marks=six_rotors)]


def fleet(*models: str, **environment: Any) -> Fleet:
    drones = [
        {"name": f"d{k}", "model": model, "position_m": [2.0 * k, 0, 0], "yaw_deg": 40.0 * k}
        for k, model in enumerate(models)
    ]
    document = {"name": "t", "duration_s": 1, "drones": drones, "environment": environment}
    return Fleet(resolve(document))


def fly(flight: Fleet, seconds: float, velocity: tuple[float, float, float] | None = None) -> None:
    for _ in range(round(seconds / GATE_S)):
        for i in range(flight.count if velocity else 0):
            assert flight.set_velocity(i, velocity or (0.0, 0.0, 0.0)) is None
        flight.advance()


def airborne(*models: str) -> Fleet:
    flight = fleet(*models)
    for i in range(flight.count):
        assert flight.takeoff(i) is None
    fly(flight, 10.0)
    assert [flight.status(i)[0] for i in range(flight.count)] == ["hovering"] * flight.count
    return flight


def velocity_ahead(flight: Fleet, i: int) -> np.ndarray:
    truth = flight.truth()
    psi = heading(truth.orientation_wxyz[i])
    vx, vy, vz = truth.velocity_m_s[i]
    return np.array([math.cos(psi) * vx + math.sin(psi) * vy, math.cos(psi) * vy - math.sin(psi) * vx, vz])


@pytest.mark.parametrize("model", ALL_MODELS)
def test_every_vehicle_takes_off_hovers_flies_a_velocity_and_lands(model: str):
    flight = airborne(model)
    height = vehicle_of(model).takeoff_height_m
    start = flight.truth().position_m[0]
    fly(flight, 10.0)
    away = flight.truth().position_m[0] - start
    assert start[2] == pytest.approx(height, abs=0.15)
    assert np.abs(away[:2]).max() < 0.5
    assert abs(away[2]) < 0.1
    fly(flight, 6.0, (0.8, -0.4, 0.2))
    means = []
    for _ in range(100):
        fly(flight, GATE_S, (0.8, -0.4, 0.2))
        means.append(velocity_ahead(flight, 0))
    np.testing.assert_allclose(np.mean(means, axis=0), (0.8, -0.4, 0.2), atol=0.12)
    assert flight.land(0) is None
    fly(flight, 25.0)
    assert flight.status(0)[0] == "landed"
    assert np.abs(flight.truth().velocity_m_s).max() < 0.01


@pytest.mark.parametrize("model", ALL_MODELS)
def test_hover_thrust_is_the_weight_shared_by_all_rotors(model: str):
    flight = airborne(model)
    speeds = []
    for _ in range(200):
        flight.advance()
        speeds.append((flight.truth().rotor_rad_s[0] ** 2).mean())
    vehicle = vehicle_of(model)
    weight = vehicle.mass_kg * 9.80665
    lift = len(vehicle.rotors) * vehicle.thrust_n_s2 * np.mean(speeds)
    assert lift == pytest.approx(weight, rel=0.02)


@six_rotors
def test_vehicles_of_different_size_and_rotors_fly_side_by_side():
    flight = airborne("ardrone2", "crazyflie2", "hexacopter")
    closest = math.inf
    for _ in range(20):
        fly(flight, 1.0, (0.5, 0.0, 0.0))
        closest = min(closest, flight.closest_m)
    for i in range(3):
        np.testing.assert_allclose(velocity_ahead(flight, i), (0.5, 0.0, 0.0), atol=0.25)
    assert flight.rotors == [4, 4, 6]
    assert not flight.truth().rotor_rad_s[:2, 4:].any()
    assert closest > 0.5


@six_rotors
def test_a_quadrotor_flies_with_the_same_bits_beside_one_of_six_rotors():
    alone, beside = airborne("ardrone2"), airborne("ardrone2", "hexacopter")
    for flight in (alone, beside):
        fly(flight, 2.0, (0.5, 0.2, 0.1))
    np.testing.assert_array_equal(alone.truth().position_m[0], beside.truth().position_m[0])
    np.testing.assert_array_equal(alone.truth().rotor_rad_s[0], beside.truth().rotor_rad_s[0, :4])


@six_rotors
def test_truth_and_commands_have_a_number_for_each_rotor():
    flight = airborne("crazyflie2", "hexacopter")
    bundle = GatePublication(flight).gate([None, None])
    quad, hexa = (message.rotor_rad_s for key, message in bundle.decoded() if key.endswith("truth"))
    np.testing.assert_array_equal(quad, flight.truth().rotor_rad_s[0, :4])
    np.testing.assert_array_equal(hexa, flight.truth().rotor_rad_s[1])
    assert "6 rotors" in str(flight.set_rotors(1, (300.0,) * 4))
    assert flight.set_rotors(1, (400.0,) * 6) is None
    fly(flight, 0.2)
    np.testing.assert_allclose(flight.truth().rotor_rad_s[1], 400.0, rtol=0.01)
