"""Common parts of laws with a shape: the drones' positions in it, and the terms that tie it to the reference.

Laws based on relative quantities do not control the position of the shape; some do not control its rotation either, and
one does not control its scale. Two terms, common to all these laws, tie the shape to the reference:

    u_i = law + v_i*                          feed-forward, for drones that know the reference's motion
              + b_i (p_i* - p_i)              pinning, for informed drones

Pinning one node of a connected, undirected graph changes the rate of consensus from k lambda_2(L), about the mean, to
lambda_min(k L + diag(b)), about the reference.
"""

from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, field

from zsim.scenario.scenario import DRONES_MAX, Scenario, Value
from zsim.schema.checker import Fault
from zsim.schema.quantities import NonNegative, Positive, Real
from zsim_agents.laws.pilot import Array, FormationReference, Pilot, PilotParameters, Sight, polygon


class ShapeParameters(PilotParameters):
    """Parameters of the laws with a shape."""

    gain_1_s: Annotated[float, Meta(gt=0, le=5)] = 0.3
    places_m: Annotated[list[tuple[Real, Real]], Meta(max_length=DRONES_MAX)] = field(default_factory=list)
    """Positions in the shape, in the scenario's order of drones; empty: the corners of a regular polygon."""
    radius_m: Positive = 3.0
    """Circumradius of that polygon."""
    heading_deg: Value = 0.0
    scale: Value = 1.0
    """Factor applied to the positions, which `heading_deg` rotates. Both take the same forms as `centre_m`."""
    feedforward: bool = True
    """Whether all drones know the reference's motion; otherwise only the informed ones do."""
    informed: list[str] | None = None
    """Drones that know their own reference position in W; None: the first drone only."""
    pin_1_s: NonNegative = 1.0
    """Gain with which informed drones approach their reference positions."""


class ShapePilot(Pilot):
    """Flies one drone to its position in a shape; the laws differ in `velocity`."""

    Parameters = ShapeParameters

    def begin(self, scenario: Scenario) -> None:
        parameters, names = self.parameters, [drone.name for drone in scenario.drones]
        positions = np.array(parameters.places_m) if parameters.places_m else polygon(len(names), parameters.radius_m)
        self._places: dict[str, Array] = dict(zip(names, positions, strict=True))
        self._informed = self._drone in (names[:1] if parameters.informed is None else parameters.informed)

    @staticmethod
    def reference_of(parameters: Any) -> FormationReference:
        return FormationReference(parameters.centre_m, parameters.heading_deg, parameters.scale, parameters.start_s)

    def relative(self, now: Sight) -> list[tuple[Array, Array]]:
        """Return z_ij = p_j - p_i [m; W] of each neighbour, and its desired value."""
        own = now.reference.place(self._places[self._drone])[0]
        return [(each.p_W - now.p_W, now.reference.place(self._places[each.name])[0] - own) for each in now.heard]

    def own_place(self, now: Sight) -> tuple[Array, Array]:
        """Return the drone's reference position p_i* [m; W] and its rate v_i* [m/s]."""
        c, c_dot = now.reference.place(self._places[self._drone])
        return now.reference.p_W + c, now.reference.v_W + c_dot

    def tied(self, now: Sight) -> Array:
        """Return the terms (2,) that tie the shape to the reference [m/s; W]."""
        p_W, v_W = self.own_place(now)
        feedforward = v_W if self.parameters.feedforward or self._informed else np.zeros(2)
        return feedforward + self.parameters.pin_1_s * (p_W - now.p_W) if self._informed else feedforward

    @classmethod
    def flaws(cls, parameters: Mapping[str, Any], scenario: Scenario) -> Iterator[Fault]:
        yield from super().flaws(parameters, scenario)
        drones, positions = [drone.name for drone in scenario.drones], parameters["places_m"]
        if positions and len(positions) != len(drones):
            yield "places_m", f"has {len(positions)} positions; must have {len(drones)}, one for each drone"
        for name in parameters["informed"] or ():
            if name not in drones:
                yield "informed", f"names {name!r}; must be one of {', '.join(drones)}"
