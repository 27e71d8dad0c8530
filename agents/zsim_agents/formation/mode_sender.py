"""Mode commands to drones, repeated while they have no effect."""

from __future__ import annotations

import math

from zsim_agents.formation.flight_data import GateInput, ModeCommand


class ModeSender:
    """Sends a mode to each drone that is still in a state from which it is to go, once per resend_s."""

    def __init__(self, drones: tuple[str, ...], resend_s: float) -> None:
        self._drones = drones
        self._resend_s = resend_s
        self._sent_s: dict[str, float] = {}

    def restart(self) -> None:
        """Begin anew: the next commands are sent at once."""
        self._sent_s.clear()

    def commands(self, gate: GateInput, mode: str, states: frozenset[str]) -> tuple[ModeCommand, ...]:
        """Return the commands of this gate for the drones that are in one of the states."""
        due = []
        for drone, state in zip(self._drones, gate.states, strict=True):
            if state in states and gate.t_s - self._sent_s.get(drone, -math.inf) >= self._resend_s:
                self._sent_s[drone] = gate.t_s
                due.append(ModeCommand(drone, mode))
        return tuple(due)
