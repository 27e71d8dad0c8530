"""Compile what flies, once on a machine, so that a run starts at once there: `python -m zsim_deploy.roles.warm_up`.

Where numba is missing nothing is compiled, and there is nothing to do. `zsim push` runs this on a host.
"""

import importlib.util
import math
import time
from typing import Any

from zsim.scenario import scenario_file

SIZES = {"pair": 2, "triad": 3, "template": 5}  # drones of the kinds of cluster: each has code of its own
ALONE = {"name": "warm-up", "duration_s": 1, "drones": [{"name": "alone", "position_m": [0, 0, 0]}]}  # as good as many
NESTED = ("groups", 2, 3)  # name, groups, drones of each
APART_M = 4.0  # on circles, so that no formation stands in a line


def main() -> None:
    """Build the world and one of each agent, as far as they are installed, and let them compile."""
    if not (_has("numba") and _has("psutil")):
        return
    from zsim_world.flight.world import World

    info = World(scenario_file.resolve(ALONE), "lockstep", 0.0, time.monotonic_ns, None).info()
    if not _has("filterpy"):
        return
    from zsim_agents.hosting import hosted

    hosted(info, scenario_file.resolve(formations()), ["*"]).rehearse()


def formations() -> dict[str, Any]:
    """Return a scenario with one cluster of each kind."""
    nested, groups, size = NESTED
    names = {kind: [f"{kind}{i}" for i in range(count)] for kind, count in (SIZES | {nested: groups * size}).items()}
    clusters: list[dict[str, Any]] = [{"name": kind, "drones": drones} for kind, drones in names.items()]
    clusters[-1]["groups"] = [{"name": f"g{i}", "size": size} for i in range(groups)]
    places = [(name, _place(i, row)) for row, each in enumerate(names.values()) for i, name in enumerate(each)]
    drones = [{"name": name, "position_m": place} for name, place in places]
    return {"name": "warm-up", "duration_s": 1, "drones": drones, "clusters": clusters}


def _place(i: int, row: int) -> list[float]:
    return [APART_M * math.cos(i), APART_M * math.sin(i) + 4 * APART_M * row, 0.0]


def _has(module: str) -> bool:
    return importlib.util.find_spec(module) is not None


if __name__ == "__main__":
    main()
