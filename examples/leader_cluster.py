"""A cluster kinematics of one's own: the paper's triangle, with the place of robot 1 instead of the centroid.

    python examples/leader_cluster.py scenarios/step.yaml --duration 60

Checks the Jacobian against differences, then flies the scenario in this process with it.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from msgspec import Struct

from zsim.contract import messages
from zsim.runtime.bus import Bus
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim_agents.estimation.estimator import Estimator
from zsim_agents.formation.controller import Controller, gains_of, plan_of
from zsim_agents.formation.engagement import Engagement
from zsim_agents.formation.spaces.cluster_space import Array
from zsim_agents.formation.spaces.triad_cluster import TriadCluster
from zsim_world.flight.world import World

STEP = 1e-6  # m or rad, of the differences


class LeaderCluster(TriadCluster):
    """c as in the paper, but (x_c, y_c, z_c) is where robot 1 is: its command does not ask the others."""

    def forward(self, p_W: Array, yaw: Array) -> Array:
        c = super().forward(p_W, yaw)
        c[:3] = p_W[0]
        return c

    def inverse(self, c: Array) -> tuple[Array, Array]:
        p_W, yaw = super().inverse(c)
        return p_W - p_W[0] + c[:3], yaw

    def jacobian(self, p_W: Array, yaw: Array) -> Array:
        J = super().jacobian(p_W, yaw)
        J[:3] = 0.0
        J[:3, :3] = np.eye(3)
        return J

    def inverse_jacobian(self, c: Array) -> Array:
        J = super().inverse_jacobian(c).reshape(self.n, 4, self.size)
        J[:, :3, 3:] -= J[0, :3, 3:].copy()
        return J.reshape(self.size, self.size)


class LeaderController(Controller):
    """The stock controller on another cluster space."""

    def __init__(self, info: messages.Info, scenario: Scenario, cluster: str) -> None:
        super().__init__(info, scenario, cluster)
        spec = scenario.cluster(cluster)
        space = LeaderCluster(len(spec.drones))
        self._engagement = Engagement(space, spec.drones, gains_of(spec.gains), plan=plan_of(spec))


def jacobian_error(space: LeaderCluster) -> float:
    """Return the greatest difference of J to central differences of `forward`, and of J J^-1 to one."""
    p_W, yaw = np.array([(0.0, 1.5, 3.0), (-1.5, -1.5, 2.8), (1.7, -1.4, 3.1)]), np.array([0.1, -0.2, 0.3])
    J, c = space.jacobian(p_W, yaw), space.forward(p_W, yaw)
    columns = []
    for k in range(space.size):
        step = np.zeros((space.n, 4))
        step.flat[k] = STEP
        ahead = space.forward(p_W + step[:, :3], yaw + step[:, 3])
        behind = space.forward(p_W - step[:, :3], yaw - step[:, 3])
        columns.append(space.difference(ahead, behind) / (2 * STEP))
    off = np.abs(J - np.array(columns).T).max()
    return float(max(off, np.abs(J @ space.inverse_jacobian(c) - np.eye(space.size)).max()))


def fly(scenario: Scenario) -> list[messages.ClusterState]:
    """Fly a scenario of one cluster; return the controller's states."""
    world, seen = World(scenario), []

    def sink(key: str, message: Struct) -> None:
        if isinstance(message, messages.ClusterState):
            seen.append(message)

    info = world.info()
    estimators = [Estimator(info, scenario, drone.name) for drone in scenario.drones]
    bus = Bus(
        world, [*estimators, LeaderController(info, scenario, scenario.clusters[0].name)], time.monotonic_ns, sink
    )
    bus.join()
    while bus.turn():
        pass
    bus.end()
    return seen


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scenario", type=Path)
    parser.add_argument("--duration", type=float, default=60.0)
    args = parser.parse_args()
    error = jacobian_error(LeaderCluster(3))
    print(f"Jacobian: off by at most {error:.1e}")
    if error > 1e-6:
        raise SystemExit("the Jacobian does not belong to the kinematics")
    last = fly(scenario_file.load(args.scenario, duration_s=args.duration))[-1]
    here, there = (", ".join(f"{x:.2f}" for x in row[:3]) for row in (last.value, last.desired))
    print(f"t = {last.t_ns / 1e9:.0f} s, {last.phase}: robot 1 at ({here}) m, desired ({there}) m")


if __name__ == "__main__":
    main()
