"""Agents on a computer that has no numba: the same flight within 1e-9, and every message a message."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np

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


def test_the_estimator_needs_no_numba():
    compiles, wanted = fly()
    plain, found = fly("without")
    assert (compiles, plain) == (True, False)
    assert found.shape == (150, 46)
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9)
