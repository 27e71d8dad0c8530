"""The estimator bank: independence of the drones, robustness to bad readings, and reading of whole gates."""

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2
from synthetic_flight import GATE_S, Flight, Reading, feed, readings, seconds

from zsim.contract import keys
from zsim.contract.framing import GateMessages
from zsim.math.compiled import COMPILES
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim_agents.estimation.drone_estimator import StateEstimate
from zsim_agents.estimation.estimator import Estimator
from zsim_agents.estimation.estimator_bank import EstimatorBank
from zsim_world.run.world import World

END_S = 8.0  # s, end of a flight that starts at 2 s
ASIDE = {"mount": {"position_m": [0.1, -0.05, 0.04], "rpy_deg": [10.0, -20.0, 160.0]}}
BIASED = {"bias": 0.3, "bias_walk": 0.01}
KINDS = ("imu", "gps", "mag", "baro", "sonar", "flow")
Change = Callable[[list[Reading], np.random.Generator], list[Reading]]


def gates(coming: Sequence[Reading]) -> list[list[Reading]]:
    """Group readings by the gate at whose end they are used."""
    sorted_in: list[list[Reading]] = [[] for _ in range(round(END_S / GATE_S) + 1)]
    for reading in coming:
        sorted_in[min(math.ceil(reading.t_s / GATE_S - 1e-6), len(sorted_in) - 1)].append(reading)
    return sorted_in


def bank_of(of: Scenario) -> EstimatorBank:
    return EstimatorBank(of.drones, of.environment, of.estimation, GATE_S)


def fly(bank: EstimatorBank, by_gate: Sequence[Sequence[Sequence[Reading]]], span: range) -> list[list[StateEstimate]]:
    """Return the estimates at each gate of a span, given the readings of each drone by gate."""
    estimates = []
    for gate in span:
        for i, each in enumerate(by_gate):
            for reading in each[gate]:
                feed(bank, i, reading)
        estimates.append(bank.estimate(seconds(gate * GATE_S)))
    return estimates


def same(a: list[StateEstimate], b: list[StateEstimate]) -> bool:
    """Return whether estimates are equal to the bit: repr differs if any bit does, and NaN equals NaN."""
    return repr(a) == repr(b)


def as_if_alone(of: Scenario, coming: Sequence[Sequence[Reading]]) -> list[list[StateEstimate]]:
    """Assert that one bank of all drones and a bank for each give the same estimates; return them by gate."""
    by_gate, span = [gates(each) for each in coming], range(1, round(END_S / GATE_S) + 1)
    among = fly(bank_of(of), by_gate, span)
    for i, drone in enumerate(of.drones):
        alone = fly(bank_of(msgspec.structs.replace(of, drones=[drone])), by_gate[i : i + 1], span)
        assert same([each[0] for each in alone], [each[i] for each in among])
    return among


def nees(flight: Flight, t_s: float, estimate: StateEstimate) -> float:
    """Return e^T P^-1 e for position and velocity."""
    t = np.array([t_s])
    truth = np.concatenate([flight.position(t)[0], flight.velocity(t)[0]])
    error = truth - (*estimate.position_m, *estimate.velocity_m_s)
    return float(error @ np.linalg.solve(np.reshape(estimate.covariance, (6, 6)), error))


def three(preset: str = "paper", **sections: Any) -> Scenario:
    """Return a scenario of three drones with error states of different sizes; the last has its sensors off-centre."""
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
    """Return a separate flight for each drone."""
    return [Flight(seed + i, start_s=2.0, yaw_rate=0.3 * i) for i in range(3)]


@cache
def flown(seed: int, preset: str = "paper") -> list[list[Reading]]:
    """Return the readings of each drone's sensors in its own flight; vectors are tuples, as in messages."""
    of = three(preset)
    pairs = zip(of.drones, flights(seed), strict=True)
    alone = [(msgspec.structs.replace(of, drones=[drone]), flight) for drone, flight in pairs]

    def tupled(reading: Reading) -> Reading:
        values = (tuple(value) if isinstance(value, list) else value for value in reading.values)
        return reading._replace(values=tuple(values))

    return [[*map(tupled, readings(flight, each, seed + i, END_S))] for i, (each, flight) in enumerate(alone)]


@pytest.mark.parametrize(
    ("preset", "settings"),
    [
        ("ardrone2", {}),
        ("paper", {"magnetometer": False}),
        ("paper", {"flow": False}),
        ("paper", {"madgwick_beta": 0.1}),
    ],
)
def test_each_drone_is_estimated_as_if_it_were_alone(preset: str, settings: dict[str, Any]):
    as_if_alone(three(preset, estimation=settings), flown(3, preset))


def lost(coming: list[Reading], rng: np.random.Generator) -> list[Reading]:
    """Drop a third of all readings."""
    return [reading for reading in coming if rng.random() > 0.33]


def silent_imu(coming: list[Reading], rng: np.random.Generator) -> list[Reading]:
    """Drop IMU readings for 1.5 s: dead reckoning coasts."""
    return [reading for reading in coming if reading.sensor != "imu" or not 4.0 < reading.t_s < 5.5]


def shuffled(coming: list[Reading], rng: np.random.Generator) -> list[Reading]:
    """Deliver readings in any order, some of them twice and some up to a second late."""
    again = [reading for reading in coming if rng.random() < 0.1]
    late = [reading._replace(t_s=reading.t_s + rng.uniform(0.0, 1.0)) for reading in coming if rng.random() < 0.1]
    mixed = [*coming, *again, *late]
    return sorted(mixed, key=lambda reading: (math.ceil(reading.t_s / GATE_S - 1e-6), rng.random()))


def impossible(coming: list[Reading], rng: np.random.Generator) -> list[Reading]:
    """Give one reading in ten a value that no sensor can measure."""

    def spoilt(reading: Reading) -> Reading:
        bad, values = float(rng.choice([math.nan, math.inf, 1e9, -700.0, 0.0])), list(reading.values)
        place = int(rng.integers(len(values)))
        value = values[place]
        if isinstance(value, bool | int):
            values[place] = not value
        else:
            values[place] = bad if isinstance(value, float) else (bad, *value[1:])
        return reading._replace(values=tuple(values))

    return [spoilt(reading) if rng.random() < 0.1 else reading for reading in coming]


def displaced(coming: list[Reading], rng: np.random.Generator) -> list[Reading]:
    """Offset GPS, magnetometer, barometer and flow from 2.5 s: they are refused until patience ends, then accepted."""
    shift = {"gps": 60.0, "baro": 30.0, "flow": 9.0, "mag": 40.0}

    def moved(reading: Reading) -> Reading:
        by, (first, *rest) = shift[reading.sensor], reading.values
        return reading._replace(
            values=(first + by if isinstance(first, float) else tuple(x + by for x in first), *rest)
        )

    return [moved(r) if r.t_s > 2.5 and r.sensor in shift else r for r in coming]


def crowded(coming: list[Reading], rng: np.random.Generator) -> list[Reading]:
    """Deliver half a second of readings to one gate, as after a stalled link: more than one update can hold."""
    held = [5.4 < r.t_s <= 5.5 or (r.sensor != "imu" and 5.0 < r.t_s <= 5.4) for r in coming]
    return [r._replace(t_s=5.5) if late else r for r, late in zip(coming, held, strict=True)]


@pytest.mark.parametrize("change", [lost, silent_imu, shuffled, impossible, displaced, crowded])
def test_estimates_stay_sound_under_disturbed_readings(change: Change):
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


def test_a_restarted_bank_continues_from_published_estimates():
    of, by_gate = three(), [gates(each) for each in flown(6)]
    last = fly(bank_of(of), by_gate, range(1, 300))[-1]
    bank = bank_of(of)
    bank.receive(0, "airspeed", object(), 0.02)  # an unknown sensor
    assert same(bank.estimate(0.02), bank_of(of).estimate(0.02))
    bank = bank_of(of)
    for i, estimate in enumerate(last):
        bank.warm_start(i, estimate)
    for flight, estimate in zip(flights(6), fly(bank, by_gate, range(300, 400))[-1], strict=True):
        assert nees(flight, 399 * GATE_S, estimate) < chi2.ppf(1.0 - 1e-6, 6)


# Sensor messages of a gate

DRONES = ("d1", "d2", "d3")


@pytest.fixture(scope="module")
def flight() -> tuple[World, list[GateMessages]]:
    places = [{"name": name, "position_m": [3 * i, 0, 0]} for i, name in enumerate(DRONES)]
    latency = {"gps": {"latency_ms": 35.0}, "mag": {"latency_ms": 5.0}}
    of = scenario_file.resolve({"name": "reader", "drones": places, "sensors": latency, "duration_s": 5})
    world, gates = World(of), []
    for number in range(120):
        if number == 20:
            assert world.fleet.takeoff(0) is None
        gates.append(world._publication.gate(world.queue.commanders()))
        world.fleet.advance()
    return world, gates


compiled = pytest.mark.skipif(not COMPILES, reason="numba is not installed: gates are taken apart")


def estimates(agent: Estimator, gates: list[GateMessages], whole: bool) -> list[object]:
    """Return an estimator's outputs for a flight, delivered as gates or as messages in the order of a runner."""
    outputs = []
    for gate in gates:
        if whole:
            agent.receive_gate(gate)
        else:
            readings = [(key, m) for key, m in gate.decoded() if keys.is_sensor(key)]
            for key, message in sorted(readings, key=lambda entry: (entry[1].t_ns, entry[0], entry[1].seq)):
                if keys.thing(key) in agent.counted:
                    agent.receive(key, message)
        outputs += agent.step(gate.t_ns)
    return outputs


@compiled
@pytest.mark.parametrize("drones", [DRONES, ("d2",), ("d3", "d1")])
def test_a_gate_gives_the_estimates_of_its_messages(
    flight: tuple[World, list[GateMessages]], drones: tuple[str, ...]
) -> None:
    world, gates = flight
    whole, each = (Estimator(world.info(), world.scenario, drones) for _ in range(2))
    assert whole.takes_gates
    assert estimates(whole, gates, whole=True) == estimates(each, gates, whole=False)


@compiled
def test_a_message_in_an_unusual_encoding_is_decoded_all_the_same(
    flight: tuple[World, list[GateMessages]],
) -> None:
    """Its floats are encoded as integers: valid, but not supported by the compiled reader."""
    world, gates = flight
    gate = next(b for b in gates if any(key.endswith("mag") for key, _ in b.pairs))
    whole_ut = {"field_ut": [20, 0, -40]}
    pairs = [
        (key, msgspec.msgpack.encode(msgspec.msgpack.decode(payload) | whole_ut) if key.endswith("/mag") else payload)
        for key, payload in gate.pairs
    ]
    changed = [GateMessages.of(gate.t_ns, gate.seq, gate.table, pairs) if b is gate else b for b in gates]
    whole, each = (Estimator(world.info(), world.scenario, DRONES) for _ in range(2))
    assert estimates(whole, changed, whole=True) == estimates(each, changed, whole=False)


def test_out_of_range_columns_of_a_gate_are_ignored(flight: tuple[World, list[GateMessages]]) -> None:
    world, gates = flight
    b, agent = gates[0], Estimator(world.info(), world.scenario, DRONES)
    for which, ends in (
        (np.full(len(b), 10**9), b.ends),
        (np.full(len(b), -5), b.ends),
        (b.which, b.ends + 10**9),
        (b.which, b.ends[::-1].copy()),
        (b.which, -b.ends),
    ):
        agent.receive_gate(GateMessages(b.t_ns, b.seq, b.table, which, b.stamps, ends, bytes(b.buffer)))
    assert len(agent.step(b.t_ns)) == len(DRONES)
