"""Whether a formation may take off, be engaged, and be flown on, and where it may be: every fault in words."""

from __future__ import annotations

import math

import numpy as np

from zsim.math.compiled import portable
from zsim_agents.formation.control_law import FormationGains
from zsim_agents.formation.flight_data import AIRBORNE, EngagementLimits, GateInput, ShapeLimits
from zsim_agents.formation.spaces.cluster_space import Array, ClusterSpace, SingularClusterError, closest_pair

FAR = 1e6  # m or rad: beyond it a value is a slip
ROUNDING_M = 1e-9  # of a place that is computed from variables: 1e-14 at 50 m; a limit itself is allowed
VALID, STALE, NOT_FINITE, UNCERTAIN, TURNED = range(5)  # state of an estimate


class FlightCheck:
    """Checks the estimates and states of a gate; each check returns the fault, or None where all is well.

    Attributes:
        value: (4n,) cluster of the newest estimates that had a frame, zero before any.
        margin: its distance to singularity [m] (`ClusterSpace.margin`), 0 while the estimates have no frame.
    """

    def __init__(
        self,
        space: ClusterSpace,
        drones: tuple[str, ...],
        gains: FormationGains,
        limits: EngagementLimits,
    ) -> None:
        self.space = space
        self.drones = drones
        self.gains = gains
        self.limits = limits
        self._shape_in_flight = limits.shape_in_flight
        self._bounds_in_flight = bounds_of(space, self._shape_in_flight)
        self.value: Array = np.zeros(space.size)
        self.margin = 0.0
        self._spread = 0.0
        self._no_frame: str | None = "nothing was observed yet"
        self._flaw = (VALID, 0)  # of the estimates of the gate that was observed, by the limits in flight
        sigmas = limits.sigma_max_m, limits.yaw_sigma_max_rad
        self._at_start = (limits.age_max_s, *sigmas)
        self._in_flight = (limits.age_max_s, *(limits.in_flight_factor * sigma for sigma in sigmas))

    def observe(self, gate: GateInput) -> None:
        """Take over the estimates of a gate."""
        self.margin, self._no_frame = 0.0, "an estimate is not finite"
        self._flaw = _first_flaw(gate, *self._in_flight)
        if self._flaw[0] != VALID and not all_near(gate.p_W, gate.yaw):
            return
        try:
            self.value = self.space.forward(gate.p_W, gate.yaw)
            self._spread, self.margin = self.space.measures(self.value)
            self._no_frame = None
        except SingularClusterError as error:
            self._no_frame = str(error)

    def take_off_fault(self, gate: GateInput) -> str | None:
        """Return why the drones may not take off; drones that fly already need not stand well."""
        fault = self.state_fault(gate, AIRBORNE | {"landed"}) or self._start_fault(gate)
        return fault or (self.formation_fault(gate) if "landed" in gate.states else None)

    def engagement_fault(self, gate: GateInput) -> str | None:
        """Return why the formation cannot be engaged."""
        fault = self.state_fault(gate, AIRBORNE) or self._start_fault(gate)
        if fault:
            return fault
        low = int(np.argmin(gate.p_W[:, 2]))
        least_m = self.limits.assembly_height_m - self.limits.assembly_within_m
        if gate.p_W[low, 2] < least_m:
            return f"{self.drones[low]} is at z = {gate.p_W[low, 2]:.2f} m; allowed: {least_m:.2f} m or more"
        return self.formation_fault(gate)

    def flight_fault(self, gate: GateInput) -> str | None:
        """Return why the loop of an engaged formation cannot be closed."""
        fault = self.state_fault(gate, AIRBORNE) or self.estimate_fault(gate) or self._no_frame
        shape = self._shape_in_flight
        if fault or (self._spread > shape.spread_min_m and first_outside(self.value, self._bounds_in_flight) < 0):
            return fault
        return shape_fault(self.space, self.value, shape, self._spread)

    def formation_fault(self, gate: GateInput) -> str | None:
        """Return why the robots, where they are, make no formation to start from."""
        fault = self._no_frame or shape_fault(self.space, self.value, self.limits.shape, self._spread)
        if fault:
            return fault
        distance, i, j = closest_pair(gate.p_W)
        if distance >= self.gains.separation_min_m:
            return None
        pair = f"{self.drones[i]} and {self.drones[j]}"
        return f"{pair} are {distance:.2f} m apart; allowed: {self.gains.separation_min_m:g} m or more"

    def estimate_fault(self, gate: GateInput) -> str | None:
        """Return why the estimates of drones in flight cannot be flown on, those of the gate that was observed."""
        return self._flaw_text(gate, self._flaw, self.limits.in_flight_factor)

    def state_fault(self, gate: GateInput, allowed: frozenset[str]) -> str | None:
        """Return which drone is in another state than those allowed."""
        if allowed.issuperset(gate.states):
            return None
        drone, state = next(pair for pair in zip(self.drones, gate.states, strict=True) if pair[1] not in allowed)
        return f"{drone} is in state {state}; allowed: {', '.join(sorted(allowed))}"

    def _start_fault(self, gate: GateInput) -> str | None:
        return self._flaw_text(gate, _first_flaw(gate, *self._at_start))

    def _flaw_text(self, gate: GateInput, flaw: tuple[int, int], factor: float = 1.0) -> str | None:
        kind, i = flaw
        if kind == VALID:
            return None
        drone, age_max_s = self.drones[i], self.limits.age_max_s
        if kind == STALE:
            return f"the estimate of {drone} is {gate.age_s[i]:.2f} s old; allowed: {age_max_s:g} s"
        if kind == NOT_FINITE:
            return f"the estimate of {drone} is not finite; allowed: up to {FAR:g} m, m/s or rad"
        if kind == TURNED:
            sigma_deg, most_deg = math.degrees(gate.yaw_sigma[i]), math.degrees(factor * self.limits.yaw_sigma_max_rad)
            return f"the heading of {drone} has a sigma of {sigma_deg:.1f} deg; allowed: {most_deg:g} deg"
        worst_m, most_m = max(gate.sigma_m[i].tolist()), factor * self.limits.sigma_max_m
        return f"the position of {drone} has a sigma of {worst_m:.2f} m; allowed: {most_m:g} m"


def _first_flaw(gate: GateInput, age_max_s: float, sigma_max_m: float, yaw_sigma_max: float) -> tuple[int, int]:
    of_gate = gate.age_s, gate.p_W, gate.v_W, gate.yaw, gate.sigma_m, gate.yaw_sigma
    return estimate_flaw(*of_gate, age_max_s, sigma_max_m, yaw_sigma_max)


@portable
def all_near(p_W: Array, yaw: Array) -> bool:
    """Return whether all positions (n, 3) and headings (n,) are finite and below FAR."""
    fit = True
    for i in range(yaw.size):
        fit = fit and near(p_W, i) and abs(yaw[i]) < FAR
    return fit


@portable
def near(vectors: Array, i: int) -> bool:
    """Return whether row i of (n, 3) is finite and below FAR; false for NaN."""
    return abs(vectors[i, 0]) < FAR and abs(vectors[i, 1]) < FAR and abs(vectors[i, 2]) < FAR


@portable
def estimate_flaw(
    age_s: Array,
    p_W: Array,
    v_W: Array,
    yaw: Array,
    sigma_m: Array,
    yaw_sigma: Array,
    age_max_s: float,
    sigma_max_m: float,
    yaw_sigma_max: float,
) -> tuple[int, int]:
    """Return what the first estimate that is not well is (STALE, NOT_FINITE, UNCERTAIN, TURNED), and whose; else VALID.

    UNCERTAIN: where the drone is; TURNED: its heading.
    """
    for i in range(yaw.size):
        if not age_s[i] <= age_max_s:
            return STALE, i
        if not (near(p_W, i) and near(v_W, i) and abs(yaw[i]) < FAR):
            return NOT_FINITE, i
        for k in range(3):
            if not sigma_m[i, k] <= sigma_max_m:
                return UNCERTAIN, i
        if not yaw_sigma[i] <= yaw_sigma_max:
            return TURNED, i
    return VALID, 0


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
            tilt_deg, most_deg = math.degrees(c[k]), math.degrees(limits.tilt_max_rad)
            return (
                f"{space.names[k]} of the formation is {tilt_deg:.1f} deg; allowed: below {most_deg:g} deg either way"
            )
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
    if well_placed(p_W, gains.separation_min_m, limits.height_min_m):
        return None
    distance, i, j = closest_pair(p_W)
    if distance < gains.separation_min_m - ROUNDING_M:
        pair = f"robots {i + 1} and {j + 1}"
        return f"{pair} are {distance:.3f} m apart; allowed: {gains.separation_min_m:g} m or more"
    heights = p_W[:, 2].tolist()
    lowest = min(heights)
    if lowest < limits.height_min_m - ROUNDING_M:
        low = heights.index(lowest)
        return f"robot {low + 1} is at z = {lowest:.2f} m; allowed: {limits.height_min_m:g} m or more"
    return None


@portable
def well_placed(p_W: Array, separation_min_m: float, height_min_m: float) -> bool:
    """Return whether robots at p_W (n, 3) are neither too near to each other nor too low."""
    fit = closest_pair(p_W)[0] >= separation_min_m - ROUNDING_M
    for i in range(p_W.shape[0]):
        fit = fit and p_W[i, 2] >= height_min_m - ROUNDING_M
    return fit
