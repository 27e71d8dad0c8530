"""The compiled bank says to the bit what an estimator of each drone says, whatever comes in."""

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import msgspec
import numpy as np
import pytest
from synthetic_flight import GATE_S, Flight, Reading, readings

from zsim.math.compiled import COMPILES
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim_agents.estimation.drone_estimator import DroneEstimator
from zsim_agents.estimation.estimate import Estimate
from zsim_agents.estimation.estimator_bank import EstimatorBank

pytestmark = pytest.mark.skipif(not COMPILES, reason="numba is not installed: a bank is made only where it is")
END_S = 8.0  # s, of a flight that starts at 2 s
ASIDE = {"mount": {"position_m": [0.1, -0.05, 0.04], "rpy_deg": [10.0, -20.0, 160.0]}}
BIASED = {"bias": 0.3, "bias_walk": 0.01}
KINDS = ("imu", "gps", "mag", "baro", "sonar", "flow")
Change = Callable[[list[Reading], np.random.Generator], list[Reading]]


def gates(coming: Sequence[Reading]) -> list[list[Reading]]:
    """Sort readings by the gate at whose end they are used."""
    sorted_in: list[list[Reading]] = [[] for _ in range(round(END_S / GATE_S) + 1)]
    for reading in coming:
        sorted_in[min(math.ceil(reading.t_s / GATE_S - 1e-6), len(sorted_in) - 1)].append(reading)
    return sorted_in


def together(of: Scenario, coming: Sequence[Sequence[Reading]]) -> None:
    """Feed a bank of all drones and an estimator of each; all they say must be equal."""
    cores = [DroneEstimator(d, of.environment, of.estimation, GATE_S) for d in of.drones]
    bank = EstimatorBank(of.drones, of.environment, of.estimation, GATE_S)
    by_gate = [gates(each) for each in coming]
    for gate in range(1, len(by_gate[0])):
        for i, core in enumerate(cores):
            for reading in by_gate[i][gate]:
                feed(core, bank, i, reading)
        t_s = gate * GATE_S
        assert same([core.close(t_s) for core in cores], bank.close(t_s)), f"gate {gate}"


def same(a: list[Estimate], b: list[Estimate]) -> bool:
    """Equal to the bit; repr tells numbers apart that differ in any bit, and NaN is NaN."""
    return repr(a) == repr(b)


def feed(core: DroneEstimator, bank: EstimatorBank, i: int, reading: Reading) -> None:
    t_s, name, t_sample_s, values = reading
    if name == "imu":
        core.imu(t_sample_s, *values)
        bank.imu(i, t_sample_s, *values)
    else:
        getattr(core, name)(t_s, t_sample_s, *values)
        getattr(bank, name)(i, t_s, t_sample_s, *values)


def three(preset: str = "paper", **sections: Any) -> Scenario:
    """Return a scenario of three drones with error states of different sizes, the last with every sensor aside."""
    biased = {"gps": "position_m", "baro": "altitude_m", "flow": "velocity_m_s"}
    aside = {kind: ASIDE | ({biased[kind]: BIASED} if kind in biased else {}) for kind in KINDS}
    drones = [
        {"name": "drone1", "position_m": [0.0, 0.0, 0.0], "yaw_deg": 30.0},
        {"name": "drone2", "position_m": [4.0, 0.0, 0.0], "yaw_deg": -170.0, "sensors": {"preset": "ardrone2"}},
        {"name": "drone3", "position_m": [8.0, 0.0, 0.0], "yaw_deg": 90.0, "sensors": aside},
    ]
    return scenario_file.resolve(
        {"name": "three", "duration_s": 60, "sensors": {"preset": preset}, "drones": drones, **sections}
    )


@cache
def flown(seed: int, preset: str = "paper") -> list[list[Reading]]:
    """Return what each drone's sensors say of a flight of its own; vectors are tuples, as messages have them."""
    of = three(preset)
    return [
        [
            _tupled(reading)
            for reading in readings(
                Flight(seed + i, start_s=2.0, yaw_rate=0.3 * i),
                msgspec.structs.replace(of, drones=[drone]),
                seed + i,
                END_S,
            )
        ]
        for i, drone in enumerate(of.drones)
    ]


def _tupled(reading: Reading) -> Reading:
    values = (tuple(value) if isinstance(value, list) else value for value in reading.values)
    return reading._replace(values=tuple(values))


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("preset", ["paper", "ardrone2"])
def test_a_bank_says_what_each_drones_estimator_says(preset: str, seed: int):
    of = three(preset)
    together(of, flown(seed, preset))


@pytest.mark.parametrize("settings", [{"magnetometer": False}, {"flow": False}, {"madgwick_beta": 0.1}])
def test_with_other_settings_too(settings: dict[str, Any]):
    of = three(estimation=settings)
    together(of, flown(3))


def lost(coming: list[Reading], rng: np.random.Generator) -> list[Reading]:
    """A third of everything does not come."""
    return [reading for reading in coming if rng.random() > 0.33]


def silent_imu(coming: list[Reading], rng: np.random.Generator) -> list[Reading]:
    """The IMU says nothing for a second and a half: dead reckoning coasts."""
    return [reading for reading in coming if reading.sensor != "imu" or not 4.0 < reading.t_s < 5.5]


def shuffled(coming: list[Reading], rng: np.random.Generator) -> list[Reading]:
    """Readings come in any order, some twice, some a second late."""
    again = [reading for reading in coming if rng.random() < 0.1]
    late = [reading._replace(t_s=reading.t_s + rng.uniform(0.0, 1.0)) for reading in coming if rng.random() < 0.1]
    mixed = [*coming, *again, *late]
    return sorted(mixed, key=lambda reading: (math.ceil(reading.t_s / GATE_S - 1e-6), rng.random()))


def impossible(coming: list[Reading], rng: np.random.Generator) -> list[Reading]:
    """One in ten has a value that no sensor can read."""
    return [_spoilt(reading, rng) if rng.random() < 0.1 else reading for reading in coming]


def _spoilt(reading: Reading, rng: np.random.Generator) -> Reading:
    bad = float(rng.choice([math.nan, math.inf, 1e9, -700.0, 0.0]))
    place = int(rng.integers(len(reading.values)))
    value = reading.values[place]
    if isinstance(value, bool | int):
        return reading._replace(values=(*reading.values[:place], not value, *reading.values[place + 1 :]))
    worse = bad if isinstance(value, float) else (bad, *value[1:])
    return reading._replace(values=(*reading.values[:place], worse, *reading.values[place + 1 :]))


def displaced(coming: list[Reading], rng: np.random.Generator) -> list[Reading]:
    """From 2.5 s on GPS, barometer and flow are far off: refused until patience ends, then believed."""
    shift = {"gps": 60.0, "baro": 30.0, "flow": 9.0, "mag": 40.0}
    return [_moved(r, shift[r.sensor]) if r.t_s > 2.5 and r.sensor in shift else r for r in coming]


def _moved(reading: Reading, by: float) -> Reading:
    first, *rest = reading.values
    moved = first + by if isinstance(first, float) else tuple(x + by for x in first)
    return reading._replace(values=(moved, *rest))


def crowded(coming: list[Reading], rng: np.random.Generator) -> list[Reading]:
    """A link stood still and gives half a second's readings to one gate: more than one update can hold."""
    return [reading._replace(t_s=5.5) if 5.4 < reading.t_s <= 5.5 else _closer(reading) for reading in coming]


def _closer(reading: Reading) -> Reading:
    held = reading.sensor != "imu" and 5.0 < reading.t_s <= 5.4
    return reading._replace(t_s=5.5) if held else reading


@pytest.mark.parametrize("change", [lost, silent_imu, shuffled, impossible, displaced, crowded])
def test_whatever_comes_in(change: Change):
    of, rng = three(), np.random.default_rng(5)
    together(of, [change(coming, rng) for coming in flown(4)])


def test_a_restart_goes_on_from_what_was_published():
    of, coming = three(), flown(6)
    first = EstimatorBank(of.drones, of.environment, of.estimation, GATE_S)
    by_gate = [gates(each) for each in coming]
    last = estimates_of(first, by_gate, range(1, 300))[-1]
    bank = EstimatorBank(of.drones, of.environment, of.estimation, GATE_S)
    cores = [DroneEstimator(d, of.environment, of.estimation, GATE_S) for d in of.drones]
    for i, (core, e) in enumerate(zip(cores, last, strict=True)):
        known = (e.position_m, e.velocity_m_s, e.orientation_wxyz, e.covariance, e.yaw_sigma_rad, e.gyro_bias_rad_s)
        core.warm_start(*known)
        bank.warm_start(i, *known)
    for gate in range(300, 400):
        for i, core in enumerate(cores):
            for reading in by_gate[i][gate]:
                feed(core, bank, i, reading)
        assert same([core.close(gate * GATE_S) for core in cores], bank.close(gate * GATE_S)), f"gate {gate}"


def estimates_of(
    bank: EstimatorBank, by_gate: Sequence[Sequence[Sequence[Reading]]], span: range
) -> list[list[Estimate]]:
    """Fly a bank by itself."""
    told = []
    for gate in span:
        for i, each in enumerate(by_gate):
            for reading in each[gate]:
                t_s, name, t_sample_s, values = reading
                if name == "imu":
                    bank.imu(i, t_sample_s, *values)
                else:
                    getattr(bank, name)(i, t_s, t_sample_s, *values)
        told.append(bank.close(gate * GATE_S))
    return told


def test_a_drone_is_estimated_alike_alone_and_among_others():
    of = three()
    by_gate = [gates(each) for each in flown(7)]
    span = range(1, 200)
    among = estimates_of(EstimatorBank(of.drones, of.environment, of.estimation, GATE_S), by_gate, span)
    for i, drone in enumerate(of.drones):
        alone = estimates_of(EstimatorBank([drone], of.environment, of.estimation, GATE_S), by_gate[i : i + 1], span)
        assert same([each[0] for each in alone], [each[i] for each in among])
