"""Compiles the kernels of a run in advance, so that runs on this machine start without delay.

    python -m zsim_deploy.roles.warm_up EXTRA...

compiles the kernels of the roles that need these extras, and prints the name of each compiled function; `zsim push`
runs it on hosts. Without numba there is nothing to compile.
"""

import importlib.util
import math
import sys
import time
from collections.abc import Collection
from typing import Any

import numpy as np

from zsim import CONTRACT, __version__
from zsim.contract.messages import ClusterInfo, DroneInfo, Info, Origin
from zsim.errors import printable
from zsim.math import elementary as el
from zsim.math import linear
from zsim.math.randomness import normal_quantile
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario

SIZES = {"pair": 2, "triad": 3, "template": 5}  # number of drones, by kind of cluster; each kind has its own kernels
# Scenario for the world, whose kernels are the same for any number of drones.
ALONE = {"name": "warm-up", "duration_s": 1, "drones": [{"name": "alone", "position_m": [0, 0, 0]}]}
NESTED = ("groups", 2, 3)  # a cluster of groups: its name, number of groups, drones per group
WITH_WORLD = {"world", "sweep", "all", "dev"}  # extras that include the world; pyproject.toml
WITH_AGENTS = WITH_WORLD | {"agents"}
WITH_CAMERAS = {"cameras"}
RADIUS_M = 4.0  # radius of the circle of each formation, so that none is collinear; any value well above 0 would do


def main(extras: Collection[str]) -> None:
    """Compile the kernels by building the world and an agent of each kind, as far as the extras include them."""
    if importlib.util.find_spec("numba") is None:
        return
    if WITH_WORLD & {*extras}:
        from zsim_world.run.world import World

        World(scenario_file.resolve(ALONE), "lockstep", 0.0, time.monotonic_ns, None)
    if WITH_AGENTS & {*extras}:
        _compile_mathematics()
        from zsim_agents.hosting import hosted

        scenario = scenario_file.resolve(formations())
        hosted(_info(scenario), scenario, ["*"]).rehearse()
    if WITH_CAMERAS & {*extras}:
        from zsim_agents.cameras import detector

        detector.rehearse()


def _compile_mathematics() -> None:
    """Call the mathematical functions that scenarios, laws and references may use but the formations below do not."""
    for function in (el.sin, el.cos, el.tan, el.asin, el.acos, el.atan, el.exp, el.log, el.log1p, el.square):
        function(0.5)
    for function in (el.atan2, el.power, el.hypot):
        function(0.5, 0.5)
    square = np.eye(4)
    linear.solve(square, square)
    linear.eigen(square)
    linear.singular_values(square)
    linear.solve_banded(np.ones((4, 1)), 0, square)
    normal_quantile(0.5)


def _info(scenario: Scenario) -> Info:
    """Return a `world/info` message that stands in for a world, whose kernel then need not be compiled."""
    time = scenario.time
    drones = tuple(DroneInfo(drone.name, drone.model) for drone in scenario.drones)
    clusters = tuple(ClusterInfo(cluster.name, tuple(cluster.drones)) for cluster in scenario.clusters)
    return Info(
        t_ns=0, seq=0, contract=CONTRACT, run_id=scenario.name, federation=scenario.federation, mode="lockstep",
        rate=0.0, gate_ns=round(time.gate_ms * 1e6), physics_dt_ns=round(time.physics_dt_ms * 1e6),
        command_delay_ns=0, seed=scenario.seed, origin=Origin(0.0, 0.0, 0.0), drones=drones, clusters=clusters,
        scenario="", scenario_sha256="", version=__version__, fingerprint="",
    )  # fmt: skip


def formations() -> dict[str, Any]:
    nested, groups, size = NESTED
    names = {kind: [f"{kind}{i}" for i in range(count)] for kind, count in (SIZES | {nested: groups * size}).items()}
    clusters: list[dict[str, Any]] = [{"name": kind, "drones": drones} for kind, drones in names.items()]
    clusters[-1]["groups"] = [{"name": f"g{i}", "size": size} for i in range(groups)]
    drones = [
        {"name": name, "position_m": [RADIUS_M * math.cos(i), RADIUS_M * math.sin(i) + 4 * RADIUS_M * row, 0.0]}
        for row, each in enumerate(names.values())
        for i, name in enumerate(each)
    ]
    return {"name": "warm-up", "duration_s": 1, "drones": drones, "clusters": clusters}


def _show_compilation() -> None:
    """From now on, print a line for each function called from Python that is compiled rather than loaded from disk."""
    from numba.core import event

    class Shown(event.Listener):
        """Prints the outermost function being compiled, not those that it calls."""

        depth = 0

        def on_start(self, event: Any) -> None:
            if not self.depth:
                function = event.data["dispatcher"].py_func
                print(printable(f"compiling {function.__module__}.{function.__name__}"), flush=True)
            self.depth += 1

        def on_end(self, event: Any) -> None:
            self.depth -= 1

    event.register("numba:compile", Shown())


if __name__ == "__main__":
    if importlib.util.find_spec("numba") is not None:
        _show_compilation()
    main(sys.argv[1:])
