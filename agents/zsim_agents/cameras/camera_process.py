"""The cameras of one or several drones as a process: draws what they see, from the truth, and publishes it.

When it is too slow it leaves pictures out, and counts them; where the scenario lets cameras gate, the run waits.
"""

import time
from collections import deque
from collections.abc import Callable, Sequence
from itertools import count

from zsim.contract import keys, messages
from zsim.contract.flight_messages import CameraImage, CameraInfo
from zsim.contract.messages import Info
from zsim.contract.run_messages import RUN_ENDED
from zsim.errors import DecodeError
from zsim.scenario.scenario import Scenario
from zsim.sensors.camera import Camera
from zsim.sensors.camera_model import camera_matrix, camera_pose, lens_of
from zsim.transport.session import Query, RawSample, ReceivedSample, Session
from zsim.vehicles.vehicle import ROTORS_MIN
from zsim_agents.cameras.presence import Bell, Presence
from zsim_agents.cameras.rendering.renderer import Renderer
from zsim_agents.cameras.rendering.scene import Scene, scene_of
from zsim_agents.cameras.truths import TruthHistory, standing

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
