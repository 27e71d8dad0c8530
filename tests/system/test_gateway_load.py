"""Two hundred clients of a gateway of a realtime run: each receives its values, however slowly."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from federation import Federation
from gateway_process import GatewayProcess

TRIO = """
name: trio
seed: 3
duration_s: 36000
drones:
  - {name: drone1, position_m: [2, 0, 0]}
  - {name: drone2, position_m: [-2, 0, 0]}
  - {name: drone3, position_m: [0, 3, 0]}
clusters:
  - {name: main, drones: [drone1, drone2, drone3], plan: {takeoff_s: 0.5}}
"""
LOAD = Path(__file__).with_name("gateway_load.py")
CLIENTS = 200
HANGS_S = 1800.0  # wall time after which the clients count as hung


def fly_with_clients(federation: Federation, clients: int, values: int) -> dict[str, Any]:
    """Fly in realtime while `clients` receive `values` each; return their figures and the deadline misses."""
    run = federation.run(TRIO, "--realtime", "--hosted")
    gateway = GatewayProcess(federation).in_run()
    client = federation.client()
    client.subscribe("clock").until(lambda clock: clock["t_ns"] >= 1e9)
    numbers = map(str, (gateway.http_port, gateway.lines_port, clients, values))
    command = ["nice", "-n", "10", sys.executable, str(LOAD), *numbers]
    done = subprocess.run(command, capture_output=True, text=True, timeout=HANGS_S)
    assert done.returncode == 0, done.stderr[-3000:]
    assert client.request("world/control", "stop")["ok"]
    run.ends(with_code=0)
    return json.loads(done.stdout) | {"deadline_misses": federation.record().end()["deadline_misses_by"]}


@pytest.mark.soak
@pytest.mark.parametrize("values", [10, 600])
def test_all_clients_get_their_values(federation: Federation, values: int) -> None:
    print(json.dumps(fly_with_clients(federation, CLIENTS, values)))
