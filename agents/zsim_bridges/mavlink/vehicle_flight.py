"""The flight of one vehicle: its arming state, mode and targets, and the commands that make the drone follow them.

A landed drone of zsim has no armed state; here, armed means that it takes off on command. Positions are approached as
references are, by `zsim_agents.references.cruise`.
"""

import math
from collections.abc import Callable
from typing import Literal

from zsim.math.rotation import Vector
from zsim_agents.references.cruise import Course, Cruise
from zsim_bridges.mavlink.dialect import Severity
from zsim_bridges.mavlink.mission import Mission
from zsim_bridges.mavlink.personality import HOLD_MODES, FlightMode, Parameters, Personality
from zsim_bridges.mavlink.vehicle_state import NO_POSITION, Target, TiltTarget, VehicleState
from zsim_bridges.vehicle_links.drone_link import REPEAT_NS, CommandSender, ModeName

GROUND_ENDING_MODES = (FlightMode.TAKEOFF, FlightMode.LAND, FlightMode.RETURN, FlightMode.MISSION)
Report = Callable[[Severity, str], None]
RESPONSE_TIMEOUT_NS = 1_000_000_000  # ns within which the drone should begin a requested take-off or landing
CLIMB_TOLERANCE_M = 0.3  # m; a climb ends this close to its target height
STEP_NS = 40_000_000  # ns; the guidance law is evaluated 25 times a second
BURST_MAX = 500  # commands in one burst: half as many as the world records from a source outside the lockstep


class Flight:
    """The flight of one vehicle; requests return None, or the reason for their refusal.

    Args:
        name: name of this process, as it appears in a drone's `commander`.
    """

    def __init__(
        self,
        name: str,
        personality: Personality,
        parameters: Parameters,
        state: VehicleState,
        sender: CommandSender,
        course: Course,
        report: Report,
    ) -> None:
        self._name = name
        self._personality = personality
        self._parameters = parameters
        self._state = state
        self._report = report
        self._control = FlightControl(parameters, state, sender, course)
        self._is_armed = self._was_airborne = False
        self._armed_ns = 0
        self._setpoint_ns: int | None = None  # simulated time of the newest setpoint from a client
        self._return_stage = 0
        self._is_mission_return = False  # whether the return under way is an item of the mission
        self.mode = personality.first_mode
        self.mission = Mission(first=0 if personality.is_px4 else 1, turns=personality.is_px4)

    # Requests of clients

    @property
    def target(self) -> Target | TiltTarget | None:
        """The target being held; None while nothing is sent."""
        return self._control.target

    @property
    def is_armed(self) -> bool:
        return self._state.is_airborne or self._is_armed

    @property
    def foreign_commander(self) -> str | None:
        commander = self._state.status.commander if self._state.status else None
        return commander if commander != self._name else None

    def refusal(self) -> str | None:
        if self._state.status is None:
            return "no status from the drone yet"
        if self.foreign_commander:
            return f"flown by {self.foreign_commander}"
        return "emergency: rotors are stopped; reboot" if self._state.state == "emergency" else None

    def arm(self, force: bool) -> str | None:
        if self.is_armed:
            return None
        failed = [] if force else self._state.failed_sensors()
        reason = self.refusal() or (f"{', '.join(failed)} failed" if failed else None)
        if reason is None:
            self._is_armed, self._armed_ns = True, self._state.t_ns
            self._state.home_m = self._state.position_m
            self._report(Severity.INFO, "Armed")
            if self.mode is FlightMode.MISSION and self._personality.is_px4 and self.mission.items:
                self._begin_mission_on_ground()
        return reason

    def disarm(self, force: bool) -> str | None:
        """Disarm the vehicle; if forced, even in the air, where the rotors stop at once."""
        if not self._state.is_airborne:
            if self._is_armed:
                self._end_flight("Disarmed")
            return None
        if force:
            self.terminate()
        return None if force else "in flight; land first, or force disarming"

    def terminate(self) -> None:
        """Stop the rotors at once, regardless of the commander."""
        self.mission.abort("a client stopped the rotors", failsafe=False)
        self._control.send_mode("emergency")
        self._end_flight("Emergency: rotors stopped")

    def reboot(self) -> str | None:
        """Restart, which is possible only on the ground; this ends an emergency."""
        if self._state.is_airborne:
            return "in flight"
        if self._state.state == "emergency":
            self._control.send_mode("reset")
        self._end_flight("Rebooted")
        self.mode = self._personality.first_mode
        return None

    def take_off(self, altitude_m: float) -> str | None:
        """Take off to an altitude above home."""
        has_mode = FlightMode.TAKEOFF in self._personality.modes
        reason = self.refusal() or self._takeoff_refusal()
        if reason is None and not has_mode and self.mode is not FlightMode.OFFBOARD:
            reason = "a take-off needs GUIDED"
        if reason:
            return reason
        if has_mode:
            self.mode = FlightMode.TAKEOFF
        self._is_armed = True
        self._control.climb(self._state.home_or_current_m[2] + altitude_m)
        return None

    def set_mode(self, mode: FlightMode) -> str | None:
        reason = self.refusal()
        if reason and (self._state.is_airborne or self.foreign_commander):
            return reason
        if self._state.state == "landing" and mode is not FlightMode.LAND:
            return "landing; no mode change before touchdown"
        return self._enter(mode)

    def go_to(self, target: Target) -> str | None:
        reason = self.refusal() or (None if self._state.is_steerable else f"{self._state.state}, not flying")
        if reason is None:
            self.mode = FlightMode.HOLD if FlightMode.TAKEOFF in self._personality.modes else FlightMode.OFFBOARD
            self._is_armed = True
            self._control.climb_to_m = None
            self._control.hold(target)
        return reason

    def set_point(self, target: Target | TiltTarget) -> str | None:
        """Accept a setpoint from a stream; in OFFBOARD (GUIDED) it is followed at once, unless a climb is under way."""
        self._setpoint_ns = self._state.t_ns
        if self.mode is not FlightMode.OFFBOARD:
            return None if self._personality.is_px4 else "not in GUIDED"
        reason = self.refusal()
        if reason is None and self._control.climb_to_m is None:
            self._control.hold(target)
            if isinstance(target, Target) and self._is_armed and not self._state.is_airborne:
                z = target.position_m[2]  # only a target above the drone, or an upward velocity, starts a take-off
                if target.velocity_m_s[2] > 0.0 or (
                    z is not None and z > self._state.position_m[2] + CLIMB_TOLERANCE_M
                ):
                    self._control.request("takeoff")
        return reason

    def steer_by_sticks(self, target: Target) -> None:
        """Follow a joystick, in the modes that otherwise hold the position."""
        if self.mode in HOLD_MODES and self._state.is_steerable and self._is_armed and not self.refusal():
            self._setpoint_ns = self._state.t_ns
            self._control.hold(target)

    def start_mission(self, first: int | None = None) -> str | None:
        """Fly the mission from a given item on, or from the current one."""
        reason = self.refusal() or self._takeoff_refusal()
        if reason is None and first is not None and not self.mission.set_current(first):
            reason = f"no item {first}"
        return reason or self.set_mode(FlightMode.MISSION)

    # Gates

    def step(self) -> None:
        self._control.advance()
        self.mission.note_progress()
        if self.mode is not FlightMode.MISSION and not (self.mode is FlightMode.RETURN and self._is_mission_return):
            self.mission.abort(f"a client chose {self.mode.name}", failsafe=False)
        self._follow_drone()
        if self.foreign_commander:
            self._control.release()
        elif self._state.is_steerable and self._is_armed:
            if self._control.pending_mode and self._control.pending_mode[0] == "takeoff":
                self._control.pending_mode = None
            self._fly()
            self._control.send_due()
        elif self._control.is_takeoff_overdue():
            self._control.release()
            self._report(Severity.ERROR, "Take-off refused by the drone")
            self.mission.abort("the drone refused the take-off", failsafe=True)

    def _follow_drone(self) -> None:
        state, is_airborne = self._state.state, self._state.is_airborne
        if state == "emergency":
            self.mission.abort("its rotors were stopped", failsafe=True)
            self._control.release()
            self._is_armed = False
        elif self._was_airborne and not is_airborne:
            if self.mission.is_landing:
                self.mission.finish()
            else:
                self.mission.abort("it landed by itself", failsafe=True)
            self._end_flight("Landed; disarmed")
        elif self._is_armed and not is_airborne and self._control.pending_mode is None:
            delay_s = self._parameters["disarm_s"]
            if delay_s > 0 and self._state.t_ns - self._armed_ns > delay_s * 1e9:
                self.mission.abort("no take-off", failsafe=True)
                self._end_flight("Disarmed: no take-off")
        if state == "landing" and self.mode not in GROUND_ENDING_MODES:
            self._control.release()
            self.mode = FlightMode.LAND
        self._was_airborne = is_airborne

    def _fly(self) -> None:
        if self._control.climb_to_m is not None:
            if self._control.continue_climb():
                if self.mode is FlightMode.TAKEOFF:
                    self.mode = FlightMode.HOLD
                elif self.mode is FlightMode.MISSION:
                    self.mission.has_climbed = True
        elif self.mode is FlightMode.MISSION:
            self._fly_mission()
        elif self.mode is FlightMode.RETURN:
            self._fly_home()
        elif self.mode is FlightMode.LAND:
            self._control.request("land")
        elif self._is_stream_silent() and self.target is not None:  # ArduPilot holds a position without a stream
            if self.mode is FlightMode.OFFBOARD and self._personality.is_px4:
                self._report(Severity.WARNING, "Offboard lost: no setpoints; holding")
                self._enter(FlightMode.HOLD)
            elif self._control.is_moving:
                self._control.hold_position()

    def _fly_mission(self) -> None:
        step = self.mission.step(self._state, self._parameters)
        match step.action:
            case "land":
                self._control.request("land")
            case "climb":
                self._control.climb(step.z_m)
            case "return":
                self._enter(FlightMode.RETURN)
                self._is_mission_return = True
            case "fly" if step.target != self.target:
                self._control.hold(step.target)
            case "over":
                self._report(Severity.INFO, "Mission finished")
                self.mission.finish()
                self._enter(FlightMode.HOLD)

    def _fly_home(self) -> None:
        """Climb to the return height, fly home, and land."""
        home_x, home_y, home_z = self._state.home_or_current_m
        x, y, z = self._state.position_m
        target = self.target
        if self._return_stage == 0:
            self._return_stage = 1
            self._control.hold(Target((x, y, max(z, home_z + self._parameters["return_altitude_m"]))))
        elif self._return_stage == 1 and isinstance(target, Target) and self._control.has_arrived():
            self._return_stage = 2
            self._control.hold(Target((home_x, home_y, target.position_m[2])))
        elif self._return_stage == 2 and (target is None or self._control.has_arrived()):
            self._control.request("land")

    def _is_stream_silent(self) -> bool:
        silence_ns = self._parameters["stream_s"] * 1e9
        return self._setpoint_ns is None or self._state.t_ns - self._setpoint_ns > silence_ns

    def _takeoff_refusal(self) -> str | None:
        return "landing" if self._state.state == "landing" else None if self.is_armed else "not armed"

    def _enter(self, mode: FlightMode) -> str | None:
        needs_stream = mode is FlightMode.OFFBOARD and self._personality.is_px4
        if needs_stream and self._is_stream_silent():
            return "OFFBOARD needs a stream of setpoints first"
        if mode is FlightMode.MISSION and not self.mission.items:
            return "no mission"
        if mode is FlightMode.TAKEOFF:
            return self.take_off(self._parameters["takeoff_altitude_m"])
        self.mode, self._is_mission_return, self._return_stage = mode, False, 0
        if self._state.is_airborne:
            self._is_armed = True
            if mode is FlightMode.MISSION:
                self.mission.start()
            if mode is FlightMode.LAND:
                self._control.request("land")
            elif mode in HOLD_MODES or (mode is FlightMode.OFFBOARD and not needs_stream):
                self._control.hold_position()
            else:
                self._control.climb_to_m = None
        elif mode is FlightMode.MISSION and self._is_armed:
            self._begin_mission_on_ground()
        return None

    def _begin_mission_on_ground(self) -> None:
        self.mission.start()
        z_m = self.mission.takeoff_height_m(self._state)
        takeoff_m = self._state.home_or_current_m[2] + self._parameters["takeoff_altitude_m"]
        self._control.climb(takeoff_m if z_m is None else z_m)

    def _end_flight(self, text: str) -> None:
        self._control.release()
        self._is_armed = False
        if self.mode in GROUND_ENDING_MODES or (self.mode is FlightMode.OFFBOARD and self._personality.is_px4):
            self.mode = self._personality.first_mode
        self._report(Severity.INFO, text)


class FlightControl:
    """Sends a drone the commands that make it hold a target.

    The world accepts one more command from a source at each gate, so each gate adds one to the allowance here; a new
    target is sent at once as long as the allowance permits.

    Attributes:
        target: target being held; None while nothing is sent.
        climb_to_m: z in W at which the climb under way ends; None without a climb.
        pending_mode: mode that the firmware has yet to enter, and when it was requested.
    """

    def __init__(self, parameters: Parameters, state: VehicleState, sender: CommandSender, course: Course) -> None:
        self._parameters = parameters
        self._state = state
        self._sender = sender
        self._course = course
        self._course_request: tuple[Target, Cruise] | None = None  # target and speeds that the course follows
        self.target: Target | TiltTarget | None = None
        self.climb_to_m: float | None = None
        self.pending_mode: tuple[Literal["takeoff", "land"], int] | None = None
        self._is_pending = False  # whether a new target could not be sent at once
        self._allowance = BURST_MAX
        self._sent_ns = 0

    def advance(self) -> None:
        self._allowance = min(BURST_MAX, self._allowance + 1)

    @property
    def is_moving(self) -> bool:
        """Whether the target keeps the vehicle in motion, as a velocity, a turn or a tilt does."""
        target = self.target
        if not isinstance(target, Target):
            return target is not None
        return any(target.velocity_m_s) or (target.yaw_rad is None and target.yaw_rate_rad_s != 0.0)

    def hold(self, target: Target | TiltTarget) -> None:
        """Hold a target from now on, and send it at once if the firmware, the climb and the allowance permit this."""
        self.target = target
        if self._state.is_steerable and self.climb_to_m is None:
            self._is_pending = self._allowance <= BURST_MAX // 10  # the last tenth is for repetitions
            if not self._is_pending:
                self._send()

    def hold_position(self) -> None:
        """Come to rest, cancelling a climb under way."""
        self.climb_to_m = None
        if self._state.is_steerable:
            self.hold(Target(self._course.stop(*self._motion())))

    def climb(self, z_m: float) -> None:
        """Climb or take off vertically to z in W."""
        self.target, self.climb_to_m = None, z_m
        if not self._state.is_airborne:
            self.request("takeoff")

    def continue_climb(self) -> bool:
        """Continue a climb; return whether it has just ended."""
        z_m = self.climb_to_m
        if z_m is None:
            return False
        if self.target is None:
            x, y, _ = self._state.position_m
            self.target = Target((x, y, z_m))
        if abs(self._state.position_m[2] - z_m) >= CLIMB_TOLERANCE_M:
            return False
        self.climb_to_m = None
        return True

    def request(self, mode: Literal["takeoff", "land"]) -> None:
        """Request a mode from the firmware; the request is repeated only if the firmware does not respond."""
        if (
            self.pending_mode is None
            or self.pending_mode[0] != mode
            or self._state.t_ns - self.pending_mode[1] > RESPONSE_TIMEOUT_NS
        ):
            self.pending_mode = mode, self._state.t_ns
            if mode == "land":
                self._clear_target()
            self.send_mode(mode)

    def send_mode(self, mode: ModeName) -> None:
        self._allowance -= 1
        self._sender.send_mode(self._state.t_ns, mode)

    def is_takeoff_overdue(self) -> bool:
        """Return whether the drone is still on the ground RESPONSE_TIMEOUT_NS after a take-off was requested."""
        if self.pending_mode is None or self.pending_mode[0] != "takeoff" or self._state.is_airborne:
            return False
        return self._state.t_ns - self.pending_mode[1] > RESPONSE_TIMEOUT_NS

    def release(self) -> None:
        self.pending_mode = None
        self._clear_target()

    def _clear_target(self) -> None:
        self.target = self.climb_to_m = self._course_request = None
        self._course.leave()

    def has_arrived(self) -> bool:
        position_m, radius_m = self._state.position_m, self._parameters["acceptance_m"]
        return isinstance(self.target, Target) and self.target.distance_m(position_m) < radius_m

    def send_due(self) -> None:
        age_ns = self._state.t_ns - self._sent_ns
        if isinstance(self.target, Target) and self.target.position_m != NO_POSITION:
            is_due = age_ns >= STEP_NS
        else:
            is_due = self.target is not None and (age_ns >= REPEAT_NS or self._is_pending)
        if is_due:
            self._send()

    def _send(self) -> None:
        target, t_ns = self.target, self._state.t_ns
        self._sent_ns, self._is_pending = t_ns, False
        self._allowance -= 1
        if isinstance(target, Target):
            frame = "heading" if target.along_heading else "world"
            self._sender.send_velocity(t_ns, *self._velocity(target), frame)
        elif target is not None:
            self._course_request = None
            self._course.leave()
            self._sender.send_attitude(t_ns, target.q_WB, target.thrust_n, target.yaw_rate_rad_s)

    def _velocity(self, target: Target) -> tuple[Vector, float]:
        """Return the velocity [m/s], in the axes of the target, and the yaw rate [rad/s] that lead to the target."""
        speeds, (t_s, position, rates) = self._parameters.speeds, self._motion()
        horizontal_m_s = min(target.speed_m_s or math.inf, speeds.horizontal_m_s)
        course_request = target, speeds._replace(horizontal_m_s=horizontal_m_s)
        if course_request != self._course_request:
            goal, rate = (*target.position_m, target.yaw_rad), (*target.velocity_m_s, target.yaw_rate_rad_s)
            self._course.send(goal, t_s, position, rates, rate, course_request[1])
            self._course_request = course_request
        return self._course.velocity(t_s, position, rates)

    def _motion(self) -> tuple[float, tuple[float, ...], tuple[float, ...]]:
        """Return simulated time [s], position and heading, and their rates; the yaw rate is taken as 0."""
        state = self._state
        return state.t_ns * 1e-9, (*state.position_m, state.yaw_rad), (*state.velocity_m_s, 0.0)
