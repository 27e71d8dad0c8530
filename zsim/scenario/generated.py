"""Obstacles that a seed places: a forest of trunks, and the walls of a winding corridor.

They become entries of `environment.obstacles` where a scenario is resolved, so that the record, and all who read it,
have each of them. The same seed gives the same obstacles, rounded to a millimetre, on every machine.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np

from zsim.math.random_streams import stream
from zsim.scenario.scenario import Corridor, Forest, Position, Scenario
from zsim.schema.checker import Fault, faults, sound

TRIES_MAX = 500  # places for a trunk, after which the forest is taken for full; chosen
Entry = dict[str, Any]
_KINDS = {"forest": Forest, "corridor": Corridor}


def with_generated(document: dict[str, Any]) -> tuple[dict[str, Any], list[Fault]]:
    """Return a raw document whose `forest:` and `corridor:` have become obstacles, and their faults."""
    environment = document.get("environment")
    if not isinstance(environment, dict) or not _KINDS.keys() & environment.keys():
        return document, []
    given, wrong = environment.get("obstacles", []), []
    obstacles = [*given] if isinstance(given, list) else []
    parts = sound(document, Scenario)
    starts = [drone.position_m for drone in parts.drones or () if drone and drone.position_m]
    for name, kind in _KINDS.items():
        if name not in environment:
            continue
        where = f"environment.{name}"
        found = [*faults(environment[name], kind, where)]
        wrong += found
        if not found:
            settings = msgspec.convert(environment[name], kind)
            seed = parts.seed if settings.seed is msgspec.UNSET else settings.seed
            rng = stream(0 if seed is None else seed, name)
            make = _forest if name == "forest" else _corridor
            entries, fault = make(settings, rng, starts, where)
            wrong += [fault] if fault else []
            obstacles += entries
    rest = {name: value for name, value in environment.items() if name not in _KINDS}
    return {**document, "environment": {**rest, "obstacles": obstacles} if obstacles else rest}, wrong


def _forest(
    own: Forest, rng: np.random.Generator, starts: Sequence[Position], where: str
) -> tuple[list[Entry], Fault | None]:
    """Return trunks at random places, one after the other, each clear of those before and of where drones start."""
    for name in ("radius_m", "height_m"):
        low, high = getattr(own, name)
        if low > high:
            return [], (f"{where}.{name}", f"is {[low, high]}; must be [least, greatest]")
    west, south, east, north = own.area_m
    if west >= east or south >= north:
        return [], (f"{where}.area_m", f"is {list(own.area_m)}; must be [west, south, east, north], rising")
    places = np.empty((own.trees, 3))  # x, y, radius
    clear = np.array([(x, y) for x, y, _ in starts]).reshape(-1, 2)
    entries: list[Entry] = []
    for count in range(own.trees):
        for _ in range(TRIES_MAX):
            x, y = (round(each, 3) for each in rng.uniform((west, south), (east, north)).tolist())
            radius, height = (round(rng.uniform(*span), 3) for span in (own.radius_m, own.height_m))
            away = np.hypot(places[:count, 0] - x, places[:count, 1] - y) - places[:count, 2] - radius
            from_starts = np.hypot(clear[:, 0] - x, clear[:, 1] - y) - radius
            if (away >= own.gap_m).all() and (from_starts >= own.clear_m).all():
                break
        else:
            most = f"{count} trunks of {list(own.radius_m)} m with gap_m {own.gap_m:g} and clear_m {own.clear_m:g} fit"
            return entries, (f"{where}.trees", f"is {own.trees}; must be less: {most}")
        places[count] = x, y, radius
        trunk = {"shape": "cylinder", "position_m": [x, y, 0.0], "radius_m": radius, "height_m": height}
        entries.append({"name": f"tree{count + 1}", **trunk})
    return entries, None


def _corridor(
    own: Corridor, rng: np.random.Generator, starts: Sequence[Position], where: str
) -> tuple[list[Entry], Fault | None]:
    """Return the walls on both sides of a line that turns by a random angle after each segment, joined at its bends."""
    turns = [0.0, *np.radians(rng.uniform(-own.turn_deg, own.turn_deg, own.segments - 1)).tolist()]
    headings = (math.radians(own.heading_deg) + np.cumsum(turns)).tolist()
    middles = [own.start_m]
    for heading in headings:
        x, y = middles[-1]
        middles.append((x + own.length_m * math.cos(heading), y + own.length_m * math.sin(heading)))
    bends = [*zip(middles, headings, turns, strict=False), (middles[-1], headings[-1], 0.0)]
    entries: list[Entry] = []
    for side, off in (("left", 1.0), ("right", -1.0)):
        corners = []  # of the middle line of the walls: on the bisector of each bend
        for (x, y), heading, turn in bends:
            across, away = heading - 0.5 * turn, 0.5 * off * (own.width_m + own.wall_m) / math.cos(0.5 * turn)
            corners.append((x - away * math.sin(across), y + away * math.cos(across)))
        for k, ((ax, ay), (bx, by)) in enumerate(pairwise(corners)):
            wall = {
                "name": f"wall{k + 1}_{side}",
                "shape": "box",
                "position_m": [round(0.5 * (ax + bx), 3), round(0.5 * (ay + by), 3), 0.0],
                "size_m": [round(math.hypot(bx - ax, by - ay) + own.wall_m, 3), own.wall_m, own.height_m],
                "yaw_deg": round(math.degrees(math.atan2(by - ay, bx - ax)), 3),
            }
            entries.append(wall)
    return entries, None
