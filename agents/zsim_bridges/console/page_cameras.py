"""The cameras of all pages: each follows the formation and has all of it in view, unless its page wants otherwise."""

import math
import secrets
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
import viser

from zsim.contract.camera_messages import CameraImage, CameraInfo
from zsim.math import frames, rotation
from zsim_bridges.console.camera_feed import field_of_view
from zsim_bridges.console.picture import Array, DronePoses

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


UP_W = np.array([0.0, 0.0, 1.0])
DIRECTIONS = {  # from the centre to the camera; not quite from above, since a camera has to know which way is up
    "reset": OFFSET_M / DISTANCE_MIN_M,
    "top": np.array([0.0, -0.02, 1.0]),
    "side": np.array([0.0, -1.0, 0.06]),
}
DEADBAND = 0.05  # of the distance; a shorter move does not move the camera: pictures then need not be drawn anew
SPARE = 1.15  # of the distance from which all is just in view
NEARER = 0.6  # of the distance, below which the fitting one must be for the camera to come nearer


@dataclass
class _Page:
    """A page's camera.

    Attributes:
        follows: whether it moves with the formation.
        fits: whether it keeps its distance such that all drones are in view.
        direction: from which it looks at the next picture; None: as the page has it.
        moved: whether it has to be aimed whatever it shows.
    """

    client: viser.ClientHandle
    follows: bool = True
    fits: bool = True
    direction: Array | None = field(default_factory=DIRECTIONS["reset"].copy)
    moved: bool = True


class CameraFollow:
    """Cameras of all pages.

    Args:
        server: viser's.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._lock = threading.Lock()
        self._pages: dict[int, _Page] = {}  # by viser's number
        self._points: Array = np.zeros((1, 3))
        server.on_client_connect(self._on_connect)
        server.on_client_disconnect(self._on_disconnect)

    def restart(self) -> None:
        """Aim all cameras anew at the first picture: another run may fly elsewhere."""
        with self._lock:
            for page in self._pages.values():
                page.moved = True

    def choose(self, client_id: int, follows: bool, fits: bool, direction: str = "") -> None:
        """Let a page's camera follow or not, keep all in view or not, and look from a direction of `DIRECTIONS`."""
        with self._lock:
            page = self._pages.get(client_id)
            if page is None:
                return
            page.moved = page.moved or direction in DIRECTIONS or (fits and not page.fits)
            page.direction = DIRECTIONS.get(direction, page.direction)
            page.follows, page.fits = follows, fits

    def set_target(self, p_W: Array) -> None:
        """Aim the cameras of later pages at positions (n, 3) [m], unless there are none."""
        if len(p_W):
            self._points = p_W

    def follow(self, p_W: Array) -> None:
        """Move the cameras that follow the positions (n, 3) [m]."""
        self.set_target(p_W)
        if not len(p_W):
            return
        with self._lock:
            pages = [page for page in self._pages.values() if page.follows or page.moved]
        for page in pages:
            self._move(page)

    def _move(self, page: _Page) -> None:
        camera, centre = page.client.camera, _centre(self._points)
        back = camera.position - camera.look_at
        now_m = float(np.linalg.norm(back))
        direction = page.direction if page.direction is not None else back / max(now_m, 1e-9)
        distance_m = self._distance_m(page, direction, centre, now_m)
        near = float(np.linalg.norm(centre - camera.look_at)) <= DEADBAND * now_m
        if page.moved or not near or distance_m != now_m:
            page.moved, page.direction = False, None
            aim(page.client, centre, direction * distance_m / float(np.linalg.norm(direction)))

    def _distance_m(self, page: _Page, direction: Array, centre: Array, now_m: float) -> float:
        """Return from how far a page is to look; as it does, unless that is too near or much too far."""
        camera = page.client.camera
        fit_m = fit_distance_m(self._points, centre, direction, UP_W, camera.fov, camera.aspect)
        if page.moved:
            return SPARE * fit_m
        return now_m if not page.fits or NEARER * now_m <= fit_m <= now_m else SPARE * fit_m

    def _on_connect(self, client: viser.ClientHandle) -> None:
        page = _Page(client)
        self._move(page)
        page.moved = True  # once more at the next picture: the first one may be that of another run
        with self._lock:
            self._pages[client.client_id] = page
        if client.client_id not in self._server.get_clients():
            self._on_disconnect(client)  # it has disconnected meanwhile

    def _on_disconnect(self, client: viser.ClientHandle) -> None:
        with self._lock:
            self._pages.pop(client.client_id, None)


def _centre(p_W: Array) -> Array:
    """Return the middle of the box around positions (n, 3)."""
    return (p_W.min(axis=0) + p_W.max(axis=0)) / 2


NODE = "/camera_frustum"
SCALE = 0.8  # of a frustum: the picture on it is about a metre wide; chosen: beside a hull of half a metre
EDGE_PX = 2.0
COLOUR = (226, 0, 134)
FIELD_MAX_RAD = 2.6  # of an angle of view that is drawn; beyond it the picture would be wider than the formation
PAGE_KEY_BYTES = 12


class ShownPicture(Protocol):
    """A picture; another has another number."""

    @property
    def number(self) -> int: ...

    @property
    def image(self) -> CameraImage: ...


Shown = Callable[[str], tuple[CameraInfo, ShownPicture] | None]
"""Returns a camera with its newest picture, None while there is none."""


def frustum_pose(info: CameraInfo, p_WB: Array, q_WB: Array) -> tuple[Array, Array]:
    """Return position [m; W] and quaternion, K to W, of a camera.

    Args:
        info: of the camera; usable.
        p_WB, q_WB: of its drone, (3,) m and (4,).
    """
    p_WK = p_WB + frames.rotate(q_WB, info.position_m)
    return p_WK, frames.quaternion_multiply(q_WB, rotation.normalised(info.orientation_wxyz))


class CameraFrustums:
    """The frusta of all pages; one that appears out of its page's view is brought into it.

    Args:
        server: viser's. Each page is told a key of its own, by which it says here which frustum it shows.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._lock = threading.Lock()
        self._pages: dict[str, viser.ClientHandle] = {}  # by key
        self._chosen: dict[str, str] = {}  # camera by key
        self._clicked: dict[str, str] = {}  # drone by key
        self._nodes: dict[str, _Frustum] = {}  # by key; only touched where it is drawn
        server.on_client_connect(self._on_connect)
        server.on_client_disconnect(self._on_disconnect)

    def client_id(self, page: str) -> int | None:
        """Return viser's number of a page, None of one that is not open."""
        with self._lock:
            return self._pages[page].client_id if page in self._pages else None

    def choose(self, page: str, camera: str) -> None:
        """Show a camera's frustum on a page, empty for none."""
        with self._lock:
            if page in self._pages and camera:
                self._chosen[page] = camera
            else:
                self._chosen.pop(page, None)

    def click(self, client_id: int, drone: str) -> None:
        """Tell a page, by viser's number of it, that a drone was clicked in its scene."""
        with self._lock:
            for key, page in self._pages.items():
                if page.client_id == client_id:
                    self._clicked[key] = drone

    def take_click(self, page: str) -> str:
        """Return the drone that was clicked last in a page's scene, once; empty for none."""
        with self._lock:
            return self._clicked.pop(page, "")

    def draw(self, drones: DronePoses | None, shown: Shown) -> None:
        """Draw those that are chosen, and remove the others."""
        with self._lock:
            pages = {key: (self._pages[key], camera) for key, camera in self._chosen.items() if key in self._pages}
        for key in self._nodes.keys() - pages.keys():
            self._nodes.pop(key).remove()
        for key, (client, camera) in pages.items():
            self._draw_one(key, client, camera, drones, shown(camera))

    def clear(self) -> None:
        """Remove all: the run is over."""
        with self._lock:
            self._chosen.clear()
        self.draw(None, lambda _: None)

    def _draw_one(
        self, key: str, client: viser.ClientHandle, camera: str, drones: DronePoses | None, what: Any
    ) -> None:
        node = self._nodes.get(key)
        if node is not None and node.camera != camera:
            self._nodes.pop(key).remove()
            node = None
        index = drone_index(drones, camera)
        if what is None or drones is None or index is None:
            return
        info, picture = what
        p_W, q_WK = frustum_pose(info, drones.p_W[index], drones.q_WB[index])
        if node is None:
            bring_into_view(client, p_W, p_W + frames.rotate(q_WK, (0.0, 0.0, SCALE)))
        node = self._nodes[key] = node or _Frustum(client, camera, info)
        node.move(p_W, q_WK)
        node.show(picture.number, picture.image)

    def _on_connect(self, client: viser.ClientHandle) -> None:
        key = secrets.token_urlsafe(PAGE_KEY_BYTES)
        with self._lock:
            self._pages[key] = client
        client.gui.add_html(f'<i data-zsim-page="{key}"></i>', order=-2.0)

    def _on_disconnect(self, client: viser.ClientHandle) -> None:
        with self._lock:
            for key in [key for key, other in self._pages.items() if other.client_id == client.client_id]:
                del self._pages[key]
                self._chosen.pop(key, None)
                self._clicked.pop(key, None)


def drone_index(drones: DronePoses | None, camera: str) -> int | None:
    """Return which drone a camera is on, None if it is not in the view."""
    drone = camera.partition("/")[0]
    if drones is None or drone not in drones.names:
        return None
    index = drones.names.index(drone)
    return index if drones.present[index] else None


class _Frustum:
    """The frustum of one page."""

    def __init__(self, client: viser.ClientHandle, camera: str, info: CameraInfo) -> None:
        self.camera = camera
        self._number = 0
        self._node: Any = client.scene.add_camera_frustum(
            NODE, min(field_of_view(info), FIELD_MAX_RAD), info.width / info.height, scale=SCALE, thickness=EDGE_PX,
            thickness_units="screen", color=COLOUR, cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        self._node._format = "jpeg"

    def move(self, p_W: Array, q_WK: Array) -> None:
        self._node.position, self._node.wxyz = p_W, q_WK

    def show(self, number: int, image: CameraImage) -> None:
        """Show a picture: the JPEG as it came, which viser's own way would decode and encode again."""
        if number != self._number:
            self._number, self._node._image_data = number, image.data

    def remove(self) -> None:
        self._node.remove()
