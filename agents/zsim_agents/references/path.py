"""Paths of one drone: a place and its rate for every instant, their peaks, and the time that fits limits. Pure.

A path is a `Reference` of four variables, x, y, z [m, W] and yaw [rad, not wrapped]; time is in seconds from its start,
and it stands still at the nearest end outside of [0, duration_s].
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.polynomial import polynomial

from zsim_agents.formation.spaces.cluster_space import Array
from zsim_agents.formation.trajectory import Reference, TrajectoryError

DEGREE = 7  # of a piece, as in the files of uav_trajectories: the least in which place, velocity, acceleration and jerk
# of both ends can be given
ENDS = 3  # derivatives that are given at both ends of a path
ROUNDED = 9  # decimals of a coefficient: a nanometre, below which processors differ in the last bits of a solution
SAMPLE_S, SAMPLES_MIN, SAMPLES_MAX = 0.05, 65, 4001  # of a path that is no polynomial, between which peaks are refined
HORIZON_S = 600.0  # of an endless path that is looked at
DIFFERENCE_S = 1e-4  # of rates, for an acceleration: exact to 1e-7 of it in motions of a second
FACTOR_DIGITS = 3  # of the factor of a fit, rounded up, see ROUNDED
SHARE = 0.8  # of the drone's limits, as in formations: the rest is for the feedback
LEAST_S, MOVE_MAX_S, GROWTH = 0.5, 3600.0, 1.1  # of a move: 25 gates, however short; an hour; step of the search
STILL = 1e-9  # m, m/s or rad/s, below which nothing moves


class PathLimits(NamedTuple):
    """What a path may ask of its drone: horizontal and vertical speed, turn, horizontal acceleration."""

    speed_m_s: float
    climb_m_s: float
    yaw_rate_rad_s: float
    accel_m_s2: float

    def share(self, share: float) -> PathLimits:
        return PathLimits(*(share * each for each in self))


class Peaks(NamedTuple):
    """The greatest of each quantity of `PathLimits` on a path, and when it is reached [s]."""

    speed_m_s: float
    climb_m_s: float
    yaw_rate_rad_s: float
    accel_m_s2: float
    at_s: tuple[float, float, float, float]

    def factor(self, limits: PathLimits) -> float:
        """Return by how much a path has to be slower to keep within limits; below 1 where it may be faster."""
        speeds = max(own / most for own, most in zip(self[:3], limits[:3], strict=True))
        return max(speeds, math.sqrt(self.accel_m_s2 / limits.accel_m_s2))  # speeds fall with time, accelerations twice


class PiecewisePolynomial:
    """Polynomials of local time that follow each other.

    Args:
        durations_s: (m,) of the pieces.
        coefficients: (m, 8, 4) of t^0 to t^7 in x, y, z, yaw.
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
        place, rate = [], []
        for highest, *others in self._axes[piece]:  # in floats: numpy takes five times as long
            value, slope = highest, 0.0
            for coefficient in others:
                slope = slope * local + value
                value = value * local + coefficient
            place.append(value)
            rate.append(slope)
        return np.array(place), np.array(rate) if clamped == t_s else np.zeros(4)

    def until(self, end_s: float) -> PiecewisePolynomial:
        """Return the part before end_s, which is after the beginning."""
        count = bisect.bisect_left(self._begins, end_s)
        durations = self.durations_s[:count].copy()
        durations[-1] = min(durations[-1], end_s - self._begins[count - 1])
        return PiecewisePolynomial(durations, self.coefficients[:count])

    def peaks(self) -> Peaks:
        """Return the peaks, by the roots of the derivative of each squared quantity."""
        greatest = [(0.0, 0.0)] * 4
        for begin_s, duration_s, own in zip(self.begins_s, self.durations_s, self.coefficients, strict=False):
            unit = own * duration_s ** np.arange(len(own))[:, None]  # of a local time from 0 to 1, which is well scaled
            v = polynomial.polyder(unit) / duration_s
            a = polynomial.polyder(v) / duration_s
            for k, columns in enumerate((v[:, :2], v[:, 2:3], v[:, 3:], a[:, :2])):
                square = np.sum([np.convolve(column, column) for column in columns.T], axis=0)
                most, at = _greatest(square)
                greatest[k] = max(greatest[k], (math.sqrt(most), float(begin_s + at * duration_s)))
        values, times = zip(*greatest, strict=True)
        return Peaks(*values, at_s=times)


def _greatest(coefficients: Array) -> tuple[float, float]:
    """Return the greatest value of a polynomial in [0, 1], and where."""
    slope = polynomial.polytrim(polynomial.polyder(coefficients), 1e-12 * max(1e-300, np.abs(coefficients).max()))
    roots = polynomial.polyroots(slope) if len(slope) > 1 else np.zeros(0)
    inside = roots.real[(np.abs(roots.imag) < 1e-3) & (roots.real > 0.0) & (roots.real < 1.0)]
    at = np.concatenate(([0.0, 1.0], inside))
    values = polynomial.polyval(at, coefficients)
    best = int(np.argmax(values))
    return max(0.0, float(values[best])), float(at[best])


class EndMotion(NamedTuple):
    """The derivatives of a path at its first or last place, each (4,)."""

    velocity: Array
    acceleration: Array
    jerk: Array


def at_rest() -> EndMotion:
    return EndMotion(np.zeros(4), np.zeros(4), np.zeros(4))


def minimum_snap(
    times_s: Sequence[float], places: Array, begin: EndMotion | None = None, end: EndMotion | None = None
) -> PiecewisePolynomial:
    """Return the path through places (m, 4) at times with the least integral of the squared fourth derivative.

    Among all paths with given derivatives up to the third at both ends, at rest by default, that is the spline of
    degree 7: Mellinger and Kumar, ICRA 2011, for the cost; Schoenberg, Proc. Nat. Acad. Sci. 52 (1964) 947, for the
    spline. From rest to rest over one second it is 35 t^4 - 84 t^5 + 70 t^6 - 20 t^7.

    Args:
        times_s: (m,), rising; the first is the start of the path.
    """
    from scipy.interpolate import PPoly, make_interp_spline  # here, as in `WaypointTrajectory`

    ends = begin or at_rest(), end or at_rest()
    given = [[(k + 1, motion[k]) for k in range(ENDS)] for motion in ends]
    spline = make_interp_spline(np.asarray(times_s), places, k=DEGREE, bc_type=given)
    pieces = [PPoly.from_spline((spline.t, spline.c[:, k], DEGREE)) for k in range(4)]
    inner = slice(DEGREE, -DEGREE)  # the knots at both ends are repeated
    rising = np.stack([each.c[::-1, inner] for each in pieces], axis=-1).swapaxes(0, 1)  # (m - 1, 8, 4)
    spans = np.diff(np.asarray(times_s, float))
    scale = spans[:, None, None] ** np.arange(DEGREE + 1)[:, None]  # to a local time from 0 to 1
    return PiecewisePolynomial(spans, np.asarray(np.round(rising * scale, ROUNDED), float) / scale)


def move(
    start: Array,
    goal: Array,
    limits: PathLimits,
    over_s: float = 0.0,
    begin: EndMotion | None = None,
    end: EndMotion | None = None,
) -> PiecewisePolynomial:
    """Return the minimum-snap way from one place to another (4,), within limits.

    It lasts over_s, or longer where the limits need that. It begins and ends at rest, or in the motions that are given.
    The yaw turns by the shorter way.

    Raises:
        TrajectoryError: the motion at an end is beyond the limits.
    """
    turned = start[3] + math.remainder(goal[3] - start[3], math.tau)
    places = np.array([start, [*goal[:3], turned]])
    if begin is None and end is None:
        unit = minimum_snap((0.0, 1.0), places).peaks().factor(limits)
        return minimum_snap((0.0, max(over_s, LEAST_S, round_up(unit))), places)
    length_s = max(over_s, LEAST_S)
    while length_s < MOVE_MAX_S:  # the ends do not slow down with the rest, so there is no factor
        path = minimum_snap((0.0, length_s), places, begin, end)
        if path.peaks().factor(limits) <= 1.0:
            return path
        length_s *= GROWTH
    raise TrajectoryError("is faster at an end than the limits of the way there")


def round_up(factor: float) -> float:
    scale = 10.0**FACTOR_DIGITS
    return math.ceil(factor * scale - 1e-6) / scale


@dataclass(frozen=True, eq=False)
class Scaled:
    """A path that is flown `factor` times as slowly, from an origin (4,)."""

    of: Reference
    factor: float
    origin: Array

    @property
    def duration_s(self) -> float | None:
        own = self.of.duration_s
        return None if own is None else own * self.factor

    def value(self, t_s: float) -> tuple[Array, Array]:
        place, rate = self.of.value(t_s / self.factor)
        return place + self.origin, rate / self.factor

    def peaks(self) -> Peaks:
        own, f = peaks_of(self.of), self.factor
        w, x, y, z = own.at_s
        speed, climb, turn = (each / f for each in own[:3])
        return Peaks(speed, climb, turn, own.accel_m_s2 / f**2, (w * f, x * f, y * f, z * f))


def peaks_of(path: Reference) -> Peaks:
    """Return the peaks of any path: exact ones of polynomials, of others refined between samples."""
    own: Callable[[], Peaks] | None = getattr(path, "peaks", None)
    if own is not None:
        return own()
    end_s = HORIZON_S if path.duration_s is None else path.duration_s
    count = min(max(math.ceil(end_s / SAMPLE_S) + 1, SAMPLES_MIN), SAMPLES_MAX)
    times = np.linspace(0.0, end_s, count)

    def quantities(t_s: float) -> Array:
        rate = path.value(t_s)[1]
        before, after = max(0.0, t_s - DIFFERENCE_S), min(end_s, t_s + DIFFERENCE_S)
        accel = (path.value(after)[1] - path.value(before)[1]) / max(after - before, STILL)
        return np.array([math.hypot(*rate[:2]), abs(rate[2]), abs(rate[3]), math.hypot(*accel[:2])])

    table = np.array([quantities(t_s) for t_s in times.tolist()])
    found = [_refined(lambda t, k=k: float(quantities(t)[k]), times, table[:, k]) for k in range(4)]
    values, at = zip(*found, strict=True)
    return Peaks(*values, at_s=at)


def _refined(quantity: Callable[[float], float], times: Array, samples: Array) -> tuple[float, float]:
    """Return the greatest value of a quantity near its greatest sample, and when."""
    from scipy.optimize import minimize_scalar

    best = int(np.argmax(samples))
    low, high = times[max(best - 1, 0)], times[min(best + 1, len(times) - 1)]
    if high > low and samples[best] > STILL:
        inner = minimize_scalar(lambda t: -quantity(t), bounds=(low, high), method="bounded", options={"xatol": 1e-6})
        if -inner.fun > samples[best]:
            return float(-inner.fun), float(inner.x)
    return float(samples[best]), float(times[best])
