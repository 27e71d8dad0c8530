"""A custom agent: lands every drone whose estimate leaves a circle around the origin.

PYTHONPATH=examples zsim run scenarios/step.yaml --agent 'geofence:Geofence radius_m=4.0'   with a run
PYTHONPATH=examples zsim agent geofence:Geofence radius_m=4.0                               beside a running federation
python examples/geofence.py scenarios/step.yaml 4.0                                         from Python
"""

import math
import sys
from typing import Any

import zsim


class Geofence(zsim.Agent):
    """Sends `land` to every hovering or flying drone whose estimated position is outside the circle."""

    name = "fence.main"  # name of the agent's process, as role.thing
    reads = ("drone/*/sensor/status", "drone/*/estimate")

    def __init__(self, radius_m: float) -> None:
        self._radius_m = radius_m
        self._state: dict[str, str] = {}
        self._is_outside: dict[str, bool] = {}

    def receive(self, key: str, message: Any) -> None:
        drone = key.split("/")[1]
        if key.endswith("estimate"):
            self._is_outside[drone] = math.hypot(*message.position_m[:2]) > self._radius_m
        else:
            self._state[drone] = message.state

    def step(self, t_ns: int) -> list[zsim.Output]:
        flying = (drone for drone, state in self._state.items() if state in ("hovering", "flying"))
        return [self.command(t_ns, drone, zsim.land()) for drone in flying if self._is_outside.get(drone)]


if __name__ == "__main__":
    run = zsim.run(sys.argv[1], duration_s=40, agents=[Geofence(float(sys.argv[2]))])
    for t_s, event in run.events.iterrows():
        if event.kind in ("mode", "refused"):
            print(f"{t_s:8.2f} s  {event.text}")
