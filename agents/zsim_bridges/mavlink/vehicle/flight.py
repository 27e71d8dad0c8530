"""The flight of one vehicle: armed or not, its mode, what it holds, and what it sends to its drone for that.

A landed drone of zsim has no state of its own for armed: armed is that it will take off on command.
"""

from collections.abc import Callable

from zsim_bridges.mavlink.vehicle.command_output import CommandOutput
from zsim_bridges.mavlink.vehicle.enums import Severity
from zsim_bridges.mavlink.vehicle.guidance import AttitudeTarget, SpeedLimits, Target, distance_m, steer
from zsim_bridges.mavlink.vehicle.mission import Mission
from zsim_bridges.mavlink.vehicle.personality import HOLDING, Mode, Personality, Settings
from zsim_bridges.mavlink.vehicle.vehicle_state import VehicleState

ANSWER_NS = 1_000_000_000  # ns within which the drone is to begin a take-off or a landing
ARRIVED_M = 0.3  # m of the height at which a climb is over
STEP_NS = 40_000_000  # ns; the loop of position is closed 25 times a second
Report = Callable[[Severity, str], None]


class Flight:
    """The flight of one vehicle; whoever asks for something is given None, or the reason why not.

    Args:
        name: of this process among the commanders of drones.
        report: called with texts for the operator.

    Attributes:
        mode: what it is to do.
        target: what it holds; None while it sends nothing.
        mission: its items, and where it is in them.
    """

    def __init__(
        self,
        name: str,
        personality: Personality,
        settings: Settings,
        state: VehicleState,
        output: CommandOutput,
        report: Report,
    ) -> None:
        self._name = name
        self._personality = personality
        self._settings = settings
        self._state = state
        self._output = output
        self._report = report
        self._is_armed = False
        self._armed_ns = 0
        self._asked: tuple[str, int] | None = None  # a mode of the firmware, and since when
        self._climb_to_m: float | None = None  # z in W, after the take-off
        self._was_airborne = False
        self._setpoint_ns = -ANSWER_NS
        self._stepped_ns = 0
        self._pending = False
        self._returns = 0  # step of a return: 1 climb, 2 go, 3 land
        self.mode = personality.first_mode
        self.target: Target | AttitudeTarget | None = None
        self.mission = Mission()

    # What clients ask

    @property
    def is_armed(self) -> bool:
        return self._state.is_airborne or self._is_armed

    @property
    def foreign_commander(self) -> str | None:
        """Who else flies the drone."""
        commander = self._state.status.commander if self._state.status else None
        return commander if commander != self._name else None

    def refusal(self) -> str | None:
        """Return why nothing can be asked of the drone now."""
        if self._state.status is None:
            return "no status of the drone yet"
        if self.foreign_commander:
            return f"flown by {self.foreign_commander}"
        return "emergency: rotors are stopped; reboot to leave it" if self._state.state == "emergency" else None

    def arm(self, force: bool) -> str | None:
        """Arm it."""
        if self.is_armed:
            return None
        failed = [] if force else self._state.failed_sensors()
        reason = self.refusal() or (f"{', '.join(failed)} failed" if failed else None)
        if reason is None:
            self._is_armed, self._armed_ns = True, self._state.t_ns
            self._state.home_m = self._state.position_m
            self._report(Severity.INFO, "Armed")
        return reason

    def disarm(self, force: bool) -> str | None:
        """Disarm it; in the air, where forced, the rotors stop at once."""
        if self._state.is_airborne:
            if not force:
                return "in flight; land first, or force"
            return self.terminate()
        if self._is_armed:
            self._stand("Disarmed")
        return None

    def terminate(self) -> None:
        """Stop the rotors at once, whoever flies it."""
        self._output.mode("emergency")
        self._stand("Emergency: rotors stopped")

    def reboot(self) -> str | None:
        """Begin again: on the ground only; leave an emergency."""
        if self._state.is_airborne:
            return "in flight"
        if self._state.state == "emergency":
            self._output.mode("reset")
        self._stand("Rebooted")
        self.mode = self._personality.first_mode
        return None

    def take_off(self, altitude_m: float) -> str | None:
        """Take off to an altitude over home."""
        reason = self.refusal() or (None if self.is_armed else "not armed")
        if reason:
            return reason
        if Mode.TAKEOFF in self._personality.modes:
            self.mode = Mode.TAKEOFF
        elif self.mode not in (Mode.OFFBOARD, Mode.MISSION):
            return "a take-off needs GUIDED"
        home_m = self._state.home_m or self._state.position_m
        self._climb(home_m[2] + altitude_m)
        return None

    def set_mode(self, mode: Mode) -> str | None:
        """Change the mode."""
        if self._state.state == "landing" and mode is not Mode.LAND:
            return "landing; it ends on the ground"
        reason = self.refusal()
        if reason and (self._state.is_airborne or self.foreign_commander):
            return reason
        return self._enter(mode)

    def go_to(self, target: Target) -> str | None:
        """Fly to a position and hold it."""
        reason = self.refusal() or (None if self._state.is_steerable else f"{self._state.state}, not flying")
        if reason is None:
            if self.mode is not Mode.OFFBOARD or self._personality.needs_stream:
                self.mode = Mode.HOLD if Mode.TAKEOFF in self._personality.modes else Mode.OFFBOARD
            self._hold(target)
        return reason

    def set_point(self, target: Target | AttitudeTarget) -> str | None:
        """Take a setpoint of a stream; it is flown in OFFBOARD (GUIDED), and at once."""
        self._setpoint_ns = self._state.t_ns
        if self.mode is not Mode.OFFBOARD:
            return None if self._personality.needs_stream else "not in GUIDED"
        reason = self.refusal()
        if reason is None and self._climb_to_m is None:
            self._hold(target)
            self._take_off_for(target)
        return reason

    def steer_by_sticks(self, target: Target) -> None:
        """Fly as a joystick asks, in the modes that are for it."""
        if self.mode in HOLDING and self._state.is_steerable and not self.refusal():
            self._setpoint_ns = self._state.t_ns
            self._hold(target)

    def pause(self) -> str | None:
        """Hold where it is."""
        return self.set_mode(Mode.HOLD)

    # What time brings

    def step(self) -> None:
        """Do what is due at a gate, after the state has been updated."""
        self._output.advance(self._state.t_ns)
        self._follow_drone()
        if self.foreign_commander:
            self._let_go()
        elif self._state.is_steerable:
            self._fly()
        elif self._asked:
            self._await_answer(*self._asked)

    def _follow_drone(self) -> None:
        """Notice what the drone does of itself."""
        state, airborne = self._state.state, self._state.is_airborne
        if state == "emergency":
            self._let_go()
            self._is_armed = False
        elif self._was_airborne and not airborne:
            self._stand("Landed; disarmed")
        elif not airborne and self._is_armed and self._asked is None:
            self._disarm_idle()
        if state == "landing" and self.mode is not Mode.LAND and self.mode is not Mode.RETURN:
            self._let_go()
            if self.mode is not Mode.MISSION:
                self.mode = Mode.LAND
        self._was_airborne = airborne

    def _disarm_idle(self) -> None:
        delay_s = self._settings["disarm_s"]
        if delay_s > 0 and self._state.t_ns - self._armed_ns > delay_s * 1e9:
            self._stand("Disarmed: no take-off")

    def _fly(self) -> None:
        """Do what the mode asks in the air."""
        if self._asked and self._asked[0] == "takeoff":
            self._asked = None
        if self._climb_to_m is not None:
            self._go_on_climbing(self._climb_to_m)
        elif self.mode is Mode.MISSION:
            self._fly_mission()
        elif self.mode is Mode.RETURN:
            self._fly_home()
        elif self.mode is Mode.LAND:
            self._ask("land")
        elif self.mode is Mode.OFFBOARD or (
            self.mode in HOLDING and isinstance(self.target, Target) and self.target.is_moving
        ):
            self._watch_stream()
        self._send_due()

    @property
    def _is_stream_silent(self) -> bool:
        return self._state.t_ns - self._setpoint_ns > self._settings["stream_s"] * 1e9

    @property
    def _is_steered(self) -> bool:
        """Whether a joystick moves it."""
        return self.mode in HOLDING and isinstance(self.target, Target) and self.target.is_moving

    def _go_on_climbing(self, z_m: float) -> None:
        if self.target is None:
            x, y, _ = self._state.position_m
            self.target = Target((x, y, z_m))
        elif abs(self._state.position_m[2] - z_m) < ARRIVED_M:
            self._climb_to_m = None
            if self.mode is Mode.TAKEOFF:
                self.mode = Mode.HOLD
            elif self.mode is Mode.MISSION:
                self.mission.on_climbed()

    def _fly_mission(self) -> None:
        step = self.mission.step(self._state, self._settings)
        if step.land:
            self._ask("land")
        elif step.climb_to_m is not None:
            self._climb(step.climb_to_m)
        elif step.returns:
            self._enter(Mode.RETURN)
        elif step.target is not None and step.target != self.target:
            self._hold(step.target)
        if step.is_over:
            self._report(Severity.INFO, "Mission finished")
            self._enter(Mode.HOLD)

    def _fly_home(self) -> None:
        x, y, z = self._state.home_m or self._state.position_m
        goal = self.target if isinstance(self.target, Target) else None
        if self._returns == 0:
            own_x, own_y, own_z = self._state.position_m
            self._hold(Target((own_x, own_y, max(own_z, z + self._settings["return_altitude_m"]))))
            self._returns = 1
        elif self._returns == 1 and goal and distance_m(goal, self._state.position_m) < self._settings["acceptance_m"]:
            self._hold(Target((x, y, goal.position_m[2])))
            self._returns = 2
        elif self._returns == 2 and goal and distance_m(goal, self._state.position_m) < self._settings["acceptance_m"]:
            self._ask("land")

    def _watch_stream(self) -> None:
        """Hold where setpoints have ceased to come: positions are held anyway by ArduPilot."""
        if not self._is_stream_silent or self.target is None:
            return
        moving = isinstance(self.target, AttitudeTarget) or self.target.is_moving
        if self.mode is Mode.OFFBOARD and self._personality.needs_stream:
            self._report(Severity.WARNING, "Offboard lost: no setpoints; holding")
            self._enter(Mode.HOLD)
        elif moving:
            self._hold(Target(self._state.position_m))

    def _send_due(self) -> None:
        if isinstance(self.target, Target) and self.target.position_m != (None, None, None):
            if self._state.t_ns - self._stepped_ns >= STEP_NS:
                self._send()
        elif self.target is not None and (self._output.is_due or self._pending):
            self._send()

    # Parts

    def _enter(self, mode: Mode) -> str | None:
        if mode is Mode.OFFBOARD and self._personality.needs_stream and self._is_stream_silent:
            return "OFFBOARD needs a stream of setpoints first"
        if mode is Mode.MISSION and not self.mission.items:
            return "no mission"
        if mode is Mode.TAKEOFF:
            return self.take_off(self._settings["takeoff_altitude_m"])
        if mode not in self._personality.modes:
            return f"no mode {mode.value}"
        self.mode, self._returns = mode, 0
        self._begin(mode)
        return None

    def _begin(self, mode: Mode) -> None:
        if not self._state.is_airborne:
            if mode is Mode.MISSION and self._is_armed:
                self._begin_mission_on_ground()
            return
        if mode is Mode.LAND:
            self._ask("land")
        elif mode in HOLDING or (mode is Mode.OFFBOARD and not self._personality.needs_stream):
            self._climb_to_m = None
            if self._state.is_steerable:
                self._hold(Target(self._state.position_m))
        elif mode is Mode.OFFBOARD:
            self._climb_to_m = None

    def _begin_mission_on_ground(self) -> None:
        home_m = self._state.home_m or self._state.position_m
        height_m = self.mission.takeoff_height_m(self._state)
        self._climb(height_m if height_m is not None else home_m[2] + self._settings["takeoff_altitude_m"])

    def start_mission(self, first: int | None = None) -> str | None:
        """Fly the mission, from an item on where one is given."""
        reason = self.refusal() or (None if self.is_armed else "not armed")
        if reason:
            return reason
        if first is not None and not self.mission.set_current(first):
            return f"no item {first}"
        return self._enter(Mode.MISSION)

    def _take_off_for(self, target: Target | AttitudeTarget) -> None:
        """Take off where a setpoint leads up from the ground."""
        if not self._is_armed or self._state.is_airborne or self._asked or isinstance(target, AttitudeTarget):
            return
        z_m = target.position_m[2]
        if target.velocity_m_s[2] > 0.0 or (z_m is not None and z_m > self._state.position_m[2] + ARRIVED_M):
            self._ask("takeoff")

    def _climb(self, z_m: float) -> None:
        self.target, self._climb_to_m = None, z_m
        if not self._state.is_airborne:
            self._ask("takeoff")

    def _ask(self, mode: str) -> None:
        """Ask the firmware for a mode, once until it has answered."""
        if self._asked is None or self._asked[0] != mode or self._state.t_ns - self._asked[1] > ANSWER_NS:
            self._asked = mode, self._state.t_ns
            if mode == "land":
                self.target = self._climb_to_m = None
            self._output.mode("takeoff" if mode == "takeoff" else "land")

    def _await_answer(self, mode: str, since_ns: int) -> None:
        standing = not self._state.is_airborne
        if mode == "takeoff" and standing and self._state.t_ns - since_ns > ANSWER_NS:
            self._let_go()
            self._report(Severity.ERROR, "Take-off refused by the drone")

    def _hold(self, target: Target | AttitudeTarget) -> None:
        """Hold a target from now on, and send it at once."""
        self.target = target
        if self._state.is_steerable and self._climb_to_m is None:
            self._pending = not self._output.has_room
            if not self._pending:
                self._send()

    def _send(self) -> None:
        self._stepped_ns, self._pending = self._state.t_ns, False
        if isinstance(self.target, Target):
            state, speeds = self._state, self._speeds()
            self._output.steer(steer(self.target, state.position_m, state.yaw_rad, speeds))
        elif self.target is not None:
            self._output.tilt(self.target)

    def _speeds(self) -> SpeedLimits:
        return self._settings.speeds

    def _let_go(self) -> None:
        """Send nothing any more."""
        self.target = self._climb_to_m = self._asked = None

    def _stand(self, text: str) -> None:
        """Be disarmed."""
        self._let_go()
        self._is_armed, self._returns = False, 0
        if self.mode in (Mode.TAKEOFF, Mode.LAND, Mode.RETURN, Mode.MISSION) or (
            self.mode is Mode.OFFBOARD and self._personality.needs_stream
        ):
            self.mode = self._personality.first_mode
        self._report(Severity.INFO, text)
