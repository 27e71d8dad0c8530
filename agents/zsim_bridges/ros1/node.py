"""A ROS 1 node: its slave API, and the TCPROS connections of its topics and services.

A TCPROS connection begins with a header from each side; frames follow, each a length and that many bytes. All lengths
are little-endian uint32.

Sources: wiki.ros.org/ROS/Slave_API, wiki.ros.org/ROS/TCPROS, wiki.ros.org/ROS/Connection Header.
"""

import asyncio
import contextlib
import os
import socket
import struct
import threading
from asyncio import IncompleteReadError, StreamReader, StreamWriter, Task
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from typing import Any, NamedTuple

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from zsim.errors import ZsimError
from zsim_bridges.ros1 import master_api
from zsim_bridges.ros1.master_api import GraphEntry, Registration

Answer = list[Any]
OK, ERROR, REFUSED = 1, -1, 0
ALL_INTERFACES, LOOPBACK = "0.0.0.0", "127.0.0.1"
STOP_POLL_S = 0.1  # period at which the XML-RPC server checks for its shutdown
RETRY_S, RETRY_MAX_S = 0.5, 8.0  # first and longest pause between attempts to reach a publisher, doubling each time
DONE, FAILED = b"\x01", b"\x00"  # first byte of a service's response
HEADER_MAX = 1_000_000  # bytes; the definitions of the largest messages take about 10 000
FRAME_MAX = 1_000_000  # bytes; other nodes send only commands, which are short
HANDSHAKE_TIMEOUT_S = 10.0  # time limit for connecting, and for the arrival of a header
ANY_TYPE = "*"  # md5sum of a node that accepts any type
CONNECTION_ERRORS = (OSError, IncompleteReadError, TimeoutError, ValueError, OverflowError)
"""Errors that end a connection: the peer is gone or silent, or does not speak TCPROS."""
_LENGTH = struct.Struct("<I")
Say = Callable[[str], None]


class Ros1Node:
    """One node; everything but its slave API and its registration runs in one asyncio loop.

    Args:
        name: name in the ROS graph, such as "/zsim".
        host: name or address at which other nodes reach this host.

    Attributes:
        shutdown_reason: why this node must stop; empty until then.
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
        """Advertise a topic, before `running`."""
        published = self.published[topic] = PublishedTopic(topic_type_of(topic, kind), queue_size)
        return published

    def subscribe(self, topic: str, kind: str, callback: Callable[[Any], None]) -> None:
        """Subscribe to a topic, before `running`. `callback` raises ValueError for a message that it refuses."""
        self.subscribed[topic] = SubscribedTopic(topic_type_of(topic, kind), self.name, callback, self._say)

    def serve(self, name: str, action: Callable[[], str | None]) -> None:
        """Offer a std_srvs/Empty service, before `running`. `action` returns why it failed, or None if it succeeded."""
        self.services[name] = EmptyService(EMPTY_SERVICE._replace(name=name), action)

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Take part in the ROS graph while the context is open."""
        loop = asyncio.get_running_loop()

        def update_publishers(topic: str, uris: list[str], is_complete: bool = True) -> None:
            with contextlib.suppress(RuntimeError):  # raised if the loop is closed
                loop.call_soon_threadsafe(self.subscribed[topic].update, uris, is_complete)

        is_local = self.host == "localhost" or self.host.startswith("127.")
        bind_address = LOOPBACK if is_local else ALL_INTERFACES
        server = await asyncio.start_server(self._on_connection, bind_address, 0)
        port: int = server.sockets[0].getsockname()[1]
        api = master_api.XmlRpcServer(bind_address, SlaveApi(self, port, update_publishers))
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
        """Serve a subscriber or a service client until its connection ends."""
        task = asyncio.current_task()
        assert task is not None
        self._connections.add(task)
        try:
            with contextlib.suppress(*CONNECTION_ERRORS):
                header = await read_header(reader)
                endpoints = self.services if "service" in header else self.published
                name = header.get("service") or header.get("topic", "")
                endpoint = endpoints.get(name)
                if endpoint is None:
                    refusal = f"[{self.name}] has no topic or service [{name[:200]}]"
                else:
                    refusal = mismatch(endpoint.topic_type, header, self.name)
                if endpoint is None or refusal:
                    writer.write(encode_header({"error": refusal or ""}))
                    await writer.drain()
                else:
                    await endpoint.serve(reader, writer, header, self.name)
        except asyncio.CancelledError:
            writer.transport.abort()  # data that a slow subscriber has not read would keep the connection open
        finally:
            self._connections.discard(task)
            writer.close()


class SlaveApi:
    """XML-RPC methods for the master and other nodes; called in the server's threads.

    Args:
        port: port for TCPROS connections.
        update: called with a topic and its current publishers.
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
        """Return all connections, each as number, peer, direction, transport, topic, and whether it is up."""
        links = [(link.caller, "o", topic) for topic, link in self._links()]
        links += [(uri, "i", topic) for topic, s in self._node.subscribed.items() for uri in list(s.connected)]
        return [
            OK,
            "",
            [[n, peer, direction, "TCPROS", topic, True] for n, (peer, direction, topic) in enumerate(links)],
        ]

    def getBusStats(self, caller: str) -> Answer:
        """Return the bytes sent per topic, and each connection's number in getBusInfo, bytes, messages, and state.

        Subscribed topics and services are not included.
        """
        by_topic: dict[str, list[Any]] = {topic: [] for topic in self._node.published}
        for number, (topic, link) in enumerate(self._links()):
            by_topic[topic].append([number, link.sent, link.message_count, True])
        return [OK, "", [[[topic, sum(each[1] for each in links), links] for topic, links in by_topic.items()], [], []]]

    def _links(self) -> "list[tuple[str, SubscriberLink]]":
        """Return the connections of published topics, each with its topic."""
        return [(topic, link) for topic, published in self._node.published.items() for link in list(published.links)]

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
        """Stop, as requested by `rosnode kill` or by a master that gives the name to another node."""
        self._node.request_shutdown(f"{str(caller)[:80]} requests a shutdown: {str(reason)[:200]}".rstrip(": "))
        return [OK, "", 0]


class PublishedTopic:
    """A topic that the node publishes; a slow subscriber may lag `queue_size` messages behind."""

    def __init__(self, topic_type: "TopicType", queue_size: int) -> None:
        self.topic_type = topic_type
        self._queue_size = queue_size
        self.links: list[SubscriberLink] = []
        self.sent = 0

    def publish(self, make_message: Callable[[int], Any]) -> None:
        """Send what `make_message`, called only if there are subscribers, returns for a sequence number."""
        if not self.links:
            return
        framed = frame(serialize(self.topic_type.type, make_message(self.sent)))
        self.sent += 1
        for link in self.links:
            link.put(framed)

    async def serve(self, reader: StreamReader, writer: StreamWriter, header: Mapping[str, str], caller: str) -> None:
        """Serve a subscriber with a matching header until it disconnects; `caller` is this node's name."""
        configure(writer, header.get("tcp_nodelay") == "1")
        writer.write(encode_header(publisher_header(self.topic_type, caller)))
        link = SubscriberLink(writer, header["callerid"], self._queue_size)
        sender = asyncio.create_task(link.run())
        self.links.append(link)
        try:
            while await reader.read(4096):
                pass  # a subscriber sends nothing after its header
        finally:
            self.links.remove(link)
            sender.cancel()


class SubscriberLink:
    """The connection to one subscriber; a full queue drops its oldest message. Counts bytes, messages and lost ones."""

    def __init__(self, writer: StreamWriter, caller: str, queue_size: int) -> None:
        self._writer = writer
        self._queue: deque[bytes] = deque(maxlen=queue_size)
        self._message_queued = asyncio.Event()
        self.caller = caller
        self.sent = 0
        self.message_count = 0
        self.lost = 0

    def put(self, framed: bytes) -> None:
        self.lost += len(self._queue) == self._queue.maxlen
        self._queue.append(framed)
        self._message_queued.set()

    async def run(self) -> None:
        """Send queued messages until the connection ends."""
        with contextlib.suppress(*CONNECTION_ERRORS):
            while True:
                await self._message_queued.wait()
                self._message_queued.clear()
                while self._queue:
                    framed = self._queue.popleft()
                    self._writer.write(framed)
                    await self._writer.drain()
                    self.sent += len(framed)
                    self.message_count += 1


class EmptyService:
    """A service of type std_srvs/Empty; `action` returns why a request failed, or None if it succeeded."""

    def __init__(self, topic_type: "TopicType", action: Callable[[], str | None]) -> None:
        self.topic_type = topic_type
        self.action = action

    async def serve(self, reader: StreamReader, writer: StreamWriter, header: Mapping[str, str], caller: str) -> None:
        """Serve a client with a matching header until it disconnects; `caller` is this node's name."""
        configure(writer, True)
        kind = self.topic_type.type
        kinds = {"type": kind, "request_type": f"{kind}Request", "response_type": f"{kind}Response"}
        writer.write(encode_header({"callerid": caller, "md5sum": self.topic_type.md5, **kinds}))
        await writer.drain()
        expects_request = header.get("probe") != "1"
        while expects_request:
            request = await read_frame(reader)
            reason = f"the request has {len(request)} bytes; must have none" if request else self.action()
            writer.write(FAILED + frame(reason.encode()) if reason else DONE + frame(b""))
            await writer.drain()
            expects_request = header.get("persistent") == "1"


class RefusedError(ValueError):
    """The publisher has another type or protocol, or refuses this node."""


class SubscribedTopic:
    """A topic that the node subscribes to, with a connection to each publisher.

    A lost connection is renewed; a publisher that was refused is tried again when it is next announced, as in roscpp.

    Attributes:
        connected: names of connected publishers by the URI of their slave API.
    """

    def __init__(
        self, topic_type: "TopicType", caller: str, callback: Callable[[Any], None], say: Callable[[str], None]
    ) -> None:
        self.topic_type = topic_type
        self.callback = callback
        self._caller = caller
        self._say = say
        self._publishers: set[str] = set()
        self._tasks: dict[str, Task[None]] = {}
        self._reported: set[str] = set()
        self.connected: dict[str, str] = {}

    def update(self, publishers: Iterable[str], is_complete: bool = True) -> None:
        """Follow publishers, given by the URIs of their slave APIs: only these if `is_complete`, else these as well.

        Messages that a publisher sent before it left the graph may still be in transit, so its connection is read to
        the end.
        """
        self._publishers = set(publishers) | (set() if is_complete else self._publishers)
        for uri in self._publishers - set(self._tasks):
            self._tasks[uri] = asyncio.create_task(self._follow(uri))
        for uri in set(self._tasks) - self._publishers - set(self.connected):
            self._tasks.pop(uri).cancel()

    async def close(self) -> None:
        tasks = list(self._tasks.values())
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _follow(self, uri: str) -> None:
        pause_s = RETRY_S
        while uri in self._publishers:
            try:
                async with self._connection(uri) as reader:
                    pause_s = RETRY_S
                    while True:
                        data = await read_frame(reader)
                        try:
                            self.callback(deserialize(self.topic_type.type, data))
                        except (ValueError, ZsimError) as error:
                            self._report_once(uri, str(error))
            except RefusedError as error:
                self._report_once(uri, str(error))
                break
            except (*CONNECTION_ERRORS, *master_api.CALL_ERRORS):
                if uri in self._publishers:
                    await asyncio.sleep(pause_s)
                pause_s = min(2 * pause_s, RETRY_MAX_S)
        del self._tasks[uri]

    @contextlib.asynccontextmanager
    async def _connection(self, uri: str) -> AsyncIterator[StreamReader]:
        """Yield a publisher's stream once the headers have been exchanged."""
        arguments = [self._caller, self.topic_type.name, [["TCPROS"]]]
        protocol, host, port = await asyncio.to_thread(master_api.call_api, uri, "requestTopic", *arguments)
        if protocol != "TCPROS":
            raise RefusedError(f"protocol is {str(protocol)[:20]!r}; must be TCPROS")
        async with asyncio.timeout(HANDSHAKE_TIMEOUT_S):
            reader, writer = await asyncio.open_connection(host, port)
        try:
            configure(writer, True)
            writer.write(encode_header(subscriber_header(self.topic_type, self._caller)))
            header = await read_header(reader)
            error = header.get("error") or mismatch(self.topic_type, {"callerid": "?", **header}, self._caller)
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
            self._say(f"{self.topic_type.name}: messages from {self.connected.get(uri, uri)} are refused: {reason}")


class TopicType(NamedTuple):
    """Name, type, MD5 sum and definition of a topic or service; the MD5 sum must agree on both sides."""

    name: str
    type: str
    md5: str
    definition: str


def frame(payload: bytes) -> bytes:
    """Return a payload preceded by its length."""
    return _LENGTH.pack(len(payload)) + payload


def encode_header(fields: Mapping[str, str]) -> bytes:
    """Return an encoded header, preceded by its length."""
    return frame(b"".join(frame(f"{key}={value}".encode()) for key, value in fields.items()))


def decode_header(body: bytes) -> dict[str, str]:
    """Return the fields of a header, given without its leading length.

    Raises:
        ValueError: the header is malformed.
    """
    fields: dict[str, str] = {}
    start = 0
    while start < len(body):
        field_start = start + _LENGTH.size
        if field_start > len(body) or (end := field_start + _LENGTH.unpack_from(body, start)[0]) > len(body):
            raise ValueError("a field is longer than the header")
        key, separator, value = body[field_start:end].decode(errors="replace").partition("=")
        if not separator:
            raise ValueError(f"a field is {key[:40]!r}; must be key=value")
        fields[key] = value
        start = end
    return fields


def publisher_header(topic_type: TopicType, caller: str) -> dict[str, str]:
    """Return the header with which a publisher answers a subscriber."""
    return {
        "callerid": caller,
        "latching": "0",
        "md5sum": topic_type.md5,
        "message_definition": topic_type.definition,
        "topic": topic_type.name,
        "type": topic_type.type,
    }


def subscriber_header(topic_type: TopicType, caller: str) -> dict[str, str]:
    """Return the header that a subscriber sends to a publisher."""
    header = publisher_header(topic_type, caller) | {"tcp_nodelay": "1"}
    del header["latching"]
    return header


def mismatch(topic_type: TopicType, header: Mapping[str, str], caller: str) -> str | None:
    """Return why a header's type does not match that of `caller`; None if it does."""
    missing = [field for field in ("callerid", "md5sum") if field not in header]
    if missing:
        return f"missing required {missing[0]!r} field"
    if header["md5sum"] in (ANY_TYPE, topic_type.md5):
        return None
    requested = f"{header.get('type', topic_type.type)}/{header['md5sum']}"
    return (
        f"[{header['callerid']}] wants [{topic_type.name}] to have datatype/md5sum [{requested}], "
        f"but [{caller}] has [{topic_type.type}/{topic_type.md5}]"
    )


async def read_frame(reader: StreamReader, limit: int = FRAME_MAX) -> bytes:
    """Return the next frame's payload.

    Raises:
        ValueError: the frame is longer than `limit` bytes.
        IncompleteReadError: the connection ended.
    """
    (size,) = _LENGTH.unpack(await reader.readexactly(_LENGTH.size))
    if size > limit:
        raise ValueError(f"a frame has {size} bytes; must have at most {limit}")
    return await reader.readexactly(size)


async def read_header(reader: StreamReader) -> dict[str, str]:
    """Return the header with which a connection begins.

    Raises:
        ValueError: the header is malformed.
        TimeoutError: it does not arrive within HANDSHAKE_TIMEOUT_S.
    """
    async with asyncio.timeout(HANDSHAKE_TIMEOUT_S):
        return decode_header(await read_frame(reader, HEADER_MAX))


def configure(writer: StreamWriter, nodelay: bool) -> None:
    """Set whether small messages are sent at once, and enable keep-alives to detect a host that is gone."""
    sock: socket.socket = writer.get_extra_info("socket")
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, nodelay)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)


NAVDATA = """
Header header
float32 batteryPercent  # 0 to 100
uint32 state            # 0 unknown, 1 init, 2 landed, 3 and 7 flying, 4 hovering, 5 test, 6 taking off, 8 landing
int32 magX
int32 magY
int32 magZ
int32 pressure          # Pa
int32 temp              # 0.1 deg C
float32 wind_speed      # m/s
float32 wind_angle
float32 wind_comp_angle
float32 rotX            # deg, positive to the right
float32 rotY            # deg, positive nose down
float32 rotZ            # deg, positive counter-clockwise
int32 altd              # mm
float32 vx              # mm/s
float32 vy
float32 vz
float32 ax              # g
float32 ay
float32 az
uint8 motor1
uint8 motor2
uint8 motor3
uint8 motor4
uint32 tags_count
uint32[] tags_type
uint32[] tags_xc
uint32[] tags_yc
uint32[] tags_width
uint32[] tags_height
float32[] tags_orientation
float32[] tags_distance
float32 tm              # us
"""  # fields of ardrone_autonomy 1.4.1, msg/Navdata.msg; the MD5 sum ignores comments
EMPTY_SERVICE = TopicType("", "std_srvs/Empty", "d41d8cd98f00b204e9800998ecf8427e", "")  # MD5 of an empty definition

_store = get_typestore(Stores.ROS1_NOETIC)
_store.register(get_types_from_msg(NAVDATA, "ardrone_autonomy/msg/Navdata"))
_store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", "tf2_msgs/msg/TFMessage"))


def topic_type_of(topic: str, kind: str) -> TopicType:
    """Return the description of a topic whose type is named like "sensor_msgs/Imu"."""
    definition, md5 = _store.generate_msgdef(_full_name(kind), ros_version=1)
    return TopicType(topic, kind, md5, definition)


def message_class(kind: str) -> Callable[..., Any]:
    return _store.types[_full_name(kind)]


def serialize(kind: str, message: Any) -> bytes:
    """Return the bytes of a message.

    Raises:
        ValueError: a value does not fit its field.
    """
    try:
        return bytes(_store.serialize_ros1(message, _full_name(kind)))
    except Exception as error:  # the generated writer may raise any exception for invalid values
        raise ValueError(f"the message is not a valid {kind}: {error}") from error


def deserialize(kind: str, data: bytes) -> Any:
    """Return the message encoded in `data`.

    Raises:
        ValueError: `data` does not encode a message of this type.
    """
    try:
        return _store.deserialize_ros1(data, _full_name(kind))
    except Exception as error:  # the generated reader may raise any exception for invalid bytes
        raise ValueError(f"{len(data)} bytes are not a {kind}") from error


def _full_name(kind: str) -> str:
    return kind.replace("/", "/msg/")
