"""Where all drones are in one camera's picture, computed together. Pure."""

from collections import defaultdict
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.math.frames import rotation_matrix
from zsim_agents.cameras.rendering.balls import NEAR_M, Ball
from zsim_agents.cameras.rendering.drones import DroneImage, blade_points, drone_model
from zsim_agents.cameras.rendering.faces import fixed
from zsim_agents.cameras.rendering.scene import DroneStates, Scene
from zsim_agents.cameras.rendering.view import CameraMotion, View, skew

Array = NDArray[np.float64]
MAGENTA = np.array([134.0, 0.0, 226.0])  # B, G, R of the paper's marker
SEEN_M = 300.0  # m; what is farther is less than a pixel
ROOM_M = 0.5  # m; a drone of which no part is farther from its middle, by its arms of 0.18 m
BLADE_RAD = 0.3  # rad, that a blade covers of the circle, at two thirds of its radius
OPACITY = 0.16, 0.9  # of what a blade sweeps over, least and most; chosen


class DroneImages(NamedTuple):
    """The drones over one exposure.

    Attributes:
        distances_m: of the drones from the camera.
        in_view: which of them may be in the picture.
        cameras_B: the camera in the body of each, (N, 3) [m].
        hats: of those in view, where their hats are seen.
        drones: what is to be drawn of each that is wholly before the camera.
    """

    distances_m: list[float]
    in_view: list[int]
    cameras_B: Array
    hats: dict[int, Ball]
    drones: dict[int, DroneImage]


def balls(view: View, centres_K: Array, ways_K: Array, radius_m: float, brightness: float) -> list[Ball]:
    """Return hats in front of the camera by their centres and how these move during the exposure, (M, 3) [m; K]."""
    if not len(centres_K):
        return []
    flows = np.hypot(*view.flow_px(centres_K, ways_K).T).tolist()
    rows = zip(centres_K, ways_K, view.pixels(centres_K), flows, strict=True)
    return [Ball(*row, radius_m, brightness * MAGENTA) for row in rows]


class DroneImager:
    """The drones of a scene as one camera sees them.

    Args:
        view: of the camera.
        scene: with the drones' looks.
        carrier: which of them carries the camera.
        exposure_s: time of exposure [s].
        brightness: of the light, as the sensor has it.
    """

    def __init__(self, view: View, scene: Scene, carrier: int, exposure_s: float, brightness: float) -> None:
        self._view, self._looks, self._carrier = view, scene.drones, carrier
        self._exposure_s, self._brightness = exposure_s, brightness
        self._models = [drone_model(look) for look in scene.drones]
        self._hat, self._radius_m = np.array(scene.hats.position_m), scene.hats.diameter_m / 2
        self._kinds: list[int] = []  # of each drone, the first that looks the same
        firsts: dict[tuple[bytes, bytes, float], int] = {}
        for i, look in enumerate(scene.drones):
            key = look.hubs_B.tobytes(), look.turns.tobytes(), look.radius_m
            self._kinds.append(firsts.setdefault(key, i))
        lens = view.lens
        self._edges = max(lens.cx, lens.width - lens.cx) / lens.fx, max(lens.cy, lens.height - lens.cy) / lens.fy
        self._slack = 1.5 if view.distorts else 1.05

    def images(self, motion: CameraMotion, t_s: float, bodies: DroneStates) -> DroneImages:
        """Return the drones over an exposure about t_s [s]."""
        R_WB = rotation_matrix(bodies.q_WB)
        R_KB = motion.R_WK.T @ R_WB
        centres = motion.points_K(bodies.p_WB)
        hats = centres + R_KB @ self._hat
        hat_velocities = bodies.v_WB + np.einsum("nij,nj->ni", R_WB, bodies.w_WB_B @ -skew(self._hat).T)
        hat_ways = motion.rates_K(hats, hat_velocities) * self._exposure_s
        ways = motion.rates_K(centres, bodies.v_WB) * self._exposure_s
        cameras_B = np.einsum("nji,nj->ni", R_KB, -centres)
        distances = np.sqrt((centres * centres).sum(axis=-1))
        in_view = self._in_view(centres, distances)
        drones: dict[int, DroneImage] = {}
        for kind, which in self._by_kind(in_view).items():
            self._add(drones, kind, which, R_KB, centres, ways, cameras_B, t_s, bodies)
        balls = self._hats([i for i in in_view if self._looks[i].has_hat], hats, hat_ways)
        return DroneImages(distances.tolist(), in_view, cameras_B, balls, drones)

    def _hats(self, which: list[int], centres: Array, ways: Array) -> dict[int, Ball]:
        shown = [i for i in which if centres[i, 2] > NEAR_M]
        return dict(
            zip(shown, balls(self._view, centres[shown], ways[shown], self._radius_m, self._brightness), strict=True)
        )

    def _in_view(self, centres: Array, distances: Array) -> list[int]:
        room = ROOM_M * max(model.size for model in self._models)
        across, down = (self._slack * edge for edge in self._edges)
        ahead = centres[:, 2] + room
        near = (np.abs(centres[:, 0]) - 2 * room < across * ahead) & (np.abs(centres[:, 1]) - 2 * room < down * ahead)
        near &= (distances < SEEN_M) & (ahead > 0)
        near[self._carrier] = False  # its own parts are not in its picture
        return np.flatnonzero(near).tolist()

    def _by_kind(self, which: list[int]) -> dict[int, list[int]]:
        groups: defaultdict[int, list[int]] = defaultdict(list)
        for i in which:
            groups[self._kinds[i]].append(i)
        return groups

    def _add(
        self,
        drones: dict[int, DroneImage],
        kind: int,
        which: list[int],
        R_KB: Array,
        centres: Array,
        ways: Array,
        cameras_B: Array,
        t_s: float,
        bodies: DroneStates,
    ) -> None:
        """Add the images of the drones of one look."""
        look, model = self._looks[kind], self._models[kind]
        speeds = np.array([bodies.rotors[i] for i in which], float)
        blades = blade_points(look, model.size, t_s, self._exposure_s, speeds)
        of_model = np.broadcast_to(model.points, (len(which), *model.points.shape))
        points: Array = (
            np.concatenate([of_model, blades], axis=1) @ R_KB[which].transpose(0, 2, 1) + centres[which, None]
        )
        visible = points[..., 2].min(axis=1) > NEAR_M
        pixels, middles = fixed(self._view.pixels(points)), self._view.pixels(centres[which])
        flows = self._view.flow_px(centres[which], ways[which])
        sweeps = np.maximum(np.abs(speeds).mean(axis=1) * self._exposure_s, BLADE_RAD)
        for at in np.flatnonzero(visible).tolist():
            i = which[at]
            drones[i] = DroneImage(
                model,
                pixels[at],
                middles[at],
                float(centres[i, 2]),
                flows[at],
                from_above=bool(cameras_B[i, 2] > 0.03 * model.size),
                shows_lens=bool(cameras_B[i, 0] > 0.1 * model.size),
                brightness=self._brightness,
                opacity=float(np.clip(BLADE_RAD / sweeps[at], *OPACITY)),
            )
