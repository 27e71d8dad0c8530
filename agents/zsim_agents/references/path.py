"""Paths of one drone: position and rate over time, peak speeds and acceleration, and scaling to limits. No I/O.

A path is a piecewise polynomial, such as a minimum-snap path, or a circle, helix or figure-8 flown for a number of
laps, which begins and ends at rest on the curve.

A path is a `Reference` of four variables, x, y, z [m; W] and yaw [rad, not wrapped]. Its time starts at 0; outside
[0, duration_s] it rests at its nearer end.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.polynomial import polynomial

from zsim.math import elementary as el
from zsim.math import linear
from zsim_agents.formation.spaces.cluster_space import Array
from zsim_agents.formation.trajectory import Reference, TrajectoryError

# Degree of a piece, as in the files of uav_trajectories: the lowest that allows position, velocity, acceleration and
# jerk to be prescribed at both ends
DEGREE = 7
ENDS = 3  # number of derivatives prescribed at each end of a path
BELOW, ABOVE = 11, 3  # diagonals below and above the main one in the equations of `minimum_snap`
PEAK_SAMPLES = 64  # samples per piece in the search for its peaks
GOLDEN = 0.6180339887498949  # (sqrt(5) - 1) / 2
GOLDEN_STEPS = 40  # steps of a golden-section search; each leaves 0.62 of the interval, all leave 1e-10 of a piece
SAMPLE_S, SAMPLES_MIN, SAMPLES_MAX = 0.05, 65, 4001  # sampling of non-polynomial paths, before peaks are refined
HORIZON_S = 600.0  # initial part of an endless path that is searched for peaks
DIFFERENCE_S = 1e-4  # step of central differences of rates; relative error 2e-9 for motions with time scales of 1 s
FACTOR_DIGITS = 3  # decimals to which the factor of a fitted path is rounded up
SHARE = 0.8  # share of the drone's limits that a path may use, as in formations; the rest is left to the feedback
# Minimum duration of a move (25 gates), maximum unless a longer one is requested, and its growth per step of the search
DURATION_MIN_S, MOVE_MAX_S, GROWTH = 0.5, 3600.0, 1.1
NEGLIGIBLE = 1e-9  # value below which a quantity is treated as zero
RAMP_SHARE = 0.25  # duration of speeding up from rest, and of slowing down, as a share of a lap's
Curve = Callable[[float], tuple[Array, Array]]
"""Maps the angle [rad] to the position (4,) and its derivative with respect to the angle."""


class PathLimits(NamedTuple):
    """Limits of a path: horizontal speed, vertical speed, yaw rate and horizontal acceleration."""

    speed_m_s: float
    climb_m_s: float
    yaw_rate_rad_s: float
    accel_m_s2: float

    def share(self, share: float) -> PathLimits:
        return PathLimits(*(share * each for each in self))


class Peaks(NamedTuple):
    """The maximum of each quantity in `PathLimits` over a path, and when it is reached [s]."""

    speed_m_s: float
    climb_m_s: float
    yaw_rate_rad_s: float
    accel_m_s2: float
    at_s: tuple[float, float, float, float]

    def factor(self, limits: PathLimits) -> float:
        """Return the factor by which to stretch the duration to just satisfy the limits; below 1 if it may shrink."""
        speeds = max(peak / limit for peak, limit in zip(self[:3], limits[:3], strict=True))
        return max(speeds, math.sqrt(self.accel_m_s2 / limits.accel_m_s2))  # acceleration scales as 1/t^2


class PiecewisePolynomial:
    """A path of consecutive polynomial pieces, each in its own local time.

    Args:
        durations_s: durations of the pieces, (m,).
        coefficients: coefficients of t^0 to t^7 for x, y, z and yaw, (m, 8, 4).
    """

    def __init__(self, durations_s: Array, coefficients: Array) -> None:
        self.durations_s, self.coefficients = np.asarray(durations_s, float), np.asarray(coefficients, float)
        self.begins_s = np.concatenate(([0.0], np.cumsum(self.durations_s)))
        self.duration_s: float | None = float(self.begins_s[-1])
        self._begins: list[float] = self.begins_s[:-1].tolist()
        self._axes: list[list[list[float]]] = self.coefficients.swapaxes(1, 2)[:, :, ::-1].tolist()  # t^7 first

    def value(self, t_s: float) -> tuple[Array, Array]:
        clamped = min(max(t_s, 0.0), float(self.begins_s[-1]))
        piece = bisect.bisect_right(self._begins, clamped) - 1
        local = clamped - self._begins[piece]
        position, rate = [], []
        for highest, *others in self._axes[piece]:  # in plain floats: numpy takes five times as long
            value, slope = highest, 0.0
            for coefficient in others:
                slope = slope * local + value
                value = value * local + coefficient
            position.append(value)
            rate.append(slope)
        return np.array(position), np.array(rate) if clamped == t_s else np.zeros(4)

    def until(self, end_s: float) -> PiecewisePolynomial:
        """Return the part of the path before `end_s` > 0."""
        count = bisect.bisect_left(self._begins, end_s)
        durations = self.durations_s[:count].copy()
        durations[-1] = min(durations[-1], end_s - self._begins[count - 1])
        return PiecewisePolynomial(durations, self.coefficients[:count])

    def peaks(self) -> Peaks:
        """Return the peaks over all pieces, with times accurate to 1e-8 of a piece, the limit set by rounding."""
        maxima = [(0.0, 0.0)] * 4
        for begin_s, duration_s, coefficients in zip(self.begins_s, self.durations_s, self.coefficients, strict=False):
            # in local time from 0 to 1, for good scaling
            unit = coefficients * _powers(duration_s, len(coefficients))[:, None]
            v = polynomial.polyder(unit) / duration_s
            a = polynomial.polyder(v) / duration_s
            for k, columns in enumerate((v[:, :2], v[:, 2:3], v[:, 3:], a[:, :2])):
                peak, fraction = _maximum(columns)
                maxima[k] = max(maxima[k], (math.sqrt(peak), float(begin_s + fraction * duration_s)))
        values, times = zip(*maxima, strict=True)
        return Peaks(*values, at_s=times)


def _powers(x: float, count: int) -> Array:
    """Return x^0, x^1, ..., x^(count - 1)."""
    return np.array([el.power(x, float(k)) for k in range(count)])


def _maximum(columns: Array) -> tuple[float, float]:
    """Return the maximum over [0, 1] of the sum of squares of k polynomials, and where it is.

    It is found by sampling and golden section; only maxima narrower than the spacing of the samples can be missed.

    Args:
        columns: coefficients of t^0 to t^(n - 1), a column per polynomial, (n, k).
    """
    descending = columns[::-1].T.tolist()

    def value(t: float) -> float:
        total = 0.0
        for column in descending:
            result = 0.0
            for coefficient in column:
                result = result * t + coefficient
            total += result * result
        return total

    samples = np.square(polynomial.polyval(np.linspace(0.0, 1.0, PEAK_SAMPLES + 1), columns)).sum(axis=0)
    best = int(np.argmax(samples))
    low, high = max(best - 1, 0) / PEAK_SAMPLES, min(best + 1, PEAK_SAMPLES) / PEAK_SAMPLES
    argmax = best / PEAK_SAMPLES
    peak = value(argmax)
    for _ in range(GOLDEN_STEPS):
        left, right = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
        a, b = value(left), value(right)
        low, high = (low, right) if a > b else (left, high)
        if max(a, b) > peak:
            peak, argmax = (a, left) if a > b else (b, right)
    return peak, argmax


class EndMotion(NamedTuple):
    """Derivatives of a path at its start or end, each (4,)."""

    velocity: Array
    acceleration: Array
    jerk: Array


def at_rest() -> EndMotion:
    return EndMotion(np.zeros(4), np.zeros(4), np.zeros(4))


def minimum_snap(
    times_s: Sequence[float], positions: Array, begin: EndMotion | None = None, end: EndMotion | None = None
) -> PiecewisePolynomial:
    """Return the path through positions at given times that minimises the integral of the squared fourth derivative.

    With the first three derivatives prescribed at both ends, zero by default, it is the spline of degree 7. The cost is
    that of Mellinger and Kumar, ICRA 2011; for the spline see Schoenberg, Proc. Nat. Acad. Sci. 52 (1964) 947. From 0
    to 1 in one second, at rest at both ends, it is 35 t^4 - 84 t^5 + 70 t^6 - 20 t^7.

    Args:
        times_s: increasing times, (m,); the path starts at the first.
        positions: x, y, z [m; W] and yaw [rad] at these times, (m, 4).
        begin, end: derivatives at the first and at the last time.
    """
    ends = begin or at_rest(), end or at_rest()
    spans = np.diff(np.asarray(times_s, float))
    m, size = len(spans), DEGREE + 1
    slopes = np.ones((size, size))  # derivatives of t^k at 1, one row per derivative
    for d in range(1, size):
        slopes[d] = slopes[d - 1] * np.maximum(np.arange(size) - (d - 1.0), 0.0)
    diagonals, b = np.zeros((m * size, BELOW + 1 + ABOVE)), np.zeros((m * size, 4))

    def put(row: int, piece: int, values: Array, first: int = 0) -> None:
        """Write a row's entries for the coefficients of a piece, from that of t^`first` on."""
        column = piece * size + first - row + BELOW
        diagonals[row, column : column + len(values)] = values

    row = 0
    for p in range(m):
        put(row, p, np.ones(1))
        b[row] = positions[p]
        if p == 0:
            for d in range(1, ENDS + 1):
                put(row + d, 0, slopes[d, d : d + 1], d)
                b[row + d] = ends[0][d - 1] * el.power(spans[0], float(d))
            row += 1 + ENDS
        else:
            ratio = spans[p - 1] / spans[p]
            for d in range(1, DEGREE):
                put(row + d, p - 1, slopes[d])
                put(row + d, p, -slopes[d, d : d + 1] * el.power(ratio, float(d)), d)
            row += DEGREE
        put(row, p, slopes[0])
        b[row] = positions[p + 1]
        row += 1
    for d in range(1, ENDS + 1):
        put(row + d - 1, m - 1, slopes[d])
        b[row + d - 1] = ends[1][d - 1] * el.power(spans[-1], float(d))
    unit = linear.solve_banded(diagonals, BELOW, b).reshape(m, size, 4)  # in local time from 0 to 1, as in `peaks`
    scale = np.array([_powers(span, size) for span in spans.tolist()])
    return PiecewisePolynomial(spans, unit / scale[:, :, None])


def move(
    start: Array,
    goal: Array,
    limits: PathLimits,
    over_s: float = 0.0,
    begin: EndMotion | None = None,
    end: EndMotion | None = None,
) -> PiecewisePolynomial:
    """Return the minimum-snap path within limits from one position and yaw (4,) to another, turning the shorter way.

    It lasts `over_s`, or longer if the limits require it. It begins and ends at rest or in the given motions.

    Raises:
        TrajectoryError: no path of an hour or less, or of `over_s`, satisfies the limits, usually because the motion
            at an end exceeds them.
    """
    end_yaw = start[3] + math.remainder(goal[3] - start[3], math.tau)
    positions = np.array([start, [*goal[:3], end_yaw]])
    if begin is None and end is None:
        unit = minimum_snap((0.0, 1.0), positions).peaks().factor(limits)
        return minimum_snap((0.0, max(over_s, DURATION_MIN_S, round_up(unit))), positions)
    length_s = max(over_s, DURATION_MIN_S)
    length_max_s = max(over_s, MOVE_MAX_S)
    while length_s <= length_max_s:  # by search: the given motions do not scale with the duration
        path = minimum_snap((0.0, length_s), positions, begin, end)
        if path.peaks().factor(limits) <= 1.0:
            return path
        length_s *= GROWTH
    raise TrajectoryError("is faster at one end than the limits of the approach allow")


def round_up(factor: float) -> float:
    scale = 10.0**FACTOR_DIGITS
    return math.ceil(factor * scale - 1e-6) / scale


@dataclass(frozen=True, eq=False)
class Scaled:
    """A path slowed down by `factor` and shifted to an origin (4,)."""

    of: Reference
    factor: float
    origin: Array

    @property
    def duration_s(self) -> float | None:
        own = self.of.duration_s
        return None if own is None else own * self.factor

    def value(self, t_s: float) -> tuple[Array, Array]:
        position, rate = self.of.value(t_s / self.factor)
        return position + self.origin, rate / self.factor

    def peaks(self) -> Peaks:
        own, f = peaks_of(self.of), self.factor
        w, x, y, z = own.at_s
        speed, climb, turn = (each / f for each in own[:3])
        return Peaks(speed, climb, turn, own.accel_m_s2 / (f * f), (w * f, x * f, y * f, z * f))


def peaks_of(path: Reference) -> Peaks:
    """Return the peaks of a path: from its own method if it has one, otherwise by sampling and refinement."""
    own: Callable[[], Peaks] | None = getattr(path, "peaks", None)
    if own is not None:
        return own()
    end_s = HORIZON_S if path.duration_s is None else path.duration_s
    count = min(max(math.ceil(end_s / SAMPLE_S) + 1, SAMPLES_MIN), SAMPLES_MAX)
    times = np.linspace(0.0, end_s, count)

    def quantities(t_s: float) -> Array:
        rate = path.value(t_s)[1]
        before, after = max(0.0, t_s - DIFFERENCE_S), min(end_s, t_s + DIFFERENCE_S)
        accel = (path.value(after)[1] - path.value(before)[1]) / max(after - before, NEGLIGIBLE)
        return np.array([el.length(rate[:2]), abs(rate[2]), abs(rate[3]), el.length(accel[:2])])

    table = np.array([quantities(t_s) for t_s in times.tolist()])
    found = [_refined(lambda t, k=k: float(quantities(t)[k]), times, table[:, k]) for k in range(4)]
    values, times_s = zip(*found, strict=True)
    return Peaks(*values, at_s=times_s)


def _refined(quantity: Callable[[float], float], times: Array, samples: Array) -> tuple[float, float]:
    """Return the maximum of a quantity near its largest sample, and the time of the maximum [s]."""
    from scipy.optimize import minimize_scalar

    best = int(np.argmax(samples))
    low, high = times[max(best - 1, 0)], times[min(best + 1, len(times) - 1)]
    if high > low and samples[best] > NEGLIGIBLE:
        inner = minimize_scalar(lambda t: -quantity(t), bounds=(low, high), method="bounded", options={"xatol": 1e-6})
        if -inner.fun > samples[best]:
            return float(-inner.fun), float(inner.x)
    return float(samples[best]), float(times[best])


def circle(radius_m: float, climb_m: float = 0.0) -> Curve:
    """Return a circle around the origin, counter-clockwise from (radius, 0); a helix if `climb_m` per lap is not 0."""

    def point_at(angle: float) -> tuple[Array, Array]:
        c, s, rise = radius_m * el.cos(angle), radius_m * el.sin(angle), climb_m / math.tau
        return np.array([c, s, rise * angle, 0.0]), np.array([-s, c, rise, 0.0])

    return point_at


def figure_eight(length_m: float, width_m: float) -> Curve:
    """Return the lemniscate of Gerono with its length along x, starting at the crossing, which is the origin."""

    def point_at(angle: float) -> tuple[Array, Array]:
        x, y = length_m / 2.0, width_m / 2.0
        position = np.array([x * el.sin(angle), y * el.sin(2.0 * angle), 0.0, 0.0])
        return position, np.array([x * el.cos(angle), 2.0 * y * el.cos(2.0 * angle), 0.0, 0.0])

    return point_at


class Laps:
    """A curve flown for a number of laps of `period_s` each, from rest to rest; ramps add RAMP_SHARE periods in total.

    In the ramp at either end the angular rate is a quintic, so that acceleration and jerk are zero at the ends as well.
    """

    def __init__(self, curve: Curve, period_s: float, laps: float) -> None:
        self._curve = curve
        self._rate = math.tau / period_s
        self._ramp_s = RAMP_SHARE * period_s
        self.duration_s: float | None = self._ramp_s + laps * period_s

    def value(self, t_s: float) -> tuple[Array, Array]:
        end_s = self.duration_s or 0.0
        t = min(max(t_s, 0.0), end_s)
        angle, rate = self._ramp_motion(t)
        remaining_s = end_s - t
        if remaining_s < self._ramp_s:
            remaining_angle, rate = self._ramp_motion(remaining_s)
            angle = self._rate * (end_s - self._ramp_s) - remaining_angle
        position, slope = self._curve(angle)
        return position, slope * rate

    def _ramp_motion(self, t: float) -> tuple[float, float]:
        """Return the angle [rad] and angular rate [rad/s] at a time `t` [s] after the start from rest."""
        s = t / self._ramp_s
        if s >= 1.0:
            return self._rate * (t - 0.5 * self._ramp_s), self._rate
        rate = self._rate * s * s * s * (10.0 - s * (15.0 - 6.0 * s))
        return self._rate * self._ramp_s * s * s * s * s * (2.5 - s * (3.0 - s)), rate
