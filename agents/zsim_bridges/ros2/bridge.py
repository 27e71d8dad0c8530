"""The bridge between a run and ROS 2: topics of what is told, subscriptions and services for what is asked.

A topic is converted only while a ROS node subscribes to it, and only then is its source read: a run without ROS nodes
pays for its clock alone. Nothing here is waited for.
"""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from functools import partial
from typing import Any, NamedTuple

from zsim.contract import keys
from zsim.contract.messages import Info
from zsim.errors import SessionError
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim.transport import session
from zsim.transport.session import Heard, Session
from zsim.transport.tls import Identity
from zsim_bridges.observer_process import Presence
from zsim_bridges.ros2 import conversions, rmw_zenoh, sensor_frames, topics
from zsim_bridges.ros2.callback_queue import Inbox
from zsim_bridges.ros2.commands import Commands
from zsim_bridges.ros2.participant import Node, Participant
from zsim_bridges.ros2.ros_names import ros_names
from zsim_bridges.ros2.ros_types import Types
from zsim_bridges.ros2.source_keys import SAMPLES_MAX, Feeds, Publication
from zsim_bridges.ros2.topics import Names, Topic

NODE = "zsim"
POLL_S = 0.1  # how often a stop is looked for
ATTEMPT_S = 1.0  # of connecting to ROS's router
TRIGGER = "std_srvs/srv/Trigger"
CLUSTER_SERVICES = ("takeoff", "engage", "hold", "land")
Say = Callable[[str], None]


class Door(NamedTuple):
    """Where ROS is.

    Attributes:
        domain: ROS_DOMAIN_ID.
        router: endpoint of ROS's own Zenoh router; None where the world's hub is its router.
        identity: for the connection to that router.
    """

    domain: int
    router: str | None
    identity: Identity


class Bridge:
    """One run's worth of it; everything but commands and services happens in the thread that calls `turn`.

    Args:
        link: to the world.
        info: of the run.
        presence: of this process in the run.
        say: told what a person should know, each thing once.
        wall_ns: time since 1970.
    """

    def __init__(self, link: Session, info: Info, presence: Presence, say: Say, wall_ns: Callable[[], int]) -> None:
        self._link = link
        self._presence = presence
        self._say = say
        self._wall_ns = wall_ns
        self._scenario: Scenario = scenario_file.from_text(info.scenario)
        self._inbox = Inbox(SAMPLES_MAX)
        self._publications: dict[str, Publication] = {}
        self._feeds = Feeds(link, self._inbox, self._refuse, info.mode == "realtime")
        self._said: set[str] = set()
        self._ends: list[Callable[[], None]] = []
        self._domain = 0
        self.names = Names(
            ros_names((drone.name for drone in info.drones), "drone"),
            ros_names((cluster.name for cluster in info.clusters), "cluster"),
        )
        self._ends.append(link.hear(keys.CLOCK, self._on_clock))

    def _on_clock(self, heard: Heard) -> None:
        self._inbox.act(partial(self._presence.heed, heard.payload))

    def turn(self, within_s: float) -> None:
        """Do what there is to do, waiting for something."""
        taken = self._inbox.take(within_s)
        start_ns = self._wall_ns()
        for act in taken.acts:
            act()
        passed = self._feeds.pass_on(taken.samples)
        health = self._presence.health
        if passed:
            health.step(self._wall_ns() - start_ns)
        health.received += passed
        health.dropped = self._inbox.dropped + self._feeds.dropped
        self._presence.tick()

    def close(self) -> None:
        """Hear nothing any more."""
        self._feeds.close()
        for end in self._ends:
            end()

    def refuse(self, where: str, why: str) -> None:
        """Count what others sent in vain, and say so once for each name; callable from any thread."""
        self._inbox.act(partial(self._refuse, where, why))

    def _refuse(self, where: str, why: str) -> None:
        self._presence.health.refused += 1
        self.say_once(where, f"{where}: refused, {why}; further ones are counted in {self._presence.name}'s health")

    def say_once(self, about: str, text: str) -> None:
        if about not in self._said:
            self._said.add(about)
            self._say(f"{self._presence.name}: {text}")

    # What ROS sees

    def enter(self, ros: Participant) -> None:
        """Show the run to ROS."""
        self._domain = ros.domain
        types = ros.types
        commands = Commands(self._link, self._presence, types.of("std_srvs/srv/Trigger_Response"))
        sensors = {drone.name: drone.sensors for drone in self._scenario.drones}
        root = ros.node("/", NODE)
        self._offer(root, topics.of_run(self.names))
        self._place(root)
        for drone, name in self.names.drones.items():
            node = ros.node(f"/{name}", NODE)
            self._offer(node, topics.of_drone(drone, name, sensors[drone], types))
            self._obey(node, drone, name, commands)
        for cluster, name in self.names.clusters.items():
            node = ros.node(f"/cluster/{name}", NODE)
            self._offer(node, topics.of_cluster(cluster, name, types))
            for op in CLUSTER_SERVICES:
                node.service(f"/cluster/{name}/{op}", TRIGGER, _asking(commands.cluster, cluster, op))
        ros.on_subscription(lambda token, alive: self._inbox.act(partial(self._on_reader, token, alive)))
        self._say_names()

    def _offer(self, node: Node, offered: Iterator[Topic]) -> None:
        for topic in offered:
            publisher = node.publisher(topic.name, topic.kind, topic.qos)
            self._publications[topic.name] = Publication(topic, publisher)

    def _obey(self, node: Node, drone: str, name: str, commands: Commands) -> None:
        """Take a drone's commands."""
        empty = "std_msgs/msg/Empty"
        taken: dict[str, tuple[str, Callable[[Any], None]]] = {
            "cmd_vel": ("geometry_msgs/msg/Twist", partial(commands.velocity, drone)),
            "takeoff": (empty, lambda _: commands.mode(drone, "takeoff")),
            "land": (empty, lambda _: commands.mode(drone, "land")),
            "reset": (empty, lambda _: commands.reset(drone)),
        }
        for leaf, (kind, act) in taken.items():
            self._ends.append(node.subscription(f"/{name}/{leaf}", kind, rmw_zenoh.DEFAULT, act))
        node.service(f"/{name}/release", TRIGGER, _asking(commands.release, drone))

    def _place(self, node: Node) -> None:
        """Tell once, for all that come later too, where the frames are that never move."""
        publisher = node.publisher("/tf_static", "tf2_msgs/msg/TFMessage", rmw_zenoh.TF_STATIC)
        placed = [
            pose for d in self._scenario.drones for pose in sensor_frames.fixed(self.names.drones[d.name], d.sensors)
        ]
        publisher.publish(conversions.transforms(0, placed))

    def _say_names(self) -> None:
        for name, ros in {**self.names.drones, **self.names.clusters}.items():
            if name != ros:
                self.say_once(name, f"{name} is {ros} in ROS, which takes no such name")

    # What ROS subscribes to

    def _on_reader(self, token: str, alive: bool) -> None:
        endpoint = rmw_zenoh.endpoint_of(token)
        publication = self._publications.get(endpoint.name) if endpoint else None
        if endpoint is None or publication is None:
            return
        if endpoint.key(self._domain) != publication.publisher.key:
            kind = publication.topic.kind
            self.say_once(token, f"{endpoint.name}: somebody subscribes to {endpoint.type_name}; it is {kind}")
            return
        readers, had = publication.readers, bool(publication.readers)
        readers.add(token) if alive else readers.discard(token)
        if bool(readers) != had:
            (self._feeds.start if readers else self._feeds.end)(publication)


def _asking(ask: Callable[..., Any], *about: str) -> Callable[[Any], Any]:
    """Return what answers an empty request."""
    return lambda _: ask(*about)


def serve(
    link: Session,
    info: Info,
    presence: Presence,
    stopped: Callable[[], bool],
    say: Say,
    door: Door,
    wall_ns: Callable[[], int],
) -> None:
    """Bridge one run to ROS, until it is over or it is told to stop.

    Raises:
        SessionError: the router's endpoint is malformed.
    """
    bridge = Bridge(link, info, presence, say, wall_ns)
    with ExitStack() as stack, closing(bridge):
        ros_link = link.bare() if door.router is None else None
        entered = False
        while not presence.over and not stopped():
            ros_link = ros_link or _reach(stack, door, bridge)
            if ros_link is not None and not entered:
                bridge.enter(Participant(ros_link, door.domain, Types(), wall_ns, bridge.refuse))
                say(f"{presence.name}: ROS domain {door.domain} by {door.router or 'the hub of the world'}")
                entered = True
            bridge.turn(POLL_S)


def _reach(stack: ExitStack, door: Door, bridge: Bridge) -> Session | None:
    """Return a session with ROS's router, None where nobody listens yet."""
    assert door.router is not None
    try:
        return stack.enter_context(
            session.connect(door.router, "", wait_s=ATTEMPT_S, reader=True, identity=door.identity)
        )
    except SessionError as error:
        if "nobody listens" not in str(error):
            raise
        bridge.say_once("router", f"no router of ROS on {door.router} yet, waiting for it; start rmw_zenohd there")
        return None
