"""A ROS 1 node: its slave API (wiki.ros.org/ROS/Slave_API), and TCPROS connections of its topics and services."""

import asyncio
import contextlib
import os
import threading
from asyncio import StreamReader, StreamWriter, Task
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from typing import Any

from zsim.errors import ZsimError
from zsim_bridges.ros1 import master_api, tcpros
from zsim_bridges.ros1.master_api import GraphEntry, Registration

Answer = list[Any]
OK, ERROR, REFUSED = 1, -1, 0
EVERYWHERE, LOOPBACK = "0.0.0.0", "127.0.0.1"
STOP_POLL_S = 0.1  # how soon the XML-RPC server ends
RETRY_S, RETRY_MAX_S = 0.5, 8.0  # wall time between attempts to reach a publisher, doubling
DONE, FAILED = b"\x01", b"\x00"  # of a service
Say = Callable[[str], None]


class Ros1Node:
    """One node; all but its slave API lives in one asyncio loop.

    Args:
        name: in the ROS graph, "/zsim".
        host: name or address under which other nodes reach this host.

    Attributes:
        shutdown_reason: who requested this node to stop, and why; empty while nobody has.
    """

    def __init__(self, name: str, master_uri: str, host: str, say: Say) -> None:
        self.name = name
        self.master_uri = master_uri
        self.host = host
        self.shutdown_reason = ""
        self.published: dict[str, PublishedTopic] = {}
        self.subscribed: dict[str, SubscribedTopic] = {}
        self.services: dict[str, EmptyService] = {}
        self._say = say
        self._connections: set[Task[Any]] = set()

    def publish(self, topic: str, kind: str, queue_size: int) -> "PublishedTopic":
        """Publish a topic; before `running`."""
        published = self.published[topic] = PublishedTopic(tcpros.topic_type_of(topic, kind), queue_size)
        return published

    def subscribe(self, topic: str, kind: str, callback: Callable[[Any], None]) -> None:
        """Subscribe to a topic; before `running`. `callback` raises ValueError for a message that it refuses."""
        self.subscribed[topic] = SubscribedTopic(tcpros.topic_type_of(topic, kind), self.name, callback, self._say)

    def serve(self, name: str, act: Callable[[], str | None]) -> None:
        """Serve a std_srvs/Empty service; before `running`. `act` returns why it failed, None where it did not."""
        self.services[name] = EmptyService(tcpros.EMPTY_SERVICE._replace(name=name), act)

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Take part in the ROS graph meanwhile."""
        loop = asyncio.get_running_loop()

        def update_publishers(topic: str, uris: list[str], only: bool = True) -> None:
            with contextlib.suppress(RuntimeError):  # the loop is closed
                loop.call_soon_threadsafe(self.subscribed[topic].update, uris, only)

        local = self.host == "localhost" or self.host.startswith("127.")
        bound = LOOPBACK if local else EVERYWHERE
        server = await asyncio.start_server(self._on_connection, bound, 0)
        port: int = server.sockets[0].getsockname()[1]
        api = master_api.XmlRpcServer(bound, SlaveApi(self, port, update_publishers))
        threading.Thread(target=api.serve_forever, args=(STOP_POLL_S,), name="slave API", daemon=True).start()
        entry = GraphEntry(
            self.name,
            f"http://{self.host}:{api.server_address[1]}/",
            f"rosrpc://{self.host}:{port}",
            [(topic, published.topic_type.type) for topic, published in self.published.items()],
            [(topic, subscribed.topic_type.type) for topic, subscribed in self.subscribed.items()],
            list(self.services),
        )
        registration = Registration(
            self.master_uri,
            entry,
            lambda topic, uris: update_publishers(topic, uris, False),
            self.request_shutdown,
            self._say,
        )
        try:
            yield
        finally:
            await asyncio.to_thread(registration.close)
            server.close()
            await asyncio.to_thread(api.shutdown)
            api.server_close()
            for subscription in self.subscribed.values():
                await subscription.close()
            for task in list(self._connections):
                task.cancel()
            await asyncio.gather(*self._connections, return_exceptions=True)

    def request_shutdown(self, reason: str) -> None:
        self.shutdown_reason = self.shutdown_reason or reason

    async def _on_connection(self, reader: StreamReader, writer: StreamWriter) -> None:
        """Serve a subscriber or a client of a service until its connection ends."""
        task = asyncio.current_task()
        assert task is not None
        self._connections.add(task)
        try:
            with contextlib.suppress(*tcpros.CONNECTION_ERRORS):
                header = await tcpros.read_header(reader)
                by_name = self.services if "service" in header else self.published
                name = header.get("service") or header.get("topic", "")
                endpoint = by_name.get(name)
                if endpoint is None:
                    await tcpros.send_error(writer, f"[{self.name}] has no topic or service [{name[:200]}]")
                elif refusal := tcpros.mismatch(endpoint.topic_type, header, self.name):
                    await tcpros.send_error(writer, refusal)
                else:
                    await endpoint.serve(reader, writer, header, self.name)
        except asyncio.CancelledError:
            writer.transport.abort()  # data that a slow subscriber has not read would keep it open
        finally:
            self._connections.discard(task)
            writer.close()


class SlaveApi:
    """XML-RPC methods for the master and other nodes; called in threads of the server.

    Args:
        port: of its TCPROS connections.
        update: called with a topic and its publishers now.
    """

    def __init__(self, node: Ros1Node, port: int, update: Callable[[str, list[str]], None]) -> None:
        self._node = node
        self._port = port
        self._update = update

    def getName(self, caller: str) -> Answer:
        return [OK, "", self._node.name]

    def getMasterUri(self, caller: str) -> Answer:
        return [OK, "", self._node.master_uri]

    def getPid(self, caller: str) -> Answer:
        return [OK, "", os.getpid()]

    def getPublications(self, caller: str) -> Answer:
        return [OK, "", [[topic, p.topic_type.type] for topic, p in self._node.published.items()]]

    def getSubscriptions(self, caller: str) -> Answer:
        return [OK, "", [[topic, s.topic_type.type] for topic, s in self._node.subscribed.items()]]

    def getBusInfo(self, caller: str) -> Answer:
        """Answer all connections: number, other end, direction, transport, topic, whether it is up."""
        links = [(link.caller, "o", topic) for topic, p in self._node.published.items() for link in list(p.links)]
        links += [(uri, "i", topic) for topic, s in self._node.subscribed.items() for uri in list(s.connected)]
        return [OK, "", [[n, other, way, "TCPROS", topic, True] for n, (other, way, topic) in enumerate(links)]]

    def getBusStats(self, caller: str) -> Answer:
        """Answer for each topic the bytes sent, and for each connection its number, bytes, messages, whether it is up.

        Subscribed topics and services are not included.
        """
        sent: list[Any] = []
        for topic, published in self._node.published.items():
            links = [[n, link.sent, published.sent, True] for n, link in enumerate(list(published.links))]
            sent.append([topic, sum(link[1] for link in links), links])
        return [OK, "", [sent, [], []]]

    def requestTopic(self, caller: str, topic: str, protocols: list[list[Any]]) -> Answer:
        if topic not in self._node.published:
            return [ERROR, f"{self._node.name} does not publish {topic}", 0]
        if not any(protocol and protocol[0] == "TCPROS" for protocol in protocols):
            return [REFUSED, "must be TCPROS", []]
        return [OK, "", ["TCPROS", self._node.host, self._port]]

    def publisherUpdate(self, caller: str, topic: str, publishers: list[str]) -> Answer:
        """Update the publishers of a topic that the node subscribes to."""
        if topic in self._node.subscribed:
            self._update(topic, [str(uri) for uri in publishers])
        return [OK, "", 0]

    def paramUpdate(self, caller: str, key: str, value: Any) -> Answer:
        return [ERROR, "not subscribed", 0]

    def shutdown(self, caller: str, reason: str = "") -> Answer:
        """Stop, at the request of `rosnode kill` or of a master that gives the name to another node."""
        self._node.request_shutdown(f"{str(caller)[:80]} asks us to stop: {str(reason)[:200]}".rstrip(": "))
        return [OK, "", 0]


class PublishedTopic:
    """A topic that the node publishes; a slow subscriber may be `queue_size` messages behind."""

    def __init__(self, topic_type: tcpros.TopicType, queue_size: int) -> None:
        self.topic_type = topic_type
        self._queue_size = queue_size
        self.links: list[SubscriberLink] = []
        self.sent = 0

    def publish(self, make: Callable[[int], Any]) -> None:
        """Send the message that `make` returns for a sequence number; it is called only where there are subscribers."""
        if not self.links:
            return
        framed = tcpros.frame(tcpros.serialize(self.topic_type.type, make(self.sent)))
        self.sent += 1
        for link in self.links:
            link.put(framed)

    async def serve(self, reader: StreamReader, writer: StreamWriter, header: Mapping[str, str], caller: str) -> None:
        """Serve a subscriber whose header fits until it goes; `caller` is this node's name."""
        tcpros.configure(writer, header.get("tcp_nodelay") == "1")
        writer.write(tcpros.encode_header(tcpros.publisher_header(self.topic_type, caller)))
        link = SubscriberLink(writer, header["callerid"], self._queue_size)
        sender = asyncio.create_task(link.run())
        self.links.append(link)
        try:
            while await reader.read(4096):
                pass  # a subscriber sends nothing more
        finally:
            self.links.remove(link)
            sender.cancel()


class SubscriberLink:
    """The connection of one subscriber; a full queue drops the oldest message. Counts bytes sent and messages lost."""

    def __init__(self, writer: StreamWriter, caller: str, queue_size: int) -> None:
        self._writer = writer
        self._queue: deque[bytes] = deque(maxlen=queue_size)
        self._news = asyncio.Event()
        self.caller = caller
        self.sent = 0
        self.lost = 0

    def put(self, framed: bytes) -> None:
        self.lost += len(self._queue) == self._queue.maxlen
        self._queue.append(framed)
        self._news.set()

    async def run(self) -> None:
        """Send queued messages, until the connection ends."""
        with contextlib.suppress(*tcpros.CONNECTION_ERRORS):
            while True:
                await self._news.wait()
                self._news.clear()
                while self._queue:
                    framed = self._queue.popleft()
                    self._writer.write(framed)
                    await self._writer.drain()
                    self.sent += len(framed)


class EmptyService:
    """A service of type std_srvs/Empty; `act` returns why a request failed, None if it succeeded."""

    def __init__(self, topic_type: tcpros.TopicType, act: Callable[[], str | None]) -> None:
        self.topic_type = topic_type
        self.act = act

    async def serve(self, reader: StreamReader, writer: StreamWriter, header: Mapping[str, str], caller: str) -> None:
        """Serve a client whose header fits until it goes; `caller` is this node's name."""
        tcpros.configure(writer, True)
        writer.write(tcpros.encode_header(tcpros.service_header(self.topic_type, caller)))
        await writer.drain()
        expects_request = header.get("probe") != "1"
        while expects_request:
            request = await tcpros.read_frame(reader)
            reason = f"the request has {len(request)} bytes; must have none" if request else self.act()
            writer.write(FAILED + tcpros.frame(reason.encode()) if reason else DONE + tcpros.frame(b""))
            await writer.drain()
            expects_request = header.get("persistent") == "1"


class RefusedError(ValueError):
    """A publisher of another type."""


class SubscribedTopic:
    """A topic that the node subscribes to: a connection to each publisher, made again when it breaks.

    Attributes:
        connected: names of connected publishers, by their slave API's URI.
    """

    def __init__(
        self, topic_type: tcpros.TopicType, caller: str, callback: Callable[[Any], None], say: Callable[[str], None]
    ) -> None:
        self.topic_type = topic_type
        self.callback = callback
        self._caller = caller
        self._say = say
        self._wanted: set[str] = set()
        self._tasks: dict[str, Task[None]] = {}
        self._reported: set[str] = set()
        self.connected: dict[str, str] = {}

    def update(self, publishers: Iterable[str], only: bool = True) -> None:
        """Follow these publishers, given by the URIs of their slave APIs; `only` them, or these too.

        A publisher's messages from before it left the graph may still be on their way, so its connection is read to the
        end.
        """
        self._wanted = set(publishers) | (set() if only else self._wanted)
        for uri in self._wanted - set(self._tasks):
            self._tasks[uri] = asyncio.create_task(self._follow(uri))
        for uri in set(self._tasks) - self._wanted - set(self.connected):
            self._tasks.pop(uri).cancel()

    async def close(self) -> None:
        tasks = list(self._tasks.values())
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _follow(self, uri: str) -> None:
        pause_s = RETRY_S
        while uri in self._wanted:
            try:
                async with self._connection(uri) as reader:
                    pause_s = RETRY_S
                    while True:
                        data = await tcpros.read_frame(reader)
                        try:
                            self.callback(tcpros.deserialize(self.topic_type.type, data))
                        except (ValueError, ZsimError) as error:
                            self._report_once(uri, str(error))
            except RefusedError as error:
                self._report_once(uri, str(error))
                return
            except (*tcpros.CONNECTION_ERRORS, *master_api.CALL_ERRORS):
                if uri in self._wanted:
                    await asyncio.sleep(pause_s)
                pause_s = min(2 * pause_s, RETRY_MAX_S)
        del self._tasks[uri]

    @contextlib.asynccontextmanager
    async def _connection(self, uri: str) -> AsyncIterator[StreamReader]:
        """Yield the stream of a publisher once headers are exchanged."""
        arguments = [self._caller, self.topic_type.name, [["TCPROS"]]]
        protocol, host, port = await asyncio.to_thread(master_api.call_api, uri, "requestTopic", *arguments)
        if protocol != "TCPROS":
            raise RefusedError(f"protocol is {str(protocol)[:20]!r}; must be TCPROS")
        reader, writer = await asyncio.wait_for(asyncio.open_connection(host, port), tcpros.HANDSHAKE_S)
        try:
            tcpros.configure(writer, True)
            writer.write(tcpros.encode_header(tcpros.subscriber_header(self.topic_type, self._caller)))
            header = await tcpros.read_header(reader)
            error = header.get("error") or tcpros.mismatch(self.topic_type, {"callerid": "?", **header}, self._caller)
            if error:
                raise RefusedError(error[:300])
            self.connected[uri] = header.get("callerid", "?")
            yield reader
        finally:
            self.connected.pop(uri, None)
            writer.transport.abort()

    def _report_once(self, uri: str, reason: str) -> None:
        if uri not in self._reported:
            self._reported.add(uri)
            self._say(f"{self.topic_type.name}: what {self.connected.get(uri, uri)} sends is refused: {reason}")
