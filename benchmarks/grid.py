"""Scenarios with any number of drones on a grid on the ground, each with all sensors of the paper and an estimator.

Three drones in a row do not form a triangle and would not take off, so the drones of a cluster of three stand at three
corners of a square, and the squares form the grid.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim.schema import yaml_file

SPACING_M = 4.0  # about eight hull diameters, so that hulls never touch and downwash reaches no neighbour
GUST_M_S = 0.5  # as in Test 1
CLUSTER = 3  # drones per cluster, as in the paper
CORNERS = ((0, 0), (1, 0), (0, 1))  # the occupied corners of each square


def document(
    count: int, duration_s: float = 60.0, cluster: int = CLUSTER, drone: Mapping[str, Any] | None = None
) -> Any:
    """Return a scenario document with `count` drones.

    Args:
        count: number of drones.
        duration_s: simulated duration.
        cluster: drones per cluster, 0 for no clusters; every cluster takes off, leftover drones stay on the ground.
        drone: fields of every drone in addition to its name and position.
    """
    places = _triangles(count) if cluster == CLUSTER else _rows(count, SPACING_M)
    names = [f"drone{k + 1}" for k in range(count)]
    groups = [names[k : k + cluster] for k in range(0, count - cluster + 1, cluster)] if cluster else []
    return {
        "name": f"grid{count}",
        "duration_s": duration_s,
        "time": {"command_delay_gates": 5},  # 100 ms until a command takes effect, as in Test 1
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


def _rows(count: int, pitch_m: float) -> list[tuple[float, float, float]]:
    side = math.ceil(math.sqrt(count))
    return [(pitch_m * (k % side), pitch_m * (k // side), 0.0) for k in range(count)]


def _triangles(count: int) -> list[tuple[float, float, float]]:
    squares = _rows(math.ceil(count / CLUSTER), 2.0 * SPACING_M)
    places = [(x + SPACING_M * i, y + SPACING_M * j, 0.0) for x, y, _ in squares for i, j in CORNERS]
    return places[:count]


def scenario(
    count: int, duration_s: float = 60.0, cluster: int = CLUSTER, drone: Mapping[str, Any] | None = None
) -> Scenario:
    """Return the scenario of `document`, resolved; the arguments are the same."""
    return scenario_file.resolve(document(count, duration_s, cluster, drone))


def write(
    path: Path, count: int, duration_s: float, cluster: int = CLUSTER, expect: Sequence[str] | None = None
) -> None:
    """Write the scenario of `document` to `path`, with `expect` in its section `processes`."""
    content = document(count, duration_s, cluster)
    content["processes"] = {"expect": expect}
    path.write_text(yaml_file.dump(content))
