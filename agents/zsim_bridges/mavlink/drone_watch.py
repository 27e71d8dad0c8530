"""What the pilot of a drone is told: sensors, battery, faults, refusals, collisions, and the geofence that is kept.

The fence is a circle and a ceiling by parameters, and circles and polygons that clients upload, in the axes of W.
Source of its items: https://mavlink.io/en/services/mission.html#fence.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from zsim.contract.run_messages import Event
from zsim.math.rotation import Vector
from zsim_bridges.mavlink.dialect import Cmd, Severity
from zsim_bridges.mavlink.mission import PlanItem, place_of
from zsim_bridges.mavlink.personality import FenceAction, FlightMode, Parameters
from zsim_bridges.mavlink.telemetry import BREACH_ALTITUDE, BREACH_BOUNDARY, BREACH_NONE, TelemetrySource
from zsim_bridges.mavlink.vehicle_flight import Report
from zsim_bridges.mavlink.vehicle_state import VehicleState

FAULTS = {"fault": "", "fault_end": " is over", "fault_clear": " cleared"}
MODE_OF = {FenceAction.HOLD: FlightMode.HOLD, FenceAction.RETURN: FlightMode.RETURN, FenceAction.LAND: FlightMode.LAND}
Point = tuple[float, float]


class DroneWatch:
    """Watches one drone, reports changes, and acts at its fence.

    Args:
        source: name of this process, whose commands may be refused.
        seen: state and flight of the drone; the breach of its fence is noted there.
    """

    def __init__(self, drone: str, source: str, seen: TelemetrySource, parameters: Parameters, report: Report) -> None:
        self._drone = drone
        self._own = source
        self._seen = seen
        self._parameters = parameters
        self._report = report
        self._shapes: list[Circle | Polygon] = []
        self._failed: set[str] = set()
        self._was_low = False

    def load_fence(self, items: Sequence[PlanItem]) -> None:
        self._shapes = fence_shapes(items, self._seen.state)

    def on_event(self, event: Event) -> None:
        """Report an event that is about the drone."""
        if event.kind in FAULTS and event.data.get("target") == self._drone:
            severity = Severity.CRITICAL if event.kind == "fault" else Severity.NOTICE
            self._report(severity, f"Fault {event.data.get('kind')}{FAULTS[event.kind]}")
        elif event.kind == "collision" and self._drone in (pair := (event.subject, event.data.get("other"))):
            self._report(Severity.CRITICAL, f"Collision with {pair[1] if pair[0] == self._drone else pair[0]}")
        elif event.kind == "refused" and event.source == self._own and f"/{self._drone}/" in event.subject:
            is_overtaken = not event.subject.endswith("/mode") and self._seen.flight.target is None
            if not is_overtaken:  # a setpoint that a landing overtook is no news
                self._report(Severity.WARNING, f"Refused: {event.data.get('reason', event.text)}")

    def look(self) -> None:
        """Report what has changed since the last gate."""
        state = self._seen.state
        failed = set(state.failed_sensors())
        for name in sorted(failed - self._failed):
            self._report(Severity.CRITICAL, f"{name.upper()} lost")
        for name in sorted(self._failed - failed):
            self._report(Severity.INFO, f"{name.upper()} back")
        self._failed = failed
        if state.is_battery_low and not self._was_low:
            self._report(Severity.CRITICAL, f"Low battery: {self._seen.battery_percent:.0f} %")
        self._was_low = state.is_battery_low
        seen, action = self._seen, self._parameters.fence_action
        if action is FenceAction.NONE or not state.is_steerable:
            seen.breach = BREACH_NONE
            return
        breach = self._breach(state.position_m)
        if breach and not seen.breach:
            seen.breaches += 1
            seen.breach_ns = state.t_ns
            self._report(Severity.CRITICAL, f"Geofence breached: {action.name.lower()}")
            if action in MODE_OF and not seen.flight.foreign_commander:
                seen.flight.mission.abort("it left its geofence", failsafe=True)
                seen.flight.set_mode(MODE_OF[action])
        seen.breach = breach

    def _breach(self, position_m: Vector) -> int:
        (x, y, z), (home_x, home_y, home_z) = position_m, self._seen.state.home_or_here_m
        ceiling_m, radius_m = self._parameters["fence_altitude_m"], self._parameters["fence_radius_m"]
        if ceiling_m > 0 and z - home_z > ceiling_m:
            return BREACH_ALTITUDE
        near = radius_m <= 0 or math.hypot(x - home_x, y - home_y) <= radius_m
        return BREACH_NONE if near and all(shape.allows(x, y) for shape in self._shapes) else BREACH_BOUNDARY


class Circle(NamedTuple):
    """A circle that must not be left, or not be entered."""

    centre_m: Point
    radius_m: float
    inside: bool

    def allows(self, x: float, y: float) -> bool:
        return (math.hypot(x - self.centre_m[0], y - self.centre_m[1]) <= self.radius_m) == self.inside


class Polygon(NamedTuple):
    """A polygon that must not be left, or not be entered."""

    corners_m: tuple[Point, ...]
    inside: bool

    def allows(self, x: float, y: float) -> bool:
        """Return whether a point may be flown to, by the parity of the edges crossed to the east of it."""
        crossed = False
        for (x1, y1), (x2, y2) in zip(self.corners_m, (*self.corners_m[1:], self.corners_m[0]), strict=True):
            if (y1 > y) != (y2 > y) and x < x1 + (x2 - x1) * (y - y1) / (y2 - y1):
                crossed = not crossed
        return crossed == self.inside


def fence_shapes(items: Sequence[PlanItem], state: VehicleState) -> list[Circle | Polygon]:
    """Return the shapes of uploaded items; a polygon has an item for each corner."""
    shapes: list[Circle | Polygon] = []
    corners: list[Point] = []
    for item in items:
        x, y, _ = place_of(item, state)
        if item.command in (Cmd.FENCE_CIRCLE_INCLUSION, Cmd.FENCE_CIRCLE_EXCLUSION):
            shapes.append(Circle((x, y), item.params[0], item.command == Cmd.FENCE_CIRCLE_INCLUSION))
        elif item.command in (Cmd.FENCE_POLYGON_INCLUSION, Cmd.FENCE_POLYGON_EXCLUSION):
            corners.append((x, y))
            if len(corners) >= item.params[0]:
                shapes.append(Polygon(tuple(corners), item.command == Cmd.FENCE_POLYGON_INCLUSION))
                corners = []
    return shapes
