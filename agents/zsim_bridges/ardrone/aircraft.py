"""One drone of a run as an AR.Drone 2.0: messages and datagrams in, commands and datagrams out. Pure.

The session of one aircraft: AT commands, configuration, watchdogs and state, between a run and pilots' programs.
"""

import math
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

from zsim.contract import flight_messages, messages
from zsim.math import frames as rotations
from zsim.scenario.scenario import Drone
from zsim.sensors.camera import CAMERAS
from zsim_bridges.ardrone import at_commands, configuration
from zsim_bridges.ardrone.at_commands import Command
from zsim_bridges.ardrone.configuration import Configuration, ConfigurationError
from zsim_bridges.ardrone.navdata import LOST_COM, MAGNETO_CALIBRATION, ControlState, StateBit
from zsim_bridges.ardrone.navdata_sender import NavdataContent, NavdataSender, Send
from zsim_bridges.ardrone.pilot import IN_THE_AIR, Pilot, SetpointSender
from zsim_bridges.vehicle_links.drone_link import CommandSender, OnboardState

WATCHDOG_NS = 50_000_000  # ns without an AT command until the watchdog's bit (Developer Guide 6.6, COMWDG)
LAND_AFTER_NS = 2_000_000_000  # ns of hovering without a pilot's program before it lands, chosen
SECOND_NS = 1_000_000_000
MALFORMED_SHOWN = 20  # parts of datagrams that are no commands, chosen; more are only counted
LOW_BATTERY_PERCENT = 10.0  # %, below it zsim's firmware does not take off; below 5 % it lands
RANGE_COSINE = math.cos(math.radians(75.0))  # of the tilt at which the firmware cuts the motors
THREADS = StateBit.AT_THREAD | StateBit.NAVDATA_THREAD | StateBit.VIDEO_THREAD | StateBit.ACQUISITION_THREAD
ALWAYS = int(StateBit.ALTITUDE_CONTROL | StateBit.PIC_VERSION_OK | THREADS)  # of an aircraft on the ground
CONTROL_STATES = {
    "landed": ControlState.LANDED,
    "taking_off": ControlState.TAKING_OFF,
    "hovering": ControlState.HOVERING,
    "flying": ControlState.FLYING,
    "landing": ControlState.LANDING,
    "emergency": ControlState.DEFAULT,
}
FRONT_CHANNELS = (0, 2)  # video_channel: 0 front, 1 bottom, 2 and 3 with the other one small, 4 the next one
NEXT_CHANNEL = 4
FIGURES = "figures are not flown here; the aircraft's flips are its firmware's"


class Outlets(NamedTuple):
    """The outputs of an aircraft: messages to the run, navdata to programs, bytes to the control port, refusals."""

    put: Callable[[str, Any], None]
    send_navdata: Send
    send_control: Callable[[bytes], None]
    refuse: Callable[[str], None]


class Aircraft:
    """One aircraft, steered by the programs of its pilot; `gate_ns` is how exactly the time of an arrival is known."""

    def __init__(self, drone: Drone, source: str, gate_ns: int, outlets: Outlets) -> None:
        self._name = drone.name
        self._gate_ns = gate_ns
        self._outlets = outlets
        self._state = OnboardState(drone.sensors.imu.mount, drone.sensors.mag.mount)
        limits = drone.limits
        highest = {
            "euler_angle_max": math.radians(limits.tilt_deg),
            "control_vz_max": 1e3 * limits.vertical_speed_m_s,
            "control_yaw": math.radians(limits.yaw_rate_deg_s),
        }
        self.configuration = Configuration(
            {f"control:{place}{name}": v for name, v in highest.items() for place in ("", "indoor_", "outdoor_")},
            {"general:ardrone_name": drone.name, "network:ssid_single_player": f"ardrone2_{drone.name}"},
        )
        sender = CommandSender(drone.name, source, outlets.put)
        self._setpoints = SetpointSender(sender, limits, self.configuration)
        self.pilot = Pilot(sender, self._setpoints, source, self._refuse)
        self._content = NavdataContent(self._state, drone.rotor_max_rad_s)
        outputs = outlets.send_navdata, self._state_bits, self._ctrl_state, self._refuse
        self._navdata = NavdataSender(self._content, self.configuration, *outputs)
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
        """The camera whose pictures are streamed."""
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
        """Hover, and then land, when the pilot's program has gone silent."""
        silent_ns = self._silent_ns()
        lost_ns = round(self.configuration.number("general:com_watchdog") * SECOND_NS)
        if silent_ns <= lost_ns:
            return
        if not self._is_lost:
            self._is_lost = True
            self._navdata.clients.clear()
            self.pilot.on_lost()
        elif silent_ns > lost_ns + LAND_AFTER_NS:
            self.pilot.land()

    def _silent_ns(self) -> int:
        """Return since when no AT command has arrived, less the gate within which its arrival is not known."""
        return 0 if self._command_ns is None else max(0, self._now_ns - self._command_ns - self._gate_ns)

    # Pilots' programs

    def on_navdata_request(self, datagram: bytes, address: Hashable) -> None:
        if not self._navdata.on_request(datagram, address, self._now_ns):
            self._refuse(f"a datagram of {len(datagram)} bytes on the navdata port does not ask for navdata")

    def on_at(self, datagram: bytes) -> None:
        commands, refusals = at_commands.parse(datagram)
        for refusal in refusals:
            self._malformed += 1
            self._refuse(refusal if self._malformed <= MALFORMED_SHOWN else "more is sent that is no AT command")
        for command in commands:
            # numbers begin again with 0 or 1, and after a silence
            if command.sequence > self._last_sequence or command.sequence in (0, 1) or self._is_lost:
                self._last_sequence = command.sequence
                self._command_ns, self._is_lost = self._now_ns, False
                self._obey(command)
            else:
                self._refuse("AT commands come with sequence numbers that are not above the last one")

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
                self._outlets.send_control(configuration.format_configuration(self.configuration.all()))
                self._ack = True
            case at_commands.Control(mode=at_commands.SEND_CUSTOM_LIST):
                self._outlets.send_control(configuration.format_custom_list(self.configuration.custom_list()))
                self._ack = True
            case at_commands.Calibrate():
                self.pilot.calibrate()
            case at_commands.FlatTrim() if self.pilot.state != "landed":
                self._refuse(f"FTRIM is not obeyed: the drone is {self.pilot.state}; must be landed")
            case at_commands.Animation():
                self._refuse(f"ANIM is not obeyed: {FIGURES}")

    def _configure(self, config: at_commands.Config, ids: at_commands.ConfigIds | None) -> None:
        """Set an entry, and acknowledge it in any case, as the aircraft does."""
        self._ack = True
        key = config.key.lower()
        is_foreign = ids and not self.configuration.is_current(ids.session, ids.user, ids.application)
        if is_foreign and not key.startswith("custom:"):
            self._refuse(f"CONFIG {key[:60]} is not obeyed: its identifiers are not those in force")
            return
        if key == "control:flight_anim":
            self._refuse(f"CONFIG {key} is not obeyed: {FIGURES}")
            return
        try:
            self.configuration.set(key, config.value)
        except ConfigurationError as error:
            self._refuse(f"CONFIG is not obeyed: {error}")
            return
        if key == "general:navdata_demo":
            self._navdata.is_bootstrap = False
        elif key == "video:video_channel":
            wanted = int(self.configuration.number("video:video_channel"))
            self._channel = int(self.camera == CAMERAS[0]) if wanted == NEXT_CHANNEL else wanted

    # State

    def _refuse(self, reason: str) -> None:
        self._outlets.refuse(f"{self._name}: {reason}")

    def _ctrl_state(self) -> int:
        major, minor = CONTROL_STATES[self.pilot.state], 0
        if major == ControlState.HOVERING and self._is_lost:
            minor = LOST_COM
        elif self.pilot.calibrates:
            major, minor = ControlState.HOVERING, MAGNETO_CALIBRATION
        return major << 16 | minor

    def _state_bits(self) -> int:
        status = self._state.status
        is_silent = self._command_ns is None or self._silent_ns() > WATCHDOG_NS
        bits = (
            (StateBit.FLYING, self.pilot.state in (*IN_THE_AIR, "landing")),
            (StateBit.COMMAND_ACK, self._ack),
            (StateBit.CAMERA_READY, self._has_camera),
            (StateBit.COM_WATCHDOG, is_silent),
            (StateBit.COM_LOST, self._is_lost),
            (StateBit.ULTRASOUND_DEAF, self._content.is_sonar_deaf),
            (StateBit.BATTERY_LOW, status is not None and status.battery_percent < LOW_BATTERY_PERCENT),
        )
        state = sum((bit for bit, is_set in bits if is_set), ALWAYS)  # a flag's `|` is slow
        if self.pilot.state == "emergency":
            state += StateBit.EMERGENCY + (StateBit.USER_EMERGENCY if self.pilot.stopped_by_pilot else StateBit.CUTOUT)
            if float(rotations.rotation_matrix(self._state.attitude)[2, 2]) < RANGE_COSINE:
                state += StateBit.ANGLES_OUT_OF_RANGE
        return state
