r"""AT commands, which a pilot's program sends to UDP port 5556.

A datagram holds one or more `AT*NAME=sequence,argument,...\r`, whole. Integers are decimal, strings are quoted, a float
is written as the signed integer that has the same 32 bits.

Source: AR.Drone Developer Guide SDK 2.0, chapter 6; ARDroneLib, ardrone_api.c.
"""

import math
import re
import struct
from collections.abc import Iterator
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
"""Commands of the SDK that are accepted and have no effect here."""


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
    """Take the present attitude as level."""

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
    """Show that the pilot's program is still running."""

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
    """A command of the SDK without effect."""

    sequence: int
    name: str


FlightCommand = Ref | Pcmd | PcmdMag | FlatTrim | Calibrate | Animation
Command = FlightCommand | ConfigIds | Config | Control | ResetWatchdog | Led | Ignored
KINDS: dict[str, type[Any]] = {
    "REF": Ref,
    "PCMD": Pcmd,
    "PCMD_MAG": PcmdMag,
    "FTRIM": FlatTrim,
    "CALIB": Calibrate,
    "CONFIG_IDS": ConfigIds,
    "CONFIG": Config,
    "CTRL": Control,
    "COMWDG": ResetWatchdog,
    "LED": Led,
    "ANIM": Animation,
}
_NAME_OF = {kind: name for name, kind in KINDS.items()}
_TYPE_NAMES = {int: "an integer", float: "a float", str: "a string"}
_BITS, _FLOAT = struct.Struct("<i"), struct.Struct("<f")
_FORM = re.compile(r"AT\*([A-Z_]{1,20})=(\d{1,10})(?:,(.*))?")
_ARGUMENT = re.compile(r'(?:"([^"]*)"|(-?\d{1,10}))(?:,|\Z)')
_SEQUENCE_MAX = 2**32 - 1


class Parsed(NamedTuple):
    """The commands of a datagram in order, and a text for each invalid part."""

    commands: list[Command]
    refusals: list[str]


class _RefusalError(ValueError):
    """A part of a datagram is not a command; the text says why."""


def parse(datagram: bytes) -> Parsed:
    """Return the commands of a datagram; never raises."""
    if len(datagram) > DATAGRAM_MAX:
        return Parsed([], [f"a datagram has {len(datagram)} bytes; must have at most {DATAGRAM_MAX}"])
    parsed = Parsed([], [])
    *parts, rest = datagram.split(b"\r")
    for part in parts:
        try:
            parsed.commands.append(_command(part))
        except _RefusalError as error:
            parsed.refusals.append(str(error))
    if rest.strip(b"\n\0 "):
        parsed.refusals.append(f"{_shown(rest)} does not end in a carriage return; must be a complete command")
    return parsed


def _command(part: bytes) -> Command:
    if len(part) >= COMMAND_MAX:
        raise _RefusalError(f"a command has {len(part) + 1} characters; must have at most {COMMAND_MAX}")
    if not part.isascii() or not (form := _FORM.fullmatch(part.decode("ascii").strip("\n "))):
        raise _RefusalError(f"{_shown(part)} is not an AT command; must be AT*NAME=sequence,arguments")
    name, sequence, text = form[1], int(form[2]), form[3] or ""
    if sequence > _SEQUENCE_MAX:
        raise _RefusalError(f"{name} has the sequence number {sequence}; must be <= {_SEQUENCE_MAX}")
    if name in IGNORED_NAMES:
        return Ignored(sequence, name)
    if name not in KINDS:
        raise _RefusalError(f"{name} is not known; must be one of {', '.join(KINDS)}")
    arguments, types = list(_arguments(name, text)), _argument_types(KINDS[name])
    if len(arguments) != len(types):
        raise _RefusalError(f"{name} has {len(arguments)} arguments; must have {len(types)}")
    return KINDS[name](sequence, *(_value(name, *pair) for pair in zip(types, arguments, strict=True)))


def _argument_types(kind: type[Any]) -> list[type]:
    return list(kind.__annotations__.values())[1:]


def _arguments(name: str, text: str) -> Iterator[int | str]:
    """Yield the arguments of a command; a comma after the last one is allowed."""
    at = 0
    while at < len(text):
        match = _ARGUMENT.match(text, at)
        if match is None:
            raise _RefusalError(f'{name} has the argument {text[at : at + 20]!r}; must be an integer or a "string"')
        yield match[1] if match[2] is None else int(match[2])
        at = match.end()


def _value(name: str, type_: type, argument: int | str) -> Any:
    if isinstance(argument, str):
        if type_ is str:
            return argument
    elif type_ is int and -(2**31) <= argument < 2**32:
        return argument
    elif type_ is float and -(2**31) <= argument < 2**31 and math.isfinite(value := float_of_bits(argument)):
        return value
    needed = f"{_TYPE_NAMES[type_]}, finite, of 32 bits"
    raise _RefusalError(f"{name} has the argument {str(argument)[:20]!r}; must be {needed}")


def _shown(part: bytes) -> str:
    return repr(part[:40].decode("ascii", "replace"))


def float_of_bits(bits: int) -> float:
    """Return the float that has the same 32 bits as a signed integer."""
    return _FLOAT.unpack(_BITS.pack(bits))[0]


def bits_of_float(value: float) -> int:
    """Return the signed integer that has the same 32 bits as a float."""
    return _BITS.unpack(_FLOAT.pack(value))[0]


def format_command(command: Command) -> bytes:
    if isinstance(command, Ignored):
        return f"AT*{command.name}={command.sequence}\r".encode("ascii")
    sequence, *values = command
    texts = [str(sequence)]
    value: Any
    for type_, value in zip(_argument_types(type(command)), values, strict=True):
        texts.append(f'"{value}"' if type_ is str else str(bits_of_float(value) if type_ is float else value))
    return f"AT*{_NAME_OF[type(command)]}={','.join(texts)}\r".encode("ascii")


def ref(sequence: int, takes_off: bool, emergency: bool = False) -> Ref:
    """Return a REF with the bits that are always set."""
    bits = REF_CONSTANT | (TAKE_OFF_BIT if takes_off else 0) | (EMERGENCY_BIT if emergency else 0)
    return Ref(sequence, bits)
