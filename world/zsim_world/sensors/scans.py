"""Distances measured by range beams, lidars and depth cameras: rays cast from true poses, with errors. Compiled.

All rays of a message are cast at one instant, possibly between two gates. They hit the ground, obstacles, surfaces and
the hulls of other drones (zsim_world.physics.rays). Each sensor has its own random stream, from which every message
draws the same number of values: two for each distance and one for the message.
"""

import math
from collections.abc import Iterator
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.contract.messages import Depth, Lidar, Range
from zsim.contract.snapshot import IN_PLACE, PART, Saved
from zsim.math import elementary as el
from zsim.math.compiled import Field, columns, inlined, kernel
from zsim.math.frames import quaternion_from_rpy, rotation_matrix
from zsim.math.held import Held, hold
from zsim.math.randomness import normal_quantile, stream
from zsim.math.rotation import add, dot, matrix, product, subtract
from zsim.scenario.scenario import Scenario
from zsim.sensors.camera import Camera
from zsim.sensors.camera_model import camera_pose, lens_of, undistorted
from zsim.sensors.scanner import SINGLE, DepthConfig, LidarConfig, RangeConfig, Scanner, along, scanners
from zsim.sensors.sensor import Mount, Sample
from zsim_world.physics.fleet_arrays import STATE, four, vector
from zsim_world.physics.rays import Scene, cast, cast_hull
from zsim_world.sensors.noise import WORDS, fill, words
from zsim_world.sensors.sampler import Between, Exposures, poses_between, released
from zsim_world.sensors.sensor_set import rounded

CONE_RAYS = 8  # rays on the cone of a beam that has one, in addition to the ray along its axis
SHARE_MIN = 0.2  # lower bound of a ray's depth over its length, which is 0.26 at the edge of a 150 deg picture
MOUNT_MAX_M = 2.0  # m, design choice: generous bound on a sensor's distance from its drone's centre, to skip far drones
# share: fraction of a ray's length that is measured; below 1 for a depth, which is along the optical axis
RAY = columns("RayColumns", (Field("direction_B", "1", 3), Field("share", "1")))
SCANNER = columns(
    "ScannerColumns",
    (
        Field("drone", "1"),
        Field("origin", "1"),  # index of the first origin of its rays
        Field("apart", "1"),  # 1: each value has its own origin; 0: all share one
        Field("first", "1"),  # index of its first ray
        Field("values", "1"),
        Field("rays", "1"),  # rays per value; the value is their smallest distance
        Field("min", "m"),
        Field("max", "m"),
        Field("noise", "m"),  # standard deviation at distance d: root of noise^2 + (share d)^2 + (square d^2)^2
        Field("share", "1"),
        Field("square", "1/m"),
        Field("bias", "m"),  # constant during a run
        Field("quantum", "m"),
        Field("miss", "1"),  # a value is missed when its standard normal variate is below this
        Field("drop", "1"),  # likewise, a message is lost
        Field("stuck", "1"),  # 1: a fault makes it repeat its first message since the fault began
    ),
)

Array = NDArray[np.float64]


class Scan(NamedTuple):
    """A message of a scanner, without its sequence number."""

    t_ns: int
    drone: int
    t_sample_ns: int
    kind: type[Sample]
    sensor: str
    camera: str  # camera of a depth image, otherwise empty
    values: bytes  # float32
    fixed: dict[str, Any]  # fields that are the same in every message

    def message(self, seq: int) -> Any:
        values: Any = self.values
        name = "depth_m" if self.kind is Depth else "ranges_m"
        if self.kind is Range:
            values = tuple(np.frombuffer(values, SINGLE).tolist())
        return self.kind(self.t_ns, seq, t_sample_ns=self.t_sample_ns, **self.fixed, **{name: values})


class WaitingScan(NamedTuple):
    """A scan that is not due yet."""

    t_ns: int
    t_sample_ns: int
    place: int  # index of its sensor
    values: bytes


class Mounted(NamedTuple):
    """A sensor of a drone, and its rays in B, grouped by value."""

    drone: int
    sensor: str
    kind: type[Sample]
    camera: str
    settings: Scanner
    origins: Array  # m in B, one for all values or one for each, (1 or values, 3)
    rays: Array  # k for each value, (values * k, RAY.size)
    values: int
    fixed: dict[str, Any]


class ScanScene(NamedTuple):
    """W sensors on N drones, and the objects around them, for compiled code."""

    scene: Scene
    hulls: NDArray[np.float64]  # (N,), hull radii [m]
    scanners: NDArray[np.float64]  # (W, SCANNER.size)
    origins: NDArray[np.float64]  # origins of all sensors, (O, 3) [m; B]
    rays: NDArray[np.float64]  # rays of all sensors, (R, RAY.size)


class ScanSampler:
    """Computes the scans of a fleet gate by gate; `hulls`: hull radius of each drone [m], (N,)."""

    SAVED: ClassVar[Saved] = {
        "_rows": IN_PLACE,
        "_streams": IN_PLACE,
        "_exposures": PART,
        "_later": list[WaitingScan],
        "_stuck": dict[int, bytes],
    }

    def __init__(self, scenario: Scenario, hulls: Array, scene: Scene) -> None:
        self._mounted = [*_mounted(scenario)]
        stream_names = [
            "/".join(filter(None, (scenario.drones[m.drone].name, m.sensor, m.camera))) for m in self._mounted
        ]
        generators = [stream(scenario.seed, name) for name in stream_names]
        rows, first, origin = np.zeros((len(stream_names), SCANNER.size)), 0, 0
        for row, each, rng in zip(rows, self._mounted, generators, strict=True):
            _fill_row(row, each, first, origin, rng)
            first, origin = first + len(each.rays), origin + len(each.origins)
        self._streams = np.array([words(rng) for rng in generators], dtype=np.uint64).reshape(-1, WORDS.size)
        origins, rays = (np.concatenate([getattr(m, part) for m in self._mounted]) for part in ("origins", "rays"))
        self._rows, self._sound = rows, rows.copy()
        self._held = hold(ScanScene(scene, hulls, rows, origins, rays))
        gate_ns = round(scenario.time.gate_ms * 1e6)
        self._exposures = Exposures([each.settings.rate_hz for each in self._mounted], gate_ns)
        self._later: list[WaitingScan] = []
        self._stuck: dict[int, bytes] = {}  # the message that each stuck sensor repeats, by index of the sensor

    def recover(self) -> None:
        """Remove the effects of faults from all sensors."""
        self._rows[:] = self._sound

    def rows_of(self, drone: int, sensor: str) -> Iterator[Array]:
        """Yield the rows of a drone's sensor, (SCANNER.size,), one for each depth camera, for faults to modify."""
        for row, each in zip(self._rows, self._mounted, strict=True):
            if (each.drone, each.sensor) == (drone, sensor):
                yield row

    def due(self, state: Array, now_ns: int) -> list[Scan]:
        """Return the scans due by a gate, given the states of all drones at it, (N, STATE.size or more)."""
        samples, between = self._exposures.until(state, now_ns)
        for at_ns, index in samples:
            self._scan(at_ns, index, between)
        return [self._message_of(each) for each in released(self._later, now_ns)]

    def _scan(self, at_ns: int, index: int, between: Between | None) -> None:
        """Take a sample and hold it until it is due."""
        assert between is not None  # as always when samples are due
        poses = poses_between(*between, at_ns)
        values = scan(self._held, index, poses, self._streams[index])
        if len(values):
            sent = values.astype(SINGLE).tobytes()
            if self._rows[index, SCANNER.stuck]:
                sent = self._stuck.setdefault(index, sent)
            else:
                self._stuck.pop(index, None)
            latency_ns = round(self._mounted[index].settings.latency_ms * 1e6)
            self._later.append(WaitingScan(at_ns + latency_ns, at_ns, index, sent))

    def _message_of(self, waiting: WaitingScan) -> Scan:
        m = self._mounted[waiting.place]
        return Scan(waiting.t_ns, m.drone, waiting.t_sample_ns, m.kind, m.sensor, m.camera, waiting.values, m.fixed)


def _mounted(scenario: Scenario) -> Iterator[Mounted]:
    """Yield every scanner of a simulated drone, a depth sensor once for each of its cameras."""
    for i, drone in enumerate(scenario.drones):
        if drone.is_external:
            continue
        for name, settings in scanners(drone.sensors).items():
            p_BS, R_BS = _pose(settings.mount)
            if isinstance(settings, RangeConfig):
                yield _beams(i, name, settings, p_BS, R_BS)
            elif isinstance(settings, LidarConfig):
                yield _lidar(i, name, settings, p_BS, R_BS)
            elif isinstance(settings, DepthConfig):
                for camera in settings.cameras:
                    yield _depth(i, name, settings, camera, drone.sensors.cameras()[camera])


def _pose(mount: Mount) -> tuple[Array, Array]:
    return np.array(mount.position_m, dtype=float), rotation_matrix(quaternion_from_rpy(np.radians(mount.rpy_deg)))


def _turned(R: Array, vectors: Array) -> Array:
    """Return R v for each row v of `vectors`, (M, 3), summed in a fixed order."""
    return (R * vectors[:, None, :]).sum(axis=2)


def _rays(directions_B: Array, share: Array | float = 1.0) -> Array:
    rays = np.ones((len(directions_B), RAY.size))
    rays[:, :3], rays[:, 3] = directions_B, share
    return rays


def _beams(i: int, name: str, settings: RangeConfig, p_BS: Array, R_BS: Array) -> Mounted:
    half, step = math.radians(0.5 * settings.cone_deg), 2.0 * math.pi / CONE_RAYS
    rim = [(el.cos(half), el.sin(half) * el.cos(k * step), el.sin(half) * el.sin(k * step)) for k in range(CONE_RAYS)]
    cone = np.array([(1.0, 0.0, 0.0), *(rim if half else ())])
    names = sorted(settings.beams)  # as in the resolved scenario
    poses = [_pose(settings.beams[beam]) for beam in names]
    origins = np.array([p_BS + _turned(R_BS, p[None])[0] for p, _ in poses])
    rays = _rays(np.concatenate([_turned(R_BS, _turned(R, cone)) for _, R in poses]))
    fixed = {"beams": tuple(names), "max_m": settings.max_m}
    return Mounted(i, name, Range, "", settings, origins, rays, len(poses), fixed)


def _lidar(i: int, name: str, settings: LidarConfig, p_BS: Array, R_BS: Array) -> Mounted:
    channels, count = settings.channels, settings.columns
    (low, high), (first, last) = np.radians(settings.elevation_deg).tolist(), np.radians(settings.azimuth_deg).tolist()
    elevation = (low, (high - low) / (channels - 1) if channels > 1 else 0.0)
    azimuth = (first, (last - first) / count)
    fixed = {"channels": channels, "columns": count, "elevation_rad": elevation, "azimuth_rad": azimuth}
    up = elevation[0] + elevation[1] * np.arange(channels)[:, None]
    directions = along(up, azimuth[0] + azimuth[1] * np.arange(count)[None, :]).reshape(-1, 3)
    fixed["max_m"] = settings.max_m
    return Mounted(i, name, Lidar, "", settings, p_BS[None], _rays(_turned(R_BS, directions)), channels * count, fixed)


def _depth(i: int, name: str, settings: DepthConfig, camera: str, optics: Camera) -> Mounted:
    """Return a depth camera with a ray through the centre of each depth pixel, which is a block of camera pixels."""
    pose, lens, rows, count = camera_pose(optics), lens_of(optics), settings.rows, settings.columns
    width, height = lens.width / count, lens.height / rows  # size of a depth pixel in camera pixels
    grids: Any = np.meshgrid((np.arange(count) + 0.5) * width - 0.5, (np.arange(rows) + 0.5) * height - 0.5)
    x, y = undistorted(lens, *(grid.ravel() for grid in grids))
    length = np.sqrt(x * x + y * y + 1.0)
    directions = np.stack([x, y, np.ones_like(x)], axis=1) / length[:, None]
    fixed = {"camera": camera, "columns": count, "rows": rows, "max_m": settings.max_m}
    fixed["focal_px"] = (lens.fx / width, lens.fy / height)
    fixed["centre_px"] = ((lens.cx + 0.5) / width - 0.5, (lens.cy + 0.5) / height - 0.5)
    rays = _rays(_turned(pose.R_BK, directions), 1.0 / length)
    return Mounted(i, name, Depth, camera, settings, pose.p_BK[None], rays, rows * count, fixed)


def _fill_row(row: Array, mounted: Mounted, first: int, origin: int, rng: np.random.Generator) -> None:
    """Fill the row of a sensor; its bias is the first draw from its random stream."""
    own, values = mounted.settings, mounted.values
    row[SCANNER.drone], row[SCANNER.first], row[SCANNER.origin] = mounted.drone, first, origin
    row[SCANNER.apart], row[SCANNER.values] = len(mounted.origins) > 1, values
    row[SCANNER.rays] = len(mounted.rays) // values
    row[SCANNER.min], row[SCANNER.max], row[SCANNER.quantum] = own.min_m, own.max_m, own.quantum_m
    row[SCANNER.noise], row[SCANNER.share], row[SCANNER.square] = own.noise_m, own.noise_share, own.noise_1_m
    row[SCANNER.bias] = own.bias_m * rng.standard_normal()
    row[SCANNER.miss], row[SCANNER.drop] = normal_quantile(own.miss), normal_quantile(own.dropout)


@kernel()
def scan(held: Held, index: int, poses: NDArray, stream: NDArray) -> NDArray:
    """Return the values [m] of one sensor's message, 0 where there is no echo; empty if the message is lost.

    Args:
        held: the ScanScene, wrapped by `hold`.
        index: index of the sensor.
        poses: states of all drones, (N, STATE.size or more).
        stream: words of the sensor's random stream, (WORDS.size,), advanced in place.
    """
    scene, hulls, scanners, origins, rays = held.content
    row = scanners[index]
    i, values, each = int(row[SCANNER.drone]), int(row[SCANNER.values]), int(row[SCANNER.rays])
    drawn = np.empty(2 * values + 1)
    fill(drawn, stream)
    if drawn[2 * values] < row[SCANNER.drop]:
        return np.empty(0)
    p_WB, q_WB = vector(poses[i], STATE.p_WB), four(poses[i], STATE.q_WB)
    R_WB, max_range, out = matrix(q_WB), row[SCANNER.max], np.empty(values)
    near_drones, count = np.empty(len(hulls), np.int64), 0
    for j in range(len(hulls)):
        away = subtract(vector(poses[j], STATE.p_WB), p_WB)
        max_distance = max_range / SHARE_MIN + hulls[j] + MOUNT_MAX_M
        if j != i and dot(away, away) < max_distance * max_distance:
            near_drones[count] = j
            count += 1
    at, ray = int(row[SCANNER.origin]), int(row[SCANNER.first])
    o = add(p_WB, product(R_WB, vector(origins[at], 0)))
    for v in range(values):
        if row[SCANNER.apart] != 0.0:
            o = add(p_WB, product(R_WB, vector(origins[at + v], 0)))
        nearest = math.inf
        for _ in range(each):
            d, share = product(R_WB, vector(rays[ray], RAY.direction_B)), rays[ray, RAY.share]
            ray_end = max_range / share
            hit = cast(scene, o, d, ray_end)
            for k in range(count):
                j = near_drones[k]
                hit = cast_hull(vector(poses[j], STATE.p_WB), four(poses[j], STATE.q_WB), hulls[j], o, d, hit)
            if hit < ray_end:
                nearest = min(nearest, hit * share)
            ray += 1
        out[v] = _measured(row, nearest, drawn[2 * v], drawn[2 * v + 1])
    return out


@inlined
def _measured(row: NDArray, distance: float, noise: float, chance: float) -> float:
    """Return the value measured at a true distance, 0 without an echo; `noise` and `chance` are standard normal."""
    if distance == math.inf or chance < row[SCANNER.miss]:
        return 0.0
    share, square = row[SCANNER.share] * distance, row[SCANNER.square] * distance * distance
    sigma = math.sqrt(row[SCANNER.noise] * row[SCANNER.noise] + share * share + square * square)
    measured = rounded(distance, row[SCANNER.bias], sigma * noise, row[SCANNER.quantum])
    return measured if row[SCANNER.min] <= measured <= row[SCANNER.max] else 0.0
