"""A formation as an FMU sees it: cluster variables of the estimates, and velocities for rates of these variables.

So an FMU may be a cluster space controller that knows nothing of kinematics: c in, c_dot out.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from zsim.contract import keys
from zsim.contract.flight_messages import Velocity
from zsim.errors import RunError, UserCodeError
from zsim.scenario.scenario import Scenario
from zsim_agents.formation.spaces.cluster_space import SingularClusterError, robot_rates
from zsim_agents.formation.spaces.scenario_space import scenario_space


class Formation:
    """One of a scenario's clusters.

    Attributes:
        drones: in the order of its robots.
        names: of its variables, in the order of c.
    """

    def __init__(self, scenario: Scenario, cluster: str) -> None:
        of = scenario.cluster(cluster)
        self.cluster, self.drones = cluster, of.drones
        try:
            self._space = scenario_space(scenario, of)
        except ValueError as error:
            raise RunError(f"cluster {cluster}: {error}") from error
        self.names: Sequence[str] = self._space.names
        self._estimates = [keys.estimate(drone) for drone in self.drones]

    def c(self, latest: Mapping[str, Any]) -> list[float] | None:
        """Return c (4n,) of the newest messages; None before there are all estimates, or where it is singular."""
        estimates = [latest.get(key) for key in self._estimates]
        if None in estimates:
            return None
        p_W = np.array([estimate.position_m for estimate in estimates])  # type: ignore[union-attr]
        yaw = np.array([estimate.yaw_rad for estimate in estimates])  # type: ignore[union-attr]
        try:
            return self._space.forward(p_W, yaw).tolist()
        except SingularClusterError:
            return None

    def velocities(self, latest: Mapping[str, Any], c_dot: Sequence[float]) -> list[Velocity]:
        """Return the commands of the drones in W [m/s, rad/s] for rates c_dot (4n,); none before there is a c.

        Raises:
            UserCodeError: the formation has no such motion.
        """
        c = self.c(latest)
        if c is None:
            return []
        try:
            v_W, yaw_rates = robot_rates(self._space, np.array(c), np.array(c_dot))
        except SingularClusterError as error:
            raise UserCodeError(f"cluster {self.cluster}: {error}") from error
        rates = zip(v_W.tolist(), yaw_rates.tolist(), strict=True)
        return [Velocity(0, 0, "", (x, y, z), yaw_rate, "world") for (x, y, z), yaw_rate in rates]
