"""CPU time of lidars: ten drones in a forest, each with 16 x 360 rays at 10 Hz, compared with a flight without lidars.

.venv/bin/python -m benchmarks.lidar
"""

import argparse
import statistics
import time
from typing import Any

from zsim.scenario.scenario_file import resolve
from zsim_world.fleet.fleet import Fleet
from zsim_world.fleet.publication import GatePublication

DRONES, CHANNELS, COLUMNS, RATE_HZ = 10, 16, 360, 10.0
FOREST = {"trees": 200, "area_m": [-25, -25, 25, 25], "gap_m": 1.0, "clear_m": 1.5}
LIDAR = {"rate_hz": RATE_HZ, "channels": CHANNELS, "columns": COLUMNS, "elevation_deg": [-15, 15], "max_m": 40}
WARM_UP, GATES, GATE_S = 100, 500, 0.02  # all drones are in the air after WARM_UP gates


def share(lidar: bool) -> float:
    """Return the CPU seconds per simulated second of the fleet and its messages, in one thread."""
    document: dict[str, Any] = {
        "name": "lidars",
        "duration_s": 60,
        "environment": {"forest": FOREST},
        "sensors": {"preset": "ardrone2", **({"lidar": LIDAR} if lidar else {})},
        "drones": [{"name": f"drone{i}", "position_m": [2 * i - DRONES, 0, 0]} for i in range(DRONES)],
    }
    fleet = Fleet(resolve(document))
    publication, commanders = GatePublication(fleet), [None] * DRONES
    for i in range(DRONES):
        fleet.takeoff(i)
    for _ in range(WARM_UP):
        fleet.advance()
        publication.gate([*commanders])
    began = time.process_time()
    for _ in range(GATES):
        fleet.advance()
        publication.gate([*commanders])
    return (time.process_time() - began) / (GATES * GATE_S)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    repeats = parser.parse_args().repeats
    pairs = [(share(False), share(True)) for _ in range(repeats)]
    costs = sorted(with_it - without for without, with_it in pairs)
    rays = DRONES * CHANNELS * COLUMNS * RATE_HZ
    cost = statistics.median(costs)
    print(f"without lidars {statistics.median(each for each, _ in pairs):.4f} of a core")
    print(f"lidars {cost:.4f} ({costs[0]:.4f} to {costs[-1]:.4f}) of a core, {cost / rays * 1e9:.0f} ns a ray")


if __name__ == "__main__":
    main()
