"""A driver's demands on its aircraft: accepted commands within limits, and a hold or a landing without commands.

Pure. The rules, by the clock of the run:

- Nothing is demanded before an operator has armed the driver.
- Without a setpoint for `silence.hover_s` it holds; for `silence.land_s` more, it lands.
- Without the world for as long, whoever flies, it lands.
- Outside the fence it lands; it does not take off from there.
- Killed by an operator or an accepted emergency, armed or not, it stops its motors and is disarmed.
- An aircraft that lands by itself is landed. One that is down, or in an emergency, without a command is disarmed, so
  that a commander that keeps asking for a take-off starts no motor.
- While the aircraft is silent, only a landing or a stop is sent: one that was switched off and on again might take the
  next setpoint, or a repeated take-off, for a new one.
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

from zsim.contract import flight_messages
from zsim.math import elementary as el
from zsim.math.frames import heading, turned_about_up
from zsim.scenario.scenario import Silence
from zsim_bridges.vehicle_links.vehicle_session import AIRBORNE, STANDING, AircraftState, Demand

TAKEOFF_S = 20.0  # chosen: four times what an AR.Drone takes; then it is given up
RESET_S = 2.0  # chosen: ten times what an AR.Drone takes to leave its emergency
LINK_LOST_S = 1.0  # chosen: heartbeats come once a second, telemetry ten times as often
BRAKING_M_S2 = 1.0  # chosen: half of what an AR.Drone at 12 deg of tilt has; the speed towards a fence follows from it
RETURN_M_S = 0.5  # chosen: slow, since nobody asked for it
BREACH_M = 1.0  # chosen: how far outside it lands; the fence itself stops it before

Phase = Literal["idle", "taking_off", "airborne", "landing", "killed", "resetting"]


class FlightLimits(NamedTuple):
    """Limits that a driver never exceeds, in W; the fence is a cylinder around the origin.

    Attributes:
        speed_m_s, climb_m_s, yaw_rate_rad_s: greatest, in any direction, up or down, either way.
        radius_m, ceiling_m: of the fence; inf for none.
    """

    speed_m_s: float = 2.0  # chosen: what a person can walk after
    climb_m_s: float = 1.0  # chosen: control_vz_max of the AR.Drone outdoors
    yaw_rate_rad_s: float = 1.75  # rad/s, control_yaw of the AR.Drone indoors
    radius_m: float = math.inf
    ceiling_m: float = math.inf

    def limited(self, velocity_m_s: Sequence[float], position_m: Sequence[float] | None) -> tuple[float, float, float]:
        """Return a velocity [m/s; W] within the limits that does not lead through the fence, if a position is known."""
        x, y, z = velocity_m_s
        speed = el.hypot(x, y)
        share = min(1.0, self.speed_m_s / speed) if speed else 1.0
        x, y, z = x * share, y * share, max(-self.climb_m_s, min(self.climb_m_s, z))
        if position_m is None:
            return x, y, z
        distance = el.hypot(position_m[0], position_m[1])
        if distance > 0.0 and not math.isinf(self.radius_m):
            out_x, out_y = position_m[0] / distance, position_m[1] / distance
            excess = x * out_x + y * out_y - _approach(self.radius_m - distance)
            if excess > 0.0:
                x, y = x - excess * out_x, y - excess * out_y
        return x, y, min(z, _approach(self.ceiling_m - position_m[2]))

    def yaw_rate(self, yaw_rate_rad_s: float) -> float:
        return max(-self.yaw_rate_rad_s, min(self.yaw_rate_rad_s, yaw_rate_rad_s))

    def is_breached(self, position_m: Sequence[float]) -> bool:
        """Return whether an aircraft at a position [m; W] is so far outside that it must land."""
        distance = el.hypot(position_m[0], position_m[1])
        return distance > self.radius_m + BREACH_M or position_m[2] > self.ceiling_m + BREACH_M


def _approach(distance_m: float) -> float:
    """Return the greatest speed towards a fence at which the aircraft still stops before it; outside, back to it."""
    return math.sqrt(2.0 * BRAKING_M_S2 * distance_m) if distance_m > 0.0 else max(-RETURN_M_S, distance_m)


class Failsafe:
    """The phases of a flight, by commands and silences.

    Attributes:
        armed: whether commands are obeyed.
        commander: source of the last setpoint.
        reason: why it last left the commander's control; empty for never.
    """

    def __init__(self, silence: Silence, limits: FlightLimits, armed: bool = False) -> None:
        self._hover_ns = round(silence.hover_s * 1e9)
        self._land_ns = self._hover_ns + round(silence.land_s * 1e9)
        self._limits = limits
        self.armed = armed
        self.phase: Phase = "idle"
        self.commander: str | None = None
        self.reason = ""
        self._uncommanded = False  # whether the landing under way was not commanded
        self._setpoint: flight_messages.Velocity | None = None
        self._setpoint_ns = self._clock_ns = self._began_ns = 0

    # Operators

    def arm(self, now_ns: int, vehicle: AircraftState) -> str | None:
        """Start obeying commands; return None, or the reason for a refusal."""
        if _is_lost(vehicle, now_ns):
            return "nothing is received from the aircraft; check its address, and that it is switched on"
        self.armed, self._uncommanded = True, False
        if self.phase == "killed":
            self._enter("idle", now_ns)
        return None

    def disarm(self, vehicle: AircraftState) -> str | None:
        """Stop obeying commands; return None, or the reason for a refusal."""
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
        """Return whether a landing or a stop of the motors is under way."""
        return self.phase == "landing" or (self.phase == "killed" and vehicle.state not in STANDING)

    def land(self, reason: str, now_ns: int) -> None:
        """Land, if it flies for this driver."""
        if self.phase in ("taking_off", "airborne"):
            self._enter("landing", now_ns)
            self.reason, self._uncommanded = reason, True

    # The run

    def on_clock(self, now_ns: int) -> None:
        self._clock_ns = now_ns

    def on_command(self, command: flight_messages.Command, now_ns: int, vehicle: AircraftState) -> str | None:
        """Process an accepted command; return None, or why it is not obeyed."""
        match command:
            case flight_messages.Mode(mode="emergency"):
                self.kill(now_ns, command.source)
                return None
            case flight_messages.Mode(mode="reset"):
                return self._reset(now_ns, vehicle)
            case _ if not self.armed:
                return "its driver is not armed; an operator must arm it"
            case flight_messages.Mode(mode="land"):
                self._enter("landing", now_ns)
                return None
            case flight_messages.Mode():
                return self._take_off(now_ns, vehicle)
            case flight_messages.Velocity():
                self._setpoint, self._setpoint_ns, self.commander = command, now_ns, command.source
                return None
            case flight_messages.Ardrone(hover=True):  # the world's, when nobody flies the drone any more
                self._setpoint = self.commander = None
                return None
            case _:
                return f"a driver does not take {type(command).__name__}; send velocity"

    def _take_off(self, now_ns: int, vehicle: AircraftState) -> str | None:
        if vehicle.state != "landed":
            return f"the aircraft is {vehicle.state}; a take-off needs it landed"
        if self._is_outside(vehicle):
            return "the aircraft stands outside the fence; carry it inside, or start the driver with another fence"
        self._setpoint = self.commander = None
        self._enter("taking_off", now_ns)
        return None

    def _reset(self, now_ns: int, vehicle: AircraftState) -> str | None:
        """Leave the emergency, once no motor turns; return None, or the reason for a refusal."""
        if self.is_stopping(vehicle):
            return f"the aircraft is {vehicle.state}; its motors are being stopped"
        if self.phase == "killed" or vehicle.state == "emergency":
            self._enter("resetting", now_ns)
        return None

    # The aircraft

    def demand(self, now_ns: int, vehicle: AircraftState) -> Demand:
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
        """Enter the next phase once the aircraft has reached it, or because of a silence."""
        airborne = vehicle.state in AIRBORNE
        has_had_time = now_ns - self._began_ns > LINK_LOST_S * 1e9  # to show that it obeys
        if self.phase in ("taking_off", "airborne") and vehicle.state == "emergency":
            self.reason, self._uncommanded = "the aircraft is in an emergency", True
            self._settle(now_ns)
        elif self.phase == "taking_off" and airborne:
            self._enter("airborne", now_ns)
        elif self.phase == "taking_off" and now_ns - self._began_ns > TAKEOFF_S * 1e9:
            self.land(f"the take-off took longer than {TAKEOFF_S:g} s", now_ns)
        elif self.phase == "landing" and vehicle.state in STANDING and has_had_time:
            self._settle(now_ns)
        elif self.phase == "resetting" and (vehicle.state != "emergency" or now_ns - self._began_ns > RESET_S * 1e9):
            self._enter("idle", now_ns)
        elif self.phase == "idle" and self.armed and airborne:
            self._enter("airborne", now_ns)  # a driver that is started again in flight
        elif self.phase == "airborne" and vehicle.state == "landed" and has_had_time:
            self.reason, self._uncommanded = "the aircraft landed without a command", True
            self._settle(now_ns)
        elif self.phase == "airborne" and vehicle.state == "landing":
            self.land("the aircraft lands by itself", now_ns)
        elif self.phase == "airborne" and self._setpoint is not None and now_ns - self._setpoint_ns > self._land_ns:
            self.land(f"{self.commander} is silent", now_ns)
        elif self.phase in ("taking_off", "airborne") and self._is_outside(vehicle):
            self.land("it is outside the fence", now_ns)
        elif self.phase in ("taking_off", "airborne") and now_ns - max(self._clock_ns, self._began_ns) > self._land_ns:
            self.land("the world is silent", now_ns)

    def _settle(self, now_ns: int) -> None:
        """Record that it is down: after an uncommanded landing, only an operator can let it fly again."""
        self._enter("idle", now_ns)
        if self._uncommanded:
            self.armed, self._uncommanded = False, False

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
    """Return whether nothing has been received from an aircraft for too long, or ever."""
    return vehicle.received_ns is None or now_ns - vehicle.received_ns > LINK_LOST_S * 1e9
