"""The cluster space of a scenario's cluster: a stock one, a user's class, or a cluster of clusters if it has groups.

Group k has cluster variables c_k of its own robots. Its (x_c, y_c, z_c, yaw) are the position and heading of robot k of
the parent; the rest of c_k (tilts, headings and shape) is appended to the parent's variables. For m groups, the 4m
variables of the parent and 4n_k - 4 of each group add up to 4n. Groups may themselves be clusters of clusters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.errors import UserCodeError
from zsim.math import elementary as el
from zsim.math.linear import product
from zsim.scenario.scenario import ROBOTS_MAX, Cluster, ClusterGroup, Scenario, space_name
from zsim.schema import parameters, plugin
from zsim_agents.formation.spaces.cluster_space import Array, ClusterSpace, checked
from zsim_agents.formation.spaces.template_cluster import TemplateCluster
from zsim_agents.formation.spaces.triad_cluster import PairCluster, TriadCluster

Indices = NDArray[np.intp]
BODY = ("x_c", "y_c", "z_c", "yaw")  # variables of a group that describe a robot of the parent


def scenario_space(scenario: Scenario, cluster: Cluster) -> ClusterSpace:
    """Return the cluster space of one of a scenario's clusters.

    Raises:
        ValueError: the positions in the template are collinear.
        DocumentError: a user's class cannot be loaded; UserCodeError: it cannot be instantiated.
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
    places_m = np.array(spec.template_m or starts, dtype=float)
    name = space_name(spec.space, len(places_m), bool(spec.template_m))
    kind = STOCK.get(name) or plugin.load(name, "space", ClusterSpace)
    own: Any = parameters.bound(kind, spec.space_parameters, "space_parameters")
    if name in STOCK:
        return own(places_m)
    try:
        return checked(own.for_places(places_m))
    except TypeError as error:  # includes a call with wrong arguments, whose traceback has no frame of the user's code
        failure = plugin.user_code_error(error, "")
        raise failure or UserCodeError(f"{name}.for_places raised TypeError: {error}") from error


def _starts(scenario: Scenario, drones: Sequence[str]) -> Array:
    """Return the start positions of drones (n, 3) [m] in the first drone's heading frame: x ahead, y left, z up."""
    by_name = {drone.name: drone for drone in scenario.drones}
    yaw = math.radians(by_name[drones[0]].yaw_deg)
    c, s = el.cos(yaw), el.sin(yaw)
    return product([by_name[name].position_m for name in drones], [(c, -s, 0), (s, c, 0), (0, 0, 1)])


def cluster_space(n: int) -> ClusterSpace:
    """Return the triad space of n robots, 2 to 64: the paper's for n = 3, otherwise its generalisation."""
    if not 2 <= n <= ROBOTS_MAX:
        raise ValueError(f"a cluster of {n} robots is not possible; allowed: 2 to {ROBOTS_MAX}")
    return PairCluster() if n == 2 else TriadCluster(n)


STOCK: dict[str, Callable[[Array], ClusterSpace]] = {
    "triad": lambda places_m: cluster_space(len(places_m)),
    "template": TemplateCluster,
}


class _Group(NamedTuple):
    """The indices of a group in the complete cluster.

    Attributes:
        robots, rows: indices of the group's robots, and of their entries in r, four each.
        body, rest: indices of BODY and of all other variables in the group's own c.
        own: indices of these other variables in the c of the complete cluster.
        parent_rows: indices of the group's body in the r of the parent.
    """

    space: ClusterSpace
    robots: slice
    rows: slice
    body: Indices
    rest: Indices
    own: slice
    parent_rows: slice


class NestedCluster(ClusterSpace):
    """c = (variables of the parent, then those of each group except x_c, y_c, z_c, yaw, as NAME.roll, NAME.pitch, ...).

    phi_k of the parent is the yaw of group k relative to that of the parent, NAME.phi_i the heading of a robot relative
    to the yaw of its group. The origin is the mean of the groups' centroids. The chain rule gives both Jacobians.
    `groups` contains the name and space of each group, one group for each robot of the parent, in the same order.
    """

    def __init__(self, parent: ClusterSpace, groups: Sequence[tuple[str, ClusterSpace]]) -> None:
        if len(groups) != parent.n:
            raise ValueError(f"groups: {len(groups)}; allowed: {parent.n}, one per robot of their parent")
        self.parent = parent
        self._groups: list[_Group] = []
        names, robots = list(parent.names), 0
        for k, (name, space) in enumerate(groups):
            body = np.array([space.index(variable) for variable in BODY])
            rest = np.setdiff1d(np.arange(space.size), body)
            own = slice(len(names), len(names) + len(rest))
            end = robots + space.n
            rows, parent_rows = slice(4 * robots, 4 * end), slice(4 * k, 4 * k + 4)
            self._groups.append(_Group(space, slice(robots, end), rows, body, rest, own, parent_rows))
            names += [f"{name}.{space.names[i]}" for i in rest]
            robots = end
        super().__init__(robots, names, "minimum of the spreads of the parent and its groups")

    def forward(self, p_W: Array, yaw: Array) -> Array:
        c, bodies = np.empty(self.size), np.empty((self.parent.n, 4))
        for k, group in enumerate(self._groups):
            own = group.space.forward(p_W[group.robots], yaw[group.robots])
            bodies[k], c[group.own] = own[group.body], own[group.rest]
        c[: self.parent.size] = self.parent.forward(np.ascontiguousarray(bodies[:, :3]), bodies[:, 3].copy())
        return c

    def inverse(self, c: Array) -> tuple[Array, Array]:
        p_W, yaw = np.empty((self.n, 3)), np.empty(self.n)
        for group, own in zip(self._groups, self.parts(c)[1:], strict=True):
            p_W[group.robots], yaw[group.robots] = group.space.inverse(own)
        return p_W, yaw

    def jacobian(self, p_W: Array, yaw: Array) -> Array:
        J, body = np.zeros((self.size, self.size)), np.zeros((self.parent.size, self.size))
        bodies = np.empty((self.parent.n, 4))
        for k, group in enumerate(self._groups):
            own = group.space.jacobian(p_W[group.robots], yaw[group.robots])
            bodies[k] = group.space.forward(p_W[group.robots], yaw[group.robots])[group.body]
            J[group.own, group.rows], body[group.parent_rows, group.rows] = own[group.rest], own[group.body]
        J[: self.parent.size] = product(self.parent.jacobian(bodies[:, :3].copy(), bodies[:, 3].copy()), body)
        return J

    def inverse_jacobian(self, c: Array) -> Array:
        J_inv = np.zeros((self.size, self.size))
        parent, *parts = self.parts(c)
        parent_motion = self.parent.inverse_jacobian(parent)
        for group, own in zip(self._groups, parts, strict=True):
            own_inverse = group.space.inverse_jacobian(own)
            J_inv[group.rows, : self.parent.size] = product(
                own_inverse[:, group.body], parent_motion[group.parent_rows]
            )
            J_inv[group.rows, group.own] = own_inverse[:, group.rest]
        return J_inv

    def motion(self, c: Array, c_dot: Array) -> Array:
        r_dot = np.empty(self.size)
        parent, *parts = self.parts(c)
        parent_motion = self.parent.motion(parent, c_dot[: self.parent.size])
        for group, own in zip(self._groups, parts, strict=True):
            own_dot = np.empty(group.space.size)
            own_dot[group.body], own_dot[group.rest] = parent_motion[group.parent_rows], c_dot[group.own]
            r_dot[group.rows] = group.space.motion(own, own_dot)
        return r_dot

    def specimen(self, separation_m: float) -> Array:
        c = np.zeros(self.size)
        parent_separation_m = separation_m
        for group in self._groups:
            own = group.space.specimen(separation_m)
            c[group.own] = own[group.rest]
            parent_separation_m = max(
                parent_separation_m, 2.0 * float(np.ptp(group.space.inverse(own)[0], axis=0).max())
            )
        c[: self.parent.size] = self.parent.specimen(parent_separation_m)
        return c

    def parts(self, c: Array) -> list[Array]:
        """Return the cluster variables of the parent (4m,), then all cluster variables of each group (4n_k,)."""
        parent = c[: self.parent.size]
        bodies = np.empty((self.parent.n, 4))
        bodies[:, :3], bodies[:, 3] = self.parent.inverse(parent)
        parts = [parent]
        for k, group in enumerate(self._groups):
            own = np.empty(group.space.size)
            own[group.body], own[group.rest] = bodies[k], c[group.own]
            parts.append(own)
        return parts

    def spread(self, c: Array) -> float:
        return min(space.spread(part) for space, part in self._pairs(c))

    def measures(self, c: Array) -> tuple[float, float]:
        """Return the minimum spread and margin of parent and groups: the cluster is singular if one of them is."""
        spreads, margins = zip(*(space.measures(part) for space, part in self._pairs(c)), strict=True)
        return min(spreads), min(margins)

    def condition(self, c: Array) -> float:
        """Return the maximum condition number of the parent and the groups, each in its own scaling.

        J^-1 of the cluster is a product of theirs: if none of these is ill-conditioned, neither is the product.
        """
        return max(space.condition(part) for space, part in self._pairs(c))

    def _pairs(self, c: Array) -> list[tuple[ClusterSpace, Array]]:
        return list(zip([self.parent, *(group.space for group in self._groups)], self.parts(c), strict=True))
