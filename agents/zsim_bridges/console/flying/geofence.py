"""The geofence of drones that are flown one by one from a page. Pure; axes of W.

Formations have ranges of their own, of their variables: `page/operator_input.py`.
"""

from typing import NamedTuple

from zsim.scenario.scenario import Scenario
from zsim_bridges.console.page.operator_input import HEIGHT_MAX_M, HEIGHT_MIN_M, SIDEWAYS_M

BRAKE_S = 1.0  # over which a drone comes to rest before the fence; chosen: three times the lag of its velocity loop
AXES = "xyz"


class Geofence(NamedTuple):
    """A box around the drones' starts.

    Attributes:
        low_m, high_m: corners [m; W].
    """

    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]

    def refusal(self, x_m: float, y_m: float) -> str:
        """Return why no drone may be sent to a place; empty where it may."""
        for axis, value in zip(AXES, (x_m, y_m), strict=False):
            low, high = self.low_m[AXES.index(axis)], self.high_m[AXES.index(axis)]
            if not low <= value <= high:
                return f"{axis} is {value:.1f} m, outside of the geofence: {low:g} to {high:g} m"
        return ""

    def within(self, velocity_W: tuple[float, float, float], p_W: tuple[float, float, float]) -> tuple[float, ...]:
        """Return a velocity [m/s] without what leads out: at `BRAKE_S` before the fence a drone begins to slow down.

        Args:
            velocity_W: that is wanted.
            p_W: where the drone is [m]; from beyond the fence it may come back.
        """
        return tuple(
            min(max(v, min(0.0, (low - p) / BRAKE_S)), max(0.0, (high - p) / BRAKE_S))
            for v, p, low, high in zip(velocity_W, p_W, self.low_m, self.high_m, strict=True)
        )


def geofence_of(scenario: Scenario) -> Geofence:
    """Return the fence of a scenario's drones: around all starts, and below the lowest ceiling."""
    starts = [drone.position_m for drone in scenario.drones]
    top_m = min(HEIGHT_MAX_M, *(drone.limits.altitude_m for drone in scenario.drones))
    xs, ys, _ = zip(*starts, strict=True)
    low_m = (round(min(xs)) - SIDEWAYS_M, round(min(ys)) - SIDEWAYS_M, min(HEIGHT_MIN_M, top_m / 2.0))
    high_m = (round(max(xs)) + SIDEWAYS_M, round(max(ys)) + SIDEWAYS_M, top_m)
    return Geofence(low_m, high_m)
