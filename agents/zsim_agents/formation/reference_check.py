"""What a reference must keep before robots follow it, and the ramps that keep it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from zsim.math.compiled import COMPILES, portable
from zsim_agents.formation.formation_law import FormationGains, load
from zsim_agents.formation.spaces.cluster_space import (
    Array,
    ClusterSpace,
    SingularClusterError,
    closest_pair,
    least_distance,
    robot_rates,
)
from zsim_agents.formation.trajectory import Ramp, Reference, Shifted, TrajectoryError, ramp_onto

SAMPLE_S = 0.5  # at 2 m/s a robot moves 1 m between two samples
SAMPLES_MIN, SAMPLES_MAX = 41, 301
HORIZON_S = 600.0  # how far an endless trajectory is checked before; the rest is checked while it is flown
RAMP_MIN_S, RAMP_MAX_S = 2.0, 3600.0
RAMP_GROWTH = 1.2  # least step of the search for a ramp that is slow enough
RAMP_SAMPLES = 33  # odd: one falls on the peak rate of a ramp, its middle
LOAD_TOLERANCE = 1.02  # of the share: ramps are sampled, and one may start at the limit
FAR = 1e6  # m or rad: beyond it a value is a slip


@dataclass(frozen=True)
class ShapeLimits:
    """Where a formation may be engaged, and where a reference may lead it.

    Attributes:
        spread_min_m: least height of the shape.
        tilt_max_rad: greatest roll and pitch of the formation.
        condition_max: greatest condition number of J^-1.
        height_min_m: least height of a robot's reference over the ground, z_W = 0.
        share: share of the robots' speed limits that a reference may use; the law keeps the rest.
    """

    spread_min_m: float = 1.0  # chosen: five sigma of a side's estimate keep robots out of one line
    tilt_max_rad: float = math.radians(30.0)  # chosen: far from the 90 deg where Euler angles fail
    condition_max: float = 20.0  # chosen: beyond it a small motion in cluster space is a large one of a robot
    height_min_m: float = 0.5  # chosen: five rotor radii, above most of the ground effect
    share: float = 0.8  # chosen


def shape_fault(space: ClusterSpace, c: Array, limits: ShapeLimits, spread: float | None = None) -> str | None:
    """Return why c is no formation to engage or to lead to, or None; names quantity, value and limit.

    Args:
        spread: of c, where it is known.
    """
    outside = first_outside(c, space.bounds)
    if outside >= 0:
        return _value_fault(space, c, outside)
    spread = space.spread(c) if spread is None else spread
    if spread <= limits.spread_min_m:
        return f"{space.spread_text} is {spread:.2f} m; allowed: above {limits.spread_min_m:g} m"
    for k in space.tilts:
        if abs(c[k]) >= limits.tilt_max_rad:
            found, most = math.degrees(c[k]), math.degrees(limits.tilt_max_rad)
            return f"{space.names[k]} of the formation is {found:.1f} deg; allowed: below {most:g} deg either way"
    condition = space.condition(c) if math.isfinite(limits.condition_max) else 0.0
    if not condition < limits.condition_max:
        return f"condition number of J^-1 is {condition:.1f}; allowed: below {limits.condition_max:g}"
    return None


def bounds_of(space: ClusterSpace, limits: ShapeLimits) -> Array:
    """Return the open bounds (4n, 2) of variables of which `shape_fault` finds none at fault, but for the condition."""
    bounds = space.bounds.copy()
    for k in space.tilts:
        bounds[k, 0] = max(bounds[k, 0], -limits.tilt_max_rad)
        bounds[k, 1] = min(bounds[k, 1], limits.tilt_max_rad)
    return bounds


@portable
def first_outside(c: Array, bounds: Array) -> int:
    """Return the place of the first variable of c that is beyond FAR or its open bounds (4n, 2), or -1."""
    for k in range(c.size):
        if not (abs(c[k]) < FAR and bounds[k, 0] < c[k] < bounds[k, 1]):  # also true for NaN
            return k
    return -1


def _value_fault(space: ClusterSpace, c: Array, k: int) -> str:
    name, value, (low, high) = space.names[k], float(c[k]), space.bounds[k].tolist()
    if not abs(value) < FAR:
        return f"{name} is {value:g}; allowed: up to {FAR:g}"
    return f"{name} is {value:.3g}; allowed: between {low:.3g} and {high:.3g}"


def place_fault(space: ClusterSpace, c: Array, gains: FormationGains, limits: ShapeLimits) -> str | None:
    """Return why the robots may not stand where c puts them (too near to each other, too low), or None."""
    p_W, _ = space.inverse(c)
    if COMPILES and well_placed(p_W, gains.separation_min_m, limits.height_min_m):
        return None
    distance, i, j = closest_pair(p_W)
    if distance < gains.separation_min_m:
        pair = f"robots {i + 1} and {j + 1}"
        return f"{pair} are {distance:.3f} m apart; allowed: {gains.separation_min_m:g} m or more"
    heights = p_W[:, 2].tolist()
    lowest = min(heights)
    if lowest < limits.height_min_m:
        low = heights.index(lowest)
        return f"robot {low + 1} is at z = {lowest:.2f} m; allowed: {limits.height_min_m:g} m or more"
    return None


@portable
def well_placed(p_W: Array, separation_min_m: float, height_min_m: float) -> bool:
    """Return whether robots at p_W (n, 3) are neither too near to each other nor too low."""
    fit = least_distance(p_W)[0] >= separation_min_m
    for i in range(p_W.shape[0]):
        fit = fit and p_W[i, 2] >= height_min_m
    return fit


def reference_fault(
    space: ClusterSpace,
    reference: Reference,
    from_s: float,
    to_s: float,
    gains: FormationGains,
    limits: ShapeLimits,
) -> str | None:
    """Return why a reference may not be flown from from_s to to_s, or None; sampled 41 to 301 times."""
    count = min(max(math.ceil((to_s - from_s) / SAMPLE_S) + 1, SAMPLES_MIN), SAMPLES_MAX)
    count = count if to_s > from_s else 1
    for t_s in np.linspace(from_s, to_s, count).tolist():
        fault = _fault_at(space, *reference.value(t_s), gains, limits)
        if fault:
            return f"{t_s - from_s:.1f} s after its start {fault}" if t_s > from_s else fault
    return None


def plan_ramp(
    space: ClusterSpace,
    start: tuple[Array, Array],
    onto: Reference,
    start_s: float,
    gains: FormationGains,
    limits: ShapeLimits,
    over_s: float | None = None,
) -> Ramp:
    """Return the ramp from start (c, c_dot) onto a reference; without over_s as fast as the limits let it.

    The ramp and what follows it (600 s of it at most) are checked.

    Raises:
        TrajectoryError: too fast, too far, or it leads through a place that is not allowed.
    """
    from_s = max(start_s, onto.start_s) if isinstance(onto, Shifted) else start_s
    end_s = min(math.inf if onto.duration_s is None else onto.duration_s, from_s + HORIZON_S)
    try:
        fault = reference_fault(space, onto, from_s, max(from_s, end_s), gains, limits)
        if fault:
            raise TrajectoryError(f"the reference is not allowed: {fault}")
        ramp = fastest_ramp(space, start, onto, start_s, gains, limits)
        if over_s is not None:
            ramp = _ramp_over(space, start, onto, start_s, gains, limits, over_s, ramp.over_s)
        fault = reference_fault(space, ramp, start_s, start_s + ramp.over_s, gains, limits)
    except SingularClusterError as error:
        raise TrajectoryError(f"the way is singular: {error}") from None
    if fault:
        raise TrajectoryError(f"the way is not allowed: {fault}")
    return ramp


def fastest_ramp(
    space: ClusterSpace,
    start: tuple[Array, Array],
    onto: Reference,
    start_s: float,
    gains: FormationGains,
    limits: ShapeLimits,
) -> Ramp:
    """Return the ramp that uses the limits; its way is not checked.

    Raises:
        TrajectoryError: it would take longer than an hour.
    """
    over_s = RAMP_MIN_S
    while over_s <= RAMP_MAX_S:
        ramp = ramp_onto(space, *start, onto, start_s, over_s)
        excess = _peak_load(space, ramp, gains) / limits.share
        if excess <= LOAD_TOLERANCE:
            return ramp
        over_s *= max(min(excess, 10.0), RAMP_GROWTH)
    raise TrajectoryError(f"not reached within {RAMP_MAX_S:g} s at the robots' limits: too far, or it moves too fast")


def _ramp_over(
    space: ClusterSpace,
    start: tuple[Array, Array],
    onto: Reference,
    start_s: float,
    gains: FormationGains,
    limits: ShapeLimits,
    over_s: float,
    least_s: float,
) -> Ramp:
    if 0.0 < over_s <= RAMP_MAX_S:
        ramp = ramp_onto(space, *start, onto, start_s, over_s)
        if _peak_load(space, ramp, gains) <= limits.share * LOAD_TOLERANCE:
            return ramp
    raise TrajectoryError(f"over_s is {over_s:g} s; allowed at the robots' limits: {least_s:.1f} s to {RAMP_MAX_S:g} s")


def _peak_load(space: ClusterSpace, ramp: Ramp, gains: FormationGains) -> float:
    times = np.linspace(ramp.start_s, ramp.start_s + ramp.over_s, RAMP_SAMPLES).tolist()
    return max(load(*robot_rates(space, *ramp.value(t_s)), gains) for t_s in times)


def _fault_at(space: ClusterSpace, c: Array, c_dot: Array, gains: FormationGains, limits: ShapeLimits) -> str | None:
    fault = shape_fault(space, c, limits) or place_fault(space, c, gains, limits)
    if fault:
        return fault
    share = load(*robot_rates(space, c, c_dot), gains)
    if share > limits.share * LOAD_TOLERANCE:
        return f"a robot moves at {share:.2f} of its limits; allowed: {limits.share:g}"
    return None
