"""Sightings of hats without rendering: what a camera has in view, from true poses, with a detector's errors.

A hat, the marker by which drones detect each other, is modelled as a ball. It is in view if it is entirely within the
picture and enough of its edge is visible for a detector to fit a circle. It can be hidden by obstacles, surfaces, hulls
(flat bodies of revolution about their drones' z axes) and, from below, by the rotors of the drone that wears it.

Each camera has its own random stream; all pictures due in a gate are computed in one compiled call. The errors match
those of the detector on rendered pictures (tests compare them): noise of a hat's centre and apparent diameter in
pixels, larger for small hats, for motion during the exposure and in low light; misses; false alarms. Every picture of a
camera draws the same number of random numbers.
"""

import math
from collections.abc import Iterator
from typing import ClassVar, NamedTuple

import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from zsim.contract.flight_messages import Seen, Sightings
from zsim.contract.keys import SIGHTINGS
from zsim.contract.snapshot import IN_PLACE, PART, Saved
from zsim.math import elementary as el
from zsim.math import linear
from zsim.math import rotation as rot
from zsim.math.compiled import Field, columns, compiled, inlined, kernel
from zsim.math.held import Held, hold
from zsim.math.randomness import normal_probability, stream
from zsim.math.rotation import (
    Quaternion,
    Vector,
    add,
    axpy,
    cross,
    dot,
    norm,
    rotate,
    rotate_back,
    scaled,
    subtract,
)
from zsim.scenario.scenario import Scenario
from zsim.sensors.camera import Camera, Hats, SightingModel
from zsim.sensors.camera_model import Lens, camera_pose, lens_of, pixel, spread, undistorted
from zsim_world.physics.fleet_arrays import STATE, four, vector
from zsim_world.physics.rays import HULL_FLATNESS, Scene, cast_parts
from zsim_world.sensors.noise import WORDS, fill, words
from zsim_world.sensors.sampler import Between, Exposures, poses_between, released

VIEW = columns(  # a camera's view of a hat
    "ViewColumns",
    (
        Field("seen", "1"),  # 0 or 1
        Field("direction_K", "1", 3),  # unit vector to the hat's centre
        Field("share", "1"),  # visible share of its edge
        Field("centre", "1"),  # error of the centre of a circle fitted to the visible edge over that for the whole edge
        Field("radius", "1"),  # likewise for the circle's radius
        Field("range", "m"),
        Field("angle", "rad"),  # apparent diameter of the hat
        Field("scale", "px/rad"),  # scale of the picture at the hat
        Field("rate", "rad/s"),  # angular rate at which the hat moves across the picture
    ),
)
CAMERA = columns(  # a camera as mounted on a drone
    "CameraColumns", (Field("lens", "1, px", 11), Field("p_BK", "m", 3), Field("q_BK", "1", 4))
)
AHEAD_MIN = 0.05  # cosine of the angle to the optical axis; rays farther off the axis miss even a 150 deg picture
RIM_WIDE, RIM_HIGH = 1.15, 0.14  # radius and height of the rotors' disc, in hull radii; fitted to rendered pictures
POINTS = 32  # number of points of a hat's edge that are checked for visibility
COSINES, SINES = (np.array([f(2.0 * math.pi * k / POINTS) for k in range(POINTS)]) for f in (el.cos, el.sin))
LEVEL_COSINE = 0.9  # cosine of the angle to the vertical; steeper rays need another basis
SHARE_MIN = 0.3  # visible share of the edge below which a detector does not recognise the circle
EDGE_PX = 3.0  # px, blur of a hat's edge: a hat closer than this to the picture's edge counts as cut off
NOISY_LIGHT = 0.4  # light, relative to a clear day, at which noise is sqrt(2) times that in unlimited light; measured
DETECTOR = columns(  # detector of one camera, and the hats that it detects
    "DetectorColumns",
    (
        Field("R_BK", "1", 9),  # including the misalignment, which is unknown to the drone
        Field("misaligned", "rad"),  # standard deviation of the misalignment
        Field("radius", "m"),  # radius of a hat
        Field("exposure", "s"),
        Field("centre", "px"),  # standard deviations, as in SightingModel
        Field("diameter", "px"),
        Field("noise", "px^2"),  # at the light of the scenario
        Field("blur_share", "1"),
        Field("diameter_min", "px"),
        Field("miss", "1"),
        Field("false", "1"),  # false alarms per picture
    ),
)
SEEN = columns(  # a sighting
    "SeenColumns",
    (
        Field("picture", "1"),  # index among the pictures of a call
        Field("direction_B", "1", 3),
        Field("range", "m"),
        Field("sigma_direction", "rad"),
        Field("sigma_range", "m"),
    ),
)
DRAWS = 4  # normal variates per hat and picture: two for the centre, one for the diameter, one for a miss
FALSE_DRAWS = 4  # normal variates per false alarm: one for its occurrence, two for its position, one for its size
# Error of a measured diameter over that of a centre, due to noise and due to blur; measured
DIAMETER_NOISE, DIAMETER_BLUR = 1.4, 2.8
ANGLE_MAX = 3.0  # rad, largest apparent diameter; pi is that of a ball touching the lens
DIAMETER_RATIO_MIN = 0.1  # lower bound of a measured diameter over the true apparent one


Array = NDArray[np.float64]


class PictureSightings(NamedTuple):
    """The sightings in one picture."""

    t_ns: int  # time of publication
    drone: int
    t_sample_ns: int  # the middle of the exposure
    camera: str
    seen: tuple[Seen, ...]  # in an order that does not reveal whose hats they are

    @property
    def sensor(self) -> str:
        return SIGHTINGS

    def message(self, seq: int) -> Sightings:
        return Sightings(self.t_ns, seq, t_sample_ns=self.t_sample_ns, camera=self.camera, seen=self.seen)


class Surroundings(NamedTuple):
    """W cameras with detectors on N drones, and the objects around them, for compiled code."""

    drones: NDArray[np.int64]  # (W,), drone of each camera
    cameras: Array  # (W, CAMERA.size)
    detectors: Array  # (W, DETECTOR.size)
    hulls: Array  # (N,), radii [m]
    hat_B: Vector  # centre of a hat [m]
    diameter: float  # of a hat [m]
    balls: Array  # (M, 3), centres of objects that only look like hats [m; W]
    bare: NDArray[np.bool_]  # (N,), whether a drone's hat is uncovered
    scene: Scene  # obstacles and surfaces


class _Pictures(NamedTuple):
    """The camera of a detector, and the delay from an exposure to the publication of its sightings."""

    drone: int
    name: str
    latency_ns: int


class SightingSampler:
    """Computes the sightings of a fleet gate by gate; `hulls`: hull radius of each drone [m], (N,)."""

    SAVED: ClassVar[Saved] = {
        "_streams": IN_PLACE,
        "_exposures": PART,
        "_later": list[PictureSightings],
    }

    def __init__(self, scenario: Scenario, hulls: Array, scene: Scene) -> None:
        env = scenario.environment
        hats = Hats() if env.hats is UNSET else env.hats
        light = 1.0 if env.light is UNSET else env.light
        watching = list(_watching(scenario))
        self._pictures = [
            _Pictures(i, name, round((camera.latency_ms + model.latency_ms) * 1e6))
            for i, name, camera, model in watching
        ]
        gate_ns = round(scenario.time.gate_ms * 1e6)
        self._exposures = Exposures([camera.rate_hz for *_, camera, _ in watching], gate_ns)
        generators = [stream(scenario.seed, f"{scenario.drones[i].name}/sightings/{name}") for i, name, *_ in watching]
        detectors = [
            _detector(camera, model, hats, light, rng)
            for (_, _, camera, model), rng in zip(watching, generators, strict=True)
        ]
        x, y, z = hats.position_m
        surroundings = Surroundings(
            np.array([i for i, *_ in watching], dtype=np.int64),
            np.array([camera_row(camera) for *_, camera, _ in watching]).reshape(-1, CAMERA.size),
            np.array(detectors).reshape(-1, DETECTOR.size),
            hulls,
            (float(x), float(y), float(z)),
            hats.diameter_m,
            np.array(hats.false_m, dtype=float).reshape(-1, 3),
            np.array([drone.name not in hats.covered for drone in scenario.drones]),
            scene,
        )
        self._held = hold(surroundings)
        self._streams = np.array([words(rng) for rng in generators], dtype=np.uint64).reshape(-1, WORDS.size)
        self._later: list[PictureSightings] = []

    def due(self, state: Array, now_ns: int) -> list[PictureSightings]:
        """Return the sightings due by a gate, given the states of all drones at it, (N, STATE.size or more)."""
        pictures, between = self._exposures.until(state, now_ns)
        if between is not None:
            self._look(pictures, between)
        return released(self._later, now_ns)

    def _look(self, pictures: list[tuple[int, int]], between: Between) -> None:
        """Compute the sightings in pictures (instant [ns], camera), and hold them until they are due."""
        indices = np.array(pictures, dtype=np.int64)
        seen: list[list[Seen]] = [[] for _ in pictures]
        for picture, x, y, z, range_m, sigma, sigma_m in look(indices, *between, self._held, self._streams).tolist():
            seen[int(picture)].append(Seen((x, y, z), range_m, sigma, sigma_m))
        for (at_ns, w), of_picture in zip(pictures, seen, strict=True):
            drone, name, latency_ns = self._pictures[w]
            self._later.append(PictureSightings(at_ns + latency_ns, drone, at_ns, name, tuple(of_picture)))


def _watching(scenario: Scenario) -> Iterator[tuple[int, str, Camera, SightingModel]]:
    """Yield every camera of a simulated drone with a detector: drone, name, camera, detector."""
    for i, drone in enumerate(scenario.drones):
        model = drone.sensors.sightings
        if model is not UNSET and not drone.is_external:
            for name, camera in drone.sensors.cameras().items():
                if name in model.cameras:
                    yield i, name, camera, model


def _detector(camera: Camera, model: SightingModel, hats: Hats, light: float, rng: np.random.Generator) -> Array:
    """Return the row of a detector; its camera's misalignment is the first draw from `rng`."""
    row = np.zeros(DETECTOR.size)
    misaligned_rad = math.radians(model.misalignment_deg)
    turn = rot.matrix(rot.from_rotation_vector(tuple((misaligned_rad * rng.standard_normal(3)).tolist())))
    R_BK = linear.product(camera_pose(camera).R_BK, turn)
    row[DETECTOR.R_BK : DETECTOR.R_BK + 9] = R_BK.ravel()
    row[DETECTOR.misaligned], row[DETECTOR.radius] = misaligned_rad, 0.5 * hats.diameter_m
    row[DETECTOR.exposure] = camera.exposure_ms * 1e-3
    row[DETECTOR.centre], row[DETECTOR.diameter] = model.centre_px, model.diameter_px
    row[DETECTOR.noise] = model.noise_px2 * el.hypot(1.0, NOISY_LIGHT / light) / el.hypot(1.0, NOISY_LIGHT)
    row[DETECTOR.blur_share], row[DETECTOR.diameter_min] = model.blur_share, model.diameter_min_px
    row[DETECTOR.miss], row[DETECTOR.false] = model.miss, model.false_hz / camera.rate_hz
    return row


@kernel()
def look(
    pictures: NDArray,
    former: NDArray,
    former_ns: int,
    now: NDArray,
    now_ns: int,
    held: Held,
    streams: NDArray,
) -> NDArray:
    """Return the sightings in pictures taken between two gates, (M, SEEN.size).

    Args:
        pictures: instant [ns] and camera of each picture, sorted by instant, (P, 2).
        former, now: states of all drones at the two gates, (N, STATE.size).
        former_ns, now_ns: times of the two gates [ns].
        held: the Surroundings, wrapped by `hold`.
        streams: words of the cameras' random streams, (W, WORDS.size); advanced in place.
    """
    own = held.content
    hats = len(now) + len(own.balls)
    view, out = np.empty((hats, VIEW.size)), np.empty((len(pictures) * (hats + 1), SEEN.size))
    poses, end = now, 0
    for n in range(len(pictures)):
        at_ns, w = pictures[n]
        if n == 0 or at_ns != pictures[n - 1, 0]:
            poses = poses_between(former, former_ns, now, now_ns, at_ns)
        camera = mounted(own.cameras[w])
        fixed = (own.hulls, own.hat_B, own.diameter, own.balls, own.bare, own.scene)
        hats_in_view(camera, int(own.drones[w]), poses, *fixed, view)
        first, end = end, detect(own.detectors[w], camera.lens, view, streams[w], out, end)
        out[first:end, SEEN.picture] = n
    return out[:end]


class MountedCamera(NamedTuple):
    """A camera: lens, and pose in its drone's body."""

    lens: Lens
    p_BK: Vector  # m
    q_BK: Quaternion


def camera_row(camera: Camera) -> NDArray:
    """Return the row of a camera, (CAMERA.size,)."""
    pose = camera_pose(camera)
    return np.array([*lens_of(camera), *pose.p_BK.tolist(), *pose.q_BK], dtype=float)


@inlined
def mounted(row: NDArray) -> MountedCamera:
    """Return the camera of a row."""
    # in the order of Lens's fields
    lens = Lens(row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7], row[8], int(row[9]), int(row[10]))
    return MountedCamera(lens, vector(row, CAMERA.p_BK), four(row, CAMERA.q_BK))


@inlined
def _hull_hides(eye: Vector, ray: Vector, far: float, p_WB: Vector, q_WB: Quaternion, radius: float) -> bool:
    """Return whether a hull, an ellipsoid scaled to a ball here, is on a ray (unit vector, W) nearer than `far` [m]."""
    o, d = rotate_back(q_WB, subtract(eye, p_WB)), rotate_back(q_WB, ray)
    stretch = 1.0 / HULL_FLATNESS
    o, d = (o[0], o[1], stretch * o[2]), (d[0], d[1], stretch * d[2])
    a, b, c = dot(d, d), dot(o, d), dot(o, o) - radius * radius
    root = b * b - a * c
    if c <= 0.0 or root <= 0.0:
        return False  # the ray misses the hull, or the eye is inside it
    at = (-b - math.sqrt(root)) / a
    return 0.0 < at < far


@inlined
def _rim_hides(eye: Vector, ray: Vector, p_WB: Vector, q_WB: Quaternion, radius: float) -> bool:
    """Return whether a ray to a drone's own hat passes upwards through the disc of its rotors."""
    o, d = rotate_back(q_WB, subtract(eye, p_WB)), rotate_back(q_WB, ray)
    rise = RIM_HIGH * radius - o[2]
    if rise <= 0.0 or d[2] <= 0.0:
        return False
    x, y = o[0] + rise / d[2] * d[0], o[1] + rise / d[2] * d[1]
    return x * x + y * y < RIM_WIDE * RIM_WIDE * radius * radius


@inlined
def _drone_hides(eye: Vector, ray: Vector, away: float, i: int, m: int, pose: NDArray, radius: float) -> bool:
    """Return whether drone `i` blocks a ray to a ball: the hat of drone `m`, or a decoy if no drone has index `m`."""
    p, q = vector(pose, STATE.p_WB), four(pose, STATE.q_WB)
    return _rim_hides(eye, ray, p, q, radius) if i == m else _hull_hides(eye, ray, away, p, q, radius)


@inlined
def _passes(eye: Vector, ray: Vector, away: float, p: Vector, radius: float) -> bool:
    """Return whether a sphere is clear of the line of sight to a point at distance `away` [m] along `ray`."""
    to = subtract(p, eye)
    along = min(max(dot(to, ray), 0.0), away)
    offset = axpy(to, -along, ray)
    return dot(offset, offset) > radius * radius


@inlined
def _scale(lens: Lens, cosine: float) -> float:
    """Return the pixels per radian off the axis: geometric mean of radial (f / cos^2) and tangential (f / cos)."""
    return lens.fx / (cosine * math.sqrt(cosine))


@inlined
def _in_picture(lens: Lens, to_K: Vector, angle: float) -> bool:
    """Return whether a ball of apparent diameter `angle` [rad] is entirely within the picture."""
    cosine = to_K[2] / norm(to_K)
    if cosine < AHEAD_MIN:
        return False
    u, v = pixel(lens, to_K[0], to_K[1], to_K[2])
    edge = 0.5 * angle * _scale(lens, cosine) + EDGE_PX - 0.5
    return edge <= u < lens.width - 1.0 - edge and edge <= v < lens.height - 1.0 - edge


@inlined
def _hidden(
    eye: Vector, ray: Vector, away: float, ball: float, own: int, m: int, poses: NDArray, hulls: NDArray, scene: Scene
) -> int:
    """Return which points of a ball's edge are hidden, one bit each."""
    e1 = (ray[1], -ray[0], 0.0) if abs(ray[2]) < LEVEL_COSINE else (0.0, ray[2], -ray[1])
    e1 = scaled(e1, 1.0 / norm(e1))
    e2 = cross(ray, e1)
    hidden, drones = 0, poses.shape[0]
    for i in range(drones + 1 if scene.tree.part.shape[0] > 0 else drones):  # the drones, then the static scene
        if i < drones and (
            i == own or _passes(eye, ray, away, vector(poses[i], STATE.p_WB), RIM_WIDE * hulls[i] + ball)
        ):
            continue
        for point in range(POINTS):
            a, b = ball / away * COSINES[point], ball / away * SINES[point]
            to = axpy(axpy(ray, a, e1), b, e2)
            to = scaled(to, 1.0 / norm(to))
            if (
                _drone_hides(eye, to, away, i, m, poses[i], hulls[i])
                if i < drones
                else cast_parts(scene, eye, to, away) < away
            ):
                hidden |= 1 << point
    return hidden


@inlined
def _write_outline(hidden: int, row: NDArray) -> None:
    """Write the visible share of a ball's edge, and how accurately the visible points determine its circle."""
    row[VIEW.share], row[VIEW.centre], row[VIEW.radius] = 1.0, 1.0, 1.0
    if hidden == 0:
        return
    wrap = POINTS - 1  # a detector ignores the points next to hidden ones
    hidden |= hidden << 1 | hidden >> 1 | hidden << wrap | hidden >> wrap
    n, x, y, xx, xy, yy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(POINTS):
        if not hidden >> k & 1:
            a, b = COSINES[k], SINES[k]
            n, x, y, xx, xy, yy = n + 1.0, x + a, y + b, xx + a * a, xy + a * b, yy + b * b
    centre, radius = spread(n, x, y, xx, xy, yy)
    row[VIEW.share] = n / POINTS
    row[VIEW.centre], row[VIEW.radius] = centre * math.sqrt(POINTS / 2), radius * math.sqrt(POINTS)


@kernel()
def hats_in_view(
    camera: MountedCamera,
    own: int,
    poses: NDArray,
    hulls: NDArray,
    hat_B: Vector,
    diameter: float,
    balls: NDArray,
    bare: NDArray,
    scene: Scene,
    view: NDArray,
) -> None:
    """Compute which hats a camera has in view, and how it sees them.

    Args:
        camera: the camera as mounted on its drone.
        own: index of its drone.
        poses: states of N drones at the instant of the picture, (N, STATE.size).
        hulls: radius of each hull [m], (N,).
        hat_B: centre of a hat in the body of its drone [m].
        diameter: diameter of a hat [m].
        balls: centres of balls that only look like hats [m; W], (M, 3).
        bare: whether the hat of each drone is uncovered, (N,).
        scene: obstacles and surfaces.
        view: filled by this function, (N + M, VIEW.size): hats of the drones, then balls.
    """
    row = poses[own]
    q_WB, w_B = four(row, STATE.q_WB), vector(row, STATE.w_WB_B)
    eye = add(vector(row, STATE.p_WB), rotate(q_WB, camera.p_BK))
    v_eye = add(vector(row, STATE.v_WB), rotate(q_WB, cross(w_B, camera.p_BK)))
    w_W = rotate(q_WB, w_B)
    drones = poses.shape[0]
    view[:, VIEW.seen] = 0.0
    for m in range(view.shape[0]):
        if m == own or (m < drones and not bare[m]):
            continue
        centre, velocity = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        if m < drones:
            other = four(poses[m], STATE.q_WB)
            centre = add(vector(poses[m], STATE.p_WB), rotate(other, hat_B))
            velocity = vector(poses[m], STATE.v_WB)
        else:
            centre = vector(balls[m - drones], 0)
        to_W = subtract(centre, eye)
        away = norm(to_W)
        to_K = rotate_back(camera.q_BK, rotate_back(q_WB, to_W))
        if away <= diameter:
            continue
        angle = 2.0 * el.asin(0.5 * diameter / away)
        if not _in_picture(camera.lens, to_K, angle):
            continue
        ray = scaled(to_W, 1.0 / away)
        _write_outline(_hidden(eye, ray, away, 0.5 * diameter, own, m, poses, hulls, scene), view[m])
        if view[m, VIEW.share] < SHARE_MIN:
            continue
        across = axpy(subtract(velocity, v_eye), -dot(subtract(velocity, v_eye), ray), ray)
        moves = subtract(scaled(across, 1.0 / away), cross(w_W, ray))
        view[m, VIEW.seen] = 1.0
        for k in range(3):
            view[m, VIEW.direction_K + k] = to_K[k] / away
        view[m, VIEW.range] = away
        view[m, VIEW.angle] = angle
        view[m, VIEW.scale] = _scale(camera.lens, to_K[2] / away)
        view[m, VIEW.rate] = norm(moves)


@inlined
def _unit(normal: float) -> float:
    """Convert a standard normal variate to a uniform one in [0, 1]."""
    return normal_probability(-normal)


@inlined
def _sigmas_px(model: NDArray, row: NDArray) -> tuple[float, float]:
    """Return the standard deviations of a hat's measured centre and diameter [px]."""
    scale = row[VIEW.scale]
    noise = model[DETECTOR.noise] / (row[VIEW.angle] * scale)
    blur = model[DETECTOR.blur_share] * row[VIEW.rate] * model[DETECTOR.exposure] * scale
    centre = row[VIEW.centre] * el.hypot(noise, blur)
    hidden = 0.5 * (row[VIEW.radius] - 1.0)
    diameter = el.hypot(row[VIEW.radius] * DIAMETER_NOISE * noise, (1.0 + hidden) * DIAMETER_BLUR * blur)
    return el.hypot(model[DETECTOR.centre], centre), el.hypot(model[DETECTOR.diameter], diameter)


@inlined
def _put(model: NDArray, to_K: Vector, range_m: float, sigma: float, sigma_m: float, out: NDArray) -> None:
    """Write a sighting in the direction of `to_K`, a vector of any length in the camera frame K."""
    length = math.sqrt(to_K[0] * to_K[0] + to_K[1] * to_K[1] + to_K[2] * to_K[2])
    for k in range(3):
        at = DETECTOR.R_BK + 3 * k
        along = model[at] * to_K[0] + model[at + 1] * to_K[1] + model[at + 2] * to_K[2]
        out[SEEN.direction_B + k] = along / length
    out[SEEN.range], out[SEEN.sigma_direction], out[SEEN.sigma_range] = range_m, sigma, sigma_m


@inlined
def _range_m(model: NDArray, angle: float) -> float:
    return model[DETECTOR.radius] / el.sin(0.5 * min(angle, ANGLE_MAX))


@inlined
def _write_sighting(model: NDArray, row: NDArray, noise: NDArray, out: NDArray) -> bool:
    """Write the sighting of a hat in view; return False if it is missed at random, or measured as too small."""
    centre_px, diameter_px = _sigmas_px(model, row)
    scale, angle = row[VIEW.scale], row[VIEW.angle]
    measured = angle + diameter_px / scale * noise[2]
    if measured * scale < model[DETECTOR.diameter_min] or _unit(noise[3]) < model[DETECTOR.miss]:
        return False
    measured = max(measured, DIAMETER_RATIO_MIN * angle)
    x, y, z = row[VIEW.direction_K], row[VIEW.direction_K + 1], row[VIEW.direction_K + 2]
    across = el.hypot(x, z)
    a, b = centre_px / scale * noise[0], centre_px / scale * noise[1]
    to_K = (x + a * z / across - b * x * y / across, y + b * across, z - a * x / across - b * y * z / across)
    range_m = _range_m(model, measured)
    sigma = el.hypot(centre_px / scale, model[DETECTOR.misaligned])
    sigma_m = range_m * diameter_px / (scale * measured)
    _put(model, to_K, range_m, sigma, sigma_m, out)
    return True


@inlined
def _write_false_alarm(model: NDArray, lens: Lens, noise: NDArray, out: NDArray) -> bool:
    """Write a false alarm, a small blob anywhere in the picture; return False if this picture has none."""
    if _unit(noise[0]) >= model[DETECTOR.false]:
        return False
    x, y = undistorted(lens, _unit(noise[1]) * lens.width - 0.5, _unit(noise[2]) * lens.height - 0.5)
    size_px = model[DETECTOR.diameter_min] * (1.0 + 2.0 * _unit(noise[3]))
    range_m = _range_m(model, size_px / lens.fx)
    sigma = el.hypot(model[DETECTOR.centre] / lens.fx, model[DETECTOR.misaligned])
    _put(model, (x, y, 1.0), range_m, sigma, range_m * model[DETECTOR.diameter] / size_px, out)
    return True


@inlined
def _sort(out: NDArray, first: int, end: int) -> None:
    """Sort sightings from left to right, so that their order does not reveal the identity of the hats."""
    for m in range(first + 1, end):
        for k in range(m, first, -1):
            a, b = out[k - 1], out[k]
            if el.atan2(a[SEEN.direction_B + 1], a[SEEN.direction_B]) >= el.atan2(
                b[SEEN.direction_B + 1], b[SEEN.direction_B]
            ):
                break
            for c in range(SEEN.size):
                a[c], b[c] = b[c], a[c]


@compiled
def detect(model: NDArray, lens: Lens, view: NDArray, stream: NDArray, out: NDArray, first: int) -> int:
    """Write a detector's sightings in a picture into `out` from row `first` on; return the row after the last one.

    Args:
        model: row of the detector, (DETECTOR.size,).
        lens: lens of the camera.
        view: views of hats and of balls that look like hats, (M, VIEW.size).
        stream: words of the camera's random stream, (WORDS.size,), advanced in place.
        out: sightings, (first + M + 1 or more, SEEN.size).
    """
    drawn = np.empty(DRAWS * len(view) + FALSE_DRAWS)
    fill(drawn, stream)
    end = first
    for m in range(len(view)):
        noise = drawn[DRAWS * m : DRAWS * m + DRAWS]
        if view[m, VIEW.seen] != 0.0 and _write_sighting(model, view[m], noise, out[end]):
            end += 1
    if model[DETECTOR.false] > 0.0 and _write_false_alarm(model, lens, drawn[DRAWS * len(view) :], out[end]):
        end += 1
    _sort(out, first, end)
    return end
