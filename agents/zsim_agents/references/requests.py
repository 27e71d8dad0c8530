"""Requests to the pilot of one drone, `drone/{d}/control`, and the flights that they ask for.

takeoff, land
hold: come to rest
goto {position_m, yaw_deg, over_s}: fly there, from rest to rest as fast as the limits let it, or in over_s
follow {minimum_snap: [...], fit: true, ...}: fly to the beginning of a path, then the path; fields as of a reference
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from msgspec import Struct, convert

from zsim.scenario.scenario import PATHS, Drone, DroneReference, Position
from zsim.schema.checker import faults
from zsim.schema.quantities import NonNegative, Real
from zsim_agents.formation.spaces.cluster_space import Array
from zsim_agents.formation.trajectory import TrajectoryError
from zsim_agents.references.flight import HEIGHT_MIN_M, SHARE, Flight, FlightError, Leg, fitted_path, way_to
from zsim_agents.references.path import EndMotion, PathLimits, move

BRAKE_S = 1.0  # of motion at the present velocity, in which a drone comes to rest; chosen
PLAIN = ("takeoff", "land", "hold")
OPERATIONS = (*PLAIN, "goto", "follow")


class DroneRequestError(ValueError):
    """A request cannot be understood, or not be done now; the text names the field, finding and remedy."""


class Goto(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A place to fly to, in W."""

    position_m: Position
    yaw_deg: Real | None = None
    over_s: NonNegative = 0.0


Asked = Literal["takeoff", "land", "hold"] | Goto | DroneReference


def read_request(op: str, args: Mapping[str, Any]) -> Asked:
    """Return what is asked for; DroneRequestError: none of OPERATIONS, or arguments that are not allowed."""
    if op not in OPERATIONS:
        raise DroneRequestError(f"is unknown; allowed: {', '.join(OPERATIONS)}")
    if op in PLAIN:
        if args:
            raise DroneRequestError(f"{next(iter(args))!s:.40} is given; must have no arguments")
        return op  # type: ignore[return-value]
    kind = Goto if op == "goto" else DroneReference
    wrong = [f"{path} {text}" for path, text in faults(dict(args), kind)]
    if wrong:
        raise DroneRequestError("; ".join(wrong[:3]))
    asked = convert(dict(args), kind)
    if isinstance(asked, DroneReference) and len(asked.paths()) != 1:
        given = " and ".join(asked.paths()) or "none"
        raise DroneRequestError(f"has {given} of {', '.join(PATHS)}; must have one")
    return asked


def requested_flight(asked: Any, t_s: float, place: Array, rate: Array, drone: Drone, limits: PathLimits) -> Flight:
    """Return the flight that is asked for at t_s, from a place (4,) in motion; FlightError: it cannot be flown."""
    begin = EndMotion(rate, np.zeros(4), np.zeros(4)) if rate.any() else None
    if isinstance(asked, DroneReference):
        path = fitted_path(asked, limits, float(place[3]), drone.limits.altitude_m)
        way = way_to(place, path, limits, begin)
        path_s = t_s + (way.duration_s or 0.0)
        return Flight(place, (Leg(t_s, way, "approaching"), Leg(path_s, path, "path")))
    goal, over_s = place + BRAKE_S * rate, 0.0
    if isinstance(asked, Goto):
        yaw = float(place[3]) if asked.yaw_deg is None else math.radians(asked.yaw_deg)
        goal, over_s = np.array([*asked.position_m, yaw]), asked.over_s
        low, high = HEIGHT_MIN_M, drone.limits.altitude_m
        if not low <= goal[2] <= high:
            raise FlightError("position_m[2]", f"is {goal[2]:g}; must be >= {low:g} and <= {high:g}")
    try:
        way = move(place, goal, limits.share(SHARE), over_s, begin)
    except TrajectoryError as error:
        raise FlightError("", str(error)) from None
    return Flight(place, (Leg(t_s, way, "approaching"),))
