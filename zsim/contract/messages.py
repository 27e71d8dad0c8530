"""The messages of the contract, version 1: typed, validated on decode.

Every message is a msgpack map with exactly these field names, SI units and radians, the unit in the name.
`encode` and `decode` are the only way onto and off the wire.
"""

import math
import sys
from collections.abc import Callable, Iterable, Iterator
from functools import cache, lru_cache
from typing import Annotated, Any, Literal, NoReturn

import msgspec
from msgspec import Meta, Struct

from zsim.errors import DecodeError
from zsim.schema.checker import first_fault

# Limits that every finite number keeps and that NaN and infinities break: msgspec compares while it decodes.
Number = Annotated[float, Meta(ge=-sys.float_info.max, le=sys.float_info.max)]
Whole = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Vector3 = tuple[Number, Number, Number]
Quaternion = tuple[Number, Number, Number, Number]
Rotors = Annotated[tuple[Number, ...], Meta(min_length=4, max_length=8)]
Covariance = Annotated[tuple[Number, ...], Meta(min_length=36, max_length=36)]
DroneState = Literal["landed", "taking_off", "hovering", "flying", "landing", "emergency"]
Phase = Literal["idle", "taking_off", "assembling", "engaged", "landing", "held"]
PAYLOAD_MAX = 16_000_000  # bytes; a scenario of 1000 drones in world/info is below this
REFUSALS = (ValueError, TypeError, RecursionError, OverflowError, MemoryError, msgspec.MsgspecError)
"""Whatever a decoder raises for a payload that somebody else wrote: wrong types, bad UTF-8, maps without end."""


class Message(Struct, frozen=True, gc=False):
    """What every message starts with: simulated time of publication, and a count per key from 0."""

    t_ns: Count
    seq: Count


class Origin(Struct, frozen=True):
    """The origin of W: WGS 84 latitude and longitude [deg], ellipsoidal height [m]."""

    latitude_deg: Number
    longitude_deg: Number
    height_m: Number


class RotorInfo(Struct, frozen=True):
    """A rotor: its place in B and its radius [m]; `turn` is 1 if it turns clockwise seen from above, else -1."""

    name: str
    x_m: Number
    y_m: Number
    turn: Literal[-1, 1]
    radius_m: Number


class DroneInfo(Struct, frozen=True):
    """A drone of the run, the model of its aircraft, and its rotors in the order of `rotor_rad_s`.

    Records of older versions name no rotors.
    """

    name: str
    model: str
    rotors: tuple[RotorInfo, ...] = ()


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


class Waiting(Struct, frozen=True):
    """A process that the world waits for, its host, and the wall time since when [s]."""

    name: str
    host: str
    since_wall_s: Number


class Clock(Message, frozen=True):
    """The gate that the world has published; its `rate` is measured. `waiting_for` is filled while time stands."""

    run_id: str
    step: Count
    state: Literal["waiting", "running", "paused", "stopped"]
    rate: Number
    waiting_for: tuple[Waiting, ...] = ()


class Event(Message, frozen=True):
    """Something that happened once: what, by whom, about whom, in words, and in figures."""

    kind: str
    source: str
    subject: str
    text: str
    data: dict[str, Any] = {}


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


class Status(Message, frozen=True):
    """What a drone tells of itself, last in every gate.

    `commander` is who flies it; `count` is how many messages on its `sensor/*` have come since the last status, this
    one included.
    """

    state: DroneState
    battery_percent: Number
    collision: bool
    commander: str | None
    count: Count


class Truth(Message, frozen=True):
    """The true state of a drone: position, velocity, acceleration in W, attitude B to W, rate in B, rotor speeds."""

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
    """Fly a velocity [m/s] and turn at a rate [rad/s], counter-clockwise from above.

    `frame`: "heading", x forward and y left by the sender's idea of the yaw; "world", W by the firmware's own.
    """

    velocity_m_s: Vector3
    yaw_rate_rad_s: Number
    frame: Literal["heading", "world"] = "heading"


class Ardrone(Command, frozen=True):
    """Fly as the aircraft's own commands do: tilt forward and left, climb, yaw rate, each in [-1, 1] of its limit."""

    forward: Number
    left: Number
    up: Number
    yaw_left: Number
    hover: bool = False


class Attitude(Command, frozen=True):
    """Hold the tilt of an orientation B to W, whose heading is not used, with a thrust [N] and a yaw rate."""

    orientation_wxyz: Quaternion
    thrust_n: Number
    yaw_rate_rad_s: Number


class RotorSpeeds(Command, frozen=True):
    """Turn the rotors at these speeds: front left, front right, rear right, rear left."""

    speed_rad_s: Rotors


class Mode(Command, frozen=True):
    """Take off, land, stop the rotors at once, or leave the emergency; open to all with the commander's priority."""

    mode: Literal["takeoff", "land", "emergency", "reset"]


class Estimate(Message, frozen=True):
    """Where an estimator believes its drone to be: position and velocity in W, attitude B to W.

    `covariance` is that of position and velocity, 6 x 6, row-major, SI units; `gyro_bias_rad_s` is in B; `sensors` has
    by name how many readings were used and refused.
    """

    position_m: Vector3
    velocity_m_s: Vector3
    orientation_wxyz: Quaternion
    yaw_rad: Number
    covariance: Covariance
    yaw_sigma_rad: Number
    gyro_bias_rad_s: Vector3
    sensors: dict[str, tuple[Count, Count]]
    source: str = ""


class ClusterState(Message, frozen=True):
    """Where a formation is, by the estimates, and where it is to be.

    `names` are the 4n cluster variables of n drones, in the order of `value`, `desired` [m, rad] and `desired_rate`
    [m/s, rad/s]. `trajectory_t_s` is the trajectory's own time, None where none runs; `margin` is the distance to a
    singularity in the measure of the cluster space; `reason` is why it waits or is held. `plan_step` is how many steps
    of the scenario's plan a restarted controller leaves out.
    """

    phase: Phase
    drones: tuple[str, ...]
    names: tuple[str, ...]
    value: tuple[Number, ...]
    desired: tuple[Number, ...]
    desired_rate: tuple[Number, ...]
    trajectory_t_s: Number | None
    margin: Number
    reason: str
    source: str = ""
    plan_step: Count = 0


class ClusterRequest(Message, frozen=True):
    """A request on `cluster/{c}/control` as the controller took it, before its outputs of the gate `t_ns`.

    `source` is who asked; `error` is why it is refused. `controller` is the process that answered.
    """

    op: str
    args: dict[str, Any]
    source: str
    ok: bool
    error: str = ""
    controller: str = ""


class Join(Message, frozen=True):
    """A process takes part from now on; the newest of several random incarnations counts.

    `period_ns` is how often it says done: a multiple of the gate, 0 for never. `serves` names processes that need not
    join, since this one does what they would.
    """

    run_id: str
    incarnation: int
    role: str
    host: str
    pid: int
    period_ns: Whole
    version: str = ""
    fingerprint: str = ""
    serves: tuple[str, ...] = ()


class Done(Message, frozen=True):
    """Everything stamped up to `done_ns` is handled and answered; `sent` outputs were sent since the last done."""

    run_id: str
    incarnation: int
    done_ns: Whole
    sent: Count


class Bye(Message, frozen=True):
    """A process leaves of its own will."""

    reason: str


class Health(Message, frozen=True):
    role: str
    host: str
    pid: int
    step_us: dict[str, Number]
    lag_ns: Whole
    dropped: Count
    refused: Count
    rss_bytes: Count
    received: Count = 0


class DroneView(Struct, frozen=True):
    """A drone as eyes see it: position in W, attitude B to W."""

    name: str
    position_m: Vector3
    orientation_wxyz: Quaternion
    rotor_rad_s: Rotors
    state: str
    battery_percent: Number
    commander: str | None = None


class ViewDrones(Message, frozen=True):
    """All drones at one instant, and the wind at each in W; never gates and may skip."""

    drones: tuple[DroneView, ...]
    wind_m_s: tuple[Vector3, ...] = ()


class EstimateView(Struct, frozen=True):
    """An estimate as eyes see it; fields as in Estimate.

    `covariance_m2` is that of the position in W, the upper triangle row by row: xx, xy, xz, yy, yz, zz.
    """

    name: str
    position_m: Vector3
    covariance_m2: tuple[Number, Number, Number, Number, Number, Number]
    yaw_rad: Number
    yaw_sigma_rad: Number
    sensors: dict[str, tuple[Count, Count]]


class ViewEstimates(Message, frozen=True):
    """What an estimator believes of all its drones, for eyes; never gates and may skip."""

    estimates: tuple[EstimateView, ...]


class ViewCluster(Message, frozen=True):
    """A formation as eyes see it; fields as in ClusterState; never gates and may skip."""

    phase: Phase
    names: tuple[str, ...]
    value: tuple[Number, ...]
    desired: tuple[Number, ...]
    reason: str


class Fault(Struct, frozen=True):
    """An injected fault: a kind and parameters of docs/faults.md, a drone, link, cluster or process as its target.

    It acts in the gates after `from_ns` up to `until_ns`, or until it is cleared. `source` is "scenario", or who asked.
    `rank` counts those of the same kind, target and start before it: each of them has a stream of its own.
    """

    id: Count
    kind: str
    target: str
    parameters: dict[str, Any]
    from_ns: Count
    until_ns: Count | None = None
    source: str = ""
    rank: Count = 0


class Faults(Message, frozen=True):
    """The faults that are planned or act, in the order of their ids; said before the first gate that a change is in."""

    faults: tuple[Fault, ...] = ()


GATES_MAX = 1_000_000  # of one `step`: 5.5 hours at 20 ms
RATE_MAX = 1000.0  # simulated per wall second; beyond it nothing paces
PRIORITY_MAX = 100  # programs have 0, operators 10


class ControlRequest(Struct, frozen=True):
    """What is asked of `world/control` and `cluster/{c}/control`."""

    op: str
    args: dict[str, Any] = {}
    source: str = ""


class ControlAnswer(Struct, frozen=True):
    """Whether a request was done; if not, why; and what it asked for."""

    ok: bool
    error: str = ""
    result: Any = None
    more: Count | None = None


_FIXED: dict[str, type[Struct]] = {
    "world/info": Info,
    "clock": Clock,
    "world/event": Event,
    "world/faults": Faults,
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
    ("cluster", "request"): ClusterRequest,
    ("process", "join"): Join,
    ("process", "done"): Done,
    ("process", "bye"): Bye,
    ("process", "health"): Health,
}
_VIEWS: dict[str, type[Struct]] = {"view/cluster/": ViewCluster, "view/estimates/": ViewEstimates}
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
    fault_of = _RELATIONS.get(kind)
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


# What the types alone do not say


def _event_fault(event: Event) -> str | None:
    return _free_fault("data", event.data)


def _request_fault(request: ControlRequest | ClusterRequest) -> str | None:
    return _free_fault("args", request.args)


def _answer_fault(answer: ControlAnswer) -> str | None:
    return _free_fault("result", answer.result)


def _free_fault(field: str, value: Any) -> str | None:
    """Return the fault of a field whose content is free: only its numbers must be finite."""
    infinite = next((number for number in _numbers(value) if not math.isfinite(number)), None)
    return None if infinite is None else f"{field} holds {infinite}; must be finite numbers"


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, float):
        yield value
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _numbers(key)
            yield from _numbers(item)
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _numbers(item)


def _state_fault(state: ClusterState) -> str | None:
    wanted = 4 * len(state.drones)
    return _length_fault(state, ("names", "value", "desired", "desired_rate"), wanted)


def _view_fault(view: ViewCluster) -> str | None:
    return _length_fault(view, ("value", "desired"), len(view.names))


def _length_fault(message: Struct, names: tuple[str, ...], wanted: int) -> str | None:
    for name in names:
        length = len(getattr(message, name))
        if length != wanted:
            return f"{name} has {length} entries; must have {wanted}"
    return None


_RELATIONS: dict[type[Struct], Callable[[Any], str | None]] = {
    Event: _event_fault,
    ControlRequest: _request_fault,
    ClusterRequest: _request_fault,
    ControlAnswer: _answer_fault,
    ClusterState: _state_fault,
    ViewCluster: _view_fault,
}
