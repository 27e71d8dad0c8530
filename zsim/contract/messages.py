"""The messages of contract version 1 and of users' agents: types by key, encoding and decoding.

Every message is a msgpack map with exactly its class's field names; numbers are in SI units and radians, with the unit
in the name. `encode` encodes all messages; `decode` decodes them and checks types, shapes and finiteness.

Users' agents exchange messages of classes with a key, which `world/info` declares for readers without the class:

class State(zsim.AgentMessage, frozen=True):
    key = "swarm/{drone}/state"  # each agent publishes on its own drone's key
    position_m: tuple[float, float, float]
    is_leader: bool = False

State.of()  # "swarm/*/state", the key expression for all drones
"""

import math
import re
from collections.abc import Callable, Iterable
from functools import cache, lru_cache
from typing import Any, ClassVar, Literal, NamedTuple, NoReturn

import msgspec
from msgspec import UNSET, Struct, UnsetType

from zsim.contract import flight_messages, keys, run_messages
from zsim.errors import DecodeError, RunError
from zsim.schema.checker import first_fault
from zsim.schema.message import Count, FieldType, Message, Number, Whole, declared_type, field_types
from zsim.sensors.scanner import SCANNERS
from zsim.sensors.scanner import Depth as Depth
from zsim.sensors.scanner import Lidar as Lidar
from zsim.sensors.scanner import Range as Range
from zsim.sensors.sensor import Sample, message_type
from zsim.sensors.sensor_catalogue import STOCK
from zsim.sensors.stock_sensors import Baro as Baro
from zsim.sensors.stock_sensors import Flow as Flow
from zsim.sensors.stock_sensors import Gps as Gps
from zsim.sensors.stock_sensors import Imu as Imu
from zsim.sensors.stock_sensors import Mag as Mag
from zsim.sensors.stock_sensors import Sonar as Sonar

_KEY = re.compile(r"([a-z][a-z0-9_]{0,31})/\{(drone|cluster|run)\}/([a-z][a-z0-9_]{0,31})")
KEY_ALLOWED = "swarm/{drone}/state: a word, {drone}, {cluster} or {run}, and a word: a letter and up to 31 of a-z 0-9 _"
_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")
CONTRACT_WORDS = frozenset({"drone", "cluster", "process", "world", "view", "clock"})  # first words of contract keys


class AgentMessage(Struct, frozen=True, kw_only=True, gc=False):
    """Base of the messages of users' agents: `zsim.AgentMessage`.

    A subclass has `key`, in which `{drone}`, `{cluster}` or `{run}` stands for the name of the agent's drone, cluster
    or run, and fields: numbers, tuples and lists of numbers, integers, booleans, text. zsim fills in t_ns, the gate at
    which a message is published; seq, which counts the messages of a key from 0; and source, the publishing agent.
    """

    key: ClassVar[str] = ""

    t_ns: Whole = -1
    seq: Whole = -1
    source: str = ""

    @classmethod
    def of(cls, thing: str = "*") -> str:
        """Return the key on which the agent of a drone, cluster or run publishes; by default the expression for all.

        Raises:
            ValueError: the class's key is invalid.
        """
        parts = _KEY.fullmatch(cls.key)
        if parts is None:
            raise ValueError(f"{cls.__name__}.key is {cls.key!r:.60}; must be like {KEY_ALLOWED}")
        return f"{parts[1]}/{thing}/{parts[3]}"

    def fault(self) -> str | None:
        """Return the fault of a received message; a plain float, which a class may declare, may also be NaN."""
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if name in ("t_ns", "seq") and value < 0:
                return f"{name} is missing or negative; must be >= 0"
            for number in value if isinstance(value, tuple | list) else (value,):
                if isinstance(number, float) and not math.isfinite(number):
                    return f"{name} is {number}; must be finite"
        return None


class MessageInfo(Struct, frozen=True, omit_defaults=True):
    """A message of users' agents: `key` has `*` in place of a name; `fields` omits t_ns, seq and source.

    `role` is the first part of the names of the processes that publish it.
    """

    key: str
    message: str
    fields: dict[str, FieldType]
    role: str = ""

    def declares(self, kind: object) -> bool:
        """Return whether a class matches this declaration."""
        if not (isinstance(kind, type) and issubclass(kind, AgentMessage)):
            return False
        return kind.__name__ == self.message and field_types(kind, AgentMessage) == self.fields

    def is_sound(self) -> bool:
        """Return whether a class can be created from this declaration."""
        head, star, leaf = (*self.key.split("/"), "", "")[:3]
        key_is_sound = star == "*" and self.key.count("/") == 2 and head not in CONTRACT_WORDS
        return key_is_sound and all(map(_NAME.fullmatch, (head, leaf, self.message.lower(), *self.fields)))


def message_info(kind: type[AgentMessage]) -> MessageInfo:
    """Return the declaration of a message class for other processes.

    Raises:
        TypeError: a field has a type not allowed in messages.
        ValueError: the class's key, its name or a field's name is not allowed.
    """
    parts = _KEY.fullmatch(kind.key)
    if not parts or parts[1] in CONTRACT_WORDS:
        reserved = f"must be like {KEY_ALLOWED}; not beginning with {', '.join(sorted(CONTRACT_WORDS))}"
        raise ValueError(f"{kind.__name__}.key is {kind.key!r:.60}; {reserved}")
    info = MessageInfo(f"{parts[1]}/*/{parts[3]}", kind.__name__, field_types(kind, AgentMessage))
    if not info.is_sound():
        raise ValueError(f"{kind.__name__}, or a field, is misnamed; must be a letter and up to 31 of a-z 0-9 _")
    return info


def type_of_info(info: MessageInfo) -> type[AgentMessage]:
    """Return a class created from a declaration, for processes without the user's class."""
    return declared_type(info.message, info.fields, AgentMessage, (("key", info.key),))


def about(kind: type[AgentMessage]) -> str:
    """Return the scope of the agents that publish messages of a class: "drone", "cluster" or "run"."""
    parts = _KEY.fullmatch(kind.key)
    return parts[2] if parts else ""


PAYLOAD_MAX = 16_000_000  # bytes; a scenario of 1000 drones in world/info is below this
REFUSALS = (ValueError, TypeError, RecursionError, OverflowError, MemoryError, msgspec.MsgspecError)
"""Errors that a decoder raises for a foreign payload: wrong types, invalid UTF-8, excessive nesting."""


class Origin(Struct, frozen=True):
    """The origin of W: WGS 84 latitude and longitude [deg], ellipsoidal height [m]."""

    latitude_deg: Number
    longitude_deg: Number
    height_m: Number


class RotorInfo(Struct, frozen=True):
    """A rotor: its position in B, its radius, and its sense: `turn` is 1 if clockwise seen from above, otherwise -1."""

    name: str
    x_m: Number
    y_m: Number
    turn: Literal[-1, 1]
    radius_m: Number


class DroneInfo(Struct, frozen=True):
    """A drone of the run, the model of its aircraft, and its rotors in the order of `rotor_rad_s`.

    Records of older versions name no rotors. `body` is omitted for a simulated drone; an external drone is published by
    its driver, and the world does not simulate it.
    """

    name: str
    model: str
    rotors: tuple[RotorInfo, ...] = ()
    body: Literal["external"] | UnsetType = UNSET


class ClusterInfo(Struct, frozen=True):
    """A formation and its drones, in the order of its robots."""

    name: str
    drones: tuple[str, ...]


class SensorInfo(Struct, frozen=True):
    """A user's sensor: the content of `drone/{d}/sensor/{name}` after `t_ns`, `seq` and `t_sample_ns`.

    `message` is the name of the message class; `fields` has the type of each field by name.
    """

    name: str
    message: str
    fields: dict[str, FieldType]


@keys.on("world/info", writers="world", readers="each", last="world")
class Info(Message, frozen=True):
    """What a process needs to take part: the resolved scenario and the settings of time, on `world/info`.

    `rate` is simulated over wall time, 0 for as fast as possible; `scenario` is YAML text. `replay_of` is the run_id of
    the run that is played back; empty for a flight. Omitted are `user_sensors` if all sensors are the contract's,
    `user_messages` if agents exchange none, `sightings` if the world computes none, and `scanners` if no drone has a
    range, lidar or depth sensor. `module_folders` are the folders in which the world searched for the modules that the
    scenario names, for readers of the record; omitted if the scenario names none. `changed` holds the texts
    `a.b.c=value` with which the command line changed the scenario's file; omitted if unknown. Creating or decoding an
    Info registers the messages of its sensors and agents.
    """

    contract: Count
    run_id: str
    federation: str
    mode: Literal["lockstep", "realtime"]
    rate: Number
    gate_ns: Count
    physics_dt_ns: Count
    command_delay_ns: Count
    seed: Count
    origin: Origin
    drones: tuple[DroneInfo, ...]
    clusters: tuple[ClusterInfo, ...]
    scenario: str
    scenario_sha256: str
    version: str
    fingerprint: str
    replay_of: str = ""
    user_sensors: tuple[SensorInfo, ...] | UnsetType = UNSET
    sightings: bool | UnsetType = UNSET
    module_folders: tuple[str, ...] | UnsetType = UNSET
    changed: tuple[str, ...] | UnsetType = UNSET
    user_messages: tuple[MessageInfo, ...] | UnsetType = UNSET
    scanners: tuple[str, ...] | UnsetType = UNSET

    def __post_init__(self) -> None:
        register_sensors(self.own_sensors)
        for each in filter(MessageInfo.is_sound, self.own_messages):
            if not each.declares(_USER_TYPES.get(each.key)):
                _register(each.key, type_of_info(each))

    @property
    def own_sensors(self) -> tuple[SensorInfo, ...]:
        return () if self.user_sensors is UNSET else self.user_sensors

    @property
    def sensors_beside(self) -> tuple[str, ...]:
        """Names of the sensors besides the contract's six that the run's drones have, in the order of their keys."""
        sightings = (keys.SIGHTINGS,) * (self.sightings is True)
        return (
            *(each.name for each in self.own_sensors),
            *sightings,
            *(() if self.scanners is UNSET else self.scanners),
        )

    @property
    def own_messages(self) -> tuple[MessageInfo, ...]:
        return () if self.user_messages is UNSET else self.user_messages


for _name, _message in {**{name: kind.message for name, kind in STOCK.items()}, **SCANNERS}.items():
    keys.on(f"drone/*/sensor/{_name}", writers="world")(_message)
keys.on("drone/*/sensor/*", writers="driver", readers="estimator")(Sample)  # including users' sensors
TOPICS = keys.TOPICS
"""The contract's keys, with `*` in place of a name, and their messages; complete once this module is imported."""

RELAYED = (
    *(flight_messages.Estimate, flight_messages.ClusterState, flight_messages.Reference),
    *(run_messages.ClusterRequest, AgentMessage),
)
"""Messages, or their bases, that agents publish for each other; the world counts them like commands."""
KEYS_KEPT = 65_536  # maximum number of keys with cached types; 1000 drones have 15 000; garbage keys are evicted
_USER_TYPES: dict[str, type[Struct]] = {}  # users' message classes by shape of their key, from the newest Info


def _plain(value: Any) -> Any:
    to_plain = getattr(value, "tolist", None)
    if to_plain is None:
        raise TypeError(f"a value is of type {type(value).__name__}; must be a number, text, list or map")
    return to_plain()


encode: Callable[[Struct], bytes] = msgspec.msgpack.Encoder(enc_hook=_plain).encode
"""Return the payload of a message; numpy's numbers and arrays are converted."""


def shape_of(key: str) -> str:
    """Return a key with `*` in place of its name, as in TOPICS."""
    if key in TOPICS:
        return key
    kind, owner, topic = keys.parts(key)
    return f"view/{owner}/*" if kind == "view" else f"{kind}/*/{topic}"


@lru_cache(maxsize=KEYS_KEPT)
def type_of(key: str) -> type[Struct] | None:
    """Return the message type of a key; None for an unknown key."""
    shape = shape_of(key)
    return TOPICS[shape].message if shape in TOPICS else _USER_TYPES.get(shape)


def register_sensors(sensors: Iterable[SensorInfo]) -> None:
    """Register the messages of a run's user sensors.

    A sensor with an invalid name, message name or field name is skipped: its messages remain unknown.
    """
    for each in sensors:
        if all(map(_NAME.fullmatch, (each.name, each.message.lower(), *each.fields))):
            _register(f"drone/*/sensor/{each.name}", message_type(each.message, each.fields, each.name))


def register_messages(kinds: Iterable[type[AgentMessage]]) -> None:
    """Register users' message classes, used in this process instead of the declarations in `world/info`.

    Raises TypeError and ValueError as `message_info` does.
    """
    for kind in kinds:
        _register(message_info(kind).key, kind)


def _register(shape: str, kind: type[Struct]) -> None:
    if _USER_TYPES.get(shape) is not kind:
        _USER_TYPES[shape] = kind
        for by_key in (type_of, is_output, encoding, _reader_of):
            by_key.cache_clear()


def types_by_shape() -> dict[str, type[Struct]]:
    return {shape: topic.message for shape, topic in TOPICS.items() if topic.message}


COMMANDS = {topic.message: shape for shape, topic in TOPICS.items() if topic.message and keys.is_command(shape)}
"""Shapes of command keys, by message type."""


def command_key(drone: str, command: Struct) -> str:
    """Return the key of a command to a drone; raise RunError if it is not a command."""
    shape = COMMANDS.get(type(command))
    if shape is None:
        kinds = ", ".join(each.__name__ for each in COMMANDS)
        raise RunError(f"the command to {drone} is a {type(command).__name__}; must be one of {kinds}")
    return keys.command(drone, shape.rpartition("/")[2])


@lru_cache(maxsize=KEYS_KEPT)
def is_output(key: str) -> bool:
    """Return whether the world checks a key's messages against the count in their publisher's done."""
    topic = TOPICS.get(shape_of(key))
    return is_relayed(type_of(key)) if topic is None else topic.message is not None and topic.is_output


def is_relayed(kind: type[Struct] | None) -> bool:
    """Return whether agents publish messages of a type for other agents."""
    return kind is not None and issubclass(kind, RELAYED)


def output_type(key: str) -> type[Struct]:
    """Return the message type that an agent's step may return for a key; raise DecodeError for other keys."""
    kind = type_of(key)
    if kind is None:
        raise DecodeError(f"{key:.80}: is not a key of the contract; see docs/protocol.md")
    if not is_output(key):
        todo = "return it from `views`" if key.startswith("view/") else "only the process that owns it writes there"
        reason = "is not a key of an agent's outputs (commands, estimates, states, messages)"
        raise DecodeError(f"{key:.80}: {reason}; {todo}")
    return kind


def fields(kind: type[Struct]) -> Iterable[str]:
    return kind.__struct_fields__


@lru_cache(maxsize=KEYS_KEPT)
def encoding(key: str) -> str:
    kind = type_of(key)
    return f"application/msgpack;{kind.__name__}" if kind else "application/msgpack"


def decode(key: str, payload: bytes) -> Any:
    """Return the message on `key`, checked for types, shapes and finiteness; raise DecodeError naming a fault."""
    kind, read = _reader_of(key)
    if kind is None:
        raise DecodeError(f"{key:.80}: is not a key of the contract; see docs/protocol.md")
    try:
        return read(payload) if len(payload) <= PAYLOAD_MAX else _too_long(payload)
    except REFUSALS as error:
        raise _refusal(kind, payload, key, error) from error


def decode_as(kind: type[Struct], payload: bytes, where: str) -> Any:
    """Return `payload` as a `kind`; `where` begins the text of the DecodeError."""
    try:
        return _reader(kind)(payload) if len(payload) <= PAYLOAD_MAX else _too_long(payload)
    except REFUSALS as error:
        raise _refusal(kind, payload, where, error) from error


def fault_at(key: str, error: Exception) -> str:
    """Return the text of a decoding error without its leading key."""
    text, where = str(error), key if len(key) <= 80 or str(error).startswith(key) else _shown(key)
    return text.removeprefix(f"{where}: ")


def _shown(where: str) -> str:
    return where if len(where) <= 80 else f"{where[:77]}..."


_Reader = Callable[[bytes], Any]


@lru_cache(maxsize=KEYS_KEPT)  # bounded, since keys come from other processes too
def _reader_of(key: str) -> tuple[type[Struct] | None, _Reader]:
    kind = type_of(key)
    return kind, _reader(kind or Struct)


@cache
def _reader(kind: type[Struct]) -> _Reader:
    """Return the decoder of a `kind`: msgspec's own if the types express every check."""
    decode_bare = msgspec.msgpack.Decoder(kind).decode
    fault_of = getattr(kind, "fault", None)
    if fault_of is None:
        return decode_bare

    def read(payload: bytes) -> Any:
        message = decode_bare(payload)
        fault = fault_of(message)
        if fault:
            raise ValueError(fault)
        return message

    return read


def _too_long(payload: bytes) -> NoReturn:
    raise ValueError(f"the payload has {len(payload)} bytes; must have at most {PAYLOAD_MAX}")


def _refusal(kind: type[Struct], payload: bytes, where: str, error: Exception) -> DecodeError:
    """Return a DecodeError that names the key, the field, the value found and the values allowed."""
    where = _shown(where)
    if not isinstance(error, msgspec.MsgspecError):
        return DecodeError(f"{where}: {str(error) or type(error).__name__}")
    try:
        first = first_fault(msgspec.msgpack.decode(payload), kind)
    except REFUSALS as fault:
        first = ("", f"({len(payload)} bytes) is not msgpack ({fault}); must be a map, the {kind.__name__}")
    path, text = first or ("", f"is refused ({error}); must be the {kind.__name__}")
    return DecodeError(f"{where}: {path or 'the payload'} {text}")


class NoData(Struct, frozen=True):
    """Data that processes do not use."""


class RunEnd(Struct, frozen=True):
    """The run has ended; `last_ns` is its last gate."""

    last_ns: Count


class ProcessEntry(Struct, frozen=True):
    """A process has joined."""

    incarnation: int
    host: str
    pid: int
    from_ns: Count  # first gate that waits for it
    done_ns: Whole = -1  # newest gate that it, or its former incarnation, has completed; -1: none
    former_pid: int | None = None  # pid of the incarnation that it replaces


class WorldEvent(NamedTuple):
    """An event on which processes act."""

    kind: str
    subject: str
    data: Struct


_EVENT_DATA: dict[str, type[Struct]] = {
    "end": RunEnd,
    "join": ProcessEntry,
    "restart": ProcessEntry,
    "superseded": ProcessEntry,
    "leave": NoData,
    "drop": NoData,
}


def read_event(payload: bytes) -> WorldEvent | None:
    """Return an event on which processes act, with checked data; None for an event of another kind.

    Raises DecodeError if the payload is not an event, or its data does not fit its kind.
    """
    event: run_messages.Event = decode(keys.EVENT, payload)
    kind = _EVENT_DATA.get(event.kind)
    if kind is None:
        return None
    try:
        return WorldEvent(event.kind, event.subject, msgspec.convert(event.data, kind))
    except REFUSALS as error:
        raise DecodeError(f"{keys.EVENT}: data of {event.kind!r} is refused ({error}); see docs/protocol.md") from error
