"""The camera with which each page looks at the scene: where it begins, what it follows, and what it has in view."""

import math
import threading
from typing import Any, NamedTuple

import numpy as np
import viser

from zsim_bridges.console.page.picture import Array

OFFSET_M = np.array([-2.3, -3.9, 1.7])  # of a camera, from what it looks at, where that is not larger than EXTENT_M
EXTENT_M = 2.0  # from its centre
DEADBAND_M = 0.25  # a shorter move does not move the camera: pictures then need not be drawn anew
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


def _unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector)


def bring_into_view(client: viser.ClientHandle, *points_W: Array) -> None:
    """Aim a page's camera at the first of some points [m; W], unless it has all in view."""
    camera = client.camera
    view = CameraView(camera.position, camera.look_at, camera.up_direction, camera.fov, camera.aspect)
    if not all(view.contains(p_W) for p_W in points_W):
        aim(client, points_W[0], view.offset())


class CameraFollow:
    """Cameras of all pages: where they begin, and which follow the formation, as each page chooses.

    Args:
        server: viser's.

    Attributes:
        switches: ids of the controls by which each page chooses for itself.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self.switches: set[str] = set()
        self._server = server
        self._lock = threading.Lock()
        self._switches: dict[int, tuple[viser.ClientHandle, Any]] = {}
        self._targets: dict[int, Array] = {}
        self._centre: Array = np.zeros(3)
        self._offset: Array = OFFSET_M
        self._aimed = False
        server.on_client_connect(self._on_connect)
        server.on_client_disconnect(self._on_disconnect)

    def restart(self) -> None:
        """Aim all cameras anew at the first picture: another run may fly elsewhere."""
        self._aimed = False

    def set_target(self, p_W: Array) -> None:
        """Aim the cameras of later pages at positions (n, 3) [m], unless there are none."""
        if not len(p_W):
            return
        self._centre = p_W.mean(axis=0)
        extent_m = float(np.linalg.norm(p_W - self._centre, axis=1).max())
        self._offset = OFFSET_M * max(1.0, extent_m / EXTENT_M)

    def follow(self, p_W: Array) -> None:
        """Move the cameras that follow the positions (n, 3) [m]."""
        self.set_target(p_W)
        centre = self._centre
        with self._lock:
            switches = list(self._switches.items())
        if not self._aimed and len(p_W):
            self._aimed = True
            for _, (client, _) in switches:
                aim(client, centre, self._offset)
        for number, (client, switch) in switches:
            if self._moves(number, switch.value, centre):
                aim(client, centre, client.camera.position - client.camera.look_at)

    def _moves(self, number: int, follows: bool, centre: Array) -> bool:
        """Return whether a page's camera has to move, and store where to."""
        with self._lock:
            if not follows:
                self._targets.pop(number, None)
            near = np.linalg.norm(centre - self._targets.get(number, np.full(3, np.inf))) <= DEADBAND_M
            if not follows or near or number not in self._switches:
                return False
            self._targets[number] = centre
            return True

    def _on_connect(self, client: viser.ClientHandle) -> None:
        with client.atomic():
            aim(client, self._centre, self._offset)
        switch = client.gui.add_checkbox("Camera follows the formation", False, order=-1.0)
        with self._lock:
            self._switches[client.client_id] = (client, switch)
            self.switches.add(switch._impl.uuid)
        if client.client_id not in self._server.get_clients():
            self._on_disconnect(client)  # it has disconnected meanwhile

    def _on_disconnect(self, client: viser.ClientHandle) -> None:
        with self._lock:
            _, switch = self._switches.pop(client.client_id, (None, None))
            self._targets.pop(client.client_id, None)
            if switch is not None:
                self.switches.discard(switch._impl.uuid)


def aim(client: viser.ClientHandle, centre: Array, offset: Array) -> None:
    """Aim a page's camera at a point from an offset [m; W]."""
    with client.atomic():
        client.camera.position = centre + offset
        client.camera.look_at = centre
