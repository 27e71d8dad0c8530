"""Estimators of drones of several clusters, each cluster with a joint filter, with the methods of an EstimatorBank."""

from collections.abc import Sequence
from typing import Any

from zsim.contract.flight_messages import Estimate
from zsim.contract.framing import GateMessages
from zsim.contract.snapshot import State
from zsim.scenario.scenario import Scenario
from zsim_agents.estimation.drone_estimator import StateEstimate
from zsim_agents.estimation.estimator_bank import EstimatorBank
from zsim_agents.estimation.joint.joint_bank import JointBank


def cluster_mates(scenario: Scenario, drone: str) -> tuple[str, ...]:
    """Return the drones of the cluster of a drone in its order; the drone alone where it is in none."""
    return next((tuple(cluster.drones) for cluster in scenario.clusters if drone in cluster.drones), (drone,))


class ClusterBanks:
    """A JointBank for each cluster of some drones; a drone of none has an EstimatorBank.

    Args:
        scenario: resolved.
        drones: whose estimates are wanted.
        gate_s: interval of the gates [s].

    Attributes:
        drones: whose sensors are needed, in the order in which `receive` counts them.
    """

    def __init__(self, scenario: Scenario, drones: Sequence[str], gate_s: float) -> None:
        groups = list(dict.fromkeys(cluster_mates(scenario, drone) for drone in drones))
        settings = (scenario.environment, scenario.estimation, gate_s)
        kinds = [JointBank if len(group) > 1 else EstimatorBank for group in groups]
        made = zip(kinds, groups, strict=True)
        self._banks = [kind([scenario.drone(name) for name in group], *settings) for kind, group in made]
        self.drones = [drone for group in groups for drone in group]
        self._places = [(bank, i) for bank, group in zip(self._banks, groups, strict=True) for i in range(len(group))]
        self._wanted = [self.drones.index(drone) for drone in drones]

    def receive(self, i: int, sensor: str, message: Any, t_arrival_s: float) -> None:
        """Take a message of a sensor of the i-th of `drones`."""
        bank, place = self._places[i]
        bank.receive(place, sensor, message, t_arrival_s)

    def receive_gate(self, gate: GateMessages) -> bool:
        """Take all sensors of a gate; False, and none, if one of its messages is not as the world writes it."""
        if len(self._banks) > 1:
            return False  # one may take it and another not
        return self._banks[0].receive_gate(gate)

    def estimate(self, t_s: float) -> list[StateEstimate]:
        """Use what has come since the last gate and return the wanted estimates for `t_s`."""
        if len(self._banks) == 1:
            return self._banks[0].estimate(t_s, self._wanted)
        estimates = [each for bank in self._banks for each in bank.estimate(t_s)]
        return [estimates[place] for place in self._wanted]

    def warm_start(self, i: int, last: StateEstimate | Estimate) -> None:
        """Continue the i-th wanted drone from a published estimate; call before the first reading."""
        bank, place = self._places[self._wanted[i]]
        bank.warm_start(place, last)

    def snapshot(self) -> State:
        """Return the rows of all as they are between two gates."""
        return {"banks": [bank.snapshot() for bank in self._banks]}

    def restore(self, state: State) -> None:
        """Take over what `snapshot` returned.

        Raises:
            KeyError, ValueError: it is of other drones.
        """
        for bank, saved in zip(self._banks, state["banks"], strict=True):
            bank.restore(saved)
