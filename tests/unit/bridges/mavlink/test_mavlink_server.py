"""The MAVLink process: its peers, datagrams, system IDs, mission reports, pace and options."""

import asyncio
import socket
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import typer
from in_loop import in_loop
from mavlink_drone import ORIGIN, SCENARIO

from zsim.contract.run_messages import ControlAnswer
from zsim.errors import NoWorldError, RunError
from zsim.transport.session import Unanswered
from zsim_bridges.mavlink import dialect
from zsim_bridges.mavlink.dialect import Link, Parser, Received
from zsim_bridges.mavlink.mavlink_server import (
    DATAGRAM_MAX,
    LEARNT_PEERS_MAX,
    PEER_TIMEOUT_S,
    MavlinkOptions,
    MavlinkServer,
    Peers,
    ServedVehicle,
    VehiclePort,
)
from zsim_bridges.mavlink.mission import MissionReport
from zsim_bridges.vehicle_links.server import set_pace
from zsim_deploy.cli.role_commands import _endpoint, read_key

GCS = ("192.0.2.7", 14550)


def test_off_loopback_only_the_configured_peer_is_obeyed() -> None:
    peers = Peers(GCS)
    assert peers.accepts(GCS, 0.0)
    for address in (("192.0.2.7", 14551), ("192.0.2.8", 14550), ("0.0.0.0", 14550)):
        assert not peers.accepts(address, 0.0)
    assert peers.refused == 3
    assert peers.addresses(0.0) == [GCS]


def test_programs_on_this_machine_become_peers_until_they_are_silent() -> None:
    peers = Peers(GCS)
    for i in range(LEARNT_PEERS_MAX):
        assert peers.accepts(("127.0.0.1", 5000 + i), 0.0)
    assert not peers.accepts(("127.0.0.1", 6000), 0.0)
    assert len(peers.addresses(1.0)) == 1 + LEARNT_PEERS_MAX
    assert peers.accepts(("127.0.0.1", 5000), PEER_TIMEOUT_S)
    assert peers.addresses(PEER_TIMEOUT_S + 1.0) == [GCS, ("127.0.0.1", 5000)]


@pytest.fixture
def program() -> Iterator[socket.socket]:
    """Yield the socket of a program with its own port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.0.1", 0))
        opened.settimeout(120.0)
        yield opened


def served_vehicle(program: socket.socket, received: list[Received]) -> ServedVehicle:
    port = VehiclePort(("127.0.0.1", 0), program.getsockname(), None, received.append)
    port.open()
    vehicle: Any = None
    return ServedVehicle(vehicle, [port], Link(1, 1))


@pytest.mark.parametrize("is_taken", [True, False])
def test_a_port_that_cannot_be_opened_is_refused_with_its_option(program: socket.socket, is_taken: bool) -> None:
    local = ("127.0.0.1" if is_taken else "nowhere.invalid", program.getsockname()[1])
    with pytest.raises(RunError, match=f"{local[0]}:{local[1]}.*{'--api-local' if is_taken else '--listen'}"):
        VehiclePort(local, GCS, None, print)


@in_loop
async def test_messages_go_together_in_datagrams_and_those_out_of_range_are_counted(program: socket.socket) -> None:
    many = [dialect.Statustext(6, f"{i:050}") for i in range(50)]

    served = served_vehicle(program, [])
    served.send([*many[:25], dialect.Heartbeat(type=300), *many[25:]])
    assert served.refused()["unsent"] == 1
    served.ports[0].close()
    parser, read = Parser(), []
    while len(read) < len(many):
        data = program.recv(65_536)
        assert len(data) <= DATAGRAM_MAX
        read += [each.message for each in parser.feed(data)]
    assert read == many


@in_loop
async def test_what_a_program_sends_is_read_and_what_is_damaged_is_counted(program: socket.socket) -> None:
    received: list[Received] = []
    served = served_vehicle(program, received)
    good = Link(255, 190).pack(dialect.Heartbeat(type=6))
    for data in (good[:-1] + bytes([good[-1] ^ 1]), good):
        program.sendto(data, served.ports[0]._socket.getsockname())
    while not received:
        await asyncio.sleep(0)
    assert received == [Received(dialect.Heartbeat(type=6), 255, 190, 0, False)]
    assert served.refused()["bad_crc"] == 1
    served.ports[0].close()


def server_of(link: Any, first_system_id: int = 1, run_id: str = "r") -> MavlinkServer:
    info: Any = SimpleNamespace(scenario=SCENARIO, origin=ORIGIN, run_id=run_id)
    options = MavlinkOptions("px4", "normal", "127.0.0.1", GCS, 0, GCS, 0, None, 2, None, first_system_id)
    observer: Any = SimpleNamespace(name="mavlink.main")
    return MavlinkServer(link, info, observer, lambda _: None, options)


def close(served: ServedVehicle) -> None:
    for port in served.ports:
        port._socket.close()


def test_vehicles_of_two_simulations_have_different_ids() -> None:
    addresses, unique_ids = set(), set()
    for run_id, first in (("one", 1), ("two", 11)):
        served = server_of(SimpleNamespace(put=lambda *_: None), first, run_id)._served["drone1"]
        vehicle = served.vehicle
        heartbeat = served.link.pack(dialect.Heartbeat())
        addresses.add(next(iter(Parser().feed(heartbeat))).system_id)
        assert vehicle._parameters.values["MAV_SYS_ID"] == first
        version: Any = vehicle._version()
        unique_ids.add(version.uid)
        close(served)
    assert addresses == {1, 11}
    assert len(unique_ids) == 2
    with pytest.raises(RunError, match=r"254.*--first-system-id.*255"):
        server_of(SimpleNamespace(put=lambda *_: None), 255)


def test_mission_reports_are_sent_to_the_world_in_order() -> None:
    asked: list[tuple[Any, ...]] = []
    link = SimpleNamespace(request=lambda *arguments: asked.append(arguments), put=lambda *_: None)
    server = server_of(link)
    served = server._served["drone1"]
    reports = [MissionReport("active", 5, 3), MissionReport("aborted", 5, 3, "it left its geofence", failsafe=True)]
    served.vehicle.flight.mission.reports += reports
    server.report_mission(served.vehicle)
    server._requests.shutdown()
    close(served)
    assert [(key, op, source) for key, op, source, *_ in asked] == [("world/control", "mission", "mavlink.main")] * 2
    assert [args for *_, args, _ in asked] == [{"drone": "drone1", **each._asdict()} for each in reports]
    assert served.vehicle.flight.mission.reports == []


def test_a_run_without_a_pace_is_refused_unless_one_is_set() -> None:
    asked: list[Any] = []

    def ask(mode: str, own: float, rate: float | None, answer: Any = ControlAnswer(ok=True)) -> None:  # noqa: B008
        info: Any = SimpleNamespace(run_id="r", mode=mode, rate=own)
        link: Any = SimpleNamespace(request=lambda _, *arguments: asked.append(arguments) or answer)
        set_pace(link, info, "mavlink.main", rate)

    with pytest.raises(RunError, match="--rate"):
        ask("lockstep", 0.0, None)
    ask("lockstep", 2.0, None)
    ask("realtime", 1.0, None)
    assert asked == []
    ask("lockstep", 0.0, 3.0)
    assert asked == [("rate", "mavlink.main", {"value": 3.0})]
    with pytest.raises(RunError, match="not now"):
        ask("lockstep", 0.0, 3.0, ControlAnswer(ok=False, error="not now"))
    with pytest.raises(NoWorldError, match="nobody answers there"):
        ask("lockstep", 0.0, 3.0, Unanswered(ok=False, error="nobody answers there"))


def test_endpoints_are_reachable_hosts_and_ports() -> None:
    assert _endpoint("--gcs", "127.0.0.1:14550", "127.0.0.1") == ("127.0.0.1", 14550)
    assert _endpoint("--gcs", "192.0.2.7:14550", "0.0.0.0") == GCS
    for text in ("14550", "127.0.0.1:", "127.0.0.1:0", "127.0.0.1:70000", ":5"):
        with pytest.raises(typer.BadParameter, match="must be HOST:PORT"):
            _endpoint("--gcs", text, "127.0.0.1")
    with pytest.raises(typer.BadParameter, match="--listen"):
        _endpoint("--gcs", "192.0.2.7:14550", "127.0.0.1")


def test_a_key_is_32_bytes_hexadecimal_digits_or_a_passphrase(tmp_path: Path) -> None:
    path, key = tmp_path / "key", bytes(range(32))
    path.write_bytes(key)
    assert read_key(path) == key
    path.write_text(f"{key.hex()}\n")
    assert read_key(path) == key
    path.write_text("open sesame\n")
    assert read_key(path).hex().startswith("41ef4bb0")  # as sha256sum prints it
    path.write_text("\n")
    with pytest.raises(RunError, match="is empty"):
        read_key(path)
    with pytest.raises(RunError, match="cannot be read"):
        read_key(tmp_path / "none")
