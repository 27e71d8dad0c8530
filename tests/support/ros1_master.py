"""A minimal ROS 1 master: it registers publishers, subscribers and services, and notifies subscribers."""

import threading
from collections import defaultdict
from typing import Any
from xmlrpc.client import ServerProxy
from xmlrpc.server import SimpleXMLRPCServer


class Graph:
    """The registrations of a master; the methods are the master's API."""

    def __init__(self) -> None:
        self.publishers: dict[str, list[str]] = defaultdict(list)
        self.subscribers: dict[str, list[str]] = defaultdict(list)
        self.services: dict[str, str] = {}
        self.nodes: dict[str, str] = {}

    def registerPublisher(self, caller: str, topic: str, kind: str, uri: str) -> list[Any]:
        self.nodes[caller] = uri
        self.publishers[topic].append(uri)
        self._tell(topic)
        return [1, "", self.subscribers[topic]]

    def registerSubscriber(self, caller: str, topic: str, kind: str, uri: str) -> list[Any]:
        self.nodes[caller] = uri
        self.subscribers[topic].append(uri)
        return [1, "", self.publishers[topic]]

    def registerService(self, caller: str, service: str, uri: str, api: str) -> list[Any]:
        self.nodes[caller] = api
        self.services[service] = uri
        return [1, "", 0]

    def unregisterPublisher(self, caller: str, topic: str, uri: str) -> list[Any]:
        self.publishers[topic].remove(uri)
        self._tell(topic)
        return [1, "", 1]

    def unregisterSubscriber(self, caller: str, topic: str, uri: str) -> list[Any]:
        self.subscribers[topic].remove(uri)
        return [1, "", 1]

    def unregisterService(self, caller: str, service: str, uri: str) -> list[Any]:
        del self.services[service]
        return [1, "", 1]

    def lookupNode(self, caller: str, name: str) -> list[Any]:
        found = self.nodes.get(name)
        return [1, "", found] if found else [-1, "unknown node", ""]

    def _tell(self, topic: str) -> None:
        for uri in self.subscribers[topic]:
            with ServerProxy(uri) as node:
                node.publisherUpdate("/master", topic, self.publishers[topic])


class Master:
    """A served graph; after `stop`, a new one on the same port acts as a master that has lost its registrations."""

    def __init__(self, port: int = 0) -> None:
        self.graph = Graph()
        self._server = SimpleXMLRPCServer(("127.0.0.1", port), logRequests=False, allow_none=True)
        self._server.register_instance(self.graph)
        self.port: int = self._server.server_address[1]
        self.uri = f"http://127.0.0.1:{self.port}/"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def __enter__(self) -> "Master":
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
