"""The cameras of a run for pages: their names, the newest picture of each watched one, and the marks drawn on it.

Pictures may come from any program, so each is checked before a browser decodes it. Frames: B of the drone; K of the
camera: x right, y down, z ahead. Pixel coordinates (0, 0) are the centre of the picture's upper-left pixel.
"""

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from msgspec import Struct

from zsim.contract import keys, messages
from zsim.contract.flight_messages import CameraImage, CameraInfo, Seen, Sightings
from zsim.errors import DecodeError, ZsimError
from zsim.math import rotation
from zsim.runtime.participant import Participant
from zsim.sensors.camera import CAMERAS, PictureError, frame_of
from zsim.sensors.camera_model import Lens, pixel, undistorted
from zsim.transport.session import RawSample, Session

REQUEST_EXPIRY_S = 15.0  # wall; age at which a page's request expires; slow pages take seconds to show a picture
MESSAGE_BYTES = 1_000  # maximum size of a picture's message without the image data
SIGHTINGS_KEPT = 8  # number of sightings kept per camera and key: half a second at 15 Hz
MARKS_MAX = 40  # maximum number of marks on a picture; more would hide it
RADIUS_MIN_PX = 5.0  # minimum radius of a circle; a smaller one would go unnoticed
SIGMAS = 2.0  # uncertainty of a hat's direction that its circle includes, in standard deviations
FOLD_MAX = 1e-3  # maximum distance, in focal lengths, between a ray and the undistorted ray of its pixel
NORM_MIN = 1e-6  # minimum norm of a quaternion, and minimum forward component of a ray relative to its norm
AGE_MAX_NS = 300_000_000  # simulated; maximum time between a picture and sightings drawn on it: 3 pictures at 10 Hz
PICTURE_BYTES_MAX = 1_000_000  # maximum size of a picture; ten such pictures a second fill a link of 80 Mbit/s
PIXELS_MAX = 1920 * 1200  # per picture; a scenario's cameras have 1920 × 1080 at most; a browser needs 4 bytes each
JPEG_END = b"\xff\xd9"  # last bytes of a JPEG; ITU-T T.81, table B.1
SUPPORTED_MARKERS = frozenset({0xC0, 0xC1, 0xC2})  # frame types that browsers show: baseline, extended, progressive


class CameraPicture(NamedTuple):
    """A checked picture; `number` is unique in the run."""

    number: int
    image: CameraImage


class Mark(Struct, frozen=True):
    """A circle on a picture [px], with a text beside it."""

    u: float  # u, v: the circle's centre
    v: float
    radius: float
    text: str


class _WatchedCamera:
    """The state of a camera while a page watches it."""

    def __init__(self) -> None:
        self.payload: bytes | None = None  # a newer picture that is not decoded yet
        self.picture: CameraPicture | None = None
        self.sightings: dict[str, deque[Sightings]] = {}  # the newest ones, by key


class CameraFeed:
    """The cameras of one run, each named `DRONE/CAMERA`; only watched ones are subscribed to.

    Cameras that are not those of the run's drones are ignored; `hat_m` is the diameter of a hat [m].
    """

    def __init__(
        self,
        link: Session,
        observer: Participant,
        drones: Iterable[str],
        hat_m: float,
        wall_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._link = link
        self._observer = observer
        self._order = [f"{drone}/{camera}" for drone in drones for camera in CAMERAS]
        self._hat_m = hat_m
        self._wall_s = wall_s
        self._lock = threading.Lock()
        self._infos: dict[str, CameraInfo] = {}
        self._requests: dict[object, tuple[tuple[str, ...], float]] = {}  # by page: cameras, and expiry [s; wall]
        self._watched: dict[str, _WatchedCamera] = {}
        self._undeclare: dict[str, Callable[[], None]] = {}  # by key
        self._number = 0
        self.refused: Counter[str] = Counter()  # number of refused pictures by camera
        self.reasons: dict[str, str] = {}  # why the last picture of a camera was refused

    def open(self) -> None:
        """Discover existing cameras, and those that appear later."""
        expression = keys.camera_info("*", "*")
        self._link.declare_subscriber(expression, self._on_info)
        try:
            samples = self._link.get(expression)
        except ZsimError:
            return  # an older certificate does not permit the query; cameras that appear later are still discovered
        for sample in samples:
            self._on_info(sample, is_retained=True)

    def close(self) -> None:
        with self._lock:
            self._requests.clear()
        self.update()

    def update(self) -> None:
        """Subscribe to the cameras that pages recently requested, and no others; call it several times a second."""
        with self._lock:
            now_s = self._wall_s()
            self._requests = {page: each for page, each in self._requests.items() if each[1] > now_s}
            wanted = {camera for cameras, _ in self._requests.values() for camera in cameras if camera in self._infos}
            self._watched = {camera: self._watched.get(camera) or _WatchedCamera() for camera in wanted}
        wanted_keys = {keys.camera(*camera.split("/")) for camera in wanted}
        wanted_keys |= {key for camera in wanted for key in _sighting_keys(camera)}
        for key in self._undeclare.keys() - wanted_keys:
            self._undeclare.pop(key)()
        for key in wanted_keys - self._undeclare.keys():
            on_sample = self._on_picture if keys.is_picture(key) else self._on_sightings
            self._undeclare[key] = self._link.declare_subscriber(key, on_sample)

    # For pages; from any thread

    def cameras(self) -> tuple[tuple[str, CameraInfo], ...]:
        infos = self._infos.copy()
        return tuple((camera, infos[camera]) for camera in self._order if camera in infos)

    def request_pictures(self, page: object, cameras: Iterable[str]) -> None:
        """Request pictures of these cameras, and no others, for a page; must be repeated within REQUEST_EXPIRY_S."""
        with self._lock:
            self._requests[page] = tuple(cameras), self._wall_s() + REQUEST_EXPIRY_S

    def release(self, page: object) -> None:
        with self._lock:
            self._requests.pop(page, None)

    def picture(self, camera: str) -> CameraPicture | None:
        """Return a camera's newest valid picture; None before the first one, or if the camera is not watched."""
        with self._lock:
            watched = self._watched.get(camera)
            if watched is None:
                return None
            payload, watched.payload = watched.payload, None
            if payload is not None:
                watched.picture = self._decode_picture(camera, payload) or watched.picture
            return watched.picture

    def marks(self, camera: str) -> tuple[Mark, ...]:
        """Return the marks on the newest picture: from a detector's sightings close in time, or else the world's."""
        with self._lock:
            watched, info = self._watched.get(camera), self._infos.get(camera)
            if watched is None or watched.picture is None or info is None:
                return ()
            t_ns = watched.picture.image.t_sample_ns
            for key in _sighting_keys(camera):
                sightings = sightings_of(t_ns, watched.sightings.get(key, ()))
                if sightings is not None:
                    return marks_of(info, sightings.seen[:MARKS_MAX], self._hat_m)
        return ()

    def info_and_picture(self, camera: str) -> tuple[CameraInfo, CameraPicture] | None:
        info, picture = self._infos.get(camera), self.picture(camera)
        return None if info is None or picture is None else (info, picture)

    def state(self) -> list[dict[str, Any]]:
        with self._lock:
            watched = {camera: self._watched.get(camera) for camera, _ in self.cameras()}
            return [
                {
                    "camera": camera,
                    "watched": each is not None,
                    "t_s": each.picture.image.t_sample_ns / 1e9 if each is not None and each.picture else None,
                    "refused": self.refused[camera],
                    "reason": self.reasons.get(camera, ""),
                }
                for camera, each in watched.items()
            ]

    # Callbacks; in Zenoh's threads

    def _on_info(self, sample: Any, is_retained: bool = False) -> None:
        camera = _camera_of(sample.key)
        if camera not in self._order or (is_retained and camera in self._infos):
            return  # a description that has arrived in the meantime is newer than the kept one
        try:
            info = messages.decode(sample.key, sample.payload)
        except DecodeError:
            info = None
        with self._lock:
            if isinstance(info, CameraInfo) and is_usable(info):
                self._infos[camera] = info
            else:
                self._observer.health.refused += 1

    def _on_picture(self, sample: RawSample) -> None:
        camera = _camera_of(sample.key)
        with self._lock:
            self._observer.health.received += 1
            watched = self._watched.get(camera)
            if watched is None:
                return
            if len(sample.payload) > PICTURE_BYTES_MAX + MESSAGE_BYTES:
                self._refuse(camera, f"picture has {len(sample.payload)} bytes; must have {PICTURE_BYTES_MAX} at most")
            else:
                watched.payload = sample.payload

    def _on_sightings(self, sample: RawSample) -> None:
        try:
            sightings = messages.decode(sample.key, sample.payload)
        except DecodeError:
            sightings = None
        with self._lock:
            self._observer.health.received += 1
            if not isinstance(sightings, Sightings):
                self._observer.health.refused += 1
                return
            watched = self._watched.get(f"{keys.thing(sample.key)}/{sightings.camera}")
            if watched is not None:
                watched.sightings.setdefault(sample.key, deque(maxlen=SIGHTINGS_KEPT)).append(sightings)

    def _decode_picture(self, camera: str, payload: bytes) -> CameraPicture | None:
        """Return a picture; if it is invalid, count it as refused, and return None."""
        try:
            image: CameraImage = messages.decode(keys.camera(*camera.split("/")), payload)
            check_picture(image.data, image.width, image.height)
        except (DecodeError, PictureError) as error:
            self._refuse(camera, str(error))
            return None
        self._number += 1
        return CameraPicture(self._number, image)

    def _refuse(self, camera: str, reason: str) -> None:
        self._observer.health.refused += 1
        self.refused[camera] += 1
        self.reasons[camera] = reason


def _camera_of(key: str) -> str:
    _, drone, channel = keys.parts(key)
    return f"{drone}/{channel.split('/')[1]}"


def _sighting_keys(camera: str) -> tuple[str, str]:
    """Return the keys of sightings from a camera's drone: first those of a detector, then those of the world."""
    drone = camera.split("/")[0]
    return keys.detections(drone), keys.sensor(drone, keys.SIGHTINGS)


def check_picture(data: bytes, width: int, height: int) -> None:
    """Refuse data that is not a complete JPEG of the given size [px], or that a page could not show.

    Raises:
        PictureError: the data is refused; the message states why, in one line.
    """
    if len(data) > PICTURE_BYTES_MAX:
        raise PictureError(f"picture has {len(data)} bytes; must have {PICTURE_BYTES_MAX} at most")
    frame = frame_of(data)
    if frame.marker not in SUPPORTED_MARKERS or not data.endswith(JPEG_END):
        raise PictureError(
            "JPEG is truncated, or browsers cannot show it; must be complete, and baseline or progressive"
        )
    if (frame.width, frame.height) != (width, height):
        size = f"{frame.width} × {frame.height}"
        raise PictureError(f"JPEG is {size}, but its message says {width} × {height}; must be the same")
    if width * height > PIXELS_MAX:
        raise PictureError(f"picture is {width} × {height}; must have {PIXELS_MAX} pixels at most")


# Marks


def is_usable(info: CameraInfo) -> bool:
    """Return whether a camera's description, which any program may have sent, is safe to compute with."""
    fx, fy = info.K[0], info.K[4]
    return fx > 0 and fy > 0 and math.sqrt(sum(q * q for q in info.orientation_wxyz)) > NORM_MIN


def field_of_view(info: CameraInfo) -> float:
    return 2.0 * math.atan(info.height / 2.0 / info.K[4])


def sightings_of(picture_ns: int, candidates: Iterable[Sightings]) -> Sightings | None:
    """Return the sightings nearest to a picture's exposure; None if all are too far from it in time."""
    nearest = min(candidates, key=lambda each: abs(each.t_sample_ns - picture_ns), default=None)
    if nearest is None or abs(nearest.t_sample_ns - picture_ns) > AGE_MAX_NS:
        return None
    return nearest


def marks_of(info: CameraInfo, seen: Iterable[Seen], hat_m: float) -> tuple[Mark, ...]:
    """Return marks for those sightings that fall on the picture of a usable camera.

    A mark is a circle around a hat of diameter `hat_m`, enlarged by SIGMAS standard deviations of the hat's direction.
    """
    fx, _, cx, _, fy, cy, *_ = info.K
    lens = Lens(fx, fy, cx, cy, *info.D, info.width, info.height)
    q_BK = rotation.normalised(info.orientation_wxyz)
    marks = []
    for each in seen:
        centre = _pixel_of(lens, rotation.rotate_back(q_BK, each.direction_B))
        if centre is None or each.range_m <= 0:
            continue
        half_angle = hat_m / 2.0 / each.range_m + SIGMAS * abs(each.sigma_direction_rad)
        radius = min(max(lens.fx * half_angle, RADIUS_MIN_PX), float(lens.height))
        marks.append(Mark(round(centre[0], 1), round(centre[1], 1), round(radius, 1), range_text(each)))
    return tuple(marks)


def _pixel_of(lens: Lens, ray_K: rotation.Vector) -> tuple[float, float] | None:
    """Return the pixel of a ray, None if it is outside the picture.

    A distortion polynomial folds over far outside the field of view: a ray from there would be drawn at the pixel of
    another ray.
    """
    x, y, z = ray_K
    if z <= NORM_MIN * rotation.norm(ray_K):
        return None
    u, v = pixel(lens, x / z, y / z, 1.0)
    if not (-0.5 <= u <= lens.width - 0.5 and -0.5 <= v <= lens.height - 0.5):
        return None
    reprojected = undistorted(lens, u, v)
    return (u, v) if math.dist(reprojected, (x / z, y / z)) <= FOLD_MAX else None


def range_text(seen: Seen) -> str:
    digits = 1 if seen.sigma_range_m >= 0.1 else 2
    return f"{seen.range_m:.{digits}f} ± {seen.sigma_range_m:.{digits}f} m"
