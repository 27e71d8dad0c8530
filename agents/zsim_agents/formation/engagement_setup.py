"""Builds the engagement of a scenario's cluster from space, gains, law and plan, and rehearses it before the flight.

A plan is checked before the flight, from the drones' start positions. It is refused if the guidance would certainly
refuse it throughout the flight (if it is too fast, the text gives the factor by which to stretch its times), or if it
ends before any formation could start it. Limits are slightly wider than in flight, since the formation is never exactly
at its start position; the guidance decides on cases in between, twice a second while the formation hovers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from msgspec import UNSET

from zsim.errors import DocumentError, NotTrustedError, RunError
from zsim.scenario.scenario import Cluster, Gains, Scenario
from zsim.schema import parameters, plugin
from zsim_agents.formation.assembly import assembly_goal, planned_assembly
from zsim_agents.formation.control_law import (
    LAWS,
    ControlLaw,
    FormationGains,
    RobotLimits,
    granted,
    grants_of,
    guard,
    load,
)
from zsim_agents.formation.engagement import Engagement
from zsim_agents.formation.flight_check import (
    ASSEMBLY_HEIGHT_M,
    SHAPE,
    SHAPE_IN_FLIGHT,
    EngagementLimits,
    GateInput,
    all_near,
    formation_fault,
    shape_fault,
)
from zsim_agents.formation.flight_plan import REFUSALS, Assemble, FlightPlan, Follow, MoveTo, PlanError, plan_of
from zsim_agents.formation.guidance import HORIZON_S, LOAD_TOLERANCE, RampPlanner
from zsim_agents.formation.spaces.cluster_space import (
    Array,
    ClusterSpace,
    SingularClusterError,
    closest_pair,
    robot_rates,
)
from zsim_agents.formation.spaces.scenario_space import scenario_space
from zsim_agents.formation.trajectory import Hold, Reference, Shifted, ramp_onto

SEPARATION_M = 2.0  # distance between robots in a rehearsal; any value well above zero
READY_S = 3.0  # minimum time from the take-off order to hovering drones and engagement; AR.Drones take 4 to 12 s
SPEED_SLACK = 1.05  # factor on the speed limits; design choice: positions in the formation are off by some centimetres
PATH_SLACK = 1.25  # factor on a path from the start; design choice: its length changes as drones drift during the climb
SEPARATION_SLACK = 0.9  # factor on the minimum separation and height; design choice, for the same reasons
STEP_S, STEPS_MIN, STEPS_MAX = 0.1, 41, 3001  # sampling of a checked reference


def engagement_of(scenario: Scenario, cluster: Cluster) -> Engagement:
    """Return the engagement of a cluster; RunError: its plan can never be flown."""
    with _refusals_of(scenario, cluster):
        space, gains = scenario_space(scenario, cluster), gains_of(cluster.gains)
        name = cluster.law or "proportional"
        law = LAWS.get(name) or plugin.load(name, "law", ControlLaw, is_constructed=True)
        law = parameters.bound(law, cluster.law_parameters, "law_parameters")
        if plugin.is_own(law):
            law = granted(law, grants_of(cluster, scenario.environment))
        _rehearse(space, cluster.drones, gains, law)
        limits = EngagementLimits()
        if cluster.gains.sigma_max_m is not UNSET:
            limits = replace(limits, sigma_max_m=cluster.gains.sigma_max_m)
        if cluster.gains.heading_sigma_max_deg is not UNSET:
            limits = replace(limits, yaw_sigma_max_rad=math.radians(cluster.gains.heading_sigma_max_deg))
        engagement = Engagement(space, cluster.drones, gains, limits, plan_of(cluster), law)
        _check_flyable(scenario, cluster, space, gains)
        return engagement


def check_plan(scenario: Scenario, cluster: Cluster) -> None:
    """Raise RunError for a plan that `engagement_of` would refuse, without rehearsing the law."""
    with _refusals_of(scenario, cluster):
        space = scenario_space(scenario, cluster)
        FlightPlan(space, plan_of(cluster))
        _check_flyable(scenario, cluster, space, gains_of(cluster.gains))


class PlannedMotion(NamedTuple):
    """The last reference of a plan, its earliest start `from_s`, and its end `until_s`: landing or the run's end."""

    space: ClusterSpace
    reference: Reference
    from_s: float
    until_s: float
    path: str  # path in the cluster's section of the scenario

    def positions(self, t_s: float) -> Array:
        """Return the reference positions of the robots, (n, 3) [m; W]."""
        return self.space.inverse(self.reference.value(t_s)[0])[0]


def planned_motion(scenario: Scenario, cluster: Cluster) -> PlannedMotion | None:
    """Return the last target or trajectory of a valid plan; None if it has neither.

    Raises:
        RunError: as in `check_plan`.
    """
    plan, motion = cluster.plan, None
    with _refusals_of(scenario, cluster):
        space, gains = scenario_space(scenario, cluster), gains_of(cluster.gains)
        p_W, yaw = _hovers(scenario, cluster)
        start, ready_s = _formation_at(space, p_W, yaw), (plan.takeoff_s or 0.0) + READY_S
        goal = np.zeros(space.size) if start is None else np.where(space.neutral, 0.0, start)
        until_s = scenario.duration_s if plan.land_s is None else min(plan.land_s, scenario.duration_s)
        for step in plan_of(cluster):
            request = step.request
            try:
                if isinstance(request, Assemble):
                    start = goal = assembly_goal(space, request.values, None if start is None else goal, p_W, yaw)
                    ready_s = (
                        max(ready_s, step.at_s) + planned_assembly(space, goal, p_W, gains, SEPARATION_SLACK)[0].over_s
                    )
                    p_W, yaw = space.inverse(goal)
                elif isinstance(request, MoveTo | Follow) and start is not None:
                    if isinstance(request, MoveTo):
                        goal = request.goal(space, goal)
                        reference: Reference = Hold(goal)
                    else:
                        reference = Shifted(request.trajectory(space, goal), request.start_s or 0.0)
                    rest = np.zeros_like(start)
                    over_s = RampPlanner(space, gains, SHAPE).fastest((start, rest), reference, ready_s).over_s
                    begin_s = max(ready_s + over_s, reference.start_s if isinstance(reference, Shifted) else 0.0)
                    motion = PlannedMotion(space, reference, begin_s, until_s, step.path)
            except REFUSALS as error:
                raise PlanError(f"{step.path}: {error}") from None
    return motion


def _hovers(scenario: Scenario, cluster: Cluster) -> tuple[Array, Array]:
    """Return the positions of the drones after their climb (n, 3) [m; W], and their headings (n,) [rad]."""
    drones = [scenario.drone(name) for name in cluster.drones]
    p_W = np.array([drone.position_m for drone in drones], float)
    p_W[:, 2] += ASSEMBLY_HEIGHT_M
    return p_W, np.radians([drone.yaw_deg for drone in drones])


@contextmanager
def _refusals_of(scenario: Scenario, cluster: Cluster) -> Iterator[None]:
    """Re-raise faults as a RunError that names the cluster and, for faults in its plan, the path in the scenario."""
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


def _rehearse(
    space: ClusterSpace,
    drones: Sequence[str],
    gains: FormationGains,
    law: Callable[[ClusterSpace, FormationGains], ControlLaw],
) -> None:
    """Step a separate engagement by one gate, so that all code is compiled or loaded before the flight."""
    p_W, yaw = space.inverse(space.specimen(max(gains.separation_min_m, SEPARATION_M)))
    c, zero_vectors, zeros = space.forward(p_W, yaw), np.zeros((space.n, 3)), np.zeros(space.n)
    rehearsal = Engagement(space, drones, gains, law=law)
    rehearsal.warm_start("engaged", c)
    rehearsal.step(GateInput(0.0, p_W, yaw, zero_vectors, zero_vectors, zeros, zeros, ("flying",) * space.n))
    ramp_onto(space, c, c, Hold(c), 0.0, 2.0).value(1.0)
    all_near(p_W, yaw)
    closest_pair(p_W)
    guard(p_W, zero_vectors, zero_vectors, gains.limits)
    load(*robot_rates(space, c, c), gains.limits)


def gains_of(gains: Gains) -> FormationGains:
    return FormationGains(
        k_1_s=gains.proportional_1_s,
        integral_1_s2=gains.integral_1_s2,
        speed_max_m_s=gains.horizontal_speed_m_s,
        climb_max_m_s=gains.vertical_speed_m_s,
        yaw_rate_max_rad_s=math.radians(gains.yaw_rate_deg_s),
        separation_min_m=gains.separation_min_m,
        separation_alarm_m=gains.separation_alarm_m,
    )


def _check_flyable(scenario: Scenario, cluster: Cluster, space: ClusterSpace, gains: FormationGains) -> None:
    """Raise PlanError for a plan that these drones cannot fly.

    The paths of a plan without assemblies are not checked if the drones do not start in a valid formation.
    """
    plan = cluster.plan
    assembles = plan.assemblies is not UNSET
    if plan.takeoff_s is None or not (plan.target or plan.trajectory or assembles):
        return
    ready_s = plan.takeoff_s + READY_S
    begins_s = max(ready_s, plan.trajectory.start_s) if plan.trajectory else ready_s
    if plan.land_s is not None and plan.land_s < begins_s:
        kind = "trajectory" if plan.trajectory else "target"
        reason = f"the {kind} of the plan begins at {begins_s:g} s at the earliest"
        raise PlanError(f"plan.land_s is {plan.land_s:g}; must be later: {reason}")
    p_W, yaw = _hovers(scenario, cluster)
    start = _formation_at(space, p_W, yaw)
    if start is None and not assembles:
        return
    rehearsal = _Rehearsal(scenario, cluster, space, gains)
    goal = np.zeros(space.size) if start is None else np.where(space.neutral, 0.0, start)
    for step in plan_of(cluster):
        request = step.request
        try:
            if isinstance(request, Assemble):
                base = None if start is None else goal
                start = goal = assembly_goal(space, request.values, base, p_W, yaw)
                planned_assembly(space, goal, p_W, gains, SEPARATION_SLACK)
                p_W, yaw = space.inverse(goal)
            elif start is None:
                continue  # the take-off order, before any formation exists
            elif isinstance(request, MoveTo):
                goal = request.goal(space, goal)
                rehearsal.check_target(start, goal, None if plan.trajectory else request.over_s)
            elif isinstance(request, Follow):
                begin_s = request.start_s or 0.0
                rehearsal.check_trajectory(start, request.trajectory(space, goal), begin_s, ready_s)
        except REFUSALS as error:
            raise PlanError(f"{step.path}: {error}") from None


def _formation_at(space: ClusterSpace, p_W: Array, yaw: Array) -> Array | None:
    """Return the cluster variables (4n,) of the robots; None if their formation cannot be engaged."""
    try:
        c = space.forward(p_W, yaw)
        return None if shape_fault(space, c, SHAPE) else c
    except SingularClusterError:
        return None


class _Rehearsal:
    """Checks the paths of a plan against the limits of formation, controller and drones."""

    def __init__(self, scenario: Scenario, cluster: Cluster, space: ClusterSpace, gains: FormationGains) -> None:
        self._space, self._share = space, SHAPE.share
        self._drones = [(name, scenario.drone(name).limits) for name in cluster.drones]
        drone_limits = [each for _, each in self._drones]
        self._limits: RobotLimits = gains.limits._replace(
            speed_max_m_s=min(gains.speed_max_m_s, *(each.horizontal_speed_m_s for each in drone_limits)),
            climb_max_m_s=min(gains.climb_max_m_s, *(each.vertical_speed_m_s for each in drone_limits)),
            yaw_rate_max_rad_s=min(gains.yaw_rate_max_rad_s, *(math.radians(e.yaw_rate_deg_s) for e in drone_limits)),
        )
        relaxed = replace(gains, separation_min_m=SEPARATION_SLACK * gains.separation_min_m)
        self._relaxed = relaxed, replace(SHAPE_IN_FLIGHT, height_min_m=SEPARATION_SLACK * SHAPE.height_min_m)
        self._exact = gains, SHAPE
        self._planner = RampPlanner(space, gains, SHAPE)

    def check_target(self, start: Array, goal: Array, over_s: float | None) -> None:
        """Refuse a target that is not allowed or too far for its duration; TrajectoryError: it is out of reach."""
        if fault := self._fault_at(goal):
            raise PlanError(f"plan.target: {fault}")
        home, rest = Hold(goal), np.zeros_like(start)
        if over_s is None:
            self._planner.fastest((start, rest), home, 0.0)
            return
        peak, _ = self._peak(ramp_onto(self._space, start, rest, home, 0.0, over_s), 0.0, over_s)
        if peak > PATH_SLACK * LOAD_TOLERANCE * self._share:
            factor = peak / self._share
            raise PlanError(
                f"plan.target_over_s is {over_s:g}; must be {factor:.2g} times as long, {factor * over_s:.1f} s or "
                f"more, for a robot to need at most {self._share:g} times its speed limits"
            )

    def check_trajectory(self, start: Array, trajectory: Reference, start_s: float, ready_s: float) -> None:
        """Refuse a trajectory that is too fast, leads through a forbidden state or ends too soon."""
        length_s = trajectory.duration_s
        end_s = start_s + (math.inf if length_s is None else length_s)
        if end_s <= ready_s:
            reason = f"a formation is engaged at {ready_s:g} s at the earliest, {READY_S:g} s after its take-off"
            raise PlanError(f"plan.trajectory is over at {end_s:g} s; must start later: {reason}")
        from_s = max(0.0, ready_s - start_s)
        to_s = min(from_s + HORIZON_S, math.inf if length_s is None else length_s)
        peak, peak_s = self._peak(trajectory, from_s, to_s)
        if peak > SPEED_SLACK * LOAD_TOLERANCE * self._share:
            factor = peak / self._share
            raise PlanError(
                f"plan.trajectory needs {peak:.2f} times the speed limits of a robot {peak_s:.1f} s after its start; "
                f"must be at most {self._share:g} times: stretch its times by {factor:.2f}"
            )
        for t_s in _instants(from_s, to_s):
            if fault := self._fault_at(trajectory.value(t_s)[0]):
                raise PlanError(f"plan.trajectory: {t_s:.1f} s after its start {fault}")
        ramp = self._planner.fastest((start, np.zeros_like(start)), Shifted(trajectory, start_s), ready_s)
        arrival_s = ready_s + ramp.over_s
        if end_s < math.inf and arrival_s > ready_s + PATH_SLACK * (end_s - ready_s):
            reason = f"the formation does not reach it before {arrival_s:.0f} s"
            raise PlanError(f"plan.trajectory is over at {end_s:g} s; must start later: {reason}")

    def _peak(self, reference: Reference, from_s: float, to_s: float) -> tuple[float, float]:
        """Return the maximum share of a robot's speed limits used along a reference, and the time of this peak [s]."""
        return max(
            (load(*robot_rates(self._space, *reference.value(t_s)), self._limits), t_s)
            for t_s in _instants(from_s, to_s)
        )

    def _fault_at(self, c: Array) -> str | None:
        space = self._space
        if formation_fault(space, c, *self._relaxed):
            return formation_fault(space, c, *self._exact)
        heights_m = space.inverse(c)[0][:, 2].tolist()
        for (name, limits), height_m in zip(self._drones, heights_m, strict=True):
            if height_m > limits.altitude_m:
                return f"{name} is at z = {height_m:.1f} m; allowed: {limits.altitude_m:g} m, its limits.altitude_m"
        return None


def _instants(from_s: float, to_s: float) -> list[float]:
    count = min(max(math.ceil((to_s - from_s) / STEP_S) + 1, STEPS_MIN), STEPS_MAX)
    return np.linspace(from_s, to_s, count).tolist()
