"""Compile what flies, once on a machine, so that a run starts at once there: `python -m zsim_deploy.warm_up`.

Where numba is missing nothing is compiled, and there is nothing to do. `zsim push` runs this on a host.
"""

import importlib.util
import time

from zsim import scenario_file

FORMATIONS = """
name: warm-up
duration_s: 1
drones:
  - {name: drone1, position_m: [0, 0, 0]}
  - {name: drone2, position_m: [4, 0, 0]}
  - {name: drone3, position_m: [8, 0, 0]}
  - {name: drone4, position_m: [12, 0, 0]}
  - {name: drone5, position_m: [16, 0, 0]}
clusters:
  - {name: pair, drones: [drone1, drone2]}
  - {name: triad, drones: [drone3, drone4, drone5]}
"""
"""Each kind of cluster, since each has code of its own."""


def main() -> None:
    """Build the world and one of each agent, as far as they are installed, and let them compile."""
    if not (_has("numba") and _has("psutil")):
        return
    from zsim_world.world import World

    scenario = scenario_file.from_text(FORMATIONS)
    info = World(scenario, "lockstep", 0.0, time.monotonic_ns, None).info()
    if not _has("filterpy"):
        return
    from zsim_agents.controller import Controller
    from zsim_agents.estimator import Estimator

    Estimator(info, scenario, scenario.drones[0].name).rehearse()
    for cluster in scenario.clusters:
        Controller(info, scenario, cluster.name).rehearse()


def _has(module: str) -> bool:
    return importlib.util.find_spec(module) is not None


if __name__ == "__main__":
    main()
