"""What the phase machine of a formation reads and gives at every gate.

What is made at every gate is a Struct, which takes a fifth of the time of a tuple or dataclass with names.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from msgspec import Struct

from zsim_agents.formation.spaces.cluster_space import Array

AIRBORNE = frozenset({"hovering", "flying"})  # states of a drone that follows velocity commands
DOWN = frozenset({"landed", "emergency"})  # states of a drone that is on the ground, or falls to it
HELD_ON_REQUEST = "held on request"  # reasons of a formation; a display reads from them what may be asked for
READY_TO_ENGAGE = "ready to engage"
GUARD_PARTS = "the guard parts"
TOO_NEAR = "ALARM"
REJOINING = "rejoining"


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


@dataclass(frozen=True)
class EngagementLimits:
    """Limits and heights of the phase machine; all chosen, `shape` so that no formation comes near a singularity.

    Attributes:
        shape: where a formation may be engaged and led.
        flight_slack: in flight the spread may fall to its limit over this, the tilt grow to its limit times
            this.
        assembly_height_m: height to which drones climb straight up before engagement, within
            assembly_within_m.
        assembly_climb_m_s: greatest speed of that climb.
        age_max_s: oldest estimate that is flown on.
        sigma_max_m, yaw_sigma_max_rad: greatest sigma of position and heading for take-off and engagement.
        in_flight_factor: by which both may be greater in flight.
        heal_s: how long everything must be well before a held formation goes on.
        resend_s: after it a mode command without effect is sent again.
    """

    shape: ShapeLimits = field(default_factory=ShapeLimits)
    flight_slack: float = 1.5  # so that noise of the estimates at the limit holds nobody
    assembly_height_m: float = 1.5  # many rotor radii over the ground, and a fall that the hull takes
    assembly_within_m: float = 0.3  # three sigma of the barometer
    assembly_climb_m_s: float = 0.5  # half of what the firmware allows: the drones climb alike
    age_max_s: float = 0.5  # as the firmware's silence: 25 gates
    sigma_max_m: float = 1.0  # half of the least separation of 2 m
    yaw_sigma_max_rad: float = math.radians(15.0)  # half of the 30 deg at which three sigma turn a velocity by 90 deg
    in_flight_factor: float = 2.0  # of a position: 2 m, as of a single GPS fix: nothing else helps any more
    heal_s: float = 0.5  # 25 gates without a fault are no accident
    resend_s: float = 1.0  # ten times the delay of commands in the paper's scenario, 100 ms

    @property
    def shape_in_flight(self) -> ShapeLimits:
        """Return the wider limits beyond which a formation in flight is held."""
        return dataclasses.replace(
            self.shape,
            spread_min_m=self.shape.spread_min_m / self.flight_slack,
            tilt_max_rad=self.shape.tilt_max_rad * self.flight_slack,
            condition_max=math.inf,
        )


class GateInput(Struct, eq=False):
    """The newest estimates of n drones at a gate; its arrays may be filled anew for the next.

    Attributes:
        t_s: simulated time.
        p_W, v_W: (n, 3) [m, m/s]; yaw: (n,) [rad]; non-finite where nothing is known.
        sigma_m: (n, 3) standard deviations of position; yaw_sigma: (n,) of the heading [rad].
        age_s: (n,) ages of the estimates; infinite where there is none.
        states: (n,) `state` of each drone's sensor/status.
    """

    t_s: float
    p_W: Array
    yaw: Array
    v_W: Array
    sigma_m: Array
    yaw_sigma: Array
    age_s: Array
    states: tuple[str, ...]

    @property
    def down(self) -> bool:
        """Return whether no drone is in the air."""
        return DOWN.issuperset(self.states)


class ModeCommand(NamedTuple):
    """A mode command for one drone: takeoff or land."""

    drone: str
    mode: str


class ModeSender:
    """Sends a mode to each drone that is still in a state from which it is to go, once per resend_s.

    Attributes:
        sent_s: when, by drone.
    """

    def __init__(self, drones: tuple[str, ...], resend_s: float) -> None:
        self._drones = drones
        self._resend_s = resend_s
        self.sent_s: dict[str, float] = {}

    def restart(self) -> None:
        """Begin anew: the next commands are sent at once."""
        self.sent_s.clear()

    def commands(self, gate: GateInput, mode: str, states: frozenset[str]) -> tuple[ModeCommand, ...]:
        """Return the commands of this gate for the drones that are in one of the states."""
        due = []
        for drone, state in zip(self._drones, gate.states, strict=True):
            if state in states and gate.t_s - self.sent_s.get(drone, -math.inf) >= self._resend_s:
                self.sent_s[drone] = gate.t_s
                due.append(ModeCommand(drone, mode))
        return tuple(due)


class Setpoint(Struct, eq=False):
    """A velocity command for one drone [m/s, W; rad/s]."""

    v_W: Sequence[float]
    yaw_rate: float


def setpoints(gate: GateInput, v_W: Array, yaw_rate: Array) -> tuple[Setpoint | None, ...]:
    """Return the setpoints of velocities (n, 3) and yaw rates (n,), None for a drone that does not follow one."""
    every = map(Setpoint, v_W.tolist(), yaw_rate.tolist())
    if AIRBORNE.issuperset(gate.states):
        return tuple(every)
    return tuple(setpoint if state in AIRBORNE else None for setpoint, state in zip(every, gate.states, strict=True))


class GateOutput(Struct, eq=False):
    """Commands of a gate, and the fields of the cluster's state message.

    Attributes:
        modes: mode commands to send.
        setpoints: (n,) what each drone is to do, None for no command.
        phase, value, desired, desired_rate, trajectory_t_s, margin, reason: as in the message; value and
            desired with wrapped angles.
        factor: common factor of the saturation, 1 where nothing is saturated.
        alarmed: pairs of drone indices that are nearer than the alarm threshold.
        plan_step: as in the message.
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
    alarmed: tuple[tuple[int, int], ...]
    plan_step: int
