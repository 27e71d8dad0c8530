"""Frusta of cameras in the scene, with their pictures on them: each page shows the one that was clicked on it."""

import secrets
import threading
from collections.abc import Callable
from typing import Any, Protocol

import viser

from zsim.contract.flight_messages import CameraImage, CameraInfo
from zsim.math import frames, rotation
from zsim_bridges.console.cameras.camera_marks import field_of_view
from zsim_bridges.console.scene.page_camera import bring_into_view
from zsim_bridges.console.scene.picture import Array, DronePoses

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
