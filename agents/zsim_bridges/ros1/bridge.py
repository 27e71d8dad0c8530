"""The bridge as a process: one run's drones in the graph of a ROS 1 master; it commands, and never gates."""

import asyncio
import contextlib
from collections.abc import Callable, Iterable
from typing import Any

from zsim.contract import keys, messages
from zsim.contract.messages import Info
from zsim.errors import DecodeError, RunError
from zsim.scenario import scenario_file
from zsim.transport.session import Session
from zsim_bridges import ros_frames
from zsim_bridges.observer_process import Presence
from zsim_bridges.ros1 import conversions
from zsim_bridges.ros1.drone_topics import QUEUE, DroneTopics
from zsim_bridges.ros1.intake import Intake
from zsim_bridges.ros1.onboard import warm_up
from zsim_bridges.ros1.wire.node import Node

POLL_S = 0.1  # how often a stop is looked for
TOLD_MAX = 1000  # refusals remembered, so that each is told once
Say = Callable[[str], None]


class DismissedError(RunError):
    """A ROS node, or the master, asked this node to stop."""


def serve(
    link: Session,
    info: Info,
    presence: Presence,
    stopped: Callable[[], bool],
    say: Say,
    master_uri: str,
    host: str,
) -> None:
    """Serve one run until it is over.

    Args:
        link: an open session.
        info: of the run.
        presence: of this process in it.
        stopped: asked now and then; True ends it.
        say: told what a person should know.
        master_uri: of the ROS master.
        host: name or address under which ROS nodes reach us.

    Raises:
        DismissedError: ROS asked this node to stop.
        RunError: two drones have the same name in ROS.
    """
    warm_up()
    node = Node(f"/{ros_frames.graph_name(info.federation)}", master_uri, host, say)
    asyncio.run(Bridge(link, info, presence, node, say).run(stopped))
    if node.dismissed:
        presence.leave(node.dismissed)
        raise DismissedError(f"{presence.name}: {node.dismissed}")


class Bridge:
    """One run in one ROS graph."""

    def __init__(self, link: Session, info: Info, presence: Presence, node: Node, say: Say) -> None:
        self._link = link
        self._info = info
        self._presence = presence
        self._node = node
        self._say = say
        self._told: set[str] = set()
        self._clock = node.publish("/clock", "rosgraph_msgs/Clock", QUEUE)
        tf = node.publish("/tf", "tf2_msgs/TFMessage", QUEUE * len(info.drones))
        check_names(drone.name for drone in info.drones)
        drones = scenario_file.from_text(info.scenario).drones
        self._drones = {drone.name: DroneTopics(node, drone, presence.name, link.put, tf) for drone in drones}

    async def run(self, stopped: Callable[[], bool]) -> None:
        """Pass on both ways until the run is over, or we are to stop."""
        intake = Intake(self._link, self._info, self._presence.health, asyncio.get_running_loop())
        try:
            async with self._node.running():
                while not (stopped() or self._presence.over or self._node.dismissed):
                    with contextlib.suppress(TimeoutError):
                        await asyncio.wait_for(intake.news.wait(), POLL_S)
                    await self._pass_on(intake)
                    self._presence.tick()
        finally:
            intake.close()

    async def _pass_on(self, intake: Intake) -> None:
        for arrived in intake.arrivals():
            for key, payload in arrived:
                self.hear(key, payload)
            await asyncio.sleep(0)  # let connections have their turn

    def hear(self, key: str, payload: bytes) -> None:
        """Take what has passed the world, and pass on what follows from it."""
        kind, whose, what = keys.parts(key)
        if key == keys.CLOCK:
            self._on_clock(payload)
        elif key == keys.EVENT:
            self._on_event(payload)
        elif kind == "drone" and whose in self._drones and not what.startswith("cmd/"):
            self._hear_of(whose, key, payload)

    def _hear_of(self, drone: str, key: str, payload: bytes) -> None:
        message = self._decoded(key, payload)
        if message is None:
            return
        try:
            self._drones[drone].hear(message)
        except (ValueError, ArithmeticError) as error:  # finite, but beyond what a field of ROS can hold
            self._presence.health.refused += 1
            self._tell(f"{key}: {error}")

    def _decoded(self, key: str, payload: bytes) -> Any:
        try:
            return messages.decode(key, payload)
        except DecodeError:
            self._presence.health.refused += 1
            return None

    def _on_clock(self, payload: bytes) -> None:
        self._presence.heed(payload)
        clock = self._decoded(keys.CLOCK, payload)
        if clock is not None:
            self._clock.publish(lambda _: conversions.clock(clock))

    def _on_event(self, payload: bytes) -> None:
        """Tell what the world refuses of what ROS nodes ask."""
        event = self._decoded(keys.EVENT, payload)
        if event is None or (event.kind, event.source) != ("refused", self._presence.name):
            return
        self._tell(f"{event.subject}: {event.data.get('reason', event.text)}")

    def _tell(self, reason: str) -> None:
        """Say something once."""
        if reason not in self._told and len(self._told) < TOLD_MAX:
            self._told.add(reason)
            self._say(f"{self._presence.name}: {reason}")


def check_names(drones: Iterable[str]) -> None:
    """Refuse drones that ROS cannot tell from each other.

    Raises:
        RunError: two have the same name there.
    """
    found: dict[str, str] = {}
    for drone in drones:
        name = ros_frames.graph_name(drone)
        if name in found:
            raise RunError(f"drones {found[name]!r} and {drone!r} are both {name!r} in ROS; rename one")
        found[name] = drone
