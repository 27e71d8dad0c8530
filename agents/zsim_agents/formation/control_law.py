"""Control laws of a formation: velocity commands from the estimates of the robots and a reference.

Contains the base class of all laws (`law:` of a cluster may name a user's subclass), the stock law, the inputs that a
scenario grants to a law besides the estimates, and the compiled functions that saturate the robots' velocities and
guard the distances between robots.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np
from msgspec import UNSET, Struct, convert
from numpy.typing import NDArray

from zsim.contract import keys
from zsim.contract.messages import decode, encode, type_of
from zsim.contract.snapshot import State
from zsim.errors import UserCodeError
from zsim.math.compiled import portable
from zsim.math.rotation import Vector, dot, norm, subtract
from zsim.scenario.scenario import Cluster, Environment, Obstacle, Surface
from zsim.schema import plugin
from zsim.schema.checker import show
from zsim.sensors.sensor import Sample
from zsim_agents.formation.spaces.cluster_space import TAU, Array, ClusterSpace, row

Pairs = tuple[tuple[int, int], ...]
Order = NDArray[np.int64]
PairTable = NDArray[np.int64]
Kind = TypeVar("Kind", bound=Sample)

RATES = ("vx", "vy", "vz", "yaw rate")  # components of a robot's velocity, in the order of r_dot
NEAR_M = 1e-6  # distance below which the direction between two robots is undefined
DEFICIT_MIN_M_S = 1e-9  # smaller deficits of the separation rate are ignored
LOAD_MIN = 1e-9  # avoids division by zero
GUARD_SWEEPS = 4  # passes over all pairs: one is enough for two robots; three close together need a few


@dataclass(frozen=True)
class FormationGains:
    """Parameters of a law, validated with the scenario. For those not listed here, see `RobotLimits`.

    Attributes:
        k_1_s: proportional gain [1/s]; 0.5 to 0.8 works well; above about 2, a drone's velocity loop is too slow.
        integral_1_s2: integral gain [1/s^2]; removes the offset due to wind; 0 switches it off.
        integral_max_m_s, integral_max_rad_s: limits of the integral term for lengths and for angles.
        separation_min_m: minimum distance between two robots, for references and for the guard.
    """

    k_1_s: float = 0.6
    integral_1_s2: float = 0.05
    integral_max_m_s: float = 0.5
    integral_max_rad_s: float = 0.1
    speed_max_m_s: float = 2.0  # limit of velocityXY in the paper's base simulator, hector_quadrotor
    climb_max_m_s: float = 1.0  # control_vz_max of the AR.Drone SDK outdoors, 1000 mm/s
    yaw_rate_max_rad_s: float = 1.75  # control_yaw of the AR.Drone SDK
    separation_min_m: float = 2.0  # four times the width of the drone with its hull, 0.52 m
    separation_alarm_m: float = 1.5
    guard_horizon_s: float = 1.0
    response_s: float = 0.3

    @cached_property
    def limits(self) -> RobotLimits:
        return RobotLimits(*(float(getattr(self, name)) for name in RobotLimits._fields))


class FormationCommand(Struct, eq=False):
    """The commands to the robots.

    Attributes:
        v_W, yaw_rate: velocities (n, 3) [m/s, W] and yaw rates (n,) [rad/s].
        factor: common factor of the saturation; 1 without saturation.
        guarded: pairs of robot indices that the guard keeps apart; alarmed: pairs closer than the alarm threshold.
    """

    v_W: Array
    yaw_rate: Array
    factor: float
    guarded: Pairs
    alarmed: Pairs


class ControlLaw(ABC):
    """Base class of control laws, which saturates and guards the rates of every law in the same way.

    Saturation by one factor for all robots keeps the direction in cluster space; the guard keeps the robots apart. A
    user's law implements `rates` and, if it has state, `reset`, `followed`, `snapshot` and `restore`.

    Args:
        space: cluster space of n robots.
        gains: gains of the scenario, of which a law uses those it needs.

    Attributes:
        robots: names of the robots in messages, in order.
        grants: inputs besides the estimates, read through `samples`, `map` and `now_ns`.
    """

    _granted: Grants | None = None

    def __init__(self, space: ClusterSpace, gains: FormationGains | None = None) -> None:
        self.space = space
        self.gains = gains or FormationGains()
        self.grants = self._granted or Grants()
        self.robots: Sequence[str] = [f"robot {i + 1}" for i in range(space.n)]
        self._order = np.empty((space.n, space.n), np.int64)
        self._is_own = plugin.is_own(type(self))

    @abstractmethod
    def rates(self, c: Array, p_W: Array, v_W: Array, c_des: Array, c_dot_des: Array) -> Array:
        """Return the desired r_dot (4n,): (vx, vy, vz [m/s], yaw rate [rad/s]) robot by robot, in W.

        Args:
            c: cluster variables of the estimates, (4n,).
            p_W, v_W: estimated positions and velocities, (n, 3) each [m, m/s; W].
            c_des, c_dot_des: reference and its rate, (4n,) each.
        """

    def samples(self, sensor: str, kind: type[Kind]) -> tuple[Kind | None, ...]:
        """Return each robot's newest sample of a sensor, in the order of the robots; None before the first sample.

        `t_ns` of a sample is the gate at which it was published, `t_sample_ns` the time of measurement.

        Args:
            sensor: name of the sensor, one of the cluster's `law_sensors`.
            kind: class of its messages, e.g. zsim.sensors.scanner.Range for "range".

        Raises:
            UserCodeError: the scenario does not grant the sensor, or its samples are of another class.
        """
        return self.grants.samples(type(self), sensor, kind)

    @property
    def map(self) -> Map:
        """The obstacles and surfaces of the scenario; UserCodeError unless the cluster's `law_map` is true."""
        return self.grants.map_for(type(self))

    @property
    def now_ns(self) -> int:
        """Simulated time of the present gate [ns]."""
        return self.grants.t_ns

    def reset(self) -> None:  # noqa: B027 - a law may have no state
        """Clear all state; called when the formation is engaged or continues after a fault."""

    def followed(self, dt_s: float) -> None:  # noqa: B027
        """Advance the state by dt_s [s] after a gate whose rates were neither saturated nor guarded.

        It is not called after other gates, so that an integral accumulated here does not wind up.
        """

    def snapshot(self) -> State | None:
        """Return all state as plain values and arrays: {} for a law without state, None if it cannot be transferred."""
        return {} if type(self).reset is ControlLaw.reset and type(self).followed is ControlLaw.followed else None

    def restore(self, state: State) -> None:  # noqa: B027
        """Restore a `snapshot` taken in another process, to continue bit-identically."""

    def command(
        self, c: Array, p_W: Array, v_W: Array, c_des: Array, c_dot_des: Array, dt_s: float
    ) -> FormationCommand:
        """Return the command of this gate; arguments as in `rates`, and dt_s, the time since the last command [s].

        Raises:
            UserCodeError: `rates` of a user's law returned an array of the wrong size or a non-finite rate.
        """
        n, order = self.space.n, self._order
        r_dot = self.rates(c, p_W, v_W, c_des, c_dot_des)
        if self._is_own:  # compiled code would read past the end of a shorter array
            r_dot = self._checked(r_dot)
        v_cmd_W, yaw_rate = np.empty((n, 3)), np.empty(n)
        factor, guards, alarms = limited(r_dot, p_W, v_W, v_cmd_W, yaw_rate, order, *self.gains.limits)
        if factor == 1.0 and not guards:
            self.followed(dt_s)
        guarded, alarmed = numbered(order) if guards else (), numbered(order.T) if alarms else ()
        return FormationCommand(v_cmd_W, yaw_rate, factor, guarded, alarmed)

    def _checked(self, r_dot: Any) -> Array:
        context, size = f"{plugin.full_name(type(self))}.rates returns", self.space.size
        try:
            rates = plugin.numbers(r_dot)
        except ValueError as error:
            raise UserCodeError(f"{context} {show(r_dot)}; must be {size} real numbers") from error
        if rates.shape != (size,):
            raise UserCodeError(f"{context} an array of shape {rates.shape}; must be ({size},), four for each robot")
        invalid = np.flatnonzero(~np.isfinite(rates))
        if invalid.size:
            robot, k = divmod(int(invalid[0]), len(RATES))
            raise UserCodeError(f"{context} {rates[invalid[0]]} as {RATES[k]} of {self.robots[robot]}; must be finite")
        return rates


class ProportionalLaw(ControlLaw):
    """Feed-forward, proportional and integral terms in cluster space; the integral I (4n,) is its only state.

    c_dot_cmd = c_dot_des + k (c_des - c) + I,    I' = k_i (c_des - c),    r_dot = J^-1(c) c_dot_cmd
    """

    def __init__(self, space: ClusterSpace, gains: FormationGains | None = None) -> None:
        super().__init__(space, gains)
        self._clamp = np.where(space.in_radians, self.gains.integral_max_rad_s, self.gains.integral_max_m_s)
        self._error, self._c_dot = np.empty(space.size), np.empty(space.size)
        self.reset()

    def reset(self) -> None:
        self.integral = np.zeros(self.space.size)

    def snapshot(self) -> State:
        return {"integral": self.integral}

    def restore(self, state: State) -> None:
        self.integral = state["integral"]

    def rates(self, c: Array, p_W: Array, v_W: Array, c_des: Array, c_dot_des: Array) -> Array:
        error, c_dot = self._error, self._c_dot
        put_cluster_rate(c_des, c, self.space.period, c_dot_des, self.integral, self.gains.k_1_s, error, c_dot)
        return self.space.motion(c, c_dot)

    def followed(self, dt_s: float) -> None:
        accumulate(self.integral, self._error, self.gains.integral_1_s2 * dt_s, self._clamp)


LAWS: dict[str, type[ControlLaw]] = {"proportional": ProportionalLaw}  # stock laws by name in a scenario


class Map(NamedTuple):
    """Obstacles and surfaces of the scenario, in W, including those of its forest, corridor and cloud."""

    obstacles: Sequence[Obstacle]
    surfaces: Sequence[Surface]


class Grants:
    """The inputs of one law: the newest sample of each granted sensor of each drone, and the map if granted.

    Attributes:
        t_ns: simulated time of the present gate [ns].
        keys: keys of the granted sensors, which the law's process must read.
    """

    def __init__(
        self,
        cluster: str = "NAME",
        drones: Sequence[str] = (),
        sensors: Sequence[str] = (),
        scenario_map: Map | None = None,
    ) -> None:
        self.t_ns = 0
        self._cluster, self._map = cluster, scenario_map
        self._newest: dict[str, list[Sample | None]] = {name: [None] * len(drones) for name in sensors}
        self._received: dict[str, Any] = {name: type_of(keys.sensor(drones[0], name)) for name in sensors}
        self._drones: Sequence[str] = drones
        self._slots = self._slots_by_key()
        self.keys = tuple(self._slots)

    def _slots_by_key(self) -> dict[str, tuple[str, int]]:
        return {keys.sensor(drone, name): (name, i) for name in self._newest for i, drone in enumerate(self._drones)}

    def reorder(self, drones: Sequence[str]) -> None:
        """Set the names of the drones, in the order of the robots."""
        if not self.keys:
            return
        order = [self._drones.index(drone) for drone in drones]
        self._newest = {name: [newest[k] for k in order] for name, newest in self._newest.items()}
        self._drones = drones
        self._slots = self._slots_by_key()

    def put(self, key: str, sample: Sample) -> None:
        name, index = self._slots[key]
        former = self._newest[name][index]
        if former is None or sample.t_ns >= former.t_ns:  # in real time, an older sample may arrive after a newer one
            self._newest[name][index] = sample

    def samples(self, law: type, sensor: str, kind: type[Kind]) -> tuple[Kind | None, ...]:
        """Implement `ControlLaw.samples`; `law` is the law's class, for the text of a UserCodeError."""
        if sensor not in self._newest:
            listed = ", ".join([*self._newest, sensor])
            raise self._not_granted(law, f"sensor {sensor!r:.40}", "law_sensors", f"law_sensors: [{listed}]")
        received = self._received[sensor]
        if received not in (None, kind) and not _is_declared_as(received, kind):
            finding = f"{plugin.full_name(law)} reads {sensor!r} as {getattr(kind, '__name__', kind)!s:.40}"
            raise UserCodeError(f"{finding}; must be {received.__name__}, the class of its messages")
        newest = self._newest[sensor]
        for index, sample in enumerate(newest):
            if sample is not None and type(sample) is not kind:  # its class was built from `world/info`
                newest[index] = convert(sample, kind, from_attributes=True)
        return tuple(newest)  # type: ignore[return-value] - converted above

    def map_for(self, law: type) -> Map:
        if self._map is None:
            raise self._not_granted(law, "the map", "law_map", "law_map: true")
        return self._map

    def _not_granted(self, law: type, subject: str, field: str, line: str) -> UserCodeError:
        where = f"{plugin.full_name(law)} reads {subject}, which clusters.{self._cluster}.{field} does not grant"
        return UserCodeError(f"{where}; write `{line}` in the cluster, or remove the call from the class")

    def snapshot(self) -> State:
        newest = ((key, self._newest[name][index]) for key, (name, index) in self._slots.items())
        return {key: encode(sample) for key, sample in newest if sample is not None}

    def restore(self, state: State) -> None:
        for key, payload in state.items():
            name, index = self._slots[key]
            self._newest[name][index] = decode(key, payload)


def grants_of(cluster: Cluster, environment: Environment) -> Grants:
    surfaces = [] if environment.surfaces is UNSET else environment.surfaces
    scenario_map = Map(environment.obstacles, surfaces) if cluster.law_map is True else None
    return Grants(cluster.name, cluster.drones, cluster.law_sensors or (), scenario_map)


def granted(law: Any, grants: Grants) -> Any:
    """Return a subclass of a law's class whose instances have these grants once `ControlLaw.__init__` has run."""
    attributes = {
        "_granted": grants,
        "__module__": law.__module__,
        "__qualname__": law.__qualname__,
        "__doc__": law.__doc__,
    }
    return type(law.__name__, (law,), attributes)


def _is_declared_as(received: Any, kind: Any) -> bool:
    """Return whether a message class built from its declaration in `world/info` corresponds to a user's class."""
    names = [(getattr(each, "__name__", None), getattr(each, "__struct_fields__", None)) for each in (received, kind)]
    return names[0] == names[1]


@portable
def put_cluster_rate(
    c_des: Array, c: Array, period: Array, c_dot_des: Array, integral: Array, k: float, error: Array, c_dot: Array
) -> None:
    """Write c_des - c, angles by the shorter way round, to `error`, and c_dot_des + k error + integral to `c_dot`."""
    for i in range(c.size):
        difference = c_des[i] - c[i]
        error[i] = difference - period[i] * np.rint(difference / TAU)
        c_dot[i] = c_dot_des[i] + k * error[i] + integral[i]


@portable
def accumulate(integral: Array, error: Array, rate: float, clamp: Array) -> None:
    for k in range(integral.size):
        integral[k] = min(max(integral[k] + rate * error[k], -clamp[k]), clamp[k])


class RobotLimits(NamedTuple):
    """Limits of the saturation and the guard, for compiled code.

    Attributes:
        separation_min_m: minimum distance between two robots.
        separation_alarm_m: distance below which pairs are reported.
        guard_horizon_s: prediction horizon of the guard.
        response_s: lag of a drone's velocity loop, during which the guard expects it to keep its velocity.
    """

    speed_max_m_s: float
    climb_max_m_s: float
    yaw_rate_max_rad_s: float
    separation_min_m: float
    separation_alarm_m: float
    guard_horizon_s: float
    response_s: float


def guard(p_W: Array, v_W: Array, v_cmd_W: Array, limits: RobotLimits) -> tuple[Array, Pairs, Pairs]:
    """Return velocities limited to prevent dangerous approaches, the guarded pairs, and the pairs in alarm.

    The commanded rate d' of the distance between two robots is kept at d' >= -(d_near - separation_min) /
    guard_horizon: the distance predicted over the horizon stays above the minimum, and robots that are already closer
    separate. d_near is the distance after the response time, during which an approach at the present velocities
    continues. Each robot of a pair takes half of the change; a few sweeps settle several pairs.
    """
    guarded_W, order = v_cmd_W.copy(), np.empty((len(p_W), len(p_W)), np.int64)
    guards, alarms = hold_apart(p_W, v_W, guarded_W, order, *limits)
    return guarded_W, numbered(order) if guards else (), numbered(order.T) if alarms else ()


def numbered(order: Order) -> Pairs:
    """Return the pairs that are numbered above the diagonal, in the order of their numbers."""
    numbers = order.tolist()
    entries = [(numbers[i][j], i, j) for j in range(len(numbers)) for i in range(j) if numbers[i][j]]
    return tuple((i, j) for _, i, j in sorted(entries))


@portable
def limited(
    r_dot: Array, p_W: Array, v_W: Array, v_cmd_W: Array, yaw_rate: Array, order: Order, *limit_values: float
) -> tuple[float, int, int]:
    """Write the saturated and guarded velocities (n, 3) and yaw rates (n,) for r_dot (4n,).

    Return the factor of the saturation, then the result of `hold_apart`. limit_values are the fields of a RobotLimits:
    passing a tuple to compiled code takes longer than the computation.
    """
    limits = RobotLimits(*limit_values)
    for i in range(yaw_rate.size):
        v_cmd_W[i, 0], v_cmd_W[i, 1], v_cmd_W[i, 2] = r_dot[4 * i], r_dot[4 * i + 1], r_dot[4 * i + 2]
        yaw_rate[i] = r_dot[4 * i + 3]
    factor = min(1.0, 1.0 / max(load(v_cmd_W, yaw_rate, limits), LOAD_MIN))
    scale(v_cmd_W, yaw_rate, factor)
    guards, alarms = hold_apart(p_W, v_W, v_cmd_W, order, *limit_values)
    if guards:
        scale(v_cmd_W, yaw_rate, 1.0 / max(load(v_cmd_W, yaw_rate, limits), 1.0))
    return factor, guards, alarms


@portable
def load(v_W: Array, yaw_rate: Array, limits: RobotLimits) -> float:
    """Return the maximum ratio of any robot's speed, climb or yaw rate to its limit."""
    max_ratio = 0.0
    for i in range(yaw_rate.size):
        speed = math.sqrt(v_W[i, 0] * v_W[i, 0] + v_W[i, 1] * v_W[i, 1])
        max_ratio = max(max_ratio, speed / limits.speed_max_m_s)
        max_ratio = max(max_ratio, abs(v_W[i, 2]) / limits.climb_max_m_s)
        max_ratio = max(max_ratio, abs(yaw_rate[i]) / limits.yaw_rate_max_rad_s)
    return max_ratio


@portable
def scale(v_W: Array, yaw_rate: Array, factor: float) -> None:
    for i in range(yaw_rate.size):
        for k in range(3):
            v_W[i, k] *= factor
        yaw_rate[i] *= factor


@portable
def near_pairs(p_W: Array, distance_max_m: float) -> PairTable:
    """Return the pairs (i, j), i < j, of positions (n, 3) closer than a distance, sorted by j, then i, (m, 2)."""
    n = p_W.shape[0]
    pairs, count = np.empty((n * (n - 1) // 2, 2), np.int64), 0
    for j in range(1, n):
        for i in range(j):
            x, y, z = p_W[j, 0] - p_W[i, 0], p_W[j, 1] - p_W[i, 1], p_W[j, 2] - p_W[i, 2]
            if not math.sqrt(x * x + y * y + z * z) >= distance_max_m:  # also true for NaN
                pairs[count, 0], pairs[count, 1] = i, j
                count += 1
    return pairs[:count]


@portable
def hold_apart(p_W: Array, v_W: Array, v_cmd_W: Array, order: Order, *limit_values: float) -> tuple[int, int]:
    """Modify commands in place so that every pair separates at least at its required rate (see `guard`).

    After GUARD_SWEEPS sweeps, some pairs may still fall short of it.

    Return the numbers of modified pairs and of pairs closer than the alarm threshold. In `order`, (n, n), the former
    are numbered from 1 above the diagonal and the latter below it; all other entries are zero.
    """
    limits = RobotLimits(*limit_values)
    order[:] = 0
    pairs = near_pairs(p_W, max(reach(limits), limits.separation_alarm_m))
    alarms = note_alarms(p_W, pairs, limits.separation_alarm_m, order)
    guards = 0
    for _ in range(GUARD_SWEEPS):
        is_settled = True
        for k in range(pairs.shape[0]):
            i, j = pairs[k, 0], pairs[k, 1]
            if separate(p_W, v_W, v_cmd_W, i, j, limits):
                is_settled = False
                if order[i, j] == 0:
                    guards += 1
                    order[i, j] = guards
        if is_settled:
            break
    return guards, alarms


@portable
def note_alarms(p_W: Array, pairs: PairTable, separation_alarm_m: float, order: Order) -> int:
    """Number the pairs closer than the alarm threshold below the diagonal of `order`; return their count."""
    alarms = 0
    for k in range(pairs.shape[0]):
        i, j = pairs[k, 0], pairs[k, 1]
        if norm(subtract(row(p_W, j), row(p_W, i))) < separation_alarm_m:
            alarms += 1
            order[j, i] = alarms
    return alarms


@portable
def separate(p_W: Array, v_W: Array, v_cmd_W: Array, i: int, j: int, limits: RobotLimits) -> bool:
    """Make robots i and j separate at least at the required rate, half by each; return whether commands changed."""
    line_W = subtract(row(p_W, j), row(p_W, i))
    distance = norm(line_W)
    if distance >= reach(limits):
        return False
    u_W = direction(line_W, distance)
    predicted_m = distance + min(separation_rate(u_W, v_W, i, j), 0.0) * limits.response_s
    min_rate = (limits.separation_min_m - predicted_m) / limits.guard_horizon_s
    deficit = min_rate - separation_rate(u_W, v_cmd_W, i, j)
    if deficit <= DEFICIT_MIN_M_S:
        return False
    for k in range(3):
        v_cmd_W[i, k] -= u_W[k] * deficit / 2
        v_cmd_W[j, k] += u_W[k] * deficit / 2
    return True


@portable
def reach(limits: RobotLimits) -> float:
    """Return the distance [m] beyond which two robots cannot come too close within the horizon."""
    climb, speed = limits.climb_max_m_s, limits.speed_max_m_s
    fastest = 2.0 * math.sqrt(speed * speed + climb * climb)
    return limits.separation_min_m + fastest * (limits.guard_horizon_s + limits.response_s)


@portable
def separation_rate(u_W: Vector, v_W: Array, i: int, j: int) -> float:
    """Return the rate at which robot j moves away from robot i along the line between them [m/s]."""
    return dot(u_W, subtract(row(v_W, j), row(v_W, i)))


@portable
def direction(line_W: Vector, distance: float) -> Vector:
    """Return the unit vector along a line; x_W if the robots coincide, so that they still separate."""
    if distance < NEAR_M:
        return 1.0, 0.0, 0.0
    return line_W[0] / distance, line_W[1] / distance, line_W[2] / distance
