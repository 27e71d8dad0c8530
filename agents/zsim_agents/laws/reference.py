"""The reference of a formation: centre, heading and scale as functions of time, and the resulting places.

    p_i*(t) = p_c(t) + s(t) R(psi(t)) c_i        v_i* = dp_i*/dt

All of it is horizontal, in W; c_i are the places of the drones in the formation, [m].
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.math import elementary as el
from zsim_agents.formation.expression import Expression

Array = NDArray[np.float64]


class Pose(NamedTuple):
    """The reference at an instant, with its rates."""

    p_W: Array  # (2,) centre [m]
    v_W: Array  # (2,) [m/s]
    turn: Array  # (2, 2) s R(psi)
    turn_rate: Array  # (2, 2) its derivative [1/s]

    def place(self, c: Array) -> tuple[Array, Array]:
        """Return the present displacement of a place c (2,) from the centre [m; W], and its rate [m/s]."""
        return turned(self.turn, c), turned(self.turn_rate, c)


class FormationReference:
    """The motion of a formation from `start_s` on; before, it rests at its start.

    Args:
        centre_m: x and y in W: numbers, or expressions of t, in seconds since start_s.
        heading_deg, scale: likewise.

    Raises:
        ExpressionError: a text is not an expression of t, or has no value at its start.
    """

    def __init__(
        self, centre_m: Sequence[float | str], heading_deg: float | str, scale: float | str, start_s: float = 0.0
    ) -> None:
        given: Mapping[str, float | str] = {
            "centre_m[0]": centre_m[0], "centre_m[1]": centre_m[1], "heading_deg": heading_deg, "scale": scale,
        }  # fmt: skip
        self._functions = [Expression(name, text if isinstance(text, str) else repr(float(text)))
                           for name, text in given.items()]  # fmt: skip
        self._start_s = start_s
        self.at(start_s)

    def at(self, t_s: float) -> Pose:
        """Return the reference at a simulated time; ExpressionError: it has no value there."""
        since_s = t_s - self._start_s
        (x, vx), (y, vy), (psi_deg, turn_deg_s), (s, s_dot) = (each(max(since_s, 0.0)) for each in self._functions)
        if since_s < 0.0:
            vx = vy = turn_deg_s = s_dot = 0.0
        psi, w = math.radians(psi_deg), math.radians(turn_deg_s)
        c, sn = el.cos(psi), el.sin(psi)
        turn = np.array([[s * c, -s * sn], [s * sn, s * c]])
        turn_rate = np.array([[s_dot * c - s * w * sn, -s_dot * sn - s * w * c],
                              [s_dot * sn + s * w * c, s_dot * c - s * w * sn]])  # fmt: skip
        return Pose(np.array([x, y]), np.array([vx, vy]), turn, turn_rate)


def turned(matrix: Array, c: Array) -> Array:
    """Return a matrix (2, 2) times c (2,), in one order of operations on every processor."""
    return np.array([matrix[0, 0] * c[0] + matrix[0, 1] * c[1], matrix[1, 0] * c[0] + matrix[1, 1] * c[1]])


def polygon(count: int, radius_m: float) -> Array:
    """Return the corners (count, 2) of a regular polygon about the origin, the first one on the x axis [m]."""
    angles = [2 * math.pi * i / count for i in range(count)]
    return radius_m * np.array([[el.cos(angle), el.sin(angle)] for angle in angles])
