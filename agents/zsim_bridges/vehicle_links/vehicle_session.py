"""The protocol-independent parts of a driver: demands on an aircraft, and the session that carries them out. No I/O.

`Failsafe` turns accepted commands into demands within limits, and makes the aircraft hold or land if commands cease.
Its rules, with times measured at the rate of the run:
- Nothing is demanded before an operator has armed the driver.
- After `silence.hover_s` without a setpoint the aircraft holds; after a further `silence.land_s`, it lands.
- After the same total time without the world's clock, it lands, whoever is flying it.
- Outside the fence it lands, and it does not take off from there.
- When an operator or an accepted emergency command kills it, armed or not, its motors stop and the driver is disarmed.
- An aircraft that begins to land by itself is landed. If it is down or in an emergency without a command, the driver is
  disarmed, so that a commander that keeps requesting a take-off starts no motor.
- While nothing is received from the aircraft, only a landing, a stop or a reset is sent: after a power cycle, it might
  take the next setpoint or a repeated take-off for a new command.

`VehicleSession` is the base class of all protocols' sessions, with the aircraft's readings and clock. Poses and
readings are timestamped by the clock of this process.
"""

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple

from zsim.contract import flight_messages
from zsim.contract.flight_messages import AIRBORNE, DroneState
from zsim.math import elementary as el
from zsim.math.frames import geodetic_to_enu, heading, turned_about_up
from zsim.math.rotation import LEVEL, Quaternion, Vector
from zsim.scenario.scenario import Silence

WINDOW_NS = 5_000_000_000  # design choice: much longer than queuing delays, with little clock drift (50 ppm: 0.25 ms)
SIGMA_UNKNOWN_M = 2.0  # m, for a GPS receiver that does not report its accuracy (paper, section VI)
P0_PA = 101_325.0  # Pa, pressure at sea level (ISO 2533)
SCALE_M = 44_330.77  # m, T0 / lapse rate = 288.15 K / 6.5 K/km (ISO 2533)
EXPONENT = 0.190263  # R lapse / g (ISO 2533)
PRESSURES_AVERAGED = 250  # readings averaged; 10 s at 25 Hz reduce 0.1 m of noise to less than 1 cm
ZERO_VECTOR: Vector = (0.0, 0.0, 0.0)
MOTORS_OFF_STATES: tuple[DroneState, ...] = ("landed", "emergency")  # states in which no rotor turns
LOSS_WINDOW = 1000  # messages over which the loss is computed, a few seconds of telemetry
Action = Literal["none", "take_off", "hold", "fly", "land", "kill", "reset"]
TAKEOFF_S = 20.0  # time limit of a take-off: four times what an AR.Drone needs
RESET_S = 2.0  # time limit of a reset: ten times what an AR.Drone needs to leave its emergency
LINK_LOST_S = 1.0  # silence that means a lost link: telemetry comes ten times a second, heartbeats once
BRAKING_M_S2 = 1.0  # half the acceleration of an AR.Drone at 12 deg of tilt; limits the speed towards the fence
RETURN_M_S = 0.5  # speed of the return into the fence; slow, since nobody commanded it
BREACH_MARGIN_M = 1.0  # distance outside the fence at which the aircraft lands; > 0, since it should stop at the fence
Phase = Literal["idle", "taking_off", "airborne", "landing", "killed", "resetting"]


class AircraftPose(NamedTuple):
    """Position and velocity of an aircraft's centre of mass in W, its attitude and angular rate, at `taken_ns`."""

    taken_ns: int
    position_m: Vector
    velocity_m_s: Vector = ZERO_VECTOR
    q_WB: Quaternion = LEVEL
    w_WB_B: Vector = ZERO_VECTOR


class AircraftState(NamedTuple):
    """The state of an aircraft; `received_ns` is when something was last received from it, None for never."""

    state: DroneState = "landed"
    battery_percent: float = 0.0
    pose: AircraftPose | None = None
    received_ns: int | None = None


class Demand(NamedTuple):
    """The current demand on an aircraft; velocities are in W, yaw rates counter-clockwise.

    Attributes:
        action: what the aircraft should do; for `none`, nothing that starts or controls a motor is sent.
    """

    action: Action
    velocity_m_s: Vector = ZERO_VECTOR
    yaw_rate_rad_s: float = 0.0


class FlightLimits(NamedTuple):
    """Limits that a driver never exceeds, in W; the fence is a cylinder around the origin.

    Attributes:
        speed_m_s, climb_m_s, yaw_rate_rad_s: maximum horizontal speed, climb or descent rate, and yaw rate either way.
        radius_m, ceiling_m: radius and height of the fence; inf for none.
    """

    speed_m_s: float = 2.0  # design choice: a person can follow on foot
    climb_m_s: float = 1.0  # the AR.Drone's outdoor control_vz_max
    yaw_rate_rad_s: float = 1.75  # the AR.Drone's indoor control_yaw
    radius_m: float = math.inf
    ceiling_m: float = math.inf

    def limited(self, velocity_m_s: Sequence[float], position_m: Sequence[float] | None) -> tuple[float, float, float]:
        """Return a velocity [m/s; W] reduced to the limits and, at a known position, so as to stop before the fence."""
        x, y, z = velocity_m_s
        speed = el.hypot(x, y)
        scale = min(1.0, self.speed_m_s / speed) if speed else 1.0
        x, y, z = x * scale, y * scale, max(-self.climb_m_s, min(self.climb_m_s, z))
        if position_m is None:
            return x, y, z
        distance = el.hypot(position_m[0], position_m[1])
        if distance > 0.0 and not math.isinf(self.radius_m):
            out_x, out_y = position_m[0] / distance, position_m[1] / distance
            excess = x * out_x + y * out_y - _approach_speed(self.radius_m - distance)
            if excess > 0.0:
                x, y = x - excess * out_x, y - excess * out_y
        return x, y, min(z, _approach_speed(self.ceiling_m - position_m[2]))

    def yaw_rate(self, yaw_rate_rad_s: float) -> float:
        return max(-self.yaw_rate_rad_s, min(self.yaw_rate_rad_s, yaw_rate_rad_s))

    def is_breached(self, position_m: Sequence[float]) -> bool:
        """Return whether an aircraft at a position [m; W] is so far outside the fence that it must land."""
        distance = el.hypot(position_m[0], position_m[1])
        return distance > self.radius_m + BREACH_MARGIN_M or position_m[2] > self.ceiling_m + BREACH_MARGIN_M


def _approach_speed(distance_m: float) -> float:
    """Return the maximum speed towards a fence from which the aircraft can still stop; outside, negative, to return."""
    return math.sqrt(2.0 * BRAKING_M_S2 * distance_m) if distance_m > 0.0 else max(-RETURN_M_S, distance_m)


class Failsafe:
    """Tracks the phase of a flight, which follows from commands and silences.

    Attributes:
        armed: whether commands are obeyed.
        commander: source of the last setpoint; None once the world or a landing has ended its control.
        reason: why the aircraft last left the commander's control; empty if it never did.
    """

    def __init__(self, silence: Silence, limits: FlightLimits, armed: bool = False) -> None:
        self._hover_ns = round(silence.hover_s * 1e9)
        self._land_ns = self._hover_ns + round(silence.land_s * 1e9)
        self._limits = limits
        self.armed = armed
        self.phase: Phase = "idle"
        self.commander: str | None = None
        self.reason = ""
        self._is_uncommanded = False  # whether the landing under way was not commanded
        self._setpoint: flight_messages.Velocity | None = None
        self._setpoint_ns = self._clock_ns = self._entered_ns = 0

    # Operators

    def arm(self, now_ns: int, vehicle: AircraftState) -> str | None:
        """Start obeying commands; return None, or the reason for a refusal."""
        if _is_lost(vehicle, now_ns):
            return "nothing is received from the aircraft; check its address, and that it is switched on"
        self.armed, self._is_uncommanded = True, False
        if self.phase == "killed":
            self._enter_phase("idle", now_ns)
        return None

    def disarm(self, vehicle: AircraftState) -> str | None:
        """Stop obeying commands; return None, or the reason for a refusal."""
        if vehicle.state not in MOTORS_OFF_STATES:
            return f"the aircraft is {vehicle.state}; land it first, or kill it"
        self.armed, self.phase = False, "idle"
        return None

    def kill(self, now_ns: int, source: str) -> None:
        """Stop the motors, armed or not, and disarm."""
        self.armed = False
        self._enter_phase("killed", now_ns)
        self.reason = f"killed by {source}"

    def is_stopping(self, vehicle: AircraftState) -> bool:
        """Return whether a landing or a stop of the motors is under way."""
        return self.phase == "landing" or (self.phase == "killed" and vehicle.state not in MOTORS_OFF_STATES)

    def land(self, reason: str, now_ns: int) -> None:
        """Land if this driver is flying the aircraft."""
        if self.phase in ("taking_off", "airborne"):
            self._enter_phase("landing", now_ns)
            self.reason, self._is_uncommanded = reason, True

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
                self._enter_phase("landing", now_ns)
                return None
            case flight_messages.Mode():
                return self._take_off(now_ns, vehicle)
            case flight_messages.Velocity():
                self._setpoint, self._setpoint_ns, self.commander = command, now_ns, command.source
                return None
            case flight_messages.Ardrone(hover=True):  # the world sends this once nobody flies the drone any more
                self._setpoint = self.commander = None
                return None
            case _:
                return f"a driver does not accept {type(command).__name__}; send velocity"

    def _take_off(self, now_ns: int, vehicle: AircraftState) -> str | None:
        if vehicle.state != "landed":
            return f"the aircraft is {vehicle.state}; it must be landed to take off"
        if self._is_outside(vehicle):
            return "the aircraft is outside the fence; carry it inside, or start the driver with another fence"
        self._setpoint = self.commander = None
        self._enter_phase("taking_off", now_ns)
        return None

    def _reset(self, now_ns: int, vehicle: AircraftState) -> str | None:
        """Leave the emergency, once no motor turns; return None, or the reason for a refusal."""
        if self.is_stopping(vehicle):
            return f"the aircraft is {vehicle.state}; its motors are being stopped"
        if self.phase == "killed" or vehicle.state == "emergency":
            self._enter_phase("resetting", now_ns)
        return None

    # The aircraft

    def demand(self, now_ns: int, vehicle: AircraftState) -> Demand:
        self._advance_phase(now_ns, vehicle)
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
                return self._flight_demand(now_ns, vehicle)
            case _:
                return Demand("none")

    def _advance_phase(self, now_ns: int, vehicle: AircraftState) -> None:
        """Enter the phase that the aircraft has reached, or that a silence, a time limit or the fence requires."""
        is_airborne = vehicle.state in AIRBORNE
        has_had_time = now_ns - self._entered_ns > LINK_LOST_S * 1e9  # for its telemetry to show that it obeys
        if self.phase in ("taking_off", "airborne") and vehicle.state == "emergency":
            self.reason, self._is_uncommanded = "the aircraft is in an emergency", True
            self._end_flight(now_ns)
        elif self.phase == "taking_off" and is_airborne:
            self._enter_phase("airborne", now_ns)
        elif self.phase == "taking_off" and now_ns - self._entered_ns > TAKEOFF_S * 1e9:
            self.land(f"the take-off took longer than {TAKEOFF_S:g} s", now_ns)
        elif self.phase == "landing" and vehicle.state in MOTORS_OFF_STATES and has_had_time:
            self._end_flight(now_ns)
        elif self.phase == "resetting" and (vehicle.state != "emergency" or now_ns - self._entered_ns > RESET_S * 1e9):
            self._enter_phase("idle", now_ns)
        elif self.phase == "idle" and self.armed and is_airborne:
            self._enter_phase("airborne", now_ns)  # the driver was restarted in flight
        elif self.phase == "airborne" and vehicle.state == "landed" and has_had_time:
            self.reason, self._is_uncommanded = "the aircraft landed without a command", True
            self._end_flight(now_ns)
        elif self.phase == "airborne" and vehicle.state == "landing":
            self.land("the aircraft lands by itself", now_ns)
        elif self.phase == "airborne" and self._setpoint is not None and now_ns - self._setpoint_ns > self._land_ns:
            self.land(f"{self.commander} is silent", now_ns)
        elif self.phase in ("taking_off", "airborne") and self._is_outside(vehicle):
            self.land("the aircraft is outside the fence", now_ns)
        elif (
            self.phase in ("taking_off", "airborne") and now_ns - max(self._clock_ns, self._entered_ns) > self._land_ns
        ):
            self.land("the world is silent", now_ns)

    def _end_flight(self, now_ns: int) -> None:
        """Record that the aircraft is down; after an uncommanded landing, only an operator can let it fly again."""
        self._enter_phase("idle", now_ns)
        if self._is_uncommanded:
            self.armed, self._is_uncommanded = False, False

    def _is_outside(self, vehicle: AircraftState) -> bool:
        return vehicle.pose is not None and self._limits.is_breached(vehicle.pose.position_m)

    def _flight_demand(self, now_ns: int, vehicle: AircraftState) -> Demand:
        setpoint, pose = self._setpoint, vehicle.pose
        if setpoint is None or pose is None or now_ns - self._setpoint_ns > self._hover_ns:
            return Demand("hold")
        velocity = setpoint.velocity_m_s
        if setpoint.frame == "heading":
            velocity = turned_about_up(velocity, float(heading(pose.q_WB)))
        velocity = self._limits.limited(velocity, pose.position_m)
        return Demand("fly", velocity, self._limits.yaw_rate(setpoint.yaw_rate_rad_s))

    def _enter_phase(self, phase: Phase, now_ns: int) -> None:
        if phase != self.phase:
            self.phase, self._entered_ns = phase, now_ns
        if phase in ("landing", "killed"):
            self._setpoint = self.commander = None


def _is_lost(vehicle: AircraftState, now_ns: int) -> bool:
    """Return whether nothing has been received from an aircraft for too long, or ever."""
    return vehicle.received_ns is None or now_ns - vehicle.received_ns > LINK_LOST_S * 1e9


class UdpChannel(NamedTuple):
    """A UDP port of an aircraft, and the local port (0: any)."""

    host: str
    port: int
    local_port: int = 0


class LinkQuality(NamedTuple):
    """The quality of the link; None for unknown values.

    Attributes:
        loss_percent: share of the aircraft's messages lost in the last few seconds.
        clock_offset_ms: the aircraft's clock minus that of this process.
        refused: number of datagrams, or messages in them, that were not accepted.
    """

    loss_percent: float | None = None
    round_trip_ms: float | None = None
    clock_offset_ms: float | None = None
    refused: int = 0


class VehicleSession(ABC):
    """The state machine of one aircraft at the other end of a link. No I/O: the process passes in the time.

    Args:
        channels: the aircraft's ports; a channel number is an index into them.
        readings: collects the measurements in the aircraft's telemetry.
        modulus: value at which the sequence numbers of the telemetry wrap around.

    Attributes:
        texts: lines for the terminal, collected by the process.
    """

    def __init__(self, channels: tuple[UdpChannel, ...], readings: "AircraftReadings", modulus: int) -> None:
        self.channels = channels
        self.texts: list[str] = []
        self.readings = readings
        self._loss = StreamLoss(modulus)
        self._received_ns: int | None = None
        self._refused = 0

    @property
    @abstractmethod
    def state(self) -> AircraftState:
        """The state of the aircraft."""

    @abstractmethod
    def receive(self, channel: int, datagram: bytes, now_ns: int) -> None:
        """Process a datagram from one of the aircraft's ports."""

    @abstractmethod
    def advance(self, now_ns: int, demand: Demand) -> Iterable[tuple[int, bytes]]:
        """Return the datagrams that are due, each with its channel; called at least every 20 ms."""

    def link_quality(self) -> LinkQuality:
        clock = self.readings.clock
        return LinkQuality(self._loss.percent, clock.round_trip_ms, clock.ahead_ms, self._refused)


class StreamLoss:
    """Counts gaps in sequence numbers that increase by one, modulo a power of two."""

    def __init__(self, modulus: int) -> None:
        self._modulus = modulus
        self._last: int | None = None
        self._steps: deque[int] = deque(maxlen=LOSS_WINDOW)

    def add(self, number: int) -> bool:
        """Process the number of a message; return whether it is newer than the previous ones."""
        step = 1 if self._last is None else (number - self._last) % self._modulus
        if step == 0 or step > self._modulus // 2:
            return False  # duplicated or out of order
        self._last = number
        self._steps.append(step)
        return True

    def restart(self) -> None:
        """Accept any number next: the sender has restarted its count."""
        self._last = None

    @property
    def percent(self) -> float | None:
        """The share of sent messages that did not arrive [%]; None before the first message."""
        sent = sum(self._steps)
        return 100.0 * (1.0 - len(self._steps) / sent) if sent else None


class Reading(NamedTuple):
    """A measurement taken at `taken_ns` of this process's clock; `values` follow `t_sample_ns` in its message."""

    sensor: str
    taken_ns: int
    values: tuple


class AircraftReadings:
    """The measurements of one aircraft; `origin` is that of W: latitude, longitude [deg], height [m].

    Attributes:
        pose: newest pose; None before the first.
        clock: offset of the aircraft's clock.
        readings: readings not yet returned by `take`.
    """

    def __init__(self, origin: tuple[float, float, float]) -> None:
        self._origin = origin
        self.pose: AircraftPose | None = None
        self.clock = ClockOffset()
        self.readings: list[Reading] = []
        self._last: dict[str, tuple] = {}
        self._fix: tuple = ()
        self._pressure_offset_m = 0.0
        self._pressure_count = 0

    def take(self) -> list[Reading]:
        readings, self.readings = self.readings, []
        return readings

    def read(self, sensor: str, taken_ns: int, *values: Any) -> bool:
        """Add a reading if it is finite and new (aircraft repeat those of slow sensors); return whether it is."""
        if self._last.get(sensor) == values or not _is_finite(values):
            return False
        self._last[sensor] = values
        self.readings.append(Reading(sensor, taken_ns, values))
        return True

    def read_pressure(self, taken_ns: int, pressure_pa: float, height_m: float) -> None:
        """Add a barometer reading, with its height above the origin of W.

        Args:
            height_m: the aircraft's own estimate of its height; the first readings are aligned with it, because the
                standard atmosphere does not account for the weather.
        """
        # Altitude at which the standard atmosphere has this pressure, valid below 11 km.
        altitude_m = SCALE_M * (1.0 - (max(pressure_pa, 0.0) / P0_PA) ** EXPONENT)
        if self._pressure_count < PRESSURES_AVERAGED:
            self._pressure_count += 1
            self._pressure_offset_m += (altitude_m - height_m - self._pressure_offset_m) / self._pressure_count
        self.read("baro", taken_ns, pressure_pa, altitude_m - self._pressure_offset_m)

    def gps_values(
        self, geodetic: Vector, speed_m_s: float, course_rad: float, sigma_m: float, fix: int, satellites: int
    ) -> tuple:
        """Return the values of a fix, with its position in W; the climb rate is the pose's, as the protocols send none.

        Args:
            geodetic: latitude, longitude [deg], height [m].
            course_rad: clockwise from north.
            sigma_m: standard deviation of the position; 0 if unknown.
        """
        x, y, z = geodetic_to_enu(geodetic, self._origin).tolist()
        velocity = speed_m_s * math.sin(course_rad), speed_m_s * math.cos(course_rad), self.climb_m_s
        return *geodetic, (x, y, z), velocity, sigma_m or SIGMA_UNKNOWN_M, fix, satellites

    @property
    def climb_m_s(self) -> float:
        return self.pose.velocity_m_s[2] if self.pose else 0.0


def _is_finite(values: tuple) -> bool:
    return all(_is_finite(value) if isinstance(value, tuple) else math.isfinite(value) for value in values)


class ClockOffset:
    """Estimates the offset of another clock from this one, based on messages with timestamps.

    It uses the minimum difference between arrival and timestamp within a window, since delays by a link or a busy
    process are never negative. The minimum delay is taken as half the shortest round trip, if round trips are measured.
    """

    def __init__(self) -> None:
        self._min_differences: deque[tuple[int, int]] = deque()  # arrivals and differences; both increase
        self._round_trips: deque[tuple[int, int]] = deque()

    def add(self, stamp_ns: int, arrival_ns: int) -> None:
        """Record a message's timestamp by the other clock, and its arrival by this one."""
        _update_window_minimum(self._min_differences, arrival_ns, arrival_ns - stamp_ns)

    def add_round_trip(self, duration_ns: int, arrival_ns: int) -> None:
        """Record the round trip of a request and its answer."""
        _update_window_minimum(self._round_trips, arrival_ns, duration_ns)

    @property
    def offset_ns(self) -> int:
        """This clock's time minus the other's; 0 while unknown."""
        round_trip_ns = self._round_trips[0][1] if self._round_trips else 0
        return self._min_differences[0][1] - round_trip_ns // 2 if self._min_differences else 0

    @property
    def ahead_ms(self) -> float | None:
        """The other clock's time minus this one's; None while unknown."""
        return -self.offset_ns / 1e6 if self._min_differences else None

    @property
    def round_trip_ms(self) -> float | None:
        """The shortest round trip of the window; None if none was measured."""
        return self._round_trips[0][1] / 1e6 if self._round_trips else None

    def taken_ns(self, stamp_ns: int, arrival_ns: int) -> int:
        """Record a timestamped message and its arrival; return when it was created, by this clock."""
        self.add(stamp_ns, arrival_ns)
        return min(arrival_ns, stamp_ns + self.offset_ns)

    def to_remote(self, local_ns: int) -> int:
        """Convert a time of this clock to the other clock's."""
        return local_ns - self.offset_ns


def _update_window_minimum(window: deque[tuple[int, int]], now_ns: int, value: int) -> None:
    """Add a value to a queue whose first entry is the minimum within a window."""
    while window and window[-1][1] >= value:
        window.pop()
    window.append((now_ns, value))
    while now_ns - window[0][0] > WINDOW_NS:
        window.popleft()
