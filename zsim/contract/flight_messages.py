"""Messages of a flight, contract version 1: drones, commands, estimates, formations, cameras, and views for displays.

Numbers are in SI units and radians, with the unit in the name. W is the world frame (ENU), B the body frame (FLU);
quaternions have w first and rotate B to W.
"""

from collections.abc import Sequence
from operator import itemgetter
from typing import Annotated, Any, Literal, get_args

from msgspec import Meta, Struct

from zsim.contract.keys import on
from zsim.math import elementary as el
from zsim.schema.message import Count, Message, Number, Vector3, Whole

Quaternion = tuple[Number, Number, Number, Number]
Rotors = Annotated[tuple[Number, ...], Meta(min_length=4, max_length=8)]
Covariance = Annotated[tuple[Number, ...], Meta(min_length=36, max_length=36)]
DroneState = Literal["landed", "taking_off", "hovering", "flying", "landing", "emergency"]
AIRBORNE: frozenset[DroneState] = frozenset({"hovering", "flying"})  # states in which a drone accepts setpoints
Connection = Literal["waiting", "connected", "armed", "lost"]
Phase = Literal["idle", "taking_off", "assembling", "engaged", "landing", "held"]
ReferencePhase = Literal["waiting", "approaching", "path", "holding", "over"]
PICTURE_MAX = 4_000_000  # bytes; larger than a JPEG of 1920 x 1080 at full quality
SEEN_MAX = 1000  # maximum number of hats seen in one picture
JPEG_BEGINS = b"\xff\xd8\xff"  # SOI, then the next marker: ISO/IEC 10918-1, B.1

SidePx = Annotated[int, Meta(ge=1, le=16_384)]


# Drones


@on("drone/*/sensor/status", writers="world driver", readers="estimator controller reference", last="world")
class Status(Message, frozen=True):
    """The state of a drone, published as its last message in every gate.

    `commander` is the source whose commands the drone accepts; `count` is the number of messages on the drone's
    `sensor/*` since the last status, including this one.
    """

    state: DroneState
    battery_percent: Number
    collision: bool
    commander: str | None
    count: Count


@on("drone/*/truth", writers="world driver", last="world")
class Truth(Message, frozen=True):
    """The true state of a drone: position, velocity, acceleration in W; attitude B to W; rate in B; rotor speeds."""

    position_m: Vector3
    velocity_m_s: Vector3
    orientation_wxyz: Quaternion
    angular_velocity_rad_s: Vector3
    accel_m_s2: Vector3
    rotor_rad_s: Rotors


@on("drone/*/cmd/*", writers="controller reference operator", is_output=True)
@on("drone/*/accepted/*", writers="world", readers="driver")
class Command(Message, frozen=True):
    """Base of the commands to a drone; `source` is the sender's process name."""

    source: str


@on("drone/*/cmd/velocity", is_output=True)
@on("drone/*/accepted/velocity")
class Velocity(Command, frozen=True):
    """Fly at a velocity [m/s] and turn at a rate [rad/s], counter-clockwise seen from above.

    `frame` is "heading" (x forward, y left, by the sender's yaw estimate) or "world" (W, by the firmware's estimate).
    """

    velocity_m_s: Vector3
    yaw_rate_rad_s: Number
    frame: Literal["heading", "world"] = "heading"


@on("drone/*/cmd/ardrone", is_output=True)
@on("drone/*/accepted/ardrone")
class Ardrone(Command, frozen=True):
    """The AR.Drone's own command: tilt forward and left, climb, yaw rate, each in [-1, 1], relative to its limit."""

    forward: Number
    left: Number
    up: Number
    yaw_left: Number
    hover: bool = False


@on("drone/*/cmd/attitude", is_output=True)
@on("drone/*/accepted/attitude")
class Attitude(Command, frozen=True):
    """Hold the tilt of an orientation B to W, whose heading is ignored, with a thrust [N] and a yaw rate [rad/s]."""

    orientation_wxyz: Quaternion
    thrust_n: Number
    yaw_rate_rad_s: Number


@on("drone/*/cmd/rotors", is_output=True)
@on("drone/*/accepted/rotors")
class RotorSpeeds(Command, frozen=True):
    """Turn the rotors at these speeds, in the vehicle's order.

    Four rotors in an X configuration are in the order front left, front right, rear right, rear left.
    """

    speed_rad_s: Rotors


@on("drone/*/cmd/mode", is_output=True)
@on("drone/*/accepted/mode")
class Mode(Command, frozen=True):
    """Take off, land, stop the rotors at once, or leave the emergency state.

    Accepted from every source with at least the commander's priority.
    """

    mode: Literal["takeoff", "land", "emergency", "reset"]


@on("drone/*/link", writers="driver", last="world")
class LinkState(Message, frozen=True):
    """The link between a driver and the aircraft that flies as an external drone.

    `state`: `waiting` for the first datagram; `connected`, but disarmed: no command that starts or steers a motor is
    sent; `armed`; `lost` after silence. `peer` is the address whose datagrams are accepted. `age_ms` is the wall time
    since the peer's newest datagram, `loss_percent` the share of its recent datagrams that were lost, `clock_offset_ms`
    its clock minus the driver's; these and `round_trip_ms` are None if unknown. `refused` counts datagrams
    that are invalid or from elsewhere.
    """

    source: str
    peer: str
    state: Connection
    age_ms: Number | None
    loss_percent: Number | None
    round_trip_ms: Number | None
    clock_offset_ms: Number | None
    refused: Count


# Estimates and formations


@on(
    "drone/*/estimate",
    writers="estimator driver",
    readers="estimator controller reference",
    last="world",
    is_output=True,
)
class Estimate(Message, frozen=True):
    """The estimated state of a drone: position and velocity in W, attitude B to W.

    `covariance` is that of position and velocity, 6 x 6, row-major, SI units; `gyro_bias_rad_s` is in B; `sensors`
    gives, by sensor, the numbers of readings used and rejected.
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


@on("cluster/*/state", writers="controller", readers="controller", last="world", is_output=True)
class ClusterState(Message, frozen=True):
    """The estimated and the desired state of a formation.

    `drones` are in the order of the robots, which an assembly may change. `names` are the 4n cluster variables of n
    drones, in the order of `value`, `desired` [m, rad] and `desired_rate` [m/s, rad/s]. `trajectory_t_s` is the
    trajectory's own time, None if no trajectory is running; `margin` is the distance to a singularity in the metric of
    the cluster space; `reason` is why the formation waits or is held. `plan_step` is the number of steps of the
    scenario's plan that a restarted controller skips.
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

    def fault(self) -> str | None:
        return length_fault(self, ("names", "value", "desired", "desired_rate"), 4 * len(self.drones))


@on("drone/*/reference", writers="reference", readers="reference", last="world", is_output=True)
class Reference(Message, frozen=True):
    """The reference of a drone with its own pilot: position and velocity in W, heading.

    `phase`: `waiting` on the ground, `approaching` the start of its path or a position, on the `path`, `holding` a
    position, `over` once the drone is to land. `path_t_s` is the path's own time, None off the path.
    """

    phase: ReferencePhase
    position_m: Vector3
    velocity_m_s: Vector3
    yaw_rad: Number
    yaw_rate_rad_s: Number
    path_t_s: Number | None
    source: str


# Cameras


@on("drone/*/camera/*", writers="camera", readers="detector")
@on("drone/*/camera/front")
@on("drone/*/camera/bottom")
class CameraImage(Message, frozen=True, kw_only=True):
    """A picture, exposed around `t_sample_ns`."""

    t_sample_ns: Whole
    source: str
    width: SidePx
    height: SidePx
    format: Literal["jpeg"] = "jpeg"
    data: Annotated[bytes, Meta(max_length=PICTURE_MAX)]

    def fault(self) -> str | None:
        if self.data.startswith(JPEG_BEGINS):
            return None
        return f"data begins with {self.data[:8].hex(' ') or 'nothing'}; must be a JPEG, which begins with ff d8 ff"


@on("drone/*/camera/*/info", writers="camera", readers="detector", last="writer")
@on("drone/*/camera/front/info", is_output=True)
@on("drone/*/camera/bottom/info", is_output=True)
class CameraInfo(Message, frozen=True, kw_only=True):
    """The intrinsics and pose of a camera; the last value is kept.

    `K` is row-major; `D` is k1, k2, p1, p2, k3. `position_m` is the camera's position in B; `orientation_wxyz` rotates
    the camera frame (x right, y down, z ahead) to B. `gate_ns` is the interval of the run's gates.
    """

    source: str = ""
    width: SidePx
    height: SidePx
    K: tuple[Number, Number, Number, Number, Number, Number, Number, Number, Number]
    D: tuple[Number, Number, Number, Number, Number]
    position_m: Vector3
    orientation_wxyz: Quaternion
    rate_hz: Number
    exposure_s: Number = 0.0
    gate_ns: Count = 0


class Seen(Struct, frozen=True, gc=False):
    """A sighted hat, without the identity of its drone.

    `direction_B` is the unit vector from the camera to the hat's centre in B. The sigmas are standard deviations, that
    of the direction about each of two axes perpendicular to it.
    """

    direction_B: Vector3
    range_m: Number
    sigma_direction_rad: Number
    sigma_range_m: Number


@on("drone/*/sightings", writers="detector", is_output=True)
@on("drone/*/sensor/sightings", writers="world")
class Sightings(Message, frozen=True, kw_only=True):
    """The hats seen in one picture of `camera`."""

    t_sample_ns: Whole
    source: str = ""
    camera: str
    seen: Annotated[tuple[Seen, ...], Meta(max_length=SEEN_MAX)] = ()


# For displays: no gate waits for these messages, and they may skip gates


class DroneView(Struct, frozen=True):
    """A drone for displays: position in W, attitude B to W."""

    name: str
    position_m: Vector3
    orientation_wxyz: Quaternion
    rotor_rad_s: Rotors
    state: str
    battery_percent: Number
    commander: str | None = None


@on("view/drones", writers="world")
class ViewDrones(Message, frozen=True):
    """All drones at one time, and the wind at each in W."""

    drones: tuple[DroneView, ...]
    wind_m_s: tuple[Vector3, ...] = ()


class EstimateView(Struct, frozen=True):
    """An estimate for displays; fields as in Estimate.

    `covariance_m2` is that of the position in W, the upper triangle row by row: xx, xy, xz, yy, yz, zz.
    """

    name: str
    position_m: Vector3
    covariance_m2: tuple[Number, Number, Number, Number, Number, Number]
    yaw_rad: Number
    yaw_sigma_rad: Number
    sensors: dict[str, tuple[Count, Count]]
    velocity_m_s: Vector3 = (0.0, 0.0, 0.0)


@on("view/estimates/*", writers="estimator")
class ViewEstimates(Message, frozen=True):
    """The estimates of all drones of an estimator, for displays."""

    estimates: tuple[EstimateView, ...]


@on("view/cluster/*", writers="controller")
class ViewCluster(Message, frozen=True):
    """A formation for displays; fields as in ClusterState."""

    phase: Phase
    names: tuple[str, ...]
    value: tuple[Number, ...]
    desired: tuple[Number, ...]
    reason: str

    def fault(self) -> str | None:
        return length_fault(self, ("value", "desired"), len(self.names))


_triangle = itemgetter(0, 1, 2, 7, 8, 14)  # indices of the position's upper triangle in the 6 x 6 covariance, row-major


def estimate_view(drone: str, estimate: Any) -> EstimateView:
    e = estimate
    covariance_m2 = _triangle(e.covariance)
    return EstimateView(drone, e.position_m, covariance_m2, e.yaw_rad, e.yaw_sigma_rad, e.sensors, e.velocity_m_s)


def cluster_view(state: ClusterState, t_ns: int, seq: int) -> ViewCluster:
    return ViewCluster(t_ns, seq, state.phase, state.names, state.value, state.desired, state.reason)


def length_fault(message: Struct, names: tuple[str, ...], length: int) -> str | None:
    """Return the fault of the first named field that does not have `length` entries; None if all do."""
    for name in names:
        entries = len(getattr(message, name))
        if entries != length:
            return f"{name} has {entries} entries; must have {length}"
    return None


# Commands that a drone accepts, and plausible truths from a driver

_ALL: frozenset[DroneState] = frozenset(get_args(DroneState))
_RULES: dict[str, tuple[str, frozenset[DroneState]]] = {
    "takeoff": ("it must be landed to take off", frozenset({"landed"})),
    "land": ("it must be in the air to land", _ALL - {"landed", "emergency"}),
    "emergency": ("", _ALL),
    "reset": ("only a drone in the emergency state can be reset", frozenset({"emergency"})),
}
_SETPOINT = ("it accepts setpoints only while hovering or flying", AIRBORNE)


def state_refusal(name: str, state: str, requested: str) -> str | None:
    """Return why a drone refuses a command in its current state; None if it accepts the command.

    Args:
        name: name of the drone.
        requested: the requested mode; any other text stands for a setpoint.
    """
    need, states = _RULES.get(requested, _SETPOINT)
    return None if state in states else f"{name} is {state}; {need}"


POSE_AGE_MAX_NS = 500_000_000  # contract: 25 gates, 1 m at 2 m/s; also the limit for an estimate in flight
DISTANCE_MAX_M = 100_000.0  # limit of each coordinate, as in scenarios: a tangent plane cannot represent a larger area
SPEED_MAX_M_S = 200.0  # design choice: twice the speed of the fastest racing drones
RATE_MAX_RAD_S = 100.0  # design choice: more than twice the range of a 2000 deg/s gyroscope
UNIT_SLACK = 0.01  # tolerance of a quaternion's length; single precision stays within 1e-6


def moved_on(p_W: Sequence[float], v_W: Sequence[float], age_ns: int) -> tuple[float, float, float]:
    """Return a drone's position [m; W] from an old pose, at constant velocity for POSE_AGE_MAX_NS, then at rest."""
    age_s = min(max(0, age_ns), POSE_AGE_MAX_NS) * 1e-9
    x, y, z = (p + v * age_s for p, v in zip(p_W, v_W, strict=True))
    return x, y, z


def truth_fault(truth: Truth, rotors: int) -> str | None:
    """Return the fault of the first implausible field of a driver's truth; None if all are plausible.

    The numbers are known to be finite.
    """
    limits = (
        ("position_m", DISTANCE_MAX_M, "m"),
        ("velocity_m_s", SPEED_MAX_M_S, "m/s"),
        ("angular_velocity_rad_s", RATE_MAX_RAD_S, "rad/s"),
    )
    for name, limit, unit in limits:
        values: Sequence[float] = getattr(truth, name)
        if max(map(abs, values)) > limit:
            return f"{name} is {_shown(values)}; each must be at most {limit:g} {unit} in magnitude"
    if abs(el.length(truth.orientation_wxyz) - 1.0) > UNIT_SLACK:
        return f"orientation_wxyz is {_shown(truth.orientation_wxyz)}; must be a quaternion of length 1"
    if len(truth.rotor_rad_s) != rotors:
        return f"rotor_rad_s has {len(truth.rotor_rad_s)} speeds; must have {rotors}, one per rotor of the drone"
    return None


def _shown(values: Sequence[float]) -> str:
    return f"[{', '.join(f'{value:g}' for value in values)}]"
