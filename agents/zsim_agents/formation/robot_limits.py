"""What robots may do: the saturation of their velocities, and the guard of the distances between them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.math.compiled import portable
from zsim.math.rotation import Vector, dot, norm, subtract
from zsim_agents.formation.spaces.cluster_frame import row
from zsim_agents.formation.spaces.cluster_space import Array

Pairs = tuple[tuple[int, int], ...]
Order = NDArray[np.int64]
PairTable = NDArray[np.int64]

NEAR_M = 1e-6  # robots that are nearer have no direction from one to the other
SETTLED_M_S = 1e-9  # a rate that lacks less is reached
LOAD_MIN = 1e-9  # against division by zero
GUARD_SWEEPS = 4  # passes over all pairs; one settles two robots, three robots in a corner need a few


class RobotLimits(NamedTuple):
    """What the saturation and the guard keep, for compiled code.

    Attributes:
        speed_max_m_s, climb_max_m_s, yaw_rate_max_rad_s: limits of each robot.
        separation_min_m: least distance between two robots.
        separation_alarm_m: below it two robots are reported.
        guard_horizon_s: how far ahead the guard looks.
        response_s: lag of a drone's velocity loop, over which the guard expects it to keep its velocity.
    """

    speed_max_m_s: float
    climb_max_m_s: float
    yaw_rate_max_rad_s: float
    separation_min_m: float
    separation_alarm_m: float
    guard_horizon_s: float
    response_s: float


def guard(p_W: Array, v_W: Array, v_cmd_W: Array, limits: RobotLimits) -> tuple[Array, Pairs, Pairs]:
    """Return the velocities with dangerous approaches taken out, the pairs concerned, and the pairs in alarm.

    Two robots at distance d, d' = rate of the command along their line, are held to
    d' >= -(d_near - separation_min) / guard_horizon: the distance predicted over the horizon stays above the
    minimum, and below it the approach is reversed. d_near allows for the velocities that the robots have,
    which last for their response time. Each robot of a pair takes half of the change;
    a few sweeps settle several pairs.
    """
    parted_W, order = v_cmd_W.copy(), np.empty((len(p_W), len(p_W)), np.int64)
    guards, alarms = hold_apart(p_W, v_W, parted_W, order, *limits)
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
def limited(
    r_dot: Array, p_W: Array, v_W: Array, v_cmd_W: Array, yaw_rate: Array, order: Order, *limits_of: float
) -> tuple[float, int, int]:
    """Write velocities (n, 3) and yaw rates (n,) of r_dot (4n,), saturated and guarded.

    Returns the factor of the saturation, then what `hold_apart` does; limits_of are the fields of RobotLimits: a tuple
    takes longer to hand over to compiled code than all else here.
    """
    limits = RobotLimits(*limits_of)
    for i in range(yaw_rate.size):
        v_cmd_W[i, 0], v_cmd_W[i, 1], v_cmd_W[i, 2] = r_dot[4 * i], r_dot[4 * i + 1], r_dot[4 * i + 2]
        yaw_rate[i] = r_dot[4 * i + 3]
    factor = min(1.0, 1.0 / max(load(v_cmd_W, yaw_rate, limits), LOAD_MIN))
    scale(v_cmd_W, yaw_rate, factor)
    guards, alarms = hold_apart(p_W, v_W, v_cmd_W, order, *limits_of)
    if guards:
        scale(v_cmd_W, yaw_rate, 1.0 / max(load(v_cmd_W, yaw_rate, limits), 1.0))
    return factor, guards, alarms


@portable
def load(v_W: Array, yaw_rate: Array, limits: RobotLimits) -> float:
    """Return the greatest ratio of a robot's speed, climb or yaw rate to its limit; 1 is at the limit."""
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
def near_pairs(p_W: Array, within_m: float) -> PairTable:
    """Return the pairs (m, 2), i < j, by j and then by i, of positions (n, 3) that are nearer than a distance."""
    n = p_W.shape[0]
    pairs, count = np.empty((n * (n - 1) // 2, 2), np.int64), 0
    for j in range(1, n):
        for i in range(j):
            x, y, z = p_W[j, 0] - p_W[i, 0], p_W[j, 1] - p_W[i, 1], p_W[j, 2] - p_W[i, 2]
            if not math.sqrt(x * x + y * y + z * z) >= within_m:  # also true for NaN
                pairs[count, 0], pairs[count, 1] = i, j
                count += 1
    return pairs[:count]


@portable
def hold_apart(p_W: Array, v_W: Array, v_cmd_W: Array, order: Order, *limits_of: float) -> tuple[int, int]:
    """Change commands in place until every pair separates at its least rate (see `guard`).

    Returns how many pairs were changed and how many are nearer than the alarm threshold; writes into order (n, n)
    the numbers of the former, from 1 on, above the diagonal and of the latter below it, all else zero.
    """
    limits = RobotLimits(*limits_of)
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
        if norm(subtract(row(p_W, j), row(p_W, i))) < separation_alarm_m:
            alarms += 1
            order[j, i] = alarms
    return alarms


@portable
def part(p_W: Array, v_W: Array, v_cmd_W: Array, i: int, j: int, limits: RobotLimits) -> bool:
    """Let robots i and j separate at their least rate, half of the change each; return whether they did not."""
    line_W = subtract(row(p_W, j), row(p_W, i))
    distance = norm(line_W)
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
def reach(limits: RobotLimits) -> float:
    """Return the distance beyond which no two robots come too near within the horizon."""
    climb, speed = limits.climb_max_m_s, limits.speed_max_m_s
    fastest = 2.0 * math.sqrt(speed * speed + climb * climb)
    return limits.separation_min_m + fastest * (limits.guard_horizon_s + limits.response_s)


@portable
def along(u_W: Vector, v_W: Array, i: int, j: int) -> float:
    """Return the rate at which j leaves i along their line [m/s]."""
    return dot(u_W, subtract(row(v_W, j), row(v_W, i)))


@portable
def direction(line_W: Vector, distance: float) -> Vector:
    """Return the unit vector of a line; east where robots coincide, so that they part at all."""
    if distance < NEAR_M:
        return 1.0, 0.0, 0.0
    return line_W[0] / distance, line_W[1] / distance, line_W[2] / distance
