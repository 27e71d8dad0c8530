"""Surfaces and points from files: meshes (STL, OBJ, PLY), height maps (CSV, NPY), point clouds (PCD, PLY).

A resolved scenario contains their content, so that its readers need no file. Formats other than numbers in text are
read by trimesh and pypcd4, of the extra `obstacles`.
"""

import base64
import binascii
import importlib
import math
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from zsim.errors import DocumentError, missing
from zsim.math import elementary as el
from zsim.schema.checker import show

TRIANGLES_MAX = 40_000  # of all surfaces: with them a resolved scenario stays below the 4 MB of a file
BYTES_MAX = 100_000_000  # of a file
CORNERS = 9  # numbers of a triangle: three corners
SINGLE = np.dtype("<f4")

Array = NDArray[np.float64]


def triangles_of(path: Path, where: str, cell_m: float | None) -> Array:
    """Return the triangles of a mesh, or of a height map whose cells are `cell_m` wide, (T, 9): three corners each.

    A height map has a height [m] for every corner of its cells: row by row from south to north, its middle at the
    origin; two triangles a cell.

    Raises:
        DocumentError: the file cannot be read, or is not a mesh; one line that begins with `where`.
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
        triangles = _of_heights(np.asarray(heights, dtype=float), float(cell_m or 1.0))
    elif kind in (".stl", ".obj", ".ply"):
        mesh = _read(path, where, lambda p: importlib.import_module("trimesh").load_mesh(p, process=False))
        triangles = np.asarray(getattr(mesh, "triangles", np.empty((0, 3, 3))), dtype=float).reshape(-1, CORNERS)
    else:
        _refuse(path, where, f"ends in {kind or 'nothing'}", "must be .stl, .obj or .ply, or a height map .csv or .npy")
    if not len(triangles):
        size = path.stat().st_size
        found = f"of {size} bytes has no triangle that could be read"
        allowed = "; a binary STL has 84 bytes and 50 for each triangle" if kind == ".stl" else ""
        _refuse(path, where, found, f"must have one or more{allowed}")
    if len(wrong := np.flatnonzero(~np.isfinite(triangles).all(axis=1))):
        _refuse(path, where, f"has a number that is not finite in triangle {wrong[0] + 1}", "must be finite")
    return triangles


def points_of(path: Path, where: str) -> Array:
    """Return the finite points of a cloud, (P, 3) [m]. Errors as for `triangles_of`."""
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
    return np.load(path).astype(float, casting="same_kind")  # no archive, no complex numbers, no texts


def _text_grid(path: Path) -> Array:
    return np.loadtxt(path, delimiter=",", ndmin=2)


def _read(path: Path, where: str, read: Callable[[Path], Any]) -> Any:
    try:
        if path.stat().st_size > BYTES_MAX:
            _refuse(path, where, f"has more than {BYTES_MAX} bytes", "must have less")
        return read(path)
    except DocumentError:
        raise
    except ModuleNotFoundError as error:
        raise DocumentError([f"{where} is {show(str(path))}: {missing(error) or error}"]) from error
    except Exception as error:  # whatever a reader of somebody else's file raises
        _refuse(
            path, where, f"cannot be read ({str(error).splitlines()[0] if str(error) else type(error).__name__})", ""
        )


def _refuse(path: Path, where: str, found: str, allowed: str) -> NoReturn:
    raise DocumentError([f"{where} is {show(str(path))}, which {found}{'; ' if allowed else ''}{allowed}"])


def _of_heights(heights: Array, cell_m: float) -> Array:
    """Return two triangles for each cell of a grid of heights, (T, 9)."""
    rows, columns = heights.shape
    x = (np.arange(columns) - 0.5 * (columns - 1)) * cell_m
    y = (np.arange(rows) - 0.5 * (rows - 1)) * cell_m
    points = np.stack([*np.meshgrid(x, y), heights], axis=2)
    a, b, c, d = points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]
    halves = [np.concatenate(three, axis=2).reshape(-1, CORNERS) for three in ((a, b, c), (a, c, d))]
    return np.concatenate(halves)


def packed(triangles: Array) -> str:
    """Return triangles as text: float32, compressed, in base 64."""
    return base64.b64encode(zlib.compress(triangles.astype(SINGLE).tobytes(), 9)).decode()


def unpacked(text: str) -> Array:
    """Return the triangles of a text made by `packed`, (T, 9).

    Raises:
        ValueError: the text is invalid.
    """
    each = CORNERS * SINGLE.itemsize
    reader = zlib.decompressobj()
    try:
        data = reader.decompress(base64.b64decode(text, validate=True), TRIANGLES_MAX * each + 1)
    except (binascii.Error, zlib.error) as error:
        raise ValueError(f"is no triangles ({error})") from error
    if len(data) > TRIANGLES_MAX * each:  # a short text may be of any number of bytes
        raise ValueError(f"has more than {TRIANGLES_MAX} triangles; must have at most {TRIANGLES_MAX}")
    if not reader.eof:
        raise ValueError("is no triangles (cut short)")
    if not data or len(data) % each:
        raise ValueError(f"has {len(data)} bytes; must have {each} for each triangle")
    triangles = np.frombuffer(data, SINGLE).astype(float).reshape(-1, CORNERS)
    if not np.isfinite(triangles).all():
        raise ValueError("has a number that is not finite; must be finite")
    return triangles


def placed(surface: Any) -> Array:
    """Return the triangles of a surface of a scenario in W, (T, 9): a corner, and the two edges from it [m]."""
    s, c = el.sin_cos(math.radians(surface.yaw_deg))
    x, y, z = np.moveaxis(surface.scale * unpacked(surface.triangles).reshape(-1, 3, 3), 2, 0)
    corners = np.stack([c * x - s * y, s * x + c * y, z], axis=2) + np.array(surface.position_m)
    first = corners[:, 0]
    return np.concatenate([first, corners[:, 1] - first, corners[:, 2] - first], axis=1)
