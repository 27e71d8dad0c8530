"""The newest picture of each camera of a run that a page looks at, and what was seen in it; of the others nothing."""

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from zsim.contract import keys, messages
from zsim.contract.camera_messages import CameraImage, CameraInfo, Sightings
from zsim.errors import DecodeError, ZsimError
from zsim.runtime.participant import Participant
from zsim.sensors.camera import CAMERAS
from zsim.sensors.jpeg_header import PictureError
from zsim.transport.session import RawSample, Session
from zsim_bridges.console.cameras import camera_marks
from zsim_bridges.console.cameras.camera_marks import Mark
from zsim_bridges.console.cameras.picture_check import PICTURE_BYTES_MAX, check_picture

ASKED_S = 15.0  # wall; a page that has shown nothing for so long sleeps: a slow one takes seconds for a picture
MESSAGE_BYTES = 1_000  # of a picture's message beside its data, at most; chosen
SIGHTINGS_KEPT = 8  # of one camera from one key: half a second of 15 Hz
MARKS_MAX = 40  # on a picture; more would hide it


class CameraPicture(NamedTuple):
    """A picture that may be shown."""

    number: int  # counts all of a run; another picture has another number
    image: CameraImage


class _Watched:
    """What is kept of a camera while a page looks at it."""

    def __init__(self) -> None:
        self.payload: bytes | None = None  # newer than the picture; not decoded yet
        self.picture: CameraPicture | None = None
        self.sightings: dict[str, deque[Sightings]] = {}  # by key


class _Asked(NamedTuple):
    """What a page asks for."""

    cameras: tuple[str, ...]
    until_s: float  # wall


class CameraFeed:
    """The cameras of one run. A camera is named `drone1/front`.

    Args:
        link: an open session.
        observer: of the console in the run; what is refused is counted there.
        drones: of the run; cameras of others are left out.
        hat_m: diameter of a hat [m].
        wall_s: monotonic.

    Attributes:
        refused: how many pictures of each camera were left out.
        reasons: why the last of them was.
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
        self._asked: dict[object, _Asked] = {}  # by page
        self._watched: dict[str, _Watched] = {}
        self._undeclare: dict[str, Callable[[], None]] = {}  # by key
        self._number = 0
        self.refused: Counter[str] = Counter()
        self.reasons: dict[str, str] = {}

    def open(self) -> None:
        """Learn which cameras there are, and of those that come."""
        expression = keys.camera_info("*", "*")
        self._link.declare_subscriber(expression, self._on_info)
        try:
            samples = self._link.get(expression)
        except ZsimError:
            return  # a certificate of before cameras may not ask; those that come later are seen
        for sample in samples:
            self._on_info(sample, kept=True)

    def close(self) -> None:
        """Subscribe to nothing any more."""
        with self._lock:
            self._asked.clear()
        self.update()

    def update(self) -> None:
        """Subscribe to the cameras that pages have asked for lately, and to no others; to be called again and again."""
        with self._lock:
            now_s = self._wall_s()
            self._asked = {page: asked for page, asked in self._asked.items() if asked.until_s > now_s}
            wanted = {camera for asked in self._asked.values() for camera in asked.cameras if camera in self._infos}
            self._watched = {camera: self._watched.get(camera) or _Watched() for camera in wanted}
        self._subscribe({key for camera in wanted for key in _keys_of(camera)})

    def _subscribe(self, wanted: set[str]) -> None:
        for key in self._undeclare.keys() - wanted:
            self._undeclare.pop(key)()
        for key in wanted - self._undeclare.keys():
            on_sample = self._on_picture if keys.is_picture(key) else self._on_sightings
            self._undeclare[key] = self._link.declare_subscriber(key, on_sample)

    # For pages; from any thread

    def cameras(self) -> tuple[tuple[str, CameraInfo], ...]:
        """Return the cameras that there are, in the order of the drones."""
        infos = self._infos.copy()
        return tuple((camera, infos[camera]) for camera in self._order if camera in infos)

    def ask(self, page: object, cameras: Iterable[str]) -> None:
        """Ask for pictures of these cameras on a page, and of no others; to be repeated within ASKED_S."""
        with self._lock:
            self._asked[page] = _Asked(tuple(cameras), self._wall_s() + ASKED_S)

    def release(self, page: object) -> None:
        """Ask for nothing any more on a page."""
        with self._lock:
            self._asked.pop(page, None)

    def picture(self, camera: str) -> CameraPicture | None:
        """Return the newest picture of a camera, None as long as there is none."""
        with self._lock:
            watched = self._watched.get(camera)
            if watched is None:
                return None
            payload, watched.payload = watched.payload, None
            if payload is not None:
                watched.picture = self._checked(camera, payload) or watched.picture
            return watched.picture

    def marks(self, camera: str) -> tuple[Mark, ...]:
        """Return what is to be drawn on the newest picture: what a detector found in it, or else what the world saw."""
        with self._lock:
            watched, info = self._watched.get(camera), self._infos.get(camera)
            if watched is None or watched.picture is None or info is None:
                return ()
            for key in _sighting_keys(camera):
                t_ns = watched.picture.image.t_sample_ns
                found = camera_marks.sightings_of(t_ns, watched.sightings.get(key, ()))
                if found is not None:
                    return camera_marks.marks_of(info, found.seen[:MARKS_MAX], self._hat_m)
        return ()

    def shown(self, camera: str) -> tuple[CameraInfo, CameraPicture] | None:
        """Return a camera with its newest picture, None as long as there is none."""
        info, picture = self._infos.get(camera), self.picture(camera)
        return None if info is None or picture is None else (info, picture)

    def state(self) -> list[dict[str, Any]]:
        """Return the cameras as plain data: for programs, and for tests."""
        return [self._camera_state(camera) for camera, _ in self.cameras()]

    def _camera_state(self, camera: str) -> dict[str, Any]:
        with self._lock:
            watched = self._watched.get(camera)
            picture = watched.picture if watched is not None else None
            return {
                "camera": camera,
                "watched": watched is not None,
                "t_s": picture.image.t_sample_ns / 1e9 if picture is not None else None,
                "refused": self.refused[camera],
                "reason": self.reasons.get(camera, ""),
            }

    # What comes; in threads of Zenoh's

    def _on_info(self, sample: Any, kept: bool = False) -> None:
        camera = _camera_of(sample.key)
        if camera not in self._order or (kept and camera in self._infos):
            return  # what has arrived meanwhile is newer
        try:
            info = messages.decode(sample.key, sample.payload)
        except DecodeError:
            info = None
        with self._lock:
            if isinstance(info, CameraInfo) and camera_marks.is_usable(info):
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
            seen = messages.decode(sample.key, sample.payload)
        except DecodeError:
            seen = None
        with self._lock:
            self._observer.health.received += 1
            if not isinstance(seen, Sightings):
                self._observer.health.refused += 1
                return
            watched = self._watched.get(f"{keys.thing(sample.key)}/{seen.camera}")
            if watched is not None:
                watched.sightings.setdefault(sample.key, deque(maxlen=SIGHTINGS_KEPT)).append(seen)

    def _checked(self, camera: str, payload: bytes) -> CameraPicture | None:
        """Return a picture that may be shown; count one that may not."""
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
    """Return the name of the camera that a key is about."""
    _, drone, what = keys.parts(key)
    return f"{drone}/{what.split('/')[1]}"


def _sighting_keys(camera: str) -> tuple[str, str]:
    """Return the keys of what is seen by a camera's drone: by detectors, and by the world."""
    drone = camera.split("/")[0]
    return keys.detections(drone), keys.sensor(drone, keys.SIGHTINGS)


def _keys_of(camera: str) -> tuple[str, ...]:
    drone, name = camera.split("/")
    return keys.camera(drone, name), *_sighting_keys(camera)
