"""Sightings of hats without pictures: exposures between two gates, what a detector would make of them, and chance.

The errors are those of a detector on rendered pictures (tests hold them against each other): of a hat's centre and
apparent diameter in pixels, more where it is small, where it moves during the exposure and where the light is low;
misses, false alarms.
Each camera has a random stream, from which the same count of numbers is drawn for every picture.
"""

import math
from typing import NamedTuple

import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from zsim.contract.camera_messages import Seen
from zsim.contract.snapshot import State
from zsim.math.random_streams import stream
from zsim.scenario.obstacle import COLUMNS, row_of
from zsim.scenario.scenario import Drone, Scenario
from zsim.sensors.camera import Camera, Hats, SightingModel
from zsim.sensors.camera_model import camera_pose, lens_of, undistorted
from zsim_world.physics.normal_variates import place, words
from zsim_world.sensors.hats_in_view import VIEW, MountedCamera, hats_in_view, poses_between
from zsim_world.state.fleet_arrays import STATE

NOISY_LIGHT = 0.4  # of a clear day, at which a picture's noise is half again of what it is by day; measured
HIDDEN_CENTRE, HIDDEN_RANGE = 0.5, 1.2  # of diameter and range, per what hulls hide: sigmas of a detector; measured
DRAWS = 4  # normal numbers for each hat of a picture: two for its centre, one for its diameter, one for a miss
FALSE_DRAWS = 5  # uniform numbers for a false alarm: whether, where (2), how large, order


class PictureSightings(NamedTuple):
    """What was seen in one picture.

    Attributes:
        drone: whose camera.
        t_ns: when it is published.
        t_sample_ns: the middle of the exposure.
        camera: its name.
        seen: in no order that tells whose hats they are.
    """

    drone: int
    t_ns: int
    t_sample_ns: int
    camera: str
    seen: tuple[Seen, ...]


class SightingSampler:
    """Makes the sightings of a fleet, gate by gate.

    Args:
        scenario: resolved; some drone has sightings.
        hulls: radius of each drone's [m], (N,).
    """

    def __init__(self, scenario: Scenario, hulls: NDArray[np.float64]) -> None:
        env = scenario.environment
        hats = Hats() if env.hats is UNSET else env.hats
        self._watchers = [
            _Watcher(scenario.seed, i, drone, name, camera, model, hats, 1.0 if env.light is UNSET else env.light)
            for i, drone in enumerate(scenario.drones)
            if (model := drone.sensors.sightings) is not UNSET
            for name, camera in drone.sensors.cameras().items()
            if name in model.cameras
        ]
        self._hulls = hulls
        self._bare = np.array([drone.name not in hats.covered for drone in scenario.drones])
        self._balls = np.array(hats.false_m, dtype=float).reshape(-1, 3)
        self._obstacles = np.array([row_of(each) for each in env.obstacles], dtype=float).reshape(-1, COLUMNS)
        x, y, z = hats.position_m
        self._hat_B, self._diameter_m = (float(x), float(y), float(z)), hats.diameter_m
        self._later: list[PictureSightings] = []
        self._former: NDArray[np.float64] | None = None
        self._former_ns = 0

    def snapshot(self) -> State:
        """Return what is on its way, the poses of the last gate, and the random streams."""
        former = np.empty(0) if self._former is None else self._former
        later = [[s.drone, s.t_ns, s.t_sample_ns, s.camera, [_plain(each) for each in s.seen]] for s in self._later]
        watchers = [watcher.snapshot() for watcher in self._watchers]
        return {"later": later, "former": former, "former_ns": self._former_ns, "watchers": watchers}

    def restore(self, state: State) -> None:
        """Take over what `snapshot` returned."""
        self._later = [
            PictureSightings(drone, t_ns, at_ns, camera, tuple(Seen(tuple(each[:3]), *each[3:]) for each in seen))
            for drone, t_ns, at_ns, camera, seen in state["later"]
        ]
        self._former = state["former"].copy() if len(state["former"]) else None
        self._former_ns = state["former_ns"]
        for watcher, saved in zip(self._watchers, state["watchers"], strict=True):
            watcher.restore(saved)

    def due(self, state: NDArray[np.float64], now_ns: int) -> list[PictureSightings]:
        """Return what falls due by a gate, given the state of all drones there, (N, STATE.size or more)."""
        now = state[:, : STATE.size].copy()
        former, former_ns = (now, now_ns) if self._former is None else (self._former, self._former_ns)
        known: dict[int, NDArray[np.float64]] = {}  # poses by instant: cameras of the same rate look together
        for watcher in self._watchers:
            while watcher.next_ns <= now_ns:
                if watcher.next_ns not in known:
                    known[watcher.next_ns] = poses_between(former, former_ns, now, now_ns, watcher.next_ns)
                self._later.append(watcher.look(self._in_view(watcher, known[watcher.next_ns])))
        self._former, self._former_ns = now, now_ns
        due = [sighting for sighting in self._later if sighting.t_ns <= now_ns]
        if due:
            self._later = [sighting for sighting in self._later if sighting.t_ns > now_ns]
        return due

    def _in_view(self, watcher: "_Watcher", poses: NDArray[np.float64]) -> NDArray[np.float64]:
        view = np.zeros((len(poses) + len(self._balls), VIEW.size))
        fixed = (self._hulls, self._hat_B, self._diameter_m, self._balls, self._bare, self._obstacles)
        hats_in_view(watcher.camera, watcher.drone, poses, *fixed, view)
        return view


class _Watcher:
    """One camera of one drone, and the detector behind it.

    Attributes:
        drone: its number.
        camera: as mounted.
        next_ns: instant of the next picture.
    """

    next_ns: int

    def __init__(
        self,
        seed: int,
        drone: int,
        spec: Drone,
        name: str,
        camera: Camera,
        model: SightingModel,
        hats: Hats,
        light: float,
    ) -> None:
        pose = camera_pose(camera)
        self.drone, self._name, self._model = drone, name, model
        self._radius_m = 0.5 * hats.diameter_m
        self._rng = stream(seed, f"{spec.name}/sightings/{name}")
        p, q = pose.p_BK.tolist(), pose.q_BK
        self.camera = MountedCamera(lens_of(camera), (p[0], p[1], p[2]), (q[0], q[1], q[2], q[3]))
        R_BK = pose.R_BK @ _turned(math.radians(model.misalignment_deg) * self._rng.standard_normal(3))
        self._R_BK: list[list[float]] = R_BK.tolist()
        self._misaligned_rad = math.radians(model.misalignment_deg)
        self._rate_hz, self._count = camera.rate_hz, 0
        self._latency_ns = round((camera.latency_ms + model.latency_ms) * 1e6)
        self._exposure_s = camera.exposure_ms * 1e-3
        self._noise_px2 = model.noise_px2 * math.hypot(1.0, NOISY_LIGHT / light) / math.hypot(1.0, NOISY_LIGHT)
        self._set_next()

    def _set_next(self) -> None:
        self.next_ns = round(self._count * 1e9 / self._rate_hz)

    def snapshot(self) -> State:
        return {"count": self._count, "stream": words(self._rng)}

    def restore(self, state: State) -> None:
        self._count = state["count"]
        self._set_next()
        place(self._rng, state["stream"])

    def look(self, view: NDArray[np.float64]) -> PictureSightings:
        """Return what the detector makes of what is in view."""
        at_ns, model = self.next_ns, self._model
        self._count += 1
        self._set_next()
        normal = self._rng.standard_normal((len(view), DRAWS))
        seen = [
            self._seen(row, noise)
            for row, noise in zip(view.tolist(), normal.tolist(), strict=True)
            if row[VIEW.seen] and not self._is_missed(row, noise)
        ]
        if model.false_hz:
            seen += self._false(self._rng.random(FALSE_DRAWS).tolist())
        if len(seen) > 1:
            seen.sort(key=_azimuth)
        return PictureSightings(self.drone, at_ns + self._latency_ns, at_ns, self._name, tuple(seen))

    def _is_missed(self, row: list[float], noise: list[float]) -> bool:
        """Tell whether a hat is missed by chance, or measured as too small."""
        model, (_, diameter_px) = self._model, self._sigmas_px(row)
        measured_px = math.sqrt(row[VIEW.share]) * row[VIEW.angle] * row[VIEW.scale] + diameter_px * noise[2]
        return measured_px < model.diameter_min_px or 0.5 * math.erfc(noise[3] / math.sqrt(2.0)) < model.miss

    def _sigmas_px(self, row: list[float]) -> tuple[float, float]:
        """Return the standard deviations of a hat's centre and apparent diameter."""
        model, scale = self._model, row[VIEW.scale]
        blur = model.blur_share * row[VIEW.rate] * self._exposure_s * scale
        of_noise = self._noise_px2 / (row[VIEW.angle] * scale)
        return math.hypot(model.centre_px, of_noise, blur), math.hypot(model.diameter_px, of_noise, blur)

    def _seen(self, row: list[float], noise: list[float]) -> Seen:
        centre_px, diameter_px = self._sigmas_px(row)
        scale, angle = row[VIEW.scale], row[VIEW.angle]
        x, y, z = (row[VIEW.direction_K + k] + row[VIEW.shift_K + k] for k in range(3))
        left = math.sqrt(row[VIEW.share])
        across = math.hypot(x, z)
        e1, e2 = (z / across, 0.0, -x / across), (-x * y / across, across, -y * z / across)
        a, b = centre_px / scale * noise[0], centre_px / scale * noise[1]
        measured = max(left * angle + diameter_px / scale * noise[2], 0.1 * angle)
        range_m = self._radius_m / math.sin(0.5 * measured)
        direction = self._in_body(x + a * e1[0] + b * e2[0], y + a * e1[1] + b * e2[1], z + a * e1[2] + b * e2[2])
        sigma = math.hypot(centre_px / scale, self._misaligned_rad, HIDDEN_CENTRE * (1.0 - left) * angle)
        sigma_m = range_m * math.hypot(diameter_px / (scale * measured), HIDDEN_RANGE * (1.0 - left))
        return Seen(direction, range_m, sigma, sigma_m)

    def _in_body(self, x: float, y: float, z: float) -> tuple[float, float, float]:
        """Return the unit vector in B along (x, y, z) in K."""
        r, s, t = self._R_BK
        length = math.sqrt(x * x + y * y + z * z)
        x, y, z = x / length, y / length, z / length
        return (
            r[0] * x + r[1] * y + r[2] * z,
            s[0] * x + s[1] * y + s[2] * z,
            t[0] * x + t[1] * y + t[2] * z,
        )

    def _false(self, uniform: list[float]) -> list[Seen]:
        """Return a false alarm, if there is one in this picture: a small blob anywhere."""
        if uniform[0] >= self._model.false_hz / self._rate_hz:
            return []
        lens, model = self.camera.lens, self._model
        x, y = undistorted(lens, uniform[1] * lens.width - 0.5, uniform[2] * lens.height - 0.5)
        size_px = model.diameter_min_px * (1.0 + 2.0 * uniform[3])
        angle = size_px / lens.fx
        sigma = math.hypot(model.centre_px / lens.fx, self._misaligned_rad)
        range_m = self._radius_m / math.sin(0.5 * angle)
        return [Seen(self._in_body(x, y, 1.0), range_m, sigma, range_m * model.diameter_px / size_px)]


def _azimuth(seen: Seen) -> float:
    return -math.atan2(seen.direction_B[1], seen.direction_B[0])


def _plain(seen: Seen) -> list[float]:
    return [*seen.direction_B, seen.range_m, seen.sigma_direction_rad, seen.sigma_range_m]


def _turned(r: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix of a small turn [rad], to second order."""
    x, y, z = r.tolist()
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    U, _, Vt = np.linalg.svd(np.eye(3) + K)
    return U @ Vt
