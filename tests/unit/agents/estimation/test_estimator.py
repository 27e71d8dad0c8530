"""The estimator as an agent: external drones are estimated only while their driver reports; numba is optional."""

import json
import subprocess
import sys
from pathlib import Path

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


def test_an_external_drone_is_estimated_only_if_its_driver_reports(estimator: Estimator):
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
    estimator.deliver(100 * GATE_NS, brought("d0", 100) + brought("d1", 100)[:-1])  # without d1's status
    assert [key for key, _ in estimator.step(100 * GATE_NS)] == [keys.estimate("d0")]
    np.testing.assert_allclose(last.position_m, (4.0, 0.0, 0.0), atol=0.3)


# Without numba

FLIGHT = """
import json, sys
if "without" in sys.argv:
    sys.modules["numba"] = None
import numpy as np
from zsim.contract import messages
from zsim.scenario import scenario_file
from zsim.contract.messages import Baro, Flow, Gps, Imu, Mag, Sonar
from zsim.math.compiled import COMPILES
from zsim_agents.estimation.estimator import Estimator

scenario = scenario_file.load(sys.argv[1])
env = scenario.environment
info = messages.Info(0, 0, 1, "r", "zsim", "lockstep", 0.0, 20_000_000, 2_500_000, 20_000_000, 1,
                     messages.Origin(0.0, 0.0, 0.0), (), (), "", "", "", "")
agent, chance, said = Estimator(info, scenario, "drone1"), np.random.default_rng(5), []
at = "drone/drone1/sensor/"
for gate in range(1, 151):
    t_ns = gate * 20_000_000
    noise = chance.normal(size=20).tolist()
    for k in range(4):
        at_ns = t_ns - (3 - k) * 5_000_000
        accel = (0.3 * noise[0], 0.3 * noise[1], env.gravity_m_s2 + 0.3 * noise[2])
        agent.receive(at + "imu", Imu(at_ns, 4 * gate + k, at_ns, accel, (0.01 * noise[3], 0.01 * noise[4], 0.01 * noise[5])))
    agent.receive(at + "mag", Mag(t_ns, gate, t_ns, tuple(env.magnetic_field_ut)))
    agent.receive(at + "baro", Baro(t_ns, gate, t_ns, 101325.0, 0.1 * noise[6]))
    agent.receive(at + "sonar", Sonar(t_ns, gate, t_ns, 0.3 + 0.01 * noise[7], True))
    agent.receive(at + "flow", Flow(t_ns, gate, t_ns, (0.1 * noise[8], 0.1 * noise[9], 0.0), 1.0))
    if gate % 10 == 0:
        p, v = tuple(noise[10:13]), tuple(0.1 * n for n in noise[13:16])
        agent.receive(at + "gps", Gps(t_ns, gate // 10, t_ns, 0.0, 0.0, 0.0, p, v, 1.0, 3, 9))
    for output in agent.step(t_ns):
        message = messages.decode(output.key, messages.encode(output.message))
        said.append([*message.position_m, *message.velocity_m_s, *message.orientation_wxyz, *message.covariance])
print(json.dumps({"compiles": COMPILES, "said": said}))
"""
STEP = Path(__file__).parents[4] / "scenarios" / "step.yaml"


def fly(*how: str) -> tuple[bool, np.ndarray]:
    command = [sys.executable, "-c", FLIGHT, str(STEP), *how]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    return found["compiles"], np.array(found["said"])


def test_the_estimator_works_without_numba():
    compiles, wanted = fly()
    plain, found = fly("without")
    assert (compiles, plain) == (True, False)
    assert found.shape == (150, 46)
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9)
