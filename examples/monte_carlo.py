"""Flies a scenario in this process with many seeds, and compares two estimators of drone1 against the truth.

    python examples/monte_carlo.py scenarios/step.yaml --seeds 3 --duration 60

A run per seed and estimator: no Zenoh, no files. The other agents are those of `zsim run`.
"""

import argparse
import math
import time
from pathlib import Path

from msgspec import Struct
from msgspec.structs import replace

from zsim.contract import flight_messages, keys
from zsim.runtime.bus import Bus
from zsim.scenario import scenario_file
from zsim.scenario.scenario import ESTIMATORS, Scenario
from zsim_agents.estimation.estimator import Estimator
from zsim_agents.formation.controller import Controller
from zsim_world.run.world import World

DRONE, SETTLED_S = "drone1", 10.0  # errors before are those of the first fixes
MINE = "my_estimator:MyEstimator"  # beside this file


class Errors:
    """Takes every message of a run; keeps the horizontal error of one drone's estimate at every gate."""

    def __init__(self) -> None:
        self._truth: dict[int, flight_messages.Truth] = {}
        self.squares: list[float] = []

    def __call__(self, key: str, message: Struct) -> None:
        if isinstance(message, flight_messages.Truth) and key == keys.truth(DRONE):
            self._truth[message.t_ns] = message
        elif isinstance(message, flight_messages.Estimate) and key == keys.estimate(DRONE):
            truth = self._truth.pop(message.t_ns)
            if message.t_ns > SETTLED_S * 1e9:
                self.squares.append(math.dist(message.position_m[:2], truth.position_m[:2]) ** 2)

    def rms_m(self) -> float:
        return math.sqrt(sum(self.squares) / len(self.squares))


def fly(scenario: Scenario, algorithm: str) -> float:
    """Fly a scenario with an estimator for DRONE of the given kind; return the RMS of its position [m]."""
    world, errors = World(scenario), Errors()
    info = world.info()
    others = [drone.name for drone in scenario.drones if drone.name != DRONE]
    chosen = replace(scenario, estimation=replace(scenario.estimation, algorithm=algorithm))
    agents = [Estimator(info, chosen, DRONE), *(Estimator(info, scenario, drone) for drone in others)]
    agents += [Controller(info, scenario, cluster.name) for cluster in scenario.clusters]
    bus = Bus(world, agents, time.monotonic_ns, errors)
    bus.join()
    while bus.turn():
        pass
    bus.end()
    return errors.rms_m()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scenario", type=Path)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--duration", type=float, default=60.0)
    args = parser.parse_args()
    for seed in range(1, args.seeds + 1):
        # nobody is waited for by name: every agent has joined before the first gate
        scenario = scenario_file.load(args.scenario, ["processes.expect=[]"], seed=seed, duration_s=args.duration)
        stock, mine = fly(scenario, ESTIMATORS[0]), fly(scenario, MINE)
        print(f"seed {seed}: RMS of the horizontal position, stock {stock:.3f} m, mine {mine:.3f} m")


if __name__ == "__main__":
    main()
