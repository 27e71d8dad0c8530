"""A ROS 2 context on the wire of rmw_zenoh: names, keys, tokens, quality of service, attachments; nodes and endpoints.

Of ros2/rmw_zenoh as Jazzy (from 0.2.4), Kilted and Rolling ship it: `liveliness_utils.cpp` for tokens and quality of
service, `attachment_helpers.cpp` for attachments. Humble's has neither type hashes nor this attachment.

Order of this file: the wire, which is pure; the context, whose nodes have publishers, subscriptions and services.
"""

import re
import struct
from collections.abc import Callable, Iterable
from itertools import count
from typing import Any, NamedTuple

import xxhash

from zsim.transport.session import Query, RawSample, Session
from zsim_bridges.ros2 import ros_types

CDR = "application/cdr"
_OTHERS = re.compile(r"[^a-z0-9]+")  # and no two underscores in a row, which ROS reserves
TOKEN_SPACE = "@ros2_lv"  # of all tokens; `**` does not match it
TOKEN_PARTS = 13  # of an endpoint's token
GID_BYTES = 16
_HEAD = struct.Struct("<qqB")  # sequence number, wall time [ns], length of the gid
ATTACHMENT_BYTES = _HEAD.size + GID_BYTES


def ros_name(name: str, what: str) -> str:
    """Return the nearest name that ROS takes: `quad-1.a` is `quad_1_a`, and a drone `7` is `drone_7`."""
    bare = _OTHERS.sub("_", name)
    return f"{what}_{bare}" if bare[0].isdigit() else bare


def ros_names(names: Iterable[str], what: str) -> dict[str, str]:
    """Return the ROS name of each; where two would have the same, the later ones get a number."""
    ros_name_of: dict[str, str] = {}
    for name in names:
        first = chosen = ros_name(name, what)
        number = 2
        while chosen in ros_name_of.values():
            chosen, number = f"{first.rstrip('_')}_{number}", number + 1
        ros_name_of[name] = chosen
    return ros_name_of


class Qos(NamedTuple):
    """Quality of service that an endpoint offers or requests; the last `depth` messages are kept."""

    depth: int = 10
    best_effort: bool = False
    transient_local: bool = False

    def text(self) -> str:
        """Return it as tokens have it: what is rmw_zenoh's default (reliable, volatile, keep last) is left out."""
        reliability = "2" if self.best_effort else ""
        durability = "1" if self.transient_local else ""
        return f"{reliability}:{durability}:,{self.depth}:,:,:,,"


SENSOR = Qos(depth=5, best_effort=True)  # rmw_qos_profile_sensor_data
DEFAULT = Qos(depth=10)  # rmw_qos_profile_default, and that of services
CLOCK = Qos(depth=1, best_effort=True)  # rclcpp::ClockQoS
TF = Qos(depth=100)  # tf2_ros::DynamicBroadcasterQoS
TF_STATIC = Qos(depth=1, transient_local=True)  # tf2_ros::StaticBroadcasterQoS


class NodeId(NamedTuple):
    """A node of a Zenoh session; `namespace` is absolute, `/` for the root."""

    domain: int
    zid: str
    number: int
    namespace: str
    name: str


class Endpoint(NamedTuple):
    """A publisher (kind MP), subscription (MS), service (SS) or client (SC), as its token describes it."""

    kind: str
    name: str
    type_name: str
    type_hash: str


def dds_name(ros_type: str) -> str:
    """Return the name of a type on the wire: `std_msgs/msg/Empty` is `std_msgs::msg::dds_::Empty_`."""
    package, kind, name = ros_type.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def data_key(domain: int, name: str, type_name: str, type_hash: str) -> str:
    """Return the key of a topic's messages or of a service's requests."""
    return f"{domain}/{name.strip('/')}/{type_name}/{type_hash}"


def node_token(node: NodeId) -> str:
    return _token_head(node, node.number, "NN")


def endpoint_token(node: NodeId, number: int, endpoint: Endpoint, qos: Qos) -> str:
    endpoint_part = f"{_mangled(endpoint.name)}/{endpoint.type_name}/{endpoint.type_hash}/{qos.text()}"
    return f"{_token_head(node, number, endpoint.kind)}/{endpoint_part}"


def _token_head(node: NodeId, number: int, kind: str) -> str:
    enclave = "%"
    prefix = f"{TOKEN_SPACE}/{node.domain}/{node.zid}/{node.number}/{number}/{kind}"
    return f"{prefix}/{enclave}/{_mangled(node.namespace)}/{node.name}"


def _mangled(name: str) -> str:
    return name.replace("/", "%")


def endpoint_of(token: str) -> Endpoint | None:
    """Return the endpoint of a token; None where it is no endpoint's."""
    parts = token.split("/")
    if len(parts) != TOKEN_PARTS or parts[0] != TOKEN_SPACE:
        return None
    return Endpoint(parts[5], parts[9].replace("%", "/"), parts[10], parts[11])


def gid_of(token: str) -> bytes:
    """Return the identity of an endpoint: XXH3-128 of its token, the low half first, both little-endian."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(GID_BYTES, "little")


class Attachment(NamedTuple):
    """The attachment of every message, request and reply: its number (from 1), its wall time, and its sender."""

    sequence: int
    wall_ns: int
    gid: bytes

    def packed(self) -> bytes:
        return _HEAD.pack(self.sequence, self.wall_ns, GID_BYTES) + self.gid


def attachment_of(data: bytes) -> Attachment:
    """Return a decoded attachment.

    Raises:
        ValueError: it is none of rmw_zenoh's.
    """
    if len(data) != ATTACHMENT_BYTES or data[_HEAD.size - 1] != GID_BYTES:
        raise ValueError(f"the attachment has {len(data)} bytes; must have {ATTACHMENT_BYTES}, of rmw_zenoh >= 0.2.4")
    sequence, wall_ns, _ = _HEAD.unpack_from(data)
    return Attachment(sequence, wall_ns, data[_HEAD.size :])


class RosContext:
    """A context in the sense of ROS: the nodes of one process.

    Args:
        link: a session by full keys, without a federation.
        wall_ns: returns the time since 1970.
        refuse: called with (name, reason) of a message that is refused, in threads of Zenoh's.
    """

    def __init__(
        self, link: Session, domain: int, wall_ns: Callable[[], int], refuse: Callable[[str, str], None]
    ) -> None:
        self.link = link
        self.domain = domain
        self.wall_ns = wall_ns
        self.refuse = refuse
        self.numbers = count()  # of nodes and endpoints
        self._zid = link.zid()

    def node(self, namespace: str, name: str) -> "Ros2Node":
        """Return a new node, which other nodes see from now on."""
        return Ros2Node(self, NodeId(self.domain, self._zid, next(self.numbers), namespace, name))

    def on_subscription(self, callback: Callable[[str, bool], None]) -> None:
        """Call back with (token, alive), in a thread of Zenoh's, for the subscriptions of all contexts."""
        self.link.on_token(f"{TOKEN_SPACE}/{self.domain}/*/*/*/MS/**", callback)


class Ros2Node:
    """A node of a context. An endpoint's token is declared once it works: others may use it at once."""

    def __init__(self, context: RosContext, identity: NodeId) -> None:
        self._context = context
        self._identity = identity
        context.link.declare_token(node_token(identity))

    def publisher(self, topic: str, kind: str, qos: Qos) -> "Publisher":
        """Return a publisher of a topic, given by its full name."""
        key, token = self._endpoint("MP", topic, kind, qos)
        publisher = Publisher(self._context, key, kind, qos, gid_of(token))
        self._context.link.declare_token(token)
        return publisher

    def subscription(self, topic: str, kind: str, qos: Qos, callback: Callable[[Any], None]) -> Callable[[], None]:
        """Call back with every message on a topic, in a thread of Zenoh's, until the returned function is called."""
        context = self._context
        key, token = self._endpoint("MS", topic, kind, qos)

        def on_publication(sample: RawSample) -> None:
            try:
                attachment_of(sample.attachment)
                callback(ros_types.decode(sample.payload, kind))
            except ValueError as error:
                context.refuse(topic, str(error))

        undeclare = context.link.declare_subscriber(key, on_publication)
        context.link.declare_token(token)
        return undeclare

    def service(self, name: str, kind: str, answer: Callable[[Any], Any]) -> None:
        """Answer a service's requests, each with what `answer` returns, in a thread of Zenoh's."""
        context = self._context
        key, token = self._endpoint("SS", name, kind, DEFAULT)

        def reply(query: Query) -> None:
            try:
                received = attachment_of(query.attachment)
                response = answer(ros_types.decode(query.payload, f"{kind}_Request"))
            except ValueError as error:
                query.end()
                context.refuse(name, str(error))
                return
            attachment = Attachment(received.sequence, context.wall_ns(), received.gid)
            query.reply_raw(key, ros_types.encode(response, f"{kind}_Response"), attachment.packed())

        context.link.declare_queryable(key, reply, complete=True)
        context.link.declare_token(token)

    def _endpoint(self, how: str, name: str, kind: str, qos: Qos) -> tuple[str, str]:
        """Return key and token of a new endpoint."""
        endpoint = Endpoint(how, name, dds_name(kind), ros_types.type_hash(kind))
        token = endpoint_token(self._identity, next(self._context.numbers), endpoint, qos)
        return data_key(self._context.domain, *endpoint[1:]), token


class Publisher:
    """A publisher of a topic."""

    def __init__(self, context: RosContext, key: str, kind: str, qos: Qos, gid: bytes) -> None:
        self._context = context
        self._kind = kind
        self._gid = gid
        self._sent = 0
        self.key = key
        if qos.transient_local:  # later subscribers receive the last message, too
            self._write = lambda payload, attached: context.link.put_cached(key, payload, CDR, attached)
        else:
            self._write = context.link.declare_publisher(key, CDR)

    def publish(self, message: Any) -> None:
        """Send a message; a subscriber that is too slow loses it, the publisher never waits.

        Raises:
            ValueError: the message does not fit its type.
        """
        payload = ros_types.encode(message, self._kind)
        self._sent += 1
        self._write(payload, Attachment(self._sent, self._context.wall_ns(), self._gid).packed())
