"""The cluster space that a scenario asks for."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from zsim.scenario.scenario import Cluster, ClusterGroup, Scenario, kinematics
from zsim_agents.formation.spaces.cluster_space import Array, ClusterSpace, cluster_space
from zsim_agents.formation.spaces.nested_cluster import NestedCluster
from zsim_agents.formation.spaces.template_cluster import TemplateCluster


def scenario_space(scenario: Scenario, cluster: Cluster) -> ClusterSpace:
    """Return the cluster space of one of a scenario's clusters.

    Raises:
        ValueError: there is none: a template in one line.
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


def _space(spec: Cluster | ClusterGroup, starts: Array) -> ClusterSpace:
    """Return the space of as many robots as there are starting places (n, 3)."""
    if kinematics(spec.space, len(starts), bool(spec.template_m)) == "template":
        return TemplateCluster(spec.template_m or starts)
    return cluster_space(len(starts))


def _starts(scenario: Scenario, drones: Sequence[str]) -> Array:
    """Return where drones start (n, 3) [m]: x ahead and y left of the first of them, z up."""
    by_name = {drone.name: drone for drone in scenario.drones}
    yaw = math.radians(by_name[drones[0]].yaw_deg)
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([by_name[name].position_m for name in drones]) @ np.array([(c, -s, 0), (s, c, 0), (0, 0, 1)])
