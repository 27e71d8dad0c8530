"""The AR.Drone against published figures.

Sources: Li, MSc thesis, TU Delft 2014 (through AuRoRA): rotor constants; tum_ardrone: drag fitted in flight and the
attitude lag; Parrot: endurance and rotor speed in hover; Cheeseman and Bennett, ARC R&M 3021.
"""

import math

import numpy as np
import pytest
from vehicle_rows import rows_of

from zsim.scenario.scenario_file import resolve
from zsim.vehicles.ardrone2 import VEHICLE as ARDRONE2
from zsim_world.fleet.fleet import Fleet
from zsim_world.physics import rigid_body as body
from zsim_world.physics.fleet_arrays import STATE, VEHICLE
from zsim_world.physics.rigid_body import ground_effect


def calm(count=1, gust=0.0, seed=1, sensors=None, **drone):
    drones = [{"name": f"d{k}", "position_m": [3.0 * k, 0, 0], "yaw_deg": 50.0 * k, **drone} for k in range(count)]
    document = {"name": "t", "duration_s": 1, "seed": seed, "drones": drones}
    wind = {"wind": {"gust_m_s": gust}}
    return resolve({**document, "environment": wind, "sensors": sensors or {"preset": "paper"}})


CALM = (0.0, 0.0, 0.0)


def hovering(scenario, seconds=8.0):
    fleet = Fleet(scenario)
    for i in range(fleet.count):
        assert fleet.takeoff(i) is None
    advance(fleet, seconds)
    assert all(fleet.status(i)[0] == "hovering" for i in range(fleet.count))
    return fleet


def advance(fleet, seconds, steer=None):
    for _ in range(round(seconds / 0.02)):
        if steer:
            steer()
        fleet.advance()


def test_the_rotors_turn_at_361_6_rad_s_in_hover():
    """Out of ground effect (at 3 m), with the published mass of 0.429 kg."""
    fleet = hovering(calm(takeoff_height_m=3.0), 12.0)
    speeds = []
    for _ in range(200):
        fleet.advance()
        speeds.append(np.sqrt((fleet.truth().rotor_rad_s[0] ** 2).mean()))
    assert np.mean(speeds) == pytest.approx(361.6, abs=1.0)


@pytest.mark.parametrize(("tilt_deg", "speed"), [(12.0, 3.6), (20.0, 6.2), (30.0, 9.8)])
def test_a_held_tilt_gives_the_speed_of_the_fitted_drag(tilt_deg, speed):
    """m g tan(tilt) = D v: the table that follows from tum_ardrone's fitted drag."""
    scenario = calm(limits={"tilt_deg": tilt_deg, "altitude_m": 1000.0})
    row, rotors = rows_of(scenario)
    tilt = math.radians(tilt_deg)
    rotor = math.sqrt(row[VEHICLE.mass] * row[VEHICLE.gravity] / math.cos(tilt) / (4 * row[VEHICLE.thrust]))
    state = np.zeros(STATE.size + 4)
    state[2], state[6], state[8], state[13:] = 1e4, math.cos(tilt / 2), math.sin(tilt / 2), rotor
    for _ in range(8000):
        body.step(row, rotors, np.zeros((8, 2)), state, np.full(4, rotor), CALM, CALM, 0.0025)
    assert state[3] == pytest.approx(speed, abs=0.06)  # the table has one decimal
    assert abs(state[5]) < 1e-6
    fleet = hovering(scenario)
    advance(fleet, 10.0, lambda: fleet.set_ardrone(0, 1.0, 0.0, 0.0, 0.0))
    assert np.hypot(*fleet.truth().velocity_m_s[0, :2]) == pytest.approx(speed, abs=0.35)


def test_tilt_responds_at_least_as_fast_as_the_real_aircraft():
    """tum_ardrone's model, identified in flight: 0.143 s to 63 % of a commanded roll."""
    fleet = hovering(calm(takeoff_height_m=3.0), 12.0)
    final = math.radians(10.0)
    tilts = []
    for _ in range(50):
        fleet.set_ardrone(0, 0.5, 0.0, 0.0, 0.0)
        fleet.advance()
        tilts.append(2 * math.asin(fleet.truth().orientation_wxyz[0, 2]))
    assert 0.04 < 0.02 * (np.argmax(np.array(tilts) > 0.63 * final) + 1) <= 0.16


def test_rotors_follow_with_their_time_constant():
    """30 ms from Li's motor constants, 31.6 ms from Paparazzi's actuator model."""
    scenario = calm()
    row, rotors = rows_of(scenario)
    state = np.zeros(STATE.size + 4)
    state[2], state[6], state[13:] = 100.0, 1.0, 200.0
    for _ in range(12):
        body.step(row, rotors, np.zeros((8, 2)), state, np.full(4, 300.0), CALM, CALM, 0.0025)
    assert (state[13] - 200.0) / 100.0 == pytest.approx(1 - math.exp(-1.0), rel=1e-9)


def test_the_rotors_have_the_published_thrust_to_weight_ratio():
    """Rotors from 126 to 503 rad/s: 8.1 N at most, 1.93 times the weight."""
    scenario = calm()
    row, _ = rows_of(scenario)
    most = 4 * row[VEHICLE.thrust] * row[VEHICLE.rotor_max] ** 2
    assert most == pytest.approx(8.1, abs=0.06)
    assert most / (row[VEHICLE.mass] * row[VEHICLE.gravity]) == pytest.approx(1.93, abs=0.02)


def test_hover_endurance_matches_the_published_battery():
    """10 to 12 minutes on 1000 mAh at constant hover power."""
    fleet = hovering(calm())
    before = fleet.status(0)[1]
    advance(fleet, 60.0)
    per_minute = before - fleet.status(0)[1]
    assert 10.0 <= 100.0 / per_minute <= 12.5


def test_ground_effect_saves_power():
    """One rotor radius up, Cheeseman and Bennett give 16/15; rotors near the ground turn slower by its root."""
    assert ground_effect(ARDRONE2.rotor_radius_m, ARDRONE2.rotor_radius_m) == pytest.approx(16 / 15)
    fleet = hovering(calm(takeoff_height_m=0.3))
    speeds = []
    for _ in range(200):
        fleet.advance()
        factor = ground_effect(fleet.truth().position_m[0, 2], ARDRONE2.rotor_radius_m)
        speeds.append(np.sqrt((fleet.truth().rotor_rad_s[0] ** 2).mean() * factor))
    assert np.mean(speeds) == pytest.approx(361.6, abs=1.0)
