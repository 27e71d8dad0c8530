"""Results printed in the paper, and which flights are comparable with them, judged by their scenarios. Pure.

I. Mas, S. Curi, R. Sanchez Pena, Open-source Multi-UAV Simulator for the ROS Environment.
"""

import math
from collections.abc import Mapping

import msgspec
import numpy as np
from msgspec import UNSET

from zsim.scenario.scenario import Cluster, ClusterPlan, Drone, Scenario
from zsim.sensors.sensor_catalogue import AS_PRINTED, PRESETS, STOCK
from zsim_agents.formation.expression import Expression, ExpressionError
from zsim_agents.formation.spaces.scenario_space import cluster_space
from zsim_agents.formation.trajectory import TrajectoryError, named_values
from zsim_analysis.reading.formation import Formation, cluster_of
from zsim_analysis.reading.recorded_flight import RecordedFlight

# Table I: standard deviation of the formation parameters for Test 1 after steady state; m and rad.
PAPER_TABLE_1 = {
    "x_c": 0.11, "y_c": 0.22, "z_c": 0.13, "roll": 0.004, "pitch": 0.0025, "yaw": 0.044,
    "p": 0.032, "q": 0.035, "beta": 0.012,
}  # fmt: skip

PAPER_NOTE = (
    "With GPS errors of 2.0 m that are independent from drone to drone, the error of a distance between two "
    "drones is √6 = 2.45 times the error of a coordinate of their centroid, whatever filter each of them "
    "uses on its own. In Table I p and q are 0.15 to 0.32 times x_c and y_c. So these figures cannot be "
    "reached in truth with the set-up that the paper describes; they can be read as deviations of the "
    "estimate from the desired value, which a controller makes small even when the estimate is wrong. "
    "Compare the column est. std with the paper, and judge the flight by the columns of the truth."
)

# Equation (3): the final position of Test 1; m and rad.
TEST_1_TARGET = {
    "x_c": 5.0, "y_c": -5.0, "z_c": 15.0, "roll": 0.0, "pitch": 0.0, "yaw": math.pi / 2,
    "p": 4.0, "q": 4.0, "beta": math.pi / 4,
}  # fmt: skip
# Equation (4): the trajectory of Test 2 in t [s]; m and rad.
TEST_2_F_HZ = 0.01
TEST_2_REFERENCE = {
    "x_c": "5*cos(2*pi*f*t)",
    "y_c": "-5*(1 + 1/2*sin(4*pi*f*t))",
    "z_c": "15 + 5/2*(1 - cos(3*pi*f*t))",
    "yaw": "0.1*t",
    "p": "4",
    "q": "4",
    "beta": "pi/4",
}
COMPARED_S = (0.0, 7.0, 31.0, 88.0, 140.0)  # chosen: expressions with equal values at these times are the same
ROBOTS = 3
TOLERANCE = 1e-3  # of a target written with fewer digits
SETTLED_S, JUDGED_S = 100.0, 200.0  # from the take-off to the window, and the window: of scenarios/step.yaml
GUST_MAX_M_S = 0.5  # of scenarios/step.yaml; the paper names no wind


def paper_table_of(flight: RecordedFlight, formation: Formation, window_s: tuple[float, float]) -> Mapping[str, float]:
    """Return Table I for a formation that flew Test 1 over a complete window; empty for any other flight."""
    scenario, whole = flight.scenario, flight.completeness.complete
    faults = any(event.kind == "fault" for event in flight.events)
    if not whole or faults or scenario is None or scenario.report.window_s != window_s:
        return {}
    return paper_table(scenario, formation.name) if formation.engaged_share(window_s) == 1.0 else {}


def paper_table(scenario: Scenario, cluster: str) -> Mapping[str, float]:
    """Return Table I for a cluster whose scenario is Test 1 and lasts long enough; empty for any other."""
    own, window_s = cluster_of(scenario, cluster), scenario.report.window_s
    if own is None or window_s is None or own.plan.takeoff_s is None:
        return {}
    # the window is within the run, after the formation has settled, and as long as the paper's
    start, end = window_s
    over_s = min(scenario.duration_s, scenario.duration_s if own.plan.land_s is None else own.plan.land_s)
    is_judged = start >= own.plan.takeoff_s + SETTLED_S and end - start >= JUDGED_S and end <= over_s
    return PAPER_TABLE_1 if is_judged and _is_set_up(scenario, own) and _is_led(own) else {}


def flies_paper_test(flight: RecordedFlight, cluster: str) -> bool:
    """Return whether a cluster flew one of the paper's tests, regardless of duration and window."""
    scenario = flight.scenario
    if scenario is None or any(event.kind == "fault" for event in flight.events):
        return False
    own = cluster_of(scenario, cluster)
    return own is not None and _is_set_up(scenario, own) and (_is_led(own) or _is_along_equation_4(own.plan))


def _is_set_up(scenario: Scenario, cluster: Cluster) -> bool:
    """Return whether a cluster of three has the paper's drones and sensors, calm air and no faults."""
    wind = scenario.environment.wind
    calm = not any(wind.steady_m_s) and wind.gust_m_s <= GUST_MAX_M_S
    as_printed = all(_is_printed(scenario.drone(name)) for name in cluster.drones)
    return len(cluster.drones) == ROBOTS and calm and not scenario.faults and as_printed


def _is_along_equation_4(plan: ClusterPlan) -> bool:
    """Return whether a plan's trajectory is equivalent to equation (4)."""
    trajectory = plan.trajectory
    if trajectory is None or trajectory.waypoints or set(trajectory.expressions) != set(TEST_2_REFERENCE):
        return False
    try:
        return all(
            math.isclose(
                Expression(name, str(text), trajectory.constants)(t_s)[0],
                Expression(name, TEST_2_REFERENCE[name], {"f": TEST_2_F_HZ})(t_s)[0],
                abs_tol=TOLERANCE,
            )
            for name, text in trajectory.expressions.items()
            for t_s in COMPARED_S
        )
    except ExpressionError:
        return False  # it was refused in flight


def _is_printed(drone: Drone) -> bool:
    """Return whether a drone is an unmodified AR.Drone with the noise of the paper and no detector."""
    sensors = drone.sensors
    plain = Drone(name=drone.name, position_m=drone.position_m, yaw_deg=drone.yaw_deg, sensors=sensors)
    more = sensors.own is not UNSET or sensors.sightings is not UNSET
    over = AS_PRINTED if sensors.as_printed else {}
    printed = {
        name: msgspec.convert({**section, **over.get(name, {})}, STOCK[name].settings)
        for name, section in PRESETS["paper"].items()
    }
    return drone == plain and not more and {name: getattr(sensors, name) for name in STOCK} == printed


def _is_led(cluster: Cluster) -> bool:
    """Return whether the plan of a cluster of ROBOTS leads from the ground to equation (3)."""
    plan = cluster.plan
    if plan.takeoff_s is None or plan.trajectory is not None:
        return False
    space = cluster_space(ROBOTS)
    try:
        target = named_values(space, plan.target, "target", np.full(len(space.names), np.inf))
    except (TrajectoryError, ExpressionError):
        return False  # it was refused in flight
    wanted = [TEST_1_TARGET.get(name, np.nan) for name in space.names]
    return all(abs(target[k] - value) <= TOLERANCE for k, value in enumerate(wanted) if not np.isnan(value))
