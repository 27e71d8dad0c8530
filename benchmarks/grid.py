"""Scenarios of any number of drones: a grid on the ground, GPS and all sensors, an estimator for each."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from zsim import scenario_file, yaml_file
from zsim.scenario import Scenario

SPACING_M = 4.0  # about ten hulls: hulls never meet, and downwash reaches no neighbour
GUST_M_S = 0.5  # as in Test 1
CLUSTER = 3  # drones per cluster: the size of the paper's


def document(
    count: int, duration_s: float = 60.0, cluster: int = CLUSTER, drone: Mapping[str, Any] | None = None
) -> Any:
    """Return the document of a scenario of `count` drones.

    Args:
        count: number of drones.
        duration_s: simulated.
        cluster: drones per cluster, each of which takes off; who is left over stands by. 0: none.
        drone: what every drone has beside its place.
    """
    side = math.ceil(math.sqrt(count))
    places = [(SPACING_M * (k % side), SPACING_M * (k // side), 0.0) for k in range(count)]
    names = [f"drone{k + 1}" for k in range(count)]
    groups = [names[k : k + cluster] for k in range(0, count - cluster + 1, cluster)] if cluster else []
    return {
        "name": f"grid{count}",
        "duration_s": duration_s,
        "time": {"command_delay_gates": 5},  # 100 ms to the aircraft, as in Test 1
        "environment": {"wind": {"gust_m_s": GUST_M_S}},
        "sensors": {"preset": "paper"},
        "drones": [
            {"name": name, "position_m": list(place), **(drone or {})}
            for name, place in zip(names, places, strict=True)
        ],
        "clusters": [
            {"name": f"c{k + 1}", "drones": group, "plan": {"takeoff_s": 1.0}} for k, group in enumerate(groups)
        ],
    }


def scenario(
    count: int, duration_s: float = 60.0, cluster: int = CLUSTER, drone: Mapping[str, Any] | None = None
) -> Scenario:
    """Return the resolved scenario; arguments as for `document`."""
    return scenario_file.resolve(document(count, duration_s, cluster, drone))


def write(
    path: Path, count: int, duration_s: float, cluster: int = CLUSTER, expect: Sequence[str] | None = None
) -> None:
    """Write the scenario as a file; `expect` as in a scenario's `processes`."""
    content = document(count, duration_s, cluster)
    content["processes"] = {"expect": expect}
    path.write_text(yaml_file.dump(content))
