"""A third-party ROS 2 participant (zenoh-ros2-sdk from PyPI) as a process that takes requests as lines.

    python ros2_peer.py PORT FOLDER        FOLDER contains PACKAGE/msg/NAME.msg for every type

An input line is {"op": ...}, an output line {"op": ..., "result": ...} or {"topic": ..., "message": {...}}.
"""

import dataclasses
import json
import os
import sys
import threading
from typing import Any

import numpy as np
from zenoh_ros2_sdk import (
    ROS2Publisher,
    ROS2ServiceClient,
    ROS2Subscriber,
    discovery,
    message_registry,
)
from zenoh_ros2_sdk.session import ZenohSession

HOST = "127.0.0.1"
KEPT = ":1:,1:,:,:,,"  # transient local, depth 1
_out = threading.Lock()


def say(**line: Any) -> None:
    with _out:
        print(json.dumps(line), flush=True)


def plain(value: Any) -> Any:
    """Return a message as JSON types."""
    if dataclasses.is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [plain(each) for each in value] if isinstance(value, list) else value


class Peer:
    """The participant, whose methods are the operations."""

    def __init__(self, port: int, folder: str) -> None:
        self._session = ZenohSession.get_instance(HOST, port)
        self._where: dict[str, Any] = {"router_ip": HOST, "router_port": port}
        message_registry._registry = message_registry.MessageRegistry(folder)
        self._publishers: dict[str, ROS2Publisher] = {}
        self._kept: list[Any] = []

    def subscribe(self, topic: str, kind: str, kept: bool = False) -> None:
        self._kept.append(
            ROS2Subscriber(
                topic,
                kind,
                lambda message: say(topic=topic, message=plain(message)),
                qos=KEPT if kept else None,
                **self._where,
            )
        )

    def publish(self, topic: str, kind: str, fields: dict[str, Any]) -> None:
        if topic not in self._publishers:
            self._publishers[topic] = ROS2Publisher(topic, kind, **self._where)
        self._publishers[topic].publish(**{name: self._built(value) for name, value in fields.items()})

    def _built(self, value: Any) -> Any:
        """Return the nested message described by {"type": ..., fields}."""
        if not isinstance(value, dict):
            return value
        fields = {name: self._built(each) for name, each in value.items() if name != "type"}
        return self._session.store.types[value["type"]](**fields)

    def call(self, service: str, kind: str, request: str, response: str, fields: dict[str, Any]) -> Any:
        client = ROS2ServiceClient(
            service, kind, request_definition=request, response_definition=response, timeout=120.0, **self._where
        )
        matched = threading.Event()  # a request sent before the service is known is lost, yet the SDK awaits its answer
        querier: Any = client.querier
        querier.declare_matching_listener(lambda status: matched.set() if status.matching else None)
        if querier.matching_status.matching:
            matched.set()
        matched.wait(client.timeout)
        try:
            return plain(client.call(**fields))
        finally:
            client.close()

    def topics(self) -> Any:
        return dict(discovery.get_topic_names_and_types(0, **self._where))

    def info(self, topic: str) -> Any:
        found = discovery.get_topic_info(topic, 0, verbose=True, **self._where)
        return found and dataclasses.asdict(found)

    def services(self) -> Any:
        return dict(discovery.get_service_names_and_types(0, **self._where))


def main() -> None:
    peer = Peer(int(sys.argv[1]), sys.argv[2])
    say(op="ready", result=None)
    for line in sys.stdin:
        asked = json.loads(line)
        op = asked.pop("op")
        say(op=op, result=getattr(peer, op)(**asked))
    peer._session.close()
    os._exit(0)  # the SDK leaves threads that would keep the process alive


main()
