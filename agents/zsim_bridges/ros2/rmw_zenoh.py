"""A ROS 2 context in rmw_zenoh's wire format: types and their hashes, names, keys and tokens; nodes and endpoints.

Follows ros2/rmw_zenoh as shipped with Jazzy (from 0.2.4), Kilted and Rolling: `liveliness_utils.cpp` for tokens and
quality of service, `attachment_helpers.cpp` for attachments. Humble's version has neither type hashes nor this
attachment. Type hashes are those of REP-2011; the types used here are the same from Iron to Lyrical.

The wire format comes first, without any I/O; then the context, whose nodes have publishers, subscriptions and services;
then the types: classes, CDR, and definitions that rosbags lacks.
"""

import re
import struct
from collections.abc import Callable, Iterable
from functools import cache
from itertools import count
from typing import Any, NamedTuple

import xxhash
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from zsim.transport.session import Query, RawSample, Session

CDR = "application/cdr"
_INVALID_CHARACTERS = re.compile(r"[^a-z0-9]+")  # each sequence becomes one underscore, since ROS reserves double ones
TOKEN_SPACE = "@ros2_lv"  # prefix of all tokens; `**` does not match it
TOKEN_PARTS = 13  # parts of an endpoint's token
GID_BYTES = 16
_ATTACHMENT_HEADER = struct.Struct("<qqB")  # sequence number, wall time [ns], length of the gid
ATTACHMENT_BYTES = _ATTACHMENT_HEADER.size + GID_BYTES


def ros_name(name: str, prefix: str) -> str:
    """Return the nearest name valid in ROS: `quad-1.a` becomes `quad_1_a`, and a drone `7` becomes `drone_7`."""
    valid_name = _INVALID_CHARACTERS.sub("_", name)
    return f"{prefix}_{valid_name}" if valid_name[0].isdigit() else valid_name


def ros_names(names: Iterable[str], prefix: str) -> dict[str, str]:
    """Return the ROS name of each name; where several would be equal, the later ones get a number."""
    chosen_names: dict[str, str] = {}
    for name in names:
        base_name = unique_name = ros_name(name, prefix)
        number = 2
        while unique_name in chosen_names.values():
            unique_name, number = f"{base_name.rstrip('_')}_{number}", number + 1
        chosen_names[name] = unique_name
    return chosen_names


class Qos(NamedTuple):
    """Quality of service that an endpoint offers or requests; the last `depth` messages are kept."""

    depth: int = 10
    best_effort: bool = False
    transient_local: bool = False

    def text(self) -> str:
        """Return the text used in tokens, without rmw_zenoh's defaults (reliable, volatile, keep last)."""
        reliability = "2" if self.best_effort else ""
        durability = "1" if self.transient_local else ""
        return f"{reliability}:{durability}:,{self.depth}:,:,:,,"


SENSOR = Qos(depth=5, best_effort=True)  # rmw_qos_profile_sensor_data
DEFAULT = Qos(depth=10)  # rmw_qos_profile_default, also used for services
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
    """Return the name of a type on the wire: `std_msgs/msg/Empty` becomes `std_msgs::msg::dds_::Empty_`."""
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
    """Return the endpoint that a token describes; None if it describes no endpoint."""
    parts = token.split("/")
    if len(parts) != TOKEN_PARTS or parts[0] != TOKEN_SPACE:
        return None
    return Endpoint(parts[5], parts[9].replace("%", "/"), parts[10], parts[11])


def gid_of(token: str) -> bytes:
    """Return the identity of an endpoint: XXH3-128 of its token, the low half first, both little-endian."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(GID_BYTES, "little")


class Attachment(NamedTuple):
    """An attachment: sequence number (from 1), wall time [ns], and gid of the sender or, in a reply, of the client."""

    sequence: int
    wall_ns: int
    gid: bytes

    def packed(self) -> bytes:
        return _ATTACHMENT_HEADER.pack(self.sequence, self.wall_ns, GID_BYTES) + self.gid


def attachment_of(data: bytes) -> Attachment:
    """Decode an attachment.

    Raises:
        ValueError: the data are not an attachment of rmw_zenoh.
    """
    if len(data) != ATTACHMENT_BYTES or data[_ATTACHMENT_HEADER.size - 1] != GID_BYTES:
        raise ValueError(f"the attachment has {len(data)} bytes; must have {ATTACHMENT_BYTES} (rmw_zenoh >= 0.2.4)")
    sequence, wall_ns, _ = _ATTACHMENT_HEADER.unpack_from(data)
    return Attachment(sequence, wall_ns, data[_ATTACHMENT_HEADER.size :])


class RosContext:
    """A ROS context: the nodes of one process.

    Args:
        link: a session with full keys, without the prefix of a federation.
        wall_ns: returns the wall time since 1970 [ns].
        refuse: called, in Zenoh's threads, with the name of the topic or service and the reason for refusing a message.
    """

    def __init__(
        self, link: Session, domain: int, wall_ns: Callable[[], int], refuse: Callable[[str, str], None]
    ) -> None:
        self.link = link
        self.domain = domain
        self.wall_ns = wall_ns
        self.refuse = refuse
        self.numbers = count()  # numbers of nodes and endpoints
        self._zid = link.zid()

    def node(self, namespace: str, name: str) -> "Ros2Node":
        """Return a new node, which is visible to other nodes from now on."""
        return Ros2Node(self, NodeId(self.domain, self._zid, next(self.numbers), namespace, name))

    def on_subscription(self, callback: Callable[[str, bool], None]) -> None:
        """Call back with (token, alive), in a Zenoh thread, for the subscriptions of all contexts in the domain."""
        self.link.on_token(f"{TOKEN_SPACE}/{self.domain}/*/*/*/MS/**", callback)


class Ros2Node:
    """A node of a context. It declares an endpoint's token last, since other nodes may use the endpoint at once."""

    def __init__(self, context: RosContext, identity: NodeId) -> None:
        self._context = context
        self._identity = identity
        context.link.declare_token(node_token(identity))

    def publisher(self, topic: str, kind: str, qos: Qos) -> "Publisher":
        """Return a publisher of the topic with this full name."""
        key, token = self._endpoint("MP", topic, kind, qos)
        publisher = Publisher(self._context, key, kind, qos, gid_of(token))
        self._context.link.declare_token(token)
        return publisher

    def subscription(self, topic: str, kind: str, qos: Qos, callback: Callable[[Any], None]) -> Callable[[], None]:
        """Call back with every message on a topic, in a Zenoh thread, until the returned function is called."""
        context = self._context
        key, token = self._endpoint("MS", topic, kind, qos)

        def on_publication(sample: RawSample) -> None:
            try:
                attachment_of(sample.attachment)
                callback(decode(sample.payload, kind))
            except ValueError as error:
                context.refuse(topic, str(error))

        undeclare = context.link.declare_subscriber(key, on_publication)
        context.link.declare_token(token)
        return undeclare

    def service(self, name: str, kind: str, answer: Callable[[Any], Any]) -> None:
        """Answer a service's requests with what `answer`, called in a Zenoh thread, returns for each."""
        context = self._context
        key, token = self._endpoint("SS", name, kind, DEFAULT)

        def reply(query: Query) -> None:
            try:
                received = attachment_of(query.attachment)
                response = encode(answer(decode(query.payload, f"{kind}_Request")), f"{kind}_Response")
            except ValueError as error:
                query.end()
                context.refuse(name, str(error))
                return
            attachment = Attachment(received.sequence, context.wall_ns(), received.gid)
            query.reply_raw(key, response, attachment.packed())

        context.link.declare_queryable(key, reply, complete=True)
        context.link.declare_token(token)

    def _endpoint(self, endpoint_kind: str, name: str, kind: str, qos: Qos) -> tuple[str, str]:
        """Return the key and the token of a new endpoint."""
        endpoint = Endpoint(endpoint_kind, name, dds_name(kind), type_hash(kind))
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
        if qos.transient_local:  # later subscribers also receive the last message
            self._write = lambda payload, attachment: context.link.put_cached(key, payload, CDR, attachment)
        else:
            self._write = context.link.declare_publisher(key, CDR)

    def publish(self, message: Any) -> None:
        """Send a message without ever waiting; a subscriber that is too slow loses it.

        Raises:
            ValueError: a value does not fit its field.
        """
        payload = encode(message, self._kind)
        self._sent += 1
        self._write(payload, Attachment(self._sent, self._context.wall_ns(), self._gid).packed())


CLUSTER_STATE = """\
# The state of a formation according to its drones' estimates, and its desired state.
# names are the 4n cluster variables of n drones, in the order of value and desired [m, rad] and of desired_rate
# [m/s, rad/s].
std_msgs/Header header
# idle, taking_off, assembling, engaged, landing, held
string phase
string[] drones
string[] names
float64[] value
float64[] desired
float64[] desired_rate
# the trajectory's own time [s], NaN where none runs
float64 trajectory_time
# distance to a singularity, in the measure of the cluster space
float64 margin
# why it waits or is held
string reason
"""

NAVDATA = """\
# The fields of ardrone_autonomy's Navdata, in its units and signs (x forward, y left, z up), with names in the
# style of ROS 2. Fields without a sample yet are NaN, or 0 in integers.
std_msgs/Header header
# [%]
float32 battery_percent
# 2 landed, 3 flying, 4 hovering, 6 taking off, 8 landing, 0 emergency
uint32 state
# [uT]
float32 mag_x
float32 mag_y
float32 mag_z
# [Pa]
int32 pressure
# roll, pitch (nose down), yaw (counter-clockwise, from east) from the estimate [deg]
float32 rot_x
float32 rot_y
float32 rot_z
# by sonar [mm]
int32 altd
# by optical flow [mm/s]
float32 vx
float32 vy
float32 vz
# [g]
float32 ax
float32 ay
float32 az
# since the start [us]
float32 tm
"""

MESSAGES = {"zsim_msgs/msg/ClusterState": CLUSTER_STATE, "zsim_msgs/msg/Navdata": NAVDATA}
SERVICES = {"std_srvs/srv/Trigger": ("", "bool success\nstring message\n")}  # definitions of request and response
SERVICE_EVENT_INFO = """\
uint8 event_type
builtin_interfaces/Time stamp
uint8[16] client_gid
int64 sequence_number
"""
"""From service_msgs, whose `char[16]` is hashed as `uint8[16]`."""

PACKAGE = {  # a ROS 2 package that defines MESSAGES in ROS
    "package.xml": """\
<?xml version="1.0"?>
<package format="3">
  <name>zsim_msgs</name>
  <version>1.0.0</version>
  <description>Messages of zsim's ROS 2 bridge</description>
  <maintainer email="nobody@example.org">zsim</maintainer>
  <license>Apache-2.0</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
  <depend>std_msgs</depend>
  <exec_depend>rosidl_default_runtime</exec_depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
  <export><build_type>ament_cmake</build_type></export>
</package>
""",
    "CMakeLists.txt": """\
cmake_minimum_required(VERSION 3.8)
project(zsim_msgs)
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
find_package(std_msgs REQUIRED)
rosidl_generate_interfaces(${PROJECT_NAME} "msg/ClusterState.msg" "msg/Navdata.msg" DEPENDENCIES std_msgs)
ament_package()
""",
    "msg/ClusterState.msg": CLUSTER_STATE,
    "msg/Navdata.msg": NAVDATA,
}


_store = get_typestore(Stores.ROS2_JAZZY)
for _name, _text in MESSAGES.items():
    _store.register(get_types_from_msg(_text, _name))
for _name, _texts in SERVICES.items():
    for _part, _text in zip(("Request", "Response"), _texts, strict=True):
        _store.register(get_types_from_msg(_text, f"{_name}_{_part}"))


def message_class(name: str) -> Any:
    """Return the class of a type, named like `sensor_msgs/msg/Imu` or `std_srvs/srv/Trigger_Response`."""
    return _store.types[_rosbags_name(name)]


def encode(message: Any, name: str) -> bytes:
    """Return a message in little-endian CDR.

    Raises:
        ValueError: a value does not fit its field.
    """
    try:
        return bytes(_store.serialize_cdr(message, _rosbags_name(name), little_endian=True))
    except Exception as error:  # the generated writer may raise any exception for invalid values
        raise ValueError(f"the message is not a valid {name}: {error}") from error


def decode(payload: bytes, name: str) -> Any:
    """Return the message in a CDR payload.

    Raises:
        ValueError: the payload is not a CDR encoding of this type.
    """
    try:
        return _store.deserialize_cdr(payload, _rosbags_name(name))
    except (SerdeError, ValueError, IndexError, MemoryError, OverflowError) as error:
        reason = str(error) or type(error).__name__
        raise ValueError(f"{len(payload)} bytes are not a CDR encoding of {name} ({reason})") from error


@cache
def type_hash(name: str) -> str:
    """Return the hash of a message or service type by REP-2011: `RIHS01_` and 64 hexadecimal digits.

    A service is described by its request, its response, and an event with at most one of each, as in rosidl
    (rosidl_generator_type_description, `add_srv`).
    """
    if name not in SERVICES:
        return _store.hash_rihs01(name)

    def reference(kind: str) -> Any:
        return Nodetype.NAME, kind

    store = Typestore()
    store.fielddefs.update(_store.fielddefs)
    store.fielddefs.update(get_types_from_msg(SERVICE_EVENT_INFO, "service_msgs/msg/ServiceEventInfo"))
    request, response, event = f"{name}_Request", f"{name}_Response", f"{name}_Event"
    for part in (request, response):
        store.fielddefs[part] = _store.fielddefs[_rosbags_name(part)]
    event_fields = [
        ("info", reference("service_msgs/msg/ServiceEventInfo")),
        ("request", (Nodetype.SEQUENCE, (reference(request), 1))),
        ("response", (Nodetype.SEQUENCE, (reference(response), 1))),
    ]
    store.fielddefs[event] = [], event_fields
    members = {"request_message": request, "response_message": response, "event_message": event}
    store.fielddefs[name] = [], [(member, reference(kind)) for member, kind in members.items()]
    return store.hash_rihs01(name)


@cache
def _rosbags_name(name: str) -> str:
    """Return rosbags' name of a type; rosbags stores requests and responses as messages."""
    return name.replace("/srv/", "/srv/msg/")
