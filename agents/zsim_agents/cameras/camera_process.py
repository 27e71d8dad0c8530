"""Camera processes render pictures from the drones' true states; detector processes find hats in these pictures.

A process that is too slow drops pictures and counts them, unless the scenario makes the run wait for the cameras.
"""

from __future__ import annotations

import math
import threading
import time
from collections import OrderedDict, defaultdict, deque
from collections.abc import Callable, Mapping, Sequence
from itertools import count, product
from operator import attrgetter

import numpy as np
from msgspec.structs import replace

from zsim.contract import keys, messages
from zsim.contract.flight_messages import CameraImage, CameraInfo, Sightings, Truth, moved_on, truth_fault
from zsim.contract.messages import Info
from zsim.contract.run_messages import RUN_ENDED
from zsim.errors import DecodeError
from zsim.math.frames import rotation_matrix
from zsim.math.rotation import pose_between
from zsim.runtime.participant import Participant
from zsim.scenario.scenario import Drone, Scenario
from zsim.sensors.camera import CAMERAS, Camera, PictureError
from zsim.sensors.camera_model import CameraPose, Lens, camera_matrix, camera_pose, folds, lens_of
from zsim.transport.session import Query, RawSample, ReceivedSample, Session
from zsim.vehicles.vehicle import ROTORS_MIN
from zsim_agents.cameras.detector import PIXELS_MAX, HatDetector, decoded, rehearse
from zsim_agents.cameras.renderer import Renderer
from zsim_agents.cameras.scene import DroneStates, scene_of

TICK_S = 0.1  # interval between checks for a stop while no message arrives
# Number of gates, beyond the command delay, by which cameras may lag the world before they drop pictures: tolerates
# messages that arrive in bursts, and exceeds the slack of cameras for which the run waits
LAG_MAX_GATES = 5
QUERY_TIMEOUT_S = 0.5  # timeout of queries, which the world and cameras answer within milliseconds
BYE_DELAY_S = 0.1  # delay of the bye, whose higher priority would let it reach recorders before the last pictures
DRAIN_S = 1.0  # maximum wall time to wait for the last truths of a run
PENDING_MAX = 64  # maximum number of gates kept while the truth of a drone is missing
INFO_REQUEST_PERIOD_S = 2.0  # minimum wall time between requests for a camera's missing info
PRINTED_MAX = 5  # maximum number of lines printed about refused messages; the health message counts all of them


class RunProcess:
    """A process that waits for messages, which Zenoh's threads receive, and handles them in `turn`."""

    def __init__(self, link: Session, participant: Participant) -> None:
        self._link, self._participant = link, participant
        self._wake_event = threading.Event()
        self._was_lost = False
        self._was_restored = False  # a lost link has been restored
        link.declare_subscriber(keys.CLOCK, self._on_clock)
        link.on_link(self._on_link)

    def begin(self) -> None:
        raise NotImplementedError

    def turn(self) -> None:
        raise NotImplementedError

    def run(self, stopped: Callable[[], bool]) -> None:
        """Begin, then call `turn` until the run ends or the process is stopped."""
        self.begin()
        while not (self._participant.end_reason or stopped()):
            self.turn()

    def wake(self) -> None:
        self._wake_event.set()

    def wait(self) -> None:
        """Wait for a message, TICK_S at most."""
        self._wake_event.wait(TICK_S)
        self._wake_event.clear()
        self._participant.tick()

    def _on_clock(self, sample: RawSample) -> None:
        self._participant.update_clock(sample.payload)
        if self._participant.end_reason:
            self.wake()

    def _on_link(self, up: bool) -> None:
        self._was_restored = self._was_restored or (up and self._was_lost)
        self._was_lost = not up
        self.wake()


class CameraProcess(RunProcess):
    """Publishes the pictures of all cameras of the given drones."""

    def __init__(
        self, link: Session, info: Info, participant: Participant, scenario: Scenario, drones: Sequence[str]
    ) -> None:
        self._info = info
        self._numbers = {drone.name: i for i, drone in enumerate(info.drones)}
        scene = scene_of(info, scenario)
        cameras = {drone.name: drone.sensors.cameras() for drone in scenario.drones}
        self._streams = [
            _CameraStream(drone, name, each, Renderer(each, scene, self._numbers[drone], info.seed, f"{drone}/{name}"))
            for drone in drones
            for name, each in cameras[drone].items()
        ]
        longest_ns = max((stream.latency_ns for stream in self._streams), default=0)
        self._lag_max_ns = LAG_MAX_GATES * info.gate_ns + info.command_delay_ns
        rotors = [len(drone.rotors) or ROTORS_MIN for drone in info.drones]
        external = {
            i: stationary_truth(drone, rotors[i]) for i, drone in enumerate(scenario.drones) if drone.is_external
        }
        self._truths = TruthHistory(len(info.drones), info.gate_ns, longest_ns + 2 * self._lag_max_ns, external)
        self._arrived: deque[RawSample | ReceivedSample] = deque()
        self._drawing_order = count()
        self._info_seq = 0
        self._has_begun = False
        self._done_ns = -1
        super().__init__(link, participant)

    def begin(self) -> None:
        """Subscribe to the truth, publish the camera infos, and join if the world waits for this process."""
        for stream in self._streams:
            self._link.declare_queryable(stream.info_key, self._on_query)
        self._link.declare_subscriber(keys.truth("*"), self._on_truth)
        self._publish_infos()
        if self._participant.gates:
            self.join()

    def run(self, stopped: Callable[[], bool]) -> None:
        super().run(stopped)
        if self._participant.end_reason == RUN_ENDED:
            self._finish()

    def join(self) -> None:
        """Join, so that the world waits for this process, and catch up with a run that has begun.

        A reply to the first query shows that the run has begun. Otherwise no truth can have been missed, and there is
        no second query after joining, since replies to a query may overtake earlier publications.
        """
        has_begun = bool(self._link.get(keys.truth("*"), timeout_s=QUERY_TIMEOUT_S))
        self._participant.announce()
        if has_begun:
            self._catch_up()

    def turn(self) -> None:
        self.wait()
        if self._was_restored:
            self._was_restored = False
            self._publish_infos()
            self._catch_up()
        self._draw()

    def _finish(self) -> None:
        """Publish the pictures due by the end of the run; wait up to DRAIN_S for its last truth."""
        end_s = time.monotonic() + DRAIN_S
        self._draw()
        while self._truths.newest_ns < self._participant.now_ns and time.monotonic() < end_s:
            self.wait()
            self._draw()
        time.sleep(BYE_DELAY_S)

    def _catch_up(self) -> None:
        """Request the newest truth, which this process may have missed, if the world waits for this process."""
        if self._participant.gates:
            self._arrived.extend(self._link.get(keys.truth("*"), timeout_s=QUERY_TIMEOUT_S))
            self.wake()

    def _on_truth(self, sample: RawSample) -> None:
        self._arrived.append(sample)
        self.wake()

    def _on_query(self, query: Query) -> None:
        for stream in self._streams:
            if keys.matches(query.expression, stream.info_key):
                query.reply(stream.info_key, messages.encode(self._camera_info(stream)))
        query.end()

    def _draw(self) -> None:
        self._take_truths()
        newest_ns = self._truths.newest_ns
        for stream, number in self._due():
            self._take_truths()
            self._expose(stream, number)
        if newest_ns > self._done_ns:
            self._done_ns = newest_ns
            self._participant.done(newest_ns)

    def _take_truths(self) -> None:
        health = self._participant.health
        while self._arrived:
            sample = self._arrived.popleft()
            try:
                truth = messages.decode(sample.key, sample.payload)
            except DecodeError:
                health.refused += 1
                continue
            health.received += 1
            number = self._numbers.get(keys.thing(sample.key))
            if number is not None:
                self._truths.add(number, truth)

    def _due(self) -> list[tuple[_CameraStream, int]]:
        """Return the due pictures as pairs of camera and picture number, and count those that are too old as dropped.

        Those due before the first call are not counted. The cameras take turns, starting with the one whose last
        picture is oldest, so that a process that is too slow drops pictures of all cameras alike.
        """
        newest_ns = self._truths.newest_ns
        if newest_ns < 0:
            return []
        due: list[tuple[int, int, _CameraStream]] = []
        for stream in self._streams:
            last_number = stream.last_due(newest_ns)
            first_number = max(stream.next, stream.last_due(newest_ns - self._lag_max_ns) + 1)
            if self._has_begun:
                self._participant.health.dropped += max(0, first_number - stream.next)
            due += [(rank, number, stream) for rank, number in enumerate(range(first_number, last_number + 1))]
            stream.next = max(stream.next, last_number + 1)
        self._has_begun = True
        return [(stream, number) for _, number, stream in sorted(due, key=lambda each: (each[0], each[2].last))]

    def _expose(self, stream: _CameraStream, number: int) -> None:
        """Render and publish a picture, or drop it if it is too late or the truth around its time is missing."""
        start_ns = time.perf_counter_ns()
        t_sample_ns = stream.exposure_ns(number)
        health = self._participant.health
        health.lag_ns = max(0, self._truths.newest_ns - t_sample_ns - stream.latency_ns)
        bodies = self._truths.bodies(t_sample_ns)
        if bodies is None or health.lag_ns > 2 * self._lag_max_ns:
            health.dropped += 1
            return
        image = CameraImage(
            t_ns=self._truths.newest_ns,
            seq=stream.seq,
            t_sample_ns=t_sample_ns,
            source=self._participant.name,
            width=stream.camera.width_px,
            height=stream.camera.height_px,
            data=stream.renderer.jpeg(number, t_sample_ns / 1e9, bodies),
        )
        stream.seq += 1
        stream.last = next(self._drawing_order)
        self._link.put(stream.key, image)
        health.step(time.perf_counter_ns() - start_ns)

    def _publish_infos(self) -> None:
        self._info_seq += 1
        for stream in self._streams:
            self._link.put(stream.info_key, self._camera_info(stream))

    def _camera_info(self, stream: _CameraStream) -> CameraInfo:
        camera = stream.camera
        lens, pose = lens_of(camera), camera_pose(camera)
        return CameraInfo(
            t_ns=max(0, self._truths.newest_ns),
            seq=self._info_seq,
            source=self._participant.name,
            width=lens.width,
            height=lens.height,
            K=tuple(camera_matrix(lens).ravel().tolist()),  # type: ignore[arg-type]
            D=(lens.k1, lens.k2, lens.p1, lens.p2, lens.k3),
            position_m=tuple(pose.p_BK.tolist()),  # type: ignore[arg-type]
            orientation_wxyz=pose.q_BK,
            rate_hz=camera.rate_hz,
            exposure_s=camera.exposure_ms * 1e-3,
            gate_ns=self._info.gate_ns,
        )


class DetectorProcess(RunProcess):
    """Finds hats of the given diameter in the pictures of the given drones' cameras, and publishes the sightings."""

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
        # newest picture of each camera, beginning with the camera that has waited longest
        self._pictures: OrderedDict[str, RawSample] = OrderedDict()
        self._infos: dict[str, RawSample] = {}
        self._detectors: dict[str, HatDetector] = {}  # by camera key, as in the next two
        self._known_infos: dict[str, CameraInfo] = {}
        self._requested_s: dict[str, float] = {}
        self._seq: defaultdict[str, int] = defaultdict(int)
        self._refusals_printed = 0
        super().__init__(link, participant)

    def begin(self) -> None:
        """Subscribe to the pictures and infos of known camera names only, since any program could invent others."""
        rehearse()
        for drone, name in product(self._drones, CAMERAS):
            self._link.declare_subscriber(keys.camera_info(drone, name), self._on_info)
            self._link.declare_subscriber(keys.camera(drone, name), self._on_picture)

    def turn(self) -> None:
        """Search the newest picture of each camera for hats, beginning with the camera that has waited longest."""
        self.wait()
        while self._infos:
            self._read_info(self._infos.popitem()[1])
        for _ in range(len(self._pictures)):
            self._detect(self._pictures.popitem(last=False)[1])

    def _on_info(self, sample: RawSample) -> None:
        self._infos[sample.key] = sample
        self.wake()

    def _on_picture(self, sample: RawSample) -> None:
        if sample.key in self._pictures:
            self._participant.health.dropped += 1
        self._pictures[sample.key] = sample
        self.wake()

    def _read_info(self, sample: RawSample) -> None:
        def detector_settings(info: CameraInfo | None) -> object:
            return info and (info.width, info.height, info.K, info.D, info.orientation_wxyz)

        try:
            info: CameraInfo = messages.decode(sample.key, sample.payload)
            key = sample.key.removesuffix("/info")
            if detector_settings(self._known_infos.get(key)) != detector_settings(info):
                self._detectors[key] = _detector_of(info, self._diameter_m)
            self._known_infos[key] = info
        except (DecodeError, PictureError) as error:
            self._refuse(sample.key, error)

    def _detect(self, sample: RawSample) -> None:
        start_ns = time.perf_counter_ns()
        health = self._participant.health
        try:
            image: CameraImage = messages.decode(sample.key, sample.payload)
            detector, info = self._detectors.get(sample.key), self._known_infos.get(sample.key)
            if detector is None or info is None:
                health.dropped += 1
                self._request_info(sample.key)
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

    def _request_info(self, key: str) -> None:
        if time.monotonic() - self._requested_s.get(key, -INFO_REQUEST_PERIOD_S) < INFO_REQUEST_PERIOD_S:
            return
        self._requested_s[key] = time.monotonic()
        for reply in self._link.get(f"{key}/info", timeout_s=QUERY_TIMEOUT_S):
            self._read_info(RawSample("PUT", reply.key, reply.payload, "", None))

    def _refuse(self, key: str, error: Exception) -> None:
        self._participant.health.refused += 1
        if self._refusals_printed < PRINTED_MAX:
            self._refusals_printed += 1
            self._say(f"{self._participant.name}: {key}: {messages.fault_at(key, error)}")


class _CameraStream:
    """A camera of a drone, with its renderer and the number of its next picture."""

    def __init__(self, drone: str, name: str, camera: Camera, renderer: Renderer) -> None:
        self.key, self.info_key = keys.camera(drone, name), keys.camera_info(drone, name)
        self.camera, self.renderer = camera, renderer
        self.latency_ns = round(camera.latency_ms * 1e6)
        self.next = 0
        self.seq = 0
        self.last = -1  # index of its last picture in the sequence of all cameras' pictures

    def exposure_ns(self, number: int) -> int:  # middle of the exposure
        return round(number * 1e9 / self.camera.rate_hz)

    def last_due(self, t_ns: int) -> int:
        """Return the number of the newest picture available at `t_ns`; < 0 before the first."""
        due_ns = t_ns - self.latency_ns
        number = int(due_ns * self.camera.rate_hz / 1e9) + 1
        while number >= 0 and self.exposure_ns(number) > due_ns:
            number -= 1
        return number


class TruthHistory:
    """The true states of all drones at the most recent gates, with interpolation between gates.

    External drones, whose drivers may skip gates, are extrapolated at their last published velocity.

    Args:
        span_ns: minimum time span that the history covers [ns].
        external: initial states of the external drones by index, used until their drivers publish.
    """

    def __init__(self, drones: int, gate_ns: int, span_ns: int, external: Mapping[int, Truth] = {}) -> None:
        self._drones, self._gate_ns = drones, gate_ns
        self._external = dict(external)
        self._simulated = frozenset(range(drones)) - external.keys()
        self._gates_max = 2 + span_ns // gate_ns
        self._pending: dict[int, dict[int, Truth]] = {}
        self._complete: dict[int, list[Truth]] = {}  # by gate, in order
        self.newest_ns = -1

    def add(self, drone: int, truth: Truth) -> None:
        t_ns = truth.t_ns
        if drone in self._external:
            if truth_fault(truth, len(self._external[drone].rotor_rad_s)):
                return  # the world refuses it as well
            self._external[drone] = max(self._external[drone], truth, key=attrgetter("t_ns"))
        if t_ns <= self.newest_ns:
            return
        states = self._pending.setdefault(t_ns, {})
        states[drone] = truth
        if states.keys() >= self._simulated:
            for i, last in self._external.items():
                moved = moved_on(last.position_m, last.velocity_m_s, t_ns - last.t_ns)
                states.setdefault(i, replace(last, t_ns=t_ns, position_m=moved))
            self._complete[t_ns] = [states[i] for i in range(self._drones)]
            self.newest_ns = t_ns
            self._pending = {t: pending for t, pending in self._pending.items() if t > t_ns}
            while len(self._complete) > self._gates_max:
                del self._complete[next(iter(self._complete))]
        elif len(self._pending) > PENDING_MAX:
            del self._pending[min(self._pending)]

    def bodies(self, t_ns: int) -> DroneStates | None:
        """Return the states of all drones at `t_ns`; None if a neighbouring gate is missing."""
        before_ns = t_ns // self._gate_ns * self._gate_ns
        before, after = self._complete.get(before_ns), self._complete.get(before_ns + self._gate_ns)
        if before is None:
            return None
        if t_ns == before_ns:
            after = before
        return None if after is None else _interpolated((t_ns - before_ns) / 1e9, self._gate_ns / 1e9, before, after)


def stationary_truth(drone: Drone, rotors: int) -> Truth:
    """Return the state of a drone at rest at its start position, with stopped rotors."""
    half = 0.5 * math.radians(drone.yaw_deg)
    zero, q_WB = (0.0, 0.0, 0.0), (math.cos(half), 0.0, 0.0, math.sin(half))
    return Truth(0, 0, drone.position_m, zero, q_WB, zero, zero, (0.0,) * rotors)


def _interpolated(t_s: float, gate_s: float, before: Sequence[Truth], after: Sequence[Truth]) -> DroneStates:
    fraction = t_s / gate_s

    def interpolated(a: Sequence[float], b: Sequence[float]) -> list[float]:
        return [x + fraction * (y - x) for x, y in zip(a, b, strict=True)]

    poses, rates, rotors = [], [], []
    for a, b in zip(before, after, strict=True):
        start, end = ((t.position_m, t.velocity_m_s, t.orientation_wxyz) for t in (a, b))
        poses.append(pose_between(t_s, 0.0, *start, gate_s, *end))
        rates.append(interpolated(a.angular_velocity_rad_s, b.angular_velocity_rad_s))
        rotors.append(interpolated(a.rotor_rad_s, b.rotor_rad_s))
    p, v, q = (np.array([pose[k] for pose in poses]) for k in range(3))
    return DroneStates(p, v, q, np.array(rates), rotors)


def _detector_of(info: CameraInfo, diameter_m: float) -> HatDetector:
    """Return a hat detector for the camera that `info` describes.

    Raises:
        PictureError: the camera's pictures are too large, or its intrinsics are invalid.
    """
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
