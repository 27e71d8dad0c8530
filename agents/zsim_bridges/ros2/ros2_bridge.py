"""The bridge between a run and ROS 2: topics, and subscriptions and services for commands.

A topic's sources are read and converted only while a ROS node subscribes to it, so that without ROS nodes, only a run's
clock is read. The bridge never makes the world wait.
"""

import math
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing
from functools import partial
from typing import Any, NamedTuple

from zsim.contract import keys, messages
from zsim.contract.flight_messages import CameraInfo
from zsim.contract.messages import Info
from zsim.errors import DecodeError, NoListenerError
from zsim.runtime.participant import Participant
from zsim.scenario import scenario_file
from zsim.transport import connection
from zsim.transport.session import RawSample, Session, Subscription
from zsim.transport.tls import Identity
from zsim_bridges import ros_messages as ros
from zsim_bridges.ros2 import rmw_zenoh, topics
from zsim_bridges.ros2.rmw_zenoh import Publisher, Ros2Node, RosContext, ros_names
from zsim_bridges.ros2.topics import DRIVER, DroneCameras, RosNames, Topic
from zsim_bridges.vehicle_links.drone_link import CommandSender, ModeName

NODE = "zsim"
POLL_S = 0.1  # period of checks for a stop request
STATUS_TIMEOUT_S = 1.0  # time limit for reading a drone's state
CONNECT_TIMEOUT_S = 1.0  # time limit of one attempt to connect to the ROS router
LAST_VALUE_TIMEOUT_S = 1.0  # time limit for reading a last value; the world answers within milliseconds
SAMPLES_MAX = 2000  # samples waiting to be converted, about a tenth of a second of work
EMPTY, TRIGGER = "std_msgs/msg/Empty", "std_srvs/srv/Trigger"
CLUSTER_SERVICES = ("takeoff", "engage", "hold", "rejoin", "land")
Say = Callable[[str], None]
QueuedTask = Callable[[], object]


class RosNetwork(NamedTuple):
    """How to reach ROS.

    Attributes:
        domain: ROS_DOMAIN_ID.
        router: endpoint of the ROS Zenoh router; None if the world's hub serves as the router.
        identity: identity for the connection to that router.
    """

    domain: int
    router: str | None
    identity: Identity


def serve(
    link: Session,
    info: Info,
    observer: Participant,
    stopped: Callable[[], bool],
    say: Say,
    network: RosNetwork,
    wall_ns: Callable[[], int],
) -> None:
    """Bridge one run to ROS until it is over, or `stopped` returns True.

    Raises:
        SessionError: the router's endpoint is malformed.
    """
    bridge = Ros2Bridge(link, info, observer, say, wall_ns)
    with ExitStack() as stack, closing(bridge):
        ros_link = link.unprefixed() if network.router is None else None
        is_advertised = False
        while not observer.end_reason and not stopped():
            if ros_link is None:
                assert network.router is not None
                try:
                    ros_link = stack.enter_context(
                        connection.connect(
                            network.router, "", wait_s=CONNECT_TIMEOUT_S, reader=True, identity=network.identity
                        )
                    )
                except NoListenerError:
                    waiting_text = f"no ROS router at {network.router} yet; waiting for one; start rmw_zenohd there"
                    bridge.report_once("router", waiting_text)
            if ros_link is not None and not is_advertised:
                bridge.advertise_run(RosContext(ros_link, network.domain, wall_ns, bridge.count_refused))
                say(f"{observer.name}: ROS domain {network.domain} via {network.router or 'the hub of the world'}")
                is_advertised = True
            bridge.process(POLL_S)


class Ros2Bridge:
    """The bridge of one run; everything except commands and services runs in the thread that calls `process`."""

    def __init__(self, link: Session, info: Info, observer: Participant, say: Say, wall_ns: Callable[[], int]) -> None:
        self._link = link
        self._observer = observer
        self._say = say
        self._wall_ns = wall_ns
        self._drones = scenario_file.from_text(info.scenario).drones
        self._queue = CallbackQueue(SAMPLES_MAX)
        self._publications: dict[str, BridgedTopic] = {}
        self._sources = SourceSubscriptions(link, self._queue, self._count_refused, info.mode == "realtime")
        self._reported: set[str] = set()
        self._domain = 0
        self.names = RosNames(
            ros_names((drone.name for drone in info.drones), "drone"),
            ros_names((cluster.name for cluster in info.clusters), "cluster"),
        )
        self._cleanups = [link.declare_subscriber(keys.CLOCK, self._on_clock)]

    def _on_clock(self, sample: RawSample) -> None:
        self._queue.add_task(partial(self._observer.update_clock, sample.payload))

    def process(self, timeout_s: float) -> None:
        """Execute queued tasks and convert samples; wait for the first up to `timeout_s`."""
        tasks, queued = self._queue.pop_all(timeout_s)
        start_ns = self._wall_ns()
        for task in tasks:
            task()
        converted = self._sources.convert_all(queued)
        health = self._observer.health
        if converted:
            health.step(self._wall_ns() - start_ns)
        health.received += converted
        health.dropped = self._queue.dropped + self._sources.dropped
        self._observer.tick()

    def close(self) -> None:
        self._sources.close()
        for cleanup in self._cleanups:
            cleanup()

    def count_refused(self, name: str, reason: str) -> None:
        """Count a refused message, and report it once per name; callable from any thread."""
        self._queue.add_task(partial(self._count_refused, name, reason))

    def _count_refused(self, name: str, reason: str) -> None:
        self._observer.health.refused += 1
        self.report_once(name, f"{name}: refused, {reason}; further ones are counted in {self._observer.name}'s health")

    def report_once(self, subject: str, text: str) -> None:
        if subject not in self._reported:
            self._reported.add(subject)
            self._say(f"{self._observer.name}: {text}")

    def advertise_run(self, context: RosContext) -> None:
        """Advertise the run's topics and services to ROS."""
        self._domain = context.domain
        commands = RosCommands(self._link, self._observer, self.names.drones)
        root = context.node("/", NODE)
        self._advertise(root, topics.run_topics(self.names))
        # Fixed frames are published only once; later subscribers receive them too.
        static = root.publisher("/tf_static", "tf2_msgs/msg/TFMessage", rmw_zenoh.TF_STATIC)
        names = self.names.drones
        frames = [frame for d in self._drones for frame in topics.static_transforms(names[d.name], d.sensors)]
        static.publish(ros.TFMessage(frames))
        sensors = {drone.name: drone.sensors for drone in self._drones}
        for drone, name in names.items():
            node = context.node(f"/{name}", NODE)
            self._advertise(node, topics.drone_topics(drone, name, sensors[drone]))
            cameras = DroneCameras(drone, name)
            self._advertise(node, cameras.topics())
            node.service(f"/{name}/{DRIVER}/togglecam", TRIGGER, cameras.toggle)
            callbacks: dict[str, tuple[str, Callable[..., None]]] = {
                "cmd_vel": ("geometry_msgs/msg/Twist", commands.send_velocity),
                "takeoff": (EMPTY, partial(commands.send_mode, "takeoff")),
                "land": (EMPTY, partial(commands.send_mode, "land")),
                "reset": (EMPTY, commands.toggle_emergency),
            }
            for leaf, (kind, command) in callbacks.items():
                callback = partial(command, drone)
                self._cleanups.append(node.subscription(f"/{name}/{leaf}", kind, rmw_zenoh.DEFAULT, callback))
            release = partial(commands.request, keys.CONTROL, "release", {"drone": drone})
            node.service(f"/{name}/release", TRIGGER, release)
        for cluster, name in self.names.clusters.items():
            node = context.node(f"/cluster/{name}", NODE)
            self._advertise(node, topics.cluster_topics(cluster, name))
            for op in CLUSTER_SERVICES:
                answer = partial(commands.request, keys.cluster_control(cluster), op, {})
                node.service(f"/cluster/{name}/{op}", TRIGGER, answer)
        context.on_subscription(
            lambda token, is_alive: self._queue.add_task(partial(self._on_subscription, token, is_alive))
        )
        for original, name in {**names, **self.names.clusters}.items():
            if original != name:
                self.report_once(original, f"{original} is called {name} in ROS, which does not allow the original")

    def _advertise(self, node: Ros2Node, run_topics: Iterator[Topic]) -> None:
        for topic in run_topics:
            self._publications[topic.name] = BridgedTopic(topic, node.publisher(topic.name, topic.kind, topic.qos))

    def _on_subscription(self, token: str, is_alive: bool) -> None:
        """Start or stop reading a topic's sources as ROS nodes subscribe or unsubscribe."""
        endpoint = rmw_zenoh.endpoint_of(token)
        publication = self._publications.get(endpoint.name) if endpoint else None
        if endpoint is None or publication is None:
            return
        if rmw_zenoh.data_key(self._domain, *endpoint[1:]) != publication.publisher.key:
            kind = publication.topic.kind
            self.report_once(token, f"{endpoint.name}: a subscriber expects {endpoint.type_name}; the type is {kind}")
            return
        readers, had_readers = publication.readers, bool(publication.readers)
        readers.add(token) if is_alive else readers.discard(token)
        if bool(readers) != had_readers:
            (self._sources.add if readers else self._sources.remove)(publication)


class RosCommands:
    """Sends commands in the bridge's name; called from several threads."""

    def __init__(self, link: Session, observer: Participant, drones: Iterable[str]) -> None:
        self._link = link
        self._observer = observer
        self._response = rmw_zenoh.message_class(f"{TRIGGER}_Response")
        self._senders = {drone: CommandSender(drone, observer.name, link.put) for drone in drones}
        self._lock = threading.Lock()

    def send_velocity(self, drone: str, twist: Any) -> None:
        """Command a Twist: forward, left, up [m/s] in the heading frame, and a counter-clockwise yaw rate [rad/s].

        Raises:
            ValueError: a component is not finite.
        """
        linear, yaw_rate = twist.linear, twist.angular.z
        v = float(linear.x), float(linear.y), float(linear.z)
        if not all(map(math.isfinite, (*v, yaw_rate))):
            raise ValueError(f"the velocity is {(*v, yaw_rate)}; must be finite")
        with self._lock:
            self._senders[drone].send_velocity(self._observer.now_ns, v, float(yaw_rate), "heading")

    def send_mode(self, mode: ModeName, drone: str, _: Any = None) -> None:
        with self._lock:
            self._senders[drone].send_mode(self._observer.now_ns, mode)

    def toggle_emergency(self, drone: str, _: Any) -> None:
        """Stop the rotors at once, or reset a drone whose rotors were stopped, like the aircraft's emergency button.

        Raises:
            ValueError: the drone's state is unknown.
        """
        key = keys.status(drone)
        sample = next(iter(self._link.get(key, timeout_s=STATUS_TIMEOUT_S)), None)
        if sample is None:
            raise ValueError(f"the state of {drone} is not known: the world does not answer")
        try:
            state = messages.decode(key, sample.payload).state
        except DecodeError as error:
            raise ValueError(str(error)) from error
        self.send_mode("reset" if state == "emergency" else "emergency", drone)

    def request(self, key: str, op: str, args: dict[str, Any], _: Any) -> Any:
        """Send a control request on behalf of a service without arguments; return the service's response."""
        answer = self._link.request(key, op, self._observer.name, args)
        return self._response(answer.ok, answer.error)


class CallbackQueue:
    """A queue from Zenoh's threads to the bridge's, of all tasks and the newest `limit` samples; adding never waits."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._tasks: list[QueuedTask] = []
        self._samples: deque[tuple[str, bytes]] = deque()
        self._condition = threading.Condition()
        self.dropped = 0

    def add_task(self, task: QueuedTask) -> None:
        with self._condition:
            self._tasks.append(task)
            self._condition.notify()

    def add_sample(self, key: str, payload: bytes) -> None:
        with self._condition:
            if len(self._samples) >= self._limit:
                self._samples.popleft()
                self.dropped += 1
            self._samples.append((key, payload))
            self._condition.notify()

    def pop_all(self, timeout_s: float) -> tuple[list[QueuedTask], list[tuple[str, bytes]]]:
        """Return all tasks and samples, waiting up to `timeout_s` for the first."""
        with self._condition:
            if not self._tasks and not self._samples:
                self._condition.wait(timeout_s)
            tasks, samples = self._tasks, list(self._samples)
            self._tasks = []
            self._samples.clear()
        return tasks, samples


class BridgedTopic:
    """A topic of the bridge, with its publisher and the tokens of its subscribers."""

    def __init__(self, topic: Topic, publisher: Publisher) -> None:
        self.topic = topic
        self.publisher = publisher
        self.readers: set[str] = set()


class SourceSubscription(NamedTuple):
    """The subscription to a key, and the topics that use it; samples are queued unless they are polled."""

    readers: list[BridgedTopic]
    close: Callable[[], None]
    polled: Subscription | None = None


class SourceSubscriptions:
    """The run's keys that are read for ROS: each once, while a ROS node subscribes to a topic that uses it.

    Args:
        refuse: called with a key or topic, and the reason why a message cannot be converted.
        is_prompt: whether estimates and cluster states are converted on arrival, rather than with the next clock:
            waking up for each message costs more than converting it, and only in realtime does a gate take long.
    """

    def __init__(
        self, link: Session, queue: CallbackQueue, refuse: Callable[[str, str], None], is_prompt: bool
    ) -> None:
        self._link = link
        self._queue = queue
        self._refuse = refuse
        self._is_prompt = is_prompt
        self._by_key: dict[str, SourceSubscription] = {}
        self.dropped = 0

    def add(self, publication: BridgedTopic) -> None:
        for key in publication.topic.sources:
            if key not in self._by_key:
                self._by_key[key] = self._open_source(key)
            self._by_key[key].readers.append(publication)

    def _open_source(self, key: str) -> SourceSubscription:
        """Subscribe to a key. The world's messages arrive before its clock; others arrive at any time."""
        if self._is_prompt and keys.leaf(key) in ("estimate", "state"):
            return SourceSubscription([], self._link.declare_subscriber(key, self._on_sample))
        subscription = self._link.subscribe(key)
        if messages.type_of(key) is CameraInfo:  # published only once, before this subscription
            for sample in self._link.get(key, timeout_s=LAST_VALUE_TIMEOUT_S):
                self._queue.add_sample(sample.key, sample.payload)
        return SourceSubscription([], subscription.undeclare, subscription)

    def _on_sample(self, sample: RawSample) -> None:
        if sample.payload:
            self._queue.add_sample(sample.key, sample.payload)

    def remove(self, publication: BridgedTopic) -> None:
        """Unsubscribe from the keys that only this topic uses."""
        for key in publication.topic.sources:
            source = self._by_key[key]
            source.readers.remove(publication)
            if not source.readers:
                source.close()
                del self._by_key[key]

    def close(self) -> None:
        for source in self._by_key.values():
            source.close()

    def convert_all(self, queued: Sequence[tuple[str, bytes]]) -> int:
        """Convert and publish queued and polled samples in chronological order; return their number.

        If there are too many polled samples of a key, only the newest are converted.
        """
        received = list(queued)
        for source in self._by_key.values():
            if source.polled:
                samples = list(source.polled.drain())
                self.dropped += max(0, len(samples) - SAMPLES_MAX)
                received += samples[-SAMPLES_MAX:]
        decoded: list[tuple[str, Any]] = []
        for key, payload in received:
            if key in self._by_key:
                try:
                    decoded.append((key, messages.decode(key, payload)))
                except DecodeError as error:
                    self._refuse(key, messages.fault_at(key, error))
        decoded.sort(key=lambda entry: (entry[1].t_ns, keys.is_status(entry[0])))  # the status last, as from the world
        for key, message in decoded:
            for publication in self._by_key[key].readers:
                try:
                    converted = publication.topic.convert(key, message)
                    if converted is not None:
                        publication.publisher.publish(converted)
                except (ValueError, OverflowError) as error:  # numbers out of range for the ROS type
                    self._refuse(publication.topic.name, f"{key} does not fit it ({error})")
        return len(received)
