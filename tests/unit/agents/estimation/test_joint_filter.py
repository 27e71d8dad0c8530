"""The joint filter of a cluster: independence of the drones without sightings, and association of sighted hats."""

import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from zsim.contract.flight_messages import Seen, Sightings
from zsim.contract.messages import Baro, Flow, Gps, Imu, Mag
from zsim.math.rotation import matrix, multiply, normalised
from zsim.scenario import scenario_file
from zsim_agents.estimation.drone_estimator import StateEstimate
from zsim_agents.estimation.estimator_bank import EstimatorBank
from zsim_agents.estimation.filter_state import Moment
from zsim_agents.estimation.joint_filter import ClusterBanks, JointBank, across, expected, write_rows

EYES = scenario_file.load(Path(__file__).parents[4] / "scenarios" / "eyes.yaml")
GATE_S, GATE_NS = 0.02, 20_000_000
PLACES = np.array([(0.0, 4.0, 5.0), (-1.5, 0.0, 5.0), (1.5, 0.0, 5.0)])  # drone 1 is north of drones 2 and 3
NORTH = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
CAMERA_B, HAT_B = np.array([0.162, 0.0, 0.012]), np.array([-0.03, 0.0, 0.11])
FIELD_B = np.array([17.8, 2.8, 14.0])  # uT, field of the scenario in the frame of a drone that faces north


def still(
    bank: EstimatorBank | ClusterBanks, gate: int, rng: np.random.Generator, baro_off_m: tuple[float, ...] = (0, 0, 0)
) -> None:
    """Deliver the readings of drones that hover facing north, whose barometers are off by `baro_off_m`."""
    t_ns = gate * GATE_NS
    for i, place in enumerate(PLACES):
        for k in (3, 2, 1, 0) if gate else ():
            at = t_ns - k * 5_000_000
            bank.receive(i, "imu", Imu(at, 0, at, (0.0, 0.0, 9.80665), (0.0, 0.0, 0.0)), at * 1e-9)
        if gate % 10 == 0:
            x, y, z = (place + rng.normal(0, 2.0, 3)).tolist()
            bank.receive(i, "gps", Gps(t_ns, 0, t_ns, 0, 0, 0, (x, y, z), (0.0, 0.0, 0.0), 2.0, 3, 9), t_ns * 1e-9)
        if gate % 2 == 0:
            bank.receive(i, "mag", Mag(t_ns, 0, t_ns, tuple(FIELD_B.tolist())), t_ns * 1e-9)
            height_m = float(place[2] + baro_off_m[i] + rng.normal(0, 0.1))
            bank.receive(i, "baro", Baro(t_ns, 0, t_ns, 101_000.0, height_m), t_ns * 1e-9)
        if gate % 3 == 0:
            bank.receive(i, "flow", Flow(t_ns, 0, t_ns, tuple(rng.normal(0, 0.1, 3).tolist()), 1.0), t_ns * 1e-9)


def sighted(observer: int, target: NDArray[np.float64], t_ns: int, source: str = "") -> Sightings:
    """Return the error-free sighting by an observer of the hat of a drone at a place."""
    R = np.array(matrix(NORTH))
    to_B = R.T @ (target + R @ HAT_B - PLACES[observer]) - CAMERA_B
    away = float(np.linalg.norm(to_B))
    seen = Seen(tuple((to_B / away).tolist()), away, 1e-3, 0.05)
    return Sightings(t_ns=t_ns, seq=0, t_sample_ns=t_ns, source=source, camera="front", seen=(seen,))


def bank_of(kind: type[EstimatorBank] = JointBank) -> EstimatorBank:
    return kind(EYES.drones, EYES.environment, EYES.estimation, GATE_S)


def flown(
    bank: EstimatorBank, gates: int, seen: dict[int, NDArray[np.float64]] | None = None, lies_m: float = 0.0
) -> list[StateEstimate]:
    """Return the estimates after some gates, in every third of which each observer sees a hat at its place in `seen`.

    After gate 700, the barometer of drone 1 is off by `lies_m`.
    """
    rng = np.random.default_rng(3)
    estimates: list[StateEstimate] = []
    for gate in range(gates):
        still(bank, gate, rng, (lies_m if gate > 700 else 0.0, 0.0, 0.0))
        for observer, target in (seen or {}).items() if gate % 3 == 0 else ():
            bank.receive(observer, "sightings", sighted(observer, target, gate * GATE_NS), gate * GATE_S)
        estimates = bank.estimate(gate * GATE_S)
    return estimates


def test_drones_are_estimated_independently_without_sightings():
    alone, together = flown(bank_of(EstimatorBank), 300), flown(bank_of(), 300)
    for one, other in zip(alone, together, strict=True):
        assert np.array(other.position_m) == pytest.approx(np.array(one.position_m), abs=1e-9)
        assert np.array(other.covariance) == pytest.approx(np.array(one.covariance), abs=1e-9)


def test_sightings_improve_relative_positions():
    alone = flown(bank_of(), 1500)
    together = flown(bank_of(), 1500, {1: PLACES[0], 2: PLACES[0]})

    def miss(estimates: list[StateEstimate], i: int) -> float:
        apart = np.subtract(estimates[0].position_m, estimates[i].position_m)
        return float(np.linalg.norm(apart - (PLACES[0] - PLACES[i])))

    assert max(miss(together, 1), miss(together, 2)) < 0.05 < max(miss(alone, 1), miss(alone, 2))
    assert together[1].sensors["sightings"][0] > 300
    assert together[0].sensors["sightings"] == (0, 0)


@pytest.mark.parametrize(("seen", "height_off_m"), [({1: PLACES[0], 2: PLACES[0]}, 0.0), ({}, 5.0)])
def test_a_wrong_barometer_is_refused_while_sightings_contradict_it(
    seen: dict[int, NDArray[np.float64]], height_off_m: float
):
    """An unseen drone accepts its barometer again after refusing it for a long time."""
    estimates = flown(bank_of(), 1500, seen, lies_m=5.0)
    assert estimates[0].position_m[2] == pytest.approx(PLACES[0, 2] + height_off_m, abs=0.3)
    assert (estimates[0].sensors["baro"][1] > 300) == bool(seen)


@pytest.mark.parametrize("late_gates", [0, 2])
@pytest.mark.parametrize("slower_first", [False, True])
def test_sightings_by_two_detectors_in_one_picture_count_once(slower_first: bool, late_gates: int):
    bank, rng, estimates = bank_of(), np.random.default_rng(3), []
    for gate in range(900):
        still(bank, gate, rng)
        told = [("detector.a", gate), ("detector.b", gate - late_gates)]
        for source, of_gate in reversed(told) if slower_first else told:
            if of_gate >= 0 and of_gate % 3 == 0:
                bank.receive(1, "sightings", sighted(1, PLACES[0], of_gate * GATE_NS, source), gate * GATE_S)
        estimates = bank.estimate(gate * GATE_S)
    assert estimates == flown(bank_of(), 900, {1: PLACES[0]})
    assert estimates[1].sensors["sightings"][0] > 100


def test_a_hat_counts_once_in_each_of_two_simultaneous_pictures():
    """The observer's two cameras are at the same place, and each picture contains the hat twice."""
    mount = EYES.drones[1].sensors.cameras()["front"].mount
    bottom = msgspec.structs.replace(EYES.drones[1].sensors.cameras()["bottom"], mount=mount)
    sensors = msgspec.structs.replace(EYES.drones[1].sensors, bottom_camera=bottom)
    drones = [EYES.drones[0], msgspec.structs.replace(EYES.drones[1], sensors=sensors), EYES.drones[2]]
    bank, rng = JointBank(drones, EYES.environment, EYES.estimation, GATE_S), np.random.default_rng(3)
    used = []
    for gate in range(300):
        still(bank, gate, rng)
        message = sighted(1, PLACES[0], gate * GATE_NS)
        for camera in ("front", "bottom"):
            twice = msgspec.structs.replace(message, camera=camera, seen=message.seen * 2)
            bank.receive(1, "sightings", twice, gate * GATE_S)
        used.append(bank.estimate(gate * GATE_S)[1].sensors["sightings"][0])
    assert set(np.diff(used).tolist()) == {0, 2}  # none while the hat could be another drone's


def test_sightings_of_an_unknown_camera_have_no_effect():
    bank, calm = (bank_of() for _ in range(2))
    rngs = np.random.default_rng(3), np.random.default_rng(3)
    for gate in range(900):
        for each, rng in zip((bank, calm), rngs, strict=True):
            still(each, gate, rng)
        message = msgspec.structs.replace(sighted(1, PLACES[0], gate * GATE_NS), camera="side")
        bank.receive(1, "sightings", message, gate * GATE_S)
        assert bank.estimate(gate * GATE_S) == calm.estimate(gate * GATE_S)


def test_sightings_of_no_drone_or_ambiguous_ones_have_no_effect():
    lying = flown(bank_of(), 900, {1: np.array([3.0, 9.0, 0.0])})
    alone = flown(bank_of(), 900)
    for one, other in zip(alone, lying, strict=True):
        assert np.array(other.position_m) == pytest.approx(np.array(one.position_m), abs=1e-12)
    used, refused = lying[1].sensors["sightings"]
    assert (used, refused) == (0, 300)
    early = flown(bank_of(), 4, {1: PLACES[0]})  # before GPS has resolved their positions to a metre or two
    assert early[1].sensors["sightings"] == (0, 2)


def test_the_jacobian_is_the_derivative_of_the_prediction():
    zero = (0.0, 0.0, 0.0)
    a: Moment = (0.0, (1.0, 2.0, 3.0), zero, normalised((0.9, 0.1, -0.2, 0.3)), zero, zero, zero)
    b: Moment = (0.0, (4.0, -1.0, 3.5), zero, normalised((0.8, -0.1, 0.2, 0.5)), zero, zero, zero)
    hat, eye, n, step = (0.1, -0.2, 0.3), (0.2, 0.1, 0.05), 9, 1e-6
    axes = across((0.6, 0.0, 0.8))
    H = np.zeros((3, 2 * n))
    write_rows(H[:, :n], H[:, n:], a, b, hat, axes, (0.0, 0.0))

    def turned(q: tuple[float, ...], k: int) -> tuple[float, float, float, float]:
        half = [0.0, 0.0, 0.0]
        half[k] = step / 2
        return normalised(multiply((1.0, *half), q))  # type: ignore[arg-type]

    def moved(m: Moment, state: int) -> Moment:
        p = list(m[1])
        if state < 3:
            p[state] += step
            return (m[0], (p[0], p[1], p[2]), *m[2:])
        return (*m[:3], turned(m[3], state - 6), *m[4:])

    at = np.array(expected(a, b, hat, eye))
    for drone in (0, 1):
        for state in (0, 1, 2, 6, 7, 8):
            pair = (moved(a, state), b) if drone == 0 else (a, moved(b, state))
            slope = (np.array(expected(*pair, hat, eye)) - at) / step
            assert H[:, drone * n + state] == pytest.approx(np.array(axes) @ slope, abs=1e-5)


def test_a_restored_filter_continues_bit_for_bit():
    def banks() -> ClusterBanks:
        return ClusterBanks(EYES, ["drone2"], GATE_S)

    first, second, rng = banks(), banks(), np.random.default_rng(1)
    assert first.drones == ["drone1", "drone2", "drone3"]
    for gate in range(200):
        still(first, gate, rng)
        first.estimate(gate * GATE_S)
    second.restore(first.snapshot())
    for gate in range(200, 220):
        rngs = np.random.default_rng(gate), np.random.default_rng(gate)
        for bank, own in zip((first, second), rngs, strict=True):
            still(bank, gate, own)
            for source in ("detector.b", "detector.a")[: 1 + gate % 2]:
                bank.receive(1, "sightings", sighted(1, PLACES[0], gate // 2 * 2 * GATE_NS, source), gate * GATE_S)
        (one,), (other,) = first.estimate(gate * GATE_S), second.estimate(gate * GATE_S)
        assert one == other
