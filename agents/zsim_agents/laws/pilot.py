"""The base class of the pilots of all formation laws: one agent per drone, which uses the messages of the others.

Each pilot sends the estimated position of its drone, receives those of others, and computes a horizontal velocity. It
takes off, climbs, engages its law at the flight height, holds that height, and lands. Formations are therefore planar,
although the laws themselves are written for any number of dimensions.

A law is a subclass with one method:

    class Consensus(ShapePilot):
        def velocity(self, now: Sight) -> Array: ...  # (2,) [m/s; W]

Neighbours are the engaged drones from which a drone receives messages, as the scenario's topology and radio determine.
They are sorted by name, and all sums use that order, so that results are bit-identical for any order of arrival.

The reference of a formation is its centre, heading and scale as functions of time, and the drones' resulting positions:

    p_i*(t) = p_c(t) + s(t) R(psi(t)) c_i        v_i* = dp_i*/dt

All quantities are horizontal, in W; c_i is the position of drone i in the formation [m].
"""

import math
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from types import SimpleNamespace
from typing import Annotated, Any, NamedTuple

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from zsim.contract import keys
from zsim.contract.flight_messages import Estimate, Mode, Status, Velocity
from zsim.contract.messages import AgentMessage
from zsim.contract.snapshot import State
from zsim.errors import UserCodeError
from zsim.math import elementary as el
from zsim.runtime.agent import Agent, Output
from zsim.scenario import surroundings
from zsim.scenario.scenario import SURFACES_MAX, Scenario, Surface, Value
from zsim.schema.checker import Fault
from zsim.schema.parameters import Parameters
from zsim.schema.quantities import NonNegative
from zsim_agents.formation.expression import Expression, ExpressionError

Array = NDArray[np.float64]

ENGAGE_M = 0.3  # a drone this close to its flight height engages its law, and stays engaged
CLIMB_1_S = 1.0  # gain of the height control
CLIMB_MAX_M_S = 0.8  # below the 1 m/s that the AR.Drone's firmware allows
COMMAND_PERIOD_NS = 1_000_000_000  # time between two take-off or landing commands
UNSTAMPED = (0, 0, "")  # t_ns, seq, source of a command, filled in on sending
AIRBORNE = ("hovering", "flying")
DISTANCE_MIN_M = 1e-9  # m: closer drones have no defined direction to each other


class Motion(AgentMessage, frozen=True):
    """The message of a pilot: estimated position and velocity of its drone in W, and whether its law is engaged."""

    key = "formation/{drone}/motion"

    position_m: tuple[float, float, float]
    velocity_m_s: tuple[float, float, float]
    is_engaged: bool


class Heard(NamedTuple):
    """Another drone, as described by its last message."""

    name: str
    p_W: Array  # (2,) [m]
    v_W: Array  # (2,) [m/s]


class Pose(NamedTuple):
    """The reference at one time, with its rates."""

    p_W: Array  # (2,) centre [m; W]
    v_W: Array  # (2,) [m/s]
    turn: Array  # (2, 2) s R(psi)
    turn_rate: Array  # (2, 2) its derivative [1/s]

    def place(self, c: Array) -> tuple[Array, Array]:
        """Return the offset of a position c (2,) of the formation from the centre [m; W], and its rate [m/s]."""
        return turned(self.turn, c), turned(self.turn_rate, c)


class Sight(NamedTuple):
    """The inputs of a pilot at a gate."""

    t_s: float
    p_W: Array  # (2,) estimated position of its own drone [m]
    v_W: Array  # (2,) [m/s]
    heard: list[Heard]  # sorted by name
    reference: Pose


class PilotParameters(Parameters):
    """Common parameters of all laws; times are simulated; speeds and distances between drones are horizontal."""

    height_m: Annotated[float, Meta(gt=0, le=1000)] = 2.0
    takeoff_s: NonNegative = 2.0
    land_s: NonNegative | None = None
    """Time of landing; None: the drone flies to the end of the run."""
    speed_max_m_s: Annotated[float, Meta(gt=0, le=20)] = 1.5
    message_rate_hz: Annotated[float, Meta(gt=0, le=1000)] = 10.0
    """At most one message is sent per gate."""
    silence_s: Annotated[float, Meta(gt=0, le=60)] = 1.0
    """A drone that has been silent for longer is ignored; until then, its last message is used."""
    centre_m: tuple[Value, Value] = (0.0, 0.0)
    """Centre of the formation in W: numbers, or expressions in t, the time in seconds since `start_s`."""
    start_s: NonNegative = 0.0
    avoid_m: NonNegative = 1.5
    """Drones, obstacles and surfaces closer than this repel the drone; 0: no repulsion."""
    avoid_m4_s: NonNegative = 1.0
    """Gain of the repulsion."""


class Pilot(Agent):
    """Flies one drone by a formation law; see the module's docstring.

    Raises:
        ExpressionError: a reference is not an expression of t, or has no value at its start.
    """

    Parameters: Any = PilotParameters
    parameters: Any
    messages = (Motion,)
    reads = ("drone/{drone}/sensor/status", "drone/{drone}/estimate", Motion.of())
    invariances: tuple[str, ...] = ()
    """Which of `translation`, `rotation`, `scale` of a shape the law does not control; only for ShapePilots."""

    def __init__(self, drone: str, scenario: Scenario) -> None:
        super().__init__()
        parameters = self.parameters
        self._drone = drone
        self._gate_ns = round(scenario.time.gate_ms * 1e6)
        self._message_ns = max(self._gate_ns, round(1e9 / parameters.message_rate_hz))
        self._silence_ns = round(parameters.silence_s * 1e9)
        self._obstacles = [surroundings.row_of(each) for each in scenario.environment.obstacles]
        self._surfaces = [_sheet(each) for each in scenario.environment.surfaces or ()]
        self._reference = self.reference_of(parameters)
        self._heard: dict[str, Motion] = {}
        self._state = "landed"
        self._p_W = self._v_W = np.zeros(3)
        self._estimate_ns = -1  # time of the estimate with this position and velocity
        self._is_engaged = self._has_flown = False
        self.begin(scenario)

    def begin(self, scenario: Scenario) -> None:
        """Prepare the law's data from the scenario."""

    @staticmethod
    def reference_of(parameters: Any) -> "FormationReference":
        return FormationReference(parameters.centre_m, 0.0, 1.0, parameters.start_s)

    @abstractmethod
    def velocity(self, now: Sight) -> Array:
        """Return the velocity (2,) of the law [m/s; W], before the repulsion is added and the speed limited."""

    @classmethod
    def flaws(cls, parameters: Mapping[str, Any], scenario: Scenario) -> Iterator[Fault]:
        """Yield the path of each parameter that is invalid in a scenario, and the text of its fault."""
        try:
            cls.reference_of(cls.Parameters(**parameters))
        except ExpressionError as error:
            yield error.name, error.finding

    # The flight

    def receive(self, key: str, message: Any) -> None:
        if isinstance(message, Estimate):
            if message.t_ns < self._estimate_ns:
                return  # on links with varying delay, messages overtake each other
            self._estimate_ns = message.t_ns
            self._p_W, self._v_W = np.array(message.position_m), np.array(message.velocity_m_s)
        elif isinstance(message, Status):
            self._state = message.state
        else:
            drone, former = keys.thing(key), self._heard.get(keys.thing(key))
            if drone != self._drone and (former is None or message.t_ns >= former.t_ns):
                self._heard[drone] = message

    def step(self, t_ns: int) -> list[Output]:
        parameters, outputs = self.parameters, []
        is_airborne = self._state in AIRBORNE
        height_error = parameters.height_m - float(self._p_W[2])
        self._has_flown |= is_airborne
        self._is_engaged = is_airborne and (self._is_engaged or abs(height_error) <= ENGAGE_M)
        if t_ns // self._message_ns != (t_ns - self._gate_ns) // self._message_ns:
            p_W, v_W = triple(self._p_W), triple(self._v_W)
            outputs.append(self.message(t_ns, Motion(position_m=p_W, velocity_m_s=v_W, is_engaged=self._is_engaged)))
        must_take_off = t_ns >= parameters.takeoff_s * 1e9 and t_ns % COMMAND_PERIOD_NS < self._gate_ns
        if parameters.land_s is not None and t_ns >= parameters.land_s * 1e9:
            if is_airborne and t_ns % COMMAND_PERIOD_NS < self._gate_ns:
                outputs.append(self.command(t_ns, self._drone, Mode(*UNSTAMPED, "land")))
        elif self._state == "landed" and must_take_off and not self._has_flown:
            outputs.append(self.command(t_ns, self._drone, Mode(*UNSTAMPED, "takeoff")))
        elif is_airborne:
            v_W = self._law_velocity(t_ns) if self._is_engaged else np.zeros(2)
            climb = min(max(CLIMB_1_S * height_error, -CLIMB_MAX_M_S), CLIMB_MAX_M_S)
            command = Velocity(*UNSTAMPED, (float(v_W[0]), float(v_W[1]), climb), 0.0, "world")
            outputs.append(self.command(t_ns, self._drone, command))
        return outputs

    def _law_velocity(self, t_ns: int) -> Array:
        heard = [
            Heard(name, np.array(m.position_m[:2]), np.array(m.velocity_m_s[:2]))
            for name, m in sorted(self._heard.items())
            if m.is_engaged and t_ns - m.t_ns <= self._silence_ns
        ]
        try:
            reference = self._reference.at(t_ns / 1e9)
        except ExpressionError as error:  # a pole after the start
            raise UserCodeError(f"{type(self).__name__}: parameters.{error} (t since start_s)") from None
        now = Sight(t_ns / 1e9, self._p_W[:2], self._v_W[:2], heard, reference)
        v_W = self.velocity(now) + self.avoidance(now.p_W, heard)
        return limited(v_W, self.parameters.speed_max_m_s)

    def avoidance(self, p_W: Array, heard: Sequence[Heard]) -> Array:
        """Return the repulsion (2,) from neighbouring drones, obstacles and surfaces [m/s; W]."""
        reach, gain = self.parameters.avoid_m, self.parameters.avoid_m4_s
        v_W = np.zeros(2)
        for each in heard:
            away = p_W - each.p_W
            v_W += repulsion(length(away), reach, gain) * unit(away)
        for distance, away in self.obstacles_near(p_W, reach):
            v_W += repulsion(distance, reach, gain) * away
        return v_W

    def obstacles_near(self, p_W: Array, reach_m: float) -> list[tuple[float, Array]]:
        """Return distance [m] and direction away from each obstacle and surface within reach beside the drone, (2,).

        The distance of a surface is how far level flight goes until it meets the tangent plane at the nearest point.
        For a wall, this is the distance to the wall; for a slope, it is greater the flatter the slope is. Level ground
        below is ignored.
        """
        found = []
        for row in self._obstacles:
            distance, x, y, _ = surroundings.nearest(row, float(p_W[0]), float(p_W[1]), float(self._p_W[2]))
            if distance < reach_m and (x or y):
                found.append((distance, unit(np.array([x, y]))))
        for nearest in self._surfaces:
            distance, point = nearest((*p_W, self._p_W[2]), reach_m)
            away = p_W - point[:2]
            if distance * distance < reach_m * length(away):
                found.append((distance * distance / length(away), unit(away)))
        return found

    # The state that survives a restart

    def snapshot(self) -> State:
        heard = {name: [m.t_ns, *m.position_m, *m.velocity_m_s, m.is_engaged] for name, m in self._heard.items()}
        return {
            "heard": heard, "state": self._state, "p_W": self._p_W, "v_W": self._v_W,
            "estimate_ns": self._estimate_ns, "is_engaged": self._is_engaged, "has_flown": self._has_flown,
        }  # fmt: skip

    def restore(self, state: State) -> None:
        self._heard = {
            name: Motion(t_ns=t_ns, position_m=tuple(pv[:3]), velocity_m_s=tuple(pv[3:]), is_engaged=engaged)
            for name, (t_ns, *pv, engaged) in state["heard"].items()
        }
        self._state, self._p_W, self._v_W = state["state"], np.array(state["p_W"]), np.array(state["v_W"])
        self._estimate_ns = state["estimate_ns"]
        self._is_engaged, self._has_flown = state["is_engaged"], state["has_flown"]


@lru_cache(maxsize=SURFACES_MAX)  # shared by the pilots of a process: 40 000 triangles take a second
def _sheet(surface: Surface) -> Callable[[Sequence[float], float], tuple[float, Array]]:
    """Return a function of a point (3,) and a reach [m] that finds the surface's distance and nearest point.

    It returns the reach and the given point if the surface is not closer than the reach.
    """
    from zsim.scenario.surroundings import (  # imported here, so that numba is not loaded without a surface
        hold,
        nearest_points,
        sheet_of,
    )

    sheet = hold(sheet_of(SimpleNamespace(surfaces=[surface])))

    def nearest(point_m: Sequence[float], reach_m: float) -> tuple[float, Array]:
        distances, points = nearest_points(sheet, point_m, reach_m)
        return float(distances[0]), points[0]

    return nearest


class FormationReference:
    """The motion of a formation from `start_s` on; before that, it rests at its start.

    Args:
        centre_m: x and y in W: numbers, or expressions in t, the time in seconds since start_s.
        heading_deg, scale: likewise, numbers or expressions.

    Raises:
        ExpressionError: a text is not an expression of t, or has no value at its start.
    """

    def __init__(
        self, centre_m: Sequence[float | str], heading_deg: float | str, scale: float | str, start_s: float = 0.0
    ) -> None:
        given: Mapping[str, float | str] = {
            "centre_m[0]": centre_m[0], "centre_m[1]": centre_m[1], "heading_deg": heading_deg, "scale": scale,
        }  # fmt: skip
        self._functions = [Expression(name, text if isinstance(text, str) else repr(float(text)))
                           for name, text in given.items()]  # fmt: skip
        self._start_s = start_s
        self.at(start_s)

    def at(self, t_s: float) -> Pose:
        """Return the reference at a simulated time; ExpressionError: it has no value there."""
        elapsed_s = t_s - self._start_s
        (x, vx), (y, vy), (psi_deg, turn_deg_s), (s, s_dot) = (each(max(elapsed_s, 0.0)) for each in self._functions)
        if elapsed_s < 0.0:
            vx = vy = turn_deg_s = s_dot = 0.0
        psi, w = math.radians(psi_deg), math.radians(turn_deg_s)
        c, sn = el.cos(psi), el.sin(psi)
        turn = np.array([[s * c, -s * sn], [s * sn, s * c]])
        turn_rate = np.array([[s_dot * c - s * w * sn, -s_dot * sn - s * w * c],
                              [s_dot * sn + s * w * c, s_dot * c - s * w * sn]])  # fmt: skip
        return Pose(np.array([x, y]), np.array([vx, vy]), turn, turn_rate)


def polygon(count: int, radius_m: float) -> Array:
    """Return the corners (count, 2) of a regular polygon about the origin, the first on the x axis [m]."""
    angles = [2 * math.pi * i / count for i in range(count)]
    return radius_m * np.array([[el.cos(angle), el.sin(angle)] for angle in angles])


# Vector functions, with the same order of operations on every processor


def turned(matrix: Array, c: Array) -> Array:
    """Return a matrix (2, 2) times c (2,)."""
    return np.array([matrix[0, 0] * c[0] + matrix[0, 1] * c[1], matrix[1, 0] * c[0] + matrix[1, 1] * c[1]])


def repulsion(d: float, D: float, eta: float) -> float:
    """Return -dV/dd of Khatib's V = eta/2 (1/d - 1/D)^2 for d < D, else 0 (Int. J. Robotics Research 5(1), 1986)."""
    if d >= D or D <= 0.0:  # d may be negative, inside an obstacle
        return 0.0
    d = max(d, 0.05)  # m: at distances within the error of estimates, the speed limit applies anyway
    return eta * (1.0 / d - 1.0 / D) / (d * d)


def length(v: Array) -> float:
    return math.sqrt(total(v * v))


def unit(v: Array) -> Array:
    """Return v / |v|; the unit vector along x for a vector without direction."""
    size = length(v)
    return v / size if size > DISTANCE_MIN_M else np.eye(len(v))[0]


def triple(v: Array) -> tuple[float, float, float]:
    x, y, z = v.tolist()
    return x, y, z


def total(numbers: Array) -> float:
    """Return the sum of numbers, added from the first to the last."""
    result = 0.0
    for number in numbers.tolist():  # Python's sum() differs between versions
        result += number
    return result


def added(terms: Sequence[Array], size: int = 2) -> Array:
    """Return the sum of vectors, added from the first to the last."""
    return sum(terms, np.zeros(size))


def limited(v: Array, most: float) -> Array:
    """Return v, scaled to length `most` if it is longer."""
    size = length(v)
    return v * (most / size) if size > most else v
