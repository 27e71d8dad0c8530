"""Checks whether a formation may take off, engage or fly on, and where it may be led; faults are texts.

The data of a gate are Structs, which are created in a fifth of the time that a named tuple or dataclass takes.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from zsim.math.compiled import portable
from zsim_agents.formation.control_law import FormationGains
from zsim_agents.formation.spaces.cluster_space import Array, ClusterSpace, SingularClusterError, closest_pair

VALUE_MAX = 1e6  # m, m/s or rad; any greater value is taken for an error
ROUNDING_M = 1e-9  # tolerance above the rounding of a computed position (1e-14 m at 50 m): the limit itself is allowed
VALID, STALE, NOT_FINITE, POSITION_UNCERTAIN, HEADING_UNCERTAIN = range(5)  # findings of `estimate_flaw`
AIRBORNE = frozenset({"hovering", "flying"})  # states of a drone that follows velocity commands
DOWN = frozenset({"landed", "emergency"})  # states of a drone on the ground or falling
# Reasons in the cluster state, from which a display derives the possible requests
HELD_ON_REQUEST = "held on request"
READY_TO_ENGAGE = "ready to engage"
GUARD_PARTS = "the guard parts"
TOO_NEAR = "ALARM"
REJOINING = "rejoining"


@dataclass(frozen=True)
class ShapeLimits:
    """Limits of the shapes in which a formation may be engaged and to which a reference may lead it.

    Attributes:
        spread_min_m: minimum `ClusterSpace.spread` of the shape.
        tilt_max_rad: maximum roll and pitch of the formation.
        condition_max: maximum condition number of J^-1.
        height_min_m: minimum height of a robot's reference above the ground, z_W = 0.
        share: share of the robots' speed limits that a reference may use; the rest is left to the control law.
    """

    spread_min_m: float = 1.0  # five sigma of an estimated side, so that the robots are certainly not collinear
    tilt_max_rad: float = math.radians(30.0)  # far from 90 deg, where Euler angles are singular
    condition_max: float = 20.0  # above it, a small motion in cluster space moves a robot far
    height_min_m: float = 0.5  # five rotor radii, above most of the ground effect
    share: float = 0.8


# All limits in this module are design choices; those of the shape keep every formation away from singularities
SHAPE = ShapeLimits()
FLIGHT_SLACK = 1.5  # factor on spread and tilt limits in flight, so that noise at a limit does not hold the formation
SHAPE_IN_FLIGHT = dataclasses.replace(  # a formation in flight is held outside these limits
    SHAPE,
    spread_min_m=SHAPE.spread_min_m / FLIGHT_SLACK,
    tilt_max_rad=SHAPE.tilt_max_rad * FLIGHT_SLACK,
    condition_max=math.inf,
)
ASSEMBLY_HEIGHT_M = 1.5  # height of the climb before engagement: many rotor radii, yet drones survive a fall from it
ASSEMBLY_TOLERANCE_M = 0.3  # tolerance of that height, three sigma of the barometer
ASSEMBLY_CLIMB_M_S = 0.5  # maximum climb rate: half of the firmware's limit, so that all drones climb equally fast
AGE_MAX_S = 0.5  # maximum age of a usable estimate: 25 gates, as long as the firmware tolerates silence
IN_FLIGHT_FACTOR = 2.0  # factor on the sigma limits in flight: 2 m for a position, the sigma of a single GPS fix
RECOVERY_S = 0.5  # time without a fault before a held formation continues: 25 gates rule out coincidence
RESEND_S = 1.0  # period of resending an ineffective mode command: ten times its delay in the paper's scenario


@dataclass(frozen=True)
class EngagementLimits:
    """Maximum standard deviations for take-off and engagement."""

    sigma_max_m: float = 1.0  # half of the minimum separation of 2 m
    yaw_sigma_max_rad: float = math.radians(15.0)  # half of 30 deg, at which an error of three sigma is 90 deg


class GateInput(Struct, eq=False):
    """The newest estimates of n drones at a gate; the arrays may be overwritten at the next gate.

    Attributes:
        p_W, v_W: (n, 3) [m, m/s]; yaw: (n,) [rad]; non-finite where unknown.
        sigma_m: (n, 3) standard deviations of position; yaw_sigma: (n,) of the heading [rad].
        age_s: (n,) ages of the estimates; infinite without an estimate.
        states: `state` in each drone's sensor/status message, (n,).
    """

    t_s: float
    p_W: Array
    yaw: Array
    v_W: Array
    sigma_m: Array
    yaw_sigma: Array
    age_s: Array
    states: tuple[str, ...]

    def reordered(self, order: NDArray[np.intp]) -> GateInput:
        """Return the gate with the robots reordered; `order` (n,) contains their present indices."""
        motion = self.p_W[order], self.yaw[order], self.v_W[order]
        accuracies = self.sigma_m[order], self.yaw_sigma[order], self.age_s[order]
        return GateInput(self.t_s, *motion, *accuracies, tuple(self.states[k] for k in order.tolist()))

    @property
    def is_down(self) -> bool:  # whether no drone is in the air
        return DOWN.issuperset(self.states)


class ModeCommand(NamedTuple):
    drone: str
    mode: str  # takeoff or land


class Setpoint(Struct, eq=False):
    """A velocity command for one drone [m/s, W; rad/s]."""

    v_W: Sequence[float]
    yaw_rate: float


def setpoints(gate: GateInput, v_W: Array, yaw_rate: Array) -> tuple[Setpoint | None, ...]:
    """Return setpoints from velocities (n, 3) and yaw rates (n,); None for drones that do not follow setpoints."""
    commands = map(Setpoint, v_W.tolist(), yaw_rate.tolist())
    if AIRBORNE.issuperset(gate.states):
        return tuple(commands)
    return tuple(setpoint if state in AIRBORNE else None for setpoint, state in zip(commands, gate.states, strict=True))


class GateOutput(Struct, eq=False):
    """Commands of a gate and the fields of the cluster state message.

    Attributes:
        setpoints: velocity commands, (n,); None for a drone without a command.
        phase, value, desired, desired_rate, trajectory_t_s, margin, reason, plan_step: as in the message; angles in
            value and desired are wrapped.
        factor: common factor of the saturation; 1 without saturation.
    """

    modes: tuple[ModeCommand, ...]
    setpoints: tuple[Setpoint | None, ...]
    phase: str
    value: Array
    desired: Array
    desired_rate: Array
    trajectory_t_s: float | None
    margin: float
    reason: str
    factor: float
    plan_step: int


class FlightCheck:
    """Checks the estimates and states of a gate; each check returns a fault or None.

    Attributes:
        value: cluster variables (4n,) of the newest estimates that defined a frame; zero before the first.
        margin: `ClusterSpace.margin` of the value [m]; 0 while the estimates define no frame.
    """

    def __init__(
        self, space: ClusterSpace, drones: tuple[str, ...], gains: FormationGains, limits: EngagementLimits
    ) -> None:
        self.space, self.drones, self.gains, self.limits = space, drones, gains, limits
        self._bounds_in_flight = bounds_of(space, SHAPE_IN_FLIGHT)
        self.value: Array = np.zeros(space.size)
        self.margin = 0.0
        self._spread = 0.0
        self._no_frame: str | None = "nothing has been observed yet"
        self._flaw = (VALID, 0)  # first flaw of the observed gate under the limits in flight
        sigmas = limits.sigma_max_m, limits.yaw_sigma_max_rad
        self._start_limits = (AGE_MAX_S, *sigmas)
        self._flight_limits = (AGE_MAX_S, *(IN_FLIGHT_FACTOR * sigma for sigma in sigmas))

    def observe(self, gate: GateInput) -> None:
        self.margin, self._no_frame = 0.0, "an estimate is not finite"
        self._flaw = _first_flaw(gate, *self._flight_limits)
        if self._flaw[0] != VALID and not all_near(gate.p_W, gate.yaw):
            return
        try:
            self.value = self.space.forward(gate.p_W, gate.yaw)
            self._spread, self.margin = self.space.measures(self.value)
            self._no_frame = None
        except SingularClusterError as error:
            self._no_frame = str(error)

    def take_off_fault(self, gate: GateInput, assembles: bool = False) -> str | None:
        """Return why the drones may not take off; if all are already airborne, their positions are not checked.

        `assembles`: whether the drones will fly to assigned positions, so that they may start in any shape.
        """
        fault = self._start_fault(gate, AIRBORNE | {"landed"})
        if fault or "landed" not in gate.states:
            return fault
        return self.distance_fault(gate) if assembles else self.formation_fault(gate)

    def engagement_fault(self, gate: GateInput) -> str | None:
        return self.assembly_fault(gate) or self.formation_fault(gate)

    def assembly_fault(self, gate: GateInput) -> str | None:
        """Return why the drones cannot be led individually after their climb."""
        if fault := self._start_fault(gate, AIRBORNE):
            return fault
        lowest = int(np.argmin(gate.p_W[:, 2]))
        height_min_m = ASSEMBLY_HEIGHT_M - ASSEMBLY_TOLERANCE_M
        if gate.p_W[lowest, 2] < height_min_m:
            return f"{self.drones[lowest]} is at z = {gate.p_W[lowest, 2]:.2f} m; allowed: {height_min_m:.2f} m or more"
        return None

    def flight_fault(self, gate: GateInput) -> str | None:
        """Return why the control loop of an engaged formation cannot be closed."""
        fault = self.state_fault(gate, AIRBORNE) or self.estimate_fault(gate) or self._no_frame
        is_wide = self._spread > SHAPE_IN_FLIGHT.spread_min_m
        if fault or (is_wide and first_outside(self.value, self._bounds_in_flight) < 0):
            return fault
        return shape_fault(self.space, self.value, SHAPE_IN_FLIGHT, self._spread)

    def formation_fault(self, gate: GateInput) -> str | None:
        """Return why the robots' present positions do not form a valid formation to start from."""
        fault = self._no_frame or shape_fault(self.space, self.value, SHAPE, self._spread)
        return fault or self.distance_fault(gate)

    def distance_fault(self, gate: GateInput) -> str | None:
        distance, i, j = closest_pair(gate.p_W)
        if distance >= self.gains.separation_min_m:
            return None
        pair = f"{self.drones[i]} and {self.drones[j]}"
        return f"{pair} are {distance:.2f} m apart; allowed: {self.gains.separation_min_m:g} m or more"

    def formation(self) -> Array | None:
        """Return the cluster variables (4n,) of the observed gate; None if the robots form no flyable formation."""
        is_flyable = (
            self._no_frame is None and shape_fault(self.space, self.value, SHAPE_IN_FLIGHT, self._spread) is None
        )
        return self.value if is_flyable else None

    def estimate_fault(self, gate: GateInput) -> str | None:
        """Return why the flight cannot continue on the estimates of the observed gate."""
        return self._flaw_text(gate, self._flaw, IN_FLIGHT_FACTOR)

    def state_fault(self, gate: GateInput, allowed: frozenset[str]) -> str | None:
        """Return the fault of the first drone whose state is not allowed."""
        if allowed.issuperset(gate.states):
            return None
        drone, state = next(pair for pair in zip(self.drones, gate.states, strict=True) if pair[1] not in allowed)
        return f"{drone} is in state {state}; allowed: {', '.join(sorted(allowed))}"

    def _start_fault(self, gate: GateInput, allowed: frozenset[str]) -> str | None:
        return self.state_fault(gate, allowed) or self._flaw_text(gate, _first_flaw(gate, *self._start_limits))

    def _flaw_text(self, gate: GateInput, flaw: tuple[int, int], factor: float = 1.0) -> str | None:
        kind, i = flaw
        if kind == VALID:
            return None
        drone = self.drones[i]
        if kind == STALE:
            return f"the estimate of {drone} is {gate.age_s[i]:.2f} s old; allowed: {AGE_MAX_S:g} s"
        if kind == NOT_FINITE:
            return f"the estimate of {drone} is not finite; allowed: up to {VALUE_MAX:g} m, m/s or rad"
        if kind == HEADING_UNCERTAIN:
            sigma_deg, max_deg = math.degrees(gate.yaw_sigma[i]), math.degrees(factor * self.limits.yaw_sigma_max_rad)
            return f"the heading of {drone} has a sigma of {sigma_deg:.1f} deg; allowed: {max_deg:g} deg"
        worst_m, max_m = max(gate.sigma_m[i].tolist()), factor * self.limits.sigma_max_m
        return f"the position of {drone} has a sigma of {worst_m:.2f} m; allowed: {max_m:g} m"


def _first_flaw(gate: GateInput, age_max_s: float, sigma_max_m: float, yaw_sigma_max: float) -> tuple[int, int]:
    estimates = gate.age_s, gate.p_W, gate.v_W, gate.yaw, gate.sigma_m, gate.yaw_sigma
    return estimate_flaw(*estimates, age_max_s, sigma_max_m, yaw_sigma_max)


@portable
def all_near(p_W: Array, yaw: Array) -> bool:
    """Return whether all positions (n, 3) and headings (n,) are finite and below VALUE_MAX in magnitude."""
    is_valid = True
    for i in range(yaw.size):
        is_valid = is_valid and is_near(p_W, i) and abs(yaw[i]) < VALUE_MAX
    return is_valid


@portable
def is_near(vectors: Array, i: int) -> bool:
    """Return whether row i of vectors (n, 3) is finite and below VALUE_MAX in magnitude."""
    return abs(vectors[i, 0]) < VALUE_MAX and abs(vectors[i, 1]) < VALUE_MAX and abs(vectors[i, 2]) < VALUE_MAX


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
    """Return the flaw of the first unusable estimate and the index of its drone; (VALID, 0) if all are usable.

    POSITION_UNCERTAIN and HEADING_UNCERTAIN mean that the sigma is too large.
    """
    for i in range(yaw.size):
        if not age_s[i] <= age_max_s:
            return STALE, i
        if not (is_near(p_W, i) and is_near(v_W, i) and abs(yaw[i]) < VALUE_MAX):
            return NOT_FINITE, i
        for k in range(3):
            if not sigma_m[i, k] <= sigma_max_m:
                return POSITION_UNCERTAIN, i
        if not yaw_sigma[i] <= yaw_sigma_max:
            return HEADING_UNCERTAIN, i
    return VALID, 0


def shape_fault(space: ClusterSpace, c: Array, limits: ShapeLimits, spread: float | None = None) -> str | None:
    """Return why c is not an allowed shape (quantity, value and limit), or None.

    `spread`: the spread of c, if already known.
    """
    outside = first_outside(c, space.bounds)
    if outside >= 0:
        name, value, (low, high) = space.names[outside], float(c[outside]), space.bounds[outside].tolist()
        if not abs(value) < VALUE_MAX:
            return f"{name} is {value:g}; allowed: up to {VALUE_MAX:g}"
        return f"{name} is {value:.3g}; allowed: between {low:.3g} and {high:.3g}"
    spread = space.spread(c) if spread is None else spread
    if spread <= limits.spread_min_m:
        return f"{space.spread_text} is {spread:.2f} m; allowed: above {limits.spread_min_m:g} m"
    for k in space.tilts:
        if abs(c[k]) >= limits.tilt_max_rad:
            tilt_deg, max_deg = math.degrees(c[k]), math.degrees(limits.tilt_max_rad)
            tilt = f"{space.names[k]} of the formation is {tilt_deg:.1f} deg"
            return f"{tilt}; allowed: below {max_deg:g} deg either way"
    condition = space.condition(c) if math.isfinite(limits.condition_max) else 0.0
    if not condition < limits.condition_max:
        return f"condition number of J^-1 is {condition:.1f}; allowed: below {limits.condition_max:g}"
    return None


def bounds_of(space: ClusterSpace, limits: ShapeLimits) -> Array:
    """Return the open bounds (4n, 2) outside which `shape_fault` finds a fault."""
    bounds = space.bounds.copy()
    for k in space.tilts:
        bounds[k, 0] = max(bounds[k, 0], -limits.tilt_max_rad)
        bounds[k, 1] = min(bounds[k, 1], limits.tilt_max_rad)
    return bounds


@portable
def first_outside(c: Array, bounds: Array) -> int:
    """Return the index of the first variable of c beyond VALUE_MAX or outside its open bounds (4n, 2), else -1."""
    for k in range(c.size):
        if not (abs(c[k]) < VALUE_MAX and bounds[k, 0] < c[k] < bounds[k, 1]):  # also true for NaN
            return k
    return -1


def formation_fault(space: ClusterSpace, c: Array, gains: FormationGains, limits: ShapeLimits) -> str | None:
    """Return why the formation may not be led to c, because of its shape or the robots' positions, or None."""
    return shape_fault(space, c, limits) or place_fault(space, c, gains, limits)


def place_fault(space: ClusterSpace, c: Array, gains: FormationGains, limits: ShapeLimits) -> str | None:
    """Return why the robots' positions in c are not allowed (too close together or too low), or None."""
    p_W, _ = space.inverse(c)
    if has_valid_positions(p_W, gains.separation_min_m, limits.height_min_m):
        return None
    distance, i, j = closest_pair(p_W)
    if distance < gains.separation_min_m - ROUNDING_M:
        pair = f"robots {i + 1} and {j + 1}"
        return f"{pair} are {distance:.3f} m apart; allowed: {gains.separation_min_m:g} m or more"
    heights = p_W[:, 2].tolist()
    lowest = min(heights)
    if lowest < limits.height_min_m - ROUNDING_M:
        robot = heights.index(lowest)
        return f"robot {robot + 1} is at z = {lowest:.2f} m; allowed: {limits.height_min_m:g} m or more"
    return None


@portable
def has_valid_positions(p_W: Array, separation_min_m: float, height_min_m: float) -> bool:
    is_valid = closest_pair(p_W)[0] >= separation_min_m - ROUNDING_M
    for i in range(p_W.shape[0]):
        is_valid = is_valid and p_W[i, 2] >= height_min_m - ROUNDING_M
    return is_valid
