"""Curves that are flown in laps: circle, helix, figure-8. They begin and end at rest, on the curve itself. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from zsim.math import elementary as el
from zsim_agents.formation.spaces.cluster_space import Array

RAMP = 0.25  # of a lap's time, in which the speed along the curve rises from rest, and falls again; chosen

Curve = Callable[[float], tuple[Array, Array]]
"""From the angle [rad] to the place (4,) and its derivative by the angle."""


def circle(radius_m: float, climb_m: float = 0.0) -> Curve:
    """Return a circle around the origin, from (radius, 0) counter-clockwise; it climbs so much in a lap."""

    def at(angle: float) -> tuple[Array, Array]:
        c, s, rise = radius_m * el.cos(angle), radius_m * el.sin(angle), climb_m / math.tau
        return np.array([c, s, rise * angle, 0.0]), np.array([-s, c, rise, 0.0])

    return at


def figure_eight(length_m: float, width_m: float) -> Curve:
    """Return the lemniscate of Gerono along x, so long and so wide, from its crossing at the origin."""

    def at(angle: float) -> tuple[Array, Array]:
        x, y = length_m / 2.0, width_m / 2.0
        place = np.array([x * el.sin(angle), y * el.sin(2.0 * angle), 0.0, 0.0])
        return place, np.array([x * el.cos(angle), 2.0 * y * el.cos(2.0 * angle), 0.0, 0.0])

    return at


class Laps:
    """A curve that is flown for some laps of period_s each, with a quarter of a period more for start and stop.

    The angle's rate follows a quintic at both ends, so that acceleration and jerk begin and end at zero too.
    """

    def __init__(self, curve: Curve, period_s: float, laps: float) -> None:
        self._curve = curve
        self._rate = math.tau / period_s
        self._ramp_s = RAMP * period_s
        self.duration_s: float | None = self._ramp_s + laps * period_s

    def value(self, t_s: float) -> tuple[Array, Array]:
        end_s = self.duration_s or 0.0
        t = min(max(t_s, 0.0), end_s)
        angle, rate = self._begun(t)
        left = end_s - t
        if left < self._ramp_s:
            rest, rate = self._begun(left)
            angle = self._rate * (end_s - self._ramp_s) - rest
        place, slope = self._curve(angle)
        return place, slope * rate

    def _begun(self, t: float) -> tuple[float, float]:
        """Return angle and rate at t from rest."""
        s = t / self._ramp_s
        if s >= 1.0:
            return self._rate * (t - 0.5 * self._ramp_s), self._rate
        rate = self._rate * s * s * s * (10.0 - s * (15.0 - 6.0 * s))
        return self._rate * self._ramp_s * s * s * s * s * (2.5 - s * (3.0 - s)), rate
