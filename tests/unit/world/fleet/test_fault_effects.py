"""Effects of each fault on sensors, rotors and air, measured on a fleet against a twin without faults."""

from typing import Any

import numpy as np
import pytest
from fleet_samples import samples_of

from zsim.contract.run_messages import Fault
from zsim.scenario.faults import ROTORS, planned
from zsim.scenario.scenario_file import resolve
from zsim_world.fleet.fault_effects import gust_m_s
from zsim_world.fleet.fleet import Fleet

GATE_NS = 20_000_000
FIELDS = {"imu": 6, "gps": 9, "mag": 3, "baro": 2, "sonar": 2, "flow": 4}
WHITE = {"noise": 0.5, "bias": 0.3}
SENSORS = {
    "preset": "paper",
    "imu": {"accel_m_s2": WHITE, "gyro_deg_s": WHITE},
    "gps": {"position_m": WHITE, "velocity_m_s": WHITE},
    "mag": {"field_ut": WHITE},
    "baro": {"altitude_m": WHITE},
    "sonar": {"range_m": {"noise": 0.002, "bias": 0.001}, "min_m": 0.0, "max_m": 20.0},
    "flow": {"velocity_m_s": WHITE},
}
# first word of the kind: (sensor, affected values of a sample, parameters of a bias, bias in the unit of the values)
CHANNELS: dict[str, tuple[str, slice, dict[str, Any], Any]] = {
    "accel": ("imu", slice(0, 3), {"value_m_s2": [0.1, -0.2, 0.3]}, [0.1, -0.2, 0.3]),
    "gyro": ("imu", slice(3, 6), {"value_deg_s": [1, 2, -3]}, np.radians([1, 2, -3])),
    "gps": ("gps", slice(3, 6), {"value_m": [3, -4, 5]}, [3, -4, 5]),
    "mag": ("mag", slice(0, 3), {"value_ut": [1, 2, 3]}, [1, 2, 3]),
    "baro": ("baro", slice(1, 2), {"value_m": 7}, [7]),
    "sonar": ("sonar", slice(0, 1), {"value_m": 0.4}, [0.4]),
    "flow": ("flow", slice(0, 3), {"value_m_s": [0.1, 0.2, 0.3]}, [0.1, 0.2, 0.3]),
}


def fleet(gust: float = 0.0, sensors: Any = None) -> Fleet:
    drones = [{"name": f"d{k}", "position_m": [3 * k, 0, 0], "yaw_deg": 30} for k in (1, 2)]
    document = {"name": "t", "duration_s": 1, "seed": 5, "drones": drones, "sensors": sensors or SENSORS}
    return Fleet(resolve({**document, "environment": {"wind": {"gust_m_s": gust, "steady_m_s": [1, 0, 0]}}}))


def fault(kind: str, target: str = "d1", number: int = 1, **parameters: Any) -> Fault:
    return planned({"kind": kind, "target": target, **parameters}, number, "test", 0, GATE_NS)


def samples(flying: Fleet, name: str, gates: int, drone: int = 0) -> list[tuple[int, tuple[float, ...]]]:
    """Advance; return (t_ns, values) of one sensor."""
    found = []
    for _ in range(gates):
        flying.advance()
        found += [(s.t_ns, s.values) for s in samples_of(flying) if (s.sensor, s.drone) == (name, drone)]
    return found


def values(flying: Fleet, name: str, gates: int, drone: int = 0) -> np.ndarray:
    return np.array([row for _, row in samples(flying, name, gates, drone)])


@pytest.mark.parametrize("word", CHANNELS)
def test_a_bias_is_added_and_removed_again(word: str):
    name, which, given, bias = CHANNELS[word]
    sound, faulty = fleet(), fleet()
    faulty.impairment.strike([fault(f"{word}_bias", **given)])
    pairs = values(sound, name, 60), values(faulty, name, 60)
    assert pairs[1][:, which] - pairs[0][:, which] == pytest.approx(np.tile(bias, (len(pairs[0]), 1)), abs=1e-9)
    faulty.impairment.strike([])
    assert np.array_equal(values(sound, name, 60), values(faulty, name, 60))


@pytest.mark.parametrize("word", CHANNELS)
def test_noise_grows_by_its_factor(word: str):
    """From three to five times the noise, each sample changes by as much as from one to three times."""
    name, which, _, _ = CHANNELS[word]
    thrice, five, sound = fleet(), fleet(), fleet()
    thrice.impairment.strike([fault(f"{word}_noise", factor=3)])
    five.impairment.strike([fault(f"{word}_noise", factor=5)])
    a, b, c = (values(each, name, 400)[:, which] for each in (sound, thrice, five))
    assert np.std(b - a) > 0.0
    assert (c - b) == pytest.approx(b - a, abs=1e-6)
    sigma = 0.002 if word == "sonar" else 0.5 * (np.pi / 180 if word == "gyro" else 1.0)
    assert np.sqrt(np.mean((b - a) ** 2)) == pytest.approx(2 * sigma, rel=0.2)


@pytest.mark.parametrize("name", FIELDS)
def test_a_stuck_sensor_repeats_its_first_sample_after_the_start(name: str):
    flying = fleet()
    before = values(flying, name, 60)
    assert len(np.unique(before, axis=0)) > 1
    flying.impairment.strike([fault(f"{name}_stuck")])
    held = values(flying, name, 60)
    assert len(held) > 1
    assert len(np.unique(held, axis=0)) == 1
    assert not (before == held[0]).all(axis=1).any()
    flying.impairment.strike([])
    assert not (values(flying, name, 60) == held[0]).all(axis=1).any()


@pytest.mark.parametrize("name", FIELDS)
def test_a_fault_changes_neither_the_other_drone_nor_later_samples(name: str):
    sound, faulty = fleet(), fleet()
    faulty.impairment.strike([fault(f"{name}_stuck"), fault(f"{name}_dropout", number=2, probability=0.5)])
    for drone in (1, 1):
        assert np.array_equal(values(sound, name, 50, drone), values(faulty, name, 50, drone))
    faulty.impairment.strike([])
    assert np.array_equal(values(sound, name, 50), values(faulty, name, 50))


@pytest.mark.parametrize("name", FIELDS)
def test_a_dropout_loses_samples_at_its_probability(name: str):
    flying, gates = fleet(), 3000
    expected = len(samples(flying, name, gates))
    flying.impairment.strike([fault(f"{name}_dropout", probability=0.3)])
    kept = len(samples(flying, name, gates))
    sigma = np.sqrt(0.3 * 0.7 / expected)
    assert kept / expected == pytest.approx(0.7, abs=4 * sigma)
    flying.impairment.strike([fault(f"{name}_dropout")])
    assert samples(flying, name, 100) == []
    flying.impairment.strike([])
    assert len(samples(flying, name, gates)) == expected


def test_dropouts_combine_with_each_other_and_with_the_scenario_s():
    flying = fleet(sensors={"preset": "paper", "baro": {"dropout": 0.2}})
    rate = 25 * 0.02
    both = [fault("baro_dropout", probability=0.5), fault("baro_dropout", number=2, probability=0.5)]
    flying.impairment.strike(both)
    assert len(samples(flying, "baro", 4000)) / (4000 * rate) == pytest.approx(0.8 * 0.25, abs=0.04)
    flying.impairment.strike(both[1:])
    assert len(samples(flying, "baro", 4000)) / (4000 * rate) == pytest.approx(0.8 * 0.5, abs=0.05)


def hovering() -> Fleet:
    flying = fleet()
    assert flying.takeoff(0) is None
    for _ in range(300):
        flying.advance()
    return flying


@pytest.mark.parametrize("rotor", range(4))
def test_a_weak_rotor_produces_its_share_of_the_thrust(rotor: int):
    """Thrust is proportional to speed squared: the rotor runs at the commanded speed times the root of the share."""
    flying, share = hovering(), 0.6
    flying.impairment.strike([fault("rotor_efficiency", rotor=ROTORS[rotor], value=share)])
    assert flying.set_rotors(0, (300.0,) * 4) is None
    for _ in range(10):  # 0.2 s, before the firmware detects that the drone has overturned and cuts the motors
        flying.advance()
    speeds = flying.truth().rotor_rad_s[0]
    assert speeds[rotor] ** 2 / 300.0**2 == pytest.approx(share, rel=0.01)
    assert np.delete(speeds, rotor) == pytest.approx([300.0] * 3, rel=0.01)


def test_efficiencies_of_a_rotor_multiply():
    flying = hovering()
    weak = [
        fault("rotor_efficiency", rotor="all", value=0.9),
        fault("rotor_efficiency", number=2, rotor="all", value=0.8),
    ]
    flying.impairment.strike(weak)
    assert flying.boards.actuator[0, 1:5] ** 2 == pytest.approx([0.72] * 4)
    flying.impairment.strike(weak[:1])
    assert flying.boards.actuator[0, 1:5] ** 2 == pytest.approx([0.9] * 4)


def test_a_stuck_rotor_keeps_the_given_speed_or_that_at_the_start():
    flying = hovering()
    flying.impairment.strike([fault("rotor_stuck", rotor="front_left", speed_rad_s=150.0)])
    for _ in range(10):
        flying.advance()
    assert flying.truth().rotor_rad_s[0, 0] == pytest.approx(150.0, rel=0.01)
    flying = hovering()
    turning = flying.truth().rotor_rad_s[0]
    stuck = fault("rotor_stuck", rotor="rear_left")
    flying.impairment.strike([stuck])
    flying.set_rotors(0, (400.0,) * 4)
    for _ in range(10):
        flying.advance()
    flying.impairment.strike([stuck, fault("mag_stuck", number=2)])  # another fault begins in the meantime
    for _ in range(10):
        flying.advance()
    speeds = flying.truth().rotor_rad_s[0]
    assert speeds[3] == pytest.approx(turning[3], rel=1e-6)
    assert speeds[:3] == pytest.approx([400.0] * 3, rel=1e-3)


def test_a_gust_adds_a_one_minus_cosine_profile_to_the_steady_wind():
    flying = fleet()
    blow = planned({"kind": "gust", "target": "world", "for_s": 2.0, "velocity_m_s": [0, 4, 0]}, 1, "t", 0, GATE_NS)
    flying.impairment.strike([blow])
    felt = []
    for gate in range(100):
        flying.impairment.blow(gate * GATE_NS, (gate + 1) * GATE_NS)
        felt.append(flying.wind_m_s[0])
    middles = (np.arange(100) + 0.5) / 100
    assert np.array(felt)[:, 1] == pytest.approx(2.0 * (1 - np.cos(2 * np.pi * middles)), abs=1e-9)
    assert np.array(felt)[:, 0] == pytest.approx([1.0] * 100)
    assert gust_m_s(blow, 1_000_000_000) == pytest.approx([0, 4, 0])
    flying.impairment.strike([])
    flying.impairment.blow(100 * GATE_NS, 101 * GATE_NS)
    assert flying.wind_m_s[0].tolist() == [1.0, 0.0, 0.0]
