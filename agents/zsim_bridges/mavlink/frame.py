"""Frames of MAVLink 1 and 2: messages packed and signed for a link, and received bytes taken apart.

Sources: https://mavlink.io/en/guide/serialization.html, https://mavlink.io/en/guide/message_signing.html.
"""

import hmac
from collections import Counter
from hashlib import sha256
from typing import Literal, NamedTuple

from zsim_bridges.mavlink.dialect import BY_ID, LAYOUTS, MessageLayout, WireMessage, checksum

MAGIC_1, MAGIC_2 = 0xFE, 0xFD  # first byte of a frame
HEADER_1, HEADER_2 = 6, 10  # bytes before the payload
CHECKSUM_BYTES = 2
SIGNED = 0x01  # MAVLINK_IFLAG_SIGNED
ID_MAX_1 = 255  # message ids have one byte in MAVLink 1
KEY_BYTES = 32  # a secret key
SIGNATURE_BYTES = 13  # link id, 6 of time, 6 of hash
HASH_BYTES = 6  # the first of SHA-256
LINK_ID = b"\0"  # of signatures
TICKS_PER_S = 100_000  # unit of timestamps: 10 us
EPOCH_S = 1_420_070_400  # 2015-01-01 in seconds since 1970: zero of timestamps
BEHIND_MAX = 6_000_000  # ticks, a minute: greatest lag of a new stream
TIMESTAMP_MAX = 2**48 - 1
STREAMS_MAX = 4096  # remembered; only holders of the key begin any
Version = Literal[1, 2]


class Received(NamedTuple):
    """A message, its sender, its number on the link, and whether it was signed."""

    message: WireMessage
    system_id: int
    component_id: int
    seq: int
    signed: bool


class Signing:
    """Signs frames with a key of 32 bytes, and checks the signatures of received ones.

    Attributes:
        timestamp: of the newest frame signed or accepted [10 us since 2015].
    """

    def __init__(self, key: bytes) -> None:
        if len(key) != KEY_BYTES:
            raise ValueError(f"the signing key has {len(key)} bytes; must have {KEY_BYTES}")
        self._key = key
        self._streams: dict[tuple[int, int, int], int] = {}
        self.timestamp = 0

    def advance(self, unix_s: float) -> None:
        """Follow the wall clock [s since 1970]; timestamps never go back."""
        self.timestamp = max(self.timestamp, min(TIMESTAMP_MAX, int((unix_s - EPOCH_S) * TICKS_PER_S)))

    def sign(self, frame: bytes) -> bytes:
        """Return the signature that follows a frame, header to checksum."""
        self.timestamp += 1
        head = LINK_ID + self.timestamp.to_bytes(6, "little")
        return head + self._hash(frame + head)

    def refusal(self, frame: bytes, signature: bytes, system_id: int, component_id: int) -> str | None:
        """Return why a signed frame is refused, `bad_signature` or `replayed`; None if it is accepted."""
        if not hmac.compare_digest(self._hash(frame + signature[:-HASH_BYTES]), signature[-HASH_BYTES:]):
            return "bad_signature"
        stream = system_id, component_id, signature[0]
        timestamp = int.from_bytes(signature[1:7], "little")
        known = self._streams.get(stream)
        oldest = self.timestamp - BEHIND_MAX if known is None else known + 1
        if timestamp < oldest or (known is None and len(self._streams) >= STREAMS_MAX):
            return "replayed"
        self._streams[stream] = timestamp
        self.timestamp = max(self.timestamp, timestamp)
        return None

    def _hash(self, data: bytes) -> bytes:
        return sha256(self._key + data).digest()[:HASH_BYTES]


class Link:
    """Packs the messages of one component for one link, and numbers them; MAVLink 1 has no extensions or signatures."""

    def __init__(self, system_id: int, component_id: int, signing: Signing | None = None, version: Version = 2) -> None:
        self._address = bytes([system_id, component_id])
        self._signing = signing
        self._version = version
        self._seq = 0

    def pack(self, message: WireMessage) -> bytes:
        """Return the frame of a message.

        Raises:
            ValueError: MAVLink 1 has no place for the message.
            struct.error, OverflowError: a value is out of the range of its type, or an array has another length.
        """
        layout = LAYOUTS[type(message)]
        payload = layout.pack(message)
        seq, self._seq = self._seq, self._seq + 1 & 0xFF
        if self._version == 1:
            if layout.id > ID_MAX_1:
                raise ValueError(f"{layout.name} has the id {layout.id}; MAVLink 1 has ids up to {ID_MAX_1}")
            payload = payload[: layout.base_size]
            body = bytes((len(payload), seq)) + self._address + bytes([layout.id]) + payload
            return b"\xfe" + body + _crc(body, layout)
        payload = payload.rstrip(b"\0") or b"\0"  # an empty payload keeps one byte
        head = bytes((len(payload), SIGNED if self._signing else 0, 0, seq))
        body = head + self._address + layout.id.to_bytes(3, "little") + payload
        frame = b"\xfd" + body + _crc(body, layout)
        return frame + self._signing.sign(frame) if self._signing else frame


class Parser:
    """Splits received datagrams into frames and decodes them.

    Args:
        signing: checks signatures, without which no frame is accepted; None to read frames unchecked.

    Attributes:
        refused: frames by reason: `bad_crc`, `unknown` (not in the dialect), `incompatible` (flags that must not be
            ignored), `truncated`, `unsigned`, `bad_signature`, `replayed`; and `noise`, bytes outside frames.
    """

    def __init__(self, signing: Signing | None = None) -> None:
        self._signing = signing
        self.refused: Counter[str] = Counter()

    def feed(self, data: bytes) -> list[Received]:
        received, start = [], 0
        while (begin := self._next_magic(data, start)) is not None:
            end = _frame_end(data, begin)
            result = "truncated" if end is None else self._accept(data, begin, end)
            start = begin + 1 if end is None or result == "bad_crc" else end
            if isinstance(result, str):
                self.refused[result] += 1
            else:
                received.append(result)
        return received

    def _next_magic(self, data: bytes, start: int) -> int | None:
        if start < len(data) and data[start] in (MAGIC_1, MAGIC_2):
            return start
        places = [place for place in (data.find(b"\xfd", start), data.find(b"\xfe", start)) if place >= 0]
        self.refused["noise"] += (min(places) if places else len(data)) - start
        return min(places) if places else None

    def _accept(self, data: bytes, begin: int, end: int) -> Received | str:
        """Return the message of a whole frame, or why it is refused."""
        is_2 = data[begin] == MAGIC_2
        flags = data[begin + 2] if is_2 else 0
        at = begin + (4 if is_2 else 2)  # of the sequence number; sender and message id follow
        payload_at = begin + (HEADER_2 if is_2 else HEADER_1)
        payload_end = payload_at + data[begin + 1]
        signed_end = payload_end + CHECKSUM_BYTES
        sender = data[at + 1], data[at + 2]
        layout = BY_ID.get(int.from_bytes(data[at + 3 : payload_at], "little"))
        if layout is None:
            return "unknown"
        if _crc(data[begin + 1 : payload_end], layout) != data[payload_end:signed_end]:
            return "bad_crc"
        if flags & ~SIGNED:
            return "incompatible"
        if self._signing is not None:
            if not flags & SIGNED:
                return "unsigned"
            if refusal := self._signing.refusal(data[begin:signed_end], data[signed_end:end], *sender):
                return refusal
        return Received(layout.unpack(data[payload_at:payload_end]), *sender, data[at], bool(flags & SIGNED))


def _frame_end(data: bytes, begin: int) -> int | None:
    """Return where the frame that begins at a place ends; None if the data end before it does."""
    is_2 = data[begin] == MAGIC_2
    header = HEADER_2 if is_2 else HEADER_1
    if begin + header + CHECKSUM_BYTES > len(data):
        return None
    signature = SIGNATURE_BYTES if is_2 and data[begin + 2] & SIGNED else 0
    end = begin + header + data[begin + 1] + CHECKSUM_BYTES + signature
    return end if end <= len(data) else None


def _crc(body: bytes, layout: MessageLayout) -> bytes:
    """Return the checksum of a frame from its second byte to the end of its payload."""
    return checksum(body + layout.crc_extra_byte).to_bytes(2, "little")
