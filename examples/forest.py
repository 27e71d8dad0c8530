"""Five decentralised drones cross an unmapped forest, each pilot using its lidar, its estimate and what others send.

zsim run examples/forest.yaml
zsim run examples/forest.yaml --seed 2
python examples/forest.py

Each pilot flies in the direction of minimum cost: far from obstacles, near the direction of the goal, and near the
current course (after Borenstein and Koren, The vector field histogram, IEEE Trans. Robotics and Automation 7(3), 1991).
A direction is free up to the first lidar return in a corridor as wide as the drone plus margins. The speed allows a
stop within the free distance; the drone retreats from obstacles that are too near, and from nearby drones that it
hears. Obstacles are kept in the drone's own heading frame, so that errors of the estimate do not move them.
"""

import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

import zsim

SILENT_NS = 500_000_000  # drones not heard for this long are ignored
DIRECTIONS = np.arange(72) * (2.0 * math.pi / 72)
UNIT = np.stack([np.cos(DIRECTIONS), np.sin(DIRECTIONS)], axis=1)
HEED_M = 5.0  # drones that are farther away are ignored
DOUBT_M = 0.7  # other drones are assumed to be this much nearer, as estimates err
FLOOR_M = 0.7  # returns from farther below the drone are taken for the ground


class Where(zsim.AgentMessage, frozen=True):
    """A drone's estimate of its position, in W."""

    key = "forest/{drone}/where"

    position_m: tuple[float, float, float]


class Pilot(zsim.Agent):
    """Flies one drone east, past everything that its lidar sees."""

    class Parameters(zsim.Parameters):
        east_m: Annotated[float, Meta(ge=-1000, le=1000)] = 30.0  # x in W at which the drone stops
        height_m: Annotated[float, Meta(gt=0.5, le=50)] = 2.0
        speed_m_s: Annotated[float, Meta(gt=0, le=5)] = 1.5
        brake_m_s2: Annotated[float, Meta(gt=0, le=5)] = 0.8
        margin_m: Annotated[float, Meta(gt=0, le=5)] = 0.75  # half the width of a free corridor; the hull needs 0.26 m
        apart_m: Annotated[float, Meta(gt=0, le=20)] = 2.0  # distance below which two drones avoid each other
        takeoff_s: Annotated[float, Meta(ge=0)] = 1.0

    messages = (Where,)
    reads = ("drone/{drone}/sensor/status", "drone/{drone}/sensor/lidar", "drone/{drone}/estimate", Where.of())
    parameters: Parameters

    def __init__(self, drone: str) -> None:
        super().__init__()
        self._drone = drone
        self._heard: dict[str, tuple[int, Any]] = {}
        self._state, self._p_W, self._q_WB, self._yaw = "landed", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.0
        self._seen = np.empty((0, 2))  # returns of the last scan: distances ahead and to the left [m]
        self._course = 0.0  # direction of the last command, in the heading frame [rad]

    def receive(self, key: str, message: Any) -> None:
        kind, drone, what = key.split("/", 2)
        if kind == "forest":
            if drone != self._drone:
                self._heard[drone] = message.t_ns, message.position_m
        elif what == "estimate":
            self._p_W, self._q_WB, self._yaw = message.position_m, message.orientation_wxyz, message.yaw_rad
        elif what == "sensor/lidar":
            self._seen = self._levelled(message)
        else:
            self._state = message.state

    def step(self, t_ns: int) -> list[zsim.Output]:
        own = self.parameters
        outputs = [self.message(t_ns, Where(position_m=self._p_W))]
        if self._state == "landed" and t_ns == round(own.takeoff_s * 1e9):
            outputs.append(self.command(t_ns, self._drone, zsim.takeoff()))
        elif self._state in ("hovering", "flying"):
            v = self._velocity(t_ns)
            climb = min(max(own.height_m - self._p_W[2], -0.5), 0.5)
            outputs.append(self.command(t_ns, self._drone, zsim.velocity(float(v[0]), float(v[1]), climb)))
        return outputs

    def _levelled(self, scan: Any) -> np.ndarray:
        """Return a scan's hits (n, 2) in the heading frame, ahead and to the left [m], without those on the ground."""
        hits = np.isfinite(scan.ranges())
        points_B = scan.ranges()[hits][:, None] * scan.directions()[hits]
        w, x, y, z = self._q_WB
        ahead = points_B @ (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y))
        left = points_B @ (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x))
        up = points_B @ (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
        c, s = math.cos(self._yaw), math.sin(self._yaw)
        return np.stack([c * ahead + s * left, c * left - s * ahead], axis=1)[up > -FLOOR_M]

    def _velocity(self, t_ns: int) -> np.ndarray:
        """Return the commanded velocity (2,) in the heading frame, ahead and to the left [m/s]."""
        own, c, s = self.parameters, math.cos(self._yaw), math.sin(self._yaw)
        to_go = own.east_m - self._p_W[0]
        others_W = self._others(t_ns)
        way, seen = np.array([to_go, 0.0]), self._seen
        for off, away in others_W:
            way -= off / away * 5.0 * max(own.apart_m - away, 0.0)
            nearer = off / away * max(away - DOUBT_M, 0.1)
            seen = np.vstack([seen, (c * nearer[0] + s * nearer[1], c * nearer[1] - s * nearer[0])])
        goal = math.atan2(c * way[1] - s * way[0], c * way[0] + s * way[1])
        along, across = seen @ UNIT.T, np.abs(seen @ np.stack([-UNIT[:, 1], UNIT[:, 0]]))
        in_the_way = (across < own.margin_m) & (along > 0.0)
        free = np.where(in_the_way, along, math.inf).min(axis=0, initial=8.0) - own.margin_m
        cost = 1.0 * _apart(DIRECTIONS, goal) + 0.5 * _apart(DIRECTIONS, self._course) + 3.0 / np.maximum(free, 0.1)
        chosen = int(cost.argmin())
        self._course = float(DIRECTIONS[chosen])
        stop = math.sqrt(2.0 * own.brake_m_s2 * max(float(free[chosen]), 0.0))
        v = UNIT[chosen] * min(own.speed_m_s, stop, 0.5 * abs(float(np.hypot(*way))))
        distances = np.hypot(seen[:, 0], seen[:, 1])
        if len(seen) and distances.min() < own.margin_m:
            near = int(distances.argmin())
            v -= seen[near] / distances[near] * 2.0 * (own.margin_m - distances[near])
        return v

    def _others(self, t_ns: int) -> list[tuple[np.ndarray, float]]:
        """Return the offset (2,) in W [m] and the distance [m] of each nearby drone heard recently."""
        heard = [p_W for _, (at_ns, p_W) in sorted(self._heard.items()) if t_ns - at_ns <= SILENT_NS]
        ways = [np.subtract(p_W, self._p_W)[:2] for p_W in heard]
        return [(way, away) for way in ways if 0.0 < (away := float(np.hypot(*way))) < HEED_M]

    def snapshot(self) -> dict[str, Any]:
        heard = {drone: [at_ns, list(p_W)] for drone, (at_ns, p_W) in self._heard.items()}
        pose = [list(self._p_W), list(self._q_WB), self._yaw]
        return {"heard": heard, "state": self._state, "pose": pose, "seen": self._seen.tolist(), "course": self._course}

    def restore(self, state: dict[str, Any]) -> None:
        self._heard = {drone: (at_ns, p_W) for drone, (at_ns, p_W) in state["heard"].items()}
        self._state, (self._p_W, self._q_WB, self._yaw) = state["state"], state["pose"]
        self._seen, self._course = np.array(state["seen"]).reshape(-1, 2), state["course"]


def _apart(directions: np.ndarray, other: float) -> np.ndarray:
    return np.abs((directions - other + math.pi) % (2.0 * math.pi) - math.pi)


if __name__ == "__main__":
    run = zsim.run(Path(__file__).with_suffix(".yaml"), duration_s=30)
    for drone in run.drones:
        place = run.truth(drone).iloc[-1]
        print(f"{drone}: {place.position_m_x:.1f} m east")
