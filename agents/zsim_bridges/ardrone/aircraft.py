"""One drone of a run presented as an AR.Drone 2.0: messages and datagrams in, commands and datagrams out. No I/O.

`Aircraft` connects the run to pilots' programs, and keeps the aircraft's configuration, watchdogs and state.
`Pilot` carries out the programs' REF and PCMD: it requests a mode until it is entered or abandoned, and repeats a
setpoint while it is in force; `SetpointSender` converts setpoints for the drone. Source: AR.Drone Developer Guide SDK
2.0, 6.6; datagrams of existing clients.
"""

import math
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

from zsim.contract import flight_messages, messages
from zsim.contract.flight_messages import AIRBORNE, Status
from zsim.math import elementary as el
from zsim.math import frames as rotations
from zsim.scenario.scenario import Drone
from zsim.sensors.camera import CAMERAS
from zsim.vehicles.vehicle import Limits
from zsim_bridges.ardrone import at_commands
from zsim_bridges.ardrone.at_commands import Command, Configuration, ConfigurationError, Pcmd, PcmdMag, Ref
from zsim_bridges.ardrone.navdata import (
    LOST_COM,
    MAGNETO_CALIBRATION,
    SECOND_NS,
    ControlState,
    NavdataContent,
    NavdataSender,
    Send,
    StateBit,
)
from zsim_bridges.vehicle_links.drone_link import REPEAT_NS, CommandSender, ModeName, OnboardState

WATCHDOG_NS = 50_000_000  # time without an AT command after which the watchdog bit is set (Developer Guide 6.6, COMWDG)
LAND_AFTER_NS = 2_000_000_000  # time of hovering without a pilot's program after which the drone lands
MALFORMED_REPORTED_MAX = 20  # number of invalid parts of datagrams reported in full; further ones are only counted
LOW_BATTERY_PERCENT = 10.0  # %; zsim's firmware does not take off below this, and lands below 5 %
CUTOUT_TILT_COSINE = math.cos(math.radians(75.0))  # cosine of the tilt at which the firmware cuts the motors
THREADS = StateBit.AT_THREAD | StateBit.NAVDATA_THREAD | StateBit.VIDEO_THREAD | StateBit.ACQUISITION_THREAD
ALWAYS_SET = int(StateBit.ALTITUDE_CONTROL | StateBit.PIC_VERSION_OK | THREADS)  # bits that are set even on the ground
CONTROL_STATES = {
    "landed": ControlState.LANDED,
    "taking_off": ControlState.TAKING_OFF,
    "hovering": ControlState.HOVERING,
    "flying": ControlState.FLYING,
    "landing": ControlState.LANDING,
    "emergency": ControlState.DEFAULT,
}
FRONT_CHANNELS = (0, 2)  # video_channel: 0 front, 1 bottom, 2 and 3 the same with the other camera inset, 4 the next
NEXT_CHANNEL = 4
MODE_RETRY_NS = 500_000_000  # period at which a pending mode is requested again, as a pilot's program repeats REF
MODE_REQUESTS_MAX = 3  # number of requests after which a mode not entered is abandoned; design choice: 1.5 s in all
SETPOINTS_PER_GATE_MAX = 3  # maximum number of setpoints sent within a gate, of which only the last takes effect
IN_THE_AIR = ("taking_off", *AIRBORNE)
NO_ALTITUDE_LIMIT_MM = 100_000  # value of altitude_max that means no limit (ARDroneLib)
CLIMB_1_S = 1.5  # maximum climb rate per metre below the maximum height [1/s], as in zsim's firmware
CALIBRATION_YAW_RAD_S = 1.0  # yaw rate of a calibration: a full turn takes 6 s, as on the real aircraft
ANIMATIONS_REFUSED = "flight animations are not simulated; on a real aircraft the firmware performs them"


class AircraftOutputs(NamedTuple):
    """Outputs of an aircraft: commands to the run, navdata to programs, bytes to the control port, and refusals."""

    put: Callable[[str, Any], None]
    send_navdata: Send
    send_control: Callable[[bytes], None]
    refuse: Callable[[str], None]


class Aircraft:
    """One aircraft, controlled by pilots' programs; `gate_ns` is the resolution of arrival times."""

    def __init__(self, drone: Drone, source: str, gate_ns: int, outputs: AircraftOutputs) -> None:
        self._name = drone.name
        self._gate_ns = gate_ns
        self._outputs = outputs
        self._state = OnboardState(drone.sensors.imu.mount, drone.sensors.mag.mount)
        limits = drone.limits
        maxima = {
            "euler_angle_max": math.radians(limits.tilt_deg),
            "control_vz_max": 1e3 * limits.vertical_speed_m_s,
            "control_yaw": math.radians(limits.yaw_rate_deg_s),
        }
        self.configuration = Configuration(
            {
                f"control:{prefix}{name}": maximum
                for name, maximum in maxima.items()
                for prefix in ("", "indoor_", "outdoor_")
            },
            {"general:ardrone_name": drone.name, "network:ssid_single_player": f"ardrone2_{drone.name}"},
        )
        sender = CommandSender(drone.name, source, outputs.put)
        self._setpoints = SetpointSender(sender, limits, self.configuration)
        self.pilot = Pilot(sender, self._setpoints, source, self._refuse)
        self._content = NavdataContent(self._state, drone.rotor_max_rad_s)
        navdata_outputs = outputs.send_navdata, self._state_bits, self._ctrl_state, self._refuse
        self._navdata = NavdataSender(self._content, self.configuration, *navdata_outputs)
        self._has_camera = bool(drone.sensors.front_camera or drone.sensors.bottom_camera)
        self._now_ns = 0
        self._command_ns: int | None = None  # when the last AT command arrived
        self._last_sequence = -1
        self._is_lost = self._ack = False
        self._ids: at_commands.ConfigIds | None = None
        self._channel = 0
        self._malformed = 0

    @property
    def camera(self) -> str:
        """The camera whose images are streamed."""
        return CAMERAS[0] if self._channel in FRONT_CHANNELS else CAMERAS[1]

    # The run

    def update(self, message: Any) -> None:
        message = self._state.update(message)
        self._content.update(message)
        match message:
            case messages.Imu():
                self._navdata.on_instant(message.t_ns)
            case flight_messages.Status():
                self._now_ns = message.t_ns
                self._setpoints.altitude_m = self._state.altitude_m
                self._setpoints.heading_rad = math.radians(self._content.heading_deg)
                self._watch_pilot()
                self.pilot.on_status(message)
                self._navdata.on_gate()
                self._navdata.on_instant(message.t_ns)

    def _watch_pilot(self) -> None:
        """Hover when the pilot's program falls silent, and land if it stays silent."""
        silence_ns = self._silence_ns()
        timeout_ns = round(self.configuration.number("general:com_watchdog") * SECOND_NS)
        if silence_ns <= timeout_ns:
            return
        if not self._is_lost:
            self._is_lost = True
            self._navdata.clients.clear()
            self.pilot.on_lost()
        elif silence_ns > timeout_ns + LAND_AFTER_NS:
            self.pilot.land()

    def _silence_ns(self) -> int:
        """Return the time [ns] since the last AT command, less one gate, the resolution; 0 before the first command."""
        return 0 if self._command_ns is None else max(0, self._now_ns - self._command_ns - self._gate_ns)

    # Pilots' programs

    def on_navdata_request(self, datagram: bytes, address: Hashable) -> None:
        if not self._navdata.on_request(datagram, address, self._now_ns):
            self._refuse(f"a datagram of {len(datagram)} bytes on the navdata port is not a request for navdata")

    def on_at(self, datagram: bytes) -> None:
        commands, refusals = at_commands.parse(datagram)
        for refusal in refusals:
            self._malformed += 1
            self._refuse(refusal if self._malformed <= MALFORMED_REPORTED_MAX else "more data that are not AT commands")
        for command in commands:
            # a program may restart its sequence numbers at 0 or 1 at any time, and at any number after a silence
            if command.sequence > self._last_sequence or command.sequence in (0, 1) or self._is_lost:
                self._last_sequence = command.sequence
                self._command_ns, self._is_lost = self._now_ns, False
                self._obey(command)
            else:
                self._refuse("AT commands have sequence numbers that do not exceed the last one")

    def _obey(self, command: Command) -> None:
        ids, self._ids = self._ids, None
        match command:
            case at_commands.Ref():
                self.pilot.on_ref(command)
            case at_commands.Pcmd() | at_commands.PcmdMag():
                self.pilot.on_pcmd(command)
            case at_commands.ConfigIds():
                self._ids = command
            case at_commands.Config():
                self._configure(command, ids)
            case at_commands.Control(mode=at_commands.ACKNOWLEDGE):
                self._ack = False
            case at_commands.Control(mode=at_commands.SEND_CONFIGURATION):
                self._outputs.send_control(at_commands.format_configuration(self.configuration.all()))
                self._ack = True
            case at_commands.Control(mode=at_commands.SEND_CUSTOM_LIST):
                self._outputs.send_control(at_commands.format_custom_list(self.configuration.custom_list()))
                self._ack = True
            case at_commands.Calibrate():
                self.pilot.calibrate()
            case at_commands.FlatTrim() if self.pilot.state != "landed":
                self._refuse(f"FTRIM is not obeyed: the drone is {self.pilot.state}; must be landed")
            case at_commands.Animation():
                self._refuse(f"ANIM is not obeyed: {ANIMATIONS_REFUSED}")

    def _configure(self, config: at_commands.Config, ids: at_commands.ConfigIds | None) -> None:
        """Set an entry, and acknowledge it even if it is refused, as the real aircraft does."""
        self._ack = True
        key = config.key.lower()
        is_foreign = ids and not self.configuration.is_current(ids.session, ids.user, ids.application)
        if is_foreign and not key.startswith("custom:"):
            self._refuse(f"CONFIG {key[:60]} is not obeyed: its identifiers are not the current ones")
            return
        if key == "control:flight_anim":
            self._refuse(f"CONFIG {key} is not obeyed: {ANIMATIONS_REFUSED}")
            return
        try:
            self.configuration.set(key, config.value)
        except ConfigurationError as error:
            self._refuse(f"CONFIG is not obeyed: {error}")
            return
        if key == "general:navdata_demo":
            self._navdata.is_bootstrap = False
        elif key == "video:video_channel":
            channel = int(self.configuration.number("video:video_channel"))
            self._channel = int(self.camera == CAMERAS[0]) if channel == NEXT_CHANNEL else channel

    # State

    def _refuse(self, reason: str) -> None:
        self._outputs.refuse(f"{self._name}: {reason}")

    def _ctrl_state(self) -> int:
        major, minor = CONTROL_STATES[self.pilot.state], 0
        if major == ControlState.HOVERING and self._is_lost:
            minor = LOST_COM
        elif self.pilot.is_calibrating:
            major, minor = ControlState.HOVERING, MAGNETO_CALIBRATION
        return major << 16 | minor

    def _state_bits(self) -> int:
        status = self._state.status
        is_silent = self._command_ns is None or self._silence_ns() > WATCHDOG_NS
        bits = (
            (StateBit.FLYING, self.pilot.state in (*IN_THE_AIR, "landing")),
            (StateBit.COMMAND_ACK, self._ack),
            (StateBit.CAMERA_READY, self._has_camera),
            (StateBit.COM_WATCHDOG, is_silent),
            (StateBit.COM_LOST, self._is_lost),
            (StateBit.ULTRASOUND_DEAF, self._content.is_sonar_deaf),
            (StateBit.BATTERY_LOW, status is not None and status.battery_percent < LOW_BATTERY_PERCENT),
        )
        state = sum((bit for bit, is_set in bits if is_set), ALWAYS_SET)  # `|` is slow for flags
        if self.pilot.state == "emergency":
            state += StateBit.EMERGENCY + (
                StateBit.USER_EMERGENCY if self.pilot.was_stopped_by_pilot else StateBit.CUTOUT
            )
            if float(rotations.rotation_matrix(self._state.attitude)[2, 2]) < CUTOUT_TILT_COSINE:
                state += StateBit.ANGLES_OUT_OF_RANGE
        return state


class TiltSetpoint(NamedTuple):
    """A PCMD clipped to its range: fractions of the maximum tilt, climb rate and yaw rate.

    Attributes:
        hover: whether to hover in place, ignoring the fractions.
        right, back, up, clockwise: fractions in [-1, 1].
        pilot_heading_rad: the pilot's heading, clockwise from north, to which `right` and `back` are relative; None if
            they are relative to the drone.
    """

    hover: bool
    right: float = 0.0
    back: float = 0.0
    up: float = 0.0
    clockwise: float = 0.0
    pilot_heading_rad: float | None = None


HOVER = TiltSetpoint(hover=True)


class Pilot:
    """Carries out the REF and PCMD commands that pilots' programs send to one drone.

    Attributes:
        setpoint: the setpoint in force, or None.
        has_flown: whether this pilot has flown the drone since it last stood on the ground.
        was_stopped_by_pilot: whether this pilot caused the emergency.
    """

    def __init__(
        self, sender: CommandSender, setpoints: "SetpointSender", source: str, refuse: Callable[[str], None]
    ) -> None:
        self._sender = sender
        self._setpoints = setpoints
        self._source = source
        self._refuse = refuse
        self._status: Status | None = None
        self._last_take_off_bit = self._last_emergency_bit = False  # bits of the last REF
        self._requested_mode: ModeName | None = None  # the mode that is requested but not yet entered
        self._requested_ns, self._request_count = 0, 0
        self.setpoint: TiltSetpoint | None = None
        self._sent_ns: int | None = None  # when the setpoint was last sent; None: not yet
        self._gate_ns, self._gate_count = -1, 0
        self._pilot_heading_rad: float | None = None  # the pilot's heading in the last PCMD_MAG
        self._calibration_end_ns: int | None = None  # when the calibration turn ends
        self.has_flown = False
        self.was_stopped_by_pilot = False

    @property
    def is_calibrating(self) -> bool:
        """Whether the drone is turning to calibrate its magnetometer."""
        return self._calibration_end_ns is not None

    @property
    def state(self) -> str:
        return self._status.state if self._status else "landed"

    @property
    def _now_ns(self) -> int:
        return self._status.t_ns if self._status else 0

    def other_commander(self) -> str | None:
        """Return the name of another process that flies the drone; None if no other does."""
        commander = self._status.commander if self._status else None
        return None if commander in (None, self._source) else commander

    def _is_refused(self, name: str) -> bool:
        """Return whether a command must be refused, and report the reason."""
        if self._status is None:
            self._refuse(f"{name} is not obeyed: the drone has sent no status yet")
        elif other := self.other_commander():
            self._refuse(f"{name} is not obeyed: {other} flies the drone")
        else:
            return False
        return True

    # Commands

    def on_ref(self, ref: Ref) -> None:
        """Take off or land, and toggle the emergency state.

        A pilot's program sends the levels of both bits repeatedly; rising edges trigger a take-off and the toggle.
        """
        is_take_off_edge = ref.takes_off and not self._last_take_off_bit
        is_emergency_edge = ref.emergency and not self._last_emergency_bit
        self._last_take_off_bit, self._last_emergency_bit = ref.takes_off, ref.emergency
        if not (is_take_off_edge or is_emergency_edge or (not ref.takes_off and self.state in IN_THE_AIR)):
            if not ref.takes_off and self._requested_mode == "takeoff":  # the take-off is withdrawn
                if self._request_count:  # it has been requested already, so the drone must land
                    self._sender.send_mode(self._now_ns, "land")
                self._requested_mode = None
            return
        if self._is_refused("REF"):
            return
        if is_emergency_edge:
            self._request("reset" if self.state == "emergency" else "emergency")
        elif self._requested_mode in ("emergency", "reset"):
            return
        elif is_take_off_edge and self.state in ("landed", "landing"):
            self._request("takeoff")
        elif not ref.takes_off and self._requested_mode != "land":
            self._request("land")

    def on_pcmd(self, pcmd: Pcmd | PcmdMag) -> None:
        """Follow a PCMD until the next one arrives."""
        if isinstance(pcmd, PcmdMag):
            self._pilot_heading_rad = math.pi * clipped_fraction(pcmd.psi)
        if self.state not in IN_THE_AIR or self._requested_mode in ("land", "emergency") or self._is_refused("PCMD"):
            return
        setpoint = HOVER
        if pcmd.flag & at_commands.PROGRESSIVE:
            heading_rad = self._pilot_heading_rad if pcmd.flag & at_commands.ABSOLUTE else None
            fractions = map(clipped_fraction, (pcmd.roll, pcmd.pitch, pcmd.gaz, pcmd.yaw))
            setpoint = TiltSetpoint(False, *fractions, pilot_heading_rad=heading_rad)
        elif self.is_calibrating:
            return
        self._calibration_end_ns = None
        self._follow(setpoint)

    def calibrate(self) -> None:
        """Turn once in place to calibrate the magnetometer."""
        if self.state not in AIRBORNE:
            self._refuse(f"CALIB is not obeyed: the drone is {self.state}; must be in the air")
        elif not self._is_refused("CALIB"):
            self._follow(HOVER)
            self._calibration_end_ns = self._now_ns + self._setpoints.turn_ns

    def on_lost(self) -> None:
        """Hover in place, since the pilot's program is silent; treat its next REF as its first."""
        self._last_take_off_bit = self._last_emergency_bit = False
        if self._is_own_flight():
            self._calibration_end_ns = None
            self._follow(HOVER)

    def land(self) -> None:
        """Land, since the pilot's program remains silent."""
        if self._is_own_flight() and self._requested_mode != "land":
            self._request("land")

    def _is_own_flight(self) -> bool:
        return self.state in IN_THE_AIR and self.has_flown and not self.other_commander()

    # Gates

    def on_status(self, status: Status) -> None:
        self._status = status
        if status.state == "emergency" and self._requested_mode == "takeoff":
            self._requested_mode = None
        if status.state != "emergency" and self._requested_mode != "emergency":
            self.was_stopped_by_pilot = False
        if status.state in ("landed", "emergency", "landing"):
            self.setpoint = self._calibration_end_ns = None
        if status.state in ("landed", "emergency") and self._requested_mode != "takeoff":
            self.has_flown = False
        if self._requested_mode is not None:
            self._repeat_request(self._requested_mode)
        if self._calibration_end_ns is not None and status.t_ns >= self._calibration_end_ns:
            self._calibration_end_ns, self._sent_ns = None, None
        if self.other_commander():
            self.setpoint = None
        self._send_due()

    def _request(self, mode: ModeName) -> None:
        self._requested_mode, self._request_count = mode, 0
        self.setpoint = self._calibration_end_ns = None
        self.was_stopped_by_pilot = mode == "emergency"
        self._repeat_request(mode)

    def _repeat_request(self, mode: ModeName) -> None:
        """Request a mode whenever due, until it is entered or abandoned."""
        is_entered = {
            "takeoff": self.state in (*IN_THE_AIR, "emergency"),
            "land": self.state not in IN_THE_AIR,
            "emergency": self.state == "emergency",
            "reset": self.state != "emergency",
        }
        if is_entered[mode]:
            self._requested_mode = None
        elif mode == "takeoff" and self.state != "landed":
            return  # wait until the drone has landed
        elif not self._request_count or self._now_ns - self._requested_ns >= MODE_RETRY_NS:
            if self._request_count == MODE_REQUESTS_MAX:
                self._requested_mode = None
                return
            self._requested_ns, self._request_count = self._now_ns, self._request_count + 1
            self.has_flown = self.has_flown or mode == "takeoff"
            self._sender.send_mode(self._now_ns, mode)

    def _follow(self, setpoint: TiltSetpoint) -> None:
        """Store a setpoint, due at once if it differs from the last one, and send it if it is due."""
        if setpoint != self.setpoint:
            self.setpoint, self._sent_ns = setpoint, None
        self._send_due()

    def _send_due(self) -> None:
        if self.setpoint is None or self.state not in AIRBORNE:
            return
        now_ns = self._now_ns
        if now_ns != self._gate_ns:
            self._gate_ns, self._gate_count = now_ns, 0
        is_due = self._sent_ns is None or now_ns - self._sent_ns >= self._setpoints.repeat_ns(self.setpoint)
        if is_due and self._gate_count < SETPOINTS_PER_GATE_MAX:
            self._sent_ns, self._gate_count, self.has_flown = now_ns, self._gate_count + 1, True
            if self.is_calibrating:
                self._setpoints.send_turn(now_ns)
            else:
                self._setpoints.send(now_ns, self.setpoint)


class SetpointSender:
    """Sends setpoints to one drone, in its body frame and as fractions of its firmware's limits; limits its height.

    Args:
        limits: the firmware's limits, to which the fractions sent to the drone refer.
        configuration: holds the limits to which the pilot's fractions refer, and the maximum height.

    Attributes:
        altitude_m: height above ground, kept up to date by the caller.
        heading_rad: heading, clockwise from magnetic north, kept up to date by the caller.
        turn_ns: duration of the full turn of a calibration.
    """

    def __init__(self, sender: CommandSender, limits: Limits, configuration: Configuration) -> None:
        self._sender = sender
        self._configuration = configuration
        self._tilt_slope = el.tan(math.radians(limits.tilt_deg))
        self._climb_m_s, self._yaw_rad_s = limits.vertical_speed_m_s, math.radians(limits.yaw_rate_deg_s)
        self._turn_rad_s = min(CALIBRATION_YAW_RAD_S, self._yaw_rad_s)
        self.turn_ns = round(2e9 * math.pi / self._turn_rad_s)
        self.altitude_m = 0.0
        self.heading_rad = 0.0

    def repeat_ns(self, setpoint: TiltSetpoint) -> int:
        """Return the period at which a setpoint is repeated; 0 (every gate) if it depends on height or heading."""
        if setpoint.pilot_heading_rad is not None:
            return 0
        climb_m_s = self._configuration.number("control:control_vz_max") / 1e3 if setpoint.up > 0.0 else -math.inf
        return 0 if self._max_climb_m_s() < climb_m_s else REPEAT_NS

    def send(self, t_ns: int, setpoint: TiltSetpoint) -> None:
        if setpoint.hover:
            self._sender.send_tilt(t_ns, 0.0, 0.0, 0.0, 0.0, hover=True)
            return
        number = self._configuration.number
        right, back = setpoint.right, setpoint.back
        if setpoint.pilot_heading_rad is not None:
            angle_rad = setpoint.pilot_heading_rad - self.heading_rad
            sine, cosine = el.sin(angle_rad), el.cos(angle_rad)
            right, back = cosine * right - sine * back, sine * right + cosine * back
        tilt_rad = number("control:euler_angle_max")
        right, back = (clipped_fraction(el.tan(fraction * tilt_rad) / self._tilt_slope) for fraction in (right, back))
        climb_m_s = min(setpoint.up * number("control:control_vz_max") / 1e3, self._max_climb_m_s())
        yaw_left = clipped_fraction(-setpoint.clockwise * number("control:control_yaw") / self._yaw_rad_s)
        self._sender.send_tilt(
            t_ns, -back, -right, clipped_fraction(climb_m_s / self._climb_m_s), yaw_left, hover=False
        )

    def send_turn(self, t_ns: int) -> None:
        self._sender.send_velocity(t_ns, (0.0, 0.0, 0.0), -self._turn_rad_s)

    def _max_climb_m_s(self) -> float:
        """Return the maximum climb rate at which the drone stays below altitude_max."""
        max_altitude_mm = self._configuration.number("control:altitude_max")
        if max_altitude_mm >= NO_ALTITUDE_LIMIT_MM:
            return math.inf
        return CLIMB_1_S * (max_altitude_mm / 1e3 - self.altitude_m)


def clipped_fraction(value: float) -> float:
    """Return a fraction of a limit, clipped to [-1, 1]."""
    return min(1.0, max(-1.0, value))
