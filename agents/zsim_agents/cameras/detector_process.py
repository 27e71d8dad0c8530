"""A detector of hats as a process: reads the pictures of some drones' cameras, publishes what it finds in them."""

import time
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Sequence
from itertools import product

import numpy as np

from zsim.contract import keys, messages
from zsim.contract.camera_messages import CameraImage, CameraInfo, Sightings
from zsim.errors import DecodeError
from zsim.math.frames import rotation_matrix
from zsim.sensors.camera import CAMERAS
from zsim.sensors.camera_model import CameraPose, Lens, folds
from zsim.sensors.jpeg_header import PictureError
from zsim.transport.session import RawSample, Session
from zsim_agents.cameras import detector as hat_outline
from zsim_agents.cameras.detector import PIXELS_MAX, HatDetector, decoded
from zsim_agents.cameras.process import Bell, Presence

ASK_S = 2.0  # wall; how often a camera is asked what its pixels mean, while pictures come of which that is not known
REPORTS_MAX = 5  # lines about pictures that are refused; the count is in the health


def serve(
    link: Session,
    presence: Presence,
    stopped: Callable[[], bool],
    say: Callable[[str], None],
    drones: Sequence[str],
    diameter_m: float,
) -> None:
    """Publish what is seen in the pictures of some drones until the run is over or the process is stopped.

    Args:
        diameter_m: of a hat.
    """
    process = DetectorProcess(link, presence, say, drones, diameter_m)
    process.begin()
    while not (presence.end_reason or stopped()):
        process.turn()


class DetectorProcess:
    """The detector of some drones' cameras in one run."""

    def __init__(
        self, link: Session, presence: Presence, say: Callable[[str], None], drones: Sequence[str], diameter_m: float
    ) -> None:
        self._link, self._presence, self._say = link, presence, say
        self._drones, self._diameter_m = drones, diameter_m
        self._pictures: OrderedDict[str, RawSample] = OrderedDict()  # the newest of each camera, by who waits longest
        self._infos: dict[str, RawSample] = {}
        self._detectors: dict[str, HatDetector] = {}  # by the key of the camera
        self._known: dict[str, CameraInfo] = {}
        self._asked_s: dict[str, float] = {}
        self._seq: defaultdict[str, int] = defaultdict(int)
        self._reported = 0
        self._bell = Bell(link, presence)

    def begin(self) -> None:
        """Subscribe to pictures and to what their pixels mean; of no other names, which anybody could make up."""
        hat_outline.rehearse()
        for drone, name in product(self._drones, CAMERAS):
            self._link.declare_subscriber(keys.camera_info(drone, name), self._on_info)
            self._link.declare_subscriber(keys.camera(drone, name), self._on_picture)

    def turn(self) -> None:
        """Wait for something, and look at the newest picture of each camera, of the one that waits longest first."""
        self._bell.wait()
        while self._infos:
            self._learn(self._infos.popitem()[1])
        for _ in range(len(self._pictures)):
            self._look(self._pictures.popitem(last=False)[1])

    # What arrives, in threads of Zenoh's

    def _on_info(self, sample: RawSample) -> None:
        self._infos[sample.key] = sample
        self._bell.ring()

    def _on_picture(self, sample: RawSample) -> None:
        if sample.key in self._pictures:
            self._presence.health.dropped += 1
        self._pictures[sample.key] = sample
        self._bell.ring()

    # What is made of it

    def _learn(self, sample: RawSample) -> None:
        """Take what a camera's pixels mean."""
        try:
            info: CameraInfo = messages.decode(sample.key, sample.payload)
            key = sample.key.removesuffix("/info")
            if self._meaning(self._known.get(key)) != self._meaning(info):
                self._detectors[key] = detector_of(info, self._diameter_m)
            self._known[key] = info
        except (DecodeError, PictureError) as error:
            self._refuse(sample.key, error)

    @staticmethod
    def _meaning(info: CameraInfo | None) -> object:
        return info and (info.width, info.height, info.K, info.D, info.orientation_wxyz)

    def _look(self, sample: RawSample) -> None:
        """Publish what is seen in a picture."""
        start_ns = time.perf_counter_ns()
        health = self._presence.health
        try:
            image: CameraImage = messages.decode(sample.key, sample.payload)
            detector, info = self._detectors.get(sample.key), self._known.get(sample.key)
            if detector is None or info is None:
                health.dropped += 1
                self._ask(sample.key)
                return
            seen = detector.seen(decoded(image.data, info.width, info.height))
        except (DecodeError, PictureError) as error:
            self._refuse(sample.key, error)
            return
        health.received += 1
        _, drone, what = keys.parts(sample.key)
        seq = self._seq[drone]
        self._seq[drone] += 1
        camera = what.removeprefix("camera/")
        sightings = Sightings(
            t_ns=image.t_ns,
            seq=seq,
            t_sample_ns=image.t_sample_ns,
            source=self._presence.name,
            camera=camera,
            seen=seen,
        )
        self._link.put(keys.detections(drone), sightings)
        health.step(time.perf_counter_ns() - start_ns)

    def _ask(self, key: str) -> None:
        """Ask a camera what its pixels mean, now and then."""
        if time.monotonic() - self._asked_s.get(key, -ASK_S) < ASK_S:
            return
        self._asked_s[key] = time.monotonic()
        for answer in self._link.get(f"{key}/info", timeout_s=0.5):
            self._learn(RawSample("PUT", answer.key, answer.payload, "", None))

    def _refuse(self, key: str, error: Exception) -> None:
        self._presence.health.refused += 1
        if self._reported < REPORTS_MAX:
            self._reported += 1
            self._say(f"{self._presence.name}: {key}: {messages.fault_at(key, error)}")


def detector_of(info: CameraInfo, diameter_m: float) -> HatDetector:
    """Return the detector for a camera, whatever it is.

    Raises:
        PictureError: its pictures are too large, or its intrinsics are none.
    """
    if info.width * info.height > PIXELS_MAX:
        raise PictureError(f"{info.width} x {info.height} are too many pixels; must be at most {PIXELS_MAX}")
    fx, skew, cx, _, fy, cy, *_ = info.K
    if fx <= 0 or fy <= 0 or skew:
        raise PictureError(f"K has focal lengths {fx:g} and {fy:g}, and skew {skew:g}; must be > 0, > 0, and 0")
    lens = Lens(fx, fy, cx, cy, *info.D, info.width, info.height)
    if folds(lens):
        raise PictureError(f"D is {list(info.D)}, which folds the picture; must give every pixel a ray of its own")
    R_BK = rotation_matrix(np.array(info.orientation_wxyz))
    return HatDetector(lens, CameraPose(np.array(info.position_m), R_BK), diameter_m)
