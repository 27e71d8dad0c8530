r"""AT commands: what a pilot's program sends to UDP port 5556.

A datagram holds one or more `AT*NAME=sequence,argument,...\r`, whole. Integers are decimal, strings stand in quotes, a
float is written as the signed integer that has the same 32 bits.

Source: AR.Drone Developer Guide SDK 2.0, chapter 6; ARDroneLib, ardrone_api.c.
"""

import math
import re
import struct
from collections.abc import Callable
from typing import Any, NamedTuple

PORT = 5556  # UDP (ARDroneLib, config.h)
DATAGRAM_MAX = 8192  # bytes, chosen: eight commands of the greatest length
COMMAND_MAX = 1024  # characters of a command, its end included (Developer Guide 6.1)
REF_CONSTANT = 0x1154_0000  # bits 18, 20, 22, 24, 28, which are always set (Developer Guide 6.6)
TAKE_OFF_BIT, EMERGENCY_BIT = 1 << 9, 1 << 8  # of REF (Developer Guide 6.6)
PROGRESSIVE, COMBINED_YAW, ABSOLUTE = 1, 2, 4  # bits of a PCMD's flag (Developer Guide 6.6)
SEND_CONFIGURATION, ACKNOWLEDGE, SEND_CUSTOM_LIST = 4, 5, 6  # modes of CTRL (ARDroneLib, control_states.h)
IGNORED_NAMES = frozenset(
    ("PMODE", "MISC", "PWM", "AFLIGHT", "CAD", "ZAP", "MTRIM", "GAIN", "VISP", "VISO", "CAP", "POL", "VICON")
)
"""Commands of the SDK that a pilot's program may send, and that change nothing here."""


class Ref(NamedTuple):
    """Take off or land, and the emergency toggle."""

    sequence: int
    bits: int

    @property
    def takes_off(self) -> bool:
        return bool(self.bits & TAKE_OFF_BIT)

    @property
    def emergency(self) -> bool:
        return bool(self.bits & EMERGENCY_BIT)


class Pcmd(NamedTuple):
    """Fly: shares of the limits in [-1, 1]; roll to the right, pitch backward, gaz up, yaw clockwise."""

    sequence: int
    flag: int
    roll: float
    pitch: float
    gaz: float
    yaw: float


class PcmdMag(NamedTuple):
    """As Pcmd, in the pilot's own frame: psi is the controller's heading, a share of 180 deg clockwise of north."""

    sequence: int
    flag: int
    roll: float
    pitch: float
    gaz: float
    yaw: float
    psi: float
    psi_accuracy: float


class FlatTrim(NamedTuple):
    """The aircraft stands level: take that as level."""

    sequence: int


class Calibrate(NamedTuple):
    """Calibrate a device; 0 is the magnetometer."""

    sequence: int
    device: int


class ConfigIds(NamedTuple):
    """The identifiers for which the next Config is meant."""

    sequence: int
    session: str
    user: str
    application: str


class Config(NamedTuple):
    """Set an entry of the configuration, `section:key`."""

    sequence: int
    key: str
    value: str


class Control(NamedTuple):
    """Ask for the configuration, or clear the acknowledgement: SEND_CONFIGURATION, ACKNOWLEDGE, SEND_CUSTOM_LIST."""

    sequence: int
    mode: int
    other: int = 0


class ResetWatchdog(NamedTuple):
    """The pilot's program is still there."""

    sequence: int


class Led(NamedTuple):
    """Play an animation of the LEDs."""

    sequence: int
    animation: int
    frequency_hz: float
    duration_s: int


class Animation(NamedTuple):
    """Fly a figure."""

    sequence: int
    animation: int
    duration_ms: int


class Ignored(NamedTuple):
    """A command of the SDK that changes nothing."""

    sequence: int
    name: str


Command = (
    Ref
    | Pcmd
    | PcmdMag
    | FlatTrim
    | Calibrate
    | ConfigIds
    | Config
    | Control
    | ResetWatchdog
    | Led
    | Animation
    | Ignored
)


class Parsed(NamedTuple):
    """What a datagram holds: its commands in order, and a text for each part that is none."""

    commands: list[Command]
    refusals: list[str]


class _RefusalError(ValueError):
    """A part of a datagram is no command; the text says why."""


_BITS, _FLOAT = struct.Struct("<i"), struct.Struct("<f")
_FORM = re.compile(r"AT\*([A-Z_]{1,20})=(\d{1,10})(?:,(.*))?")
_ARGUMENT = re.compile(r'(?:"([^"]*)"|(-?\d{1,10}))(?:,|\Z)')
_SEQUENCE_MAX = 2**32 - 1
_LAYOUTS: dict[str, tuple[Callable[..., Command], str]] = {  # i integer, f float, s string
    "REF": (Ref, "i"),
    "PCMD": (Pcmd, "iffff"),
    "PCMD_MAG": (PcmdMag, "iffffff"),
    "FTRIM": (FlatTrim, ""),
    "CALIB": (Calibrate, "i"),
    "CONFIG_IDS": (ConfigIds, "sss"),
    "CONFIG": (Config, "ss"),
    "CTRL": (Control, "ii"),
    "COMWDG": (ResetWatchdog, ""),
    "LED": (Led, "ifi"),
    "ANIM": (Animation, "ii"),
}
_NAME_OF = {kind: name for name, (kind, _) in _LAYOUTS.items()}
_KINDS = {"i": "an integer", "f": "a float", "s": "a string"}


def parse(datagram: bytes) -> Parsed:
    """Return the commands of a datagram; nothing that anybody sends raises."""
    if len(datagram) > DATAGRAM_MAX:
        return Parsed([], [f"a datagram has {len(datagram)} bytes; must have at most {DATAGRAM_MAX}"])
    commands: list[Command] = []
    refusals: list[str] = []
    *parts, rest = datagram.split(b"\r")
    for part in parts:
        try:
            commands.append(_command(part))
        except _RefusalError as error:
            refusals.append(str(error))
    if rest.strip(b"\n\0 "):
        refusals.append(f"{_shown(rest)} does not end in a carriage return; a part of a command is none")
    return Parsed(commands, refusals)


def _command(part: bytes) -> Command:
    if len(part) >= COMMAND_MAX:
        raise _RefusalError(f"a command has {len(part) + 1} characters; must have at most {COMMAND_MAX}")
    if not part.isascii() or not (form := _FORM.fullmatch(part.decode("ascii").strip("\n "))):
        raise _RefusalError(f"{_shown(part)} is no AT command; must be AT*NAME=sequence,arguments")
    name, sequence, text = form[1], int(form[2]), form[3] or ""
    if sequence > _SEQUENCE_MAX:
        raise _RefusalError(f"{name} has the sequence number {sequence}; must be <= {_SEQUENCE_MAX}")
    if name in IGNORED_NAMES:
        return Ignored(sequence, name)
    if name not in _LAYOUTS:
        raise _RefusalError(f"{name} is not known; must be one of {', '.join(_LAYOUTS)}")
    kind, layout = _LAYOUTS[name]
    return kind(sequence, *_values(name, layout, _arguments(name, text)))


def _arguments(name: str, text: str) -> list[int | str]:
    """Return the arguments of a command; a comma after the last one is let pass."""
    found: list[int | str] = []
    at = 0
    while at < len(text):
        match = _ARGUMENT.match(text, at)
        if match is None:
            raise _RefusalError(f'{name} has the argument {text[at : at + 20]!r}; must be an integer or a "string"')
        found.append(match[1] if match[2] is None else int(match[2]))
        at = match.end()
    return found


def _values(name: str, layout: str, arguments: list[int | str]) -> list[Any]:
    if len(arguments) != len(layout):
        raise _RefusalError(f"{name} has {len(arguments)} arguments; must have {len(layout)}")
    return [_value(name, kind, argument) for kind, argument in zip(layout, arguments, strict=True)]


def _value(name: str, kind: str, argument: int | str) -> Any:
    if isinstance(argument, str):
        if kind == "s":
            return argument
    elif kind == "i" and -(2**31) <= argument < 2**32:
        return argument
    elif kind == "f" and -(2**31) <= argument < 2**31 and math.isfinite(value := float_of_bits(argument)):
        return value
    raise _RefusalError(f"{name} has the argument {str(argument)[:20]!r}; must be {_KINDS[kind]}, finite, of 32 bits")


def _shown(part: bytes) -> str:
    return repr(part[:40].decode("ascii", "replace"))


def float_of_bits(bits: int) -> float:
    """Return the float that has the same 32 bits as a signed integer."""
    return _FLOAT.unpack(_BITS.pack(bits))[0]


def bits_of_float(value: float) -> int:
    """Return the signed integer that has the same 32 bits as a float."""
    return _BITS.unpack(_FLOAT.pack(value))[0]


def format_command(command: Command) -> bytes:
    """Return a command as it goes on the wire."""
    if isinstance(command, Ignored):
        return f"AT*{command.name}={command.sequence}\r".encode("ascii")
    name = _NAME_OF[type(command)]
    layout = _LAYOUTS[name][1]
    sequence, *values = command
    texts = [_text(kind, value) for kind, value in zip(layout, values, strict=True)]
    return f"AT*{name}={','.join([str(sequence), *texts])}\r".encode("ascii")


def _text(kind: str, value: Any) -> str:
    if kind == "s":
        return f'"{value}"'
    return str(bits_of_float(value) if kind == "f" else value)


def ref(sequence: int, takes_off: bool, emergency: bool = False) -> Ref:
    """Return a REF with the bits that are always set."""
    bits = REF_CONSTANT | (TAKE_OFF_BIT if takes_off else 0) | (EMERGENCY_BIT if emergency else 0)
    return Ref(sequence, bits)
