"""Cameras in the scenes of pages: the pages' own viewpoints, and frusta of drones' cameras.

A page's camera follows the formation and keeps all of it in view, unless the page chooses otherwise. A page may also
show the frustum of one drone's camera, with the camera's picture.
"""

import math
import secrets
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import viser

from zsim.contract.flight_messages import CameraInfo
from zsim.math import frames, rotation
from zsim_bridges.console.camera_feed import CameraPicture, field_of_view
from zsim_bridges.console.page_server import show_jpeg
from zsim_bridges.console.picture import Array, DronePoses

OFFSET_M = np.array([-2.3, -3.9, 1.7])  # offset of a page's camera from its target, unless it must be farther away
DISTANCE_MIN_M = float(np.linalg.norm(OFFSET_M))
SLOPE_MIN = 0.05  # half the visible width per unit of distance on the narrowest page considered; hidden pages have none
REACH_M = 0.6  # radius of a drone together with the name above it
VISIBLE_MAX_M = 15.0  # distance beyond which a drone is too small, less than about 15 pixels, to be seen
MARGIN = 0.85  # share of half the page within which points are considered in view
UP_W = np.array([0.0, 0.0, 1.0])
DIRECTIONS = {  # directions from the target to the camera; not straight from above, where the up direction is undefined
    "reset": OFFSET_M / DISTANCE_MIN_M,
    "top": np.array([0.0, -0.02, 1.0]),
    "side": np.array([0.0, -1.0, 0.06]),
}
DEADBAND = 0.05  # share of the camera's distance; shorter moves are not followed, so that the page need not redraw
FIT_MARGIN = 1.15  # ratio of the camera's distance to that at which everything is just in view
APPROACH_SHARE = 0.6  # the camera comes nearer if the fitting distance is less than this share of the present one
NODE = "/camera_frustum"
SCALE = 0.8  # size of a frustum, with a picture about a metre wide; design choice: suits a hull of half a metre
EDGE_PX = 2.0
COLOUR = (226, 0, 134)
FIELD_MAX_RAD = 2.6  # maximum angle of view that is drawn; otherwise the picture might be wider than the formation
PAGE_KEY_BYTES = 12


class CameraView(NamedTuple):
    """The view of a page's camera."""

    position: Array  # (3,) m; W
    look_at: Array  # (3,) m; W
    up: Array  # (3,); W
    fov: float  # vertical angle of view [rad]
    aspect: float  # width / height

    def contains(self, p_W: Array) -> bool:
        """Return whether a point [m; W] is in view and near enough."""
        forward = _unit(self.look_at - self.position)
        right = _unit(np.cross(forward, self.up))
        offset = p_W - self.position
        x, y, z = offset @ right, offset @ np.cross(forward, right), offset @ forward
        half_height = MARGIN * math.tan(self.fov / 2) * z
        return bool(0.0 < z <= VISIBLE_MAX_M and abs(y) <= half_height and abs(x) <= half_height * self.aspect)

    def offset(self) -> Array:
        """Return an offset from a new target to the camera [m; W]: the present one, at most |OFFSET_M| long."""
        to_camera = self.position - self.look_at
        return to_camera * min(1.0, float(np.linalg.norm(OFFSET_M) / np.linalg.norm(to_camera)))


def fit_distance_m(
    points_W: Array, centre_W: Array, to_camera_W: Array, up_W: Array, fov: float, aspect: float
) -> float:
    """Return the distance at which a camera aimed at a centre has all points in view [m]; at least DISTANCE_MIN_M.

    Args:
        points_W: the points, (n, 3) m.
        centre_W: the camera's target, (3,) m.
        to_camera_W: direction from the target to the camera, (3,); not parallel to `up_W`.
        up_W: up direction of the camera, (3,).
        fov: vertical angle of view [rad].
        aspect: width / height.
    """
    to_camera = _unit(to_camera_W)
    right = _unit(np.cross(up_W, to_camera))
    offsets = points_W - centre_W
    lateral = np.abs(np.column_stack((offsets @ right, offsets @ np.cross(to_camera, right)))) + REACH_M
    slopes = np.maximum(MARGIN * math.tan(fov / 2) * np.array([aspect, 1.0]), SLOPE_MIN)
    return float(np.max(lateral / slopes + (offsets @ to_camera)[:, None], initial=DISTANCE_MIN_M))


def _unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector)


def _aim(client: viser.ClientHandle, centre: Array, offset: Array) -> None:
    with client.atomic():
        client.camera.position = centre + offset
        client.camera.look_at = centre


@dataclass
class _Page:
    """A page: how its camera looks at the scene, and the shown frustum; sockets identify the page by `key`."""

    client: viser.ClientHandle
    key: str = field(default_factory=lambda: secrets.token_urlsafe(PAGE_KEY_BYTES))
    follows: bool = True  # whether its camera moves with the formation
    fits: bool = True  # whether the camera's distance is adjusted to keep all drones in view
    direction: Array | None = field(default_factory=DIRECTIONS["reset"].copy)  # next viewing direction; None: unchanged
    needs_aim: bool = True  # whether its camera must be aimed again
    camera: str = ""  # the drone's camera whose frustum is shown; empty for none
    clicked: str = ""  # the drone last clicked in the page's scene, until `pop_click`


@dataclass
class _Frustum:
    camera: str
    node: Any  # viser's handle
    number: int = 0  # number of its picture


class PageCameras:
    """The cameras with which pages look at the scene, and the frusta of drones' cameras within it.

    A page's camera moves to a frustum that appears out of view.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._lock = threading.Lock()
        self._pages: dict[int, _Page] = {}  # by viser's number
        self._points: Array = np.zeros((1, 3))
        self._frusta: dict[int, _Frustum] = {}  # by viser's number of the page; used only by the drawing thread
        server.on_client_connect(self._on_connect)
        server.on_client_disconnect(self._on_disconnect)

    def _on_connect(self, client: viser.ClientHandle) -> None:
        page = _Page(client)
        self._move(page)
        page.needs_aim = True  # aim again at the next picture: the present target may be that of another run
        with self._lock:
            self._pages[client.client_id] = page
        client.gui.add_html(f'<i data-zsim-page="{page.key}"></i>', order=-2.0)
        if client.client_id not in self._server.get_clients():
            self._on_disconnect(client)  # it has disconnected meanwhile

    def _on_disconnect(self, client: viser.ClientHandle) -> None:
        with self._lock:
            self._pages.pop(client.client_id, None)

    def client_id(self, key: str) -> int | None:
        """Return viser's number of a page, None if it is not open."""
        with self._lock:
            return next((number for number, page in self._pages.items() if page.key == key), None)

    # How pages look at the scene

    def restart(self) -> None:
        """Aim all cameras again at the first picture of another run."""
        with self._lock:
            for page in self._pages.values():
                page.needs_aim = True

    def look(self, client_id: int, follows: bool, fits: bool, direction: str = "") -> None:
        """Set whether a page's camera follows and keeps all in view; look from a direction in `DIRECTIONS`, if any."""
        with self._lock:
            page = self._pages.get(client_id)
            if page is None:
                return
            page.needs_aim = page.needs_aim or direction in DIRECTIONS or (fits and not page.fits)
            page.direction = DIRECTIONS.get(direction, page.direction)
            page.follows, page.fits = follows, fits

    def set_target(self, p_W: Array) -> None:
        """Aim the cameras of pages opened later at positions (n, 3) [m; W], unless n is 0."""
        if len(p_W):
            self._points = p_W

    def follow(self, p_W: Array) -> None:
        """Move the cameras that follow the formation to new positions (n, 3) [m; W]."""
        self.set_target(p_W)
        if not len(p_W):
            return
        with self._lock:
            pages = [page for page in self._pages.values() if page.follows or page.needs_aim]
        for page in pages:
            self._move(page)

    def _move(self, page: _Page) -> None:
        camera, points = page.client.camera, self._points
        centre = (points.min(axis=0) + points.max(axis=0)) / 2
        to_camera = camera.position - camera.look_at
        present_m = float(np.linalg.norm(to_camera))
        direction = page.direction if page.direction is not None else to_camera / max(present_m, 1e-9)
        fit_m = fit_distance_m(points, centre, direction, UP_W, camera.fov, camera.aspect)
        keeps_distance = not page.needs_aim and (not page.fits or APPROACH_SHARE * present_m <= fit_m <= present_m)
        is_near = float(np.linalg.norm(centre - camera.look_at)) <= DEADBAND * present_m
        if not (keeps_distance and is_near):
            page.needs_aim, page.direction = False, None
            distance_m = present_m if keeps_distance else FIT_MARGIN * fit_m
            _aim(page.client, centre, direction * distance_m / float(np.linalg.norm(direction)))

    # Frusta

    def show_frustum(self, key: str, camera: str) -> None:
        """Show a camera's frustum on a page; empty: none."""
        with self._lock:
            for page in self._pages.values():
                if page.key == key:
                    page.camera = camera

    def click(self, client_id: int | None, drone: str) -> None:
        """Record that a drone was clicked in the scene of a page."""
        with self._lock:
            if client_id in self._pages:
                self._pages[client_id].clicked = drone

    def pop_click(self, key: str) -> str:
        """Return the drone last clicked in a page's scene, once; empty for none."""
        clicked = ""
        with self._lock:
            for page in self._pages.values():
                if page.key == key:
                    clicked, page.clicked = page.clicked, ""
        return clicked

    def draw_frusta(
        self, drones: DronePoses | None, view_of: Callable[[str], tuple[CameraInfo, CameraPicture] | None]
    ) -> None:
        """Draw the chosen frusta, and remove the others; `view_of` returns a camera with its newest picture."""
        with self._lock:
            chosen = {number: (page.client, page.camera) for number, page in self._pages.items() if page.camera}
        for number, frustum in list(self._frusta.items()):
            if number not in chosen or chosen[number][1] != frustum.camera:
                self._frusta.pop(number).node.remove()
        for number, (client, camera) in chosen.items():
            view, index = view_of(camera), drone_index(drones, camera)
            if view is None or drones is None or index is None:
                continue
            info, picture = view
            p_W, q_WK = frustum_pose(info, drones.p_W[index], drones.q_WB[index])
            frustum = self._frusta.get(number)
            if frustum is None:
                _bring_into_view(client, p_W, p_W + frames.rotate(q_WK, (0.0, 0.0, SCALE)))
                node: Any = client.scene.add_camera_frustum(
                    NODE, min(field_of_view(info), FIELD_MAX_RAD), info.width / info.height, scale=SCALE,
                    thickness=EDGE_PX, thickness_units="screen", color=COLOUR, cast_shadow=False, receive_shadow=False,
                )  # fmt: skip
                frustum = self._frusta[number] = _Frustum(camera, node)
            frustum.node.position, frustum.node.wxyz = p_W, q_WK
            if picture.number != frustum.number:
                frustum.number = picture.number
                show_jpeg(frustum.node, picture.image.data)

    def clear_frusta(self) -> None:
        """Remove all frusta, at the end of a run."""
        with self._lock:
            for page in self._pages.values():
                page.camera = ""
        self.draw_frusta(None, lambda _: None)


def frustum_pose(info: CameraInfo, p_WB: Array, q_WB: Array) -> tuple[Array, Array]:
    """Return position [m; W] and quaternion (K to W) of a usable camera, on a drone at `p_WB` (3,) [m], `q_WB` (4,)."""
    p_WK = p_WB + frames.rotate(q_WB, info.position_m)
    return p_WK, frames.quaternion_multiply(q_WB, rotation.normalised(info.orientation_wxyz))


def drone_index(drones: DronePoses | None, camera: str) -> int | None:
    """Return the index of the drone that carries a camera, None if it is not in the view."""
    drone = camera.partition("/")[0]
    if drones is None or drone not in drones.names:
        return None
    index = drones.names.index(drone)
    return index if drones.present[index] else None


def _bring_into_view(client: viser.ClientHandle, *points_W: Array) -> None:
    """Aim a page's camera at the first of some points [m; W], unless all are in view."""
    camera = client.camera
    view = CameraView(camera.position, camera.look_at, camera.up_direction, camera.fov, camera.aspect)
    if not all(view.contains(p_W) for p_W in points_W):
        _aim(client, points_W[0], view.offset())
