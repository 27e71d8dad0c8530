"""The driver as a process: an aircraft at the other end of a wire is one drone of a run.

The wire's session, the failsafe and what becomes of readings are pure and stand in files of their own; here are
keys and the event loop.
"""

import asyncio
import contextlib
import math
import time
from collections.abc import Callable
from functools import partial

from zsim.contract import flight_messages, keys, messages
from zsim.contract.flight_messages import Connection
from zsim.contract.messages import Info
from zsim.contract.run_messages import RUN_ENDED, ControlAnswer
from zsim.errors import DecodeError
from zsim.runtime.participant import Participant
from zsim.scenario import scenario_file
from zsim.transport.session import Query, RawSample, Session
from zsim.vehicles.vehicle import ROTORS_MIN
from zsim_bridges.vehicle_links.aircraft_socket import AircraftSocket
from zsim_bridges.vehicle_links.aircraft_state import AircraftState
from zsim_bridges.vehicle_links.clock_offset import DriverClock
from zsim_bridges.vehicle_links.driver_options import DriverOptions
from zsim_bridges.vehicle_links.external_drone import ExternalDrone, hover_speed
from zsim_bridges.vehicle_links.failsafe import LINK_LOST_S, Failsafe
from zsim_bridges.vehicle_links.vehicle_session import LinkFigures, VehicleSession

TICK_S = 0.01  # s, wall; half of the period at which setpoints are repeated
REPORT_S = 1.0  # s, wall; of the link's figures
LANDING_S = 30.0  # s, wall; how long it waits for the aircraft to be down before it leaves
PATIENCE_S = 5.0  # s, wall, chosen: heartbeats come once a second; then it prints what may be amiss
Say = Callable[[str], None]


class DriverProcess:
    """One aircraft in one run.

    Args:
        link: an open session.
        info: of the run.
        observer: of this process in it.
        options: what it is given.
        session: with the aircraft.
        say: prints a line.
    """

    def __init__(
        self,
        link: Session,
        info: Info,
        observer: Participant,
        options: DriverOptions,
        session: VehicleSession,
        say: Say,
    ) -> None:
        self._link, self._observer, self._session, self._say = link, observer, session, say
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
        self._has_clock = False  # until it has, nothing can be stamped
        self._hint_s = time.monotonic() + PATIENCE_S

    async def run(self, stopped: Callable[[], bool]) -> None:
        """Carry messages both ways until the run is over or a stop is requested; then land."""
        try:
            for socket, channel in zip(self._sockets, self._session.channels, strict=True):
                await socket.open(channel)
            self._subscribe(asyncio.get_running_loop())
            while not (stopped() or self._observer.end_reason):
                self._tick()
                await asyncio.sleep(TICK_S)
            await self._land_and_leave(stopped())
        finally:
            for socket in self._sockets:
                socket.close()

    def _subscribe(self, loop: asyncio.AbstractEventLoop) -> None:
        def in_loop(handle: Callable[[str, bytes], None]) -> Callable[[RawSample], None]:
            def take(sample: RawSample) -> None:
                with contextlib.suppress(RuntimeError):  # the loop is closed
                    loop.call_soon_threadsafe(handle, sample.key, sample.payload)

            return take

        self._link.declare_subscriber(keys.CLOCK, in_loop(self._on_clock))
        self._link.declare_subscriber(keys.accepted(self._drone, "*"), in_loop(self._on_accepted))

        def on_query(query: Query) -> None:
            with contextlib.suppress(RuntimeError):
                loop.call_soon_threadsafe(self._on_request, query)

        self._link.declare_queryable(keys.driver(self._drone), on_query)

    # What arrives

    def _receive(self, channel: int, datagram: bytes) -> None:
        self._session.receive(channel, datagram, self._clock.now_ns())
        self._external.add(self._session.take_readings())

    def _on_clock(self, _: str, payload: bytes) -> None:
        """Publish the gate that the world has reached."""
        clock = self._observer.update_clock(payload)
        self._has_clock = self._has_clock or clock is not None
        if clock is None or clock.state != "running":
            return
        now_ns = self._clock.now_ns()
        self._clock.on_gate(clock.t_ns)
        self._failsafe.on_clock(now_ns)
        vehicle = self._vehicle()
        if vehicle.received_ns is not None and now_ns - vehicle.received_ns < LINK_LOST_S * 1e9:
            for key, message in self._external.gate(clock.t_ns, vehicle, self._failsafe.commander):
                self._link.put(key, message)

    def _vehicle(self) -> AircraftState:
        """Return what is known of the aircraft; one whose motors were stopped is in an emergency."""
        vehicle = self._session.state
        return vehicle._replace(state="emergency") if self._failsafe.phase == "killed" else vehicle

    def _on_accepted(self, key: str, payload: bytes) -> None:
        """Hand a command on at once."""
        try:
            command = messages.decode(key, payload)
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
            self._say(f"{self._observer.name}: {keys.leaf(key)} of {command.source} is not obeyed: {refusal}")

    def _on_request(self, query: Query) -> None:
        """Answer an operator."""
        now_ns = self._clock.now_ns()
        try:
            request = query.request()
        except DecodeError as error:
            self._observer.health.refused += 1
            query.answer(ControlAnswer(False, str(error)))
            return
        source = request.source or "somebody"
        error = self._operate(request.op, source, now_ns)
        query.answer(ControlAnswer(error is None, error or ""))
        self._say(f"{self._observer.name}: {source} asks {request.op}: {error or 'done'}")
        self._send()
        self._report(now_ns)

    def _operate(self, op: str, source: str, now_ns: int) -> str | None:
        """Do what an operator asks; return None, or why not."""
        match op:
            case "arm":
                return self._failsafe.arm(now_ns, self._session.state)
            case "disarm":
                return self._failsafe.disarm(self._session.state)
            case "kill":
                self._failsafe.kill(now_ns, source)
                return None
            case _:
                return f"op is {op[:40]!r}; must be one of arm, disarm, kill"

    # What goes out

    def _tick(self) -> None:
        self._send()
        self._observer.tick()
        for text in self._session.texts:
            self._say(f"{self._observer.name}: {text}")
        self._session.texts.clear()
        self._hint()
        is_due = time.monotonic() - self._reported_s > REPORT_S or self._reported != self._reported_now()
        if is_due and self._has_clock:
            self._report(self._clock.now_ns())

    def _hint(self) -> None:
        """Print once what may be amiss where an aircraft does not show itself."""
        if time.monotonic() < self._hint_s:
            return
        self._hint_s = math.inf
        if self._session.state.received_ns is None:
            channel, refused = self._session.channels[0], self._session.figures(self._clock.now_ns()).refused
            silence = self._sockets[0].fault.lower() or "nothing comes"
            what = f"{refused} messages came that are not its own" if refused else silence
            advice = "check its address, that it is switched on, and over MAVLink its system id and key"
            self._say(f"{self._observer.name}: no aircraft at {channel.host}:{channel.port} ({what}); {advice}")

    def _send(self) -> None:
        """Send the aircraft what is due."""
        now_ns = self._clock.now_ns()
        demand = self._failsafe.demand(now_ns, self._session.state)
        for channel, datagram in self._session.advance(now_ns, demand):
            self._sockets[channel].send(datagram)

    def _reported_now(self) -> tuple[Connection, str, str]:
        return self._link_state(self._clock.now_ns()), self._failsafe.phase, self._failsafe.reason

    def _link_state(self, now_ns: int) -> Connection:
        received_ns = self._session.state.received_ns
        if received_ns is None:
            return "waiting"
        if now_ns - received_ns > LINK_LOST_S * 1e9:
            return "lost"
        return "armed" if self._failsafe.armed else "connected"

    def _report(self, now_ns: int) -> None:
        """Publish the state of the link; print its changes."""
        state, phase, reason = now = self._reported_now()
        if now != self._reported:
            self._say(f"{self._observer.name}: link {state}, {phase}{f' ({reason})' if reason else ''}")
        self._reported, self._reported_s = now, time.monotonic()
        figures: LinkFigures = self._session.figures(now_ns)
        received_ns, channel = self._session.state.received_ns, self._session.channels[0]
        message = flight_messages.LinkState(
            t_ns=self._observer.now_ns,
            seq=self._report_seq,
            source=self._observer.name,
            peer=f"{channel.host}:{channel.port}",
            state=state,
            age_ms=None if received_ns is None else (now_ns - received_ns) / 1e6,
            loss_percent=figures.loss_percent,
            round_trip_ms=figures.round_trip_ms,
            clock_offset_ms=figures.clock_offset_ms,
            refused=figures.refused,
        )
        self._report_seq += 1
        self._link.put(keys.link(self._drone), message)

    async def _land_and_leave(self, interrupted: bool) -> None:
        """Land what still flies for this driver, or stop it where it is killed; another driver in its place has it."""
        if self._observer.superseded:
            return
        reason = "its driver is stopped" if interrupted else self._observer.end_reason or RUN_ENDED
        if not interrupted:
            self._observer.leave(reason)  # the run is over for everybody; the aircraft may still be on its way down
        self._failsafe.land(reason, self._clock.now_ns())
        until_s = time.monotonic() + LANDING_S
        if self._failsafe.phase == "landing":
            self._say(f"{self._observer.name}: {reason}; it lands; a second Ctrl-C leaves it to itself")
        while (stopping := self._failsafe.is_stopping(self._session.state)) and time.monotonic() < until_s:
            self._tick()
            await asyncio.sleep(TICK_S)
        if stopping:
            state = self._session.state.state
            self._say(f"{self._observer.name}: it is still {state} after {LANDING_S:g} s; take it over by hand")
