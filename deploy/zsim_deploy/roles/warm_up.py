"""Compiles what a run needs, once on a machine, so that runs start at once there.

    python -m zsim_deploy.roles.warm_up EXTRA...    for the roles that need these extras; `zsim push` runs it on a host

Without numba nothing is compiled, and there is nothing to do. As a program it prints the name of each function before
it compiles it, and nothing where all is compiled already.
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
from zsim.math.distributions import normal_quantile
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario

SIZES = {"pair": 2, "triad": 3, "template": 5}  # drones of each kind of cluster; each kind has code of its own
ALONE = {"name": "warm-up", "duration_s": 1, "drones": [{"name": "alone", "position_m": [0, 0, 0]}]}  # as good as many
NESTED = ("groups", 2, 3)  # name, groups, drones of each
WITH_WORLD = {"world", "sweep", "all", "dev"}  # extras that bring it …
WITH_AGENTS = WITH_WORLD | {"agents"}  # … and them; pyproject.toml
WITH_CAMERAS = {"cameras"}
APART_M = 4.0  # on circles, so that no formation stands in a line


def main(extras: Collection[str]) -> None:
    """Build the world and one agent of each kind, as far as these extras need them, and let them compile."""
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
    """Call what scenarios, laws and references may call besides what the formations below do."""
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
    """Return the `world/info` from which agents are made without a world: their host needs no compiled kernel."""
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
        {"name": name, "position_m": [APART_M * math.cos(i), APART_M * math.sin(i) + 4 * APART_M * row, 0.0]}
        for row, each in enumerate(names.values())
        for i, name in enumerate(each)
    ]
    return {"name": "warm-up", "duration_s": 1, "drones": drones, "clusters": clusters}


def _show_compilation() -> None:
    """Print a line whenever a function called from Python is compiled, but not if it is loaded from disk."""
    from numba.core import event

    class Shown(event.Listener):
        """Prints the outermost compilation: those inside it are of the functions that it calls."""

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
