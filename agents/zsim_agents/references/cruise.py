"""Tracking of a reference, cruise paths to goals, and courses of drones that receive new goals at any time. Pure.

The commanded velocity is the reference's, taken ahead by the lag of the drone's velocity loop, plus a gain times the
position error. To first order, the lead amounts to an acceleration feed-forward that needs no second derivative.

A cruise path leads from any motion to rest at a goal, at a cruise speed and within limits of speed and acceleration.
It has three parts. At constant full acceleration a, the velocity changes from the initial v to the cruise velocity q
in t1; the drone cruises at q for t2; it brakes along q in t3 = |q| / a and is at rest at the goal. From rest, the path
is a straight line with a trapezoidal speed profile: Biagiotti and Melchiorri, Trajectory Planning for Automatic
Machines and Robots, Springer 2008, chapter 3.

Let D lead from start to goal; then D - v t1/2 = q (t1/2 + t2 + t3/2). So t1 determines both the direction of q and its
length: the cruise speed, or less where t2 would be negative, with |q|^2 / 2a + |q| t1/2 = |D - v t1/2|. t1 solves
|q(t1) - v| = a t1. Since q(t1) is continuous and bounded, a solution exists, at most the time of the largest possible
change of velocity. Any velocity between two that satisfy the limits satisfies them too. Planned anew from any state
on a path, the path to the same goal is the remainder of the old one.

Horizontal and vertical limits differ: |.| above stands for the larger of the horizontal and the vertical component,
each divided by its limit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from zsim.math import elementary as el
from zsim.math.rotation import Vector
from zsim.scenario.scenario import Piloted
from zsim_agents.formation.spaces.cluster_space import Array
from zsim_agents.references.path import DEGREE, LEAST_S, SHARE, PathLimits, PiecewisePolynomial

K_YAW_1_S = 1.0  # gain of the heading loop; design choice: a decade below the yaw loop's bandwidth
LOST_M = 2.0  # deviation beyond which the path is planned anew; design choice: above the tracking error without wind
RISE_S = 0.5  # time in which climb and yaw rates rise from 0 to their limits; design choice: above both loops' lags
HALVINGS = 60  # bisection steps: enough to determine a time to the last bit
SHORT_S = 1e-9  # duration below which a part is omitted

Four = Sequence[float]
"""x, y, z [m; W] and yaw [rad], or their rates."""
Axes = tuple[float | None, float | None, float | None, float | None]
"""Like `Four`, with None for an axis without a goal."""


class Cruise(NamedTuple):
    """Cruise speeds [m/s]; the drone's limits apply where they are lower."""

    horizontal_m_s: float = math.inf
    up_m_s: float = math.inf
    down_m_s: float = math.inf


FREE = Cruise()


class Course:
    """The successive paths of a drone that may receive a new goal at any time.

    A new path starts in the current state of the previous one, or in the drone's own state if the drone has no path or
    is more than LOST_M off it. An axis without a goal follows its rate; an axis with a goal and a rate tracks both
    directly, without a path.

    Args:
        limits: limits of the drone; a path uses SHARE of the acceleration.
    """

    def __init__(self, limits: PathLimits, law: Piloted) -> None:
        self._limits, self._law = limits._replace(accel_m_s2=SHARE * limits.accel_m_s2), law
        self._goal: Axes | None = None
        self._rate: Four = (0.0,) * 4
        self._speeds = FREE
        self._way: PiecewisePolynomial | None = None
        self._begun_s = 0.0

    def leave(self) -> None:
        """Clear the path: the next one starts at the drone."""
        self._goal = self._way = None

    def send(
        self, goal: Axes, t_s: float, here: Four, moving: Four, rate: Four = (0.0,) * 4, speeds: Cruise = FREE
    ) -> None:
        """Set the goal and the rate to follow; `here` and `moving` are the drone's own position and rate at `t_s`."""
        own, own_rate = self._motion(t_s, here, moving)
        self._goal, self._rate, self._speeds = goal, rate, speeds
        self._begin(t_s, own, own_rate)

    def stop(self, t_s: float, here: Four, moving: Four) -> Vector:
        """Return the position [m; W] where the drone can come to rest; arguments as in `send`."""
        own, rate = (np.array(each, float) for each in self._motion(t_s, here, moving))
        x, y, z = cruise_to_rest(own, self._limits, rate).value(math.inf)[0][:3].tolist()
        return x, y, z

    def velocity(self, t_s: float, here: Four, moving: Four) -> tuple[Vector, float]:
        """Return the velocity [m/s; W] and yaw rate [rad/s] to command; arguments as in `send`.

        Raises:
            RuntimeError: no goal has been set.
        """
        goal = self._goal
        if goal is None:
            raise RuntimeError("velocity: the drone has not been sent anywhere")
        if self._is_lost(t_s, here):
            self._begin(t_s, here, moving)
        place = [own if to is None else to for own, to in zip(here, goal, strict=True)]
        ahead = list(self._rate)
        if self._way is not None:
            now, (_, later) = self._state(t_s)[0], self._state(t_s + self._law.lead_s)
            for k in self._axes():
                place[k], ahead[k] = now[k], later[k]
        limits, speeds = self._limits, self._speeds
        most = min(limits.speed_m_s, speeds.horizontal_m_s), min(limits.climb_m_s, speeds.up_m_s)
        bounds = PathLimits(*most, limits.yaw_rate_rad_s, limits.accel_m_s2)
        velocity, turn = velocity_towards(place, ahead, here, bounds, self._law, speeds.down_m_s)
        return velocity, self._rate[3] if goal[3] is None else turn

    def _motion(self, t_s: float, here: Four, moving: Four) -> tuple[Four, Four]:
        """Return position and rate: those of the path on the axes it controls, those of the drone on the others."""
        own, rate = list(here), list(moving)
        if self._way is not None and not self._is_lost(t_s, here):
            place, pace = self._state(t_s)
            for k in self._axes():
                own[k], rate[k] = place[k], pace[k]
        return own, rate

    def _axes(self) -> list[int]:
        """Return the axes that the path controls: those with a goal and no rate."""
        goal = self._goal or (None,) * 4
        return [k for k in range(4) if goal[k] is not None and self._rate[k] == 0.0]

    def _begin(self, t_s: float, here: Four, moving: Four) -> None:
        led, goal = self._axes(), self._goal
        if not led or goal is None:
            self._way = None
            return
        start, rate = np.array(here, float), np.zeros(4)
        rate[led] = np.array(moving)[led]
        to = start.copy()
        to[led] = [goal[k] for k in led]
        self._way, self._begun_s = cruise(start, to, self._limits, rate, self._speeds), t_s

    def _state(self, t_s: float) -> tuple[list[float], list[float]]:
        place, rate = (self._way.value(t_s - self._begun_s)) if self._way else (np.zeros(4), np.zeros(4))
        return place.tolist(), rate.tolist()

    def _is_lost(self, t_s: float, here: Four) -> bool:
        if self._way is None:
            return False
        place, _ = self._state(t_s)
        return el.length(place[k] - here[k] for k in self._axes() if k < 3) > LOST_M


def velocity_towards(
    place: Four, ahead: Four, here: Four, limits: PathLimits, law: Piloted, down_m_s: float = math.inf
) -> tuple[Vector, float]:
    """Return the velocity [m/s; W] and yaw rate [rad/s] with which a drone at `here` tracks a reference at `place`.

    Args:
        ahead: rate of the reference `law.lead_s` later.
        limits: limits of the result.
        down_m_s: limit of the descent, if lower than that in `limits`.
    """
    x, y, z = (v + law.gain_1_s * (p - own) for v, p, own in zip(ahead[:3], place[:3], here[:3], strict=True))
    speed = el.hypot(x, y)
    share = min(1.0, limits.speed_m_s / speed) if speed else 1.0
    turn = ahead[3] + K_YAW_1_S * math.remainder(place[3] - here[3], math.tau)
    up, down, most = limits.climb_m_s, min(limits.climb_m_s, down_m_s), limits.yaw_rate_rad_s
    return (x * share, y * share, min(max(z, -down), up)), min(max(turn, -most), most)


class _Bounds(NamedTuple):
    """Limits of velocity and acceleration: horizontal, for x and y together, and vertical."""

    speed: float
    up: float
    down: float
    accel: float
    accel_z: float

    def rise_s(self, x: float, y: float, z: float) -> float:
        """Return the time that a change of velocity takes at full acceleration [s]."""
        return max(el.hypot(x, y) / self.accel, abs(z) / self.accel_z)

    def speed_along(self, x: float, y: float, z: float) -> float:
        """Return the maximum speed in a direction [m/s]."""
        aside, climb = el.hypot(x, y), self.up if z > 0.0 else self.down
        return min(self.speed / aside if aside else math.inf, climb / abs(z) if z else math.inf)


class _Part(NamedTuple):
    """A part of a path at constant acceleration; `place` and `velocity` are those at its start."""

    duration_s: float
    place: Vector
    velocity: Vector
    accel: Vector


STILL: Vector = (0.0, 0.0, 0.0)


def cruise(
    start: Array, goal: Array, limits: PathLimits, rate: Array | None = None, speeds: Cruise = FREE
) -> PiecewisePolynomial:
    """Return the path from a position (4,) with a rate (4,), by default 0, to rest at a goal (4,).

    The drone turns the shorter way, independently of its translation.

    Args:
        limits: limits of the speeds and of the horizontal acceleration; climb and yaw rates reach theirs in RISE_S.
    """
    vx, vy, vz, turning = (0.0, 0.0, 0.0, 0.0) if rate is None else rate.tolist()
    (x, y, z, yaw), (to_x, to_y, to_z, to_yaw) = start.tolist(), goal.tolist()
    speed = min(limits.speed_m_s, speeds.horizontal_m_s)
    up, down = min(limits.climb_m_s, speeds.up_m_s), min(limits.climb_m_s, speeds.down_m_s)
    bounds = _Bounds(speed, up, down, limits.accel_m_s2, limits.climb_m_s / RISE_S)
    turn = limits.yaw_rate_rad_s
    way = _parts((x, y, z), (vx, vy, vz), (to_x, to_y, to_z), bounds)
    turns = _Bounds(turn, turn, turn, turn / RISE_S, turn / RISE_S)
    turned = yaw + math.remainder(to_yaw - yaw, math.tau)
    return _polynomials(way, _parts((yaw, 0.0, 0.0), (turning, 0.0, 0.0), (turned, 0.0, 0.0), turns))


def cruise_through(
    start: Array,
    goals: Sequence[Array],
    limits: PathLimits,
    rate: Array | None = None,
    speeds: Cruise = FREE,
    radius_m: float = 0.0,
) -> PiecewisePolynomial:
    """Return the path through goals (4,) to rest at the last one; other arguments as in `cruise`.

    Within `radius_m` of each earlier goal it turns towards the next one; 0: it comes to rest at each.
    """
    durations: list[Array] = []
    coefficients: list[Array] = []
    for goal in goals:
        way = cruise(start, goal, limits, rate, speeds)
        end_s = way.duration_s or 0.0
        if radius_m and goal is not goals[-1]:
            early, late = 0.0, end_s
            for _ in range(HALVINGS):
                middle = (early + late) / 2.0
                near = el.distance(way.value(middle)[0][:3].tolist(), goal[:3].tolist()) <= radius_m
                early, late = (early, middle) if near else (middle, late)
            end_s = late
            way = way.until(end_s)
        start, rate = way.value(end_s)
        durations.append(way.durations_s)
        coefficients.append(way.coefficients)
    return PiecewisePolynomial(np.concatenate(durations), np.concatenate(coefficients))


def cruise_to_rest(start: Array, limits: PathLimits, rate: Array) -> PiecewisePolynomial:
    """Return the shortest straight path on which a drone moving at a rate (4,) comes to rest."""
    aside, climb, turn = el.hypot(rate[0], rate[1]), abs(float(rate[2])), abs(float(rate[3]))
    rise_s = max(aside / limits.accel_m_s2, climb / limits.climb_m_s * RISE_S), turn / limits.yaw_rate_rad_s * RISE_S
    stop = start + rate * np.array([*(rise_s[0],) * 3, rise_s[1]]) / 2.0
    return cruise(start, stop, limits, rate)


def _parts(start: Vector, velocity: Vector, goal: Vector, bounds: _Bounds) -> list[_Part]:
    """Return the parts of a path, without those of zero duration."""
    x, y, z = (to - from_ for to, from_ in zip(goal, start, strict=True))
    vx, vy, vz = velocity

    def cruise_after(t1: float) -> tuple[Vector, float]:
        """Return q for `t1`, and the time from the middle of the first part to the middle of the last."""
        along = x - vx * t1 / 2.0, y - vy * t1 / 2.0, z - vz * t1 / 2.0
        left = el.length(along)
        if left == 0.0:
            return STILL, 0.0
        ex, ey, ez = (each / left for each in along)
        half, accel = t1 / 2.0, 1.0 / bounds.rise_s(ex, ey, ez)
        least = 2.0 * left / (half + math.sqrt(half * half + 2.0 * left / accel))  # |q| for which t2 is 0
        q = min(bounds.speed_along(ex, ey, ez), least)
        return (q * ex, q * ey, q * ez), left / q

    t1 = 0.0
    if any(velocity):
        early, t1 = 0.0, bounds.rise_s(bounds.speed, 0.0, max(bounds.up, bounds.down)) + bounds.rise_s(*velocity)
        for _ in range(HALVINGS):
            middle = (early + t1) / 2.0
            (qx, qy, qz), _ = cruise_after(middle)
            early, t1 = (early, middle) if bounds.rise_s(qx - vx, qy - vy, qz - vz) <= middle else (middle, t1)
    elif (rise_s := bounds.rise_s(x, y, z)) > 0.0:  # of the displacement as if a velocity; if t2 = 0, |q| t1 = |D|
        t1 = min(math.sqrt(rise_s), rise_s * bounds.speed_along(x, y, z))
    (qx, qy, qz), over_s = cruise_after(t1)
    parts = []
    if t1 > SHORT_S:
        accel = (qx - vx) / t1, (qy - vy) / t1, (qz - vz) / t1
        parts.append(_Part(t1, start, velocity, accel))
        start = _moved(start, velocity, accel, t1)
    t3 = bounds.rise_s(qx, qy, qz)
    t2 = over_s - t1 / 2.0 - t3 / 2.0
    if t2 > SHORT_S:
        parts.append(_Part(t2, start, (qx, qy, qz), STILL))
        start = _moved(start, (qx, qy, qz), STILL, t2)
    if t3 > SHORT_S:
        parts.append(_Part(t3, start, (qx, qy, qz), (-qx / t3, -qy / t3, -qz / t3)))
    return parts or [_Part(LEAST_S, goal, STILL, STILL)]


def _moved(place: Vector, velocity: Vector, accel: Vector, t: float) -> Vector:
    x, y, z = (p + v * t + a * t * t / 2.0 for p, v, a in zip(place, velocity, accel, strict=True))
    return x, y, z


def _polynomials(way: list[_Part], turn: list[_Part]) -> PiecewisePolynomial:
    """Return a translation and a turn that start together as one path."""
    begins = [_begins(way), _begins(turn)]
    times = sorted({t for each in begins for t in each})
    kept = [t for t, after in pairwise(times) if after - t > SHORT_S]
    coefficients = np.zeros((len(kept), DEGREE + 1, 4))
    for row, t in zip(coefficients, kept, strict=True):
        for parts, own, columns in zip((way, turn), begins, (slice(0, 3), slice(3, 4)), strict=True):
            count = columns.stop - columns.start
            place, velocity, accel = _state(parts, own, t)
            row[:3, columns] = np.array([place[:count], velocity[:count], [a / 2.0 for a in accel[:count]]])
    return PiecewisePolynomial(np.diff([*kept, times[-1]]), coefficients)


def _begins(parts: list[_Part]) -> list[float]:
    """Return the start times of the parts, and the end of the last one."""
    times = [0.0]
    for part in parts:
        times.append(times[-1] + part.duration_s)
    return times


def _state(parts: list[_Part], begins: list[float], t: float) -> tuple[Vector, Vector, Vector]:
    """Return position, velocity and acceleration at `t`; at a boundary, of the later part; rest after the last."""
    number = max(k for k, begin in enumerate(begins) if begin <= t)
    if number == len(parts):
        last = parts[-1]
        return _moved(last.place, last.velocity, last.accel, last.duration_s), STILL, STILL
    part, own = parts[number], t - begins[number]
    x, y, z = (v + a * own for v, a in zip(part.velocity, part.accel, strict=True))
    return _moved(part.place, part.velocity, part.accel, own), (x, y, z), part.accel
