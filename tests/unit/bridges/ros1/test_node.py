"""ROS 1 nodes: headers and checksums on the wire, connections among themselves and to misbehaving peers."""

import asyncio
import socket
import struct
import xmlrpc.client
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from in_loop import in_loop
from refused import has_terms
from ros1_master import Master

from zsim.errors import RunError
from zsim_bridges.ros1 import master_api
from zsim_bridges.ros1 import node as wire
from zsim_bridges.ros1.master_api import own_address
from zsim_bridges.ros1.node import PublishedTopic, Ros1Node, TopicType

CMD_VEL = TopicType("/drone1/cmd_vel", "geometry_msgs/Twist", "9f195f881246fdfa2798d1d3eebca84a", "float64 x\n")
MD5 = {  # from `rosmsg md5` of Noetic; that of Navdata from the generated code of ardrone_autonomy
    "std_msgs/String": "992ce8a1687cec8c8bd883ec73ca41d1",
    "std_msgs/Empty": "d41d8cd98f00b204e9800998ecf8427e",
    "geometry_msgs/Twist": "9f195f881246fdfa2798d1d3eebca84a",
    "geometry_msgs/Vector3Stamped": "7b324c7325e683bf02a9b14b01090ec7",
    "sensor_msgs/Imu": "6a62c6daae103f4ff57a132d6f95cec2",
    "sensor_msgs/CameraInfo": "c9a58c1b0b154e0e6da7578cb991d214",
    "sensor_msgs/CompressedImage": "8f7a12909da2c9d3332d540a0977563f",
    "sensor_msgs/NavSatFix": "2d3a8cd499b9b4a0249fb98fd05cfa48",
    "nav_msgs/Odometry": "cd5e73d190d741a2f92e81eda573aca7",
    "rosgraph_msgs/Clock": "a9c97c1d230cfc112e270351a944ee47",
    "tf2_msgs/TFMessage": "94810edda583a504dfda3829e70d7eec",
    "ardrone_autonomy/Navdata": "e1169f766234363125ac62c9a3f87eeb",
}


def test_a_header_and_its_fields_are_prefixed_by_their_lengths():
    encoded = wire.encode_header({"topic": "/chat", "md5sum": "*"})
    assert encoded == b"\x1b\0\0\0" + b"\x0b\0\0\0topic=/chat" + b"\x08\0\0\0md5sum=*"
    assert wire.decode_header(encoded[4:]) == {"topic": "/chat", "md5sum": "*"}


@pytest.mark.parametrize(
    "body", [b"\x05", b"\xff\xff\xff\xff", b"\x05\0\0\0abc", b"\x03\0\0\0abc", struct.pack("<I", 2**31) + b"a=b"]
)
def test_an_invalid_header_is_refused(body):
    with pytest.raises(ValueError, match=r"header|key=value"):
        wire.decode_header(body)


@given(st.binary(max_size=200))
def test_garbage_decodes_to_strings_or_is_refused(body):
    try:
        fields = wire.decode_header(body)
    except ValueError:
        return
    assert all(isinstance(key, str) and isinstance(value, str) for key, value in fields.items())


@given(st.dictionaries(st.text("abc_", min_size=1, max_size=8), st.text("=\nA#ä ", max_size=20), max_size=6))
def test_a_decoded_header_equals_the_encoded_one(fields):
    assert wire.decode_header(wire.encode_header(fields)[4:]) == fields


@pytest.mark.parametrize(
    ("header", "terms"),
    [
        ({"callerid": "/me", "md5sum": "*"}, ()),
        ({"callerid": "/me", "md5sum": CMD_VEL.md5}, ()),
        ({"callerid": "/me", "md5sum": "0" * 32, "type": "geometry_msgs/Pose"}, ("geometry_msgs/Pose", CMD_VEL.type)),
        ({}, ("missing",)),
        ({"callerid": "/me"}, ("missing",)),
        ({"md5sum": "*"}, ("missing",)),
    ],
)
def test_a_mismatch_of_types_names_both_types(header, terms):
    reason = wire.mismatch(CMD_VEL, header, "/zsim")
    assert (reason is None) == (not terms)
    assert all(term in (reason or "") for term in terms)


def test_headers_of_subscriber_and_publisher_match():
    subscriber = wire.subscriber_header(CMD_VEL, "/a")
    publisher = wire.publisher_header(CMD_VEL, "/b")
    assert wire.mismatch(CMD_VEL, subscriber, "/b") is None
    assert wire.mismatch(CMD_VEL, publisher, "/a") is None
    assert subscriber["tcp_nodelay"] == "1"
    assert publisher["latching"] == "0"


@pytest.mark.parametrize(("kind", "md5"), MD5.items())
def test_md5_sums_equal_those_of_ros(kind, md5):
    assert wire.topic_type_of("/topic", kind).md5 == md5


def test_a_definition_includes_those_of_its_fields():
    definition = wire.topic_type_of("/topic", "ardrone_autonomy/Navdata").definition
    assert "float32 batteryPercent\n" in definition
    assert "MSG: std_msgs/Header" in definition


def test_a_number_out_of_range_for_its_field_is_refused():
    point = wire.message_class("geometry_msgs/Point32")(x=1e300, y=0.0, z=0.0)
    with pytest.raises(ValueError, match="geometry_msgs/Point32"):
        wire.serialize("geometry_msgs/Point32", point)


@pytest.mark.parametrize("kind", ["geometry_msgs/Twist", "std_msgs/Empty", "std_msgs/String"])
@given(data=st.binary(min_size=1, max_size=60).filter(lambda data: len(data) != 48))
def test_bytes_of_another_type_are_refused(kind, data):
    if kind == "std_msgs/String" and len(data) - 4 == int.from_bytes(data[:4], "little"):
        return
    with pytest.raises(ValueError, match=kind):
        wire.deserialize(kind, data)


PATIENCE_S = 120.0
TWIST, EMPTY = "geometry_msgs/Twist", "std_msgs/Empty"
Vector3 = wire.message_class("geometry_msgs/Vector3")


def twist(x: float) -> Any:
    return wire.message_class(TWIST)(linear=Vector3(x, 0.0, 0.0), angular=Vector3(0.0, 0.0, 0.0))


class Graph:
    """A master, its nodes, and the lines that they report."""

    def __init__(self) -> None:
        self.master = Master()
        self.lines: list[str] = []

    def node(self, name: str) -> Ros1Node:
        return Ros1Node(name, self.master.uri, "127.0.0.1", self.lines.append)

    def publishing(self) -> tuple[Ros1Node, PublishedTopic]:
        """Return a node `/a` that publishes `/t`."""
        node = self.node("/a")
        return node, node.publish("/t", TWIST, 10)

    def restart(self) -> None:
        """Replace the master by one without registrations."""
        self.master.stop()
        self.master = Master(self.master.port)

    async def uri(self, topic: str) -> str:
        """Return the URI of the slave API of the node that publishes a topic."""
        await until(lambda: self.master.graph.publishers[topic] != [])
        return self.master.graph.publishers[topic][-1]

    async def port(self, topic: str) -> int:
        """Return the TCPROS port of a topic."""
        code, _, address = await call(await self.uri(topic), "requestTopic", topic, [["TCPROS"]])
        assert (code, address[:2]) == (1, ["TCPROS", "127.0.0.1"])
        return address[2]

    def has_line(self, what: str) -> bool:
        return any(what in line for line in self.lines)


async def call(uri: str, method: str, *arguments: Any) -> Any:
    """Call a method of a node's slave API."""

    def ask() -> Any:
        with xmlrpc.client.ServerProxy(uri) as proxy:
            return getattr(proxy, method)("/tester", *arguments)

    return await asyncio.to_thread(ask)


async def until(true: Callable[[], bool]) -> None:
    """Wait until other tasks and threads make a condition true."""
    async with asyncio.timeout(PATIENCE_S):
        while not true():
            await asyncio.sleep(0.005)


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Iterator[Graph]:
    monkeypatch.setattr(master_api, "CHECK_S", 0.05)
    made = Graph()
    yield made
    made.master.stop()


async def connect(port: int, header: dict[str, str]) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(wire.encode_header(header))
    return reader, writer


def subscriber(topic: str, md5: str = "*") -> dict[str, str]:
    return {"callerid": "/tester", "topic": topic, "md5sum": md5, "type": TWIST, "tcp_nodelay": "1"}


@in_loop
async def test_a_subscriber_receives_what_a_publisher_sends(graph) -> None:
    received: list[float] = []
    a, b = graph.node("/a"), graph.node("/b")
    b.subscribe("/t", TWIST, lambda message: received.append(message.linear.x))
    topic = a.publish("/t", TWIST, 10)
    async with b.running(), a.running():
        await until(lambda: len(topic.links) == 1)
        for n in range(5):
            topic.publish(lambda _, n=n: twist(float(n)))
        await until(lambda: len(received) == 5)
    assert received == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert graph.master.graph.publishers["/t"] == []
    assert graph.master.graph.subscribers["/t"] == []


def test_no_message_is_built_without_subscribers(graph):
    topic = graph.node("/a").publish("/t", TWIST, 10)
    topic.publish(lambda _: pytest.fail("made"))
    assert topic.sent == 0


@in_loop
async def test_sequence_numbers_count_published_messages(graph) -> None:
    asked: list[int] = []
    a, topic = graph.publishing()
    async with a.running():
        _, writer = await connect(await graph.port("/t"), subscriber("/t"))
        await until(lambda: len(topic.links) == 1)
        for _ in range(3):
            topic.publish(lambda seq: asked.append(seq) or twist(0.0))
        writer.close()
    assert asked == [0, 1, 2]


@in_loop
async def test_a_subscriber_receives_type_and_definition(graph) -> None:
    a, _ = graph.publishing()
    async with a.running():
        reader, writer = await connect(await graph.port("/t"), subscriber("/t"))
        header = await wire.read_header(reader)
        writer.close()
    assert header["type"] == TWIST
    assert header["md5sum"] == "9f195f881246fdfa2798d1d3eebca84a"
    assert header["callerid"] == "/a"
    assert "MSG: geometry_msgs/Vector3" in header["message_definition"]


@pytest.mark.parametrize("turns", range(6))  # of the loop, between the header's arrival and the cancellation
@in_loop
async def test_a_cancellation_counts_even_while_a_header_arrives(turns) -> None:
    reader = asyncio.StreamReader()
    reading = asyncio.create_task(wire.read_header(reader))
    await asyncio.sleep(0)  # starts reading
    reader.feed_data(wire.encode_header({"topic": "/t"}))
    for _ in range(turns):
        await asyncio.sleep(0)
    was_running = reading.cancel()
    await asyncio.wait([reading])
    assert reading.cancelled() == was_running


@pytest.mark.parametrize(
    ("header", "terms"),
    [
        (subscriber("/t", "0" * 32), ("datatype/md5sum",)),
        (subscriber("/nobody's"), ("no topic", "[/nobody's]")),
        ({"callerid": "/tester"}, ("no topic",)),
        ({"topic": "/t", "md5sum": "*"}, ("missing",)),
        ({"service": "/none", "callerid": "/tester", "md5sum": "*"}, ("service", "[/none]")),
    ],
)
@in_loop
async def test_a_mismatching_request_is_refused_as_in_ros(graph, header, terms) -> None:
    a, _ = graph.publishing()
    async with a.running():
        reader, writer = await connect(await graph.port("/t"), header)
        answer = await wire.read_header(reader)
        assert await reader.read() == b""  # the node closed the connection
        writer.close()
    assert has_terms(answer["error"], *terms)


@pytest.mark.parametrize("garbage", [b"GET / HTTP/1.1\r\n\r\n", b"\xff" * 64, b"\x04\0\0\0\x00\x00\x00\x00", b"\x00"])
@in_loop
async def test_garbage_ends_only_its_own_connection(graph, garbage) -> None:
    a, topic = graph.publishing()
    async with a.running():
        port = await graph.port("/t")
        reader, writer = await connect(port, subscriber("/t"))
        await wire.read_header(reader)
        other, nonsense = await asyncio.open_connection("127.0.0.1", port)
        nonsense.write(garbage)
        nonsense.write_eof()
        await other.read()
        nonsense.close()
        topic.publish(lambda _: twist(7.0))
        assert wire.deserialize(TWIST, await wire.read_frame(reader)).linear.x == 7.0
        writer.close()


@in_loop
async def test_a_stalled_subscriber_loses_messages_and_delays_no_other(graph) -> None:
    text, string = "x" * 100_000, wire.message_class("std_msgs/String")
    a = graph.node("/a")
    topic = a.publish("/t", "std_msgs/String", 5)
    async with a.running():
        port = await graph.port("/t")
        lazy = socket.create_connection(("127.0.0.1", port))
        lazy.sendall(wire.encode_header(subscriber("/t")))
        reader, writer = await connect(port, subscriber("/t"))
        await wire.read_header(reader)
        await until(lambda: len(topic.links) == 2)
        for n in range(200):
            topic.publish(lambda _, n=n: string(data=f"{n:04d}{text}"))
            assert (await wire.read_frame(reader))[4:8] == b"%04d" % n
        stuck = max(topic.links, key=lambda outlet: outlet.lost)
        assert stuck.lost > 0
        assert sum(outlet.lost for outlet in topic.links) == stuck.lost  # the other lost nothing
        lazy.close()
        await until(lambda: len(topic.links) == 1)
        writer.close()


@in_loop
async def test_garbage_of_a_publisher_is_reported_once_and_reception_continues(graph) -> None:
    received: list[Any] = []

    def take(message: Any) -> None:
        if message.linear.x < 0:
            raise ValueError("negative")
        received.append(message.linear.x)

    node, server = graph.node("/b"), None
    node.subscribe("/t", TWIST, take)

    async def publish(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await wire.read_header(reader)
        writer.write(wire.encode_header(wire.publisher_header(wire.topic_type_of("/t", TWIST), "/bad")))
        negative, good = (wire.serialize(TWIST, twist(x)) for x in (-1.0, 5.0))
        for payload in (b"short", negative, b"x" * 49, good):
            writer.write(wire.frame(payload))
        await writer.drain()
        await reader.read()
        writer.close()

    server = await asyncio.start_server(publish, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    with Slave(port) as uri:
        graph.master.graph.publishers["/t"].append(uri)
        async with node.running():
            await until(lambda: received == [5.0])
    server.close()
    lines = [line for line in graph.lines if "refused" in line]
    assert len(lines) == 1
    assert "/bad" in lines[0]


class Slave(Master):
    """The slave API of a publisher, which answers only `requestTopic`, with the given port."""

    def __init__(self, port: int) -> None:
        super().__init__()
        self._server.register_function(lambda *_: [1, "", ["TCPROS", "127.0.0.1", port]], "requestTopic")

    def __enter__(self) -> Any:
        return self.uri


@in_loop
async def test_another_type_on_the_same_topic_is_refused_and_reported(graph) -> None:
    a, b = graph.node("/a"), graph.node("/b")
    a.publish("/t", EMPTY, 10)
    b.subscribe("/t", TWIST, lambda _: pytest.fail("taken"))
    async with a.running(), b.running():
        await until(lambda: graph.has_line("/t: messages from "))
    assert graph.has_line("datatype/md5sum")


@in_loop
async def test_a_refused_publisher_is_followed_once_it_registers_the_right_type(graph) -> None:
    """A publisher that restarts at the same URI is announced in the same list as before."""
    kinds = iter([EMPTY, TWIST])
    node = graph.node("/b")
    node.subscribe("/t", TWIST, lambda _: None)

    async def publish(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await wire.read_header(reader)
        writer.write(wire.encode_header(wire.publisher_header(wire.topic_type_of("/t", next(kinds)), "/a")))
        await reader.read()
        writer.close()

    server = await asyncio.start_server(publish, "127.0.0.1", 0)
    with Slave(server.sockets[0].getsockname()[1]) as uri:
        graph.master.graph.publishers["/t"].append(uri)
        async with node.running():
            await until(lambda: graph.has_line("datatype/md5sum"))
            await call(graph.master.graph.nodes["/b"], "publisherUpdate", "/t", [uri])
            await until(lambda: node.subscribed["/t"].connected == {uri: "/a"})
    server.close()


@in_loop
async def test_a_node_waits_for_its_master_and_registers_again_after_a_restart(graph) -> None:
    node = graph.node("/a")
    node.publish("/t", TWIST, 10)
    graph.master.stop()
    async with node.running():
        await until(lambda: graph.has_line("waiting for a ROS master"))
        graph.master = Master(graph.master.port)
        await until(lambda: "/a" in graph.master.graph.nodes)
        await until(lambda: graph.has_line("/a: registered with"))
        graph.restart()
        await until(lambda: graph.has_line("/a: registered again"))
        assert len(graph.master.graph.publishers["/t"]) == 1


@in_loop
async def test_connections_survive_a_restart_of_the_master(graph) -> None:
    received: list[float] = []
    a, b = graph.node("/a"), graph.node("/b")
    topic = a.publish("/t", TWIST, 10)
    b.subscribe("/t", TWIST, lambda message: received.append(message.linear.x))
    async with a.running(), b.running():
        await until(lambda: len(topic.links) == 1)
        graph.restart()
        await until(lambda: sum("registered again" in line for line in graph.lines) == 2)
        topic.publish(lambda _: twist(1.0))
        await until(lambda: received == [1.0])
        assert len(topic.links) == 1


@in_loop
async def test_a_returning_publisher_is_received_again(graph) -> None:
    received: list[float] = []
    b = graph.node("/b")
    b.subscribe("/t", TWIST, lambda message: received.append(message.linear.x))
    async with b.running():
        for n in range(2):
            a = graph.node("/a")
            topic = a.publish("/t", TWIST, 10)
            async with a.running():
                await until(lambda topic=topic: len(topic.links) == 1)
                topic.publish(lambda _, n=n: twist(float(n)))
                await until(lambda n=n: len(received) == n + 1)


@in_loop
async def test_the_last_message_of_a_leaving_node_is_received(graph) -> None:
    """A node that publishes a landing and ends may leave the graph before the message has been read."""
    received: list[float] = []
    node = graph.node("/b")
    node.subscribe("/t", TWIST, lambda message: received.append(message.linear.x))
    left = asyncio.Event()

    async def publish(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await wire.read_header(reader)
        writer.write(wire.encode_header(wire.publisher_header(wire.topic_type_of("/t", TWIST), "/a")))
        await left.wait()
        writer.write(wire.frame(wire.serialize(TWIST, twist(3.0))))
        writer.close()

    server = await asyncio.start_server(publish, "127.0.0.1", 0)
    with Slave(server.sockets[0].getsockname()[1]) as uri:
        graph.master.graph.publishers["/t"].append(uri)
        async with node.running():
            subscription = node.subscribed["/t"]
            await until(lambda: subscription.connected != {})
            await call(graph.master.graph.nodes["/b"], "publisherUpdate", "/t", [])
            left.set()
            await until(lambda: received == [3.0])
            await until(lambda: subscription._tasks == {})
    server.close()


@in_loop
async def test_a_node_that_ends_while_registering_leaves_no_registration(graph) -> None:
    node = graph.node("/a")
    topics = [f"/t{n}" for n in range(50)]
    for topic in topics:
        node.publish(topic, TWIST, 10)
    async with node.running():
        await until(lambda: graph.master.graph.publishers[topics[0]] != [])
    assert [topic for topic in topics if graph.master.graph.publishers[topic]] == []


@in_loop
async def test_a_service_accepts_and_refuses_requests(graph) -> None:
    reasons = iter([None, "the drone flies"])

    async def ask(port: int, request: bytes = b"") -> tuple[int, bytes]:
        reader, writer = await connect(port, {"callerid": "/tester", "service": "/s", "md5sum": "*"})
        assert (await wire.read_header(reader))["type"] == "std_srvs/Empty"
        writer.write(wire.frame(request))
        (ok,) = await reader.readexactly(1)
        answer = await wire.read_frame(reader)
        assert await reader.read() == b""
        writer.close()
        return ok, answer

    a = graph.node("/a")
    a.serve("/s", lambda: next(reasons))
    async with a.running():
        await until(lambda: "/s" in graph.master.graph.services)
        port = int(graph.master.graph.services["/s"].rsplit(":", 1)[1])
        assert await ask(port, b"too much") == (0, b"the request has 8 bytes; must have none")
        assert await ask(port) == (1, b"")
        assert await ask(port) == (0, b"the drone flies")
    assert graph.master.graph.services == {}


@in_loop
async def test_a_service_reports_its_type_and_serves_persistent_connections(graph) -> None:
    a = graph.node("/a")
    a.serve("/s", lambda: None)
    async with a.running():
        await until(lambda: "/s" in graph.master.graph.services)
        port = int(graph.master.graph.services["/s"].rsplit(":", 1)[1])
        asked = {"callerid": "/tester", "service": "/s", "md5sum": "*"}
        reader, writer = await connect(port, asked | {"probe": "1"})
        assert (await wire.read_header(reader))["request_type"] == "std_srvs/EmptyRequest"
        assert await reader.read() == b""
        writer.close()
        reader, writer = await connect(port, asked | {"persistent": "1"})
        await wire.read_header(reader)
        for _ in range(3):
            writer.write(wire.frame(b""))
            assert await reader.readexactly(5) == b"\x01\0\0\0\0"
        writer.close()


@in_loop
async def test_messages_and_bytes_are_counted_for_each_connection(graph) -> None:
    a, topic = graph.publishing()
    other = a.publish("/u", TWIST, 10)
    async with a.running():
        writers: list[asyncio.StreamWriter] = []
        uri, port = await graph.uri("/t"), await graph.port("/t")
        for published, sent_bytes in ((topic, 52), (topic, 156), (other, 52)):
            reader, writer = await connect(port, subscriber(published.topic_type.name))
            writers.append(writer)
            await wire.read_header(reader)
            published.publish(lambda _: twist(1.0))
            await until(lambda of=published, total=sent_bytes: sum(link.sent for link in of.links) == total)
        stats = (await call(uri, "getBusStats"))[2][0]
        numbers = [each[0] for each in (await call(uri, "getBusInfo"))[2]]
        for writer in writers:
            writer.close()
    assert stats == [["/t", 156, [[0, 104, 2, True], [1, 52, 1, True]]], ["/u", 52, [[2, 52, 1, True]]]]
    assert numbers == [0, 1, 2]


@in_loop
async def test_the_slave_api_answers_the_requests_of_ros_tools(graph) -> None:
    a, topic = graph.publishing()
    a.subscribe("/in", EMPTY, lambda _: None)
    async with a.running():
        uri = await graph.uri("/t")
        reader, writer = await connect(await graph.port("/t"), subscriber("/t"))
        await wire.read_header(reader)
        topic.publish(lambda _: twist(1.0))
        await wire.read_frame(reader)
        await until(lambda: topic.links[0].sent > 0)
        assert (await call(uri, "getPublications"))[2] == [["/t", TWIST]]
        assert (await call(uri, "getSubscriptions"))[2] == [["/in", EMPTY]]
        assert (await call(uri, "getBusInfo"))[2] == [[0, "/tester", "o", "TCPROS", "/t", True]]
        assert (await call(uri, "getBusStats"))[2] == [[["/t", 52, [[0, 52, 1, True]]]], [], []]
        assert (await call(uri, "getMasterUri"))[2] == graph.master.uri
        assert (await call(uri, "getName"))[2] == "/a"
        assert (await call(uri, "getPid"))[0] == 1
        assert (await call(uri, "requestTopic", "/none", [["TCPROS"]]))[0] == -1
        assert (await call(uri, "requestTopic", "/t", [["UDPROS"]]))[0] == 0
        assert (await call(uri, "paramUpdate", "/use_sim_time", True))[0] == -1
        assert (await call(uri, "publisherUpdate", "/none", []))[0] == 1
        with pytest.raises(xmlrpc.client.Fault):
            await call(uri, "requestTopic")
        with pytest.raises(xmlrpc.client.Fault):
            await call(uri, "_update", "/in", [])
        writer.close()


@pytest.mark.parametrize(
    "garbage",
    [
        b"\xff\x00" * 50,
        b"POST / HTTP/1.1\r\ncontent-length: 99999999999\r\n\r\n",
        b"POST / HTTP/1.1\r\ncontent-length: many\r\n\r\n",
        b"POST / HTTP/1.1\r\n\r\n",
        b"POST / HTTP/1.1\r\ncontent-length: 9\r\n\r\n<nothing>",
        b"GET / HTTP/1.1\r\n\r\n",
    ],
)
@in_loop
async def test_the_slave_api_survives_garbage(graph, garbage, capfd) -> None:
    a, _ = graph.publishing()
    async with a.running():
        uri = await graph.uri("/t")
        reader, writer = await asyncio.open_connection("127.0.0.1", int(uri.strip("/").rsplit(":", 1)[1]))
        writer.write(garbage)
        writer.write_eof()
        await reader.read()
        writer.close()
        assert (await call(uri, "getName"))[2] == "/a"
    assert capfd.readouterr().err == ""


@in_loop
async def test_a_shutdown_request_is_reported_with_caller_and_reason(graph) -> None:
    a, _ = graph.publishing()
    async with a.running():
        await call(await graph.uri("/t"), "shutdown", "user request")
    assert has_terms(a.shutdown_reason, "/tester", "user request")


@in_loop
async def test_a_node_whose_name_is_taken_over_ends(graph) -> None:
    a, _ = graph.publishing()
    async with a.running():
        await until(lambda: "/a" in graph.master.graph.nodes)
        graph.master.graph.nodes["/a"] = "http://127.0.0.1:1/"
        await until(lambda: a.shutdown_reason != "")
    assert has_terms(a.shutdown_reason, "another", "http://127.0.0.1:1/")


@pytest.mark.parametrize("uri", ["127.0.0.1:11311", "https://x:1", "http://", "http://x:99999", ""])
def test_an_invalid_master_uri_is_refused(uri):
    with pytest.raises(RunError, match=repr(uri)):
        own_address(uri)


def test_own_address_follows_ros_variables_or_the_route_to_the_master():
    assert own_address("http://127.0.0.1:11311", {}) == "127.0.0.1"
    assert own_address("http://127.0.0.1", {"ROS_IP": "10.0.0.7"}) == "10.0.0.7"
    both = {"ROS_IP": "10.0.0.7", "ROS_HOSTNAME": "lab"}
    assert own_address("http://127.0.0.1", both) == "lab"
