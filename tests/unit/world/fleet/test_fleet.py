"""The fleet: samples and their times, refusals, reproducible bits, contacts, and vehicles defined by parameters alone.

The tests of six-rotor vehicles are soak tests: they alone need code for six rotors, whose compilation takes longer than
all other tests in this file.
"""

import hashlib
import math
from typing import Any

import numpy as np
import pytest
from fleet_samples import samples_of
from refused import has_terms, refused

from zsim.contract import messages
from zsim.math.frames import geodetic_to_enu, heading
from zsim.scenario.scenario_file import resolve
from zsim.vehicles.vehicle import MODELS, vehicle_of
from zsim_world.fleet.fleet import GPS_FIX, GPS_SATELLITES, DivergedError, Fleet
from zsim_world.fleet.publication import GatePublication
from zsim_world.sensors.sensor_set import SENSORS, fleet_sensors, schedule

GATE_NS = 20_000_000
WIDTH = {"imu": 6, "gps": 9, "mag": 3, "baro": 2, "sonar": 2, "flow": 4}


def scenario(count: int = 2, seed: int = 1, gust=0.5, spacing=3.0, drone: Any = None, sensors: Any = None, **top: Any):
    """Return a scenario of drones in a row with the paper's sensors, some of which may be replaced."""
    drones = [{"name": f"d{k}", "position_m": [spacing * k, 0, 0], **(drone or {})} for k in range(count)]
    document = {"name": "t", "duration_s": 1, "seed": seed, "drones": drones}
    environment = {"wind": {"gust_m_s": gust}, **top.pop("environment", {})}
    return resolve({**document, "sensors": {"preset": "paper", **(sensors or {})}, "environment": environment, **top})


def gates(fleet, count, name=None):
    """Advance; return all samples, or those of one sensor."""
    out = []
    for _ in range(count):
        fleet.advance()
        out += samples_of(fleet)
    return [sample for sample in out if name in (None, sample.sensor)]


def in_order(samples) -> bool:
    keys = [(s.t_ns, s.drone, SENSORS.index(s.sensor)) for s in samples]
    return keys == sorted(keys)


def flown(fleet, count=500):
    """Return a digest of a flight with take-off and a turn."""
    digest = hashlib.sha256()
    for i in range(fleet.count):
        fleet.takeoff(i)
    for k in range(count):
        if k > 200:
            for i in range(fleet.count):
                fleet.set_velocity(i, (0.5, 0.1 * i, 0.2), 0.2)
        fleet.advance()
        digest.update(b"".join(np.ascontiguousarray(x).tobytes() for x in fleet.truth()))
        digest.update(repr(samples_of(fleet)).encode())
    return digest.hexdigest()


# Samples


def test_at_the_start_all_drones_stand_and_have_sampled_once():
    fleet = Fleet(scenario())
    assert (fleet.t_ns, fleet.names) == (0, ["d0", "d1"])
    assert [fleet.status(i) for i in range(2)] == [("landed", 100.0, False)] * 2
    assert [(s.drone, s.sensor) for s in samples_of(fleet)] == [(i, name) for i in range(2) for name in SENSORS]
    assert {s.t_ns for s in samples_of(fleet)} == {0}
    np.testing.assert_allclose(fleet.truth().position_m, [(0, 0, 0.058), (3, 0, 0.058)], atol=1e-12)
    assert Fleet(scenario(1)).closest_m == math.inf


def test_samples_come_in_order_with_the_right_number_of_plain_floats():
    fleet = Fleet(scenario())
    for sample in gates(fleet, 25):
        assert len(sample.values) == WIDTH[sample.sensor]
        assert all(type(x) is float for x in sample.values)
        assert type(sample.t_ns) is int
    fleet.advance()
    assert in_order(samples_of(fleet))
    assert all(fleet.t_ns - GATE_NS < s.t_ns <= fleet.t_ns for s in samples_of(fleet))


@pytest.mark.parametrize(("sensor", "rate"), [("imu", 200), ("gps", 5), ("mag", 25), ("flow", 15), ("sonar", 25)])
def test_samples_are_due_at_the_first_possible_tick_and_never_drift(sensor, rate):
    times = [s.t_ns for s in gates(Fleet(scenario(1)), 1000, sensor)]
    tick = 2_500_000
    due = [math.ceil(n * 1_000_000_000 / rate / tick - 1e-9) * tick for n in range(1, 20 * rate + 1)]
    assert times == due


def test_an_imu_at_a_lower_rate_publishes_samples_of_the_board():
    """At 60 Hz every third or fourth board sample is published, with the same values as at 200 Hz."""
    full = {s.t_ns: s.values for s in gates(Fleet(scenario(1)), 50, "imu")}
    shown = gates(Fleet(scenario(1, sensors={"imu": {"rate_hz": 60}})), 50, "imu")
    assert len(shown) == 60
    assert all(full[s.t_ns] == s.values for s in shown)


def test_a_sensor_faster_than_the_ticks_gives_several_samples_per_tick():
    times = [s.t_ns for s in gates(Fleet(scenario(1, sensors={"baro": {"rate_hz": 1000}})), 50, "baro")]
    assert len(times) == 1000
    assert all(t % 2_500_000 == 0 for t in times)


def test_latency_only_delays_publication():
    fleet = Fleet(scenario(2, sensors={"gps": {"latency_ms": 211.0}, "imu": {"latency_ms": 7.0}}))
    out = [*samples_of(fleet), *gates(fleet, 200)]
    assert in_order(out)
    late = [s for s in out if s.sensor == "gps" and s.drone == 0]
    assert [s.t_ns - s.t_sample_ns for s in late] == [211_000_000] * len(late)
    assert [s.t_sample_ns for s in late] == [200_000_000 * n for n in range(len(late))]
    assert len(late) == 19  # of 21 sampled up to 4 s, the last two are still delayed
    plain = [s.values for s in gates(Fleet(scenario(2)), 200, "gps") if s.drone == 0]
    assert [s.values for s in late[1:]] == plain[: len(late) - 1]


def test_geodetic_and_local_gps_positions_agree():
    fleet = Fleet(scenario())
    for sample in gates(fleet, 30, "gps"):
        position = geodetic_to_enu(sample.values[:3], (-34.603, -58.368, 25.0))
        np.testing.assert_allclose(position, sample.values[3:6], atol=1e-7)
    assert fleet.gps_sigma_m == [2.0, 2.0]


def test_the_sigma_that_a_gps_reports_is_that_of_its_errors():
    """A noise of 3 m and a density of 2 m/sqrt(Hz) at 4 Hz give 5 m."""
    gps = {"rate_hz": 4, "position_m": {"noise": 3.0, "density": 2.0}}
    fleet = Fleet(scenario(1, sensors={"gps": gps}))
    fixes = [m for _, m in GatePublication(fleet).gate([None]).decoded() if isinstance(m, messages.Gps)]
    assert [(m.sigma_m, m.fix, m.satellites) for m in fixes] == [(5.0, GPS_FIX, GPS_SATELLITES)]


@pytest.mark.parametrize("rate_hz", [0.01, 0.0137, 999.9])
def test_rates_from_the_lowest_to_the_highest_are_met(rate_hz):
    sensors = fleet_sensors(scenario(1, sensors={"baro": {"rate_hz": rate_hz}}))
    numerator, denominator = schedule(sensors, 2.5)[0, 3, :2]
    assert denominator / numerator / 0.0025 == pytest.approx(rate_hz, rel=5e-4)


def test_pressure_is_finite_however_high_a_drone_gets():
    fleet = Fleet(scenario(1, environment={"height_m": 10_900}, sensors={"baro": {"rate_hz": 200}}))
    fleet.bodies.state[0, 2] = 60_000.0
    assert {s.values[0] for s in gates(fleet, 2, "baro")} == {0.0}


def test_the_barometer_altitude_is_relative_and_its_pressure_absolute():
    quiet = scenario(1, sensors={"baro": {"altitude_m": {"noise": 0.0}}})
    pressure, altitude = next(s.values for s in samples_of(Fleet(quiet)) if s.sensor == "baro")
    assert altitude == pytest.approx(0.058)
    assert pressure == pytest.approx(101325.0 * (1 - 2.25577e-5 * 25.058) ** 5.25588)


# Reproducibility


def test_only_the_same_seed_gives_the_same_bits():
    digests = [flown(Fleet(scenario(seed=seed))) for seed in (1, 1, 2)]
    assert digests[0] == digests[1] != digests[2]


def test_the_length_of_a_gate_does_not_change_the_physics():
    def end(gate_ms, count):
        fleet = Fleet(scenario(time={"gate_ms": gate_ms}))
        fleet.takeoff(0)
        samples = gates(fleet, count)
        return fleet.truth(), samples

    (short, one), (long, other) = end(5.0, 800), end(50.0, 80)
    for a, b in zip(short, long, strict=True):
        np.testing.assert_array_equal(a, b)
    assert one == other


def test_more_drones_or_samples_change_no_other_random_stream():
    """Drones far apart could be coupled only by random streams; eleven fill a block of eight and part of another."""
    apart: Any = {"spacing": 200.0}
    alone, many = Fleet(scenario(1, **apart)), Fleet(scenario(11, **apart))
    alone.takeoff(0)
    many.takeoff(0)
    first = gates(alone, 300)
    assert first == [s for s in gates(many, 300) if s.drone == 0]
    for a, b in zip(alone.truth(), many.truth(), strict=True):
        np.testing.assert_array_equal(a[0], b[0])
    other, plain = Fleet(scenario(1, sensors={"mag": {"rate_hz": 50}}, **apart)), Fleet(scenario(1, **apart))
    one, two = ([s for s in gates(each, 1) if s.sensor in ("gps", "imu")] for each in (other, plain))
    assert one == two


@pytest.mark.parametrize("dt_ms", [0.5, 1.0, 5.0])
def test_other_physics_steps_give_nearly_the_same_flight(dt_ms):
    def end(dt):
        fleet = Fleet(scenario(2, time={"physics_dt_ms": dt}))
        for i in range(2):
            fleet.takeoff(i)
        gates(fleet, 400)
        for _ in range(200):
            fleet.set_velocity(0, (0.5, 0.0, 0.1))
            fleet.advance()
        assert fleet.status(1)[0] == "hovering"
        return fleet.truth().position_m

    np.testing.assert_allclose(end(dt_ms), end(2.5), atol=0.3)


# Commands and reports


def test_refusals_name_the_drone_its_state_and_the_required_states():
    fleet = Fleet(scenario())
    for refusal in (
        fleet.set_velocity(0, (1, 0, 0)),
        fleet.set_ardrone(0, 0.1, 0, 0, 0),
        fleet.set_attitude(0, (1, 0, 0, 0), 4.0),
        fleet.set_rotors(0, (300.0,) * 4),
    ):
        assert has_terms(refusal, "d0", "landed", "hovering", "flying")
    assert has_terms(fleet.land(0), "d0", "landed")
    assert has_terms(fleet.reset(0), "d0", "landed", "emergency")
    assert fleet.takeoff(1) is None
    assert has_terms(fleet.takeoff(1), "d1", "taking_off", "landed")
    gates(fleet, 10)
    assert has_terms(fleet.set_velocity(1, (1, 0, 0)), "d1", "taking_off", "hovering", "flying")
    gates(fleet, 200)
    assert "finite" in str(fleet.set_velocity(1, (math.nan, 0, 0)))
    assert "quaternion" in str(fleet.set_attitude(1, (0, 0, 0, 0), 4.0))
    assert fleet.land(1) is None
    gates(fleet, 1)
    assert fleet.land(1) is None
    assert "landing" in str(fleet.set_velocity(1, (1, 0, 0)))


def test_a_collision_is_reported_only_when_it_begins():
    fleet = Fleet(scenario(2, gust=0.0, spacing=2.0))
    fleet.takeoff(0)
    fleet.takeoff(1)
    gates(fleet, 250)
    assert 1.5 < fleet.closest_m < 2.5
    began, closest = [], math.inf
    for _ in range(150):
        fleet.set_velocity(0, (1.0, 0.0, 0.0))
        fleet.advance()
        closest = min(closest, fleet.closest_m)
        if fleet.collisions:
            began.append(fleet.collisions)
            assert [fleet.status(i)[2] for i in range(2)] == [True, True]
    assert began[0] == [(0, 1)]
    assert len(began) < 12
    assert 0.42 < closest < 0.52
    gates(fleet, 200)
    assert not fleet.status(0)[2]
    assert fleet.collisions == []


def test_the_wind_is_reported():
    windy = scenario(environment={"wind": {"steady_m_s": [1.0, 2.0, 0.0], "gust_m_s": 0.0}})
    np.testing.assert_array_equal(Fleet(windy).wind_m_s, [(1.0, 2.0, 0.0)] * 2)


def test_a_diverged_state_is_reported_with_drone_and_time():
    fleet = Fleet(scenario(drone={"inertia_kg_m2": [1e-9, 1e-9, 1e-9]}, gust=0.0))
    fleet.takeoff(1)
    with refused(DivergedError, "d1", "s", "finite") as raised:
        gates(fleet, 500)
    assert raised.value.drone == "d1"
    assert has_terms(str(raised.value), f"{(fleet.t_ns + 20_000_000) / 1e9:.3f}")


def test_truth_is_a_copy_and_a_drone_above_the_ground_falls():
    fleet = Fleet(scenario(1, drone={"position_m": [0, 0, 0.3]}))
    before = fleet.truth()
    kept = before.position_m.copy()
    gates(fleet, 100)
    np.testing.assert_array_equal(before.position_m, kept)
    assert fleet.truth().position_m[0, 2] == pytest.approx(0.058, abs=2e-3)


def test_a_hundred_crowded_drones_collide_and_stay_finite():
    drones = [{"name": f"d{k}", "position_m": [0.61 * (k % 10), 0.61 * (k // 10), 0]} for k in range(100)]
    crowd = {"name": "t", "duration_s": 1, "environment": {"wind": {"gust_m_s": 1.0}}, "drones": drones}
    fleet = Fleet(resolve(crowd))
    for i in range(100):
        fleet.takeoff(i)
    touched = 0
    for _ in range(500):
        fleet.advance()
        touched += len(fleet.collisions)
    assert touched > 0
    assert np.isfinite(fleet.truth().position_m).all()
    assert fleet.closest_m > 0.3


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
def test_every_vehicle_takes_off_hovers_follows_a_velocity_and_lands(model: str):
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
def test_vehicles_of_different_sizes_and_rotor_counts_fly_side_by_side():
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
def test_a_quadrotor_flies_the_same_bits_alone_and_beside_a_hexacopter():
    alone, beside = airborne("ardrone2"), airborne("ardrone2", "hexacopter")
    for flight in (alone, beside):
        fly(flight, 2.0, (0.5, 0.2, 0.1))
    np.testing.assert_array_equal(alone.truth().position_m[0], beside.truth().position_m[0])
    np.testing.assert_array_equal(alone.truth().rotor_rad_s[0], beside.truth().rotor_rad_s[0, :4])


@six_rotors
def test_truth_and_commands_have_one_value_per_rotor():
    flight = airborne("crazyflie2", "hexacopter")
    bundle = GatePublication(flight).gate([None, None])
    quad, hexa = (message.rotor_rad_s for key, message in bundle.decoded() if key.endswith("truth"))
    np.testing.assert_array_equal(quad, flight.truth().rotor_rad_s[0, :4])
    np.testing.assert_array_equal(hexa, flight.truth().rotor_rad_s[1])
    assert "6 rotors" in str(flight.set_rotors(1, (300.0,) * 4))
    assert flight.set_rotors(1, (400.0,) * 6) is None
    fly(flight, 0.2)
    np.testing.assert_allclose(flight.truth().rotor_rad_s[1], 400.0, rtol=0.01)
