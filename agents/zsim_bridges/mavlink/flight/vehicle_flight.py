"""The flight of one vehicle: armed or not, its mode, and what that asks for.

A landed drone of zsim has no state of its own for armed: armed is that it will take off on command.
"""

from collections.abc import Callable

from zsim_bridges.mavlink.autopilot.enums import Severity
from zsim_bridges.mavlink.autopilot.personality import HOLDING, FlightMode, Personality, Settings
from zsim_bridges.mavlink.autopilot.vehicle_state import VehicleState
from zsim_bridges.mavlink.flight.command_output import CommandOutput
from zsim_bridges.mavlink.flight.flight_control import ARRIVED_M, FlightControl
from zsim_bridges.mavlink.flight.mission import Mission
from zsim_bridges.mavlink.flight.position_guidance import Target, TiltTarget
from zsim_bridges.mavlink.flight.return_course import ReturnCourse
from zsim_bridges.mavlink.flight.setpoint_stream import SetpointStream

OVER_ON_GROUND = (FlightMode.TAKEOFF, FlightMode.LAND, FlightMode.RETURN, FlightMode.MISSION)
Report = Callable[[Severity, str], None]


class Flight:
    """The flight of one vehicle; whoever asks for something is given None, or the reason why not.

    Args:
        name: of this process among the commanders of drones.
        report: called with texts for the operator.

    Attributes:
        mode: what it is to do.
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
        self._control = FlightControl(settings, state, output)
        self._is_armed = False
        self._armed_ns = 0
        self._was_airborne = False
        self._stream = SetpointStream(settings, state)
        self._return = ReturnCourse(settings, state, self._control)
        self.mode = personality.first_mode
        self._mission_returns = False  # that its return is an item of the mission
        self.mission = Mission(first=0 if personality.needs_stream else 1, turns=personality.needs_stream)

    # What clients ask

    @property
    def target(self) -> Target | TiltTarget | None:
        """What is held; None while nothing is sent."""
        return self._control.target

    @property
    def is_armed(self) -> bool:
        return self._state.is_airborne or self._is_armed

    @property
    def foreign_commander(self) -> str | None:
        """Who else flies the drone."""
        return self._state.commander if self._state.commander != self._name else None

    def refusal(self) -> str | None:
        """Return why nothing can be asked of the drone now."""
        if self._state.status is None:
            return "no status of the drone yet"
        if self.foreign_commander:
            return f"flown by {self.foreign_commander}"
        return "emergency: rotors are stopped; reboot" if self._state.state == "emergency" else None

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
            if self.mode is FlightMode.MISSION and self._personality.needs_stream and self.mission.items:
                self._begin_mission_on_ground()
        return reason

    def disarm(self, force: bool) -> str | None:
        """Disarm it; in the air, where forced, the rotors stop at once."""
        if not self._state.is_airborne:
            if self._is_armed:
                self._stand("Disarmed")
            return None
        if force:
            self.terminate()
        return None if force else "in flight; land first, or force"

    def terminate(self) -> None:
        """Stop the rotors at once, whoever flies it."""
        self.mission.abort("a client stopped its rotors", failsafe=False)
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
        has_mode = FlightMode.TAKEOFF in self._personality.modes
        reason = self.refusal() or self._not_ready()
        if reason is None and not has_mode and self.mode is not FlightMode.OFFBOARD:
            reason = "a take-off needs GUIDED"
        if reason:
            return reason
        if has_mode:
            self.mode = FlightMode.TAKEOFF
        self._is_armed = True
        self._control.climb(self._state.home_z_m + altitude_m)
        return None

    def set_mode(self, mode: FlightMode) -> str | None:
        """Change the mode."""
        reason = self.refusal()
        if reason and (self._state.is_airborne or self.foreign_commander):
            return reason
        if self._state.state == "landing" and mode is not FlightMode.LAND:
            return "landing; it ends on the ground"
        return self._enter(mode)

    def go_to(self, target: Target) -> str | None:
        """Fly to a position and hold it."""
        reason = self.refusal() or (None if self._state.is_steerable else f"{self._state.state}, not flying")
        if reason is None:
            self.mode = FlightMode.HOLD if FlightMode.TAKEOFF in self._personality.modes else FlightMode.OFFBOARD
            self._is_armed = True
            self._control.stop_climb()
            self._control.hold(target)
        return reason

    def set_point(self, target: Target | TiltTarget) -> str | None:
        """Take a setpoint of a stream; it is flown in OFFBOARD (GUIDED), and at once."""
        self._stream.note()
        if self.mode is not FlightMode.OFFBOARD:
            return None if self._personality.needs_stream else "not in GUIDED"
        reason = self.refusal()
        if reason is None and not self._control.is_climbing:
            self._control.hold(target)
            self._take_off_for(target)
        return reason

    def steer_by_sticks(self, target: Target) -> None:
        """Fly as a joystick asks, in the modes that hold otherwise."""
        if self.mode in HOLDING and self._state.is_steerable and self._is_armed and not self.refusal():
            self._stream.note()
            self._control.hold(target)

    def start_mission(self, first: int | None = None) -> str | None:
        """Fly the mission, from an item on where one is given."""
        reason = self.refusal() or self._not_ready()
        if reason is None and first is not None and not self.mission.set_current(first):
            reason = f"no item {first}"
        return reason or self.set_mode(FlightMode.MISSION)

    # What time brings

    def step(self) -> None:
        """Do what is due at a gate, after the state has been updated."""
        self._output.advance(self._state.t_ns)
        self._follow_mission()
        self._follow_drone()
        if self.foreign_commander:
            self._control.let_go()
        elif self._state.is_steerable and self._is_armed:
            self._control.note_answer()
            self._fly()
            self._control.send_due()
        elif self._control.is_takeoff_overdue():
            self._control.let_go()
            self._report(Severity.ERROR, "Take-off refused by the drone")
            self.mission.abort("the drone refused the take-off", failsafe=True)

    def _follow_mission(self) -> None:
        """Notice what has been flown of the mission, and that a client has chosen another mode."""
        self.mission.note_progress()
        if self.mode is not FlightMode.MISSION and not (self.mode is FlightMode.RETURN and self._mission_returns):
            self.mission.abort(f"a client chose {self.mode.name}", failsafe=False)

    def _follow_drone(self) -> None:
        """Notice what the drone does of itself."""
        state, airborne = self._state.state, self._state.is_airborne
        if state == "emergency":
            self.mission.abort("its rotors were stopped", failsafe=True)
            self._control.let_go()
            self._is_armed = False
        elif self._was_airborne and not airborne:
            if self.mission.is_landing:
                self.mission.finish()
            else:
                self.mission.abort("it landed by itself", failsafe=True)
            self._stand("Landed; disarmed")
        elif self._is_armed and not airborne and not self._control.is_asking:
            self._disarm_idle()
        if state == "landing" and self.mode not in OVER_ON_GROUND:
            self._control.let_go()
            self.mode = FlightMode.LAND
        self._was_airborne = airborne

    def _disarm_idle(self) -> None:
        delay_s = self._settings["disarm_s"]
        if delay_s > 0 and self._state.t_ns - self._armed_ns > delay_s * 1e9:
            self.mission.abort("no take-off", failsafe=True)
            self._stand("Disarmed: no take-off")

    def _fly(self) -> None:
        """Do what the mode asks in the air."""
        if self._control.is_climbing:
            if self._control.go_on_climbing():
                self._on_climbed()
        elif self.mode is FlightMode.MISSION:
            self._fly_mission()
        elif self.mode is FlightMode.RETURN:
            self._return.step()
        elif self.mode is FlightMode.LAND:
            self._control.ask("land")
        elif self.mode is FlightMode.OFFBOARD or self._control.is_moving:
            self._watch_stream()

    def _on_climbed(self) -> None:
        if self.mode is FlightMode.TAKEOFF:
            self.mode = FlightMode.HOLD
        elif self.mode is FlightMode.MISSION:
            self.mission.on_climbed()

    def _fly_mission(self) -> None:
        step = self.mission.step(self._state, self._settings)
        if step.land:
            self._control.ask("land")
        elif step.climb_to_m is not None:
            self._control.climb(step.climb_to_m)
        elif step.returns:
            self._enter(FlightMode.RETURN)
            self._mission_returns = True
        elif step.target is not None and step.target != self.target:
            self._control.hold(step.target)
        if step.is_over:
            self._report(Severity.INFO, "Mission finished")
            self.mission.finish()
            self._enter(FlightMode.HOLD)

    def _watch_stream(self) -> None:
        """Hold where setpoints have ceased to come; a position is held anyway by ArduPilot."""
        if not self._stream.is_silent or self.target is None:
            return
        if self.mode is FlightMode.OFFBOARD and self._personality.needs_stream:
            self._report(Severity.WARNING, "Offboard lost: no setpoints; holding")
            self._enter(FlightMode.HOLD)
        elif self._control.is_moving:
            self._control.hold_here()

    def _not_ready(self) -> str | None:
        """Return why it cannot take off now."""
        return "landing" if self._state.state == "landing" else None if self.is_armed else "not armed"

    def _enter(self, mode: FlightMode) -> str | None:
        if mode is FlightMode.OFFBOARD and self._personality.needs_stream and self._stream.is_silent:
            return "OFFBOARD needs a stream of setpoints first"
        if mode is FlightMode.MISSION and not self.mission.items:
            return "no mission"
        if mode is FlightMode.TAKEOFF:
            return self.take_off(self._settings["takeoff_altitude_m"])
        self.mode, self._mission_returns = mode, False
        self._return.rewind()
        if self._state.is_airborne:
            self._is_armed = True
            self._begin_in_air(mode)
        elif mode is FlightMode.MISSION and self._is_armed:
            self._begin_mission_on_ground()
        return None

    def _begin_in_air(self, mode: FlightMode) -> None:
        if mode is FlightMode.MISSION:
            self.mission.start()
        if mode is FlightMode.LAND:
            self._control.ask("land")
        elif mode in HOLDING or (mode is FlightMode.OFFBOARD and not self._personality.needs_stream):
            self._control.hold_here()
        else:
            self._control.stop_climb()

    def _begin_mission_on_ground(self) -> None:
        self.mission.start()
        z_m = self.mission.takeoff_height_m(self._state)
        self._control.climb(self._state.home_z_m + self._settings["takeoff_altitude_m"] if z_m is None else z_m)

    def _take_off_for(self, target: Target | TiltTarget) -> None:
        """Take off where a setpoint leads up from the ground."""
        if self._is_armed and not self._state.is_airborne and target.leads_up(self._state.position_m[2] + ARRIVED_M):
            self._control.ask("takeoff")

    def _stand(self, text: str) -> None:
        """Be disarmed."""
        self._control.let_go()
        self._is_armed = False
        if self.mode in OVER_ON_GROUND or (self.mode is FlightMode.OFFBOARD and self._personality.needs_stream):
            self.mode = self._personality.first_mode
        self._report(Severity.INFO, text)
