"""Navdata: the packets that an aircraft sends from UDP port 5554.

A packet is a header (magic, state bits, sequence number, vision flag; uint32 each), options, and last the checksum
option, the sum of all bytes before it. All is little-endian and packed.

Source: AR.Drone Developer Guide SDK 2.0, chapter 7; ARDroneLib, navdata_common.h and config.h.
"""

import struct
from collections.abc import Callable, Iterable, Sequence
from enum import IntEnum, IntFlag
from typing import Any, NamedTuple

import numpy as np

from zsim_bridges.ardrone.wire.navdata_options import CHECKSUM_TAG, HEADER, LAYOUTS, OptionLayout

PORT = 5554  # UDP (ARDroneLib, config.h)
REQUEST_UNICAST = b"\x01\x00\x00\x00"  # what a program sends to be sent navdata (ARDroneLib, navdata client)
MAGIC = 0x5566_7788
MAGICS = (MAGIC, 0x5566_7789)  # of a drone with a newer firmware (npm ar-drone, parseNavdata.js)
DEMO_RATE_HZ, FULL_RATE_HZ = 15, 200  # Developer Guide 7.1
DEMO_OPTIONS = 1 << 0 | 1 << 16  # default of general:navdata_options: demo, vision_detect
_START = struct.Struct("<IIII")
_SUM = struct.Struct("<HHI")
_MOST = 1 << 32


class StateBit(IntFlag):
    """The state word of a packet (ARDroneLib, config.h)."""

    FLYING = 1 << 0
    VIDEO = 1 << 1
    VISION = 1 << 2
    ANGULAR_SPEED_CONTROL = 1 << 3
    ALTITUDE_CONTROL = 1 << 4
    USER_FEEDBACK = 1 << 5
    COMMAND_ACK = 1 << 6
    CAMERA_READY = 1 << 7
    TRAVELLING = 1 << 8
    USB_READY = 1 << 9
    NAVDATA_DEMO = 1 << 10
    NAVDATA_BOOTSTRAP = 1 << 11
    MOTORS_FAULT = 1 << 12
    COM_LOST = 1 << 13
    SOFTWARE_FAULT = 1 << 14
    BATTERY_LOW = 1 << 15
    USER_EMERGENCY = 1 << 16
    TIMER_ELAPSED = 1 << 17
    MAGNETO_NEEDS_CALIBRATION = 1 << 18
    ANGLES_OUT_OF_RANGE = 1 << 19
    TOO_MUCH_WIND = 1 << 20
    ULTRASOUND_DEAF = 1 << 21
    CUTOUT = 1 << 22
    PIC_VERSION_OK = 1 << 23
    AT_THREAD = 1 << 24
    NAVDATA_THREAD = 1 << 25
    VIDEO_THREAD = 1 << 26
    ACQUISITION_THREAD = 1 << 27
    CONTROL_WATCHDOG = 1 << 28
    ADC_WATCHDOG = 1 << 29
    COM_WATCHDOG = 1 << 30
    EMERGENCY = 1 << 31


class ControlState(IntEnum):
    """The upper half of demo's ctrl_state (ARDroneLib, control_states.h)."""

    DEFAULT = 0
    INIT = 1
    LANDED = 2
    FLYING = 3
    HOVERING = 4
    TEST = 5
    TAKING_OFF = 6
    GO_TO_FIX = 7
    LANDING = 8
    LOOPING = 9


class Hovering(IntEnum):
    """The lower half of ctrl_state while it hovers, as far as it is used (control_states.h)."""

    OK = 0
    LOST_COM = 8
    MAGNETO_CALIBRATION = 12


class NavdataError(ValueError):
    """A datagram is no navdata; the text says why."""


class Navdata(NamedTuple):
    """A packet.

    Attributes:
        state: its bits.
        sequence: of the packet.
        vision: whether the camera defines a frame.
        options: by tag, each a NamedTuple of `navdata_options`.
        unknown: options that this layout does not know: tags whose size differs, or that are new.
    """

    state: StateBit
    sequence: int
    vision: int
    options: dict[int, Any]
    unknown: dict[int, bytes]

    @property
    def bootstrap(self) -> bool:
        return StateBit.NAVDATA_BOOTSTRAP in self.state


def checksum(packet: bytes | bytearray | memoryview) -> int:
    """Return the sum of all bytes before the checksum option."""
    return int(np.frombuffer(packet, np.uint8).sum(dtype=np.uint64)) % _MOST


def pack(state: int, sequence: int, vision: int, options: Iterable[tuple[int, Iterable[Any]]] = ()) -> bytes:
    """Return a packet.

    Args:
        state: bits.
        sequence: from 1 on.
        vision: flag of the header.
        options: tag and values of each, in the order of the wire.

    Raises:
        struct.error: a value is beyond what its field can hold.
    """
    parts = [_START.pack(MAGIC, state, sequence, vision)]
    for tag, values in options:
        layout = LAYOUTS[tag]
        parts += [HEADER.pack(tag, layout.size), layout.codec.pack(*layout.flat(values))]
    body = b"".join(parts)
    return body + _SUM.pack(CHECKSUM_TAG, _SUM.size, checksum(body))


def unpack(datagram: bytes) -> Navdata:
    """Return a packet.

    Raises:
        NavdataError: it is none, or its checksum is wrong.
    """
    if len(datagram) < _START.size + _SUM.size:
        raise NavdataError(f"has {len(datagram)} bytes; must have at least {_START.size + _SUM.size}")
    magic, state, sequence, vision = _START.unpack_from(datagram)
    if magic not in MAGICS:
        raise NavdataError(f"begins with 0x{magic:08x}; must be one of {', '.join(f'0x{each:08x}' for each in MAGICS)}")
    options: dict[int, Any] = {}
    unknown: dict[int, bytes] = {}
    at = _START.size
    while True:
        tag, size = _option_header(datagram, at)
        if tag == CHECKSUM_TAG:
            _check_sum(datagram, at, size)
            return Navdata(StateBit(state), sequence, vision, options, unknown)
        layout = LAYOUTS.get(tag)
        if layout is not None and layout.size == size:
            options[tag] = layout.nested(layout.codec.unpack_from(datagram, at + HEADER.size))
        else:
            unknown[tag] = datagram[at + HEADER.size : at + size]
        at += size


def _option_header(datagram: bytes, at: int) -> tuple[int, int]:
    if at + HEADER.size > len(datagram):
        raise NavdataError("has no checksum")
    tag, size = HEADER.unpack_from(datagram, at)
    if size < HEADER.size or at + size > len(datagram):
        raise NavdataError(f"option {tag} at byte {at} has the size {size}, beyond the packet's {len(datagram)} bytes")
    return tag, size


def _check_sum(datagram: bytes, at: int, size: int) -> None:
    if size != _SUM.size:
        raise NavdataError(f"the checksum's size is {size}; must be {_SUM.size}")
    found, expected = _SUM.unpack_from(datagram, at)[2], checksum(datagram[:at])
    if found != expected:
        raise NavdataError(f"the checksum is {found}; must be {expected}")


class NavdataTemplate:
    """A packet that is made once and filled anew for each sending; options keep what they had before.

    Args:
        tags: of its options, in the order of the wire.
    """

    def __init__(self, tags: Sequence[int]) -> None:
        self.tags = tuple(tags)
        self._packet = bytearray(pack(0, 0, 0, ((tag, LAYOUTS[tag].zeros()) for tag in tags)))
        self._end = len(self._packet) - _SUM.size
        self._body = np.frombuffer(self._packet, np.uint8)[: self._end]
        self._layouts: dict[int, tuple[OptionLayout, int]] = {}
        at = _START.size
        for tag in tags:
            self._layouts[tag] = LAYOUTS[tag], at + HEADER.size
            at += LAYOUTS[tag].size

    def filler(self, tag: int) -> Callable[..., None]:
        """Return what puts the flat numbers of an option into the packet; for an option that is not in it, nothing."""
        if tag not in self._layouts:
            return _put_nothing
        layout, at = self._layouts[tag]
        pack_into, packet = layout.codec.pack_into, self._packet
        return lambda *numbers: pack_into(packet, at, *numbers)

    def put(self, tag: int, values: Iterable[Any]) -> None:
        """Put the values of an option into the packet.

        Raises:
            struct.error: a value is beyond what its field can hold.
        """
        layout, at = self._layouts[tag]
        layout.codec.pack_into(self._packet, at, *layout.flat(values))

    def packet(self, state: int, sequence: int, vision: int) -> bytes:
        """Return the packet with its header and its checksum."""
        _START.pack_into(self._packet, 0, MAGIC, state, sequence, vision)
        total = int(self._body.sum(dtype=np.uint64)) % _MOST
        _SUM.pack_into(self._packet, self._end, CHECKSUM_TAG, _SUM.size, total)
        return bytes(self._packet)


def _put_nothing(*_numbers: Any) -> None:
    """Leave out an option that the packet does not have."""
