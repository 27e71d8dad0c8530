"""A custom formation law: cyclic pursuit, in which each drone flies at a fixed angle to the direction of the next one.

zsim run examples/laws.yaml --set agents.pilot.class=cyclic_pursuit:CyclicPursuit
PYTHONPATH=examples zsim board --laws consensus,cyclic_pursuit:CyclicPursuit --scenarios trajectory --seeds 1

    u_i = v_r + k R(-pi/n) (p_{i+1} - p_i)

Marshall, Broucke, Francis, Formations of vehicles in cyclic pursuit, IEEE Trans. Automatic Control 49 (2004). With a
turn of pi / n outwards the drones circle at a constant radius; here the circle also moves at the reference's velocity.
The scenario must list the drones in counter-clockwise order around the centre. A drone that does not hear the next one
flies at v_r.
"""

import math
from typing import Annotated

import numpy as np
from msgspec import Meta

from zsim.scenario.scenario import Scenario
from zsim_agents.laws.pilot import Array, Pilot, PilotParameters, Sight


class CyclicPursuit(Pilot):
    class Parameters(PilotParameters):
        gain_1_s: Annotated[float, Meta(gt=0, le=2)] = 0.2

    def begin(self, scenario: Scenario) -> None:
        names = [drone.name for drone in scenario.drones]
        self._next = names[(names.index(self._drone) + 1) % len(names)]
        self._turn = -math.pi / len(names)

    def velocity(self, now: Sight) -> Array:
        ahead = [each.p_W - now.p_W for each in now.heard if each.name == self._next]
        if not ahead:
            return now.reference.v_W
        c, s, (x, y) = math.cos(self._turn), math.sin(self._turn), ahead[0]
        return now.reference.v_W + self.parameters.gain_1_s * np.array([c * x - s * y, s * x + c * y])
