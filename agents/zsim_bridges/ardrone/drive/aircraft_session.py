"""The session with one AR.Drone 2.0: navdata is asked for, the aircraft set up, followed, and flown. Pure.

Source: AR.Drone Developer Guide SDK 2.0, chapters 6 to 8.
"""

from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

from zsim.contract.flight_messages import DroneState
from zsim_bridges.ardrone.drive.flight_commands import FlightCommands
from zsim_bridges.ardrone.drive.navdata_readings import DEMO, NavdataReadings
from zsim_bridges.ardrone.drive.tilt_control import TiltControl
from zsim_bridges.ardrone.wire import at_commands, navdata
from zsim_bridges.ardrone.wire.at_commands import Command, Config, Control, ResetWatchdog
from zsim_bridges.ardrone.wire.navdata import ControlState, Navdata, NavdataError, StateBit
from zsim_bridges.ardrone.wire.navdata_options import FULL_TAGS, GPS_TAG
from zsim_bridges.vehicle_links.aircraft_state import AircraftState, Reading
from zsim_bridges.vehicle_links.failsafe import Demand
from zsim_bridges.vehicle_links.stream_loss import StreamLoss
from zsim_bridges.vehicle_links.vehicle_session import LinkFigures, UdpChannel

NAVDATA, AT = 0, 1  # channels
REQUEST_NS = 100_000_000  # chosen as npm ar-drone: navdata is asked for again after as long
CONFIG_NS = 500_000_000  # chosen: an entry is sent again after as long without its acknowledgement
WATCHDOG_NS = 1_000_000_000  # half of the aircraft's com_watchdog
RESTARTED = 100  # packets, chosen: whose number falls back by more has been switched on again
STATES: dict[int, DroneState] = {
    ControlState.FLYING: "flying",
    ControlState.HOVERING: "hovering",
    ControlState.TAKING_OFF: "taking_off",
    ControlState.GO_TO_FIX: "flying",
    ControlState.LANDING: "landing",
    ControlState.LOOPING: "flying",
}
OPTIONS_MASK = sum(1 << tag for tag in (*FULL_TAGS, GPS_TAG))


class AircraftSettings(NamedTuple):
    """What its configuration is set to.

    Attributes:
        tilt_rad: euler_angle_max.
        climb_m_s, yaw_rate_rad_s: control_vz_max, control_yaw.
        altitude_m: altitude_max.
        ultrasound: ultrasound_freq of its sonar: 7 (22.2 Hz) or 8 (25 Hz).
    """

    tilt_rad: float = 0.35  # outdoor default of the SDK
    climb_m_s: float = 1.0  # likewise
    yaw_rate_rad_s: float = 1.75  # indoor default of the SDK
    altitude_m: float = 100.0  # no limit of its own: the driver's fence stands
    ultrasound: int = 8  # default of the SDK


class AircraftSession:
    """Of one aircraft.

    Args:
        host: its address.
        readings: what becomes of its navdata.
        settings: that it is given.
        ports: of navdata and AT commands.

    Attributes:
        channels, texts: see `VehicleSession`.
    """

    def __init__(
        self,
        host: str,
        readings: NavdataReadings,
        settings: AircraftSettings = AircraftSettings(),  # noqa: B008
        ports: tuple[int, int] = (navdata.PORT, at_commands.PORT),
    ) -> None:
        self.channels: tuple[UdpChannel, ...] = UdpChannel(host, ports[0]), UdpChannel(host, ports[1])
        self.texts: list[str] = []
        self._readings = readings
        self._commands = FlightCommands(TiltControl(settings.tilt_rad, settings.climb_m_s, settings.yaw_rate_rad_s))
        self._entries = _entries(settings)
        self._pending: deque[Config] = deque(self._entries)
        self._loss = StreamLoss(1 << 32)
        self._sequence = 0
        self._newest = 0
        self._bits = StateBit(0)
        self._state: DroneState = "landed"
        self._battery = 0.0
        self._received_ns: int | None = None
        self._requested_ns = self._config_ns = self._cleared_ns = self._watchdog_ns = -WATCHDOG_NS
        self._sent: Config | None = None  # that waits for its acknowledgement
        self._refused = 0

    # What arrives

    def receive(self, channel: int, datagram: bytes, now_ns: int) -> None:
        """Take a datagram of the aircraft."""
        if channel != NAVDATA:
            return
        try:
            packet = navdata.unpack(datagram)
        except NavdataError:
            self._refused += 1
            return
        if self._newest - RESTARTED < packet.sequence <= self._newest:
            return  # overtaken
        if packet.sequence < self._newest:
            self._loss.restart()
        self._newest = packet.sequence
        self._loss.add(packet.sequence)
        self._received_ns = now_ns
        self._take(packet, now_ns)

    def _take(self, packet: Navdata, now_ns: int) -> None:
        if StateBit.COM_LOST in packet.state and StateBit.COM_LOST not in self._bits:
            self.texts.append("the aircraft has lost our commands for a while")
        if packet.bootstrap and not self._pending:
            self._pending.extend(self._entries)  # it was switched on again
        self._bits = packet.state
        demo = packet.options.get(DEMO)
        if demo is not None:
            self._battery = float(min(100, demo.battery_percent))
            self._state = STATES.get(demo.ctrl_state >> 16, "landed")
        elif StateBit.FLYING not in packet.state:  # a bootstrap has no more: it was switched on again, say
            self._state = "landed"
        if StateBit.EMERGENCY in packet.state:
            self._state = "emergency"
        self._readings.receive(packet, now_ns)

    # What goes out

    def advance(self, now_ns: int, demand: Demand) -> Iterator[tuple[int, bytes]]:
        """Yield the datagrams that are due."""
        silent_ns = now_ns - max(self._received_ns or 0, self._requested_ns)
        if silent_ns >= REQUEST_NS:
            self._requested_ns = now_ns
            yield NAVDATA, navdata.REQUEST_UNICAST
        if commands := [*self._set_up(now_ns), *self._fly(now_ns, demand)]:
            yield AT, b"".join(map(self._numbered, commands))

    def _set_up(self, now_ns: int) -> Iterator[Command]:
        """Yield the next entry of the configuration; a bit acknowledges each, and is cleared before the next."""
        if self._received_ns is None:
            return
        acknowledged = StateBit.COMMAND_ACK in self._bits
        if now_ns - self._watchdog_ns >= WATCHDOG_NS:
            self._watchdog_ns = now_ns
            yield ResetWatchdog(0)
        if acknowledged and now_ns - self._cleared_ns >= REQUEST_NS:
            self._cleared_ns = now_ns
            if self._sent is not None:
                self._pending.popleft()
                self._sent = None
            yield Control(0, at_commands.ACKNOWLEDGE)
        elif not acknowledged and self._pending and (self._sent is None or now_ns - self._config_ns >= CONFIG_NS):
            self._config_ns, self._sent = now_ns, self._pending[0]
            yield self._pending[0]

    def _fly(self, now_ns: int, demand: Demand) -> Iterator[Command]:
        emergency = StateBit.EMERGENCY in self._bits
        yield from self._commands.advance(now_ns, demand, emergency, self._readings.pose)

    def _numbered(self, command: Command) -> bytes:
        self._sequence += 1
        return at_commands.format_command(command._replace(sequence=self._sequence))

    # What is known

    @property
    def state(self) -> AircraftState:
        """What is known of the aircraft."""
        return AircraftState(self._state, self._battery, self._readings.pose, self._received_ns)

    def take_readings(self) -> list[Reading]:
        """Return what has been measured since the last call."""
        taken, self._readings.readings = self._readings.readings, []
        return taken

    def figures(self, now_ns: int) -> LinkFigures:
        """Return how good the link is; the wire has nothing to measure a round trip with."""
        return LinkFigures(self._loss.percent, None, self._readings.clock.ahead_ms, self._refused)


def _entries(settings: AircraftSettings) -> list[Config]:
    """Return what is set: `outdoor` first, which brings limits of its own."""
    entries = {
        "general:navdata_demo": "FALSE",
        "general:navdata_options": str(OPTIONS_MASK),
        "control:outdoor": "TRUE",
        "control:euler_angle_max": f"{settings.tilt_rad:g}",
        "control:control_vz_max": f"{1e3 * settings.climb_m_s:g}",
        "control:control_yaw": f"{settings.yaw_rate_rad_s:g}",
        "control:altitude_max": f"{1e3 * settings.altitude_m:g}",
        "pic:ultrasound_freq": str(settings.ultrasound),
    }
    return [Config(0, key, value) for key, value in entries.items()]
