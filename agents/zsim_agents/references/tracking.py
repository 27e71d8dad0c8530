"""The tracking law of a drone's reference, and the course of a drone sent to places at any time. Pure.

The commanded velocity is that of the reference, advanced by the lag of the drone's velocity loop, plus a share of the
position error. To first order this is an acceleration feed-forward without a second derivative.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from zsim.math import elementary as el
from zsim.math.rotation import Vector
from zsim.scenario.scenario import Piloted
from zsim_agents.references.cruise import FREE, Cruise, cruise, cruise_to_rest
from zsim_agents.references.path import SHARE, PathLimits, PiecewisePolynomial

K_YAW_1_S = 1.0  # of the heading; chosen: below the yaw loop's bandwidth by a decade
LOST_M = 2.0  # off its way, from where a drone is sent anew; chosen: more than a way without wind is missed by

Four = Sequence[float]
"""x, y, z [m, W] and yaw [rad], or their rates."""
Axes = tuple[float | None, float | None, float | None, float | None]
"""The same, None where no place is given."""


def velocity_towards(
    place: Four, ahead: Four, here: Four, limits: PathLimits, law: Piloted, down_m_s: float = math.inf
) -> tuple[Vector, float]:
    """Return the velocity [m/s; W] and yaw rate [rad/s] for a drone at `here` whose reference is at a place.

    Args:
        ahead: rate of the reference `law.lead_s` from now.
        limits: limits of the result; `down_m_s` if the limit is lower downwards than upwards.
    """
    x, y, z = (v + law.gain_1_s * (p - own) for v, p, own in zip(ahead[:3], place[:3], here[:3], strict=True))
    speed = el.hypot(x, y)
    share = min(1.0, limits.speed_m_s / speed) if speed else 1.0
    turn = ahead[3] + K_YAW_1_S * math.remainder(place[3] - here[3], math.tau)
    up, down, most = limits.climb_m_s, min(limits.climb_m_s, down_m_s), limits.yaw_rate_rad_s
    return (x * share, y * share, min(max(z, -down), up)), min(max(turn, -most), most)


class Course:
    """The paths of a drone that is sent to a place, and at any time to another one.

    A path begins in the present state of the previous one, or at the drone if there is none or the drone is off it by
    more than LOST_M. An axis without a place is flown at its rate; an axis with both is tracked as given.

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
        """Clear the path: the next one begins at the drone."""
        self._goal = self._way = None

    def send(
        self, goal: Axes, t_s: float, here: Four, moving: Four, rate: Four = (0.0,) * 4, speeds: Cruise = FREE
    ) -> None:
        """Send the drone, which is here and moves so at t_s, to a place."""
        own, own_rate = self._motion(t_s, here, moving)
        self._goal, self._rate, self._speeds = goal, rate, speeds
        self._begin(t_s, own, own_rate)

    def stop(self, t_s: float, here: Four, moving: Four) -> Vector:
        """Return the place [m, W] at which the drone, which is here and moves so at t_s, can come to rest."""
        own, rate = (np.array(each, float) for each in self._motion(t_s, here, moving))
        x, y, z = cruise_to_rest(own, self._limits, rate).value(math.inf)[0][:3].tolist()
        return x, y, z

    def velocity(self, t_s: float, here: Four, moving: Four) -> tuple[Vector, float]:
        """Return the velocity [m/s, W] and yaw rate [rad/s] of the drone, which is here and moves so at t_s.

        Raises:
            RuntimeError: it has not been sent anywhere.
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
        """Return place and rate of the path on its axes, and of the drone on the others."""
        own, rate = list(here), list(moving)
        if self._way is not None and not self._is_lost(t_s, here):
            place, pace = self._state(t_s)
            for k in self._axes():
                own[k], rate[k] = place[k], pace[k]
        return own, rate

    def _axes(self) -> list[int]:
        """Return the axes of the path."""
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
