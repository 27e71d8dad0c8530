"""The AR.Drone server: subscriptions to pictures, printed reasons, addresses, and hosts allowed on its ports."""

import asyncio
import contextlib
import socket
from typing import Any

import pytest
from fake_link import FakeLink
from in_loop import in_loop
from refused import has_terms, refused

from zsim.contract import keys
from zsim.contract.messages import DroneInfo, Info, Origin
from zsim.errors import RunError, install_command
from zsim.runtime.participant import Participant
from zsim_bridges.ardrone import ardrone_server
from zsim_bridges.ardrone.ardrone_server import (
    CONNECTIONS_MAX,
    AllowedHosts,
    ArdroneOptions,
    ArdroneServer,
    DatagramPort,
    StreamPort,
    drone_addresses,
    peer_addresses,
    read_until_end,
)

HOME = "127.0.0.1"
ELSEWHERE = AllowedHosts("192.0.2.1", frozenset({"192.0.2.9"}))  # as for an address that other hosts can reach
HERE = AllowedHosts("127.0.0.2", frozenset())
NAMES = ["drone1", "drone2"]


def test_addresses_follow_the_first_one_or_are_given_by_name():
    addresses = {"drone1": "127.0.0.254", "drone2": "127.0.0.255", "drone3": "127.0.1.0"}
    assert drone_addresses("127.0.0.254", [*NAMES, "drone3"]) == addresses
    assert drone_addresses("drone2=192.168.1.5", NAMES) == {"drone2": "192.168.1.5"}


@pytest.mark.parametrize(
    ("text", "terms"),
    [
        ("localhost", ("'localhost'", "IPv4")),
        ("", ("''", "IPv4")),
        ("255.255.255.255", ("255.255.255.255", "enough")),
        ("drone3=127.0.0.2", ("'drone3'", "drone1", "drone2")),
        ("drone1=127.0.0.2,drone2=127.0.0.2", ("address", "own")),
        ("drone1=::1", ("'::1'", "IPv4")),
    ],
)
def test_invalid_addresses_are_refused(text: str, terms: tuple[str, ...]):
    with refused(RunError, *terms):
        drone_addresses(text, NAMES)


def test_peers_are_names_or_addresses():
    assert peer_addresses(["localhost", "192.0.2.9"]) == {"127.0.0.1", "192.0.2.9"}
    with refused(RunError, "--peer", "no.such.host.invalid"):
        peer_addresses(["no.such.host.invalid"])


def test_a_loopback_address_allows_this_host_and_any_other_allows_only_peers():
    assert HERE.allow(HOME)
    assert ELSEWHERE.allow("192.0.2.9")
    assert not ELSEWHERE.allow("192.0.2.10")
    assert not ELSEWHERE.allow(HOME)
    with refused(RunError, "192.0.2.1", "--peer"):
        AllowedHosts("192.0.2.1", frozenset())


class Refusals(list[str]):
    """A list of reasons, with an event for its first one."""

    def __init__(self) -> None:
        super().__init__()
        self.came = asyncio.Event()

    def add(self, reason: str) -> None:
        self.append(reason)
        self.came.set()


@pytest.fixture
def refusals() -> Refusals:
    return Refusals()


@in_loop
async def test_datagrams_from_other_hosts_are_counted_and_ignored(refusals: Refusals) -> None:
    taken: list[bytes] = []
    port = DatagramPort(ELSEWHERE, lambda data, _: taken.append(data), refusals.add)
    number = await port.open(HOME, 0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(b"AT*REF=1,290718208\r", (HOME, number))
        await refusals.came.wait()
    await port.close()
    assert taken == []
    assert len(refusals) == 1
    assert has_terms(refusals[0], "127.0.0.1", "--peer")


@in_loop
async def test_datagrams_from_this_host_are_accepted_on_loopback(refusals: Refusals) -> None:
    taken: asyncio.Queue[bytes] = asyncio.Queue()
    port = DatagramPort(HERE, lambda data, _: taken.put_nowait(data), refusals.add)
    number = await port.open(HOME, 0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as pilot:
        pilot.sendto(b"hello", (HOME, number))
        assert await taken.get() == b"hello"
    await port.close()
    assert refusals == []


@in_loop
async def test_connections_from_other_hosts_are_closed_and_counted(refusals: Refusals) -> None:
    port = StreamPort(ELSEWHERE, read_until_end, refusals.add)
    reader, writer = await asyncio.open_connection(HOME, await port.open(HOME, 0))
    with contextlib.suppress(ConnectionError):
        assert await reader.read(1) == b""
    writer.close()
    await port.close()
    assert len(refusals) == 1
    assert has_terms(refusals[0], "127.0.0.1", "--peer")


@in_loop
async def test_the_number_of_connections_is_limited(refusals: Refusals) -> None:
    port = StreamPort(HERE, read_until_end, refusals.add)
    number = await port.open(HOME, 0)
    connections = [await asyncio.open_connection(HOME, number) for _ in range(CONNECTIONS_MAX + 1)]
    await refusals.came.wait()
    assert len(port.writers) <= CONNECTIONS_MAX
    assert "connections already" in refusals[0]
    await port.close()
    for _, writer in connections:
        writer.close()


@in_loop
async def test_a_broadcast_reaches_all_connections(refusals: Refusals) -> None:
    port = StreamPort(HERE, read_until_end, refusals.add)
    number = await port.open(HOME, 0)
    connections = [await asyncio.open_connection(HOME, number) for _ in range(2)]
    while len(port.writers) < 2:
        await asyncio.sleep(0)
    port.broadcast(b"news")
    for reader, writer in connections:
        assert await reader.readexactly(4) == b"news"
        writer.close()
    await port.close()


SCENARIO = "{name: one, duration_s: 10, drones: [{name: drone1, position_m: [0, 0, 0]}]}"
DRONES = (DroneInfo("drone1", "ardrone2"),)


def offered() -> tuple[ArdroneServer, list[str]]:
    """Return the server of one drone and a list of the lines that it prints."""
    link: Any = FakeLink()
    origin, lines = Origin(0.0, 0.0, 0.0), []
    info = Info(0, 0, 1, "r", "zsim", "lockstep", 1.0, 1, 1, 1, 1, origin, DRONES, (), SCENARIO, "", "", "")
    observer, options = Participant(link, info, "ardrone.main"), ArdroneOptions("127.0.0.2", frozenset(), None)
    return ArdroneServer(link, info, observer, lines.append, options), lines


@pytest.mark.parametrize("is_installed", [True, False])
def test_pictures_are_subscribed_to_if_encodable_else_the_extra_is_named(
    monkeypatch: pytest.MonkeyPatch, is_installed: bool
):
    monkeypatch.setattr(ardrone_server, "find_spec", lambda _: object() if is_installed else None)
    server, lines = offered()
    assert list(server.watched_cameras()) == []  # nobody is connected
    watcher: Any = object()
    server._drones["drone1"].video.port.writers.add(watcher)
    wanted = [list(server.watched_cameras()) for _ in range(2)]
    assert wanted == ([[keys.camera("drone1", "front")]] * 2 if is_installed else [[], []])
    assert len(lines) == (0 if is_installed else 1)
    assert all(install_command(["video"]) in line for line in lines)
    assert server.observer.health.refused == 0


def test_reasons_that_differ_only_in_numbers_are_printed_once_and_counted():
    """A flood may contain datagrams of all lengths; each drone and each sending host gets its own line."""
    server, lines = offered()
    for size in range(40):
        for drone in ("drone1", "drone2"):
            server.refuse(f"{drone}: a datagram of {size} bytes on the navdata port is not a request for navdata")
    for host in ("10.0.0.7", "10.0.0.8", "fe80::1", "fe80::2"):
        server.refuse(f"{host} sends datagrams and is not a --peer")
    assert len(lines) == 2 + 4
    assert server.observer.health.refused == 2 * 40 + 4
