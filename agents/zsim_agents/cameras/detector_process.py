"""A detector of hats as a process: reads the pictures of drones' cameras, and publishes sightings."""

import time
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Sequence
from itertools import product

import numpy as np

from zsim.contract import keys, messages
from zsim.contract.flight_messages import CameraImage, CameraInfo, Sightings
from zsim.errors import DecodeError
from zsim.math.frames import rotation_matrix
from zsim.runtime.participant import Participant
from zsim.sensors.camera import CAMERAS, PictureError
from zsim.sensors.camera_model import CameraPose, Lens, folds
from zsim.transport.session import RawSample, Session
from zsim_agents.cameras.detector import PIXELS_MAX, HatDetector, decoded, rehearse
from zsim_agents.cameras.process import RunProcess

ASK_S = 2.0  # wall; how often a camera is asked what its pixels mean, while that is unknown
REPORTS_MAX = 5  # lines about refused pictures; health has the count


class DetectorProcess(RunProcess):
    """Publishes the hats, of a diameter [m], in the pictures of some drones' cameras."""

    def __init__(
        self,
        link: Session,
        participant: Participant,
        say: Callable[[str], None],
        drones: Sequence[str],
        diameter_m: float,
    ) -> None:
        self._say = say
        self._drones, self._diameter_m = drones, diameter_m
        self._pictures: OrderedDict[str, RawSample] = OrderedDict()  # the newest of each camera, longest waiting first
        self._infos: dict[str, RawSample] = {}
        self._detectors: dict[str, HatDetector] = {}  # by camera key, as the next two
        self._known: dict[str, CameraInfo] = {}
        self._asked_s: dict[str, float] = {}
        self._seq: defaultdict[str, int] = defaultdict(int)
        self._reported = 0
        super().__init__(link, participant)

    def run(self, stopped: Callable[[], bool]) -> None:
        self.begin()
        super().run(stopped)

    def begin(self) -> None:
        """Subscribe to pictures and camera infos, for known names only, since any program could invent others."""
        rehearse()
        for drone, name in product(self._drones, CAMERAS):
            self._link.declare_subscriber(keys.camera_info(drone, name), self._on_info)
            self._link.declare_subscriber(keys.camera(drone, name), self._on_picture)

    def turn(self) -> None:
        """Search the newest picture of each camera, the longest waiting first."""
        self.wait()
        while self._infos:
            self._learn(self._infos.popitem()[1])
        for _ in range(len(self._pictures)):
            self._look(self._pictures.popitem(last=False)[1])

    def _on_info(self, sample: RawSample) -> None:
        self._infos[sample.key] = sample
        self.wake()

    def _on_picture(self, sample: RawSample) -> None:
        if sample.key in self._pictures:
            self._participant.health.dropped += 1
        self._pictures[sample.key] = sample
        self.wake()

    def _learn(self, sample: RawSample) -> None:
        def meaning(info: CameraInfo | None) -> object:
            return info and (info.width, info.height, info.K, info.D, info.orientation_wxyz)

        try:
            info: CameraInfo = messages.decode(sample.key, sample.payload)
            key = sample.key.removesuffix("/info")
            if meaning(self._known.get(key)) != meaning(info):
                self._detectors[key] = _detector_of(info, self._diameter_m)
            self._known[key] = info
        except (DecodeError, PictureError) as error:
            self._refuse(sample.key, error)

    def _look(self, sample: RawSample) -> None:
        start_ns = time.perf_counter_ns()
        health = self._participant.health
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
        sightings = Sightings(
            t_ns=image.t_ns,
            seq=self._seq[drone],
            t_sample_ns=image.t_sample_ns,
            source=self._participant.name,
            camera=what.removeprefix("camera/"),
            seen=seen,
        )
        self._seq[drone] += 1
        self._link.put(keys.detections(drone), sightings)
        health.step(time.perf_counter_ns() - start_ns)

    def _ask(self, key: str) -> None:
        if time.monotonic() - self._asked_s.get(key, -ASK_S) < ASK_S:
            return
        self._asked_s[key] = time.monotonic()
        for answer in self._link.get(f"{key}/info", timeout_s=0.5):
            self._learn(RawSample("PUT", answer.key, answer.payload, "", None))

    def _refuse(self, key: str, error: Exception) -> None:
        self._participant.health.refused += 1
        if self._reported < REPORTS_MAX:
            self._reported += 1
            self._say(f"{self._participant.name}: {key}: {messages.fault_at(key, error)}")


def _detector_of(info: CameraInfo, diameter_m: float) -> HatDetector:
    """Return a camera's detector; PictureError: its pictures are too large, or its intrinsics invalid."""
    if info.width * info.height > PIXELS_MAX:
        raise PictureError(f"{info.width} x {info.height} are too many pixels; must be at most {PIXELS_MAX}")
    fx, skew, cx, _, fy, cy, *_ = info.K
    if fx <= 0 or fy <= 0 or skew:
        raise PictureError(f"K has focal lengths {fx:g} and {fy:g}, and skew {skew:g}; must be > 0, > 0, and 0")
    lens = Lens(fx, fy, cx, cy, *info.D, info.width, info.height)
    if folds(lens):
        raise PictureError(f"D is {list(info.D)}, which folds the picture; must give every pixel a ray of its own")
    pose = CameraPose(np.array(info.position_m), rotation_matrix(info.orientation_wxyz))
    return HatDetector(lens, pose, diameter_m)
