"""Drones whose bodies are external: what a run with them needs, and what a driver may publish of one.

Between two poses a drone is moved on with its velocity; the world and cameras do so alike.
"""

import math
from collections.abc import Sequence

from zsim.contract.flight_messages import Truth
from zsim.errors import ScenarioError
from zsim.scenario.rights import DRIVER
from zsim.scenario.scenario import Scenario
from zsim.schema.checker import listed

POSE_AGE_MAX_NS = 500_000_000  # contract; 25 gates, as an estimate that is flown on: 1 m at 2 m/s
DISTANCE_MAX_M = 100_000.0  # of each coordinate, as places in a scenario: beyond it a tangent plane is no map
SPEED_MAX_M_S = 200.0  # chosen: twice the fastest racing drones
RATE_MAX_RAD_S = 100.0  # chosen: twice what a gyroscope of 2000 deg/s measures, and more
UNIT_SLACK = 0.01  # of a quaternion's length; single precision is within 1e-6


def moved_on(p_W: Sequence[float], v_W: Sequence[float], age_ns: int) -> tuple[float, float, float]:
    """Return where a drone is of which nothing has come for so long: at constant velocity, then at rest [m; W]."""
    age_s = min(max(0, age_ns), POSE_AGE_MAX_NS) * 1e-9
    x, y, z = (p + v * age_s for p, v in zip(p_W, v_W, strict=True))
    return x, y, z


def truth_fault(truth: Truth, rotors: int) -> str | None:
    """Return what is absurd about a truth whose numbers are finite, None if nothing is."""
    limits = (
        ("position_m", DISTANCE_MAX_M, "m"),
        ("velocity_m_s", SPEED_MAX_M_S, "m/s"),
        ("angular_velocity_rad_s", RATE_MAX_RAD_S, "rad/s"),
    )
    for name, most, unit in limits:
        values: Sequence[float] = getattr(truth, name)
        if max(map(abs, values)) > most:
            return f"{name} is {_shown(values)}; each must be within {most:g} {unit}"
    if abs(math.hypot(*truth.orientation_wxyz) - 1.0) > UNIT_SLACK:
        return f"orientation_wxyz is {_shown(truth.orientation_wxyz)}; must be a quaternion of length 1"
    if len(truth.rotor_rad_s) != rotors:
        return f"rotor_rad_s has {len(truth.rotor_rad_s)} speeds; must have {rotors}, as the drone has rotors"
    return None


def _shown(values: Sequence[float]) -> str:
    return f"[{', '.join(f'{value:g}' for value in values)}]"


def check_pace(scenario: Scenario, mode: str) -> None:
    """Refuse to run external drones, whose time is the wall's, otherwise than in realtime.

    Raises:
        ScenarioError: the scenario has some, and the mode is not "realtime".
    """
    external = scenario.external()
    if external and mode != "realtime":
        who = f"{listed(external)} {'is' if len(external) == 1 else 'are'} external"
        needed = "time passes there as on the wall: run it with --realtime, on processes of its own"
        raise ScenarioError([f"{scenario.name}: body of {who}, and the run is in {mode}; {needed}"])


def drivers_of(scenario: Scenario) -> list[str]:
    """Return the names of the processes that publish the external drones."""
    return [f"{DRIVER}.{drone}" for drone in scenario.external()]


def driver_lines(scenario: Scenario, endpoint: str) -> list[str]:
    """Return what to tell whoever starts a run of the drivers that are to be started beside it; a line, or none."""
    drivers, expected = drivers_of(scenario), scenario.expected()
    awaited, others = (listed([d for d in drivers if (d in expected) is wanted]) for wanted in (True, False))
    waits = [f"the run waits for {awaited}"] if awaited else []
    waits += [f"{others} may come at any time"] if others else []
    return [f"external drones: {', and '.join(waits)}; start drivers with --connect {endpoint}"] if drivers else []
