"""The engagement that a scenario's cluster asks for: its space, gains, law and plan, rehearsed before the flight."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from msgspec import UNSET

from zsim.errors import DocumentError, NotTrustedError, RunError
from zsim.scenario.scenario import Cluster, Gains, Scenario
from zsim.schema import plugin
from zsim_agents.formation.control_law import LAWS, ControlLaw, FormationGains, ProportionalLaw
from zsim_agents.formation.engagement import Engagement
from zsim_agents.formation.flight_check import all_near
from zsim_agents.formation.flight_data import EngagementLimits, GateInput
from zsim_agents.formation.flight_plan import FlightPlan, PlanError, plan_of
from zsim_agents.formation.plan_check import check_flyable
from zsim_agents.formation.robot_limits import guard, load
from zsim_agents.formation.spaces.cluster_space import ClusterSpace, closest_pair, robot_rates
from zsim_agents.formation.spaces.scenario_space import scenario_space
from zsim_agents.formation.trajectory import Hold, ramp_onto

APART_M = 2.0  # of robots in a rehearsal, any distance well above zero


def engagement_of(scenario: Scenario, cluster: Cluster) -> Engagement:
    """Return the phase machine that one of a scenario's clusters asks for.

    Raises:
        RunError: the plan can never be flown, with the reason.
    """
    with _refusals_of(scenario, cluster):
        space, gains, law = scenario_space(scenario, cluster), gains_of(cluster.gains), law_of(cluster)
        rehearse(space, gains, law)
        engagement = Engagement(space, cluster.drones, gains, limits_of(cluster.gains), plan_of(cluster), law)
        check_flyable(scenario, cluster, space, gains)
        return engagement


def check_plan(scenario: Scenario, cluster: Cluster) -> None:
    """Refuse a plan that `engagement_of` refuses; no law is rehearsed.

    Raises:
        RunError: the plan can never be flown, with the reason.
    """
    with _refusals_of(scenario, cluster):
        space = scenario_space(scenario, cluster)
        FlightPlan(space, plan_of(cluster))
        check_flyable(scenario, cluster, space, gains_of(cluster.gains))


@contextmanager
def _refusals_of(scenario: Scenario, cluster: Cluster) -> Iterator[None]:
    """Raise what is wrong with a cluster as a RunError that names it, in its plan with the path in the scenario."""
    try:
        yield
    except PlanError as error:
        raise RunError(f"clusters[{scenario.clusters.index(cluster)}].{error} (cluster {cluster.name!r})") from error
    except NotTrustedError:
        raise
    except DocumentError as error:
        raise RunError(f"cluster {cluster.name!r}: {error}") from error
    except plugin.RAISED as error:
        failure = plugin.user_code_error(error, f"cluster {cluster.name!r}, rehearsed before the flight")
        if failure is not None:
            raise failure from error
        if isinstance(error, ValueError):
            raise RunError(f"cluster {cluster.name!r}: {error}") from error
        raise


def law_of(cluster: Cluster) -> Callable[[ClusterSpace, FormationGains], ControlLaw]:
    """Return the class of the control law that a cluster names.

    Raises:
        DocumentError: a class of the user's own that cannot be loaded.
    """
    name = cluster.law or "proportional"
    return LAWS.get(name) or plugin.load(name, "law", ControlLaw, is_constructed=True)


def rehearse(
    space: ClusterSpace,
    gains: FormationGains,
    law: Callable[[ClusterSpace, FormationGains], ControlLaw] = ProportionalLaw,
) -> None:
    """Fly a gate of a formation of its own: code is compiled, or loaded, here and not in flight."""
    c = space.specimen(max(gains.separation_min_m, APART_M))
    p_W, yaw = space.inverse(c)
    c = space.forward(p_W, yaw)
    none = np.zeros((space.n, 3))
    rehearsal = Engagement(space, [f"robot {i + 1}" for i in range(space.n)], gains, law=law)
    rehearsal.warm_start("engaged", c)
    still = np.zeros(space.n)
    rehearsal.step(GateInput(0.0, p_W, yaw, none, none, still, still, ("flying",) * space.n))
    ramp_onto(space, c, c, Hold(c), 0.0, 2.0).value(1.0)
    all_near(p_W, yaw)
    closest_pair(p_W)
    guard(p_W, none, none, gains.limits)
    load(*robot_rates(space, c, c), gains.limits)


def limits_of(gains: Gains) -> EngagementLimits:
    """Return the limits of the phase machine, those of certainty as the scenario has them."""
    limits = EngagementLimits()
    if gains.sigma_max_m is not UNSET:
        limits = replace(limits, sigma_max_m=gains.sigma_max_m)
    if gains.heading_sigma_max_deg is not UNSET:
        limits = replace(limits, yaw_sigma_max_rad=math.radians(gains.heading_sigma_max_deg))
    return limits


def gains_of(gains: Gains) -> FormationGains:
    """Return the control law's gains in SI units."""
    return FormationGains(
        k_1_s=gains.proportional_1_s,
        integral_1_s2=gains.integral_1_s2,
        speed_max_m_s=gains.horizontal_speed_m_s,
        climb_max_m_s=gains.vertical_speed_m_s,
        yaw_rate_max_rad_s=math.radians(gains.yaw_rate_deg_s),
        separation_min_m=gains.separation_min_m,
        separation_alarm_m=gains.separation_alarm_m,
    )
