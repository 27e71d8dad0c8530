"""Tracking of a reference, cruise paths to goals, and courses of drones that receive new goals at any time. No I/O.

The commanded velocity is the reference's, evaluated one lag of the drone's velocity loop ahead, plus a gain times the
position error. To first order, the lead amounts to an acceleration feed-forward that needs no second derivative.

A cruise path leads from any motion to rest at a goal, at a cruise speed and within limits of speed and acceleration.
It has three parts. At constant full acceleration a, the velocity changes from the initial v to the cruise velocity q
in t1; the drone cruises at q for t2; it brakes along q in t3 = |q| / a and is at rest at the goal. From rest, the path
is a straight line with a trapezoidal speed profile: Biagiotti and Melchiorri, Trajectory Planning for Automatic
Machines and Robots, Springer 2008, chapter 3.

Let D be the displacement from start to goal; then D - v t1/2 = q (t1/2 + t2 + t3/2). So t1 determines both the
direction of q and its length: the cruise speed, or less where t2 would be negative, with
|q|^2 / 2a + |q| t1/2 = |D - v t1/2|. t1 solves |q(t1) - v| = a t1. Since q(t1) is continuous and bounded, a solution
exists, no later than the duration of the largest change of velocity. Any velocity between two that satisfy the limits
satisfies them too. A path planned anew from any state on a path to the same goal is the remainder of that path.

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
from zsim_agents.references.path import DEGREE, DURATION_MIN_S, SHARE, PathLimits, PiecewisePolynomial

K_YAW_1_S = 1.0  # gain of the heading loop; design choice: a decade below the yaw loop's bandwidth
DEVIATION_MAX_M = 2.0  # beyond it, the path is replanned; design choice: above the tracking error without wind
RISE_S = 0.5  # time in which climb and yaw rates rise from 0 to their limits; design choice: above both loops' lags
HALVINGS = 60  # bisection steps: enough to determine a time to the last bit
SHORT_S = 1e-9  # duration below which a part is omitted

Vector4 = Sequence[float]
"""x, y, z [m; W] and yaw [rad], or their rates."""
Axes = tuple[float | None, float | None, float | None, float | None]
"""Like `Vector4`, with None for an axis without a goal."""


class Cruise(NamedTuple):
    """Cruise speeds [m/s]; the drone's limits apply where they are lower."""

    horizontal_m_s: float = math.inf
    up_m_s: float = math.inf
    down_m_s: float = math.inf


UNLIMITED = Cruise()


class Course:
    """The successive paths of a drone that may receive a new goal at any time.

    A new path starts in the current state of the previous one, or in the drone's own state if the drone has no path or
    is more than DEVIATION_MAX_M off it. An axis without a goal follows its rate; one with a goal and a rate tracks both
    directly, without a path.

    Args:
        limits: limits of the drone; a path uses SHARE of the acceleration.
    """

    def __init__(self, limits: PathLimits, law: Piloted) -> None:
        self._limits, self._law = limits._replace(accel_m_s2=SHARE * limits.accel_m_s2), law
        self._goal: Axes | None = None
        self._rate: Vector4 = (0.0,) * 4
        self._speeds = UNLIMITED
        self._path: PiecewisePolynomial | None = None
        self._path_start_s = 0.0

    def leave(self) -> None:
        """Clear the path: the next one starts at the drone."""
        self._goal = self._path = None

    def send(
        self,
        goal: Axes,
        t_s: float,
        position: Vector4,
        drone_rate: Vector4,
        rate: Vector4 = (0.0,) * 4,
        speeds: Cruise = UNLIMITED,
    ) -> None:
        """Set the goal and the rate to follow; `position` and `drone_rate` are those of the drone at `t_s`."""
        start, start_rate = self._motion(t_s, position, drone_rate)
        self._goal, self._rate, self._speeds = goal, rate, speeds
        self._begin(t_s, start, start_rate)

    def stop(self, t_s: float, position: Vector4, drone_rate: Vector4) -> Vector:
        """Return the position [m; W] where the drone can come to rest; arguments as in `send`."""
        start, rate = (np.array(each, float) for each in self._motion(t_s, position, drone_rate))
        x, y, z = cruise_to_rest(start, self._limits, rate).value(math.inf)[0][:3].tolist()
        return x, y, z

    def velocity(self, t_s: float, position: Vector4, drone_rate: Vector4) -> tuple[Vector, float]:
        """Return the velocity [m/s; W] and yaw rate [rad/s] to command; arguments as in `send`.

        Raises:
            RuntimeError: no goal has been set.
        """
        goal = self._goal
        if goal is None:
            raise RuntimeError("velocity: the drone has not been sent anywhere")
        if self._is_off_path(t_s, position):
            self._begin(t_s, position, drone_rate)
        target = [own if to is None else to for own, to in zip(position, goal, strict=True)]
        target_rate = list(self._rate)
        if self._path is not None:
            path_position, (_, future_rate) = self._state(t_s)[0], self._state(t_s + self._law.lead_s)
            for k in self._axes():
                target[k], target_rate[k] = path_position[k], future_rate[k]
        limits, speeds = self._limits, self._speeds
        speeds_max = min(limits.speed_m_s, speeds.horizontal_m_s), min(limits.climb_m_s, speeds.up_m_s)
        bounds = PathLimits(*speeds_max, limits.yaw_rate_rad_s, limits.accel_m_s2)
        velocity, turn = velocity_towards(target, target_rate, position, bounds, self._law, speeds.down_m_s)
        return velocity, self._rate[3] if goal[3] is None else turn

    def _motion(self, t_s: float, position: Vector4, drone_rate: Vector4) -> tuple[Vector4, Vector4]:
        """Return position and rate: those of the path on the axes it controls, those of the drone on the others."""
        start, rate = list(position), list(drone_rate)
        if self._path is not None and not self._is_off_path(t_s, position):
            path_position, path_rate = self._state(t_s)
            for k in self._axes():
                start[k], rate[k] = path_position[k], path_rate[k]
        return start, rate

    def _axes(self) -> list[int]:
        """Return the axes that the path controls: those with a goal and no rate."""
        goal = self._goal or (None,) * 4
        return [k for k in range(4) if goal[k] is not None and self._rate[k] == 0.0]

    def _begin(self, t_s: float, position: Vector4, drone_rate: Vector4) -> None:
        path_axes, goal = self._axes(), self._goal
        if not path_axes or goal is None:
            self._path = None
            return
        start, rate = np.array(position, float), np.zeros(4)
        rate[path_axes] = np.array(drone_rate)[path_axes]
        end = start.copy()
        end[path_axes] = [goal[k] for k in path_axes]
        self._path, self._path_start_s = cruise(start, end, self._limits, rate, self._speeds), t_s

    def _state(self, t_s: float) -> tuple[list[float], list[float]]:
        path_position, rate = (self._path.value(t_s - self._path_start_s)) if self._path else (np.zeros(4), np.zeros(4))
        return path_position.tolist(), rate.tolist()

    def _is_off_path(self, t_s: float, position: Vector4) -> bool:
        if self._path is None:
            return False
        path_position, _ = self._state(t_s)
        return el.length(path_position[k] - position[k] for k in self._axes() if k < 3) > DEVIATION_MAX_M


def velocity_towards(
    target: Vector4,
    target_rate: Vector4,
    position: Vector4,
    limits: PathLimits,
    law: Piloted,
    down_m_s: float = math.inf,
) -> tuple[Vector, float]:
    """Return the velocity [m/s; W] and yaw rate [rad/s] for a drone at `position` to track a reference at `target`.

    Args:
        target_rate: rate of the reference `law.lead_s` later.
        limits: limits of the result.
        down_m_s: limit of the descent, if lower than that in `limits`.
    """
    x, y, z = (
        v + law.gain_1_s * (p - own) for v, p, own in zip(target_rate[:3], target[:3], position[:3], strict=True)
    )
    speed = el.hypot(x, y)
    scale = min(1.0, limits.speed_m_s / speed) if speed else 1.0
    turn = target_rate[3] + K_YAW_1_S * math.remainder(target[3] - position[3], math.tau)
    up, down, yaw_rate_max = limits.climb_m_s, min(limits.climb_m_s, down_m_s), limits.yaw_rate_rad_s
    return (x * scale, y * scale, min(max(z, -down), up)), min(max(turn, -yaw_rate_max), yaw_rate_max)


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
        horizontal, climb = el.hypot(x, y), self.up if z > 0.0 else self.down
        return min(self.speed / horizontal if horizontal else math.inf, climb / abs(z) if z else math.inf)


class _Segment(NamedTuple):
    """A part of a path at constant acceleration; `position` and `velocity` are those at its start."""

    duration_s: float
    position: Vector
    velocity: Vector
    accel: Vector


ZERO: Vector = (0.0, 0.0, 0.0)


def cruise(
    start: Array, goal: Array, limits: PathLimits, rate: Array | None = None, speeds: Cruise = UNLIMITED
) -> PiecewisePolynomial:
    """Return the path from a position (4,) with a rate (4,), by default 0, to rest at a goal (4,).

    The drone turns the shorter way, independently of its translation.

    Args:
        limits: limits of the speeds and of the horizontal acceleration; climb and yaw rates reach theirs in RISE_S.
    """
    vx, vy, vz, yaw_rate = (0.0, 0.0, 0.0, 0.0) if rate is None else rate.tolist()
    (x, y, z, yaw), (to_x, to_y, to_z, to_yaw) = start.tolist(), goal.tolist()
    speed = min(limits.speed_m_s, speeds.horizontal_m_s)
    up, down = min(limits.climb_m_s, speeds.up_m_s), min(limits.climb_m_s, speeds.down_m_s)
    bounds = _Bounds(speed, up, down, limits.accel_m_s2, limits.climb_m_s / RISE_S)
    yaw_rate_max = limits.yaw_rate_rad_s
    translation = _segments((x, y, z), (vx, vy, vz), (to_x, to_y, to_z), bounds)
    yaw_bounds = _Bounds(yaw_rate_max, yaw_rate_max, yaw_rate_max, yaw_rate_max / RISE_S, yaw_rate_max / RISE_S)
    end_yaw = yaw + math.remainder(to_yaw - yaw, math.tau)
    return _polynomials(translation, _segments((yaw, 0.0, 0.0), (yaw_rate, 0.0, 0.0), (end_yaw, 0.0, 0.0), yaw_bounds))


def cruise_through(
    start: Array,
    goals: Sequence[Array],
    limits: PathLimits,
    rate: Array | None = None,
    speeds: Cruise = UNLIMITED,
    radius_m: float = 0.0,
) -> PiecewisePolynomial:
    """Return the path through goals (4,) to rest at the last one; other arguments as in `cruise`.

    Within `radius_m` of each earlier goal it turns towards the next one; 0: it comes to rest at each.
    """
    durations: list[Array] = []
    coefficients: list[Array] = []
    for goal in goals:
        path = cruise(start, goal, limits, rate, speeds)
        end_s = path.duration_s or 0.0
        if radius_m and goal is not goals[-1]:
            low_s, high_s = 0.0, end_s
            for _ in range(HALVINGS):
                middle_s = (low_s + high_s) / 2.0
                is_near = el.distance(path.value(middle_s)[0][:3].tolist(), goal[:3].tolist()) <= radius_m
                low_s, high_s = (low_s, middle_s) if is_near else (middle_s, high_s)
            end_s = high_s
            path = path.until(end_s)
        start, rate = path.value(end_s)
        durations.append(path.durations_s)
        coefficients.append(path.coefficients)
    return PiecewisePolynomial(np.concatenate(durations), np.concatenate(coefficients))


def cruise_to_rest(start: Array, limits: PathLimits, rate: Array) -> PiecewisePolynomial:
    """Return the shortest straight path on which a drone moving at a rate (4,) comes to rest."""
    horizontal, climb, turn = el.hypot(rate[0], rate[1]), abs(float(rate[2])), abs(float(rate[3]))
    rise_s = (
        max(horizontal / limits.accel_m_s2, climb / limits.climb_m_s * RISE_S),
        turn / limits.yaw_rate_rad_s * RISE_S,
    )
    stop = start + rate * np.array([*(rise_s[0],) * 3, rise_s[1]]) / 2.0
    return cruise(start, stop, limits, rate)


def _segments(start: Vector, velocity: Vector, goal: Vector, bounds: _Bounds) -> list[_Segment]:
    """Return the parts of a path, without those of zero duration."""
    x, y, z = (to - from_ for to, from_ in zip(goal, start, strict=True))
    vx, vy, vz = velocity

    def cruise_after(t1: float) -> tuple[Vector, float]:
        """Return q for `t1`, and the time from the middle of the first part to the middle of the last."""
        displacement = x - vx * t1 / 2.0, y - vy * t1 / 2.0, z - vz * t1 / 2.0
        distance = el.length(displacement)
        if distance == 0.0:
            return ZERO, 0.0
        ex, ey, ez = (each / distance for each in displacement)
        half, accel = t1 / 2.0, 1.0 / bounds.rise_s(ex, ey, ez)
        peak_speed = 2.0 * distance / (half + math.sqrt(half * half + 2.0 * distance / accel))  # |q| for which t2 is 0
        q = min(bounds.speed_along(ex, ey, ez), peak_speed)
        return (q * ex, q * ey, q * ez), distance / q

    t1 = 0.0
    if any(velocity):
        low, t1 = 0.0, bounds.rise_s(bounds.speed, 0.0, max(bounds.up, bounds.down)) + bounds.rise_s(*velocity)
        for _ in range(HALVINGS):
            middle = (low + t1) / 2.0
            (qx, qy, qz), _ = cruise_after(middle)
            low, t1 = (low, middle) if bounds.rise_s(qx - vx, qy - vy, qz - vz) <= middle else (middle, t1)
    elif (rise_s := bounds.rise_s(x, y, z)) > 0.0:  # with the displacement as velocity; if t2 = 0, |q| t1 = |D|
        t1 = min(math.sqrt(rise_s), rise_s * bounds.speed_along(x, y, z))
    (qx, qy, qz), over_s = cruise_after(t1)
    segments = []
    if t1 > SHORT_S:
        accel = (qx - vx) / t1, (qy - vy) / t1, (qz - vz) / t1
        segments.append(_Segment(t1, start, velocity, accel))
        start = _position_after(start, velocity, accel, t1)
    t3 = bounds.rise_s(qx, qy, qz)
    t2 = over_s - t1 / 2.0 - t3 / 2.0
    if t2 > SHORT_S:
        segments.append(_Segment(t2, start, (qx, qy, qz), ZERO))
        start = _position_after(start, (qx, qy, qz), ZERO, t2)
    if t3 > SHORT_S:
        segments.append(_Segment(t3, start, (qx, qy, qz), (-qx / t3, -qy / t3, -qz / t3)))
    return segments or [_Segment(DURATION_MIN_S, goal, ZERO, ZERO)]


def _position_after(position: Vector, velocity: Vector, accel: Vector, t: float) -> Vector:
    x, y, z = (p + v * t + a * t * t / 2.0 for p, v, a in zip(position, velocity, accel, strict=True))
    return x, y, z


def _polynomials(translation: list[_Segment], turn: list[_Segment]) -> PiecewisePolynomial:
    """Return a translation and a turn that start together as one path."""
    starts_s = [_start_times(translation), _start_times(turn)]
    times = sorted({t for each in starts_s for t in each})
    times_kept = [t for t, after in pairwise(times) if after - t > SHORT_S]
    coefficients = np.zeros((len(times_kept), DEGREE + 1, 4))
    for row, t in zip(coefficients, times_kept, strict=True):
        for segments, start_times, columns in zip(
            (translation, turn), starts_s, (slice(0, 3), slice(3, 4)), strict=True
        ):
            count = columns.stop - columns.start
            position, velocity, accel = _state(segments, start_times, t)
            row[:3, columns] = np.array([position[:count], velocity[:count], [a / 2.0 for a in accel[:count]]])
    return PiecewisePolynomial(np.diff([*times_kept, times[-1]]), coefficients)


def _start_times(segments: list[_Segment]) -> list[float]:
    """Return the start times of the parts, and the end of the last one."""
    times = [0.0]
    for segment in segments:
        times.append(times[-1] + segment.duration_s)
    return times


def _state(segments: list[_Segment], starts_s: list[float], t: float) -> tuple[Vector, Vector, Vector]:
    """Return position, velocity and acceleration at `t`; at a boundary, of the later part; rest after the last."""
    index = max(k for k, start_s in enumerate(starts_s) if start_s <= t)
    if index == len(segments):
        last = segments[-1]
        return _position_after(last.position, last.velocity, last.accel, last.duration_s), ZERO, ZERO
    segment, local_s = segments[index], t - starts_s[index]
    x, y, z = (v + a * local_s for v, a in zip(segment.velocity, segment.accel, strict=True))
    return _position_after(segment.position, segment.velocity, segment.accel, local_s), (x, y, z), segment.accel
