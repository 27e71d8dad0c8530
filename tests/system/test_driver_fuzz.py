"""Malformed datagrams on a driver's port: the driver survives, counts them and starts no motor."""

import random
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ardrone_clients import addresses
from fake_aircraft import LANDED, FakeAircraft
from fake_autopilot import ON_GROUND, FakeAutopilot
from federation import Federation
from mavlink_programs import free_udp_ports
from mixed_formation import UNFLOWN
from wire import PATIENCE_S

from zsim_bridges.ardrone import at_commands, navdata
from zsim_bridges.mavlink import dialect
from zsim_bridges.mavlink.dialect import Link

pytestmark = pytest.mark.soak

COUNT = 1_000_000
CHUNK = 100  # datagrams that certainly fit into a socket's buffer
LEAST_COUNTED = 0.95  # minimum share counted: a truncated frame is one fault with the next
STEP_NS = 20_000_000
STARTERS = {"Ref", "Pcmd"}  # AT commands that make an aircraft fly


class Autopilot:
    """A MAVLink vehicle on its own port.

    Attributes:
        command: Arguments of zsim that start its driver.
        addresses: Host and port of each of its sockets.
        good: Valid datagrams that the vehicle may send.
    """

    def __init__(self) -> None:
        port, link = free_udp_ports(1), Link(1, 1)
        self.command = ("mavlink", "drive", "drone2", f"udp://127.0.0.1:{port}")
        self.addresses = [("127.0.0.1", port)]
        self.good = [link.pack(dialect.Heartbeat(2, 12, 129, 6 << 16, 4, 3)), link.pack(dialect.LocalPositionNed(5))]
        self._vehicle, self._now_ns = FakeAutopilot(), STEP_NS

    def receive(self, _channel: int, datagram: bytes) -> None:
        self._vehicle.receive(datagram, self._now_ns)

    def step(self) -> Iterator[bytes]:
        self._now_ns += STEP_NS
        yield from self._vehicle.step(self._now_ns)

    def is_idle(self) -> bool:
        vehicle = self._vehicle
        return not vehicle.armed and vehicle.landed == ON_GROUND and vehicle.setpoints == []


class Parrot:
    """An AR.Drone at its own address, with the attributes of `Autopilot`."""

    def __init__(self) -> None:
        host = addresses(50)[-1]
        self.command = ("ardrone", "drive", "drone2", host)
        self.addresses = [(host, navdata.PORT), (host, at_commands.PORT)]
        self._drone, self._now_ns = FakeAircraft(), STEP_NS
        self._drone.has_client = True
        self.good = [datagram for _ in range(2) if (datagram := self._drone.step(STEP_NS))]

    def receive(self, channel: int, datagram: bytes) -> None:
        self._drone.receive(channel, datagram)

    def step(self) -> Iterator[bytes]:
        self._now_ns += STEP_NS
        datagram = self._drone.step(self._now_ns)
        if datagram:
            yield datagram

    def is_idle(self) -> bool:
        return self._drone.state == LANDED and not STARTERS & set(self._drone.names)


class Wire:
    """The sockets of an aircraft, connected to a driver.

    Args:
        aircraft: Receives the driver's datagrams.
    """

    def __init__(self, aircraft: Any) -> None:
        self._aircraft = aircraft
        self._sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in aircraft.addresses]
        for own, address in zip(self._sockets, aircraft.addresses, strict=True):
            own.bind(address)
            own.settimeout(PATIENCE_S)
        self._driver: tuple[str, int] = ("", 0)

    def await_driver(self) -> None:
        """Receive the first datagram, whose sender is the driver's address."""
        datagram, self._driver = self._sockets[0].recvfrom(65_536)
        self._aircraft.receive(0, datagram)
        for own in self._sockets:
            own.setblocking(False)

    def exchange(self) -> None:
        """Pass received datagrams to the aircraft, step it and send its datagrams."""
        for channel, own in enumerate(self._sockets):
            try:
                while True:
                    self._aircraft.receive(channel, own.recv(65_536))
            except BlockingIOError:
                continue
        for datagram in self._aircraft.step():
            self.send(datagram)
        self.until_read()

    def send(self, datagram: bytes) -> None:
        self._sockets[0].sendto(datagram, self._driver)

    def until_read(self) -> None:
        """Wait until the driver has read everything sent to it."""
        port = f":{self._driver[1]:04X}"
        while True:
            rows = (line.split() for line in Path("/proc/net/udp").read_text().splitlines()[1:])
            if next(row[4] for row in rows if row[1].endswith(port)).endswith(":00000000"):
                return

    def close(self) -> None:
        for own in self._sockets:
            own.close()


def mutated(chance: random.Random, good: bytes) -> bytes:
    """Return random bytes, or a datagram with one bit flipped or its end cut off."""
    kind, place = chance.randrange(3), chance.randrange(1, len(good))
    if kind == 0:
        return chance.randbytes(chance.randint(1, 300))
    if kind == 1:
        return good[:place]
    return good[:place] + bytes([good[place] ^ 1 << chance.randrange(8)]) + good[place + 1 :]


@pytest.mark.parametrize("kind", [Autopilot, Parrot])
def test_malformed_datagrams_start_no_motor(federation: Federation, kind: type) -> None:
    aircraft, chance = kind(), random.Random(17)
    wire = Wire(aircraft)
    federation.world(UNFLOWN, "--realtime", "--rate", "1")
    driver = federation.start(*aircraft.command, "--connect", federation.endpoint, "--armed")
    links = federation.client().subscribe("drone/drone2/link")
    try:
        wire.await_driver()
        for _ in range(COUNT // CHUNK):
            for _ in range(CHUNK):
                wire.send(mutated(chance, chance.choice(aircraft.good)))
            wire.until_read()
            wire.exchange()
        while not any(is_counted(each.message) for each in links.now()):
            wire.exchange()
    finally:
        wire.close()
    assert aircraft.is_idle()
    assert driver.process.poll() is None
    assert "Traceback" not in driver.text()


def is_counted(link: dict[str, Any]) -> bool:
    return link["refused"] >= LEAST_COUNTED * COUNT and link["state"] == "armed"
