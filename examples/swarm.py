"""A decentralised formation: every drone has a pilot that knows only its own estimate and what the others send.

zsim run examples/swarm.yaml
zsim run examples/swarm.yaml --set agents.pilot.parameters.gain_1_s=0.6
python examples/swarm.py

Consensus on displacements (Olfati-Saber, Fax and Murray 2007, Proc. IEEE 95(1)): each pilot flies
u_i = k sum_j ((p_j - c_j) - (p_i - c_i)) over the drones that it hears, where c is a drone's position in the formation.
The error decays at least at rate k lambda_2, with the graph's algebraic connectivity lambda_2; the centroid does not
move.
"""

import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

import zsim

SILENT_NS = 500_000_000  # drones not heard for this long are ignored


class Position(zsim.AgentMessage, frozen=True):
    """A drone's estimate of its position, in W."""

    key = "swarm/{drone}/position"

    position_m: tuple[float, float, float]


class Pilot(zsim.Agent):
    """Flies one drone to its corner of a regular polygon around the centroid of all drones."""

    class Parameters(zsim.Parameters):
        radius_m: Annotated[float, Meta(gt=0, le=100)] = 3.0
        height_m: Annotated[float, Meta(gt=0.5, le=50)] = 2.0
        gain_1_s: Annotated[float, Meta(gt=0, le=2)] = 0.3
        speed_max_m_s: Annotated[float, Meta(gt=0, le=5)] = 1.5
        takeoff_s: Annotated[float, Meta(ge=0)] = 2.0

    messages = (Position,)
    reads = ("drone/{drone}/sensor/status", "drone/{drone}/estimate", Position.of())
    parameters: Parameters

    def __init__(self, drone: str, scenario: Any) -> None:
        super().__init__()
        self._drone = drone
        names = [each.name for each in scenario.drones]
        angles = 2 * np.pi * np.arange(len(names)) / len(names)
        corners = self.parameters.radius_m * np.column_stack([np.cos(angles), np.sin(angles)])
        self._corners = dict(zip(names, corners, strict=True))
        self._heard: dict[str, tuple[int, Any]] = {}
        self._state, self._p_W = "landed", (0.0, 0.0, 0.0)

    def receive(self, key: str, message: Any) -> None:
        kind, drone, what = key.split("/", 2)
        if kind == "swarm":
            if drone != self._drone:
                self._heard[drone] = message.t_ns, message.position_m
        elif what == "estimate":
            self._p_W = message.position_m
        else:
            self._state = message.state

    def step(self, t_ns: int) -> list[zsim.Output]:
        own = self.parameters
        outputs = [self.message(t_ns, Position(position_m=self._p_W))]
        if self._state == "landed" and t_ns == round(own.takeoff_s * 1e9):
            outputs.append(self.command(t_ns, self._drone, zsim.takeoff()))
        elif self._state in ("hovering", "flying"):
            error = np.array(self._p_W[:2]) - self._corners[self._drone]
            heard = [(drone, p_W) for drone, (at_ns, p_W) in self._heard.items() if t_ns - at_ns <= SILENT_NS]
            u = sum((np.array(p_W[:2]) - self._corners[drone] - error for drone, p_W in sorted(heard)), np.zeros(2))
            v = own.gain_1_s * np.append(u, own.height_m - self._p_W[2])
            v *= min(1.0, own.speed_max_m_s / max(float(np.sqrt(v @ v)), 1e-9))
            outputs.append(self.command(t_ns, self._drone, zsim.velocity(*v.tolist(), frame="world")))
        return outputs

    def snapshot(self) -> dict[str, Any]:
        heard = {drone: [at_ns, list(p_W)] for drone, (at_ns, p_W) in self._heard.items()}
        return {"heard": heard, "state": self._state, "p_W": list(self._p_W)}

    def restore(self, state: dict[str, Any]) -> None:
        self._heard = {drone: (at_ns, p_W) for drone, (at_ns, p_W) in state["heard"].items()}
        self._state, self._p_W = state["state"], state["p_W"]


if __name__ == "__main__":
    run = zsim.run(Path(__file__).with_suffix(".yaml"), duration_s=20, set={"agents.pilot.parameters.gain_1_s": 0.6})
    for drone in run.drones:
        place = run.estimate(drone).iloc[-1]
        print(f"{drone}: {math.hypot(place.position_m_x, place.position_m_y):.2f} m from the origin")
