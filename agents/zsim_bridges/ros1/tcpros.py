"""TCPROS, the wire format of ROS 1's topics and services: connection headers, frames and messages.

A connection begins with a header of each side; then come frames: a length and so many bytes. All lengths are
little-endian uint32. Sources: wiki.ros.org/ROS/TCPROS and wiki.ros.org/ROS/Connection Header.
"""

import asyncio
import socket
import struct
from asyncio import IncompleteReadError, StreamReader, StreamWriter
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

HEADER_MAX = 1_000_000  # bytes; definitions of the largest messages have some 10 000
FRAME_MAX = 1_000_000  # bytes; nodes send commands alone
HANDSHAKE_S = 10.0  # within which a header must come
ANY_TYPE = "*"  # md5sum or type of a node that takes any
CONNECTION_ERRORS = (OSError, IncompleteReadError, TimeoutError, ValueError, OverflowError)
"""Errors that end a connection: it is gone, silent, or not TCPROS."""
_LENGTH = struct.Struct("<I")


class TopicType(NamedTuple):
    """Name, type, MD5 sum and definition of a topic or service, which must agree on both sides."""

    name: str
    type: str
    md5: str
    definition: str


class HeaderError(ValueError):
    """Bytes that are not a connection header."""


def frame(payload: bytes) -> bytes:
    """Return a payload behind its length."""
    return _LENGTH.pack(len(payload)) + payload


def encode_header(fields: Mapping[str, str]) -> bytes:
    """Return a header, its own length first."""
    return frame(b"".join(frame(f"{key}={value}".encode()) for key, value in fields.items()))


def decode_header(body: bytes) -> dict[str, str]:
    """Return the fields of a header without its own length.

    Raises:
        HeaderError: it is none.
    """
    fields: dict[str, str] = {}
    start = 0
    while start < len(body):
        first = start + _LENGTH.size
        if first > len(body) or (end := first + _LENGTH.unpack_from(body, start)[0]) > len(body):
            raise HeaderError("a field is longer than the header")
        key, separator, value = body[first:end].decode(errors="replace").partition("=")
        if not separator:
            raise HeaderError(f"a field is {key[:40]!r}; must be key=value")
        fields[key] = value
        start = end
    return fields


def publisher_header(topic_type: TopicType, caller: str) -> dict[str, str]:
    """Return the header that a publisher answers to a subscriber."""
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


def service_header(topic_type: TopicType, caller: str) -> dict[str, str]:
    """Return the header that a service answers to a client."""
    return {
        "callerid": caller,
        "md5sum": topic_type.md5,
        "request_type": f"{topic_type.type}Request",
        "response_type": f"{topic_type.type}Response",
        "type": topic_type.type,
    }


def mismatch(topic_type: TopicType, header: Mapping[str, str], caller: str) -> str | None:
    """Return why the type of a header differs from that of `caller`; None if they agree."""
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
        ValueError: it is longer than the limit.
        IncompleteReadError: the connection ended.
    """
    (size,) = _LENGTH.unpack(await reader.readexactly(_LENGTH.size))
    if size > limit:
        raise ValueError(f"a frame has {size} bytes; must have at most {limit}")
    return await reader.readexactly(size)


async def read_header(reader: StreamReader) -> dict[str, str]:
    """Return the header with which a connection begins.

    Raises:
        HeaderError: it is none.
        TimeoutError: it does not arrive.
    """
    return decode_header(await asyncio.wait_for(read_frame(reader, HEADER_MAX), HANDSHAKE_S))


async def send_error(writer: StreamWriter, reason: str) -> None:
    """Refuse a connection as ROS does: by a header with the reason."""
    writer.write(encode_header({"error": reason}))
    await writer.drain()


def configure(writer: StreamWriter, nodelay: bool) -> None:
    """Set whether small messages are sent at once, and notice a host that is gone."""
    raw: socket.socket = writer.get_extra_info("socket")
    raw.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, nodelay)
    raw.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)


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
float32 rotX            # deg, to the right positive
float32 rotY            # deg, nose down positive
float32 rotZ            # deg, counter-clockwise positive
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
"""  # fields of ardrone_autonomy 1.4.1, msg/Navdata.msg; the MD5 sum leaves comments out
EMPTY_SERVICE = TopicType("", "std_srvs/Empty", "d41d8cd98f00b204e9800998ecf8427e", "")  # MD5 of no text at all

_store = get_typestore(Stores.ROS1_NOETIC)
_store.register(get_types_from_msg(NAVDATA, "ardrone_autonomy/msg/Navdata"))
_store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", "tf2_msgs/msg/TFMessage"))


def topic_type_of(topic: str, kind: str) -> TopicType:
    """Return a topic of a type such as "sensor_msgs/Imu"."""
    definition, md5 = _store.generate_msgdef(_full_name(kind), ros_version=1)
    return TopicType(topic, kind, md5, definition)


def message_class(kind: str) -> Callable[..., Any]:
    return _store.types[_full_name(kind)]


def serialize(kind: str, message: Any) -> bytes:
    """Return the bytes of a message.

    Raises:
        ValueError: a number does not go into its field.
    """
    try:
        return bytes(_store.serialize_ros1(message, _full_name(kind)))
    except Exception as error:  # the generated writer raises anything for invalid numbers
        raise ValueError(f"is no {kind}: {error}") from error


def deserialize(kind: str, data: bytes) -> Any:
    """Return the message in bytes.

    Raises:
        ValueError: they are no such message.
    """
    try:
        return _store.deserialize_ros1(data, _full_name(kind))
    except Exception as error:  # the generated reader raises anything for invalid bytes
        raise ValueError(f"{len(data)} bytes are no {kind}") from error


def _full_name(kind: str) -> str:
    return kind.replace("/", "/msg/")
