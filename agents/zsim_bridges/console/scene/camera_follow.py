"""Cameras: where they begin, and those that go with the formation, each as its own page wants it."""

import threading
from typing import Any

import numpy as np
import viser

from zsim_bridges.console.scene.picture import Array

OFFSET_M = np.array([-2.3, -3.9, 1.7])  # of a camera, from what it looks at, where that is not larger than EXTENT_M
EXTENT_M = 2.0  # from its middle
DEADBAND_M = 0.25  # a shorter way of what is followed does not move the camera: pictures then need not be drawn anew


class CameraFollow:
    """Knows the pages that are open.

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
        self._places: dict[int, Array] = {}
        self._centre: Array = np.zeros(3)
        self._offset: Array = OFFSET_M
        self._aimed = False
        server.on_client_connect(self._on_connect)
        server.on_client_disconnect(self._on_disconnect)

    def restart(self) -> None:
        """Let all cameras look at what is to be seen first: another run may fly elsewhere."""
        self._aimed = False

    def set_target(self, p_W: Array) -> None:
        """Let the cameras of pages to come look at what stands at some places (n, 3) [m], unless there is nothing."""
        if not len(p_W):
            return
        self._centre = p_W.mean(axis=0)
        extent_m = float(np.linalg.norm(p_W - self._centre, axis=1).max())
        self._offset = OFFSET_M * max(1.0, extent_m / EXTENT_M)

    def follow(self, p_W: Array) -> None:
        """Move the cameras that follow what now stands at some places (n, 3) [m]."""
        self.set_target(p_W)
        centre = self._centre
        with self._lock:
            switches = list(self._switches.items())
        if not self._aimed and len(p_W):
            self._aimed = True
            for _, (client, _) in switches:
                _aim(client, centre, self._offset)
        for number, (client, switch) in switches:
            if self._moves(number, switch.value, centre):
                _aim(client, centre, client.camera.position - client.camera.look_at)

    def _moves(self, number: int, follows: bool, centre: Array) -> bool:
        """Tell whether a page's camera goes to a place, and note that it does."""
        with self._lock:
            if not follows:
                self._places.pop(number, None)
            near = np.linalg.norm(centre - self._places.get(number, np.full(3, np.inf))) <= DEADBAND_M
            if not follows or near or number not in self._switches:
                return False
            self._places[number] = centre
            return True

    def _on_connect(self, client: viser.ClientHandle) -> None:
        with client.atomic():
            _aim(client, self._centre, self._offset)
        switch = client.gui.add_checkbox("Camera follows the formation", False, order=-1.0)
        with self._lock:
            self._switches[client.client_id] = (client, switch)
            self.switches.add(switch._impl.uuid)
        if client.client_id not in self._server.get_clients():
            self._on_disconnect(client)  # it went while it came

    def _on_disconnect(self, client: viser.ClientHandle) -> None:
        with self._lock:
            _, switch = self._switches.pop(client.client_id, (None, None))
            self._places.pop(client.client_id, None)
            if switch is not None:
                self.switches.discard(switch._impl.uuid)


def _aim(client: viser.ClientHandle, centre: Array, offset: Array) -> None:
    with client.atomic():
        client.camera.position = centre + offset
        client.camera.look_at = centre
