"""The cameras of all pages: each follows the formation and has all of it in view, unless its page wants otherwise."""

import threading
from dataclasses import dataclass, field

import numpy as np
import viser

from zsim_bridges.console.scene.page_camera import DISTANCE_MIN_M, OFFSET_M, aim, fit_distance_m
from zsim_bridges.console.scene.picture import Array

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
