"""The slave API of a node: what the master and other nodes ask it by XML-RPC (wiki.ros.org/ROS/Slave_API)."""

import os
from collections.abc import Callable, Mapping
from typing import Any

from zsim_bridges.ros1.wire.publisher import PublishedTopic
from zsim_bridges.ros1.wire.subscriber import SubscribedTopic

Answer = list[Any]
OK, ERROR, REFUSED = 1, -1, 0


class SlaveApi:
    """Called in threads of the XML-RPC server.

    Args:
        name: of the node.
        master_uri: of its master.
        door: host and port where TCPROS connections come in.
        published, subscribed: by topic.
        update: takes a topic and those who publish it now.
        shutdown: takes who asks us to stop, and why.
    """

    def __init__(
        self,
        name: str,
        master_uri: str,
        door: tuple[str, int],
        published: Mapping[str, PublishedTopic],
        subscribed: Mapping[str, SubscribedTopic],
        update: Callable[[str, list[str]], None],
        shutdown: Callable[[str], None],
    ) -> None:
        self._name = name
        self._master_uri = master_uri
        self._published = published
        self._subscribed = subscribed
        self._update = update
        self._shutdown = shutdown
        self._tcpros_address = door

    def getName(self, caller: str) -> Answer:
        return [OK, "", self._name]

    def getMasterUri(self, caller: str) -> Answer:
        return [OK, "", self._master_uri]

    def getPid(self, caller: str) -> Answer:
        return [OK, "", os.getpid()]

    def getPublications(self, caller: str) -> Answer:
        return [OK, "", [[topic, p.offer.type] for topic, p in self._published.items()]]

    def getSubscriptions(self, caller: str) -> Answer:
        return [OK, "", [[topic, s.offer.type] for topic, s in self._subscribed.items()]]

    def getBusInfo(self, caller: str) -> Answer:
        """Answer all connections: number, other end, direction, transport, topic, whether it is up."""
        links = [(outlet.caller, "o", topic) for topic, p in self._published.items() for outlet in list(p.links)]
        links += [(uri, "i", topic) for topic, s in self._subscribed.items() for uri in list(s.connected)]
        return [OK, "", [[n, other, way, "TCPROS", topic, True] for n, (other, way, topic) in enumerate(links)]]

    def getBusStats(self, caller: str) -> Answer:
        """Answer how much has been sent."""
        sent = [_statistics(topic, p) for topic, p in self._published.items()]
        return [OK, "", [sent, [], []]]

    def requestTopic(self, caller: str, topic: str, protocols: list[list[Any]]) -> Answer:
        """Answer where a topic is to be had."""
        if topic not in self._published:
            return [ERROR, f"{self._name} does not publish {topic}", 0]
        if not any(protocol and protocol[0] == "TCPROS" for protocol in protocols):
            return [REFUSED, "must be TCPROS", []]
        return [OK, "", ["TCPROS", *self._tcpros_address]]

    def publisherUpdate(self, caller: str, topic: str, publishers: list[str]) -> Answer:
        """Take note of who publishes a topic that we take."""
        if topic in self._subscribed:
            self._update(topic, [str(uri) for uri in publishers])
        return [OK, "", 0]

    def paramUpdate(self, caller: str, key: str, value: Any) -> Answer:
        return [ERROR, "not subscribed", 0]

    def shutdown(self, caller: str, reason: str = "") -> Answer:
        """Stop, as `rosnode kill` and a master that gives our name to another node ask."""
        self._shutdown(f"{str(caller)[:80]} asks us to stop: {str(reason)[:200]}".rstrip(": "))
        return [OK, "", 0]


def _statistics(topic: str, published: PublishedTopic) -> list[Any]:
    """Return a topic, the bytes sent on it, and for each connection its number, bytes, messages, whether it is up."""
    outlets = list(published.links)
    links = [[n, outlet.sent, published.sent, True] for n, outlet in enumerate(outlets)]
    return [topic, sum(outlet.sent for outlet in outlets), links]
