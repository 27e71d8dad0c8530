"""TCPROS, the wire format of ROS 1's topics and services: connection headers and frames. Pure.

A connection begins with a header of each side; then come frames: a length and so many bytes. All lengths are
little-endian uint32. Sources: wiki.ros.org/ROS/TCPROS and wiki.ros.org/ROS/Connection Header.
"""

import struct
from collections.abc import Mapping
from typing import NamedTuple

HEADER_MAX = 1_000_000  # bytes; definitions of the largest messages have some 10 000
ANY_TYPE = "*"  # md5sum or type of who takes whatever comes
_LENGTH = struct.Struct("<I")
LENGTH_SIZE = _LENGTH.size


class TopicType(NamedTuple):
    """A topic or service as both sides must know it."""

    name: str
    type: str
    md5: str
    definition: str


class HeaderError(ValueError):
    """Bytes that are no connection header."""


def frame(payload: bytes) -> bytes:
    """Return a payload behind its length."""
    return _LENGTH.pack(len(payload)) + payload


def length(head: bytes | memoryview) -> int:
    """Return the length that four bytes say."""
    return _LENGTH.unpack(head)[0]


def encode_header(fields: Mapping[str, str]) -> bytes:
    """Return a header, its own length first."""
    return frame(b"".join(frame(f"{key}={value}".encode()) for key, value in fields.items()))


def decode_header(body: bytes) -> dict[str, str]:
    """Return the fields of a header without its own length.

    Raises:
        HeaderError: it is none.
    """
    fields: dict[str, str] = {}
    rest = memoryview(body)
    while rest:
        if len(rest) < LENGTH_SIZE or length(rest[:LENGTH_SIZE]) > len(rest) - LENGTH_SIZE:
            raise HeaderError("a field is longer than the header")
        end = LENGTH_SIZE + length(rest[:LENGTH_SIZE])
        key, found, value = bytes(rest[LENGTH_SIZE:end]).decode(errors="replace").partition("=")
        if not found:
            raise HeaderError(f"a field is {key[:40]!r}; must be key=value")
        fields[key] = value
        rest = rest[end:]
    return fields


def publisher_header(offer: TopicType, caller: str) -> dict[str, str]:
    """Return what a publisher answers to a subscriber that it takes."""
    return {
        "callerid": caller,
        "latching": "0",
        "md5sum": offer.md5,
        "message_definition": offer.definition,
        "topic": offer.name,
        "type": offer.type,
    }


def subscriber_header(offer: TopicType, caller: str) -> dict[str, str]:
    """Return what a subscriber says to a publisher."""
    header = publisher_header(offer, caller) | {"tcp_nodelay": "1"}
    del header["latching"]
    return header


def service_header(offer: TopicType, caller: str) -> dict[str, str]:
    """Return what a service answers to a client that it takes."""
    return {
        "callerid": caller,
        "md5sum": offer.md5,
        "request_type": f"{offer.type}Request",
        "response_type": f"{offer.type}Response",
        "type": offer.type,
    }


def mismatch(offer: TopicType, header: Mapping[str, str], caller: str) -> str | None:
    """Return why the sender of a header and `caller` do not understand each other; None where they do."""
    missing = [field for field in ("callerid", "md5sum") if field not in header]
    if missing:
        return f"missing required {missing[0]!r} field"
    if header["md5sum"] in (ANY_TYPE, offer.md5):
        return None
    wanted = f"{header.get('type', offer.type)}/{header['md5sum']}"
    return (
        f"[{header['callerid']}] wants [{offer.name}] to have datatype/md5sum [{wanted}], "
        f"but [{caller}] has [{offer.type}/{offer.md5}]"
    )
