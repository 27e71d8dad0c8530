"""Frames of MAVLink 1 and 2: messages packed for a link, and what comes in taken apart.

Source: https://mavlink.io/en/guide/serialization.html.
"""

from collections import Counter
from typing import Literal, NamedTuple

from zsim_bridges.mavlink.wire.checksum import checksum
from zsim_bridges.mavlink.wire.signing import SIGNATURE_BYTES, Signing
from zsim_bridges.mavlink.wire.wire_message import BY_ID, LAYOUTS, MessageLayout, WireMessage

MAGIC_1, MAGIC_2 = 0xFE, 0xFD  # first byte of a frame
HEADER_1, HEADER_2 = 6, 10  # bytes before the payload
CHECKSUM_BYTES = 2
SIGNED = 0x01  # MAVLINK_IFLAG_SIGNED
ID_MAX_1 = 255  # message ids have one byte in MAVLink 1
Version = Literal[1, 2]


class Received(NamedTuple):
    """A message, who sent it, its number on the link, and whether it was signed."""

    message: WireMessage
    system_id: int
    component_id: int
    seq: int
    signed: bool


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
            ValueError: MAVLink 1 cannot have the message.
            struct.error, OverflowError: a value is out of the range of its type, or an array has another length.
        """
        layout = LAYOUTS[type(message)]
        payload = layout.pack(message)
        seq, self._seq = self._seq, self._seq + 1 & 0xFF
        return self._frame_2(layout, payload, seq) if self._version == 2 else self._frame_1(layout, payload, seq)

    def _frame_1(self, layout: MessageLayout, payload: bytes, seq: int) -> bytes:
        if layout.id > ID_MAX_1:
            raise ValueError(f"{layout.name} has the id {layout.id}; MAVLink 1 has ids up to {ID_MAX_1}")
        payload = payload[: layout.base_size]
        body = bytes((len(payload), seq)) + self._address + bytes([layout.id]) + payload
        return b"\xfe" + body + _crc(body, layout)

    def _frame_2(self, layout: MessageLayout, payload: bytes, seq: int) -> bytes:
        payload = payload.rstrip(b"\0") or b"\0"  # one byte stays, however empty it is
        flags = SIGNED if self._signing else 0
        head = bytes((len(payload), flags, 0, seq))
        body = head + self._address + layout.id.to_bytes(3, "little") + payload
        frame = b"\xfd" + body + _crc(body, layout)
        return frame + self._signing.sign(frame) if self._signing else frame


class Parser:
    """Takes apart what comes in on a link, frame by frame.

    Args:
        signing: checks signatures; None where none is looked at.
        datagrams: whether a frame ends in the part in which it begins.

    Attributes:
        refused: frames by reason: `bad_crc`, `unknown` (not in the dialect), `incompatible` (flags that this is not
            to ignore), `truncated`, `unsigned`, `bad_signature`, `replayed`; and `noise`, bytes outside of frames.
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
            result = self._taken(frame)
            start = begin + 1 if result == "bad_crc" else frame.end
            if isinstance(result, str):
                self.refused[result] += 1
            else:
                received.append(result)
        self._rest = b"" if begin is None else data[begin:]
        return received

    def _next_magic(self, data: bytes, start: int) -> int | None:
        """Return where the next frame begins, None where no further one does."""
        if start < len(data) and data[start] in (MAGIC_1, MAGIC_2):
            return start
        places = [place for place in (data.find(b"\xfd", start), data.find(b"\xfe", start)) if place >= 0]
        self.refused["noise"] += (min(places) if places else len(data)) - start
        return min(places) if places else None

    def _taken(self, frame: "_Frame") -> Received | str:
        """Return the message of a frame, or why it is refused."""
        layout = BY_ID.get(frame.message_id)
        if layout is None:
            return "unknown"
        if _crc(frame.body, layout) != frame.crc:
            return "bad_crc"
        if frame.flags & ~SIGNED:
            return "incompatible"
        refusal = self._signature_refusal(frame)
        if refusal:
            return refusal
        return Received(layout.unpack(frame.payload), *frame.sender, frame.seq, bool(frame.signature))

    def _signature_refusal(self, frame: "_Frame") -> str | None:
        if self._signing is None:
            return None
        if frame.signature:
            return self._signing.refusal(frame.signed, frame.signature, *frame.sender)
        return None if self._signing.accepts_unsigned(frame.message_id) else "unsigned"


class _Frame:
    """A frame in the data: where its parts are."""

    __slots__ = ("_begin", "_data", "_header", "_payload_end", "end", "flags")

    def __init__(self, data: bytes, begin: int, header: int, flags: int) -> None:
        self._data = data
        self._begin = begin
        self._header = header
        self.flags = flags
        self._payload_end = begin + header + data[begin + 1]
        self.end = self._payload_end + CHECKSUM_BYTES + (SIGNATURE_BYTES if flags & SIGNED else 0)

    @classmethod
    def at(cls, data: bytes, begin: int) -> "_Frame | None":
        """Return the frame that begins at a place; None where it does not end in the data."""
        is_2 = data[begin] == MAGIC_2
        header = HEADER_2 if is_2 else HEADER_1
        if begin + header + CHECKSUM_BYTES > len(data):
            return None
        frame = cls(data, begin, header, data[begin + 2] if is_2 else 0)
        return frame if frame.end <= len(data) else None

    @property
    def message_id(self) -> int:
        begin = self._begin
        if self._header == HEADER_1:
            return self._data[begin + 5]
        return int.from_bytes(self._data[begin + 7 : begin + 10], "little")

    @property
    def sender(self) -> tuple[int, int]:
        place = self._begin + (3 if self._header == HEADER_1 else 5)
        return self._data[place], self._data[place + 1]

    @property
    def seq(self) -> int:
        return self._data[self._begin + (2 if self._header == HEADER_1 else 4)]

    @property
    def body(self) -> bytes:
        """What is summed: all but the first byte, up to the payload's end."""
        return self._data[self._begin + 1 : self._payload_end]

    @property
    def payload(self) -> bytes:
        return self._data[self._begin + self._header : self._payload_end]

    @property
    def crc(self) -> bytes:
        return self._data[self._payload_end : self._payload_end + CHECKSUM_BYTES]

    @property
    def signed(self) -> bytes:
        """What a signature is about, but for its own head: the frame, header to checksum."""
        return self._data[self._begin : self._payload_end + CHECKSUM_BYTES]

    @property
    def signature(self) -> bytes:
        return self._data[self._payload_end + CHECKSUM_BYTES : self.end]


def _crc(body: bytes, layout: MessageLayout) -> bytes:
    return checksum(body + layout.crc_extra_byte).to_bytes(2, "little")
