"""What is sent to a drone: a target that is held, a climb, and modes of the firmware that are asked for."""

from typing import Literal

from zsim_bridges.mavlink.autopilot.personality import Settings
from zsim_bridges.mavlink.autopilot.vehicle_state import VehicleState
from zsim_bridges.mavlink.flight.command_output import CommandOutput
from zsim_bridges.mavlink.flight.position_guidance import NOWHERE, Target, TiltTarget, distance_m, steer

ANSWER_NS = 1_000_000_000  # ns within which the drone is to begin a take-off or a landing
ARRIVED_M = 0.3  # m of the height at which a climb is over
STEP_NS = 40_000_000  # ns; the loop of position is closed 25 times a second
Asked = Literal["takeoff", "land"]


class FlightControl:
    """Sends what a drone needs to do what is asked.

    Attributes:
        target: what is held; None while nothing is sent.
    """

    def __init__(self, settings: Settings, state: VehicleState, output: CommandOutput) -> None:
        self._settings = settings
        self._state = state
        self._output = output
        self.target: Target | TiltTarget | None = None
        self._climb_to_m: float | None = None  # z in W
        self._asked: tuple[Asked, int] | None = None  # a mode of the firmware, and since when
        self._stepped_ns = 0
        self._is_pending = False  # a target that could not be sent at once

    @property
    def is_climbing(self) -> bool:
        return self._climb_to_m is not None

    @property
    def is_moving(self) -> bool:
        """Whether what is held leads on for ever."""
        return self.target is not None and self.target.is_moving

    @property
    def is_asking(self) -> bool:
        """Whether the firmware has yet to do what was asked."""
        return self._asked is not None

    def hold(self, target: Target | TiltTarget) -> None:
        """Hold a target from now on, and send it at once; a climb goes on first."""
        self.target = target
        if self._state.is_steerable and not self.is_climbing:
            self._is_pending = not self._output.has_room
            if not self._is_pending:
                self._send()

    def hold_here(self) -> None:
        """Hold where the vehicle is, whatever was under way."""
        self._climb_to_m = None
        if self._state.is_steerable:
            self.hold(Target(self._state.position_m))

    def stop_climb(self) -> None:
        """Let what follows take over from a climb."""
        self._climb_to_m = None

    def climb(self, z_m: float) -> None:
        """Climb, or take off, to z in W above where the vehicle is."""
        self.target, self._climb_to_m = None, z_m
        if not self._state.is_airborne:
            self.ask("takeoff")

    def go_on_climbing(self) -> bool:
        """Do what a climb needs now; return whether it has just ended."""
        z_m = self._climb_to_m
        if z_m is None:
            return False
        if self.target is None:
            x, y, _ = self._state.position_m
            self.target = Target((x, y, z_m))
        if abs(self._state.position_m[2] - z_m) >= ARRIVED_M:
            return False
        self._climb_to_m = None
        return True

    def ask(self, mode: Asked) -> None:
        """Ask the firmware for a mode; again only where it does not answer."""
        if self._asked is None or self._asked[0] != mode or self._state.t_ns - self._asked[1] > ANSWER_NS:
            self._asked = mode, self._state.t_ns
            if mode == "land":
                self.target = self._climb_to_m = None
            self._output.mode(mode)

    def note_answer(self) -> None:
        """Note that the drone flies as was asked."""
        if self._asked and self._asked[0] == "takeoff":
            self._asked = None

    def is_takeoff_overdue(self) -> bool:
        """Return whether the drone still stands though it was asked to take off."""
        if self._asked is None or self._asked[0] != "takeoff" or self._state.is_airborne:
            return False
        return self._state.t_ns - self._asked[1] > ANSWER_NS

    def let_go(self) -> None:
        """Send nothing any more."""
        self.target = self._climb_to_m = self._asked = None

    def has_arrived(self) -> bool:
        """Return whether the target is reached."""
        target = self.target
        radius_m = self._settings["acceptance_m"]
        return isinstance(target, Target) and distance_m(target, self._state.position_m) < radius_m

    def send_due(self) -> None:
        """Send what is due at a gate."""
        if isinstance(self.target, Target) and self.target.position_m != NOWHERE:
            if self._state.t_ns - self._stepped_ns >= STEP_NS:
                self._send()
        elif self.target is not None and (self._output.is_due or self._is_pending):
            self._send()

    def _send(self) -> None:
        self._stepped_ns, self._is_pending = self._state.t_ns, False
        if isinstance(self.target, Target):
            state = self._state
            self._output.steer(steer(self.target, state.position_m, state.yaw_rad, self._settings.speeds))
        elif self.target is not None:
            self._output.tilt(self.target)
