"""The session with one MAVLink vehicle: it is asked for telemetry, followed, and made to do what is demanded. Pure.

Source: https://mavlink.io/en/services/ (heartbeat, command, timesync, message intervals).
"""

import time
from collections.abc import Callable, Iterator
from typing import Any

from zsim.math.rotation import Vector
from zsim_bridges.mavlink.drive.autopilot_modes import ARDUPILOT, CONTROL, PX4
from zsim_bridges.mavlink.drive.autopilot_state import CLIMBED, AutopilotState
from zsim_bridges.mavlink.drive.demand_sequence import DemandSequence
from zsim_bridges.mavlink.drive.telemetry_readings import TelemetryReadings
from zsim_bridges.mavlink.wire import dialect
from zsim_bridges.mavlink.wire.frame import Link, Parser, Received
from zsim_bridges.mavlink.wire.signing import Signing
from zsim_bridges.mavlink.wire.wire_message import LAYOUTS
from zsim_bridges.vehicle_links.aircraft_state import AircraftState, Reading
from zsim_bridges.vehicle_links.failsafe import Action, Demand
from zsim_bridges.vehicle_links.stream_loss import StreamLoss
from zsim_bridges.vehicle_links.vehicle_session import LinkFigures, UdpChannel

SYSTEM, COMPONENT = 245, 191  # of this driver; MAV_COMP_ID_ONBOARD_COMPUTER
ONBOARD_CONTROLLER, NO_AUTOPILOT, ACTIVE = 18, 8, 4  # MAV_TYPE, MAV_AUTOPILOT_INVALID, MAV_STATE
HEARTBEAT_NS = 1_000_000_000  # https://mavlink.io/en/services/heartbeat.html
TIMESYNC_NS = 500_000_000  # chosen: ten round trips in the window of a clock's offset
REQUEST_NS = 3_000_000_000  # chosen: after which a stream that does not come is asked for again
SET_INTERVAL, REQUEST_MESSAGE = 511, 512  # MAV_CMD
_RATES_HZ: dict[type, float] = {
    dialect.AttitudeQuaternion: 50,
    dialect.LocalPositionNed: 50,
    dialect.GpsRawInt: 5,
    dialect.GlobalPositionInt: 5,
    dialect.OpticalFlow: 15,
    dialect.DistanceSensor: 25,
    dialect.ExtendedSysState: 10,
    dialect.SysStatus: 1,
}
RATES_HZ = {  # by MAV_AUTOPILOT; ArduPilot has no HIGHRES_IMU
    PX4: {**_RATES_HZ, dialect.HighresImu: 200.0},
    ARDUPILOT: {**_RATES_HZ, dialect.ScaledImu: 200.0, dialect.ScaledPressure: 25.0},
}
OTHERS_MAX = 256  # systems that are reported, each once


class AutopilotSession:
    """Of one vehicle.

    Args:
        channel: its UDP port.
        origin: of W: latitude, longitude [deg], height [m].
        takeoff_height_m: over the ground.
        system: its system id; 0 for the first autopilot that shows itself.
        local_origin_m: where its local frame begins [m; W], None: as it says.
        key: of signatures, both ways; None for none.
        unix_s: wall time since 1970, which signatures carry.

    Attributes:
        channels, texts: see `VehicleSession`.
    """

    def __init__(
        self,
        channel: UdpChannel,
        origin: tuple[float, float, float],
        takeoff_height_m: float,
        system: int = 0,
        local_origin_m: Vector | None = None,
        key: bytes | None = None,
        unix_s: Callable[[], float] = time.time,
    ) -> None:
        self.channels: tuple[UdpChannel, ...] = (channel,)
        self.texts: list[str] = []
        self._system = system
        self._takeoff_height_m = takeoff_height_m
        self._telemetry = TelemetryReadings(origin, local_origin_m)
        self._sequence = DemandSequence(takeoff_height_m)
        self._signing = Signing(key) if key else None
        self._unix_s = unix_s
        self._link, self._parser = Link(SYSTEM, COMPONENT, self._signing), Parser(self._signing)
        self._autopilot: AutopilotState | None = None
        self._loss = StreamLoss(256)
        self._received_ns: int | None = None
        self._newest_ns: dict[type, int] = {}
        self._requested_ns: dict[type, int] = {}
        self._heartbeat_ns = self._timesync_ns = -HEARTBEAT_NS
        self._strangers: set[tuple[int, int]] = set()
        self._refused = 0
        self._ground_m: float | None = None
        self._action: Action = "none"
        self._taken_over = False
        self._answers: list[Any] = []

    # What arrives

    def receive(self, channel: int, datagram: bytes, now_ns: int) -> None:
        """Take a datagram of the vehicle."""
        for received in self._parser.feed(datagram):
            if self._is_vehicle(received):
                self._loss.add(received.seq)
                self._received_ns = now_ns
                self._newest_ns[type(received.message)] = now_ns
                self._take(received.message, now_ns)

    def _is_vehicle(self, received: Received) -> bool:
        """Tell whether a message is of the vehicle; the first heartbeat of an autopilot decides who that is."""
        address = received.system_id, received.component_id
        if self._autopilot is not None and address == self._autopilot.address:
            return True
        message = received.message
        wanted = self._autopilot is None and self._system in (0, received.system_id)
        if wanted and isinstance(message, dialect.Heartbeat) and message.autopilot in CONTROL:
            self._autopilot = AutopilotState(*address, message.autopilot)
            return True
        system = self._autopilot.address[0] if self._autopilot else self._system
        if system not in (0, received.system_id):
            self._refused += 1
            if address not in self._strangers and len(self._strangers) < OTHERS_MAX:
                self._strangers.add(address)
                self.texts.append(f"messages of system {address[0]}, component {address[1]}, are not read")
        return False

    def _take(self, message: Any, now_ns: int) -> None:
        assert self._autopilot is not None
        match message:
            case dialect.Timesync():
                self._on_timesync(message, now_ns)
            case dialect.Statustext():
                self.texts.append(f"the vehicle reports: {message.text}")
            case dialect.CommandAck() if message.result not in (0, 5):  # accepted, in progress
                self.texts.append(f"the vehicle answers command {message.command} with MAV_RESULT {message.result}")
            case _:
                self._autopilot.receive(message)
                self._telemetry.receive(message, now_ns)
                self._report_mode(self._autopilot)

    def _report_mode(self, autopilot: AutopilotState) -> None:
        """Print when somebody else takes the vehicle over in the air, and when it is given back."""
        control, lands = CONTROL[autopilot.autopilot], self._action == "land"
        taken_over = autopilot.is_flying and control.is_taken_over(autopilot.custom_mode, lands)
        if taken_over != self._taken_over:
            self._taken_over = taken_over
            what = "somebody else has control" if taken_over else "it is given back"
            self.texts.append(f"{what} (mode {autopilot.custom_mode:#x})")

    def _on_timesync(self, message: Any, now_ns: int) -> None:
        """Answer a question for the time here; take the answer to ours."""
        if message.tc1 == 0:
            self._answers = [dialect.Timesync(tc1=now_ns, ts1=message.ts1)]
        elif 0 <= now_ns - message.ts1 < HEARTBEAT_NS:
            self._telemetry.add_round_trip(now_ns - message.ts1, now_ns)

    # What goes out

    def advance(self, now_ns: int, demand: Demand) -> Iterator[tuple[int, bytes]]:
        """Yield the datagrams that are due."""
        self._action = demand.action
        for message in self._messages(now_ns, demand):
            yield 0, self._link.pack(message)

    def _messages(self, now_ns: int, demand: Demand) -> Iterator[Any]:
        yield from self._answers
        self._answers = []
        if now_ns - self._heartbeat_ns >= HEARTBEAT_NS:
            self._heartbeat_ns = now_ns
            if self._signing:
                self._signing.advance(self._unix_s())
            yield dialect.Heartbeat(ONBOARD_CONTROLLER, NO_AUTOPILOT, 0, 0, ACTIVE, 3)
        autopilot = self._autopilot
        if autopilot is None:
            return
        if now_ns - self._timesync_ns >= TIMESYNC_NS:
            self._timesync_ns = now_ns
            yield dialect.Timesync(tc1=0, ts1=now_ns)
        yield from self._requests(now_ns, autopilot)
        yield from self._sequence.advance(now_ns, demand, autopilot, CONTROL[autopilot.autopilot])

    def _requests(self, now_ns: int, autopilot: AutopilotState) -> Iterator[Any]:
        """Yield the requests for what is needed and does not come."""
        for kind, rate_hz in RATES_HZ[autopilot.autopilot].items():
            silent_ns = now_ns - max(self._newest_ns.get(kind, 0), self._requested_ns.get(kind, 0))
            if silent_ns > REQUEST_NS:
                self._requested_ns[kind] = now_ns
                yield autopilot.command(SET_INTERVAL, LAYOUTS[kind].id, 1e6 / rate_hz)
        kind = dialect.GpsGlobalOrigin
        if not self._telemetry.has_origin and now_ns - self._requested_ns.get(kind, 0) > REQUEST_NS:
            self._requested_ns[kind] = now_ns
            yield autopilot.command(REQUEST_MESSAGE, LAYOUTS[kind].id)

    # What is known

    @property
    def state(self) -> AircraftState:
        """What is known of the vehicle."""
        if self._autopilot is None:
            return AircraftState(received_ns=self._received_ns)
        pose, battery = self._telemetry.pose, self._telemetry.battery_percent
        return AircraftState(
            self._autopilot.state(self._action == "fly", self._climbed()), battery, pose, self._received_ns
        )

    def _climbed(self) -> bool:
        """Tell whether the vehicle has reached the height of its take-off since it stood on the ground last."""
        pose, autopilot = self._telemetry.pose, self._autopilot
        if pose is None or autopilot is None:
            return False
        height_m = pose.position_m[2]
        if not autopilot.armed:
            self._ground_m = height_m
        if self._ground_m is None:
            return True  # it was in the air when this driver began
        if height_m - self._ground_m >= CLIMBED * self._takeoff_height_m:
            self._ground_m = None
        return self._ground_m is None

    def take_readings(self) -> list[Reading]:
        """Return what has been measured since the last call."""
        readings, self._telemetry.readings = self._telemetry.readings, []
        return readings

    def figures(self, now_ns: int) -> LinkFigures:
        """Return how good the link is."""
        clock = self._telemetry.boot_clock
        refused = self._refused + sum(self._parser.refused.values())
        return LinkFigures(self._loss.percent, clock.round_trip_ms, clock.ahead_ms, refused)
