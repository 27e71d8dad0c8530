"""The cluster space that a scenario asks for: the stock ones by their names, clusters of clusters by their groups."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from zsim.errors import UserCodeError
from zsim.scenario.scenario import ROBOTS_MAX, Cluster, ClusterGroup, Scenario, space_name
from zsim.schema import plugin
from zsim_agents.formation.spaces.cluster_space import Array, ClusterSpace, checked
from zsim_agents.formation.spaces.nested_cluster import NestedCluster
from zsim_agents.formation.spaces.pair_cluster import PairCluster
from zsim_agents.formation.spaces.template_cluster import TemplateCluster
from zsim_agents.formation.spaces.triad_cluster import TriadCluster


def scenario_space(scenario: Scenario, cluster: Cluster) -> ClusterSpace:
    """Return the cluster space of one of a scenario's clusters.

    Raises:
        ValueError: there is none: a template in one line.
        DocumentError: it is a class of the user's own that cannot be loaded; the line names its module.
        UserCodeError: it is a class of the user's own that cannot be made.
    """
    starts = _starts(scenario, cluster.drones)
    if not cluster.groups:
        return _space(cluster, starts)
    groups, centres, first = [], [], 0
    for group in cluster.groups:
        own = starts[first : first + group.size]
        groups.append((group.name, _space(group, own)))
        centres.append(own.mean(axis=0))
        first += group.size
    return NestedCluster(_space(cluster, np.array(centres)), groups)


def cluster_space(n: int) -> ClusterSpace:
    """Return the space of n robots called triad: the paper's at n = 3, its generalisation elsewhere.

    Raises:
        ValueError: n is not from 2 to 64.
    """
    if not 2 <= n <= ROBOTS_MAX:
        raise ValueError(f"a cluster of {n} robots is not possible; allowed: 2 to {ROBOTS_MAX}")
    return PairCluster() if n == 2 else TriadCluster(n)


STOCK: dict[str, Callable[[Array], ClusterSpace]] = {
    "triad": lambda places_m: cluster_space(len(places_m)),
    "template": TemplateCluster,
}


def _space(spec: Cluster | ClusterGroup, starts: Array) -> ClusterSpace:
    """Return the space of as many robots as there are starting places (n, 3)."""
    places_m = np.array(spec.template_m or starts, dtype=float)
    name = space_name(spec.space, len(places_m), bool(spec.template_m))
    if name in STOCK:
        return STOCK[name](places_m)
    own: Any = plugin.load(name, "space", ClusterSpace)
    try:
        return checked(own.for_places(places_m))
    except TypeError as error:  # also of a constructor that cannot be called like this, in which no frame is the user's
        failure = plugin.user_code_error(error, "")
        raise failure or UserCodeError(f"{name}.for_places raised TypeError: {error}") from error


def _starts(scenario: Scenario, drones: Sequence[str]) -> Array:
    """Return where drones start (n, 3) [m]: x ahead and y left of the first of them, z up."""
    by_name = {drone.name: drone for drone in scenario.drones}
    yaw = math.radians(by_name[drones[0]].yaw_deg)
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([by_name[name].position_m for name in drones]) @ np.array([(c, -s, 0), (s, c, 0), (0, 0, 1)])
