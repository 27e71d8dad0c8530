"""Paths to places at a cruise speed, from any motion, within limits of speed and acceleration. Pure.

A way has three parts. The velocity changes from v, that at the start, into q, that of the cruise, straight and at full
acceleration a, in t1; the drone flies on at q for t2; it brakes straight, in t3 = |q| / a, and rests at the goal. From
rest it is a straight line with the trapezoidal profile of speed: Biagiotti and Melchiorri, Trajectory Planning for
Automatic Machines and Robots, Springer 2008, chapter 3.

With D from start to goal, D - v t1/2 = q (t1/2 + t2 + t3/2). So t1 alone gives q: its direction, and its length, the
cruise speed, or less where t2 would be negative: |q|^2 / 2a + |q| t1/2 = |D - v t1/2|. t1 solves |q(t1) - v| = a t1,
which has a solution below the greatest t1 that any q needs, because q depends continuously on it. Velocities between
two within the limits are within them. From any state on a way, the way to its goal is what is left of it.

Horizontal and vertical limits differ: the lengths above are the greater one of both shares of the limits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from zsim.math import elementary as el
from zsim.math.rotation import Vector
from zsim_agents.formation.spaces.cluster_space import Array
from zsim_agents.references.path import LEAST_S, PathLimits, PiecewisePolynomial

RISE_S = 0.5  # in which climb and turn rise to their limits; chosen: above the lags of the loops of both
HALVINGS = 60  # of the range in which t1 is looked for: to the last bit
SHORT_S = 1e-9  # shorter parts are left out
COEFFICIENTS = 8  # of a piece of `PiecewisePolynomial`


class Cruise(NamedTuple):
    """Cruise speeds [m/s], which apply if lower than the limits."""

    horizontal_m_s: float = math.inf
    up_m_s: float = math.inf
    down_m_s: float = math.inf


FREE = Cruise()


class _Bounds(NamedTuple):
    """Of velocities and accelerations along x and y together, and along z."""

    speed: float
    up: float
    down: float
    accel: float
    accel_z: float

    def rise_s(self, x: float, y: float, z: float) -> float:
        """Return the time of a change of velocity [s]."""
        return max(el.hypot(x, y) / self.accel, abs(z) / self.accel_z)

    def speed_along(self, x: float, y: float, z: float) -> float:
        """Return the maximum speed in a direction [m/s]."""
        aside, climb = el.hypot(x, y), self.up if z > 0.0 else self.down
        return min(self.speed / aside if aside else math.inf, climb / abs(z) if z else math.inf)


class _Part(NamedTuple):
    """A part of a path with constant acceleration: its duration, and position and velocity at its start."""

    duration_s: float
    place: Vector
    velocity: Vector
    accel: Vector


STILL: Vector = (0.0, 0.0, 0.0)


def cruise(
    start: Array, goal: Array, limits: PathLimits, rate: Array | None = None, speeds: Cruise = FREE
) -> PiecewisePolynomial:
    """Return the path from a place (4,), with a rate (4,) that is 0 by default, to rest at another one.

    The yaw turns by the shorter way, independently of the translation.

    Args:
        limits: of speeds and horizontal acceleration; climb and turn reach their limits in RISE_S.
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
    """Return the path through places (4,) to rest at the last one.

    Within radius_m of each other place it turns towards the next one; 0: it rests at each.
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
    """Return the shortest straight path to rest of a drone moving at a rate (4,)."""
    aside, climb, turn = el.hypot(rate[0], rate[1]), abs(float(rate[2])), abs(float(rate[3]))
    rise_s = max(aside / limits.accel_m_s2, climb / limits.climb_m_s * RISE_S), turn / limits.yaw_rate_rad_s * RISE_S
    stop = start + rate * np.array([*(rise_s[0],) * 3, rise_s[1]]) / 2.0
    return cruise(start, stop, limits, rate)


def _parts(start: Vector, velocity: Vector, goal: Vector, bounds: _Bounds) -> list[_Part]:
    """Return the parts of a path with a duration."""
    x, y, z = (to - from_ for to, from_ in zip(goal, start, strict=True))
    vx, vy, vz = velocity

    def cruise_after(t1: float) -> tuple[Vector, float]:
        """Return q, and the time from the middle of the first part to that of the last one."""
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
    elif (rise_s := bounds.rise_s(x, y, z)) > 0.0:  # of the way as a velocity; |q| t1 is its length where t2 is 0
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
    """Return a translation and a turn that begin together as one path."""
    begins = [_begins(way), _begins(turn)]
    times = sorted({t for each in begins for t in each})
    kept = [t for t, after in pairwise(times) if after - t > SHORT_S]
    coefficients = np.zeros((len(kept), COEFFICIENTS, 4))
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
    """Return position, velocity and acceleration from t on; at rest after the last part."""
    number = max(k for k, begin in enumerate(begins) if begin <= t)
    if number == len(parts):
        last = parts[-1]
        return _moved(last.place, last.velocity, last.accel, last.duration_s), STILL, STILL
    part, own = parts[number], t - begins[number]
    x, y, z = (v + a * own for v, a in zip(part.velocity, part.accel, strict=True))
    return _moved(part.place, part.velocity, part.accel, own), (x, y, z), part.accel
