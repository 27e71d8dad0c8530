"""What the paper printed of its Test 1, and which flights stand beside it: by what they flew, not by a name. Pure.

I. Mas, S. Curi, R. Sanchez Pena, Open-source Multi-UAV Simulator for the ROS Environment.
"""

import math
from collections.abc import Mapping

import msgspec
import numpy as np
from msgspec import UNSET

from zsim.scenario.scenario import Cluster, ClusterPlan, Drone, Scenario
from zsim.sensors.sensor import Sensor
from zsim.sensors.sensor_catalogue import AS_PRINTED, PRESETS, STOCK
from zsim_agents.formation.expression import ExpressionError
from zsim_agents.formation.spaces.scenario_space import cluster_space
from zsim_agents.formation.variable_values import TrajectoryError, named_values
from zsim_analysis.reading.formation import Formation
from zsim_analysis.reading.recorded_flight import RecordedFlight

# Table I: standard deviation of the formation parameters for Test 1 after steady state; m and rad.
PAPER_TABLE_1 = {
    "x_c": 0.11,
    "y_c": 0.22,
    "z_c": 0.13,
    "roll": 0.004,
    "pitch": 0.0025,
    "yaw": 0.044,
    "p": 0.032,
    "q": 0.035,
    "beta": 0.012,
}

PAPER_NOTE = (
    "With GPS errors of 2.0 m that are independent from drone to drone, the error of a distance between two "
    "drones is √6 = 2.45 times the error of a coordinate of their centroid, whatever filter each of them "
    "uses on its own. In Table I p and q are 0.15 to 0.32 times x_c and y_c. So these figures cannot be "
    "reached in truth with the set-up that the paper describes; they can be read as deviations of the "
    "estimate from the desired value, which a controller makes small even when the estimate is wrong. "
    "Compare the column est. std with the paper, and judge the flight by the columns of the truth."
)

# Equation (3): the final position that Test 1 regulates to; m and rad.
TEST_1_TARGET = {
    "x_c": 5.0,
    "y_c": -5.0,
    "z_c": 15.0,
    "roll": 0.0,
    "pitch": 0.0,
    "yaw": math.pi / 2,
    "p": 4.0,
    "q": 4.0,
    "beta": math.pi / 4,
}
ROBOTS = 3
TOLERANCE = 1e-3  # of a target that is written with fewer digits
SETTLED_S, JUDGED_S = 100.0, 200.0  # from the take-off to the window, and the window: of scenarios/step.yaml
GUST_MAX_M_S = 0.5  # of scenarios/step.yaml; the paper names no wind


def paper_table_of(flight: RecordedFlight, formation: Formation, window_s: tuple[float, float]) -> Mapping[str, float]:
    """Return Table I for a formation that flew Test 1 over a whole window of it; empty for any other flight."""
    scenario, whole = flight.scenario, flight.completeness.complete
    faults = any(event.kind == "fault" for event in flight.events)
    if not whole or faults or scenario is None or scenario.report.window_s != window_s:
        return {}
    return paper_table(scenario, formation.name) if formation.engaged_share(window_s) == 1.0 else {}


def paper_table(scenario: Scenario, cluster: str) -> Mapping[str, float]:
    """Return Table I for a cluster that a scenario sends to fly Test 1, for long enough; empty for any other one."""
    flies = any(each.name == cluster and _is_test_1(scenario, each) for each in scenario.clusters)
    return PAPER_TABLE_1 if flies else {}


def _is_test_1(scenario: Scenario, cluster: Cluster) -> bool:
    wind = scenario.environment.wind
    calm = not any(wind.steady_m_s) and wind.gust_m_s <= GUST_MAX_M_S
    members = [scenario.drone(name) for name in cluster.drones]
    as_printed = all(_is_printed(drone) for drone in members)
    return calm and not scenario.faults and as_printed and _is_judged(scenario, cluster.plan) and _is_led(cluster)


def _is_printed(drone: Drone) -> bool:
    """Return whether a drone is an AR.Drone as it stands, with the noise of the paper and no detector."""
    sensors = drone.sensors
    plain = Drone(name=drone.name, position_m=drone.position_m, yaw_deg=drone.yaw_deg, sensors=sensors)
    more = sensors.own is not UNSET or sensors.sightings is not UNSET
    noise = {name: getattr(sensors, name) for name in STOCK}
    return drone == plain and not more and noise == _printed(sensors.as_printed)


def _printed(as_printed: bool) -> dict[str, Sensor]:
    """Return the settings of the paper's sensors by name."""
    over = AS_PRINTED if as_printed else {}
    sections = {name: {**section, **over.get(name, {})} for name, section in PRESETS["paper"].items()}
    return {name: msgspec.convert(section, STOCK[name].settings) for name, section in sections.items()}


def _is_judged(scenario: Scenario, plan: ClusterPlan) -> bool:
    """Return whether the window lies in the run, after the formation has settled, and is as long as the paper's."""
    window_s = scenario.report.window_s
    if window_s is None or plan.takeoff_s is None:
        return False
    start, end = window_s
    over_s = min(scenario.duration_s, scenario.duration_s if plan.land_s is None else plan.land_s)
    return start >= plan.takeoff_s + SETTLED_S and end - start >= JUDGED_S and end <= over_s


def _is_led(cluster: Cluster) -> bool:
    """Return whether a cluster of three drones is led from the ground to equation (3)."""
    plan = cluster.plan
    if len(cluster.drones) != ROBOTS or plan.takeoff_s is None or plan.trajectory is not None:
        return False
    space = cluster_space(ROBOTS)
    try:
        target = named_values(space, plan.target, "target", np.full(len(space.names), np.inf))
    except (TrajectoryError, ExpressionError):
        return False  # it was refused in flight
    wanted = [TEST_1_TARGET.get(name, np.nan) for name in space.names]
    return all(abs(target[k] - value) <= TOLERANCE for k, value in enumerate(wanted) if not np.isnan(value))
