"""A ROS 1 node: its topics and services, its slave API (wiki.ros.org/ROS/Slave_API), and its registration."""

import asyncio
import contextlib
import os
import threading
from asyncio import StreamReader, StreamWriter
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Any

from zsim_bridges.ros1 import master_api, tcpros
from zsim_bridges.ros1.connections import EmptyService, PublishedTopic, SubscribedTopic
from zsim_bridges.ros1.master_api import GraphEntry, Registration

Answer = list[Any]
OK, ERROR, REFUSED = 1, -1, 0


class SlaveApi:
    """XML-RPC methods for the master and other nodes; called in threads of the server.

    Args:
        name: of the node.
        master_uri: of its master.
        tcpros_address: host and port of TCPROS connections.
        published, subscribed: by topic.
        update: called with a topic and its publishers now.
        shutdown: called with who requests a stop, and why.
    """

    def __init__(
        self,
        name: str,
        master_uri: str,
        tcpros_address: tuple[str, int],
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
        self._tcpros_address = tcpros_address

    def getName(self, caller: str) -> Answer:
        return [OK, "", self._name]

    def getMasterUri(self, caller: str) -> Answer:
        return [OK, "", self._master_uri]

    def getPid(self, caller: str) -> Answer:
        return [OK, "", os.getpid()]

    def getPublications(self, caller: str) -> Answer:
        return [OK, "", [[topic, p.topic_type.type] for topic, p in self._published.items()]]

    def getSubscriptions(self, caller: str) -> Answer:
        return [OK, "", [[topic, s.topic_type.type] for topic, s in self._subscribed.items()]]

    def getBusInfo(self, caller: str) -> Answer:
        """Answer all connections: number, other end, direction, transport, topic, whether it is up."""
        links = [(link.caller, "o", topic) for topic, p in self._published.items() for link in list(p.links)]
        links += [(uri, "i", topic) for topic, s in self._subscribed.items() for uri in list(s.connected)]
        return [OK, "", [[n, other, way, "TCPROS", topic, True] for n, (other, way, topic) in enumerate(links)]]

    def getBusStats(self, caller: str) -> Answer:
        """Return how much has been sent."""
        sent = [_statistics(topic, p) for topic, p in self._published.items()]
        return [OK, "", [sent, [], []]]

    def requestTopic(self, caller: str, topic: str, protocols: list[list[Any]]) -> Answer:
        """Return where a topic can be subscribed to."""
        if topic not in self._published:
            return [ERROR, f"{self._name} does not publish {topic}", 0]
        if not any(protocol and protocol[0] == "TCPROS" for protocol in protocols):
            return [REFUSED, "must be TCPROS", []]
        return [OK, "", ["TCPROS", *self._tcpros_address]]

    def publisherUpdate(self, caller: str, topic: str, publishers: list[str]) -> Answer:
        """Update the publishers of a topic that the node subscribes to."""
        if topic in self._subscribed:
            self._update(topic, [str(uri) for uri in publishers])
        return [OK, "", 0]

    def paramUpdate(self, caller: str, key: str, value: Any) -> Answer:
        return [ERROR, "not subscribed", 0]

    def shutdown(self, caller: str, reason: str = "") -> Answer:
        """Stop, for `rosnode kill`, or a master that gives the name to another node."""
        self._shutdown(f"{str(caller)[:80]} asks us to stop: {str(reason)[:200]}".rstrip(": "))
        return [OK, "", 0]


def _statistics(topic: str, published: PublishedTopic) -> list[Any]:
    """Return a topic, the bytes sent on it, and for each connection its number, bytes, messages, whether it is up."""
    subscribers = list(published.links)
    links = [[n, link.sent, published.sent, True] for n, link in enumerate(subscribers)]
    return [topic, sum(link.sent for link in subscribers), links]


EVERYWHERE, LOOPBACK = "0.0.0.0", "127.0.0.1"
STOP_POLL_S = 0.1  # how soon the XML-RPC server ends
Say = Callable[[str], None]


class Ros1Node:
    """One node; all but its slave API lives in one asyncio loop.

    Args:
        name: in the ROS graph, "/zsim".
        master_uri: of the master.
        host: name or address under which other nodes reach this host.
        say: prints a line.

    Attributes:
        shutdown_reason: who requested this node to stop, and why; empty while nobody has.
    """

    def __init__(self, name: str, master_uri: str, host: str, say: Say) -> None:
        self.name = name
        self.shutdown_reason = ""
        self._master_uri = master_uri
        self._host = host
        self._say = say
        self._published: dict[str, PublishedTopic] = {}
        self._subscribed: dict[str, SubscribedTopic] = {}
        self._services: dict[str, EmptyService] = {}
        self._connections: set[asyncio.Task[Any]] = set()

    def publish(self, topic: str, kind: str, queue_size: int) -> PublishedTopic:
        """Publish a topic; before `running`."""
        published = self._published[topic] = PublishedTopic(tcpros.topic_type_of(topic, kind), queue_size)
        return published

    def subscribe(self, topic: str, kind: str, callback: Callable[[Any], None]) -> None:
        """Subscribe to a topic; before `running`. `callback` raises ValueError for a message that it refuses."""
        self._subscribed[topic] = SubscribedTopic(tcpros.topic_type_of(topic, kind), self.name, callback, self._say)

    def serve(self, name: str, act: Callable[[], str | None]) -> None:
        """Serve a std_srvs/Empty service; before `running`. `act` returns why it failed, None where it did not."""
        self._services[name] = EmptyService(tcpros.EMPTY_SERVICE._replace(name=name), act)

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Take part in the ROS graph meanwhile."""
        bound = LOOPBACK if _is_loopback(self._host) else EVERYWHERE
        server = await asyncio.start_server(self._on_connection, bound, 0)
        port: int = server.sockets[0].getsockname()[1]
        api = master_api.XmlRpcServer(bound, self._slave_api(port))
        threading.Thread(target=api.serve_forever, args=(STOP_POLL_S,), name="slave API", daemon=True).start()
        registration = self._registration(api.server_address[1], port)
        registration.start()
        try:
            yield
        finally:
            await asyncio.to_thread(registration.close)
            server.close()
            await asyncio.to_thread(api.shutdown)
            api.server_close()
            await self._close_connections()

    def _slave_api(self, port: int) -> SlaveApi:
        loop = asyncio.get_running_loop()
        return SlaveApi(
            self.name,
            self._master_uri,
            (self._host, port),
            self._published,
            self._subscribed,
            lambda topic, uris: _call_in_loop(loop, self._subscribed[topic].update, uris),
            self._request_shutdown,
        )

    def _registration(self, api_port: int, port: int) -> Registration:
        loop = asyncio.get_running_loop()
        entry = GraphEntry(
            self.name,
            f"http://{self._host}:{api_port}/",
            f"rosrpc://{self._host}:{port}",
            [(topic, published.topic_type.type) for topic, published in self._published.items()],
            [(topic, subscribed.topic_type.type) for topic, subscribed in self._subscribed.items()],
            list(self._services),
        )
        return Registration(
            self._master_uri,
            entry,
            lambda topic, uris: _call_in_loop(loop, self._subscribed[topic].update, uris, False),
            self._request_shutdown,
            self._say,
        )

    def _request_shutdown(self, reason: str) -> None:
        self.shutdown_reason = self.shutdown_reason or reason

    async def _on_connection(self, reader: StreamReader, writer: StreamWriter) -> None:
        """Serve one connection until it ends."""
        task = asyncio.current_task()
        assert task is not None
        self._connections.add(task)
        try:
            with contextlib.suppress(*tcpros.CONNECTION_ERRORS):
                header = await tcpros.read_header(reader)
                await self._serve(reader, writer, header)
        except asyncio.CancelledError:
            writer.transport.abort()  # data that a slow subscriber has not read would keep it open
        finally:
            self._connections.discard(task)
            writer.close()

    async def _serve(self, reader: StreamReader, writer: StreamWriter, header: Mapping[str, str]) -> None:
        by_name = self._services if "service" in header else self._published
        name = header.get("service") or header.get("topic", "")
        endpoint = by_name.get(name)
        if endpoint is None:
            await tcpros.send_error(writer, f"[{self.name}] has no topic or service [{name[:200]}]")
            return
        await endpoint.serve(reader, writer, header, self.name)

    async def _close_connections(self) -> None:
        """End all connections."""
        for subscription in self._subscribed.values():
            await subscription.close()
        for task in list(self._connections):
            task.cancel()
        await asyncio.gather(*self._connections, return_exceptions=True)


def _call_in_loop(loop: asyncio.AbstractEventLoop, function: Callable[..., None], *arguments: Any) -> None:
    """Call a function in the loop, unless it is closed."""
    with contextlib.suppress(RuntimeError):
        loop.call_soon_threadsafe(function, *arguments)


def _is_loopback(host: str) -> bool:
    return host == "localhost" or host.startswith("127.")
