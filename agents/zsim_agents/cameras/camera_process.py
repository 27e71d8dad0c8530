"""The cameras of one or several drones as a process: draws what they see, from the truth, and publishes it.

When it is too slow it leaves pictures out, and counts them; where the scenario lets cameras gate, the run waits.
"""

import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from itertools import count
from operator import attrgetter

import numpy as np
from msgspec.structs import replace

from zsim.contract import keys, messages
from zsim.contract.camera_messages import CameraImage, CameraInfo
from zsim.contract.flight_messages import Truth
from zsim.contract.messages import Info
from zsim.contract.run_messages import RUN_ENDED
from zsim.errors import DecodeError
from zsim.math.interpolation import pose_between
from zsim.scenario.external_bodies import moved_on, truth_fault
from zsim.scenario.scenario import Drone, Scenario
from zsim.sensors.camera import Camera
from zsim.sensors.camera_model import camera_matrix, camera_pose, lens_of
from zsim.transport.session import Query, RawSample, ReceivedSample, Session
from zsim.vehicles.vehicle import ROTORS_MIN
from zsim_agents.cameras.process import Bell, Presence
from zsim_agents.cameras.rendering.renderer import Renderer
from zsim_agents.cameras.rendering.scene import DroneStates, Scene, scene_of

# gates that it may be behind the world, which may be ahead of everybody by the command delay, before it leaves pictures
# out: what arrives in a heap is no reason yet, and more than the slack of cameras that gate
BEHIND_MAX = 5
ASK_S = 0.5  # wall; the world answers in milliseconds
OVERTAKING_S = 0.1  # wall; a bye of higher priority would pass the last pictures, and a recorder close before them
DRAIN_S = 1.0  # wall; how long the last truths of a run are waited for


def serve(
    link: Session,
    info: Info,
    presence: Presence,
    stopped: Callable[[], bool],
    scenario: Scenario,
    drones: Sequence[str],
) -> None:
    """Publish the pictures of some drones' cameras until the run is over or the process is stopped."""
    process = CameraProcess(link, info, presence, scenario, drones)
    process.begin()
    if presence.gates:
        process.join()
    while not (presence.end_reason or stopped()):
        process.turn()
    if presence.end_reason == RUN_ENDED:
        process.finish()


class Eye:
    """One camera of one drone: which picture is next, and who draws it."""

    def __init__(self, drone: str, name: str, camera: Camera, renderer: Renderer) -> None:
        self.key, self.info_key = keys.camera(drone, name), keys.camera_info(drone, name)
        self.camera, self.renderer = camera, renderer
        self.latency_ns = round(camera.latency_ms * 1e6)
        self.next = 0
        self.seq = 0
        self.last = -1  # its last picture, by its number among those of all cameras

    def exposure_ns(self, number: int) -> int:
        """Return the middle of the exposure of a picture: number / rate."""
        return round(number * 1e9 / self.camera.rate_hz)

    def last_due(self, t_ns: int) -> int:
        """Return the number of the last picture that is out at an instant; -1 before the first."""
        due_ns = t_ns - self.latency_ns
        number = int(due_ns * self.camera.rate_hz / 1e9) + 1
        while number >= 0 and self.exposure_ns(number) > due_ns:
            number -= 1
        return number


class CameraProcess:
    """The cameras of some drones in one run.

    Args:
        link: an open session.
        info: of the run.
        presence: of this process in it.
        scenario: of the run.
        drones: whose cameras they are.
    """

    def __init__(
        self, link: Session, info: Info, presence: Presence, scenario: Scenario, drones: Sequence[str]
    ) -> None:
        self._link, self._info, self._presence = link, info, presence
        self._numbers = {drone.name: i for i, drone in enumerate(info.drones)}
        scene = scene_of(info, scenario)
        cameras = {drone.name: drone.sensors.cameras() for drone in scenario.drones}
        self._eyes = [self._eye(drone, name, each, scene) for drone in drones for name, each in cameras[drone].items()]
        longest_ns = max((eye.latency_ns for eye in self._eyes), default=0)
        self._behind_ns = BEHIND_MAX * info.gate_ns + info.command_delay_ns
        rotors = [len(drone.rotors) or ROTORS_MIN for drone in info.drones]
        external = {i: standing(drone, rotors[i]) for i, drone in enumerate(scenario.drones) if drone.is_external}
        self._truths = TruthHistory(len(info.drones), info.gate_ns, longest_ns + 2 * self._behind_ns, external)
        self._arrived: deque[RawSample | ReceivedSample] = deque()
        self._numbers_drawn = count()
        self._info_seq = 0
        self._begun = False
        self._done_ns = -1
        self._bell = Bell(link, presence)

    def _eye(self, drone: str, name: str, camera: Camera, scene: Scene) -> Eye:
        renderer = Renderer(camera, scene, self._numbers[drone], self._info.seed, f"{drone}/{name}")
        return Eye(drone, name, camera, renderer)

    def begin(self) -> None:
        """Subscribe to the truth, and tell what the pixels mean."""
        for eye in self._eyes:
            self._link.declare_queryable(eye.info_key, self._on_query)
        self._link.declare_subscriber(keys.truth("*"), self._on_truth)
        self._publish_infos()

    def join(self) -> None:
        """Let the world wait for this process.

        What is asked for may overtake what was published earlier: nothing is asked of a run that has yet to begin.
        """
        has_begun = bool(self._link.get(keys.truth("*"), timeout_s=ASK_S))
        self._presence.announce()
        if has_begun:
            self.catch_up()

    def turn(self) -> None:
        """Wait for something, and publish the pictures that are due."""
        self._bell.wait()
        if self._bell.is_back:
            self._bell.is_back = False
            self._publish_infos()
            self.catch_up()
        self.draw()

    def catch_up(self) -> None:
        """Ask for the newest truth where the world waits for this process: what it is to be done with has passed."""
        if self._presence.gates:
            self._arrived.extend(self._link.get(keys.truth("*"), timeout_s=ASK_S))
            self._bell.ring()

    def finish(self) -> None:
        """Publish the pictures that are due by the end of the run, of which the truth may still be on its way."""
        end_s = time.monotonic() + DRAIN_S
        self.draw()
        while self._truths.newest_ns < self._presence.now_ns and time.monotonic() < end_s:
            self._bell.wait()
            self.draw()
        time.sleep(OVERTAKING_S)

    def draw(self) -> None:
        """Publish the pictures that are due by what has arrived."""
        self._take_in()
        newest_ns = self._truths.newest_ns
        for eye, number in self._due():
            self._take_in()
            self._expose(eye, number)
        if newest_ns > self._done_ns:
            self._done_ns = newest_ns
            self._presence.done(newest_ns)

    # What arrives

    def _on_truth(self, sample: RawSample) -> None:
        self._arrived.append(sample)
        self._bell.ring()

    def _on_query(self, query: Query) -> None:
        """Answer with what is asked for; called in a thread of Zenoh's."""
        for eye in self._eyes:
            if keys.matches(query.expression, eye.info_key):
                query.reply(eye.info_key, messages.encode(self._message_of(eye)))
        query.end()

    def _take_in(self) -> None:
        health = self._presence.health
        while self._arrived:
            sample = self._arrived.popleft()
            number = self._numbers.get(keys.thing(sample.key))
            try:
                truth = messages.decode(sample.key, sample.payload)
            except DecodeError:
                health.refused += 1
                continue
            health.received += 1
            if number is not None:
                self._truths.add(number, truth)

    # What goes out

    def _due(self) -> list[tuple[Eye, int]]:
        """Return the pictures that are due, one of each camera after the other; those that are too old are counted.

        Of the cameras, the one whose last picture is longest ago is first: a process that is too slow for all of them
        leaves out some of each.
        """
        newest_ns = self._truths.newest_ns
        if newest_ns < 0:
            return []
        due: list[tuple[int, int, Eye]] = []
        for eye in self._eyes:
            last = eye.last_due(newest_ns)
            first = max(eye.next, eye.last_due(newest_ns - self._behind_ns) + 1)
            if self._begun:
                self._presence.health.dropped += max(0, first - eye.next)
            due += [(turn, number, eye) for turn, number in enumerate(range(first, last + 1))]
            eye.next = max(eye.next, last + 1)
        self._begun = True
        return [(eye, number) for _, number, eye in sorted(due, key=lambda each: (each[0], each[2].last))]

    def _expose(self, eye: Eye, number: int) -> None:
        """Draw and publish a picture, if it is not too late for it by now."""
        start_ns = time.perf_counter_ns()
        t_sample_ns = eye.exposure_ns(number)
        health = self._presence.health
        health.lag_ns = max(0, self._truths.newest_ns - t_sample_ns - eye.latency_ns)
        bodies = self._truths.bodies(t_sample_ns)
        if bodies is None or health.lag_ns > 2 * self._behind_ns:
            health.dropped += 1
            return
        image = CameraImage(
            t_ns=self._truths.newest_ns,
            seq=eye.seq,
            t_sample_ns=t_sample_ns,
            source=self._presence.name,
            width=eye.camera.width_px,
            height=eye.camera.height_px,
            data=eye.renderer.jpeg(number, t_sample_ns / 1e9, bodies),
        )
        eye.seq += 1
        eye.last = next(self._numbers_drawn)
        self._link.put(eye.key, image)
        health.step(time.perf_counter_ns() - start_ns)

    def _publish_infos(self) -> None:
        self._info_seq += 1
        for eye in self._eyes:
            self._link.put(eye.info_key, self._message_of(eye))

    def _message_of(self, eye: Eye) -> CameraInfo:
        t_ns = max(0, self._truths.newest_ns)
        return camera_info(eye.camera, self._presence.name, t_ns, self._info_seq, self._info.gate_ns)


def camera_info(camera: Camera, source: str, t_ns: int, seq: int, gate_ns: int) -> CameraInfo:
    """Return what a camera's pixels mean, for `drone/{d}/camera/{c}/info`."""
    lens, pose = lens_of(camera), camera_pose(camera)
    k = camera_matrix(lens).ravel().tolist()
    w, x, y, z = pose.q_BK
    px, py, pz = pose.p_BK.tolist()
    return CameraInfo(
        t_ns=t_ns,
        seq=seq,
        source=source,
        width=lens.width,
        height=lens.height,
        K=(k[0], k[1], k[2], k[3], k[4], k[5], k[6], k[7], k[8]),
        D=(lens.k1, lens.k2, lens.p1, lens.p2, lens.k3),
        position_m=(px, py, pz),
        orientation_wxyz=(w, x, y, z),
        rate_hz=camera.rate_hz,
        exposure_s=camera.exposure_ms * 1e-3,
        gate_ns=gate_ns,
    )


PENDING_MAX = 64  # gates of which the truth of a drone may be lacking


class TruthHistory:
    """The last gates of which the truth of every simulated drone is there.

    An external drone, whose driver may skip gates, is where its last pose leads to.

    Args:
        drones: how many there are.
        gate_ns: time between two gates.
        span_ns: how far back it reaches, at least.
        external: of the drones by their numbers, with where each stands until its driver publishes.
    """

    def __init__(self, drones: int, gate_ns: int, span_ns: int, external: Mapping[int, Truth] = {}) -> None:
        self._drones, self._gate_ns = drones, gate_ns
        self._external = dict(external)
        self._simulated = frozenset(range(drones)) - external.keys()
        self._kept = 2 + span_ns // gate_ns
        self._pending: dict[int, dict[int, Truth]] = {}
        self._whole: dict[int, list[Truth]] = {}  # by gate, in order
        self.newest_ns = -1

    def add(self, drone: int, truth: Truth) -> None:
        """Take the truth of a drone, by its number."""
        t_ns = truth.t_ns
        if drone in self._external:
            if truth_fault(truth, len(self._external[drone].rotor_rad_s)):
                return  # which the world refuses
            self._external[drone] = max(self._external[drone], truth, key=attrgetter("t_ns"))
        if t_ns <= self.newest_ns:
            return
        states = self._pending.setdefault(t_ns, {})
        states[drone] = truth
        if states.keys() >= self._simulated:
            self._whole[t_ns] = [states.get(i) or _at(self._external[i], t_ns) for i in range(self._drones)]
            self.newest_ns = t_ns
            self._pending = {t: left for t, left in self._pending.items() if t > t_ns}
            while len(self._whole) > self._kept:
                del self._whole[next(iter(self._whole))]
        elif len(self._pending) > PENDING_MAX:
            del self._pending[min(self._pending)]

    def bodies(self, t_ns: int) -> DroneStates | None:
        """Return all drones at an instant, or None where a gate beside it is lacking."""
        before_ns = t_ns // self._gate_ns * self._gate_ns
        before, after = self._whole.get(before_ns), self._whole.get(before_ns + self._gate_ns)
        if before is None:
            return None
        if t_ns == before_ns:
            after = before
        return None if after is None else _between((t_ns - before_ns) / 1e9, self._gate_ns / 1e9, before, after)


def standing(drone: Drone, rotors: int) -> Truth:
    """Return where the scenario puts a drone, its rotors at rest."""
    half = 0.5 * math.radians(drone.yaw_deg)
    still, q_WB = (0.0, 0.0, 0.0), (math.cos(half), 0.0, 0.0, math.sin(half))
    return Truth(0, 0, drone.position_m, still, q_WB, still, still, (0.0,) * rotors)


def _at(last: Truth, t_ns: int) -> Truth:
    """Return the truth at a gate of an external drone, by the last one of its driver."""
    return replace(last, t_ns=t_ns, position_m=moved_on(last.position_m, last.velocity_m_s, t_ns - last.t_ns))


def _between(t_s: float, gate_s: float, before: Sequence[Truth], after: Sequence[Truth]) -> DroneStates:
    share = t_s / gate_s
    poses = [
        pose_between(
            t_s,
            0.0,
            a.position_m,
            a.velocity_m_s,
            a.orientation_wxyz,
            gate_s,
            b.position_m,
            b.velocity_m_s,
            b.orientation_wxyz,
        )
        for a, b in zip(before, after, strict=True)
    ]
    rates = [
        _mean(a.angular_velocity_rad_s, b.angular_velocity_rad_s, share) for a, b in zip(before, after, strict=True)
    ]
    rotors = [_mean(a.rotor_rad_s, b.rotor_rad_s, share) for a, b in zip(before, after, strict=True)]
    p, v, q = (np.array([pose[k] for pose in poses]) for k in range(3))
    return DroneStates(p, v, q, np.array(rates), rotors)


def _mean(a: Sequence[float], b: Sequence[float], share: float) -> list[float]:
    return [x + share * (y - x) for x, y in zip(a, b, strict=True)]
