"""Converts the targets of a vehicle to commands of its drone: targets, courses to places, climbs, firmware modes.

Places are approached like references of drones: `zsim_agents.references.cruise`.
"""

import math
from typing import Literal, NamedTuple

from zsim.math import elementary as el
from zsim.math.rotation import Quaternion, Vector
from zsim_agents.references.cruise import Course, Cruise
from zsim_bridges.mavlink.personality import Parameters
from zsim_bridges.mavlink.vehicle_state import VehicleState
from zsim_bridges.vehicle_links.drone_link import CommandSender, ModeName

PLACE_MAX_M = 1e6  # m; positions farther away are refused
ANSWER_NS = 1_000_000_000  # ns within which the drone should begin a take-off or a landing
ARRIVED_M = 0.3  # m of the height at which a climb is over
STEP_NS = 40_000_000  # ns; the law is evaluated 25 times a second
BURST = 500  # commands at once: half of what the world records of a source that is not in the lockstep
REPEAT_NS = 100_000_000  # ns; the firmware treats a commander that is silent for 0.5 s as dead

Axes = tuple[float | None, float | None, float | None]
NOWHERE: Axes = (None, None, None)


class Target(NamedTuple):
    """A position or velocity to be held.

    Attributes:
        position_m: in W, None in axes where only the velocity counts.
        velocity_m_s: flown, added to the velocity towards the position.
        yaw_rad: counter-clockwise from east; None to turn at the rate.
        yaw_rate_rad_s: counter-clockwise.
        along_heading: the velocity is forward, left, up instead of in W.
        speed_m_s: limit of the horizontal speed; None for the vehicle's.
    """

    position_m: Axes = NOWHERE
    velocity_m_s: Vector = (0.0, 0.0, 0.0)
    yaw_rad: float | None = None
    yaw_rate_rad_s: float = 0.0
    along_heading: bool = False
    speed_m_s: float | None = None

    def distance_m(self, position_m: Vector) -> float:
        pairs = zip(self.position_m, position_m, strict=True)
        return el.length((0.0 if p is None else p - own for p, own in pairs))


class TiltTarget(NamedTuple):
    """A tilt to be held: attitude B to W, thrust [N], yaw rate [rad/s] counter-clockwise."""

    q_WB: Quaternion
    thrust_n: float
    yaw_rate_rad_s: float


def is_place(position_m: Axes) -> bool:
    return all(p is None or (math.isfinite(p) and abs(p) < PLACE_MAX_M) for p in position_m)


class FlightControl:
    """Sends a drone the commands that make it hold a target.

    The world accepts one more command of a source at each gate, so each gate allows one here; a new target is sent at
    once while the burst lasts.

    Attributes:
        target: held at present; None while nothing is sent.
        climb_to_m: z in W of the climb under way.
        asked: the mode that the firmware has yet to enter, and since when it is requested.
    """

    def __init__(self, parameters: Parameters, state: VehicleState, sender: CommandSender, course: Course) -> None:
        self._parameters = parameters
        self._state = state
        self._sender = sender
        self._course = course
        self._asked: tuple[Target, Cruise] | None = None  # of the course
        self.target: Target | TiltTarget | None = None
        self.climb_to_m: float | None = None
        self.asked: tuple[Literal["takeoff", "land"], int] | None = None
        self._is_pending = False  # a target that could not be sent at once
        self._allowed = BURST
        self._sent_ns = -REPEAT_NS
        self._stepped_ns = self._now_ns = 0

    def advance(self, t_ns: int) -> None:
        self._now_ns = t_ns
        self._allowed = min(BURST, self._allowed + 1)

    @property
    def is_moving(self) -> bool:
        """Whether the target never brings the vehicle to rest; one that holds a tilt flies away."""
        target = self.target
        if not isinstance(target, Target):
            return target is not None
        return any(target.velocity_m_s) or (target.yaw_rad is None and target.yaw_rate_rad_s != 0.0)

    def hold(self, target: Target | TiltTarget) -> None:
        """Hold a target from now on, and send it at once; a climb under way is finished first."""
        self.target = target
        if self._state.is_steerable and self.climb_to_m is None:
            self._is_pending = self._allowed <= BURST // 10  # the rest is for repetitions
            if not self._is_pending:
                self._send()

    def hold_here(self) -> None:
        """Come to rest, cancelling anything in progress."""
        self.climb_to_m = None
        if self._state.is_steerable:
            self.hold(Target(self._course.stop(*self._motion())))

    def climb(self, z_m: float) -> None:
        """Climb, or take off, vertically to z in W."""
        self.target, self.climb_to_m = None, z_m
        if not self._state.is_airborne:
            self.ask("takeoff")

    def continue_climb(self) -> bool:
        """Continue a climb; return whether it has just ended."""
        z_m = self.climb_to_m
        if z_m is None:
            return False
        if self.target is None:
            x, y, _ = self._state.position_m
            self.target = Target((x, y, z_m))
        if abs(self._state.position_m[2] - z_m) >= ARRIVED_M:
            return False
        self.climb_to_m = None
        return True

    def ask(self, mode: Literal["takeoff", "land"]) -> None:
        """Request a mode from the firmware; repeat only without an answer."""
        if self.asked is None or self.asked[0] != mode or self._state.t_ns - self.asked[1] > ANSWER_NS:
            self.asked = mode, self._state.t_ns
            if mode == "land":
                self._let_go()
            self.send_mode(mode)

    def send_mode(self, mode: ModeName) -> None:
        self._allowed -= 1
        self._sender.mode(self._now_ns, mode)

    def is_takeoff_overdue(self) -> bool:
        """Return whether the drone is still on the ground although a take-off was requested."""
        if self.asked is None or self.asked[0] != "takeoff" or self._state.is_airborne:
            return False
        return self._state.t_ns - self.asked[1] > ANSWER_NS

    def release(self) -> None:
        self.asked = None
        self._let_go()

    def _let_go(self) -> None:
        self.target = self.climb_to_m = self._asked = None
        self._course.leave()

    def has_arrived(self) -> bool:
        position_m, radius_m = self._state.position_m, self._parameters["acceptance_m"]
        return isinstance(self.target, Target) and self.target.distance_m(position_m) < radius_m

    def send_due(self) -> None:
        if isinstance(self.target, Target) and self.target.position_m != NOWHERE:
            if self._state.t_ns - self._stepped_ns >= STEP_NS:
                self._send()
        elif self.target is not None and (self._now_ns - self._sent_ns >= REPEAT_NS or self._is_pending):
            self._send()

    def _send(self) -> None:
        target, state = self.target, self._state
        self._stepped_ns, self._is_pending = state.t_ns, False
        self._sent_ns = self._now_ns
        self._allowed -= 1
        if isinstance(target, Target):
            frame = "heading" if target.along_heading else "world"
            self._sender.velocity(self._now_ns, *self._velocity(target), frame)
        elif target is not None:
            self._asked = None
            self._course.leave()
            self._sender.attitude(self._now_ns, target.q_WB, target.thrust_n, target.yaw_rate_rad_s)

    def _velocity(self, target: Target) -> tuple[Vector, float]:
        """Return the velocity [m/s], in the axes of the target, and the yaw rate [rad/s] that lead to it."""
        speeds, (t_s, here, moving) = self._parameters.speeds, self._motion()
        level = min(target.speed_m_s or math.inf, speeds.horizontal_m_s)
        asked = target, Cruise(level, speeds.up_m_s, speeds.down_m_s)
        if asked != self._asked:
            goal, rate = (*target.position_m, target.yaw_rad), (*target.velocity_m_s, target.yaw_rate_rad_s)
            self._course.send(goal, t_s, here, moving, rate, asked[1])
            self._asked = asked
        return self._course.velocity(t_s, here, moving)

    def _motion(self) -> tuple[float, tuple[float, ...], tuple[float, ...]]:
        """Return simulated time [s], place and heading, and their rates."""
        state = self._state
        return state.t_ns * 1e-9, (*state.position_m, state.yaw_rad), (*state.velocity_m_s, 0.0)
