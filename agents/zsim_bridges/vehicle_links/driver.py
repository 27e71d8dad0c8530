"""The driver process: presents an aircraft at the other end of a link as one drone of a run.

The session with the aircraft and the failsafe, which perform no I/O, are in other modules; this one has the drone's
messages and keys, the sockets, the event loop, and the command-line options.
"""

import asyncio
import contextlib
import errno
import math
import re
import socket
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from zsim.contract import flight_messages, keys, messages
from zsim.contract.flight_messages import Connection
from zsim.contract.messages import Info
from zsim.contract.run_messages import RUN_ENDED, ControlAnswer
from zsim.errors import DecodeError, RunError
from zsim.math.rotation import Vector
from zsim.runtime.participant import Participant
from zsim.scenario import scenario_file
from zsim.scenario.roles import DRIVER
from zsim.scenario.scenario import Drone, Scenario
from zsim.sensors.sensor_catalogue import STOCK
from zsim.transport.session import Query, RawSample, Session
from zsim.vehicles.vehicle import ROTORS_MIN
from zsim_bridges.vehicle_links.vehicle_session import (
    LINK_LOST_S,
    MOTORS_OFF_STATES,
    ZERO_VECTOR,
    AircraftState,
    ClockOffset,
    Failsafe,
    FlightLimits,
    Reading,
    UdpChannel,
    VehicleSession,
)

_SEPARATOR = re.compile(r"\s*,\s*")
_HOST = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9.-]*[A-Za-z0-9])?")  # a host name or an IPv4 address


class DriverOptions(NamedTuple):
    """Options of one driver.

    Attributes:
        drone: the drone of the run that the aircraft represents.
        origin_m: origin of the aircraft's own frame, or its initial position [m; W]; None for the one that the aircraft
            reports or the scenario states.
        yaw_deg: the aircraft's heading at the start, counter-clockwise from east; None to use its compass.
    """

    drone: str
    limits: FlightLimits = FlightLimits()
    armed: bool = False
    origin_m: Vector | None = None
    yaw_deg: float | None = None


TICK_S = 0.01  # s, wall; at most half of the period at which setpoints are repeated
REPORT_S = 1.0  # s, wall; period of reports on the link
LANDING_S = 30.0  # s, wall; time to wait for the aircraft to land before exiting
PATIENCE_S = 5.0  # s, wall; silence after which possible causes are printed: five heartbeat periods
PORT_WAIT_S = 2.0  # s, wall; time to wait for a port; ample, since a replaced driver keeps its port for about 10 ms
PORT_RETRY_S = 0.02  # s, wall; pause between attempts to open a port
READINGS_MAX = 4000  # readings, 10 s of a 200 Hz IMU and all other sensors; beyond this, the oldest are dropped
EXTRAPOLATION_MAX_NS = 500_000_000  # maximum time over which a pose is extrapolated: half of LINK_LOST_S
Say = Callable[[str], None]
SessionMaker = Callable[[Info, Scenario, DriverOptions], VehicleSession]


def drive(
    link: Session,
    info: Info,
    observer: Participant,
    stopped: Callable[[], bool],
    say: Say,
    options: DriverOptions,
    make_session: SessionMaker,
) -> None:
    """Run the driver of one aircraft until the run is over, or `stopped` returns True.

    Raises:
        RunError: the drone is not external, this process has another name, or the run does not follow the wall clock.
    """
    check_run(info, observer.name, options.drone)
    session = make_session(info, scenario_file.from_text(info.scenario), options)
    asyncio.run(DriverProcess(link, info, observer, options, session, say).run(stopped))


class DriverProcess:
    """Drives one aircraft in one run."""

    def __init__(
        self,
        link: Session,
        info: Info,
        observer: Participant,
        options: DriverOptions,
        session: VehicleSession,
        say: Say,
    ) -> None:
        self._link, self._observer, self._session = link, observer, session
        self._say_line = say
        self._drone = options.drone
        self._clock = DriverClock(info.rate or 1.0)
        scenario = scenario_file.from_text(info.scenario)
        self._failsafe = Failsafe(scenario.silence, options.limits, options.armed)
        rotors = next(len(drone.rotors) for drone in info.drones if drone.name == options.drone) or ROTORS_MIN
        hover_rad_s = hover_speed(scenario.drone(options.drone), rotors, scenario.environment.gravity_m_s2)
        self._external = ExternalDrone(options.drone, self._clock.to_simulated, (hover_rad_s,) * rotors)
        self._sockets = [AircraftSocket(partial(self._receive, number)) for number in range(len(session.channels))]
        self._reported_s = 0.0
        self._reported: tuple[Connection, str, str] | None = None
        self._report_seq = self._ignored = 0
        self._has_clock = False  # before the first clock, messages cannot be timestamped
        self._hint_s = time.monotonic() + PATIENCE_S

    async def run(self, stopped: Callable[[], bool]) -> None:
        """Exchange messages until the run is over or a stop is requested; then land."""
        loop = asyncio.get_running_loop()

        def in_loop(handle: Callable[[Any], None], value: Any) -> None:
            with contextlib.suppress(RuntimeError):  # raised if the loop is closed
                loop.call_soon_threadsafe(handle, value)

        try:
            for socket, channel in zip(self._sockets, self._session.channels, strict=True):
                await socket.open(channel)
            self._link.declare_subscriber(keys.CLOCK, partial(in_loop, self._on_clock))
            self._link.declare_subscriber(keys.accepted(self._drone, "*"), partial(in_loop, self._on_accepted))
            self._link.declare_queryable(keys.driver(self._drone), partial(in_loop, self._on_request))
            while not (stopped() or self._observer.end_reason):
                self._tick()
                await asyncio.sleep(TICK_S)
            await self._land_and_leave(stopped())
        finally:
            for socket in self._sockets:
                socket.close()

    def _say(self, text: str) -> None:
        self._say_line(f"{self._observer.name}: {text}")

    # From the run and the aircraft

    def _receive(self, channel: int, datagram: bytes) -> None:
        self._session.receive(channel, datagram, self._clock.now_ns())
        self._external.readings.extend(self._session.readings.take())

    def _on_clock(self, sample: RawSample) -> None:
        """Publish the aircraft's messages for the gate that the world has reached."""
        clock = self._observer.update_clock(sample.payload)
        self._has_clock = self._has_clock or clock is not None
        if clock is None or clock.state != "running":
            return
        now_ns = self._clock.now_ns()
        self._clock.on_gate(clock.t_ns)
        self._failsafe.on_clock(now_ns)
        vehicle = self._session.state
        if self._failsafe.phase == "killed":
            vehicle = vehicle._replace(state="emergency")
        if vehicle.received_ns is not None and now_ns - vehicle.received_ns < LINK_LOST_S * 1e9:
            for key, message in self._external.gate(clock.t_ns, vehicle, self._failsafe.commander):
                self._link.put(key, message)

    def _on_accepted(self, sample: RawSample) -> None:
        try:
            command = messages.decode(sample.key, sample.payload)
        except DecodeError:
            self._observer.health.refused += 1
            return
        refusal = self._failsafe.on_command(command, self._clock.now_ns(), self._session.state)
        if refusal is None:
            self._send()
            return
        self._observer.health.refused += 1
        self._ignored += 1
        if self._ignored == 1 or isinstance(command, flight_messages.Mode):
            self._say(f"{keys.leaf(sample.key)} from {command.source} is not obeyed: {refusal}")

    def _on_request(self, query: Query) -> None:
        now_ns = self._clock.now_ns()
        try:
            request = query.request()
        except DecodeError as error:
            self._observer.health.refused += 1
            query.answer(ControlAnswer(False, str(error)))
            return
        source, error = request.source or "somebody", None
        match request.op:
            case "arm":
                error = self._failsafe.arm(now_ns, self._session.state)
            case "disarm":
                error = self._failsafe.disarm(self._session.state)
            case "kill":
                self._failsafe.kill(now_ns, source)
            case op:
                error = f"op is {op[:40]!r}; must be one of arm, disarm, kill"
        query.answer(ControlAnswer(error is None, error or ""))
        self._say(f"{source} requests {request.op}: {error or 'done'}")
        self._send()
        self._report(now_ns)

    # To the aircraft and the run

    def _tick(self) -> None:
        self._send()
        self._observer.tick()
        for text in self._session.texts:
            self._say(text)
        self._session.texts.clear()
        if time.monotonic() >= self._hint_s:
            self._hint_s = math.inf
            self._hint()
        is_due = time.monotonic() - self._reported_s > REPORT_S or self._reported != self._current_report()
        if is_due and self._has_clock:
            self._report(self._clock.now_ns())

    def _hint(self) -> None:
        """Print possible causes if nothing has been received from the aircraft."""
        if self._session.state.received_ns is None:
            channel, refused_count = self._session.channels[0], self._session.link_quality().refused
            silence = self._sockets[0].fault.lower() or "nothing arrives"
            cause = f"{refused_count} messages arrived, but were not accepted" if refused_count else silence
            advice = "check its address, that it is switched on, and, over MAVLink, its system id and key"
            self._say(f"no aircraft at {channel.host}:{channel.port} ({cause}); {advice}")

    def _send(self) -> None:
        now_ns = self._clock.now_ns()
        demand = self._failsafe.demand(now_ns, self._session.state)
        for channel, datagram in self._session.advance(now_ns, demand):
            self._sockets[channel].send(datagram)

    def _current_report(self) -> tuple[Connection, str, str]:
        received_ns, now_ns = self._session.state.received_ns, self._clock.now_ns()
        state: Connection = "armed" if self._failsafe.armed else "connected"
        if received_ns is None:
            state = "waiting"
        elif now_ns - received_ns > LINK_LOST_S * 1e9:
            state = "lost"
        return state, self._failsafe.phase, self._failsafe.reason

    def _report(self, now_ns: int) -> None:
        """Publish the state of the link, and print its changes."""
        state, phase, reason = now = self._current_report()
        if now != self._reported:
            self._say(f"link {state}, {phase}{f' ({reason})' if reason else ''}")
        self._reported, self._reported_s = now, time.monotonic()
        quality = self._session.link_quality()
        received_ns, channel = self._session.state.received_ns, self._session.channels[0]
        message = flight_messages.LinkState(
            t_ns=self._observer.now_ns,
            seq=self._report_seq,
            source=self._observer.name,
            peer=f"{channel.host}:{channel.port}",
            state=state,
            age_ms=None if received_ns is None else (now_ns - received_ns) / 1e6,
            loss_percent=quality.loss_percent,
            round_trip_ms=quality.round_trip_ms,
            clock_offset_ms=quality.clock_offset_ms,
            refused=quality.refused,
        )
        self._report_seq += 1
        self._link.put(keys.link(self._drone), message)

    async def _land_and_leave(self, is_interrupted: bool) -> None:
        """Land an aircraft that this driver still flies, or finish a kill; leave both to a driver that replaces it."""
        if self._observer.superseded:
            return
        reason = "its driver is stopped" if is_interrupted else self._observer.end_reason or RUN_ENDED
        if not is_interrupted:
            self._observer.leave(reason)  # the run is over; the aircraft may still be descending
        self._failsafe.land(reason, self._clock.now_ns())
        deadline_s = time.monotonic() + LANDING_S
        if self._failsafe.phase == "landing":
            self._say(f"{reason}; the aircraft lands; a second Ctrl-C exits without waiting")
        while (is_stopping := self._failsafe.is_stopping(self._session.state)) and time.monotonic() < deadline_s:
            self._tick()
            await asyncio.sleep(TICK_S)
        if is_stopping:
            state = self._session.state.state
            self._say(f"the aircraft is still {state} after {LANDING_S:g} s; take control by hand")


class DriverClock:
    """The driver's clock, which runs at the run's rate, and its conversion to simulated time."""

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._offset = ClockOffset()

    def now_ns(self) -> int:
        return round(time.monotonic_ns() * self._rate)

    def on_gate(self, t_ns: int) -> None:
        self._offset.add(t_ns, self.now_ns())

    def to_simulated(self, now_ns: int) -> int:
        return self._offset.to_remote(now_ns)


class ExternalDrone:
    """Converts an aircraft's readings to the messages of one drone, gate by gate. No I/O.

    Args:
        to_simulated: converts a time of this process's clock to simulated time.
        hover_rad_s: speed of each rotor when hovering, published in flight because no wire protocol reports rotor
            speeds and other drones fly in the downwash.

    Attributes:
        readings: readings for the next gate, appended by the caller.
    """

    def __init__(
        self, drone: str, to_simulated: Callable[[int], int], hover_rad_s: tuple[float, ...] = (0.0,) * 4
    ) -> None:
        self._hover_rad_s = hover_rad_s
        self._drone = drone
        self._to_simulated = to_simulated
        self.readings: deque[Reading] = deque(maxlen=READINGS_MAX)
        self._seq: dict[str, int] = {}
        self._gate_ns = -1

    def gate(self, t_ns: int, vehicle: AircraftState, commander: str | None) -> list[tuple[str, Any]]:
        """Return the keys and messages of a gate in order: samples by time, truth, status; nothing for an old gate."""
        if t_ns <= self._gate_ns or vehicle.pose is None:
            return []
        self._gate_ns = t_ns
        outputs: list[tuple[str, Any]] = []
        timed_readings = [(min(t_ns, self._to_simulated(reading.taken_ns)), reading) for reading in self.readings]
        self.readings.clear()
        for sample_ns, reading in sorted(timed_readings, key=lambda entry: entry[0]):  # none is later than the gate
            key = keys.sensor(self._drone, reading.sensor)
            message = STOCK[reading.sensor].message
            outputs.append((key, message(t_ns, self._next(key), max(0, sample_ns), *reading.values)))
        pose = vehicle.pose
        age_ns = max(0, min(EXTRAPOLATION_MAX_NS, t_ns - self._to_simulated(pose.taken_ns)))
        x, y, z = (p + age_ns * 1e-9 * v for p, v in zip(pose.position_m, pose.velocity_m_s, strict=True))
        rotors = (0.0,) * len(self._hover_rad_s) if vehicle.state in MOTORS_OFF_STATES else self._hover_rad_s
        motion = ((x, y, z), pose.velocity_m_s, pose.q_WB, pose.w_WB_B, ZERO_VECTOR, rotors)
        key = keys.truth(self._drone)
        outputs.append((key, flight_messages.Truth(t_ns, self._next(key), *motion)))
        key = keys.status(self._drone)
        status = (vehicle.state, vehicle.battery_percent, False, commander, len(outputs))
        outputs.append((key, flight_messages.Status(t_ns, self._next(key), *status)))
        return outputs

    def _next(self, key: str) -> int:
        self._seq[key] = self._seq.get(key, -1) + 1
        return self._seq[key]


def hover_speed(drone: Drone, rotors: int, gravity_m_s2: float) -> float:
    """Return the speed [rad/s] at which each of `rotors` rotors carries an equal share of the drone's weight."""
    return math.sqrt(drone.mass_kg * gravity_m_s2 / (rotors * drone.thrust_n_s2))


class AircraftSocket(asyncio.DatagramProtocol):
    """A UDP socket to one port of the aircraft.

    Attributes:
        fault: why the newest datagram could not be delivered, for instance because nobody listens; empty otherwise.
    """

    def __init__(self, receive: Callable[[bytes], None]) -> None:
        self._receive = receive
        self._transport: asyncio.DatagramTransport | None = None
        self.fault = ""

    async def open(self, channel: UdpChannel) -> None:
        """Open the socket.

        Raises:
            RunError: the local port is taken, or the aircraft's address cannot be reached.
        """
        local = ("0.0.0.0", channel.local_port) if channel.local_port else None
        deadline_s = time.monotonic() + PORT_WAIT_S
        loop = asyncio.get_running_loop()
        while self._transport is None:
            try:
                remote = channel.host, channel.port
                self._transport, _ = await loop.create_datagram_endpoint(
                    lambda: self, remote_addr=remote, local_addr=local
                )
            except OSError as error:
                if error.errno == errno.EADDRINUSE and time.monotonic() <= deadline_s:
                    await asyncio.sleep(PORT_RETRY_S)
                    continue
                reason = error.strerror or str(error)
                if error.errno in (errno.EADDRINUSE, errno.EACCES):
                    advice = "give another --local-port, or end the program that uses it"
                    raise RunError(f"UDP port {channel.local_port} cannot be opened: {reason}; {advice}") from error
                advice = "give the address of the aircraft"
                raise RunError(f"{channel.host}:{channel.port} cannot be reached: {reason}; {advice}") from error

    def send(self, datagram: bytes) -> None:
        if self._transport is not None:
            self._transport.sendto(datagram)

    def close(self) -> None:
        if self._transport is not None:
            self._transport.close()

    def datagram_received(self, data: bytes, addr: Any) -> None:
        self._receive(data)

    def error_received(self, exc: Exception) -> None:
        """Record why a datagram was not delivered, usually because nobody listens yet; sessions repeat messages."""
        self.fault = getattr(exc, "strerror", None) or str(exc)


def udp_channel(address: str, local_port: int = 0) -> UdpChannel:
    """Return the channel of an address `udp://HOST:PORT`.

    Raises:
        RunError: the address has another form.
    """
    try:
        parts = urlsplit(address)
        port = parts.port
    except ValueError:
        parts, port = urlsplit(""), None
    if parts.scheme != "udp" or not parts.hostname or not port:
        raise RunError(f"the address is {address!r}; must be udp://HOST:PORT, such as udp://192.168.1.20:14580")
    return UdpChannel(parts.hostname, port, local_port)


def position(text: str) -> Vector:
    """Return the position written as `X,Y,Z`.

    Raises:
        RunError: the text has another form.
    """
    try:
        x, y, z = map(float, _SEPARATOR.split(text.strip()))
    except ValueError:
        x = y = z = math.nan
    if not all(map(math.isfinite, (x, y, z))):
        raise RunError(f"--origin is {text!r}; must be X,Y,Z in metres, such as 0,0,0")
    return x, y, z


def aircraft_host(text: str) -> str:
    """Return the host that a text names, for an aircraft with fixed ports.

    Raises:
        RunError: the text is not just a host.
    """
    if not _HOST.fullmatch(text):
        raise RunError(f"the address is {text!r}; must be that of a host, such as 192.168.1.12: the ports are fixed")
    return text


def check_host(host: str) -> None:
    """Refuse an unknown host before this driver replaces another in flight.

    Raises:
        RunError: the host is unknown.
    """
    try:
        socket.getaddrinfo(host, None)
    except (OSError, UnicodeError) as error:
        raise RunError(
            f"the host {host!r} of the address is unknown; give a name that this machine resolves, or an IP address"
        ) from error


def check_run(info: Info, process: str, drone: str) -> None:
    """Check that a process can drive a drone of a run.

    Raises:
        RunError: the drone is not external, the process has another name, or the run does not follow the wall clock.
    """
    bodies = {each.name: each.body for each in info.drones}
    if drone not in bodies:
        raise RunError(f"{process}: drone is {drone!r}; must be one of {', '.join(bodies)}")
    if bodies[drone] != "external":
        raise RunError(f"{process}: {drone} is simulated; a driver needs `body: external` for it in the scenario")
    if info.mode != "realtime":
        raise RunError(f"{process}: the run is in lockstep; a driver needs one that is started with --realtime")
    if process != f"{DRIVER}.{drone}":
        requirement = f"must be {DRIVER}.{drone}; give the certificate of that process"
        raise RunError(f"{process}: the name of the driver of {drone} {requirement}")
