r"""The AT commands that a pilot's program sends to an AR.Drone 2.0 on UDP port 5556, and the configuration they set.

A datagram holds one or more complete commands `AT*NAME=sequence,argument,...\r`. Integers are decimal, strings are
quoted, and a float is written as the signed integer with the same 32 bits.

In addition to the common configuration, each application, user (`profile`) and session has its own values, stored under
an identifier, for the entries of its category. Writing an identifier to an entry of section `custom` makes it the
current one; a new identifier starts with the defaults. The aircraft sends its configuration on the control port, TCP
5559: a line `section:key = value\n` per entry, then a zero byte. The list of custom configurations has the blocks
`[applis]`, `[profiles]` and `[sessions]`, with a line `id,description` per configuration; each line ends in `\r`, and
the list in a zero byte.

Source: AR.Drone Developer Guide SDK 2.0, chapters 6 and 8; ARDroneLib (SDK 2.0.1), ardrone_api.c, config_keys.h,
ardrone_control.c and ardrone_control_configuration.c.
"""

import math
import re
import struct
from collections.abc import Iterator, Mapping
from typing import Any, Literal, NamedTuple

PORT = 5556  # UDP (ARDroneLib, config.h)
DATAGRAM_MAX = 8192  # bytes; design choice: eight commands of maximum length
COMMAND_MAX = 1024  # characters in a command, including its terminator (Developer Guide 6.1)
REF_CONSTANT = 0x1154_0000  # bits 18, 20, 22, 24, 28, which are always set (Developer Guide 6.6)
TAKE_OFF_BIT, EMERGENCY_BIT = 1 << 9, 1 << 8  # bits of a REF (Developer Guide 6.6)
PROGRESSIVE, COMBINED_YAW, ABSOLUTE = 1, 2, 4  # bits of a PCMD's flag (Developer Guide 6.6)
SEND_CONFIGURATION, ACKNOWLEDGE, SEND_CUSTOM_LIST = 4, 5, 6  # modes of CTRL (ARDroneLib, control_states.h)
IGNORED_NAMES = frozenset(
    ("PMODE", "MISC", "PWM", "AFLIGHT", "CAD", "ZAP", "MTRIM", "GAIN", "VISP", "VISO", "CAP", "POL", "VICON")
)
"""SDK commands that are accepted but have no effect here."""


class Ref(NamedTuple):
    """Take off or land, and toggle the emergency state."""

    sequence: int
    bits: int

    @property
    def takes_off(self) -> bool:
        return bool(self.bits & TAKE_OFF_BIT)

    @property
    def emergency(self) -> bool:
        return bool(self.bits & EMERGENCY_BIT)


class Pcmd(NamedTuple):
    """Fly at fractions of the limits, in [-1, 1]: `roll` right, `pitch` backward, `gaz` up, `yaw` clockwise."""

    sequence: int
    flag: int
    roll: float
    pitch: float
    gaz: float
    yaw: float


class PcmdMag(NamedTuple):
    """Like Pcmd, in the pilot's frame: `psi` is the controller's heading clockwise from north, divided by 180 deg."""

    sequence: int
    flag: int
    roll: float
    pitch: float
    gaz: float
    yaw: float
    psi: float
    psi_accuracy: float


class FlatTrim(NamedTuple):
    """Take the current attitude as level."""

    sequence: int


class Calibrate(NamedTuple):
    """Calibrate a device; 0 is the magnetometer."""

    sequence: int
    device: int


class ConfigIds(NamedTuple):
    """State the identifiers to which the next Config applies."""

    sequence: int
    session: str
    user: str
    application: str


class Config(NamedTuple):
    """Set an entry of the configuration; `key` has the form `section:key`."""

    sequence: int
    key: str
    value: str


class Control(NamedTuple):
    """Request a configuration (SEND_CONFIGURATION, SEND_CUSTOM_LIST) or clear the acknowledgement (ACKNOWLEDGE)."""

    sequence: int
    mode: int
    other: int = 0


class ResetWatchdog(NamedTuple):
    """Show that the pilot's program is still running."""

    sequence: int


class Led(NamedTuple):
    """Play an LED animation."""

    sequence: int
    animation: int
    frequency_hz: float
    duration_s: int


class Animation(NamedTuple):
    """Fly a preset manoeuvre, such as a flip."""

    sequence: int
    animation: int
    duration_ms: int


class Ignored(NamedTuple):
    """An SDK command that has no effect here."""

    sequence: int
    name: str


FlightCommand = Ref | Pcmd | PcmdMag | FlatTrim | Calibrate | Animation
Command = FlightCommand | ConfigIds | Config | Control | ResetWatchdog | Led | Ignored
COMMAND_TYPES: dict[str, type[Any]] = {
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
_COMMAND_NAMES = {kind: name for name, kind in COMMAND_TYPES.items()}
_TYPE_NAMES = {int: "an integer of 32 bits", float: "a finite float of 32 bits", str: "a quoted string"}
_BITS, _FLOAT = struct.Struct("<i"), struct.Struct("<f")
_COMMAND = re.compile(r"AT\*([A-Z_]{1,20})=(\d{1,10})(?:,(.*))?")
_ARGUMENT = re.compile(r'(?:"([^"]*)"|(-?\d{1,10}))(?:,|\Z)')
_SEQUENCE_MAX = 2**32 - 1


class Parsed(NamedTuple):
    """The commands of a datagram, in order, and an error text for each invalid part."""

    commands: list[Command]
    refusals: list[str]


class _RefusalError(ValueError):
    """A part of a datagram is not a valid command; the message states why."""


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
        parsed.refusals.append(f"{_quoted(rest)} does not end in a carriage return; must be a complete command")
    return parsed


def _command(part: bytes) -> Command:
    if len(part) >= COMMAND_MAX:
        raise _RefusalError(f"a command has {len(part) + 1} characters; must have at most {COMMAND_MAX}")
    if not part.isascii() or not (match := _COMMAND.fullmatch(part.decode("ascii").strip("\n "))):
        raise _RefusalError(f"{_quoted(part)} is not an AT command; must be AT*NAME=sequence,arguments")
    name, sequence, text = match[1], int(match[2]), match[3] or ""
    if sequence > _SEQUENCE_MAX:
        raise _RefusalError(f"{name} has the sequence number {sequence}; must be <= {_SEQUENCE_MAX}")
    if name in IGNORED_NAMES:
        return Ignored(sequence, name)
    if name not in COMMAND_TYPES:
        raise _RefusalError(f"{name} is not known; must be one of {', '.join(COMMAND_TYPES)}")
    arguments, types = list(_arguments(name, text)), _argument_types(COMMAND_TYPES[name])
    if len(arguments) != len(types):
        raise _RefusalError(f"{name} has {len(arguments)} arguments; must have {len(types)}")
    return COMMAND_TYPES[name](sequence, *(_value(name, *pair) for pair in zip(types, arguments, strict=True)))


def _argument_types(kind: type[Any]) -> list[type]:
    return list(kind.__annotations__.values())[1:]


def _arguments(name: str, text: str) -> Iterator[int | str]:
    """Yield the arguments of a command; a comma after the last one is allowed."""
    position = 0
    while position < len(text):
        match = _ARGUMENT.match(text, position)
        if match is None:
            raise _RefusalError(
                f'{name} has the argument {text[position : position + 20]!r}; must be an integer or a "string"'
            )
        yield match[1] if match[2] is None else int(match[2])
        position = match.end()


def _value(name: str, type_: type, argument: int | str) -> Any:
    if isinstance(argument, str):
        if type_ is str:
            return argument
    elif type_ is int and -(2**31) <= argument < 2**32:
        return argument
    elif type_ is float and -(2**31) <= argument < 2**31 and math.isfinite(value := bits_to_float(argument)):
        return value
    requirement = f"must be {_TYPE_NAMES[type_]}"
    raise _RefusalError(f"{name} has the argument {str(argument)[:20]!r}; {requirement}")


def _quoted(part: bytes) -> str:
    return repr(part[:40].decode("ascii", "replace"))


def bits_to_float(bits: int) -> float:
    """Return the float with the same 32 bits as a signed integer."""
    return _FLOAT.unpack(_BITS.pack(bits))[0]


def float_to_bits(value: float) -> int:
    """Return the signed integer with the same 32 bits as a float."""
    return _BITS.unpack(_FLOAT.pack(value))[0]


def format_command(command: Command) -> bytes:
    if isinstance(command, Ignored):
        return f"AT*{command.name}={command.sequence}\r".encode("ascii")
    sequence, *values = command
    texts = [str(sequence)]
    value: Any
    for type_, value in zip(_argument_types(type(command)), values, strict=True):
        texts.append(f'"{value}"' if type_ is str else str(float_to_bits(value) if type_ is float else value))
    return f"AT*{_COMMAND_NAMES[type(command)]}={','.join(texts)}\r".encode("ascii")


def ref(sequence: int, takes_off: bool, emergency: bool = False) -> Ref:
    """Return a REF that includes the bits that are always set."""
    bits = REF_CONSTANT | (TAKE_OFF_BIT if takes_off else 0) | (EMERGENCY_BIT if emergency else 0)
    return Ref(sequence, bits)


CONTROL_PORT = 5559  # TCP (ARDroneLib, config.h)
TEXT_MAX = 128  # characters in a value (Developer Guide 8.1)
DEFAULT_ID = "00000000"  # initial identifier at each level (Developer Guide 8.1)
CONFIGURATIONS_MAX = 64  # maximum number of configurations per level, since clients may invent many identifiers
TERMINATOR = b"\0"
_BLOCKS = ("applis", "profiles", "sessions")
_ID = re.compile(r"[0-9A-Za-z]{1,32}")
Category = Literal["common", "application", "user", "session"]
_LEVELS: dict[str, Category] = {"application": "application", "profile": "user", "session": "session"}
"""Categories by the names that the entries of section `custom` use for them."""


class ConfigurationEntry(NamedTuple):
    """An entry of the configuration; the kind `fixed` is read-only."""

    kind: Literal["flag", "whole", "number", "text", "fixed"]
    category: Category
    default: str
    low: float = 0.0
    high: float = 0.0


LIMITS = ("euler_angle_max", "control_vz_max", "control_yaw")
"""Limits of tilt [rad], climb rate [mm/s] and yaw rate [rad/s]; the aircraft keeps an indoor and an outdoor set."""
_ALTITUDE = "20|100000"  # mm; the maximum means no limit (ARDroneLib)
_TILT, _CLIMB, _YAW = "0|0.52", "200|2000", "0.7|6.11"  # ranges in rad, mm/s and rad/s (Developer Guide 8.6)
_CODE = "0|255"  # codecs, modes and channels, each as one byte
_MASK = "0|4294967295"
_RATE = "0|20000"  # kbit/s
_MOTORS = "\n".join(
    f"general:motor{i}_{part}|fixed|common|0.0" for i in range(1, 5) for part in ("soft", "hard", "supplier")
)
_TABLE = f"""
general:num_version_config|fixed|common|1
general:num_version_mb|fixed|common|33
general:num_version_soft|fixed|common|2.4.8
general:drone_serial|fixed|common|XXXXXXXXXX
general:soft_build_date|fixed|common|2014-01-01 00:00
{_MOTORS}
general:flying_time|fixed|common|0
general:vbat_min|fixed|common|9000
control:accs_offset|fixed|common|{{ -2.0480000e+03 2.0480000e+03 2.0480000e+03 }}
control:accs_gains|fixed|common|{{ 1.0 0.0 0.0 0.0 1.0 0.0 0.0 0.0 1.0 }}
control:gyros_offset|fixed|common|{{ 1.6625000e+03 1.6625000e+03 1.6625000e+03 }}
control:gyros_gains|fixed|common|{{ 6.8940529e-03 -6.8940529e-03 -3.6215587e-03 }}
control:gyros110_offset|fixed|common|{{ 1.6625000e+03 1.6625000e+03 }}
control:gyros110_gains|fixed|common|{{ 1.5271631e-03 -1.5271631e-03 }}
control:magneto_offset|fixed|common|{{ 0.0 0.0 0.0 }}
control:magneto_radius|fixed|common|0.0
control:gyro_offset_thr_x|fixed|common|4.0
control:gyro_offset_thr_y|fixed|common|4.0
control:gyro_offset_thr_z|fixed|common|0.5
control:pwm_ref_gyros|fixed|common|500
control:osctun_value|fixed|common|0
control:osctun_test|fixed|common|FALSE
pic:ultrasound_watchdog|fixed|common|3
pic:pic_version|fixed|common|262192
video:camif_fps|fixed|common|30
video:camif_buffers|fixed|common|2
video:num_trackers|fixed|common|12
video:video_storage_space|fixed|common|0
general:ardrone_name|text|common|My ARDrone
general:navdata_demo|flag|common|FALSE
general:navdata_options|whole|application|65537|{_MASK}
general:com_watchdog|whole|common|2|1|60
general:video_enable|flag|common|TRUE
general:vision_enable|flag|common|TRUE
control:control_level|whole|application|0|{_CODE}
control:euler_angle_max|number|user|0.20944|{_TILT}
control:control_vz_max|number|user|700|{_CLIMB}
control:control_yaw|number|user|1.7453|{_YAW}
control:indoor_euler_angle_max|number|user|0.20944|{_TILT}
control:indoor_control_vz_max|number|user|700|{_CLIMB}
control:indoor_control_yaw|number|user|1.7453|{_YAW}
control:outdoor_euler_angle_max|number|user|0.34907|{_TILT}
control:outdoor_control_vz_max|number|user|1000|{_CLIMB}
control:outdoor_control_yaw|number|user|3.4907|{_YAW}
control:altitude_max|whole|common|3000|{_ALTITUDE}
control:altitude_min|whole|common|50|{_ALTITUDE}
control:control_iphone_tilt|number|user|0.34907|{_TILT}
control:outdoor|flag|common|FALSE
control:flight_without_shell|flag|common|FALSE
control:autonomous_flight|flag|common|FALSE
control:manual_trim|flag|user|FALSE
control:flying_mode|whole|session|0|0|2
control:hovering_range|whole|session|1000|0|100000
control:flight_anim|text|common|0,0
control:flying_camera_enable|flag|session|FALSE
control:flying_camera_mode|text|session|
network:ssid_single_player|text|common|ardrone2
network:ssid_multi_player|text|common|ardrone2
network:wifi_mode|whole|common|0|0|2
network:wifi_rate|whole|common|0|{_CODE}
network:owner_mac|text|common|00:00:00:00:00:00
pic:ultrasound_freq|whole|common|8|7|8
video:codec_fps|whole|session|30|1|30
video:video_codec|whole|session|129|{_CODE}
video:video_slices|whole|session|0|{_CODE}
video:video_live_socket|whole|session|0|{_CODE}
video:bitrate|whole|application|1000|{_RATE}
video:max_bitrate|whole|session|1000|{_RATE}
video:bitrate_ctrl_mode|whole|application|0|0|2
video:bitrate_storage|whole|application|4000|{_RATE}
video:video_channel|whole|session|0|0|4
video:video_on_usb|flag|common|TRUE
video:video_file_index|whole|common|1|{_MASK}
leds:leds_anim|text|common|0,0,0
detect:enemy_colors|whole|session|1|{_CODE}
detect:groundstripe_colors|whole|session|16|{_CODE}
detect:enemy_without_shell|whole|session|0|{_CODE}
detect:detect_type|whole|session|3|{_CODE}
detect:detections_select_h|whole|session|0|{_MASK}
detect:detections_select_v_hsync|whole|session|0|{_MASK}
detect:detections_select_v|whole|session|0|{_MASK}
syslog:output|whole|common|7|{_MASK}
syslog:max_size|whole|common|102400|{_MASK}
syslog:nb_files|whole|common|5|{_CODE}
userbox:userbox_cmd|text|session|0
gps:latitude|number|session|500|-1000|1000
gps:longitude|number|session|500|-1000|1000
gps:altitude|number|session|0|-1e5|1e5
"""
ENTRIES: dict[str, ConfigurationEntry] = {}
"""Entries by `section:key`, without the identifiers and descriptions of section `custom`."""
for _name, _kind, _category, _default, *_range in (line.split("|") for line in _TABLE.split("\n") if line):
    ENTRIES[_name] = ConfigurationEntry(_kind, _category, _default, *map(float, _range))  # type: ignore[arg-type]


class ConfigurationError(ValueError):
    """An entry cannot be set to a value; the message states why."""


class Configuration:
    """The values of all entries.

    Args:
        maxima: the aircraft's own maxima, by entry, to which values are limited when read.
        fixed: values specific to this aircraft, by entry.
    """

    def __init__(self, maxima: Mapping[str, float], fixed: Mapping[str, str]) -> None:
        self._maxima = maxima
        self._common: dict[str, str] = dict(fixed)
        self._values_by_id: dict[Category, dict[str, dict[str, str]]] = {
            level: {DEFAULT_ID: {}} for level in _LEVELS.values()
        }
        self._descriptions: dict[Category, dict[str, str]] = {
            level: {DEFAULT_ID: "default"} for level in _LEVELS.values()
        }
        self._current_ids: dict[Category, str] = dict.fromkeys(_LEVELS.values(), DEFAULT_ID)

    def text(self, key: str) -> str:
        """Return the value of an entry as text, limited to what the aircraft is capable of."""
        entry = ENTRIES[key]
        value = self._values(entry).get(key, entry.default)
        high = self._maxima.get(key)
        return value if high is None or float(value) <= high else f"{high:g}"

    def number(self, key: str) -> float:
        return float(self.text(key))

    def flag(self, key: str) -> bool:
        return self.text(key) == "TRUE"

    def all(self) -> dict[str, str]:
        """Return the values of all entries, those of section `custom` last."""
        custom: dict[str, str] = {}
        for name, level in _LEVELS.items():
            current = self._current_ids[level]
            custom[f"custom:{name}_id"] = current
            custom[f"custom:{name}_desc"] = self._descriptions[level][current]
        return {**{key: self.text(key) for key in ENTRIES}, **custom}

    def custom_list(self) -> dict[str, dict[str, str]]:
        """Return the stored custom configurations: for each level's block, the descriptions by identifier."""
        return {block: dict(self._descriptions[level]) for block, level in zip(_BLOCKS, _LEVELS.values(), strict=True)}

    def is_current(self, session: str, user: str, application: str) -> bool:
        current = self._current_ids
        return (session, user, application) == (current["session"], current["user"], current["application"])

    def set(self, key: str, value: str) -> None:
        """Set an entry.

        Raises:
            ConfigurationError: the entry does not exist or is read-only, or the value is invalid.
        """
        key = key.lower()
        section, _, name = key.partition(":")
        if section == "custom":
            self._set_custom(name, value)
            return
        entry = ENTRIES.get(key)
        if entry is None:
            raise ConfigurationError(f"{key[:60]!r} is not an entry of the configuration")
        self._values(entry)[key] = _checked(key, entry, value)
        # keep the limits in force equal to the indoor or outdoor set in use
        variant = "outdoor" if self.flag("control:outdoor") else "indoor"
        if key == "control:outdoor":
            for limit in LIMITS:
                self._copy(f"control:{variant}_{limit}", f"control:{limit}")
        elif section == "control" and name in LIMITS:
            self._copy(key, f"control:{variant}_{name}")
        elif section == "control" and name.removeprefix(f"{variant}_") in LIMITS:
            self._copy(key, f"control:{name.removeprefix(f'{variant}_')}")

    def _values(self, entry: ConfigurationEntry) -> dict[str, str]:
        if entry.category == "common":
            return self._common
        return self._values_by_id[entry.category][self._current_ids[entry.category]]

    def _copy(self, key: str, to_key: str) -> None:
        values = self._values(ENTRIES[to_key])
        values[to_key] = self._values(ENTRIES[key]).get(key, ENTRIES[key].default)

    def _set_custom(self, name: str, value: str) -> None:
        prefix, _, suffix = name.rpartition("_")
        level = _LEVELS.get(prefix)
        if level is None or suffix not in ("id", "desc"):
            raise ConfigurationError(f"'custom:{name[:40]}' is not an entry of the configuration")
        if suffix == "desc":
            self._descriptions[level][self._current_ids[level]] = _checked_text(f"custom:{name}", value)
        elif value.startswith("-"):
            identifier = value[1:]
            deleted = [each for each in self._values_by_id[level] if each != DEFAULT_ID and identifier in ("all", each)]
            if not deleted and identifier != "all":
                raise ConfigurationError(f"there is no configuration {identifier[:40]!r} at the {level} level")
            for each in deleted:
                del self._values_by_id[level][each], self._descriptions[level][each]
            if self._current_ids[level] not in self._values_by_id[level]:
                self._current_ids[level] = DEFAULT_ID
        else:
            if not _ID.fullmatch(value):
                raise ConfigurationError(f"the identifier {value[:40]!r} must consist of 1 to 32 letters and digits")
            if value not in self._values_by_id[level]:
                if len(self._values_by_id[level]) >= CONFIGURATIONS_MAX:
                    raise ConfigurationError(
                        f"there are {CONFIGURATIONS_MAX} configurations at the {level} level; delete some"
                    )
                self._values_by_id[level][value], self._descriptions[level][value] = {}, ""
            self._current_ids[level] = value


def _checked(key: str, entry: ConfigurationEntry, value: str) -> str:
    """Return a value in its stored form, with a number clipped to its range."""
    if entry.kind == "fixed":
        raise ConfigurationError(f"{key} is read-only")
    if entry.kind == "text":
        return _checked_text(key, value)
    if entry.kind == "flag":
        flag = {"TRUE": "TRUE", "1": "TRUE", "FALSE": "FALSE", "0": "FALSE"}.get(value.strip().upper())
        if flag is None:
            raise ConfigurationError(f"{key} is set to {value[:40]!r}; must be TRUE or FALSE")
        return flag
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ConfigurationError(f"{key} is set to {value[:40]!r}; must be a number")
    number = min(max(number, entry.low), entry.high)
    return str(round(number)) if entry.kind == "whole" else f"{number:g}"


def _checked_text(key: str, value: str) -> str:
    if len(value) > TEXT_MAX or not value.isprintable():
        raise ConfigurationError(f"{key} is set to {value[:40]!r}; must be at most {TEXT_MAX} printable characters")
    return value


def format_configuration(entries: Mapping[str, str]) -> bytes:
    return "".join(f"{key} = {value}\n" for key, value in entries.items()).encode("ascii", "replace") + TERMINATOR


def format_custom_list(descriptions: Mapping[str, Mapping[str, str]]) -> bytes:
    parts: list[str] = []
    for block, entries in descriptions.items():
        parts += [f"[{block}]", *(f"{identifier},{text}" for identifier, text in entries.items())]
    return "".join(f"{part}\r" for part in parts).encode("ascii", "replace") + TERMINATOR
