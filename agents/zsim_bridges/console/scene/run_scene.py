"""The scene of one run: its newest views as nodes, and what pages show of the time before they were opened."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import viser

from zsim.contract.flight_messages import ViewDrones
from zsim.contract.messages import Info
from zsim.math import frames
from zsim.scenario.scenario import Scenario
from zsim_agents.formation.spaces.cluster_space import ClusterSpace
from zsim_bridges.console.monitoring.view_buffer import ViewBuffer
from zsim_bridges.console.scene.camera_follow import CameraFollow
from zsim_bridges.console.scene.flight_preview import FlightPreview
from zsim_bridges.console.scene.picture import (
    Array,
    CanvasTrails,
    DronePoses,
    FormationShape,
    drone_on_ray,
    drone_poses,
    ellipsoids,
    formation_shape,
    ghosts,
)
from zsim_bridges.console.scene.scene_nodes import SceneNodes


class RunScene:
    """The scene of one run.

    Args:
        server: viser's; what another run has left in its scene is removed.
        info: of the run.
        scenario: of the run.
        spaces: of its formations.
        views: the newest of everything.
        camera_follow: moves the page's cameras that follow the formation.

    Attributes:
        nodes: viser's.
        drones: their newest poses, None before the first view.
        shapes: the formations as they truly stand, by name; None where a drone of one is missing.
        trails: of the drones.
        previews: ways (n, M, 3) [m] of the drones of formations, by name, that would be flown.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        info: Info,
        scenario: Scenario,
        spaces: Mapping[str, ClusterSpace],
        views: ViewBuffer,
        camera_follow: CameraFollow,
    ) -> None:
        self._names = tuple(drone.name for drone in info.drones)
        self._spaces = spaces
        self._views = views
        self._camera_follow = camera_follow
        self._members = {c.name: [self._names.index(d) for d in c.drones] for c in scenario.clusters}
        self._drawn_ghosts: dict[str, Any] = {}
        self.drones: DronePoses | None = None
        self.shapes: dict[str, FormationShape | None] = {}
        self.previews: dict[str, Array] = {}
        self.trails = CanvasTrails(len(self._names), around=bool(info.replay_of))
        robots = sum(space.n for space in spaces.values())
        arms_m = [drone.arm_m for drone in scenario.drones]
        self.nodes = SceneNodes(server, info.drones, arms_m, robots, len(spaces))
        self.nodes.obstacles(scenario.environment.obstacles)
        camera_follow.restart()

    def clicked(self, event: viser.SceneClickEvent) -> str | None:
        """Return the drone that a click has hit."""
        if self.drones is None:
            return None
        return drone_on_ray(self.drones, self.nodes.radii_m, event.ray_origin, event.ray_direction)

    def store(self, view: ViewDrones) -> DronePoses:
        """Store the drones' newest poses, and return them; cameras of later pages look at them."""
        drones = drone_poses(view, self._names)
        self.drones = drones
        self.trails.add(drones.t_ns / 1e9, drones.p_W)
        self.shapes = self.shapes_of(drones)
        self._camera_follow.set_target(self._camera_targets(drones))
        return drones

    def draw(self, view: ViewDrones, longest_s: float, chosen: str) -> DronePoses:
        """Draw a view of the drones, and return their poses.

        Args:
            view: of the drones.
            longest_s: for which rotors turn at most, from one picture to the next.
            chosen: the formation whose figures are drawn.
        """
        before_ns = self.drones.t_ns if self.drones is not None else 0
        drones = self.store(view)
        self.nodes.drones(drones, min(longest_s, max(0.0, (drones.t_ns - before_ns) / 1e9)))
        estimates = self._views.estimates().values()
        self.nodes.estimates(ellipsoids([each.estimate for each in estimates if each.fresh]))
        if self.shapes:
            self.nodes.shapes(list(self.shapes.values()), list(self.shapes).index(chosen))
        self._draw_ghosts()
        self._camera_follow.follow(self._camera_targets(drones))
        return drones

    def preview(self, cluster: str, shown: FlightPreview | None) -> None:
        """Show what a formation would fly, in place of what was shown before; None for nothing."""
        self.previews = {**self.previews, cluster: shown.paths_W} if shown else {
            name: paths_W for name, paths_W in self.previews.items() if name != cluster
        }  # fmt: skip
        self.nodes.previews(list(self.previews.values()))

    def draw_trails(self) -> None:
        """Draw trails and wind, which change slowly."""
        if self.drones is not None:
            segments, owners, _ = self.trails.segments(self.drones.t_ns / 1e9, self.drones.p_W)
            self.nodes.trails(segments, owners)
            self.nodes.wind(self.drones)

    def _draw_ghosts(self) -> None:
        """Move the ghosts where a formation's desired shape has changed."""
        clusters = self._views.clusters
        wanted = {name: (view.phase, view.desired) for name, view in clusters.items()}
        if wanted == self._drawn_ghosts:
            return
        self._drawn_ghosts = wanted
        poses = [ghosts(self._spaces[name], view) for name, view in clusters.items()]
        shown = [each for each in poses if each is not None]
        p_W = np.concatenate([p for p, _ in shown]) if shown else np.zeros((0, 3))
        self.nodes.ghosts(p_W, np.concatenate([q for _, q in shown]) if shown else np.zeros((0, 4)))

    def shapes_of(self, drones: DronePoses) -> dict[str, FormationShape | None]:
        """Return the formations as they truly stand, by name; None where a drone of one is missing."""
        there, yaw = drones.present, frames.heading(drones.q_WB)
        return {
            name: formation_shape(space, drones.p_W[members], yaw[members]) if there[members].all() else None
            for name, space in self._spaces.items()
            for members in [self._members[name]]
        }

    def _camera_targets(self, drones: DronePoses) -> Array:
        """Return the positions (n, 3) that cameras follow: of the formation, or of all drones."""
        members = next(iter(self._members.values())) if len(self._members) == 1 else slice(None)
        return drones.p_W[members][drones.present[members]]
