"""The camera with which a page looks at the scene: what it has in view, and from where it has all of some points."""

import math
from typing import NamedTuple

import numpy as np
import viser

from zsim_bridges.console.scene.picture import Array

OFFSET_M = np.array([-2.3, -3.9, 1.7])  # of a camera, from what it looks at, where that is not larger than EXTENT_M
DISTANCE_MIN_M = float(np.linalg.norm(OFFSET_M))
SLOPE_MIN = 0.05  # of the narrowest page that is fitted; a hidden one has no width
REACH_M = 0.6  # of a drone around its position, with its name over it; chosen
FAR_M = 15.0  # from which a drone is so small on the page that it counts as out of view; chosen: about 15 pixels
MARGIN = 0.85  # of half the page, within which a point counts as in view


class CameraView(NamedTuple):
    """What a page's camera sees: where it stands, what it looks at, and its vertical angle of view."""

    position: Array  # (3,) m; W
    look_at: Array  # (3,) m; W
    up: Array  # (3,); W
    fov: float  # rad
    aspect: float  # width / height

    def contains(self, p_W: Array) -> bool:
        """Return whether a point [m; W] is in view, and not far away."""
        ahead = _unit(self.look_at - self.position)
        right = _unit(np.cross(ahead, self.up))
        away = p_W - self.position
        x, y, z = away @ right, away @ np.cross(ahead, right), away @ ahead
        half = MARGIN * math.tan(self.fov / 2) * z
        return bool(0.0 < z <= FAR_M and abs(y) <= half and abs(x) <= half * self.aspect)

    def offset(self) -> Array:
        """Return from where it is to look at another point [m; W]: in the direction that it has, not from afar."""
        back = self.position - self.look_at
        return back * min(1.0, float(np.linalg.norm(OFFSET_M) / np.linalg.norm(back)))


def fit_distance_m(points_W: Array, centre_W: Array, back_W: Array, up_W: Array, fov: float, aspect: float) -> float:
    """Return from how far a camera that looks at a centre has all points in view [m]; DISTANCE_MIN_M at least.

    Args:
        points_W: (n, 3) m.
        centre_W: (3,) m.
        back_W: (3,), from the centre to the camera; not parallel to `up_W`.
        up_W: (3,).
        fov: vertical angle of view [rad].
        aspect: width / height.
    """
    back = _unit(back_W)
    right = _unit(np.cross(up_W, back))
    away = points_W - centre_W
    across = np.abs(np.column_stack((away @ right, away @ np.cross(back, right)))) + REACH_M
    slopes = np.maximum(MARGIN * math.tan(fov / 2) * np.array([aspect, 1.0]), SLOPE_MIN)
    return float(np.max(across / slopes + (away @ back)[:, None], initial=DISTANCE_MIN_M))


def _unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector)


def bring_into_view(client: viser.ClientHandle, *points_W: Array) -> None:
    """Aim a page's camera at the first of some points [m; W], unless it has all in view."""
    camera = client.camera
    view = CameraView(camera.position, camera.look_at, camera.up_direction, camera.fov, camera.aspect)
    if not all(view.contains(p_W) for p_W in points_W):
        aim(client, points_W[0], view.offset())


def aim(client: viser.ClientHandle, centre: Array, offset: Array) -> None:
    """Aim a page's camera at a point from an offset [m; W]."""
    with client.atomic():
        client.camera.position = centre + offset
        client.camera.look_at = centre
