"""An estimator of external drones: it publishes of each only what its driver has brought, and goes on afterwards."""

import msgspec
import numpy as np
import pytest

from zsim.contract import keys
from zsim.contract.flight_messages import Estimate, Status
from zsim.contract.messages import Baro, DroneInfo, Gps, Imu, Info, Mag, Origin
from zsim.runtime.inbox import Input
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim_agents.estimation.estimator import Estimator

GATE_NS = 20_000_000
UP = (0.0, 0.0, 9.80665)
ZEROS = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    drones = [
        {"name": f"d{i}", "position_m": [4.0 * i, 0, 0], "body": body, "sensors": {"imu": {"rate_hz": 50}}}
        for i, body in enumerate(("simulated", "external"))
    ]
    return scenario_file.resolve({"name": "t", "duration_s": 1, "drones": drones, "sensors": {"preset": "paper"}})


@pytest.fixture
def estimator(scenario: Scenario) -> Estimator:
    text = scenario_file.to_text(scenario)
    drones = (DroneInfo("d0", "ardrone2"), DroneInfo("d1", "ardrone2", body="external"))
    info = Info(
        0, 0, 1, "r", "zsim", "realtime", 1.0, GATE_NS, 2_500_000, GATE_NS, 1, Origin(0.0, 0.0, 0.0), drones, (),
        text, scenario_file.sha256(text), "0", "f",
    )  # fmt: skip
    return Estimator(info, scenario, ["d0", "d1"])


def brought(drone: str, gate: int) -> list[Input]:
    t_ns, x = gate * GATE_NS, 0.0 if drone == "d0" else 4.0
    sensors: dict[str, msgspec.Struct] = {
        "baro": Baro(t_ns, gate, t_ns, 101_325.0, 0.0),
        "gps": Gps(t_ns, gate, t_ns, 0.0, 0.0, 0.0, (x, 0.0, 0.0), ZEROS, 0.1, 3, 9),
        "imu": Imu(t_ns, gate, t_ns, UP, ZEROS),
        "mag": Mag(t_ns, gate, t_ns, (0.0, 20.0, 0.0)),
        "status": Status(t_ns, gate, "flying", 90.0, False, None, 5),
    }
    return [(keys.sensor(drone, name), message) for name, message in sensors.items()]


def step(estimator: Estimator, gate: int, *drones: str) -> dict[str, Estimate]:
    estimator.deliver(gate * GATE_NS, [each for drone in drones for each in brought(drone, gate)])
    return {keys.thing(key): estimate for key, estimate in estimator.step(gate * GATE_NS)}  # type: ignore[misc]


def test_it_estimates_one_only_where_its_driver_has_brought_a_status(estimator: Estimator):
    estimates: dict[str, Estimate] = {}
    for gate in range(100):
        coming = ("d0", "d1") if gate < 30 or gate > 60 else ("d0",)
        estimates = step(estimator, gate, *coming)
        assert tuple(estimates) == coming
        assert {drone: each.seq for drone, each in estimates.items()}["d0"] == gate
        (shown,) = [message for _, message in estimator.views(gate * GATE_NS)]
        assert tuple(each.name for each in shown.estimates) == coming  # type: ignore[attr-defined]
    last = estimates["d1"]
    assert last.seq == 68  # counted without gaps
    np.testing.assert_allclose(last.position_m, (4.0, 0.0, 0.0), atol=0.3)


def test_a_sensor_without_a_status_is_no_estimate(estimator: Estimator):
    step(estimator, 0, "d0", "d1")
    estimator.deliver(GATE_NS, brought("d0", 1) + brought("d1", 1)[:-1])
    assert [key for key, _ in estimator.step(GATE_NS)] == [keys.estimate("d0")]
