"""The driver process, with a fake session and a fake aircraft on a UDP port of loopback."""

import asyncio
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest
from fake_link import FakeLink
from in_loop import in_loop
from refused import has_terms

from zsim.contract import flight_messages, keys, messages
from zsim.contract.messages import DroneInfo, Info, Origin
from zsim.contract.run_messages import Clock, Event
from zsim.errors import RunError
from zsim.runtime.participant import Participant
from zsim.scenario import scenario_file
from zsim_bridges.vehicle_links import driver
from zsim_bridges.vehicle_links.driver import (
    AircraftSocket,
    DriverOptions,
    DriverProcess,
    ExternalDrone,
    aircraft_host,
    check_host,
    check_run,
    hover_speed,
    position,
    udp_channel,
)
from zsim_bridges.vehicle_links.vehicle_session import (
    AircraftPose,
    AircraftReadings,
    AircraftState,
    Demand,
    LinkQuality,
    Reading,
    UdpChannel,
    VehicleSession,
)

SCENARIO = """
name: one
duration_s: 10
sensors: {preset: paper}
drones: [{name: drone1, position_m: [0, 0, 0]}, {name: drone2, position_m: [3, 0, 0], body: external}]
"""
ME, GATE_NS = "driver.drone2", 20_000_000


def info(mode: Any = "realtime") -> Info:
    drones = DroneInfo("drone1", "ardrone2"), DroneInfo("drone2", "ardrone2", body="external")
    return Info(
        0, 0, 1, "r", "zsim", mode, 1.0, GATE_NS, 1, 1, 1, Origin(0.0, 0.0, 0.0), drones, (), SCENARIO, "", "", ""
    )


class Session(VehicleSession):
    """Sends the name of each demand, and takes each datagram as the aircraft's new state."""

    state: AircraftState = AircraftState()  # type: ignore[assignment]

    def __init__(self, port: int) -> None:
        super().__init__((UdpChannel("127.0.0.1", port),), AircraftReadings((0.0, 0.0, 0.0)), 256)

    def receive(self, channel: int, datagram: bytes, now_ns: int) -> None:
        self.state = AircraftState(datagram.decode(), 50.0, AircraftPose(now_ns, (1.0, 2.0, 3.0)), now_ns)  # type: ignore[arg-type]
        self.readings.readings.append(Reading("sonar", now_ns, (3.0, True)))

    def advance(self, now_ns: int, demand: Demand) -> Iterator[tuple[int, bytes]]:
        yield 0, demand.action.encode()

    def link_quality(self) -> LinkQuality:
        return LinkQuality(loss_percent=1.0)


class Aircraft(asyncio.DatagramProtocol):
    """Records the demands that it receives, and answers with its state."""

    def __init__(self) -> None:
        self.demands: list[str] = []
        self.state = "landed"
        self.news = asyncio.Event()

    def connection_made(self, transport: Any) -> None:
        self._transport = transport
        self.port = transport.get_extra_info("sockname")[1]

    def datagram_received(self, data: bytes, addr: Any) -> None:
        if self.demands[-1:] != [data.decode()]:
            self.demands.append(data.decode())
        self._transport.sendto(self.state.encode(), addr)
        self.news.set()

    async def next(self) -> None:
        """Wait for the next datagram."""
        self.news.clear()
        await asyncio.wait_for(self.news.wait(), 120)

    async def until(self, demand: str) -> None:
        while self.demands[-1:] != [demand]:
            await self.next()


class Flight:
    """A run whose clock the test advances, its driver, and the aircraft."""

    def __init__(self, armed: bool) -> None:
        self.link, self.lines, self.armed = FakeLink(), [], armed
        self.stop, self.t_ns = False, 0

    async def __aenter__(self) -> "Flight":
        loop = asyncio.get_running_loop()
        self._transport, self.aircraft = await loop.create_datagram_endpoint(Aircraft, local_addr=("127.0.0.1", 0))
        observer = Participant(self.link, info(), ME)  # type: ignore[arg-type]
        observer.announce()
        options = DriverOptions("drone2", armed=self.armed)
        link: Any = self.link
        process = DriverProcess(
            link,
            info(),
            observer,
            options,
            Session(self.aircraft.port),
            self.lines.append,  # type: ignore[arg-type]
        )
        self.task = loop.create_task(process.run(lambda: self.stop))
        await self.aircraft.until("none")
        assert self.links() == []  # without a clock there is nothing to publish
        self.link.deliver(keys.CLOCK, Clock(0, 0, "r", 1, "waiting", 1.0))
        return self

    async def __aexit__(self, *_: object) -> None:
        self.stop = True
        self.aircraft.state = "landed"
        await self.task
        self._transport.close()

    async def gate(self) -> None:
        """Let the world reach its next gate and the driver handle it."""
        self.t_ns += GATE_NS
        self.link.deliver(keys.CLOCK, Clock(self.t_ns, 0, "r", 1, "running", 1.0))
        await asyncio.sleep(0)

    def command(self, kind: str, message: Any) -> None:
        self.link.deliver(keys.accepted("drone2", kind), message)

    def links(self) -> list[str]:
        """Return the published states of the link."""
        return [report.state for report in self.link.published_on(keys.link("drone2"))]

    def take_off(self) -> None:
        self.command("mode", flight_messages.Mode(0, 0, "controller.main", "takeoff"))

    async def fly(self) -> None:
        """Put the aircraft in the air, where the driver makes it hold."""
        self.aircraft.state = "flying"
        await self.aircraft.until("hold")

    def ask(self, op: Any) -> Any:
        return self.link.ask(
            keys.driver("drone2"), msgspec.msgpack.encode({"op": op, "args": {}, "source": "operator"})
        )

    async def answered(self, op: Any) -> Any:
        query = self.ask(op)
        for _ in range(1000):
            await asyncio.sleep(0)
            if query.answered is not None:
                return query.answered
        return pytest.fail("no answer")


@in_loop
async def test_a_gate_is_published_when_the_world_reaches_it() -> None:
    async with Flight(armed=False) as flight:
        for _ in range(3):
            await flight.gate()
        statuses = flight.link.published_on(keys.status("drone2"))
        assert [status.t_ns for status in statuses] == [GATE_NS, 2 * GATE_NS, 3 * GATE_NS]
        assert {status.state for status in statuses} == {"landed"}
        assert flight.link.published_on(keys.sensor("drone2", "sonar"))
        while flight.links()[-1:] != ["connected"]:
            await flight.aircraft.next()
        assert flight.links() in (["connected"], ["waiting", "connected"])


@in_loop
async def test_an_armed_driver_flies_and_lands_the_aircraft_before_it_ends() -> None:
    async with Flight(armed=False) as flight:
        await flight.gate()
        flight.take_off()
        assert (await flight.answered("arm")).ok
        assert flight.aircraft.demands == ["none"]  # commands from before arming are discarded
        flight.take_off()
        await flight.aircraft.until("take_off")
        flight.aircraft.state = "hovering"
        await flight.aircraft.until("hold")
        velocity = flight_messages.Velocity(0, 0, "controller.main", (1.0, 0.0, 0.0), 0.0, "world")
        flight.command("velocity", velocity)
        await flight.aircraft.until("fly")
        assert not (await flight.answered("disarm")).ok
        flight.stop = True
        await flight.aircraft.until("land")
    assert any("lands" in line for line in flight.lines)
    assert sum("not obeyed" in line for line in flight.lines) == 1


@in_loop
async def test_kill_reaches_the_aircraft_at_once_and_is_shown() -> None:
    async with Flight(armed=True) as flight:
        await flight.fly()
        assert (await flight.answered("kill")).ok
        await flight.aircraft.until("kill")
        await flight.gate()
        assert flight.link.published_on(keys.status("drone2"))[-1].state == "emergency"


@in_loop
async def test_a_kill_continues_after_the_run_until_the_motors_stop() -> None:
    async with Flight(armed=True) as flight:
        await flight.fly()
        assert (await flight.answered("kill")).ok
        flight.stop = True
        for _ in range(20):
            await flight.aircraft.next()
        assert not flight.task.done()
        assert flight.aircraft.demands[-1] == "kill"
        flight.aircraft.state = "landed"
        await asyncio.wait_for(flight.task, 30)


@in_loop
async def test_an_aircraft_that_does_not_land_is_left_to_a_person(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "LANDING_S", 0.1)
    async with Flight(armed=True) as flight:
        await flight.fly()
        flight.aircraft.state, flight.stop = "landing", True
        await asyncio.wait_for(flight.task, 30)
        assert has_terms(flight.lines[-1], ME, "landing", "by hand")


@in_loop
async def test_a_silent_aircraft_is_reported_once_with_advice(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(driver, "PATIENCE_S", 0.0)
    link, lines = FakeLink(), []
    observer = Participant(link, info(), ME)  # type: ignore[arg-type]
    stopped = iter([False] * 30)
    args: Any = link, info(), observer, DriverOptions("drone2"), Session(9), lines.append
    await DriverProcess(*args).run(lambda: next(stopped, True))
    (hint,) = (line for line in lines if "127.0.0.1:9" in line)
    assert has_terms(hint, ME, "address")


@in_loop
async def test_a_new_driver_waits_for_the_port_of_its_predecessor() -> None:
    loop = asyncio.get_running_loop()
    former, _ = await loop.create_datagram_endpoint(asyncio.DatagramProtocol, local_addr=("0.0.0.0", 0))
    channel = UdpChannel("127.0.0.1", 9, former.get_extra_info("sockname")[1])
    own = AircraftSocket(print)
    opening = loop.create_task(own.open(channel))
    await asyncio.sleep(0)
    former.close()
    await asyncio.wait_for(opening, 30)
    own.close()


@pytest.mark.parametrize("taken", [True, False])
@in_loop
async def test_a_socket_that_cannot_be_opened_is_refused_with_advice(
    monkeypatch: pytest.MonkeyPatch, taken: bool
) -> None:
    monkeypatch.setattr(driver, "PORT_WAIT_S", 0.0)
    loop = asyncio.get_running_loop()
    other, _ = await loop.create_datagram_endpoint(asyncio.DatagramProtocol, local_addr=("0.0.0.0", 0))
    port = other.get_extra_info("sockname")[1] if taken else 0
    session = Session(9)
    session.channels = (UdpChannel("127.0.0.1" if taken else "nowhere.invalid", 9, port),)
    link = FakeLink()
    observer = Participant(link, info(), ME)  # type: ignore[arg-type]
    args: Any = link, info(), observer, DriverOptions("drone2"), session, print
    with pytest.raises(RunError, match=f"{port}.*--local-port" if taken else "nowhere.invalid.*address"):
        await DriverProcess(*args).run(lambda: True)
    other.close()


@in_loop
async def test_a_superseded_driver_does_not_land_the_aircraft() -> None:
    async with Flight(armed=True) as flight:
        await flight.fly()
        data = {"incarnation": 7, "host": flight.link.host, "pid": 1, "from_ns": 0}
        flight.link.deliver(keys.EVENT, Event(0, 0, "superseded", ME, ME, "", data))
        await asyncio.wait_for(flight.task, 30)
        assert flight.aircraft.demands[-1] == "hold"


BAD = {"an unknown op": ("fly", "arm, disarm, kill"), "no text": (7, "op")}


@pytest.mark.parametrize("name", BAD)
@in_loop
async def test_an_invalid_request_is_answered_with_the_reason(name: str) -> None:
    op, term = BAD[name]
    async with Flight(armed=False) as flight:
        answer = await flight.answered(op)
        assert not answer.ok
        assert term in answer.error
        flight.link.deliver(keys.accepted("drone2", "velocity"), b"garbage")
        assert (await flight.answered("arm")).ok


def test_a_drone_or_run_that_cannot_be_driven_is_refused():
    for drone, run, name, term in (
        ("ghost", info(), ME, "drone1, drone2"),
        ("drone1", info(), ME, "body: external"),
        ("drone2", info("lockstep"), ME, "--realtime"),
        ("drone2", info(), "driver.drone1", ME),
    ):
        with pytest.raises(RunError, match=term):
            check_run(run, name, drone)
    check_run(info(), ME, "drone2")


def test_addresses_and_positions_are_parsed_or_refused():
    assert udp_channel("udp://192.168.1.20:14580", 14540) == UdpChannel("192.168.1.20", 14580, 14540)
    assert position(" 1, -2.5,0") == (1.0, -2.5, 0.0)
    for bad in ("", "192.168.1.20", "tcp://a:1", "udp://a", "udp://:14540", "udp://a:x", "udp://a:99999"):
        with pytest.raises(RunError):
            udp_channel(bad)
    for bad in ("", "1,2", "1,2,x", "1 2 3", "nan,0,0", "0,inf,0"):
        with pytest.raises(RunError):
            position(bad)
    assert [aircraft_host(good) for good in ("192.168.1.12", "drone-2.local")] == ["192.168.1.12", "drone-2.local"]
    for bad in ("", "udp://192.168.1.12", "192.168.1.12:5556", "-a", "a b"):
        with pytest.raises(RunError):
            aircraft_host(bad)
    check_host("127.0.0.1")
    for bad in ("nowhere.invalid", "a..b"):
        with pytest.raises(RunError, match=bad):
            check_host(bad)


@in_loop
async def test_the_link_state_is_a_message_of_the_contract() -> None:
    async with Flight(armed=False) as flight:
        while not flight.links():
            await flight.aircraft.next()
        (first, *_) = flight.link.published_on(keys.link("drone2"))
        assert messages.decode(keys.link("drone2"), messages.encode(first)) == first
        assert (first.source, first.loss_percent, first.round_trip_ms) == (ME, 1.0, None)


def test_the_hover_speed_of_an_ardrone_matches_its_weight():
    drone = scenario_file.from_text(SCENARIO).drone("drone2")
    assert hover_speed(drone, 4, 9.80665) == pytest.approx(361.6, abs=0.5)  # rad/s, for 0.429 kg (Li, MSc thesis)


# Messages of a gate

MS = 1_000_000
BEGUN_NS = 5_000 * MS  # the start of the run, on the driver's clock


def external() -> ExternalDrone:
    return ExternalDrone("drone2", lambda now_ns: now_ns - BEGUN_NS)


def imu(t_ms: float) -> Reading:
    return Reading("imu", BEGUN_NS + round(t_ms * MS), ((0.0, 0.0, 9.8), (0.0, 0.0, 0.1)))


def vehicle(t_ms: float) -> AircraftState:
    pose = AircraftPose(BEGUN_NS + round(t_ms * MS), (1.0, 2.0, 3.0), (1.0, 0.0, -1.0))
    return AircraftState("flying", 80.0, pose, pose.taken_ns)


def test_a_gate_has_sorted_samples_the_truth_and_the_status():
    drone = external()
    drone.readings.extend([imu(18), imu(8), Reading("sonar", BEGUN_NS + 11 * MS, (1.5, True))])
    *samples, (truth_key, truth), (status_key, status) = drone.gate(20 * MS, vehicle(10), "controller.main")
    assert [keys.leaf(key) for key, _ in samples] == ["imu", "sonar", "imu"]
    assert [sample.t_sample_ns for _, sample in samples] == [8 * MS, 11 * MS, 18 * MS]
    assert {sample.t_ns for _, sample in samples} == {20 * MS}
    assert [sample.seq for key, sample in samples if key.endswith("imu")] == [0, 1]
    assert (truth_key, status_key) == (keys.truth("drone2"), keys.status("drone2"))
    assert truth.position_m == pytest.approx((1.01, 2.0, 2.99))
    assert (status.count, status.state, status.commander) == (4, "flying", "controller.main")


def test_every_message_satisfies_the_contract():
    drone = external()
    values = {
        "imu": ((0.0, 0.0, 9.8), (0.0, 0.0, 0.0)),
        "gps": (-34.0, -58.0, 30.0, (0.0, 0.0, 5.0), (0.0, 0.0, 0.0), 2.0, 3, 9),
        "mag": ((1.0, 2.0, 3.0),),
        "baro": (101_325.0, 3.0),
        "sonar": (2.0, True),
        "flow": ((0.0, 0.0, 0.0), 1.0),
    }
    drone.readings.extend(Reading(sensor, BEGUN_NS, fields) for sensor, fields in values.items())
    gate = drone.gate(20 * MS, vehicle(0), None)
    assert len(gate) == len(values) + 2
    for key, message in gate:
        assert messages.decode(key, messages.encode(message)) == message


def test_samples_are_clamped_between_the_start_of_the_run_and_the_gate():
    drone = external()
    drone.readings.extend([imu(-50), imu(25)])
    (_, first), (_, second), *_ = drone.gate(20 * MS, vehicle(0), None)
    assert (first.t_sample_ns, second.t_sample_ns) == (0, 20 * MS)


def test_a_gate_is_published_once_and_only_with_a_pose():
    drone = external()
    assert drone.gate(20 * MS, AircraftState(), None) == []
    assert drone.gate(40 * MS, vehicle(0), None)
    assert drone.gate(40 * MS, vehicle(0), None) == []
    assert drone.gate(20 * MS, vehicle(0), None) == []


@pytest.mark.parametrize(
    ("state", "turns"), [("landed", 0.0), ("taking_off", 400.0), ("flying", 400.0), ("emergency", 0.0)]
)
def test_rotors_turn_at_hover_speed_while_airborne(state: Any, turns: float):
    drone = ExternalDrone("drone2", lambda now_ns: now_ns - BEGUN_NS, (400.0,) * 6)
    (_, truth), _ = drone.gate(20 * MS, vehicle(0)._replace(state=state), None)
    assert truth.rotor_rad_s == (turns,) * 6


def test_a_pose_is_extrapolated_for_at_most_half_a_second():
    (_, truth), _ = external().gate(10_000 * MS, vehicle(0), None)
    assert truth.position_m == pytest.approx((1.5, 2.0, 2.5))
