"""Frames of MAVLink 1 and 2: messages packed and signed for a link, and received bytes taken apart.

Sources: https://mavlink.io/en/guide/serialization.html, https://mavlink.io/en/guide/message_signing.html.
"""

import hmac
from collections import Counter
from collections.abc import Collection
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
TICKS_PER_S = 100_000  # timestamps count 10 us
EPOCH_S = 1_420_070_400  # 2015-01-01 in seconds since 1970: zero of timestamps
BEHIND_MAX = 6_000_000  # ticks, a minute: a new stream may be behind that much
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
    """Signs frames with a key, and checks the signatures of received ones.

    Args:
        key: the secret, 32 bytes.
        link_id: of the frames that it signs.
        accepts_unsigned: whether frames without a signature are accepted, or the ids of the messages that are.

    Attributes:
        timestamp: of the newest frame signed or accepted [10 us since 2015].
    """

    def __init__(self, key: bytes, link_id: int = 0, accepts_unsigned: bool | Collection[int] = False) -> None:
        if len(key) != KEY_BYTES:
            raise ValueError(f"the signing key has {len(key)} bytes; must have {KEY_BYTES}")
        self._key = key
        self._link = bytes([link_id])
        self._accepts_unsigned = accepts_unsigned
        self._streams: dict[tuple[int, int, int], int] = {}
        self.timestamp = 0

    def advance(self, unix_s: float) -> None:
        """Follow the wall clock [s since 1970]; timestamps never go back."""
        self.timestamp = max(self.timestamp, min(TIMESTAMP_MAX, int((unix_s - EPOCH_S) * TICKS_PER_S)))

    def accepts_unsigned(self, message_id: int) -> bool:
        """Return whether a message is accepted without a signature."""
        policy = self._accepts_unsigned
        return policy if isinstance(policy, bool) else message_id in policy

    def sign(self, frame: bytes) -> bytes:
        """Return the signature that follows a frame, header to checksum."""
        self.timestamp += 1
        head = self._link + self.timestamp.to_bytes(6, "little")
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
    """Packs the messages of one component for one link, and numbers them.

    Args:
        system_id, component_id: of the sender.
        signing: signs what is packed.
        version: of MAVLink; 1 has no extensions and no signatures.
    """

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
    """Takes the received bytes of a link apart, frame by frame.

    Args:
        signing: checks signatures; None to read frames unchecked.
        datagrams: whether a frame ends in the part in which it begins.

    Attributes:
        refused: frames by reason: `bad_crc`, `unknown` (not in the dialect), `incompatible` (flags that must not be
            ignored), `truncated`, `unsigned`, `bad_signature`, `replayed`; and `noise`, bytes outside frames.
    """

    def __init__(self, signing: Signing | None = None, datagrams: bool = True) -> None:
        self._signing = signing
        self._datagrams = datagrams
        self._rest = b""
        self.refused: Counter[str] = Counter()

    def feed(self, data: bytes) -> list[Received]:
        """Return the messages that are complete and accepted."""
        data = self._rest + data
        received, start = [], 0
        while (begin := self._next_magic(data, start)) is not None:
            frame = _Frame.at(data, begin)
            if frame is None:
                if not self._datagrams:
                    break  # the rest is to come
                self.refused["truncated"] += 1
                start = begin + 1
                continue
            result = self._accept(frame)
            start = begin + 1 if result == "bad_crc" else frame.end
            if isinstance(result, str):
                self.refused[result] += 1
            else:
                received.append(result)
        self._rest = b"" if begin is None else data[begin:]
        return received

    def _next_magic(self, data: bytes, start: int) -> int | None:
        """Return where the next frame begins; None if there is none."""
        if start < len(data) and data[start] in (MAGIC_1, MAGIC_2):
            return start
        places = [place for place in (data.find(b"\xfd", start), data.find(b"\xfe", start)) if place >= 0]
        self.refused["noise"] += (min(places) if places else len(data)) - start
        return min(places) if places else None

    def _accept(self, frame: "_Frame") -> Received | str:
        """Return the message of a frame, or why it is refused."""
        layout = BY_ID.get(frame.message_id)
        if layout is None:
            return "unknown"
        if _crc(frame.body, layout) != frame.crc:
            return "bad_crc"
        if frame.flags & ~SIGNED:
            return "incompatible"
        if self._signing is not None:
            if frame.signature:
                if refusal := self._signing.refusal(frame.signed, frame.signature, *frame.sender):
                    return refusal
            elif not self._signing.accepts_unsigned(frame.message_id):
                return "unsigned"
        return Received(layout.unpack(frame.payload), *frame.sender, frame.seq, bool(frame.signature))


class _Frame(NamedTuple):
    """The parts of a frame.

    Attributes:
        sender: system and component id.
        body: what the checksum covers: all but the first byte, to the end of the payload.
        signed: what a signature covers beside its own head: header to checksum.
        end: of the frame in the data.
    """

    flags: int
    seq: int
    sender: tuple[int, int]
    message_id: int
    body: bytes
    payload: bytes
    crc: bytes
    signed: bytes
    signature: bytes
    end: int

    @classmethod
    def at(cls, data: bytes, begin: int) -> "_Frame | None":
        """Return the frame that begins at a place; None if the data end before it does."""
        is_2 = data[begin] == MAGIC_2
        header = HEADER_2 if is_2 else HEADER_1
        if begin + header + CHECKSUM_BYTES > len(data):
            return None
        flags = data[begin + 2] if is_2 else 0
        payload_end = begin + header + data[begin + 1]
        signed_end = payload_end + CHECKSUM_BYTES
        end = signed_end + (SIGNATURE_BYTES if flags & SIGNED else 0)
        if end > len(data):
            return None
        at = begin + (4 if is_2 else 2)  # of the sequence number; sender and message id follow
        return cls(
            flags,
            data[at],
            (data[at + 1], data[at + 2]),
            int.from_bytes(data[at + 3 : begin + header], "little"),
            data[begin + 1 : payload_end],
            data[begin + header : payload_end],
            data[payload_end:signed_end],
            data[begin:signed_end],
            data[signed_end:end],
            end,
        )


def _crc(body: bytes, layout: MessageLayout) -> bytes:
    return checksum(body + layout.crc_extra_byte).to_bytes(2, "little")
