"""Two hundred clients of a gateway, while the world flies in realtime."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from door import Door
from federation import Federation

TRIO = """
name: trio
seed: 3
duration_s: {duration_s}
drones:
  - {{name: drone1, position_m: [2, 0, 0]}}
  - {{name: drone2, position_m: [-2, 0, 0]}}
  - {{name: drone3, position_m: [0, 3, 0]}}
clusters:
  - {{name: main, drones: [drone1, drone2, drone3], plan: {{takeoff_s: 0.5}}}}
"""
CLIENTS = 200
LEAST = 10  # values that each of a crowd has in five seconds, a fiftieth of what is said
MISSES_MORE = 0.01  # of all gates: two runs of the same differ by so much on a machine of two cores
GRACE = 1.5  # clients start while the first already count


def crowded(federation: Federation, seconds: float, clients: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Fly in realtime with so many clients; return what the world says at the end, and what they got."""
    scenario = TRIO.format(duration_s=seconds + 15)
    run = federation.run(scenario, "--realtime", "--hosted")
    door = Door(federation).in_run()
    federation.client().watch("clock").until(lambda clock: clock["t_ns"] >= 1e9)
    got: dict[str, Any] = {}
    if clients:
        command = ["nice", "-n", "10", sys.executable, str(Path(__file__).with_name("crowd.py"))]
        numbers = [door.http_port, door.lines_port, clients, seconds]
        done = subprocess.run([*command, *map(str, numbers)], capture_output=True, text=True, timeout=seconds + 120)
        assert done.returncode == 0, done.stderr[-3000:]
        got = json.loads(done.stdout)
    run.ends(with_code=0, within_s=seconds + 120)
    return federation.record().end(), got


@pytest.mark.soak
@pytest.mark.slow
def test_all_of_a_crowd_are_served(federation):
    _, got = crowded(federation, 5.0, CLIENTS)
    assert got["least"] >= LEAST


@pytest.mark.soak
def test_a_crowd_makes_no_gate_late(tmp_path):
    ends, got = [], {}
    for clients in (0, CLIENTS):
        folder = tmp_path / str(clients)
        folder.mkdir()
        with Federation(folder) as federation:
            end, got = crowded(federation, 60.0, clients)
            ends.append(end)
    print(json.dumps({"without": ends[0]["deadline_misses_by"], "with": ends[1]["deadline_misses_by"], **got}))
    assert got["streams"] >= 60 * 50 * (CLIENTS // 3) / GRACE
    assert got["sockets"] >= 60 * 50 * (CLIENTS // 3) / GRACE
    gates = 75 * 50 * len(ends[1]["deadline_misses_by"])
    assert ends[1]["deadline_misses"] - ends[0]["deadline_misses"] <= MISSES_MORE * gates
