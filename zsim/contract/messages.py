"""The contract's messages by their keys, version 1: the types, and how they are written and read.

Every message is a msgpack map with exactly these field names, SI units and radians, the unit in the name.
`encode` and `decode` are the only way onto and off the wire; `decode` checks types, shapes and finite numbers.
"""

from collections.abc import Callable, Iterable
from functools import cache, lru_cache
from typing import Any, Literal, NoReturn

import msgspec
from msgspec import Struct

from zsim.contract import flight_messages, run_messages, views
from zsim.errors import DecodeError
from zsim.schema.checker import first_fault
from zsim.schema.message import Count, Message, Number, Vector3, Whole

PAYLOAD_MAX = 16_000_000  # bytes; a scenario of 1000 drones in world/info is below this
REFUSALS = (ValueError, TypeError, RecursionError, OverflowError, MemoryError, msgspec.MsgspecError)
"""Whatever a decoder raises for a payload that somebody else wrote: wrong types, bad UTF-8, maps without end."""


class Origin(Struct, frozen=True):
    """The origin of W: WGS 84 latitude and longitude [deg], ellipsoidal height [m]."""

    latitude_deg: Number
    longitude_deg: Number
    height_m: Number


class DroneInfo(Struct, frozen=True):
    """A drone of the run and the model of its aircraft."""

    name: str
    model: str


class ClusterInfo(Struct, frozen=True):
    """A formation and its drones, in the order of its robots."""

    name: str
    drones: tuple[str, ...]


class Info(Message, frozen=True):
    """What a process needs to take part: the resolved scenario and how its time runs, `world/info`.

    `rate` is simulated per wall seconds, 0 for as fast as possible; `scenario` is YAML text. `replay_of` is the
    run_id of the run that is played back; empty for a flight.
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


class Imu(Message, frozen=True):
    """Specific force [m/s^2] and body rate [rad/s] at the sensor, in its own axes; at rest and level (0, 0, +9.81)."""

    t_sample_ns: Whole
    accel_m_s2: Vector3
    gyro_rad_s: Vector3


class Gps(Message, frozen=True):
    """A fix of the antenna: WGS 84 (deg, m), the same in W [m], velocity in W [m/s].

    `sigma_m` is the standard deviation of the position per axis; `fix` as in NMEA, 3 for three dimensions.
    """

    t_sample_ns: Whole
    latitude_deg: Number
    longitude_deg: Number
    altitude_m: Number
    position_m: Vector3
    velocity_m_s: Vector3
    sigma_m: Number
    fix: Count
    satellites: Count


class Mag(Message, frozen=True):
    """The Earth's field in the axes of the sensor [uT]."""

    t_sample_ns: Whole
    field_ut: Vector3


class Baro(Message, frozen=True):
    """Static pressure [Pa], and the height over the origin of W that it stands for [m]."""

    t_sample_ns: Whole
    pressure_pa: Number
    altitude_m: Number


class Sonar(Message, frozen=True):
    """Distance to the ground along the beam [m]; without an echo it is not `valid`."""

    t_sample_ns: Whole
    range_m: Number
    valid: bool


class Flow(Message, frozen=True):
    """Velocity over the ground in the heading frame [m/s], and in [0, 1] how much of the picture is ground."""

    t_sample_ns: Whole
    velocity_m_s: Vector3
    quality: Number


_FIXED: dict[str, type[Struct]] = {
    "world/info": Info,
    "clock": run_messages.Clock,
    "world/event": run_messages.Event,
    "world/faults": run_messages.Faults,
    "view/drones": views.ViewDrones,
}
_BY_SHAPE: dict[tuple[str, str], type[Struct]] = {
    ("drone", "sensor/imu"): Imu,
    ("drone", "sensor/gps"): Gps,
    ("drone", "sensor/mag"): Mag,
    ("drone", "sensor/baro"): Baro,
    ("drone", "sensor/sonar"): Sonar,
    ("drone", "sensor/flow"): Flow,
    ("drone", "sensor/status"): flight_messages.Status,
    ("drone", "truth"): flight_messages.Truth,
    ("drone", "cmd/velocity"): flight_messages.Velocity,
    ("drone", "cmd/ardrone"): flight_messages.Ardrone,
    ("drone", "cmd/attitude"): flight_messages.Attitude,
    ("drone", "cmd/rotors"): flight_messages.RotorSpeeds,
    ("drone", "cmd/mode"): flight_messages.Mode,
    ("drone", "estimate"): flight_messages.Estimate,
    ("cluster", "state"): flight_messages.ClusterState,
    ("cluster", "request"): run_messages.ClusterRequest,
    ("process", "join"): run_messages.Join,
    ("process", "done"): run_messages.Done,
    ("process", "bye"): run_messages.Bye,
    ("process", "health"): run_messages.Health,
}
_VIEWS: dict[str, type[Struct]] = {"view/cluster/": views.ViewCluster, "view/estimates/": views.ViewEstimates}
KEYS_KEPT = 65_536  # keys whose type is remembered; 1000 drones have 15 000, garbage keys push each other out

encode: Callable[[Struct], bytes] = msgspec.msgpack.Encoder().encode
"""Return the payload of a message."""


@lru_cache(maxsize=KEYS_KEPT)
def type_of(key: str) -> type[Struct] | None:
    """Return the message type that the contract puts on a key, None for a key that it does not know."""
    for start, message in _VIEWS.items():
        if key.startswith(start):
            return message
    parts = key.split("/", 2)
    return _FIXED.get(key) or (_BY_SHAPE.get((parts[0], parts[2])) if len(parts) == 3 else None)


def types_by_shape() -> dict[str, type[Struct]]:
    """Return all message types by the shape of their key, for documentation and for tests."""
    shapes = {f"{kind}/*/{rest}": message for (kind, rest), message in _BY_SHAPE.items()}
    return {**_FIXED, **shapes, **{f"{start}*": message for start, message in _VIEWS.items()}}


def fields(kind: type[Struct]) -> Iterable[str]:
    """Return the names of a message's fields in order."""
    return kind.__struct_fields__


@lru_cache(maxsize=KEYS_KEPT)
def encoding(key: str) -> str:
    """Return the Zenoh encoding of a key's messages."""
    kind = type_of(key)
    return f"application/msgpack;{kind.__name__}" if kind else "application/msgpack"


def decode(key: str, payload: bytes) -> Any:
    """Return the message on `key`, checked for type, shape and finiteness.

    Raises:
        DecodeError: names key, field, found and allowed.
    """
    kind, read = _reader_of(key)
    if kind is None:
        raise DecodeError(f"{key:.80}: is no key of the contract; see docs/protocol.md")
    try:
        return read(payload) if len(payload) <= PAYLOAD_MAX else _too_long(payload)
    except REFUSALS as error:
        raise _refusal(kind, payload, key, error) from error


def decode_as(kind: type[Struct], payload: bytes, where: str) -> Any:
    """Return `payload` as a `kind`; `where` opens the text of the DecodeError."""
    try:
        return _reader(kind)(payload) if len(payload) <= PAYLOAD_MAX else _too_long(payload)
    except REFUSALS as error:
        raise _refusal(kind, payload, where, error) from error


_Reader = Callable[[bytes], Any]


@lru_cache(maxsize=KEYS_KEPT)  # keys come from other processes too
def _reader_of(key: str) -> tuple[type[Struct] | None, _Reader]:
    kind = type_of(key)
    return kind, _reader(kind or Struct)


@cache
def _reader(kind: type[Struct]) -> _Reader:
    """Return what turns a payload into a checked `kind`: the bare decoder where its types say everything."""
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
    """Return the refusal in the contract's words: key, field, what was found, what is allowed."""
    where = where if len(where) <= 80 else f"{where[:77]}..."
    if not isinstance(error, msgspec.MsgspecError):
        return DecodeError(f"{where}: {str(error) or type(error).__name__}")
    try:
        first = first_fault(msgspec.msgpack.decode(payload), kind)
    except REFUSALS as fault:
        first = ("", f"({len(payload)} bytes) is not msgpack ({fault}); must be a map, the {kind.__name__}")
    path, text = first or ("", f"is refused ({error}); must be the {kind.__name__}")
    return DecodeError(f"{where}: {path or 'the payload'} {text}")
