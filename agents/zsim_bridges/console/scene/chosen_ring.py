"""A ring about the drone that one page has chosen, in the scene of that page alone."""

from typing import Any

import numpy as np
import viser

from zsim_bridges.console.scene import airframe
from zsim_bridges.console.scene.picture import Array, DronePoses
from zsim_bridges.console.scene.scene_nodes import HIDDEN

CHOSEN = (25, 113, 194)


class ChosenRing:
    """The ring of one page.

    Args:
        scene: viser's of that page.
        radii_m: of the drones, in the order of their poses.
    """

    def __init__(self, scene: viser.SceneApi, radii_m: Array) -> None:
        self._radii_m = radii_m
        self._chosen = -1
        mesh = airframe.ring()
        level, nowhere = np.array([[1.0, 0.0, 0.0, 0.0]]), np.array(HIDDEN).reshape(1, 3)
        self._node: Any = scene.add_batched_meshes_simple(
            "/chosen", mesh.vertices, mesh.faces, level, nowhere, batched_scales=np.ones((1, 3)),
            batched_colors=CHOSEN, lod="off", cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def move(self, drones: DronePoses, chosen: str) -> None:
        """Put the ring about the chosen drone; out of sight while that one is not there."""
        index = drones.names.index(chosen)
        self._node.batched_positions = drones.p_W[[index]] if drones.present[index] else np.reshape(HIDDEN, (1, 3))
        if index != self._chosen:
            self._chosen = index
            self._node.batched_scales = np.full((1, 3), self._radii_m[index])
