"""The control law of a formation, from the estimated robots and a reference to velocity commands.

    c_dot_cmd = c_dot_des + k (c_des - c) + I,    I' = k_i (c_des - c),    r_dot = J^-1(c) c_dot_cmd

followed by a saturation that keeps the direction in cluster space (one factor for all robots) and by a
guard of the distance between robots.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from zsim.math.compiled import portable
from zsim_agents.formation.near_pairs import PairTable, near_pairs
from zsim_agents.formation.spaces.cluster_frame import Vector, between, dot, length, row
from zsim_agents.formation.spaces.cluster_space import TAU, Array, ClusterSpace

Pairs = tuple[tuple[int, int], ...]

Order = NDArray[np.int64]

NEAR_M = 1e-6  # robots that are nearer have no direction from one to the other
SETTLED_M_S = 1e-9  # a rate that lacks less is reached
LOAD_MIN = 1e-9  # against division by zero
GUARD_SWEEPS = 4  # passes over all pairs; one settles two robots, three robots in a corner need a few


class Limits(NamedTuple):
    """What the saturation and the guard keep, of the gains below, for compiled code."""

    speed_max_m_s: float
    climb_max_m_s: float
    yaw_rate_max_rad_s: float
    separation_min_m: float
    separation_alarm_m: float
    guard_horizon_s: float
    response_s: float


@dataclass(frozen=True)
class FormationGains:
    """Parameters of the law; all are positive, validated with the scenario.

    Attributes:
        k_1_s: proportional gain [1/s]; 0.5 to 0.8 is good, unstable from about 2 on a drone's velocity loop.
        integral_1_s2: integral gain [1/s^2]; takes out the offset that wind leaves, 0 switches it off.
        integral_max_m_s, integral_max_rad_s: clamp of the integral term for lengths and for angles.
        speed_max_m_s, climb_max_m_s, yaw_rate_max_rad_s: limits of each robot.
        separation_min_m: least distance between two robots of a reference, and where the guard acts.
        separation_alarm_m: below it two robots are reported.
        guard_horizon_s: how far ahead the guard looks.
        response_s: lag of a drone's velocity loop, over which the guard expects it to keep its velocity.
    """

    k_1_s: float = 0.6
    integral_1_s2: float = 0.05
    integral_max_m_s: float = 0.5
    integral_max_rad_s: float = 0.1
    speed_max_m_s: float = 2.0  # limit of velocityXY in the paper's base simulator, hector_quadrotor
    climb_max_m_s: float = 1.0  # control_vz_max of the AR.Drone SDK outdoors, 1000 mm/s
    yaw_rate_max_rad_s: float = 1.75  # control_yaw of the AR.Drone SDK
    separation_min_m: float = 2.0  # four widths of the drone in its hull, 0.52 m
    separation_alarm_m: float = 1.5
    guard_horizon_s: float = 1.0
    response_s: float = 0.3

    @cached_property
    def limits(self) -> Limits:
        """Return what the saturation and the guard keep."""
        return Limits(*(float(getattr(self, name)) for name in Limits._fields))


class FormationCommand(Struct, eq=False):
    """What the law asks of the robots.

    Attributes:
        v_W: velocities (n, 3) [m/s, W]; yaw_rate: (n,) [rad/s].
        factor: the common factor of the saturation, 1 where nothing is saturated.
        guarded: pairs of robot indices that the guard holds apart.
        alarmed: pairs that are nearer than the alarm threshold.
    """

    v_W: Array
    yaw_rate: Array
    factor: float
    guarded: Pairs
    alarmed: Pairs


class FormationLaw:
    """The law above with its only state, the integral term (4n,) [m/s, rad/s]."""

    def __init__(self, space: ClusterSpace, gains: FormationGains | None = None) -> None:
        self.space = space
        self.gains = gains or FormationGains()
        self._clamp = np.where(space.in_radians, self.gains.integral_max_rad_s, self.gains.integral_max_m_s)
        # Scratch of `command`, of which nothing leaves it.
        self._error, self._c_dot = np.empty(space.size), np.empty(space.size)
        self._order = np.empty((space.n, space.n), np.int64)
        self.reset()

    def reset(self) -> None:
        """Forget the integral term."""
        self.integral = np.zeros(self.space.size)

    def command(
        self, c: Array, p_W: Array, v_W: Array, c_des: Array, c_dot_des: Array, dt_s: float
    ) -> FormationCommand:
        """Return the command of this gate.

        Args:
            c: (4n,) cluster of the estimates; p_W, v_W: the estimates, (n, 3) [m, m/s; W].
            c_des, c_dot_des: (4n,) reference and its rate.
            dt_s: time since the last command, for the integral.
        """
        space, gains, error, c_dot, order = self.space, self.gains, self._error, self._c_dot, self._order
        put_cluster_rate(c_des, c, space.period, c_dot_des, self.integral, gains.k_1_s, error, c_dot)
        r_dot = space.motion(c, c_dot)
        v_cmd_W, yaw_rate = np.empty((space.n, 3)), np.empty(space.n)
        factor, guards, alarms = limited(r_dot, p_W, v_W, v_cmd_W, yaw_rate, order, *gains.limits)
        if factor == 1.0 and not guards:  # the integral runs only while the robots follow the law
            grow(self.integral, error, gains.integral_1_s2 * dt_s, self._clamp)
        guarded, alarmed = pairs_of(guards, alarms, order) if guards or alarms else ((), ())
        return FormationCommand(v_cmd_W, yaw_rate, factor, guarded, alarmed)


def load(v_W: Array, yaw_rate: Array, gains: FormationGains) -> float:
    """Return the greatest ratio of a robot's speed, climb or yaw rate to its limit; 1 is at the limit."""
    return float(greatest_load(v_W, yaw_rate, gains.limits))


def guard(p_W: Array, v_W: Array, v_cmd_W: Array, gains: FormationGains) -> tuple[Array, Pairs, Pairs]:
    """Return the velocities with dangerous approaches taken out, the pairs concerned, and the pairs in alarm.

    Two robots at distance d, d' = rate of the command along their line, are held to
    d' >= -(d_near - separation_min) / guard_horizon: the distance predicted over the horizon stays above the
    minimum, and below it the approach is reversed. d_near allows for the velocities that the robots have,
    which last for their response time. Each robot of a pair takes half of the change;
    a few sweeps settle several pairs.
    """
    parted_W, order = v_cmd_W.copy(), np.empty((len(p_W), len(p_W)), np.int64)
    guards, alarms = hold_apart(p_W, v_W, parted_W, order, *gains.limits)
    return parted_W, *pairs_of(guards, alarms, order)


def pairs_of(guards: int, alarms: int, order: Order) -> tuple[Pairs, Pairs]:
    """Return the pairs that `hold_apart` has held apart, and those in alarm."""
    return _numbered(order) if guards else (), _numbered(order.T) if alarms else ()


def _numbered(order: Order) -> Pairs:
    """Return the pairs with a number above the diagonal, in the order of their numbers."""
    numbers = order.tolist()
    places = [(numbers[i][j], i, j) for j in range(len(numbers)) for i in range(j) if numbers[i][j]]
    return tuple((i, j) for _, i, j in sorted(places))


@portable
def put_cluster_rate(
    c_des: Array, c: Array, period: Array, c_dot_des: Array, integral: Array, k: float, error: Array, c_dot: Array
) -> None:
    """Write the error c_des - c, angles the short way, and the rate c_dot_des + k error + integral, all (4n,)."""
    for i in range(c.size):
        apart = c_des[i] - c[i]
        error[i] = apart - period[i] * np.rint(apart / TAU)
        c_dot[i] = c_dot_des[i] + k * error[i] + integral[i]


@portable
def limited(
    r_dot: Array, p_W: Array, v_W: Array, v_cmd_W: Array, yaw_rate: Array, order: Order, *limits_of: float
) -> tuple[float, int, int]:
    """Write velocities (n, 3) and yaw rates (n,) of r_dot (4n,), saturated and guarded.

    Returns the factor of the saturation, then what `hold_apart` does; limits_of are the fields of Limits: a tuple
    takes longer to hand over to compiled code than all else here.
    """
    limits = Limits(*limits_of)
    for i in range(yaw_rate.size):
        v_cmd_W[i, 0], v_cmd_W[i, 1], v_cmd_W[i, 2] = r_dot[4 * i], r_dot[4 * i + 1], r_dot[4 * i + 2]
        yaw_rate[i] = r_dot[4 * i + 3]
    factor = min(1.0, 1.0 / max(greatest_load(v_cmd_W, yaw_rate, limits), LOAD_MIN))
    scale(v_cmd_W, yaw_rate, factor)
    guards, alarms = hold_apart(p_W, v_W, v_cmd_W, order, *limits_of)
    if guards:
        scale(v_cmd_W, yaw_rate, 1.0 / max(greatest_load(v_cmd_W, yaw_rate, limits), 1.0))
    return factor, guards, alarms


@portable
def greatest_load(v_W: Array, yaw_rate: Array, limits: Limits) -> float:
    """Return the greatest ratio of a robot's speed, climb or yaw rate to its limit."""
    most = 0.0
    for i in range(yaw_rate.size):
        speed = math.sqrt(v_W[i, 0] * v_W[i, 0] + v_W[i, 1] * v_W[i, 1])
        most = max(most, speed / limits.speed_max_m_s)
        most = max(most, abs(v_W[i, 2]) / limits.climb_max_m_s)
        most = max(most, abs(yaw_rate[i]) / limits.yaw_rate_max_rad_s)
    return most


@portable
def scale(v_W: Array, yaw_rate: Array, factor: float) -> None:
    """Multiply velocities and yaw rates in place."""
    for i in range(yaw_rate.size):
        for k in range(3):
            v_W[i, k] *= factor
        yaw_rate[i] *= factor


@portable
def grow(integral: Array, error: Array, rate: float, clamp: Array) -> None:
    """Add rate error to the integral, within its clamp."""
    for k in range(integral.size):
        integral[k] = min(max(integral[k] + rate * error[k], -clamp[k]), clamp[k])


@portable
def hold_apart(p_W: Array, v_W: Array, v_cmd_W: Array, order: Order, *limits_of: float) -> tuple[int, int]:
    """Change commands in place until every pair separates at its least rate (see `guard`).

    Returns how many pairs were changed and how many are nearer than the alarm threshold; writes into order (n, n)
    the numbers of the former, from 1 on, above the diagonal and of the latter below it, all else zero.
    """
    limits = Limits(*limits_of)
    order[:] = 0
    near = near_pairs(p_W, max(reach(limits), limits.separation_alarm_m))
    alarms = note_alarms(p_W, near, limits.separation_alarm_m, order)
    guards = 0
    for _ in range(GUARD_SWEEPS):
        settled = True
        for k in range(near.shape[0]):
            i, j = near[k, 0], near[k, 1]
            if part(p_W, v_W, v_cmd_W, i, j, limits):
                settled = False
                if order[i, j] == 0:
                    guards += 1
                    order[i, j] = guards
        if settled:
            break
    return guards, alarms


@portable
def note_alarms(p_W: Array, near: PairTable, separation_alarm_m: float, order: Order) -> int:
    """Number those of the near pairs that are nearer than the alarm threshold, below the diagonal; return how many."""
    alarms = 0
    for k in range(near.shape[0]):
        i, j = near[k, 0], near[k, 1]
        if length(between(row(p_W, i), row(p_W, j))) < separation_alarm_m:
            alarms += 1
            order[j, i] = alarms
    return alarms


@portable
def part(p_W: Array, v_W: Array, v_cmd_W: Array, i: int, j: int, limits: Limits) -> bool:
    """Let robots i and j separate at their least rate, half of the change each; return whether they did not."""
    line_W = between(row(p_W, i), row(p_W, j))
    distance = length(line_W)
    if distance >= reach(limits):
        return False
    u_W = direction(line_W, distance)
    near = distance + min(along(u_W, v_W, i, j), 0.0) * limits.response_s
    least = (limits.separation_min_m - near) / limits.guard_horizon_s
    lacking = least - along(u_W, v_cmd_W, i, j)
    if lacking <= SETTLED_M_S:
        return False
    for k in range(3):
        v_cmd_W[i, k] -= u_W[k] * lacking / 2
        v_cmd_W[j, k] += u_W[k] * lacking / 2
    return True


@portable
def reach(limits: Limits) -> float:
    """Return the distance beyond which no two robots come too near within the horizon."""
    climb, speed = limits.climb_max_m_s, limits.speed_max_m_s
    fastest = 2.0 * math.sqrt(speed * speed + climb * climb)
    return limits.separation_min_m + fastest * (limits.guard_horizon_s + limits.response_s)


@portable
def along(u_W: Vector, v_W: Array, i: int, j: int) -> float:
    """Return the rate at which j leaves i along their line [m/s]."""
    return dot(u_W, between(row(v_W, i), row(v_W, j)))


@portable
def direction(line_W: Vector, distance: float) -> Vector:
    """Return the unit vector of a line; east where robots coincide, so that they part at all."""
    if distance < NEAR_M:
        return 1.0, 0.0, 0.0
    return line_W[0] / distance, line_W[1] / distance, line_W[2] / distance
