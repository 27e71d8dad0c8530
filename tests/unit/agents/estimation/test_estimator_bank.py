"""A bank of drones: each as if it were alone, and sound whatever comes in."""

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2
from synthetic_flight import GATE_S, Flight, Reading, feed, readings, seconds

from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim_agents.estimation.drone_estimator import StateEstimate
from zsim_agents.estimation.estimator_bank import EstimatorBank

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


def bank_of(of: Scenario) -> EstimatorBank:
    return EstimatorBank(of.drones, of.environment, of.estimation, GATE_S)


def fly(bank: EstimatorBank, by_gate: Sequence[Sequence[Sequence[Reading]]], span: range) -> list[list[StateEstimate]]:
    """Return the estimates of each gate of a span, from the readings of each drone by gate."""
    estimates = []
    for gate in span:
        for i, each in enumerate(by_gate):
            for reading in each[gate]:
                feed(bank, i, reading)
        estimates.append(bank.estimate(seconds(gate * GATE_S)))
    return estimates


def same(a: list[StateEstimate], b: list[StateEstimate]) -> bool:
    """Equal to the bit; repr tells numbers apart that differ in any bit, and NaN is NaN."""
    return repr(a) == repr(b)


def as_if_alone(of: Scenario, coming: Sequence[Sequence[Reading]]) -> list[list[StateEstimate]]:
    """Fly a bank of all drones, and one of each: the estimates must be the same. Return them by gate."""
    by_gate, span = [gates(each) for each in coming], range(1, round(END_S / GATE_S) + 1)
    among = fly(bank_of(of), by_gate, span)
    for i, drone in enumerate(of.drones):
        alone = fly(bank_of(msgspec.structs.replace(of, drones=[drone])), by_gate[i : i + 1], span)
        assert same([each[0] for each in alone], [each[i] for each in among])
    return among


def nees(flight: Flight, t_s: float, estimate: StateEstimate) -> float:
    """Return e^T P^-1 e of position and velocity."""
    t = np.array([t_s])
    truth = np.concatenate([flight.position(t)[0], flight.velocity(t)[0]])
    error = truth - (*estimate.position_m, *estimate.velocity_m_s)
    return float(error @ np.linalg.solve(np.reshape(estimate.covariance, (6, 6)), error))


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
def flights(seed: int) -> list[Flight]:
    """Return a flight of its own for each drone."""
    return [Flight(seed + i, start_s=2.0, yaw_rate=0.3 * i) for i in range(3)]


@cache
def flown(seed: int, preset: str = "paper") -> list[list[Reading]]:
    """Return what each drone's sensors say of a flight of its own; vectors are tuples, as messages have them."""
    of = three(preset)
    pairs = zip(of.drones, flights(seed), strict=True)
    alone = [(msgspec.structs.replace(of, drones=[drone]), flight) for drone, flight in pairs]
    return [
        [_tupled(reading) for reading in readings(flight, each, seed + i, END_S)]
        for i, (each, flight) in enumerate(alone)
    ]


def _tupled(reading: Reading) -> Reading:
    values = (tuple(value) if isinstance(value, list) else value for value in reading.values)
    return reading._replace(values=tuple(values))


@pytest.mark.parametrize("preset", ["paper", "ardrone2"])
def test_each_drone_is_estimated_as_if_it_were_alone(preset: str):
    as_if_alone(three(preset), flown(1, preset))


@pytest.mark.parametrize("settings", [{"magnetometer": False}, {"flow": False}, {"madgwick_beta": 0.1}])
def test_with_other_settings_too(settings: dict[str, Any]):
    as_if_alone(three(estimation=settings), flown(3))


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
    among = as_if_alone(of, [change(coming, rng) for coming in flown(4)])
    for estimate in among[-1]:
        P = np.reshape(estimate.covariance, (6, 6))
        assert np.isfinite((*estimate.position_m, *estimate.velocity_m_s, *estimate.orientation_wxyz)).all()
        assert (P == P.T).all()
        assert np.linalg.eigvalsh(P).min() > 0.0
    if change is not displaced:
        each = zip(flights(4), among[-1], strict=True)
        assert max(nees(flight, END_S, estimate) for flight, estimate in each) < chi2.ppf(1.0 - 1e-6, 6)


def test_a_restart_goes_on_from_what_was_published():
    of, coming = three(), flown(6)
    by_gate = [gates(each) for each in coming]
    last = fly(bank_of(of), by_gate, range(1, 300))[-1]
    bank = bank_of(of)
    for i, estimate in enumerate(last):
        bank.warm_start(i, estimate)
    for flight, estimate in zip(flights(6), fly(bank, by_gate, range(300, 400))[-1], strict=True):
        assert nees(flight, 399 * GATE_S, estimate) < chi2.ppf(1.0 - 1e-6, 6)


def test_sensors_that_it_does_not_know_are_left_out():
    of = three()
    bank = bank_of(of)
    bank.receive(0, "airspeed", object(), 0.02)
    assert same(bank.estimate(0.02), bank_of(of).estimate(0.02))
