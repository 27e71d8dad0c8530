"""The firmware in flight: modes, control loops and watchdogs with noisy sensors; eight boards in one step."""

import math
from typing import Any

import numpy as np
import pytest

from zsim.math import rotation
from zsim.math.frames import heading, quaternion_from_rpy
from zsim.scenario.scenario_file import resolve
from zsim_world.fleet.fleet import Fleet
from zsim_world.physics.fleet_arrays import ROTOR, VEHICLE, PerRotor
from zsim_world.physics.simd import LANES
from zsim_world.vehicles import firmware, observer
from zsim_world.vehicles.firmware import BOARD_LANES, BOARD_ROTORS, DRIVE
from zsim_world.vehicles.observer import BELIEF

PRESETS = {
    "paper": {"preset": "paper"},
    "as_printed": {"preset": "paper", "as_printed": True},
    "ardrone2": {"preset": "ardrone2"},
}
GATE_S = 0.02
each_preset = pytest.mark.parametrize("sensors", PRESETS.values(), ids=PRESETS)


def fleet(count=1, sensors=None, gust=0.5, steady=(0.0, 0.0, 0.0), seed=1, **drone):
    drones = [{"name": f"d{k}", "position_m": [3.0 * k, 0, 0], "yaw_deg": 60.0 * k, **drone} for k in range(count)]
    wind = {"gust_m_s": gust, "steady_m_s": list(steady)}
    document = {"name": "t", "duration_s": 1, "seed": seed, "environment": {"wind": wind}, "drones": drones}
    return Fleet(resolve({**document, "sensors": sensors or {"preset": "paper"}}))


def run(flight, seconds, steer=None):
    """Advance; return the truth of every gate."""
    track = []
    for _ in range(round(seconds / GATE_S)):
        if steer:
            steer()
        flight.advance()
        track.append(flight.truth())
    return track


def states(flight):
    return [flight.status(i)[0] for i in range(flight.count)]


def airborne(*args, climb_to=None, **kwargs):
    """Return a fleet that hovers at 1 m, or has climbed to about `climb_to` [m]."""
    flight = fleet(*args, **kwargs)
    for i in range(flight.count):
        assert flight.takeoff(i) is None
    run(flight, 8.0)
    assert states(flight) == ["hovering"] * flight.count
    if climb_to:
        run(flight, climb_to - 1.0, every(flight, (0.0, 0.0, 1.0)))
    return flight


def every(flight, velocity, yaw_rate=0.0, frame="heading"):
    def steer():
        for i in range(flight.count):
            assert flight.set_velocity(i, velocity, yaw_rate, frame) is None

    return steer


def in_heading_frame(truth, i=0):
    psi = heading(truth.orientation_wxyz[i])
    c, s = math.cos(psi), math.sin(psi)
    vx, vy, vz = truth.velocity_m_s[i]
    return np.array([c * vx + s * vy, c * vy - s * vx, vz])


@each_preset
def test_drones_of_every_preset_take_off_fly_a_pattern_at_15_m_and_land(sensors):
    flight = fleet(3, sensors)
    for i in range(3):
        assert flight.takeoff(i) is None
    assert states(flight) == ["taking_off"] * 3
    track = run(flight, 8.0)
    assert states(flight) == ["hovering"] * 3
    np.testing.assert_allclose(track[-1].position_m[:, 2], 1.0, atol=0.15)
    run(flight, 14.0, every(flight, (0.0, 0.0, 1.0)))
    assert states(flight) == ["flying"] * 3
    np.testing.assert_allclose(flight.truth().position_m[:, 2], 15.0, atol=1.0)
    for velocity in ((1.5, 0.0, 0.0), (0.0, 1.5, 0.0), (-1.5, 0.0, 0.0), (0.0, -1.5, 0.5)):
        end = run(flight, 4.0, every(flight, velocity))[-50:]
        mean = np.mean([in_heading_frame(truth, i) for truth in end for i in range(3)], axis=0)
        np.testing.assert_allclose(mean, velocity, atol=0.12)
    for i in range(3):
        flight.release(i)
    run(flight, 1.0)
    assert states(flight) == ["hovering"] * 3
    for i in range(3):
        assert flight.land(i) is None
    run(flight, 40.0)
    assert states(flight) == ["landed"] * 3
    assert np.abs(flight.truth().velocity_m_s).max() < 0.01
    np.testing.assert_allclose(flight.truth().position_m[:, 2], 0.058, atol=0.003)
    assert not flight.truth().rotor_rad_s.any() or flight.truth().rotor_rad_s.max() < 1e-3


def test_takeoff_is_smooth_and_landing_is_gentle():
    flight = fleet(gust=0.0)
    flight.takeoff(0)
    track = run(flight, 8.0)
    assert max(truth.position_m[0, 2] for truth in track) < 1.25
    assert max(truth.velocity_m_s[0, 2] for truth in track) < 1.2
    assert np.abs([truth.position_m[0, :2] for truth in track]).max() < 0.25
    flight = airborne()
    flight.land(0)
    track = run(flight, 8.0)
    touch = next(k for k, truth in enumerate(track) if truth.position_m[0, 2] < 0.07)
    assert -0.7 < track[touch - 1].velocity_m_s[0, 2] < -0.15
    assert states(flight) == ["landed"]


def test_hover_in_gusts_stays_within_the_random_walk_of_the_flow():
    """Flow noise of 0.1 m/s at 15 Hz integrates to 0.1 / sqrt(15) sqrt(60 s) = 0.2 m per axis; the limit is five times
    this, plus the 0.1 m that gusts leave."""
    for seed in (1, 2, 3):
        flight = airborne(seed=seed)
        start = flight.truth().position_m[0]
        away = np.array([truth.position_m[0] - start for truth in run(flight, 60.0)])
        assert np.abs(away[:, :2]).max() < 1.1
        assert np.abs(away[:, 2]).max() < 0.2
        assert states(flight) == ["hovering"]


def test_hover_holds_against_a_steady_wind():
    flight = airborne(steady=(4.0, -3.0, 0.0), gust=0.0)
    start = flight.truth().position_m[0]
    end = run(flight, 30.0)[-1]
    assert np.linalg.norm((end.position_m[0] - start)[:2]) < 1.5
    assert np.linalg.norm(end.velocity_m_s[0]) < 0.2


@each_preset
def test_a_velocity_step_is_followed_quickly_with_little_overshoot(sensors):
    flight = airborne(1, sensors, gust=0.0, climb_to=8.0)
    track = run(flight, 6.0, every(flight, (2.0, 0.0, 0.0)))
    ahead = np.array([in_heading_frame(truth)[0] for truth in track])
    reached = GATE_S * int(np.argmax(ahead > 0.63 * 2.0))
    assert reached < 0.8
    assert ahead.max() < 2.0 * 1.2
    assert abs(ahead[150:].mean() - 2.0) < 0.1


def test_yaw_rates_and_world_frame_velocities_are_followed():
    flight = airborne(gust=0.0)
    track = run(flight, 3.0, every(flight, (0.0, 0.0, 0.0), 1.0))
    rates = np.array([truth.angular_velocity_rad_s[0, 2] for truth in track])
    assert GATE_S * int(np.argmax(rates > 0.63)) < 0.3
    assert abs(rates[-50:].mean() - 1.0) < 0.02
    track = run(flight, 4.0, every(flight, (1.0, 0.5, 0.0), frame="world"))
    np.testing.assert_allclose(track[-1].velocity_m_s[0], (1.0, 0.5, 0.0), atol=0.12)


def test_the_velocity_limits_are_respected():
    flight = airborne(limits={"horizontal_speed_m_s": 1.0, "vertical_speed_m_s": 0.3, "yaw_rate_deg_s": 30.0})
    end = run(flight, 6.0, every(flight, (9.0, 9.0, 9.0), 9.0))[-1]
    assert np.hypot(*end.velocity_m_s[0, :2]) == pytest.approx(1.0, abs=0.15)
    assert end.velocity_m_s[0, 2] == pytest.approx(0.3, abs=0.1)
    assert end.angular_velocity_rad_s[0, 2] == pytest.approx(math.radians(30.0), abs=0.03)


def test_the_altitude_limit_is_respected():
    flight = airborne(limits={"altitude_m": 3.0})
    track = run(flight, 8.0, every(flight, (0.0, 0.0, 1.0)))
    assert max(truth.position_m[0, 2] for truth in track) < 3.3
    assert track[-1].position_m[0, 2] == pytest.approx(3.0, abs=0.3)


def test_the_tilt_limit_is_respected_under_an_aggressive_command():
    flight = airborne(gust=0.0, climb_to=8.0, limits={"tilt_deg": 10.0})
    track = run(flight, 3.0, every(flight, (5.0, 0.0, 0.0)))
    q = np.array([truth.orientation_wxyz[0] for truth in track])
    tilt = np.arccos(1 - 2 * (q[:, 1] ** 2 + q[:, 2] ** 2))
    assert math.radians(8.0) < tilt.max() < math.radians(12.5)


def test_ardrone_commands_set_tilts_climb_rate_and_yaw_rate():
    flight = airborne(gust=0.0, climb_to=8.0)
    track = run(flight, 1.5, lambda: flight.set_ardrone(0, 0.5, 0.0, 0.0, 0.0, False))
    q = track[-1].orientation_wxyz[0]
    assert 2 * math.asin(q[2]) == pytest.approx(math.radians(20.0) * 0.5, abs=0.03)  # nearly half of 20 deg
    assert in_heading_frame(track[-1])[0] > 1.5
    run(flight, 4.0, lambda: flight.set_ardrone(0, 0.0, 0.0, 0.0, 0.0, True))
    assert states(flight) == ["hovering"]
    assert np.linalg.norm(flight.truth().velocity_m_s[0]) < 0.2
    track = run(flight, 1.5, lambda: flight.set_ardrone(0, 0.0, 0.5, 0.0, 0.0, False))
    assert in_heading_frame(track[-1])[1] > 1.5
    track = run(flight, 2.0, lambda: flight.set_ardrone(0, 0.0, 0.0, 0.5, 0.5, False))
    assert track[-1].velocity_m_s[0, 2] == pytest.approx(0.5, abs=0.1)
    assert track[-1].angular_velocity_rad_s[0, 2] == pytest.approx(math.radians(100.0), abs=0.1)


def test_an_attitude_setpoint_is_followed():
    flight = airborne(gust=0.0, climb_to=8.0)
    q = quaternion_from_rpy((0.0, 0.15, 1.0)).tolist()
    track = run(flight, 1.0, lambda: flight.set_attitude(0, q, 4.3, 0.0))
    axis = np.array(track[-1].orientation_wxyz[0])
    z = (2 * (axis[1] * axis[3] + axis[0] * axis[2]), 2 * (axis[2] * axis[3] - axis[0] * axis[1]))
    np.testing.assert_allclose(z, math.sin(0.15) * np.array([math.cos(1.0), math.sin(1.0)]), atol=0.03)


def test_a_rotor_setpoint_is_applied_within_the_rotor_limits():
    flight = airborne(gust=0.0, climb_to=4.0)
    run(flight, 0.2, lambda: flight.set_rotors(0, (9999.0, 503.0, 470.0, 470.0)))
    np.testing.assert_allclose(flight.truth().rotor_rad_s[0], (503.0, 503.0, 470.0, 470.0), rtol=2e-3)
    flight = airborne(gust=0.0, climb_to=4.0)
    run(flight, 0.3, lambda: flight.set_rotors(0, (0.0,) * 4))
    np.testing.assert_allclose(flight.truth().rotor_rad_s[0], 126.0, rtol=2e-3)


def test_a_drone_whose_commander_is_silent_hovers_and_then_lands():
    flight = airborne()
    assert flight.set_velocity(0, (0.3, 0.0, 0.0), 0.0) is None
    for seconds, state in ((0.46, "flying"), (0.06, "hovering"), (1.92, "hovering"), (0.1, "landing"), (8.0, "landed")):
        run(flight, seconds)
        assert states(flight) == [state]


def test_a_setpoint_ends_the_silence_and_a_release_causes_no_landing():
    flight = airborne()
    flight.set_velocity(0, (0.3, 0.0, 0.0), 0.0)
    run(flight, 1.5)
    flight.set_velocity(0, (0.0, 0.0, 0.0), 0.0)
    run(flight, 0.1)
    assert states(flight) == ["flying"]
    flight.release(0)
    run(flight, 6.0)
    assert states(flight) == ["hovering"]


def test_emergency_stops_the_rotors_and_reset_allows_a_new_takeoff():
    flight = airborne()
    assert flight.emergency(0) is None
    run(flight, 0.3)
    assert states(flight) == ["emergency"]
    assert flight.truth().rotor_rad_s.max() < 1.0
    assert "emergency" in str(flight.takeoff(0))
    run(flight, 3.0)
    assert flight.reset(0) is None
    run(flight, 1.0)
    assert states(flight) == ["landed"]
    assert flight.takeoff(0) is None
    run(flight, 8.0)
    assert states(flight) == ["hovering"]


def test_an_overturned_drone_cuts_its_motors():
    flight = airborne(gust=0.0, climb_to=4.0)
    run(flight, 0.7, lambda: flight.set_rotors(0, (503.0, 126.0, 126.0, 503.0)))
    assert states(flight) == ["emergency"]
    run(flight, 4.0)
    assert flight.truth().rotor_rad_s.max() < 1e-3
    assert np.linalg.norm(flight.truth().velocity_m_s[0]) < 0.05


def test_a_drone_on_its_back_does_not_take_off():
    flight = fleet(gust=0.0)
    flight.bodies.state[0, 6:10] = flight.boards.belief[0, :4] = quaternion_from_rpy((3.0, 0.0, 0.0))
    assert "upright" in str(flight.takeoff(0))


def test_a_low_battery_forces_a_landing_and_prevents_takeoff():
    flight = airborne(battery_percent=12.0)
    run(flight, 60.0)
    assert states(flight) == ["landed"]
    assert 3.0 < flight.status(0)[1] < 5.0
    assert "%" in str(flight.takeoff(0))
    flight = fleet(battery_percent=0.0)
    run(flight, 1.0)
    assert flight.status(0)[1] == 0.0
    assert flight.takeoff(0) is not None


def test_the_firmware_flies_on_measured_flow_and_not_on_truth():
    """A flow sensor that reads 0.3 m/s too high makes the drone drift equally fast the other way."""
    flight = airborne(gust=0.0)
    flight._w.senses.bias[0, 5, 0] += 0.3
    track = run(flight, 10.0, every(flight, (0.0, 0.0, 0.0)))
    drift = np.mean([in_heading_frame(truth) for truth in track[-200:]], axis=0)
    np.testing.assert_allclose(drift, (-0.3, 0.0, 0.0), atol=0.1)


HEAVY = {
    "mass_kg": 1.5, "inertia_kg_m2": [0.015, 0.016, 0.03], "arm_m": 0.25, "thrust_n_s2": 1.6e-5, "torque_nm_s2": 3.0e-7,
    "rotor_time_constant_s": 0.06, "rotor_min_rad_s": 150.0, "rotor_max_rad_s": 800.0, "drag_n_s_m": 0.4, "battery_mah": 5000.0,
}  # fmt: skip
LIGHT = {
    "mass_kg": 0.05, "inertia_kg_m2": [3e-5, 3e-5, 5e-5], "arm_m": 0.06, "thrust_n_s2": 4.0e-8, "torque_nm_s2": 2.4e-10,
    "rotor_time_constant_s": 0.02, "rotor_min_rad_s": 300.0, "rotor_max_rad_s": 2600.0, "drag_n_s_m": 0.02,
}  # fmt: skip
MOUNT = {"position_m": [0.03, -0.02, 0.01], "rpy_deg": [5.0, -8.0, 90.0]}
TURNED = {"preset": "ardrone2", "imu": {"mount": MOUNT}, "mag": {"mount": MOUNT}}
LOSSY = {"preset": "paper", "imu": {"dropout": 0.05}, "flow": {"dropout": 0.3}, "sonar": {"dropout": 0.3}}


@pytest.mark.parametrize(
    ("sensors", "aircraft", "velocity", "atol"),
    [
        (None, HEAVY, (1.0, 0.0, 0.2), 0.15),
        (None, LIGHT, (1.0, 0.0, 0.2), 0.15),
        (TURNED, {}, (1.0, -0.5, 0.0), 0.12),
        (LOSSY, {}, (0.5, 0.0, 0.0), 0.25),
    ],
    ids=["heavy", "light", "a turned and shifted board", "lost samples"],
)
def test_the_firmware_flies_other_aircraft_turned_boards_and_lossy_sensors(sensors, aircraft, velocity, atol):
    flight = airborne(2, sensors, **aircraft)
    track = run(flight, 6.0, every(flight, velocity))
    assert states(flight) == ["flying"] * 2
    mean = np.mean([in_heading_frame(truth) for truth in track[-100:]], axis=0)
    np.testing.assert_allclose(mean, velocity, atol=atol)
    for i in range(2):
        flight.land(i)
    run(flight, 14.0)
    assert states(flight) == ["landed"] * 2


@each_preset
def test_the_belief_agrees_with_the_truth(sensors):
    """Tilt within 1.5 degrees, heading within 3 degrees, velocity and height as the sensors allow."""
    flight = airborne(3, sensors, climb_to=12.0)
    run(flight, 30.0, every(flight, (0.3, 0.0, 0.0), 0.1))
    truth = flight.truth()
    for i in range(3):
        belief = flight.boards.belief[i]
        q = truth.orientation_wxyz[i]
        own = belief[BELIEF.q_WB : BELIEF.q_WB + 4]
        z, z_own = (np.array([2 * (a[1] * a[3] + a[0] * a[2]), 2 * (a[2] * a[3] - a[0] * a[1])]) for a in (q, own))
        turn = heading(own) - heading(q)  # each tilt is compared in its own heading frame
        rotated = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]) @ z
        assert np.linalg.norm(rotated - z_own) < math.radians(1.5)
        assert abs((turn + math.pi) % (2 * math.pi) - math.pi) < math.radians(3.0)
        believed = belief[BELIEF.v_H : BELIEF.v_H + 3]
        np.testing.assert_allclose(believed, in_heading_frame(truth, i), atol=0.3)
        assert abs(belief[BELIEF.height] - truth.position_m[i, 2]) < 0.3


COUNT = 11  # a whole block of eight and part of another
STEP_TICKS = 2  # physics ticks of 2.5 ms


def flying():
    """Return a fleet of two kinds of drones: one is on the ground, the others fly with setpoints of every kind."""
    heavy: Any = {"mass_kg": 0.6, "arm_m": 0.25, "thrust_n_s2": 1.2e-5, "rotor_time_constant_s": 0.05}
    mount: Any = {"imu": {"mount": {"rpy_deg": [5.0, -3.0, 170.0]}}}
    drones = [
        {
            "name": f"d{k}",
            "position_m": [3.0 * k, 0, 0],
            "yaw_deg": 33.0 * k,
            "sensors": mount,
            **(heavy if k % 3 else {}),
        }
        for k in range(COUNT)
    ]
    fleet = Fleet(resolve({"name": "t", "duration_s": 60, "drones": drones}))
    for i in range(COUNT - 1):
        assert fleet.takeoff(i) is None
    for _ in range(350):
        fleet.advance()
    fleet.set_attitude(1, (0.98, 0.1, -0.1, 0.0), 5.0, 2.0)
    fleet.set_rotors(2, (300.0, 310.0, 320.0, 330.0))
    fleet.set_ardrone(3, 0.5, -0.3, 0.2, 1.0)
    for i in range(4, COUNT - 1):
        fleet.set_velocity(i, (0.5 * i, -1.0, 0.3), 0.4 * (i - 6))
    return fleet


def lane(table, i, at, count):
    """Return `count` values of drone i, from column `at` on."""
    return tuple(table[i // LANES].reshape(-1, LANES)[at : at + count, i % LANES].tolist())


def rotors_of(table, i, group, count):
    """Return `count` per-rotor groups of values of drone i, from `group` on."""
    return PerRotor(np.array(lane(table, i, BOARD_LANES.size + 4 * group, 4 * count)), 0, 1, (0, 1, 2, 3))


def test_a_block_computes_the_same_bits_as_each_drone_alone():
    fleet, driven = flying(), 0
    boards, lanes = fleet.boards, fleet.boards.lanes
    for _ in range(60):
        fleet._noise.refill()
        before = boards.belief.copy()
        fleet._integrate(STEP_TICKS)
        for i in range(COUNT):
            w = lane(lanes, i, BOARD_LANES.w_WB_B, 3)
            turn = rotation.from_rotation_vector(observer.step_turn(w))
            q = rotation.normalised(rotation.multiply(tuple(before[i, BELIEF.q_WB : BELIEF.q_WB + 4]), turn))
            assert lane(lanes, i, BOARD_LANES.heading, 1) == (rotation.heading(q),)
            if lane(lanes, i, BOARD_LANES.driven, 1) == (0.0,):
                continue
            driven += 1
            sizes = {BOARD_LANES.own: 4, BOARD_LANES.q_WB: 4, BOARD_LANES.w_WB_B: 3, BOARD_LANES.z_H: 3}
            own, believed, rate, z = (lane(lanes, i, at, size) for at, size in sizes.items())
            thrust, yaw_rate = lane(lanes, i, BOARD_LANES.thrust, 2)
            row, gains = lane(lanes, i, 0, VEHICLE.size), lane(lanes, i, BOARD_LANES.drive, DRIVE.size)
            known, speeds = (
                rotors_of(lanes, i, group, size) for group, size in ((0, ROTOR.size), (BOARD_ROTORS.speed, 1))
            )
            commands = PerRotor(np.zeros(4), 0, 1, (0, 1, 2, 3))
            firmware.drive(row, known, gains, own, believed, rate, speeds, z, thrust, yaw_rate, commands)
            assert tuple(rotors_of(lanes, i, BOARD_ROTORS.command, 1).numbers) == tuple(commands.numbers)
    assert driven == 60 * (COUNT - 2)
    np.testing.assert_array_equal(rotors_of(lanes, 2, BOARD_ROTORS.command, 1).numbers, fleet.bodies.command[2])
