"""A geofence: a circle and a ceiling by parameters, and circles and polygons that were uploaded. Axes of W.

Source of the items: https://mavlink.io/en/services/mission.html#fence.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from zsim.math.rotation import Vector
from zsim_bridges.mavlink.autopilot.enums import Cmd
from zsim_bridges.mavlink.autopilot.personality import Settings
from zsim_bridges.mavlink.autopilot.vehicle_state import VehicleState
from zsim_bridges.mavlink.flight.mission import PlanItem, place_of

Point = tuple[float, float]
BREACH_NONE, BREACH_ALTITUDE, BREACH_BOUNDARY = 0, 2, 3  # FENCE_BREACH


class Circle(NamedTuple):
    """A circle that is not to be left, or not to be entered."""

    centre_m: Point
    radius_m: float
    inside: bool

    def allows(self, x: float, y: float) -> bool:
        """Return whether a point may be flown to."""
        return (math.hypot(x - self.centre_m[0], y - self.centre_m[1]) <= self.radius_m) == self.inside


class Polygon(NamedTuple):
    """A polygon that is not to be left, or not to be entered."""

    corners_m: tuple[Point, ...]
    inside: bool

    def allows(self, x: float, y: float) -> bool:
        """Return whether a point may be flown to: by how many edges are crossed to the east of it."""
        crossed = False
        for (x1, y1), (x2, y2) in zip(self.corners_m, (*self.corners_m[1:], self.corners_m[0]), strict=True):
            if (y1 > y) != (y2 > y) and x < x1 + (x2 - x1) * (y - y1) / (y2 - y1):
                crossed = not crossed
        return crossed == self.inside


class VehicleFence:
    """The fence of one vehicle.

    Attributes:
        shapes: that were uploaded.
    """

    def __init__(self) -> None:
        self.shapes: list[Circle | Polygon] = []

    def load(self, items: Sequence[PlanItem], state: VehicleState) -> None:
        """Replace the shapes."""
        self.shapes = []
        corners: list[Point] = []
        for item in items:
            x, y, _ = place_of(item, state)
            if item.command in (Cmd.FENCE_CIRCLE_INCLUSION, Cmd.FENCE_CIRCLE_EXCLUSION):
                inside = item.command == Cmd.FENCE_CIRCLE_INCLUSION
                self.shapes.append(Circle((x, y), item.params[0], inside))
            elif item.command in (Cmd.FENCE_POLYGON_INCLUSION, Cmd.FENCE_POLYGON_EXCLUSION):
                corners.append((x, y))
                if len(corners) >= item.params[0]:
                    inside = item.command == Cmd.FENCE_POLYGON_INCLUSION
                    self.shapes.append(Polygon(tuple(corners), inside))
                    corners = []

    def breach(self, position_m: Vector, state: VehicleState, settings: Settings) -> int:
        """Return which fence a position is beyond, BREACH_NONE if none."""
        home = state.home_m or position_m
        ceiling_m, radius_m = settings["fence_altitude_m"], settings["fence_radius_m"]
        if ceiling_m > 0 and position_m[2] - home[2] > ceiling_m:
            return BREACH_ALTITUDE
        x, y, _ = position_m
        near = radius_m <= 0 or math.hypot(x - home[0], y - home[1]) <= radius_m
        return BREACH_NONE if near and all(shape.allows(x, y) for shape in self.shapes) else BREACH_BOUNDARY
