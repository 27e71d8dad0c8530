"""The messages of the contract, version 1: typed, validated on decode.

Every message is a msgpack map with exactly these field names, SI units and radians, the unit in the name.
`encode` and `decode` are the only way onto and off the wire.
"""

import math
from collections.abc import Iterable
from typing import Any, Literal

import msgspec
from msgspec import Struct, structs

from zsim.errors import DecodeError

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Rotors = tuple[float, float, float, float]
DroneState = Literal["landed", "taking_off", "hovering", "flying", "landing", "emergency"]
Phase = Literal["idle", "taking_off", "assembling", "engaged", "landing", "held"]
PAYLOAD_MAX = 16_000_000  # bytes; a scenario of 1000 drones in world/info is below this


class Message(Struct, frozen=True, gc=False):
    """What every message starts with: simulated time of publication, and a count per key from 0."""

    t_ns: int
    seq: int


class Origin(Struct, frozen=True):
    latitude_deg: float
    longitude_deg: float
    height_m: float


class DroneInfo(Struct, frozen=True):
    name: str
    model: str


class ClusterInfo(Struct, frozen=True):
    name: str
    drones: tuple[str, ...]


class Info(Message, frozen=True):
    contract: int
    run_id: str
    federation: str
    mode: Literal["lockstep", "realtime"]
    rate: float
    gate_ns: int
    physics_dt_ns: int
    command_delay_ns: int
    seed: int
    origin: Origin
    drones: tuple[DroneInfo, ...]
    clusters: tuple[ClusterInfo, ...]
    scenario: str
    scenario_sha256: str
    version: str
    fingerprint: str


class Waiting(Struct, frozen=True):
    name: str
    host: str
    since_wall_s: float


class Clock(Message, frozen=True):
    run_id: str
    step: int
    state: Literal["waiting", "running", "paused", "stopped"]
    rate: float
    waiting_for: tuple[Waiting, ...] = ()


class Event(Message, frozen=True):
    kind: str
    source: str
    subject: str
    text: str
    data: dict[str, Any] = {}


class Imu(Message, frozen=True):
    t_sample_ns: int
    accel_m_s2: Vector3
    gyro_rad_s: Vector3


class Gps(Message, frozen=True):
    t_sample_ns: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    position_m: Vector3
    velocity_m_s: Vector3
    sigma_m: float
    fix: int
    satellites: int


class Mag(Message, frozen=True):
    t_sample_ns: int
    field_ut: Vector3


class Baro(Message, frozen=True):
    t_sample_ns: int
    pressure_pa: float
    altitude_m: float


class Sonar(Message, frozen=True):
    t_sample_ns: int
    range_m: float
    valid: bool


class Flow(Message, frozen=True):
    t_sample_ns: int
    velocity_m_s: Vector3
    quality: float


class Status(Message, frozen=True):
    state: DroneState
    battery_percent: float
    collision: bool
    commander: str | None
    count: int


class Truth(Message, frozen=True):
    position_m: Vector3
    velocity_m_s: Vector3
    orientation_wxyz: Quaternion
    angular_velocity_rad_s: Vector3
    accel_m_s2: Vector3
    rotor_rad_s: Rotors


class Command(Message, frozen=True):
    """Base of what is sent to a drone; `source` is the sender's process name."""

    source: str


class Velocity(Command, frozen=True):
    velocity_m_s: Vector3
    yaw_rate_rad_s: float
    frame: Literal["heading", "world"] = "heading"


class Ardrone(Command, frozen=True):
    forward: float
    left: float
    up: float
    yaw_left: float
    hover: bool = False


class Attitude(Command, frozen=True):
    orientation_wxyz: Quaternion
    thrust_n: float
    yaw_rate_rad_s: float


class RotorSpeeds(Command, frozen=True):
    speed_rad_s: Rotors


class Mode(Command, frozen=True):
    mode: Literal["takeoff", "land", "emergency", "reset"]


class Estimate(Message, frozen=True):
    position_m: Vector3
    velocity_m_s: Vector3
    orientation_wxyz: Quaternion
    yaw_rad: float
    covariance: tuple[float, ...]
    yaw_sigma_rad: float
    gyro_bias_rad_s: Vector3
    sensors: dict[str, tuple[int, int]]
    source: str = ""


class ClusterState(Message, frozen=True):
    phase: Phase
    drones: tuple[str, ...]
    names: tuple[str, ...]
    value: tuple[float, ...]
    desired: tuple[float, ...]
    desired_rate: tuple[float, ...]
    trajectory_t_s: float | None
    margin: float
    reason: str
    source: str = ""


class Join(Message, frozen=True):
    run_id: str
    incarnation: int
    role: str
    host: str
    pid: int
    period_ns: int
    version: str = ""
    fingerprint: str = ""


class Done(Message, frozen=True):
    run_id: str
    incarnation: int
    done_ns: int
    sent: int


class Bye(Message, frozen=True):
    reason: str


class Health(Message, frozen=True):
    role: str
    host: str
    pid: int
    step_us: dict[str, float]
    lag_ns: int
    dropped: int
    refused: int
    rss_bytes: int


class DroneView(Struct, frozen=True):
    name: str
    position_m: Vector3
    orientation_wxyz: Quaternion
    rotor_rad_s: Rotors
    state: str
    battery_percent: float


class ViewDrones(Message, frozen=True):
    drones: tuple[DroneView, ...]
    wind_m_s: tuple[Vector3, ...] = ()


class ViewCluster(Message, frozen=True):
    phase: Phase
    names: tuple[str, ...]
    value: tuple[float, ...]
    desired: tuple[float, ...]
    reason: str


class ControlRequest(Struct, frozen=True):
    """What is asked of `world/control` and `cluster/{c}/control`."""

    op: str
    args: dict[str, Any] = {}
    source: str = ""


class ControlAnswer(Struct, frozen=True):
    ok: bool
    error: str = ""
    result: Any = None


_FIXED: dict[str, type[Struct]] = {
    "world/info": Info,
    "clock": Clock,
    "world/event": Event,
    "view/drones": ViewDrones,
}
_BY_SHAPE: dict[tuple[str, str], type[Struct]] = {
    ("drone", "sensor/imu"): Imu,
    ("drone", "sensor/gps"): Gps,
    ("drone", "sensor/mag"): Mag,
    ("drone", "sensor/baro"): Baro,
    ("drone", "sensor/sonar"): Sonar,
    ("drone", "sensor/flow"): Flow,
    ("drone", "sensor/status"): Status,
    ("drone", "truth"): Truth,
    ("drone", "cmd/velocity"): Velocity,
    ("drone", "cmd/ardrone"): Ardrone,
    ("drone", "cmd/attitude"): Attitude,
    ("drone", "cmd/rotors"): RotorSpeeds,
    ("drone", "cmd/mode"): Mode,
    ("drone", "estimate"): Estimate,
    ("cluster", "state"): ClusterState,
    ("process", "join"): Join,
    ("process", "done"): Done,
    ("process", "bye"): Bye,
    ("process", "health"): Health,
}
_VIEW_CLUSTER = "view/cluster/"
_types: dict[str, type[Struct] | None] = {}
_decoders: dict[type[Struct], msgspec.msgpack.Decoder[Any]] = {}
_encoder = msgspec.msgpack.Encoder()


def type_of(key: str) -> type[Struct] | None:
    """Return the message type that the contract puts on a key, None for a key that it does not know."""
    if key not in _types:
        _types[key] = _find_type(key)
    return _types[key]


def _find_type(key: str) -> type[Struct] | None:
    if key.startswith(_VIEW_CLUSTER):
        return ViewCluster
    parts = key.split("/", 2)
    return _FIXED.get(key) or (_BY_SHAPE.get((parts[0], parts[2])) if len(parts) == 3 else None)


def types_by_shape() -> dict[str, type[Struct]]:
    """Return all message types with the shape of their key, for documentation and for tests over every message."""
    shapes = {f"{kind}/*/{rest}": message for (kind, rest), message in _BY_SHAPE.items()}
    return {**_FIXED, **shapes, "view/cluster/*": ViewCluster}


def encode(message: Struct) -> bytes:
    """Return the payload of a message."""
    return _encoder.encode(message)


def encoding(key: str) -> str:
    """Return the Zenoh encoding of a key's messages."""
    kind = type_of(key)
    return f"application/msgpack;{kind.__name__}" if kind else "application/msgpack"


def decode(key: str, payload: bytes) -> Any:
    """Return the message on `key`, checked for type, shape and finiteness.

    Raises:
        DecodeError: names key, field, found and allowed.
    """
    kind = type_of(key)
    if kind is None:
        raise DecodeError(f"{key}: is no key of the contract; see docs/protocol.md")
    return decode_as(kind, payload, key)


def decode_as(kind: type[Struct], payload: bytes, where: str) -> Any:
    """Return `payload` as a `kind`; `where` opens the text of the DecodeError."""
    if len(payload) > PAYLOAD_MAX:
        raise DecodeError(f"{where}: payload has {len(payload)} bytes; at most {PAYLOAD_MAX}")
    try:
        message = _decoder(kind).decode(payload)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, OverflowError) as error:
        raise DecodeError(f"{where}: {_reason(error)}; must be a {kind.__name__}") from error
    if isinstance(message, Message):
        _check_stamp(message, where)
    _check_finite(message, where)
    return message


def _decoder(kind: type[Struct]) -> msgspec.msgpack.Decoder[Any]:
    if kind not in _decoders:
        _decoders[kind] = msgspec.msgpack.Decoder(kind)
    return _decoders[kind]


def _reason(error: Exception) -> str:
    """Return msgspec's text with the path first: "velocity_m_s[2]: Expected `float`, got `str`"."""
    text, _, path = str(error).partition(" - at `$")
    return f"{path.strip('`').lstrip('.')}: {text}" if path else text


def _check_stamp(message: Message, where: str) -> None:
    if message.t_ns < 0 or message.seq < 0:
        raise DecodeError(f"{where}: t_ns is {message.t_ns} and seq {message.seq}; both must be >= 0")


def _check_finite(message: Struct, where: str) -> None:
    for name in message.__struct_fields__:
        if not _finite(getattr(message, name)):
            found = getattr(message, name)
            raise DecodeError(f"{where}: {name} is {found!r:.80}; must be finite numbers")


def _finite(value: Any) -> bool:
    kind = type(value)
    if kind is float:
        return math.isfinite(value)
    if kind is tuple or kind is list:
        return all(map(_finite, value))
    if kind is dict:
        return all(map(_finite, value.values()))
    return not isinstance(value, Struct) or all(_finite(part) for part in structs.astuple(value))


def fields(kind: type[Struct]) -> Iterable[str]:
    """Return the names of a message's fields in order."""
    return kind.__struct_fields__
