"""What faults of the links make of commands on their way to the world: the world is their receiver."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from zsim.contract import keys
from zsim.runtime import link_faults
from zsim.runtime.link_faults import NEVER, WORLD, uniform
from zsim_world.flight.commander import Due

if TYPE_CHECKING:
    from zsim_world.flight.world import World

RADIO = "radio"


class CommandLinks:
    """Says when a command comes over its link, and whether."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._cluster_of = {drone: cluster.name for cluster in world.scenario.clusters for drone in cluster.drones}

    def delay_ns(self, drone: str, key: str, message: Any, gate_ns: int) -> int | None:
        """Return by how many whole gates a command comes later [ns]; None if it does not.

        Args:
            gate_ns: the gate that it belongs to.
        """
        acting = self._world.faults.carried(gate_ns)
        if not acting:
            return 0
        froms, total_ns = (self._sender(drone, message.source),), 0
        for fault in acting:
            if fault.kind != RADIO and link_faults.joins(fault, froms, WORLD):
                draw = uniform(self._world.scenario.seed, WORLD, fault, key, message.t_ns, message.seq)
                late_ns = link_faults.delay_ns(fault, draw)
                if late_ns is None:
                    return NEVER
                total_ns += late_ns
        return -(-total_ns // self._world.gate_ns) * self._world.gate_ns

    def lost_on_air(self, due: Due, gate_ns: int) -> bool:
        """Tell whether the radio does not bring a command that would take effect before a gate."""
        return any(fault.kind == RADIO and self._lost(fault, due) for fault in self._world.faults.carried(gate_ns))

    def _lost(self, fault: Any, due: Due) -> bool:
        drone = self._world.names[due.drone]
        if fault.target not in (WORLD, self._cluster_of.get(drone)):
            return False
        there = self._where(drone)
        here = link_faults.place_of(self._sender(drone, due.source), fault.parameters["place"], self._where)
        key, message = keys.command(drone, due.kind), due.message
        draw = uniform(self._world.scenario.seed, WORLD, fault, key, message.t_ns, message.seq)
        distance_m = math.dist(there, here) if there is not None and here is not None else None
        return link_faults.delay_ns(fault, draw, distance_m) is NEVER

    def _where(self, drone: str) -> list[float] | None:
        """Return where a drone truly is [m; W]."""
        i = self._world.index.get(drone)
        return self._world.fleet.bodies.state[i, :3].tolist() if i is not None else None

    def _sender(self, drone: str, source: str) -> str:
        """Return who has sent a command: of the controllers that share a process, that of the drone's cluster."""
        controller = f"controller.{self._cluster_of.get(drone)}"
        participant = self._world.barrier.participants.get(source)
        return controller if participant is not None and controller in participant.serves else source
