"""Obstacles generated from a seed (forest, corridor) or read from files (point clouds, surfaces).

They become entries of `environment.obstacles` when a scenario is resolved, so that the record contains each of them;
a surface's file is replaced by its triangles. The same seed gives the same obstacles, rounded to a millimetre, on
every machine.

Files: meshes (STL, OBJ, PLY), height maps (CSV, NPY) and point clouds (PCD, PLY, CSV). STL, OBJ and PLY need trimesh,
PCD needs pypcd4; both come with the extra `obstacles`.
"""

import importlib
import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn

import msgspec
import numpy as np
from numpy.typing import NDArray

from zsim.errors import DocumentError, missing
from zsim.math import elementary as el
from zsim.math.randomness import stream
from zsim.scenario.scenario import OBSTACLES_MAX, Cloud, Corridor, Forest, Position, Scenario
from zsim.scenario.surroundings import TRIANGLE, TRIANGLES_MAX, packed, unpacked
from zsim.schema import plugin
from zsim.schema.checker import Fault, faults, faults_in, show, sound

TRIES_MAX = 500  # attempts to place a trunk before the forest is deemed full; design choice: bounds the time it takes
BYTES_MAX = 100_000_000  # maximum size of a file
Entry = dict[str, Any]
Array = NDArray[np.float64]
_KINDS = {"forest": Forest, "corridor": Corridor, "cloud": Cloud}


def with_generated(document: dict[str, Any]) -> tuple[dict[str, Any], list[Fault]]:
    """Return a raw document with generated obstacles and the triangles of surfaces filled in, and the faults."""
    environment = document.get("environment")
    if not isinstance(environment, dict):
        return document, []
    wrong: list[Fault] = []
    if isinstance(environment.get("surfaces"), list):
        surfaces, wrong = _read_surfaces(environment["surfaces"])
        environment = {**environment, "surfaces": surfaces}
    if not _KINDS.keys() & environment.keys():
        return {**document, "environment": environment}, wrong
    listed = environment.get("obstacles", [])
    obstacles = [*listed] if isinstance(listed, list) else []
    parts = sound(document, Scenario)
    starts = [drone.position_m for drone in parts.drones or () if drone and drone.position_m]
    for name, kind in _KINDS.items():
        if name not in environment:
            continue
        where = f"environment.{name}"
        flaws = [*faults(environment[name], kind, where)]
        wrong += flaws
        if flaws:
            continue
        settings: Any = msgspec.convert(environment[name], kind)
        try:
            if name == "cloud":
                obstacles += _boxes(settings, where)
                continue
            seed = parts.seed if settings.seed is msgspec.UNSET else settings.seed
            rng = stream(0 if seed is None else seed, name)
            obstacles += _forest(settings, rng, starts, where) if name == "forest" else _corridor(settings, rng)
        except DocumentError as error:
            wrong += faults_in(error)
    others = {name: value for name, value in environment.items() if name not in _KINDS}
    return {**document, "environment": {**others, "obstacles": obstacles} if obstacles else others}, wrong


def _forest(own: Forest, rng: np.random.Generator, starts: Sequence[Position], where: str) -> list[Entry]:
    """Return trunks at random positions, clear of each other and of the drones' start positions.

    Raises:
        DocumentError: limits are not ascending, or the trunks do not fit.
    """
    for name in ("radius_m", "height_m"):
        low, high = getattr(own, name)
        if low > high:
            raise DocumentError([f"{where}.{name} is {[low, high]}; must be [least, greatest]"])
    west, south, east, north = own.area_m
    if west >= east or south >= north:
        bounds_text = "[west, south, east, north] with west < east and south < north"
        raise DocumentError([f"{where}.area_m is {list(own.area_m)}; must be {bounds_text}"])
    trunks = np.empty((own.trees, 3))  # x, y, radius
    clear = np.array([(x, y) for x, y, _ in starts]).reshape(-1, 2)
    entries: list[Entry] = []
    for count in range(own.trees):
        for _ in range(TRIES_MAX):
            x, y = (round(each, 3) for each in rng.uniform((west, south), (east, north)).tolist())
            radius, height = (round(rng.uniform(*span), 3) for span in (own.radius_m, own.height_m))
            away = (
                np.sqrt(np.square(trunks[:count, 0] - x) + np.square(trunks[:count, 1] - y))
                - trunks[:count, 2]
                - radius
            )
            from_starts = np.sqrt(np.square(clear[:, 0] - x) + np.square(clear[:, 1] - y)) - radius
            if (away >= own.gap_m).all() and (from_starts >= own.clear_m).all():
                break
        else:
            limit = f"{count} trunks of {list(own.radius_m)} m with gap_m {own.gap_m:g} and clear_m {own.clear_m:g} fit"
            raise DocumentError([f"{where}.trees is {own.trees}; must be less: {limit}"])
        trunks[count] = x, y, radius
        trunk = {"shape": "cylinder", "position_m": [x, y, 0.0], "radius_m": radius, "height_m": height}
        entries.append({"name": f"tree{count + 1}", **trunk})
    return entries


def _corridor(own: Corridor, rng: np.random.Generator) -> list[Entry]:
    """Return the walls on both sides of a path with a random turn after each segment, joined at the bends."""
    turns = [0.0, *np.radians(rng.uniform(-own.turn_deg, own.turn_deg, own.segments - 1)).tolist()]
    headings = (math.radians(own.heading_deg) + np.cumsum(turns)).tolist()
    middles = [own.start_m]
    for heading in headings:
        x, y = middles[-1]
        middles.append((x + own.length_m * el.cos(heading), y + own.length_m * el.sin(heading)))
    bends = [*zip(middles, headings, turns, strict=False), (middles[-1], headings[-1], 0.0)]
    entries: list[Entry] = []
    for side, sign in (("left", 1.0), ("right", -1.0)):
        corners = []  # corners of a wall's centre line, on the bisector of each bend
        for (x, y), heading, turn in bends:
            across, away = heading - 0.5 * turn, 0.5 * sign * (own.width_m + own.wall_m) / el.cos(0.5 * turn)
            corners.append((x - away * el.sin(across), y + away * el.cos(across)))
        for k, ((ax, ay), (bx, by)) in enumerate(pairwise(corners)):
            wall = {
                "name": f"wall{k + 1}_{side}",
                "shape": "box",
                "position_m": [round(0.5 * (ax + bx), 3), round(0.5 * (ay + by), 3), 0.0],
                "size_m": [round(el.hypot(bx - ax, by - ay) + own.wall_m, 3), own.wall_m, own.height_m],
                "yaw_deg": round(math.degrees(el.atan2(by - ay, bx - ax)), 3),
            }
            entries.append(wall)
    return entries


def _boxes(own: Cloud, where: str) -> list[Entry]:
    """Return boxes for the occupied cells of a point cloud, merged along z, then along x.

    Raises:
        DocumentError: the file cannot be read, or yields too many boxes.
    """
    points = points_of(plugin.beside(own.file), f"{where}.file")
    cells, counts = np.unique(np.floor(points / own.cell_m).astype(np.int64), axis=0, return_counts=True)
    runs: dict[tuple[int, int], list[list[int]]] = {}  # first and last z of each run, by x and y
    for x, y, z in cells[counts >= own.points_min].tolist():
        column = runs.setdefault((x, y), [])
        if column and column[-1][1] == z - 1:
            column[-1][1] = z
        else:
            column.append([z, z])
    rows: dict[tuple[int, int, int], list[list[int]]] = {}  # first and last x of each run, by y, first z and last z
    for (x, y), column in sorted(runs.items()):
        for low, high in column:
            row = rows.setdefault((y, low, high), [])
            if row and row[-1][1] == x - 1:
                row[-1][1] = x
            else:
                row.append([x, x])
    blocks = sorted((x, y, z) for (y, *z), row in rows.items() for x in row)
    if len(blocks) > OBSTACLES_MAX:
        excess = f"which makes {len(blocks)} boxes; must make <= {OBSTACLES_MAX}"
        raise DocumentError([f"{where}.cell_m is {own.cell_m:g}, {excess}"])
    entries: list[Entry] = []
    for (first, last), y, (low, high) in blocks:
        middle = [0.5 * (first + last + 1), y + 0.5, float(low)]
        sides = [last + 1 - first, 1, high + 1 - low]
        centre = [round(p + own.cell_m * m, 3) for p, m in zip(own.position_m, middle, strict=True)]
        size = [round(own.cell_m * side, 3) for side in sides]
        entries.append({"name": f"cloud{len(entries) + 1}", "shape": "box", "position_m": centre, "size_m": size})
    return entries


def _read_surfaces(listed: list[Any]) -> tuple[list[Any], list[Fault]]:
    """Return the entries of `surfaces:` with triangles in place of files, and the files' faults."""
    surfaces, wrong, count = [], [], 0
    for index, entry in enumerate(listed):
        where, triangles = f"environment.surfaces[{index}]", None
        surfaces.append(entry)
        if not isinstance(entry, dict):
            continue
        file, text = entry.get("file"), entry.get("triangles")
        try:
            if ("file" in entry) == ("triangles" in entry):
                wrong.append(
                    (
                        f"{where}.file",
                        f"is {'given with triangles' if file else 'missing'}; give either it or triangles",
                    )
                )
            elif isinstance(file, str) and file:
                cell_m = entry.get("cell_m")
                cell_m = float(cell_m) if isinstance(cell_m, int | float) and cell_m > 0 else None
                triangles = triangles_of(plugin.beside(file), f"{where}.file", cell_m)
                surfaces[-1] = {name: value for name, value in entry.items() if name != "file"}
                surfaces[-1]["triangles"] = packed(triangles)
            elif isinstance(text, str):
                triangles = unpacked(text)
        except DocumentError as error:
            wrong += faults_in(error)
        except ValueError as error:
            wrong.append((f"{where}.triangles", str(error)))
        count += 0 if triangles is None else len(triangles)
    if count > TRIANGLES_MAX:
        wrong.append(("environment.surfaces", f"have {count} triangles; must have at most {TRIANGLES_MAX}"))
    return surfaces, wrong


def triangles_of(path: Path, where: str, cell_m: float | None) -> Array:
    """Return the triangles, (T, 9), three corners each, of a mesh or of a height map with cells `cell_m` wide [m].

    A height map has a height [m] for every corner of its cells, row by row from south to north, centred at the origin;
    each cell gives two triangles.

    Raises:
        DocumentError: the file cannot be read, or is not a mesh or height map; the line begins with `where`.
    """
    kind = path.suffix.lower()
    if kind in (".csv", ".npy"):
        heights = _read(path, where, _numpy_grid if kind == ".npy" else _text_grid)
        if heights.ndim != 2 or min(heights.shape) < 2 or cell_m is None:
            _refuse(
                path, where, f"is a height map of {list(heights.shape)} heights", "must be 2 x 2 or more, with cell_m"
            )
        if len(wrong := np.argwhere(~np.isfinite(heights))):
            row, column = wrong[0] + 1
            _refuse(path, where, f"has a height that is not finite in row {row}, column {column}", "must be finite")
        triangles = _height_triangles(np.asarray(heights, dtype=float), float(cell_m or 1.0))
    elif kind in (".stl", ".obj", ".ply"):
        mesh = _read(path, where, lambda p: importlib.import_module("trimesh").load_mesh(p, process=False))
        triangles = np.asarray(getattr(mesh, "triangles", np.empty((0, 3, 3))), dtype=float).reshape(-1, TRIANGLE)
    else:
        _refuse(path, where, f"ends in {kind or 'nothing'}", "must be .stl, .obj or .ply, or a height map .csv or .npy")
    if not len(triangles):
        size = path.stat().st_size
        fault = f"has {size} bytes, but no triangle that could be read"
        allowed = "; a binary STL has 84 bytes and 50 for each triangle" if kind == ".stl" else ""
        _refuse(path, where, fault, f"must have one or more{allowed}")
    if len(wrong := np.flatnonzero(~np.isfinite(triangles).all(axis=1))):
        _refuse(path, where, f"has a number that is not finite in triangle {wrong[0] + 1}", "must be finite")
    return triangles


def points_of(path: Path, where: str) -> Array:
    """Return the finite points of a cloud, (P, 3) [m]; errors as for `triangles_of`."""
    kind = path.suffix.lower()
    if kind == ".pcd":
        read = lambda p: importlib.import_module("pypcd4").PointCloud.from_path(p).numpy(("x", "y", "z"))  # noqa: E731
    elif kind == ".ply":
        read = lambda p: importlib.import_module("trimesh").load(p, process=False).vertices  # noqa: E731
    elif kind == ".csv":
        read = _text_grid
    else:
        _refuse(path, where, f"ends in {kind or 'nothing'}", "must be .pcd, .ply or .csv")
    points = np.asarray(_read(path, where, read), dtype=float)
    if points.ndim != 2 or points.shape[1] < 3:
        _refuse(path, where, f"has an array of {list(points.shape)}", "must be x, y, z of each point")
    points = points[np.isfinite(points[:, :3]).all(axis=1), :3]
    if not len(points):
        _refuse(path, where, "has no point", "must have one or more")
    return points


def _numpy_grid(path: Path) -> Array:
    return np.load(path).astype(float, casting="same_kind")  # refuses archives, complex numbers and strings


def _text_grid(path: Path) -> Array:
    return np.loadtxt(path, delimiter=",", ndmin=2)


def _read(path: Path, where: str, read: Callable[[Path], Any]) -> Any:
    try:
        if path.stat().st_size > BYTES_MAX:
            _refuse(path, where, f"has more than {BYTES_MAX} bytes", "must have at most that many")
        return read(path)
    except DocumentError:
        raise
    except ModuleNotFoundError as error:
        raise DocumentError([f"{where} is {show(str(path))}: {missing(error) or error}"]) from error
    except Exception as error:  # third-party readers may raise any error
        _refuse(
            path, where, f"cannot be read ({str(error).splitlines()[0] if str(error) else type(error).__name__})", ""
        )


def _refuse(path: Path, where: str, fault: str, allowed: str) -> NoReturn:
    raise DocumentError([f"{where} is {show(str(path))}, which {fault}{'; ' if allowed else ''}{allowed}"])


def _height_triangles(heights: Array, cell_m: float) -> Array:
    """Return the triangles of a grid of heights, two for each cell, (T, 9)."""
    rows, columns = heights.shape
    x = (np.arange(columns) - 0.5 * (columns - 1)) * cell_m
    y = (np.arange(rows) - 0.5 * (rows - 1)) * cell_m
    points = np.stack([*np.meshgrid(x, y), heights], axis=2)
    a, b, c, d = points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]
    halves = [np.concatenate(three, axis=2).reshape(-1, TRIANGLE) for three in ((a, b, c), (a, c, d))]
    return np.concatenate(halves)
