"""What a driver asks of its aircraft: the accepted commands, while everybody is there; else hold, then land. Pure.

The rules, for the clock of the run:

- Nothing before an operator has armed the driver on purpose.
- No setpoint for `silence.hover_s`: it holds. For `silence.land_s` more: it lands.
- The world silent for as long, whoever flies: it lands.
- Outside the fence: it lands; from there it does not take off.
- Killed, by an operator or an accepted emergency, armed or not: its motors stop, and it is disarmed.
- Landing by itself: it is landed. Down, or in an emergency, without a command: disarmed. A commander that asks for
  take-off again and again starts no motor then.
- The aircraft silent: nothing but a landing or a stop is sent. One that was switched off and on again may take the next
  setpoint, or the repetition of an old take-off, for a new one.
"""

from typing import Literal, NamedTuple

from zsim.contract import flight_messages
from zsim.math.frames import heading, turned_about_up
from zsim.math.rotation import Vector
from zsim.scenario.scenario import Silence
from zsim_bridges.vehicle_links.aircraft_state import AIRBORNE, STANDING, STILL, AircraftState
from zsim_bridges.vehicle_links.flight_limits import FlightLimits

TAKEOFF_S = 20.0  # chosen: four times what an AR.Drone takes; then it is given up
RESET_S = 2.0  # chosen: ten times what an AR.Drone takes to leave its emergency
LINK_LOST_S = 1.0  # chosen: heartbeats come once a second, telemetry ten times as often

Phase = Literal["idle", "taking_off", "airborne", "landing", "killed", "resetting"]
Action = Literal["none", "take_off", "hold", "fly", "land", "kill", "reset"]


class Demand(NamedTuple):
    """What an aircraft is to do now.

    Attributes:
        action: `none`: send nothing that starts or steers a motor.
        velocity_m_s: where it is to fly [W].
        yaw_rate_rad_s: how it is to turn, counter-clockwise.
    """

    action: Action
    velocity_m_s: Vector = STILL
    yaw_rate_rad_s: float = 0.0


class Failsafe:
    """The phases of a flight, from what is commanded and who is silent.

    Args:
        silence: of the scenario.
        limits: that hold whatever is commanded.
        armed: whether it begins armed.

    Attributes:
        armed: whether commands are obeyed.
        phase: of the flight.
        commander: source of the last setpoint.
        reason: why it left the commander's control last; empty for never.
    """

    def __init__(self, silence: Silence, limits: FlightLimits, armed: bool = False) -> None:
        self._hover_ns = round(silence.hover_s * 1e9)
        self._land_ns = self._hover_ns + round(silence.land_s * 1e9)
        self._limits = limits
        self.armed = armed
        self.phase: Phase = "idle"
        self.commander: str | None = None
        self.reason = ""
        self._uncommanded = False  # the landing that goes on
        self._setpoint: flight_messages.Velocity | None = None
        self._setpoint_ns = self._clock_ns = self._began_ns = 0

    # Operators

    def arm(self, now_ns: int, vehicle: AircraftState) -> str | None:
        """Obey from now on; return None, or why not."""
        if _is_lost(vehicle, now_ns):
            return "nothing comes from the aircraft; check its address, and that it is switched on"
        self.armed, self._uncommanded = True, False
        if self.phase == "killed":
            self._enter("idle", now_ns)
        return None

    def disarm(self, vehicle: AircraftState) -> str | None:
        """Obey no longer; return None, or why not."""
        if vehicle.state not in STANDING:
            return f"the aircraft is {vehicle.state}; land first, or kill"
        self.armed, self.phase = False, "idle"
        return None

    def kill(self, now_ns: int, source: str) -> None:
        """Stop the motors, armed or not, and be disarmed."""
        self.armed = False
        self._enter("killed", now_ns)
        self.reason = f"killed by {source}"

    def is_stopping(self, vehicle: AircraftState) -> bool:
        """Tell whether a landing or a stop of the motors goes on."""
        return self.phase == "landing" or (self.phase == "killed" and vehicle.state not in STANDING)

    def land(self, reason: str, now_ns: int) -> None:
        """Land, if it flies for this driver."""
        if self.phase in ("taking_off", "airborne"):
            self._enter("landing", now_ns)
            self.reason, self._uncommanded = reason, True

    # What comes

    def on_clock(self, now_ns: int) -> None:
        """The world is there."""
        self._clock_ns = now_ns

    def on_command(self, command: flight_messages.Command, now_ns: int, vehicle: AircraftState) -> str | None:
        """Take an accepted command; return None, or why it is not obeyed."""
        match command:
            case flight_messages.Mode(mode="emergency"):
                self.kill(now_ns, command.source)
                return None
            case flight_messages.Mode(mode="reset"):
                return self._reset(now_ns, vehicle)
            case _ if not self.armed:
                return "its driver is not armed; an operator asks `arm` of it"
            case flight_messages.Mode():
                return self._on_mode(command.mode, now_ns, vehicle)
            case flight_messages.Velocity():
                self._setpoint, self._setpoint_ns, self.commander = command, now_ns, command.source
                return None
            case flight_messages.Ardrone(hover=True):  # as the world has it where nobody flies the drone any more
                self._setpoint = self.commander = None
                return None
            case _:
                return f"a driver does not take {type(command).__name__}; send velocity"

    def _on_mode(self, mode: str, now_ns: int, vehicle: AircraftState) -> str | None:
        if mode == "land":
            self._enter("landing", now_ns)
            return None
        if vehicle.state != "landed":
            return f"the aircraft is {vehicle.state}; a take-off needs it landed"
        if self._is_outside(vehicle):
            return "the aircraft stands outside the fence; carry it inside, or start the driver with another fence"
        self._setpoint = self.commander = None
        self._enter("taking_off", now_ns)
        return None

    def _reset(self, now_ns: int, vehicle: AircraftState) -> str | None:
        """Leave the emergency, once no motor turns; return None, or why not."""
        if self.is_stopping(vehicle):
            return f"the aircraft is {vehicle.state}; its motors are being stopped"
        if self.phase == "killed" or vehicle.state == "emergency":
            self._enter("resetting", now_ns)
        return None

    # What is asked of the aircraft

    def demand(self, now_ns: int, vehicle: AircraftState) -> Demand:
        """Return what the aircraft is to do now."""
        self._advance(now_ns, vehicle)
        match self.phase:
            case "killed":
                return Demand("kill")
            case "landing":
                return Demand("land")
            case "resetting":
                return Demand("reset")
            case _ if _is_lost(vehicle, now_ns):
                return Demand("none")
            case "taking_off":
                return Demand("take_off")
            case "airborne":
                return self._airborne(now_ns, vehicle)
            case _:
                return Demand("none")

    def _advance(self, now_ns: int, vehicle: AircraftState) -> None:
        """Go on to the next phase where the aircraft has reached it, or somebody is silent."""
        airborne = vehicle.state in AIRBORNE
        if self.phase in ("taking_off", "airborne") and vehicle.state == "emergency":
            self.reason, self._uncommanded = "the aircraft is in an emergency", True
            self._settle(now_ns)
        elif self.phase == "taking_off" and airborne:
            self._enter("airborne", now_ns)
        elif self.phase == "taking_off" and now_ns - self._began_ns > TAKEOFF_S * 1e9:
            self.land(f"the take-off took longer than {TAKEOFF_S:g} s", now_ns)
        elif self.phase == "taking_off":
            self._watch_bounds(now_ns, vehicle)
        elif self.phase == "landing" and vehicle.state in STANDING and self._settled(now_ns):
            self._settle(now_ns)
        elif self.phase == "resetting" and (vehicle.state != "emergency" or now_ns - self._began_ns > RESET_S * 1e9):
            self._enter("idle", now_ns)
        elif self.phase == "idle" and self.armed and airborne:
            self._enter("airborne", now_ns)  # a driver that is started again in flight
        elif self.phase == "airborne":
            self._watch(now_ns, vehicle)

    def _settled(self, now_ns: int) -> bool:
        """Tell whether an aircraft has had the time to show that it obeys."""
        return now_ns - self._began_ns > LINK_LOST_S * 1e9

    def _settle(self, now_ns: int) -> None:
        """It is down: after a landing that nobody commanded, only an operator lets it fly again."""
        self._enter("idle", now_ns)
        if self._uncommanded:
            self.armed, self._uncommanded = False, False

    def _watch(self, now_ns: int, vehicle: AircraftState) -> None:
        if vehicle.state == "landed" and self._settled(now_ns):
            self.reason, self._uncommanded = "the aircraft landed without a command", True
            self._settle(now_ns)
        elif vehicle.state == "landing":
            self.land("the aircraft lands by itself", now_ns)
        elif self._setpoint is not None and now_ns - self._setpoint_ns > self._land_ns:
            self.land(f"{self.commander} is silent", now_ns)
        else:
            self._watch_bounds(now_ns, vehicle)

    def _watch_bounds(self, now_ns: int, vehicle: AircraftState) -> None:
        """Land outside the fence, and without the world, also during a take-off."""
        if self._is_outside(vehicle):
            self.land("it is outside the fence", now_ns)
        elif now_ns - max(self._clock_ns, self._began_ns) > self._land_ns:
            self.land("the world is silent", now_ns)

    def _is_outside(self, vehicle: AircraftState) -> bool:
        return vehicle.pose is not None and self._limits.is_breached(vehicle.pose.position_m)

    def _airborne(self, now_ns: int, vehicle: AircraftState) -> Demand:
        setpoint, pose = self._setpoint, vehicle.pose
        if setpoint is None or pose is None or now_ns - self._setpoint_ns > self._hover_ns:
            return Demand("hold")
        velocity = setpoint.velocity_m_s
        if setpoint.frame == "heading":
            velocity = turned_about_up(velocity, float(heading(pose.q_WB)))
        velocity = self._limits.limited(velocity, pose.position_m)
        return Demand("fly", velocity, self._limits.yaw_rate(setpoint.yaw_rate_rad_s))

    def _enter(self, phase: Phase, now_ns: int) -> None:
        if phase != self.phase:
            self.phase, self._began_ns = phase, now_ns
        if phase in ("landing", "killed"):
            self._setpoint = self.commander = None


def _is_lost(vehicle: AircraftState, now_ns: int) -> bool:
    """Tell whether nothing has come from an aircraft for too long, or ever."""
    return vehicle.received_ns is None or now_ns - vehicle.received_ns > LINK_LOST_S * 1e9
