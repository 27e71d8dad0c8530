"""The joint filter of a cluster: without sightings as every drone by itself, with them whose hat was seen is found out."""

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
FIELD_B = np.array([17.8, 2.8, 14.0])  # of the scenario, seen by who looks north


def still(
    bank: EstimatorBank | ClusterBanks, gate: int, rng: np.random.Generator, baro_off_m: tuple[float, ...] = (0, 0, 0)
) -> None:
    """Hand over what drones sense that stand still in the air, looking north; by how much their barometers lie."""
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
    """Return what an observer sees of a hat at a place, without error."""
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
    """Return the estimates after so many gates; each observer sees a hat there in every third.

    From gate 700 on the barometer of drone 1 is off by `lies_m`.
    """
    rng = np.random.default_rng(3)
    estimates: list[StateEstimate] = []
    for gate in range(gates):
        still(bank, gate, rng, (lies_m if gate > 700 else 0.0, 0.0, 0.0))
        for observer, target in (seen or {}).items() if gate % 3 == 0 else ():
            bank.receive(observer, "sightings", sighted(observer, target, gate * GATE_NS), gate * GATE_S)
        estimates = bank.estimate(gate * GATE_S)
    return estimates


def test_without_sightings_every_drone_is_as_by_itself():
    alone, together = flown(bank_of(EstimatorBank), 300), flown(bank_of(), 300)
    for one, other in zip(alone, together, strict=True):
        assert np.array(other.position_m) == pytest.approx(np.array(one.position_m), abs=1e-9)
        assert np.array(other.covariance) == pytest.approx(np.array(one.covariance), abs=1e-9)


def test_with_sightings_the_drones_are_where_they_are_to_each_other():
    alone = flown(bank_of(), 1500)
    together = flown(bank_of(), 1500, {1: PLACES[0], 2: PLACES[0]})

    def miss(estimates: list[StateEstimate], i: int) -> float:
        apart = np.subtract(estimates[0].position_m, estimates[i].position_m)
        return float(np.linalg.norm(apart - (PLACES[0] - PLACES[i])))

    assert max(miss(together, 1), miss(together, 2)) < 0.05 < max(miss(alone, 1), miss(alone, 2))
    assert together[1].sensors["sightings"][0] > 300
    assert together[0].sensors["sightings"] == (0, 0)


@pytest.mark.parametrize(("seen", "height_off_m"), [({1: PLACES[0], 2: PLACES[0]}, 0.0), ({}, 5.0)])
def test_a_barometer_that_lies_is_not_trusted_while_others_whom_the_drone_sees_know_better(
    seen: dict[int, NDArray[np.float64]], height_off_m: float
):
    """A drone that nobody sees trusts its barometer again, when that has been refused for long."""
    estimates = flown(bank_of(), 1500, seen, lies_m=5.0)
    assert estimates[0].position_m[2] == pytest.approx(PLACES[0, 2] + height_off_m, abs=0.3)
    assert (estimates[0].sensors["baro"][1] > 300) == bool(seen)


@pytest.mark.parametrize("late_gates", [0, 2])
@pytest.mark.parametrize("slower_first", [False, True])
def test_what_two_detectors_find_in_one_picture_of_drone_2_counts_once(slower_first: bool, late_gates: int):
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


def test_a_camera_that_the_drone_does_not_have_moves_nobody():
    bank, calm = (bank_of() for _ in range(2))
    rngs = np.random.default_rng(3), np.random.default_rng(3)
    for gate in range(900):
        for each, rng in zip((bank, calm), rngs, strict=True):
            still(each, gate, rng)
        message = msgspec.structs.replace(sighted(1, PLACES[0], gate * GATE_NS), camera="side")
        bank.receive(1, "sightings", message, gate * GATE_S)
        assert bank.estimate(gate * GATE_S) == calm.estimate(gate * GATE_S)


def test_a_hat_where_nobody_is_or_that_might_be_of_two_moves_nobody():
    lying = flown(bank_of(), 900, {1: np.array([3.0, 9.0, 0.0])})
    alone = flown(bank_of(), 900)
    for one, other in zip(alone, lying, strict=True):
        assert np.array(other.position_m) == pytest.approx(np.array(one.position_m), abs=1e-12)
    used, refused = lying[1].sensors["sightings"]
    assert (used, refused) == (0, 300)
    early = flown(bank_of(), 4, {1: PLACES[0]})  # before GPS has told them apart, within a metre or two
    assert early[1].sensors["sightings"] == (0, 2)


def test_the_jacobian_is_that_of_what_is_expected():
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


def test_it_goes_on_from_a_snapshot_to_the_same_bits():
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
