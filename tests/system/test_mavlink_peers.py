"""MAVLink vehicles obey only the configured peer on an address open to other hosts, and only the right key."""

import math
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from federation import ONE, Federation
from lab import Lab
from mavlink_programs import free_udp_ports
from mixed_formation import UNFLOWN
from wire import PATIENCE_S

from zsim_bridges.mavlink import dialect
from zsim_bridges.mavlink.dialect import Link, Parser, Received

PROGRAM, VEHICLE = 14540, 14580  # ports of the first program and of the first vehicle
ARM, TAKE_OFF = 400, 22
ACCEPTED = 0
PACE = ("--rate", "1", "--duration", "600")
KEYS = {"theirs": bytes(range(32)), "another": bytes(32)}


def commands() -> Iterator[bytes]:
    """Yield frames that arm the first vehicle and make it take off to its default height."""
    link = Link(255, 190)
    for command in (ARM, TAKE_OFF):
        target = {"command": command, "target_system": 1, "target_component": 1}
        yield link.pack(dialect.CommandLong(param1=1.0, param7=math.nan, **target))


def results(frames: list[Received]) -> list[int]:
    """Return the results of the acknowledged commands."""
    messages: list[Any] = [each.message for each in frames]
    return [message.result for message in messages if isinstance(message, dialect.CommandAck)]


def test_only_the_configured_peer_may_fly(lab: Lab, federation: Federation) -> None:
    here, scenario = lab.prefix("h1"), federation.write(ONE)
    federation.start("world", scenario, "--listen", federation.endpoint, *PACE, prefix=here)
    where = ("--listen", lab.address("h1"), "--api", f"{lab.address('h2')}:{PROGRAM}")
    server = federation.start("mavlink", "serve", "--connect", federation.endpoint, *where, prefix=here)
    server.line("programs: UDP")
    with lab.inside("h3"), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.bind(("", PROGRAM))
        for frame in commands():
            stranger.sendto(frame, (lab.address("h1"), VEHICLE))
        server.line("drone1: a datagram .* not from the configured peer")
    with lab.inside("h2"), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.settimeout(PATIENCE_S)
        peer.bind(("", PROGRAM))
        parser, answers = Parser(), []
        assert results(parser.feed(peer.recv(65_536))) == []
        for frame in commands():
            peer.sendto(frame, (lab.address("h1"), VEHICLE))
        while len(answers) < 2:
            answers += results(parser.feed(peer.recv(65_536)))
        assert answers == [ACCEPTED, ACCEPTED]


@pytest.mark.soak
@pytest.mark.parametrize("key", KEYS)
def test_a_driver_arms_only_a_vehicle_with_its_own_key(federation: Federation, tmp_path: Path, key: str) -> None:
    for name, data in KEYS.items():
        (tmp_path / name).write_bytes(data)
    api, gcs, local = free_udp_ports(2), free_udp_ports(1), free_udp_ports(4)
    with Federation(tmp_path / "vehicle") as hardware:
        hardware.folder.mkdir(exist_ok=True)
        hardware.world(ONE, "--realtime", *PACE)
        ports = ("--api", f"127.0.0.1:{api}", "--gcs", f"127.0.0.1:{gcs}")
        ports += ("--api-local", str(local), "--gcs-local", str(local + 2), "--signing-key", str(tmp_path / "theirs"))
        served = hardware.start("mavlink", "serve", "--connect", hardware.endpoint, *ports)
        served.line("programs: UDP")
        federation.world(UNFLOWN, "--realtime", "--rate", "1")
        links = federation.client().subscribe("drone/drone2/link")
        signed = ("--signing-key", str(tmp_path / key), "--armed")
        where = ("--connect", federation.endpoint, *signed)
        federation.start("mavlink", "drive", "drone2", f"udp://127.0.0.1:{local}", *where)
        if key == "theirs":
            assert links.until(lambda link: link["state"] == "armed").message["refused"] == 0
        else:
            served.line("drone1: a frame")
            assert links.until(lambda link: link["refused"] > 0).message["state"] == "waiting"
