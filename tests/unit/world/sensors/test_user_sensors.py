"""Users' sensors in the world: equations with lever arms, error statistics, faults, and no effect on other sensors."""

import importlib
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fleet_samples import samples_of

from zsim.contract.run_messages import Fault
from zsim.errors import RunError
from zsim.math.frames import quaternion_from_rpy, rotation_matrix
from zsim.scenario.scenario import Scenario
from zsim.scenario.scenario_file import resolve
from zsim.sensors.sensor import SensorTruth
from zsim_world.fleet.fleet import Fleet
from zsim_world.fleet.publication import GatePublication

EXAMPLES = Path(__file__).parents[4] / "examples"
MOUNT = {"position_m": [0.2, -0.1, 0.3], "rpy_deg": [10, 20, 90]}
UWB: dict[str, Any] = {"module": "uwb_range", "anchor_m": [3, 4, 0], "rate_hz": 50, "mount": MOUNT}
EXACT = UWB | {"range_m": {}}
GATE_S = 0.02


@pytest.fixture(autouse=True)
def examples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES))


def scenario(seed: int = 5, **sensors: Any) -> Scenario:
    drones = [{"name": f"d{i}", "position_m": [3.0 * i, 0, 0], "yaw_deg": 30} for i in range(2)]
    return resolve(
        {"name": "t", "duration_s": 60, "seed": seed, "drones": drones, "sensors": {"preset": "paper", **sensors}}
    )


def values(flying: Fleet, name: str, gates: int, drone: int = 0) -> np.ndarray:
    """Return the readings of a drone's sensor over some gates."""
    found = []
    for _ in range(gates):
        flying.advance()
        found += [sample.values for sample in samples_of(flying) if (sample.sensor, sample.drone) == (name, drone)]
    return np.array(found)


def truth(t_s: float = 0.0, **given: Any) -> SensorTruth:
    """Return the truth of a sensor that is mounted off centre and turned."""
    still = np.zeros(3)
    fields: dict[str, Any] = {
        "p_WB": still, "v_WB": still, "a_WB": still, "R_WB": np.eye(3), "w_WB_B": still, "alpha_B": still, "air_W": still,
        "p_BS": np.array(MOUNT["position_m"]), "R_BS": rotation_matrix(quaternion_from_rpy(np.radians(MOUNT["rpy_deg"]))),
    }  # fmt: skip
    return SensorTruth(t_s=t_s, **(fields | given))


def test_a_sensor_moves_as_its_mounting_point_does():
    """For rotation about a fixed axis, velocity and acceleration match finite differences of the point's position."""
    rate, speeding = 2.0, 1.5

    def at(t: float) -> SensorTruth:
        angle = rate * t + 0.5 * speeding * t * t
        R_WB = rotation_matrix(quaternion_from_rpy((0.3, 0.0, 0.0))) @ rotation_matrix(
            quaternion_from_rpy((0, 0, angle))
        )
        spin: dict[str, Any] = {"w_WB_B": np.array([0, 0, rate + speeding * t]), "alpha_B": np.array([0, 0, speeding])}
        return truth(R_WB=R_WB, p_WB=np.array([1.0, 2.0 * t, 0.0]), v_WB=np.array([0, 2.0, 0]), **spin)

    h = 1e-4
    before, now, after = at(0.4 - h), at(0.4), at(0.4 + h)
    np.testing.assert_allclose(now.v_WS, (after.p_WS - before.p_WS) / (2 * h), atol=1e-6)
    np.testing.assert_allclose(now.a_WS, (after.v_WS - before.v_WS) / (2 * h), atol=1e-6)
    np.testing.assert_allclose(now.R_WS.T @ now.R_WS, np.eye(3), atol=1e-12)


def test_the_range_of_a_standing_drone_is_measured_from_its_antenna():
    flying = Fleet(scenario(my_uwb=EXACT))
    shown = values(flying, "my_uwb", 5)
    state = flying.truth()
    antenna = state.position_m[0] + rotation_matrix(state.orientation_wxyz[0]) @ MOUNT["position_m"]
    assert shown[-1, 0] == pytest.approx(np.linalg.norm(antenna - (3, 4, 0)), abs=1e-4)


def test_airspeed_is_measured_along_the_pitot_tube():
    airspeed = importlib.import_module("airspeed")  # importable thanks to the fixture
    site = scenario().environment
    wind, spin = np.array([4.0, -3.0, 0.5]), np.array([0.0, 0.0, 2.0])
    mounted = truth(v_WB=np.array([1.0, 0, 0]), w_WB_B=spin, air_W=wind)
    x_axis = mounted.R_BS[:, 0]
    lever = np.cross(spin, mounted.p_BS)
    u = float(x_axis @ (np.array([1.0, 0, 0]) + lever - wind))
    (pascals,) = airspeed.pressure(mounted, None, site)
    assert pascals == pytest.approx(0.5 * site.air_density_kg_m3 * u * abs(u))
    assert airspeed.speed([pascals], None, site) == [pascals, pytest.approx(u)]


def test_errors_have_the_configured_statistics():
    errors = {"noise": 0.3, "density": 0.02, "quantum": 0.01}
    noisy = values(Fleet(scenario(my_uwb=UWB | {"range_m": errors})), "my_uwb", 1500)[:, 0]
    exact = values(Fleet(scenario(my_uwb=EXACT)), "my_uwb", 1500)[:, 0]
    off = noisy - exact
    sigma = math.hypot(0.3, 0.02 * math.sqrt(50), 0.01 / math.sqrt(12))
    assert abs(off.mean()) < 4 * sigma / math.sqrt(len(off))
    assert off.std() == pytest.approx(sigma, rel=0.1)
    np.testing.assert_allclose(noisy / 0.01, np.round(noisy / 0.01), atol=1e-6)
    assert np.abs(np.corrcoef(off[1:], off[:-1])[0, 1]) < 0.1


def test_biases_differ_between_drones_and_seeds():
    def bias(seed: int, drone: int) -> float:
        biased = UWB | {"range_m": {"bias": 1.0}}
        shown = [values(Fleet(scenario(seed, my_uwb=each)), "my_uwb", 2, drone)[-1, 0] for each in (biased, EXACT)]
        return shown[0] - shown[1]

    made = [bias(seed, drone) for seed in (1, 2) for drone in (0, 1)]
    assert len({round(each, 9) for each in made}) == 4
    assert bias(1, 0) == made[0]


def test_samples_are_lost_at_the_dropout_probability():
    kept = len(values(Fleet(scenario(my_uwb=UWB | {"dropout": 0.3})), "my_uwb", 1000))
    assert kept == pytest.approx(700, abs=4 * math.sqrt(1000 * 0.3 * 0.7))


def fault(kind: str, **parameters: Any) -> Fault:
    return Fault(1, f"my_uwb_{kind}", "d0", parameters, 0)


def test_faults_affect_only_their_target_drone():
    exact = values(Fleet(scenario(my_uwb=EXACT)), "my_uwb", 30)[:, 0]
    biased = Fleet(scenario(my_uwb=EXACT))
    biased.impairment.strike([fault("bias", value_m=2.0)])
    np.testing.assert_allclose(values(biased, "my_uwb", 30)[:, 0], exact + 2.0)
    lost = Fleet(scenario(my_uwb=EXACT))
    lost.impairment.strike([fault("dropout", probability=1.0)])
    assert not len(values(lost, "my_uwb", 30))
    assert len(values(lost, "my_uwb", 30, drone=1)) == 30


def test_a_stuck_sensor_repeats_one_sample_until_the_fault_ends():
    flying = Fleet(scenario(my_uwb=UWB))
    flying.impairment.strike([fault("stuck")])
    assert len(set(values(flying, "my_uwb", 20)[:, 0])) == 1
    flying.impairment.strike([])
    assert len(set(values(flying, "my_uwb", 20)[:, 0])) == 20


def test_noise_grows_by_the_factor():
    sound, noisy = (Fleet(scenario(my_uwb=UWB | {"range_m": {"noise": 0.1}})) for _ in range(2))
    noisy.impairment.strike([fault("noise", factor=3.0)])
    exact = values(Fleet(scenario(my_uwb=EXACT)), "my_uwb", 50)
    np.testing.assert_allclose(
        values(noisy, "my_uwb", 50) - exact, 3 * (values(sound, "my_uwb", 50) - exact), atol=1e-9
    )


def test_a_user_sensor_changes_no_other_sample():
    without, with_it = Fleet(scenario()), Fleet(scenario(my_uwb=UWB, pitot={"module": "airspeed"}))
    for _ in range(20):
        without.advance()
        with_it.advance()
        stock = [sample for sample in samples_of(with_it) if sample.sensor not in ("my_uwb", "pitot")]
        assert stock == samples_of(without)


def test_messages_are_published_in_order_and_none_is_lost():
    flying = Fleet(scenario(my_uwb=UWB | {"latency_ms": 30}, pitot={"module": "airspeed"}))
    publication = GatePublication(flying)
    scenario_info = {"my_uwb": 0, "pitot": 0}
    for _ in range(10):
        gate = publication.gate([None, None])
        for drone in ("d0", "d1"):
            own = [
                (key, t) for (key, _), t in zip(gate.pairs, gate.stamps.tolist(), strict=True) if f"/{drone}/" in key
            ]
            names = [key.rpartition("/")[2] for key, _ in own]
            assert names[-2:] == ["truth", "status"]
            times = [(t, publication.table.index(key)) for key, t in own[:-2]]
            assert times == sorted(times)
            for name in scenario_info:
                scenario_info[name] += names.count(name)
        flying.advance()
    assert scenario_info == {"my_uwb": 2 * 8, "pitot": 2 * 10}


def test_an_invalid_reading_ends_the_run_with_a_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    text = (EXAMPLES / "uwb_range.py").read_text()
    for name, equation in {"fails": "1 / 0", "long": "[1.0, 2.0]", "infinite": "[np.inf]"}.items():
        line = "return [float(np.linalg.norm(truth.p_WS - settings.anchor_m))]"
        (tmp_path / f"{name}.py").write_text(text.replace(line, f"return {equation}"))
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("fails", "long", "infinite"):
        with pytest.raises(RunError, match=r"d0: sensors\.my_uwb at 0\.000 s"):
            Fleet(scenario(my_uwb={"module": name}))
