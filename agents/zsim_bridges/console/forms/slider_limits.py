"""How far each cluster variable may be moved by hand, and in what unit a person reads it. Pure."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from zsim.scenario.scenario import Cluster, Scenario
from zsim_agents.formation.spaces.cluster_space import ClusterSpace, unit

SIDEWAYS_M = 50.0  # of the drones' starts, sideways; chosen: as far as a page shows a formation well
HEIGHT_MIN_M, HEIGHT_MAX_M = 1.0, 30.0  # chosen: clear of the ground, and what an AR.Drone's owner would still see
SIDE_MAX_M = 20.0  # of a formation; chosen
DISPLACEMENT_M = 5.0  # of a robot from its place in a template; chosen
TILT_MAX_DEG = 29.0  # of a formation; controllers take less than 30, reference_check.py
CORNER_DEG = 10.0  # least angle at a corner; at 0 and at 180 degrees robots stand in line
DIGITS = 6  # of a value as it is shown: 5.1, not 5.1000000000000005
STEPS = {"m": 0.1, "deg": 1.0}
SHOWN_MAX = 16  # variables that a page shows one by one; of more, those of the whole formation


class SliderRange(NamedTuple):
    """A variable as a person moves it.

    Attributes:
        name: of the variable.
        unit: m or deg.
        low, high, step: in that unit.
    """

    name: str
    unit: str
    low: float
    high: float
    step: float

    @property
    def label(self) -> str:
        return f"{self.name} [{self.unit}]"

    def to_display(self, value: float) -> float:
        """Return a value [m, rad] in the unit of the range, to its step, within it."""
        found = math.degrees(math.remainder(value, math.tau)) if self.unit == "deg" else value
        return min(max(round(round(found / self.step) * self.step, DIGITS), self.low), self.high)

    def to_si(self, shown: float) -> float:
        """Return the value [m, rad] of what is shown."""
        return math.radians(shown) if self.unit == "deg" else shown

    def refusal(self, shown: float) -> str | None:
        """Return why a value may not be asked for, None if it may."""
        if not self.low <= shown <= self.high:
            return f"{self.name} is {shown:g} {self.unit}; must be from {self.low:g} to {self.high:g}"
        return None


def slider_ranges(space: ClusterSpace, cluster: Cluster, scenario: Scenario) -> list[SliderRange]:
    """Return the ranges of all variables of a formation, in their order."""
    starts = [scenario.drone(name).position_m for name in cluster.drones]
    top_m = min(HEIGHT_MAX_M, *(scenario.drone(name).limits.altitude_m for name in cluster.drones))
    centre = [sum(p[axis] for p in starts) / len(starts) for axis in range(2)]
    apart_m = max(cluster.gains.separation_min_m, STEPS["m"])
    side = (apart_m, max(SIDE_MAX_M, 2.0 * apart_m))
    bounds = {
        "x_c": (round(centre[0]) - SIDEWAYS_M, round(centre[0]) + SIDEWAYS_M),
        "y_c": (round(centre[1]) - SIDEWAYS_M, round(centre[1]) + SIDEWAYS_M),
        "z_c": (min(HEIGHT_MIN_M, top_m / 2.0), top_m),
        **dict.fromkeys(("p", "q", "rho"), side),
        **dict.fromkeys(("roll", "pitch", "elevation"), (-TILT_MAX_DEG, TILT_MAX_DEG)),
        "beta": (CORNER_DEG, 180.0 - CORNER_DEG),
    }
    return [_range(name, bounds) for name in space.names]


def _range(name: str, bounds: dict[str, tuple[float, float]]) -> SliderRange:
    shown_in = "deg" if unit(name) == "rad" else "m"
    whole = (-180.0, 180.0) if shown_in == "deg" else (-DISPLACEMENT_M, DISPLACEMENT_M)
    stem = name.rpartition(".")[2].rstrip("0123456789").rstrip("_")
    low, high = bounds.get(name) or bounds.get(stem) or whole
    return SliderRange(name, shown_in, float(low), float(high), STEPS[shown_in])


def primary_variables(names: Sequence[str]) -> list[str]:
    """Return the variables that a page shows one by one: all of few; of many, those of the whole formation."""
    whole = ("x_c", "y_c", "z_c", "roll", "pitch", "yaw", "p", "q", "beta")
    return list(names) if len(names) <= SHOWN_MAX else [name for name in names if name in whole]
