"""The bridge between a run and ROS 2: topics, and subscriptions and services for commands.

A topic is converted only while a ROS node subscribes to it, and only then is its source read: a run without ROS nodes
costs its clock alone. The bridge never makes the world wait.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from functools import partial
from itertools import chain
from threading import Lock
from typing import Any, NamedTuple

from zsim.contract import keys, messages
from zsim.contract.flight_messages import Mode, Velocity
from zsim.contract.messages import Info
from zsim.errors import DecodeError, SessionError
from zsim.runtime.participant import Participant
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim.transport import connection
from zsim.transport.session import RawSample, Session
from zsim.transport.tls import Identity
from zsim_bridges.ros2 import conversions, rmw_zenoh, topics
from zsim_bridges.ros2.drone_cameras import DRIVER, DroneCameras
from zsim_bridges.ros2.rmw_zenoh import Ros2Node, RosContext, ros_names
from zsim_bridges.ros2.ros_types import RosTypes
from zsim_bridges.ros2.source_keys import SAMPLES_MAX, BridgedTopic, CallbackQueue, SourceSubscriptions
from zsim_bridges.ros2.topics import RosNames, Topic

NODE = "zsim"
POLL_S = 0.1  # how often a stop is checked
STATUS_S = 1.0  # how long a drone's state is waited for
ATTEMPT_S = 1.0  # of connecting to ROS's router
TRIGGER = "std_srvs/srv/Trigger"
CLUSTER_SERVICES = ("takeoff", "engage", "hold", "rejoin", "land")
Say = Callable[[str], None]


class RosNetwork(NamedTuple):
    """How to reach ROS.

    Attributes:
        domain: ROS_DOMAIN_ID.
        router: endpoint of ROS's own Zenoh router; None where the world's hub is its router.
        identity: for the connection to that router.
    """

    domain: int
    router: str | None
    identity: Identity


class RosCommands:
    """Sends commands in the bridge's name; called in several threads.

    Args:
        link: to the world.
        observer: for the name, and the time of the newest gate.
        response: class of std_srvs/Trigger_Response.
    """

    def __init__(self, link: Session, observer: Participant, response: Any) -> None:
        self._link = link
        self._observer = observer
        self._response = response
        self._sent: Counter[str] = Counter()  # commands, by key
        self._lock = Lock()

    def send_velocity(self, drone: str, twist: Any) -> None:
        """Fly a Twist: forward, left, up [m/s] in the heading frame, and counter-clockwise [rad/s].

        Raises:
            ValueError: a number is not finite.
        """
        linear, turn = twist.linear, twist.angular.z
        v = float(linear.x), float(linear.y), float(linear.z)
        if not all(map(math.isfinite, (*v, turn))):
            raise ValueError(f"the velocity is {(*v, turn)}; must be finite")
        key = keys.command(drone, "velocity")
        with self._lock:
            self._link.put(key, Velocity(*self._next_stamp(key), self._observer.name, v, float(turn)))

    def send_mode(self, drone: str, mode: Any) -> None:
        """Let a drone take off, land, stop at once or leave the emergency."""
        key = keys.command(drone, "mode")
        with self._lock:
            self._link.put(key, Mode(*self._next_stamp(key), self._observer.name, mode))

    def toggle_emergency(self, drone: str) -> None:
        """Stop the rotors at once, or, where that has happened, make ready to fly: the aircraft's emergency button.

        Raises:
            ValueError: the drone's state is not known.
        """
        self.send_mode(drone, "reset" if self._state(drone) == "emergency" else "emergency")

    def _state(self, drone: str) -> str:
        key = keys.status(drone)
        for sample in self._link.get(key, timeout_s=STATUS_S):
            try:
                return messages.decode(key, sample.payload).state
            except DecodeError as error:
                raise ValueError(str(error)) from error
        raise ValueError(f"the state of {drone} is not known: the world does not answer")

    def _next_stamp(self, key: str) -> tuple[int, int]:
        """Return t_ns and seq of the next command on a key."""
        self._sent[key] += 1
        return self._observer.now_ns, self._sent[key] - 1

    def request(self, key: str, op: str, args: dict[str, Any], _: Any) -> Any:
        """Send a control request for a service whose own request is empty; return the response."""
        answer = self._link.request(key, op, self._observer.name, args)
        return self._response(answer.ok, answer.error)


class Ros2Bridge:
    """The bridge of one run; everything but commands and services happens in the thread that calls `process`.

    Args:
        link: to the world.
        info: of the run.
        observer: of this process in the run.
        say: prints a line, each once.
        wall_ns: time since 1970.
    """

    def __init__(self, link: Session, info: Info, observer: Participant, say: Say, wall_ns: Callable[[], int]) -> None:
        self._link = link
        self._observer = observer
        self._say = say
        self._wall_ns = wall_ns
        self._scenario: Scenario = scenario_file.from_text(info.scenario)
        self._queue = CallbackQueue(SAMPLES_MAX)
        self._publications: dict[str, BridgedTopic] = {}
        self._sources = SourceSubscriptions(link, self._queue, self._count_refused, info.mode == "realtime")
        self._reported: set[str] = set()
        self._cleanups: list[Callable[[], None]] = []
        self._domain = 0
        self.names = RosNames(
            ros_names((drone.name for drone in info.drones), "drone"),
            ros_names((cluster.name for cluster in info.clusters), "cluster"),
        )
        self._cleanups.append(link.declare_subscriber(keys.CLOCK, self._on_clock))

    def _on_clock(self, sample: RawSample) -> None:
        self._queue.add_task(partial(self._observer.update_clock, sample.payload))

    def process(self, within_s: float) -> None:
        """Execute queued tasks and convert samples; wait for some."""
        work = self._queue.pop_all(within_s)
        start_ns = self._wall_ns()
        for task in work.tasks:
            task()
        converted = self._sources.convert_all(work.samples)
        health = self._observer.health
        if converted:
            health.step(self._wall_ns() - start_ns)
        health.received += converted
        health.dropped = self._queue.dropped + self._sources.dropped
        self._observer.tick()

    def close(self) -> None:
        """Close all subscriptions."""
        self._sources.close()
        for close in self._cleanups:
            close()

    def count_refused(self, name: str, reason: str) -> None:
        """Count a message that is refused, and report it once for each name; callable from any thread."""
        self._queue.add_task(partial(self._count_refused, name, reason))

    def _count_refused(self, name: str, reason: str) -> None:
        self._observer.health.refused += 1
        self.report_once(name, f"{name}: refused, {reason}; further ones are counted in {self._observer.name}'s health")

    def report_once(self, subject: str, text: str) -> None:
        if subject not in self._reported:
            self._reported.add(subject)
            self._say(f"{self._observer.name}: {text}")

    # Advertised to ROS

    def advertise_run(self, ros: RosContext) -> None:
        """Advertise the run's topics and services."""
        self._domain, types = ros.domain, ros.types
        response = types.message_class("std_srvs/srv/Trigger_Response")
        commands = RosCommands(self._link, self._observer, response)
        sensors = {drone.name: drone.sensors for drone in self._scenario.drones}
        root = ros.node("/", NODE)
        self._advertise(root, topics.run_topics(self.names))
        self._publish_static_frames(root)
        for drone, name in self.names.drones.items():
            node = ros.node(f"/{name}", NODE)
            self._advertise(node, topics.drone_topics(drone, name, sensors[drone], types))
            cameras = DroneCameras(drone, name)
            self._advertise(node, cameras.topics())
            node.service(f"/{name}/{DRIVER}/togglecam", TRIGGER, partial(cameras.toggle, response))
            self._accept_commands(node, drone, name, commands)
        for cluster, name in self.names.clusters.items():
            node = ros.node(f"/cluster/{name}", NODE)
            self._advertise(node, topics.cluster_topics(cluster, name, types))
            for op in CLUSTER_SERVICES:
                answer = partial(commands.request, keys.cluster_control(cluster), op, {})
                node.service(f"/cluster/{name}/{op}", TRIGGER, answer)
        ros.on_subscription(lambda token, alive: self._queue.add_task(partial(self._on_subscription, token, alive)))
        self._report_names()

    def _advertise(self, node: Ros2Node, run_topics: Iterator[Topic]) -> None:
        for topic in run_topics:
            self._publications[topic.name] = BridgedTopic(topic, node.publisher(topic.name, topic.kind, topic.qos))

    def _accept_commands(self, node: Ros2Node, drone: str, name: str, commands: RosCommands) -> None:
        """Subscribe to a drone's commands."""
        empty = "std_msgs/msg/Empty"
        callbacks: dict[str, tuple[str, Callable[[Any], None]]] = {
            "cmd_vel": ("geometry_msgs/msg/Twist", partial(commands.send_velocity, drone)),
            "takeoff": (empty, lambda _: commands.send_mode(drone, "takeoff")),
            "land": (empty, lambda _: commands.send_mode(drone, "land")),
            "reset": (empty, lambda _: commands.toggle_emergency(drone)),
        }
        for leaf, (kind, act) in callbacks.items():
            self._cleanups.append(node.subscription(f"/{name}/{leaf}", kind, rmw_zenoh.DEFAULT, act))
        node.service(f"/{name}/release", TRIGGER, partial(commands.request, keys.CONTROL, "release", {"drone": drone}))

    def _publish_static_frames(self, node: Ros2Node) -> None:
        """Publish the frames that never move, once for all, later subscribers too."""
        publisher = node.publisher("/tf_static", "tf2_msgs/msg/TFMessage", rmw_zenoh.TF_STATIC)
        frames = (conversions.static_frames(self.names.drones[d.name], d.sensors) for d in self._scenario.drones)
        publisher.publish(conversions.transforms(0, list(chain.from_iterable(frames))))

    def _report_names(self) -> None:
        for name, ros in {**self.names.drones, **self.names.clusters}.items():
            if name != ros:
                self.report_once(name, f"{name} is {ros} in ROS, which takes no such name")

    # Subscriptions of ROS nodes

    def _on_subscription(self, token: str, alive: bool) -> None:
        endpoint = rmw_zenoh.endpoint_of(token)
        publication = self._publications.get(endpoint.name) if endpoint else None
        if endpoint is None or publication is None:
            return
        if endpoint.key(self._domain) != publication.publisher.key:
            kind = publication.topic.kind
            self.report_once(token, f"{endpoint.name}: somebody subscribes to {endpoint.type_name}; it is {kind}")
            return
        readers, had_readers = publication.readers, bool(publication.readers)
        readers.add(token) if alive else readers.discard(token)
        if bool(readers) != had_readers:
            (self._sources.add if readers else self._sources.remove)(publication)


def serve(
    link: Session,
    info: Info,
    observer: Participant,
    stopped: Callable[[], bool],
    say: Say,
    network: RosNetwork,
    wall_ns: Callable[[], int],
) -> None:
    """Bridge one run to ROS, until it is over or `stopped` returns true.

    Raises:
        SessionError: the router's endpoint is malformed.
    """
    bridge = Ros2Bridge(link, info, observer, say, wall_ns)
    with ExitStack() as stack, closing(bridge):
        ros_link = link.unprefixed() if network.router is None else None
        entered = False
        while not observer.end_reason and not stopped():
            ros_link = ros_link or _connect(stack, network, bridge)
            if ros_link is not None and not entered:
                bridge.advertise_run(RosContext(ros_link, network.domain, RosTypes(), wall_ns, bridge.count_refused))
                say(f"{observer.name}: ROS domain {network.domain} by {network.router or 'the hub of the world'}")
                entered = True
            bridge.process(POLL_S)


def _connect(stack: ExitStack, network: RosNetwork, bridge: Ros2Bridge) -> Session | None:
    """Return a session with ROS's router, None where it does not listen yet."""
    assert network.router is not None
    try:
        return stack.enter_context(
            connection.connect(network.router, "", wait_s=ATTEMPT_S, reader=True, identity=network.identity)
        )
    except SessionError as error:
        if "nobody listens" not in str(error):
            raise
        bridge.report_once(
            "router", f"no router of ROS on {network.router} yet, waiting for it; start rmw_zenohd there"
        )
        return None
