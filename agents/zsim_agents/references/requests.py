"""Requests to the pilot of one drone, `drone/{d}/control`, and the flights that they ask for.

takeoff, land
hold: come to rest
goto {position_m, yaw_deg, speed_m_s}: fly there, at a cruise speed, or as fast as the limits let it, and rest there
goto {places_m, yaw_deg, speed_m_s, radius_m}: through places, past each by radius_m at most; 0: rest at each
goto {position_m, yaw_deg, over_s}: from rest to rest in over_s, with one function of time for all ways
follow {minimum_snap: [...], fit: true, ...}: fly to the beginning of a path, then the path; FOLLOWED of a reference
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta, Struct, convert

from zsim.scenario.scenario import PATHS, POINTS_MAX, Drone, DroneReference, Position
from zsim.schema.checker import faults, show
from zsim.schema.quantities import NonNegative, Positive, Real
from zsim_agents.formation.spaces.cluster_space import Array
from zsim_agents.formation.trajectory import TrajectoryError
from zsim_agents.references.cruise import FREE, Cruise, cruise_through, cruise_to_rest
from zsim_agents.references.flight import HEIGHT_MIN_M, SHARE, Flight, FlightError, Leg, fitted_path, way_to
from zsim_agents.references.path import EndMotion, PathLimits, move

PLAIN = ("takeoff", "land", "hold")
OPERATIONS = (*PLAIN, "goto", "follow")
OF_EXPRESSIONS = ("constants", "duration_s")
FOLLOWED = (*PATHS, *OF_EXPRESSIONS, "origin_m", "time_scale", "fit")  # the others are of a whole flight of a scenario


class DroneRequestError(ValueError):
    """A request cannot be understood, or not be done now; the text names the field, finding and remedy."""


class Goto(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A place to fly to, in W, or several one after the other."""

    position_m: Position | None = None
    places_m: Annotated[list[Position], Meta(max_length=POINTS_MAX)] = []
    yaw_deg: Real | None = None
    speed_m_s: Positive | None = None
    radius_m: NonNegative = 0.0
    over_s: NonNegative = 0.0

    def places(self) -> list[Position]:
        return self.places_m if self.position_m is None else [self.position_m]


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
    if isinstance(asked, DroneReference) and (unused := list(_unused(asked, args))):
        raise DroneRequestError(f"{'; '.join(unused[:3])}; allowed: {', '.join(FOLLOWED)}")
    if isinstance(asked, Goto):
        if (asked.position_m is None) != bool(asked.places_m):
            found = "is given beside" if asked.places_m else "is missing, and so is"
            raise DroneRequestError(f"position_m {found} places_m; must have one of them")
        if asked.over_s and (asked.places_m or asked.speed_m_s):
            other = "places_m" if asked.places_m else "speed_m_s"
            raise DroneRequestError(f"over_s is {asked.over_s:g} beside {other}; must be left out, or {other}")
    return asked


def _unused(asked: DroneReference, args: Mapping[str, Any]) -> Iterator[str]:
    """Yield what is wrong with fields that a request has no use for."""
    for name, value in args.items():
        if name not in FOLLOWED:
            yield f"{name} is {show(value)}; must be left out of a request"
        elif name in OF_EXPRESSIONS and not asked.expressions:
            yield f"{name} is {show(value)}; must be left out without expressions"


def requested_flight(asked: Any, t_s: float, place: Array, rate: Array, drone: Drone, limits: PathLimits) -> Flight:
    """Return the flight that is asked for at t_s, from a place (4,) in motion; FlightError: it cannot be flown."""
    begin = EndMotion(rate, np.zeros(4), np.zeros(4)) if rate.any() else None
    if isinstance(asked, DroneReference):
        path = fitted_path(asked, limits, float(place[3]), drone.limits.altitude_m)
        way = way_to(place, path, limits, begin)
        path_s = t_s + (way.duration_s or 0.0)
        return Flight(place, (Leg(t_s, way, "approaching"), Leg(path_s, path, "path")))
    own = limits.share(SHARE)
    if not isinstance(asked, Goto):
        return Flight(place, (Leg(t_s, cruise_to_rest(place, own, rate), "approaching"),))
    yaw = float(place[3]) if asked.yaw_deg is None else math.radians(asked.yaw_deg)
    low, high = HEIGHT_MIN_M, drone.limits.altitude_m
    for k, (_, _, z) in enumerate(asked.places()):
        if not low <= z <= high:
            field = f"places_m[{k}][2]" if asked.places_m else "position_m[2]"
            raise FlightError(field, f"is {z:g}; must be >= {low:g} and <= {high:g}")
    goals = [np.array([*each, yaw]) for each in asked.places()]
    if asked.over_s:
        try:
            way = move(place, goals[0], own, asked.over_s, begin)
        except TrajectoryError as error:
            raise FlightError("", str(error)) from None
    else:
        speeds = FREE if asked.speed_m_s is None else Cruise(*(asked.speed_m_s,) * 3)
        way = cruise_through(place, goals, own, rate, speeds, asked.radius_m)
    return Flight(place, (Leg(t_s, way, "approaching"),))
