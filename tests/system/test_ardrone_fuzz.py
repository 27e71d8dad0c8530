"""Fuzzed ports of a drone: the server neither ends nor prints a traceback, flies nothing and counts every refusal."""

import random
import socket
from collections.abc import Iterator

import pytest
from ardrone_clients import PlainPilot, addresses, serve
from federation import ONE, Federation
from wire import PATIENCE_S

from zsim_bridges.ardrone import at_commands, navdata

BURST = 64  # datagrams that certainly fit a socket's buffer
AUTHENTICATION_PORT, FTP_PORT, VIDEO_PORT = 5552, 5551, 5555
FORMED = (
    b'AT*REF=1,290718208\r',
    b'AT*PCMD=2,1,1056964608,-1090519040,1065353216,-1082130432\r',
    b'AT*PCMD_MAG=3,5,1056964608,0,0,0,1056964608,0\r',
    b'AT*CONFIG_IDS=4,"aabbccdd","11223344","01234567"\rAT*CONFIG=5,"control:euler_angle_max","0.3"\r',
    b'AT*CTRL=6,5,0\rAT*COMWDG=7\rAT*FTRIM=8\rAT*CALIB=9,0\rAT*LED=10,3,1073741824,2\rAT*ANIM=11,18,15\r',
)  # fmt: skip
STRANGE_KEYS = ("general:navdata_demo", "custom:session_id", "control:altitude_max", "video:video_channel", "a:b", ":")
STRANGE_VALUES = ("", "TRUE", "-all", "nan", "inf", "1e999", "-1", "99999999999999999999", "x" * 200, "{ 1 2 3 }", "\\")


def malformed(chance: random.Random) -> Iterator[bytes]:
    """Yield datagrams without a single valid AT command."""
    while True:
        kind = chance.randrange(4)
        if kind == 0:
            datagram = chance.randbytes(chance.randrange(0, 200))
        else:
            changed = bytearray(chance.choice(FORMED))
            for _ in range(chance.randrange(1, 12)):
                changed[chance.randrange(len(changed))] = chance.randrange(256)
            datagram = bytes(changed[: chance.randrange(len(changed))] if kind == 1 else changed * kind)
        commands, refusals = at_commands.parse(datagram)
        if refusals and not commands:
            yield datagram


def strange(chance: random.Random, sequence: int) -> bytes:
    """Return a well-formed but senseless command, which starts no motor."""
    number = chance.randrange(-(2**31), 2**31)
    key, value = chance.choice(STRANGE_KEYS), chance.choice(STRANGE_VALUES)
    return chance.choice(
        (
            f'AT*CONFIG={sequence},"{key}","{value}"\r',
            f"AT*REF={sequence},{number & ~(at_commands.TAKE_OFF_BIT | at_commands.EMERGENCY_BIT)}\r",
            f"AT*PCMD={sequence},{number},{chance.randrange(2**31)},{number},0,{number}\r",
            f"AT*CTRL={sequence},{number},0\r",
            f"AT*ANIM={sequence},{number},{number}\r",
            f"AT*CALIB={sequence},{number}\r",
        )
    ).encode()


@pytest.mark.parametrize("count", [20_000, pytest.param(1_000_000, marks=pytest.mark.soak)])
def test_fuzzed_ports_fly_nothing_and_count_all_refusals(federation: Federation, count: int) -> None:
    address = addresses(40)[-1]
    federation.world(ONE, "--rate", "1", "--duration", "36000")
    server = serve(federation, address)
    server.line("is an AR.Drone 2.0")
    client = federation.client()
    commands = client.subscribe("drone/*/cmd/**")
    health = client.subscribe("process/ardrone.main/health")
    chance = random.Random(7)
    with PlainPilot(address) as pilot:
        refused = _fuzz_commands(pilot, chance, count)
        refused += _fuzz_requests(pilot, chance, count // 20)
        _fuzz_streams(address, chance, max(20, count // 1000))
        health.until(lambda message: message["refused"] >= refused)
        pilot.request()
        pilot.send(at_commands.Config(0, "general:navdata_demo", "TRUE"))
        demo = pilot.until(lambda packet: 0 in packet.options).options[0]
    assert demo.ctrl_state >> 16 == navdata.ControlState.LANDED
    assert commands.now() == []
    assert client.get("drone/drone1/sensor/status")["drone/drone1/sensor/status"]["state"] == "landed"
    assert server.process.poll() is None
    assert "Traceback" not in server.text()


def _fuzz_commands(pilot: PlainPilot, chance: random.Random, count: int) -> int:
    """Send malformed datagrams to the AT port, with strange ones in between; return the number of malformed ones."""
    datagrams = malformed(chance)
    with socket.create_connection((pilot.address, at_commands.CONTROL_PORT), PATIENCE_S) as control:
        pilot.send(at_commands.ResetWatchdog(0))
        for _ in range(count // BURST):
            for _ in range(BURST):
                pilot.send_raw(next(datagrams))
            pilot.send_raw(strange(chance, pilot.next_sequence()))
            _await_configuration(pilot, control)
    return count // BURST * BURST


def _await_configuration(pilot: PlainPilot, control: socket.socket) -> None:
    """Wait for the answer to a request: by then all earlier datagrams to the AT port have been handled."""
    pilot.send(at_commands.Control(0, at_commands.SEND_CONFIGURATION))
    data = b""
    while not data.endswith(at_commands.TERMINATOR):
        received = control.recv(65_536)
        assert received, "the control port has been closed"
        data += received


def _fuzz_requests(pilot: PlainPilot, chance: random.Random, count: int) -> int:
    """Send invalid requests to the other UDP ports; return their number."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asker:
        asker.settimeout(PATIENCE_S)
        for _ in range(count // BURST):
            for _ in range(BURST):
                asker.sendto(b"\0" + chance.randbytes(chance.randrange(100)), (pilot.address, navdata.PORT))
                asker.sendto(b"\0" + chance.randbytes(chance.randrange(100)), (pilot.address, AUTHENTICATION_PORT))
            asker.sendto(b"PARROT AUTH", (pilot.address, AUTHENTICATION_PORT))
            assert asker.recv(100) == b"PARROT AUTH OK"
    return 2 * (count // BURST * BURST)


def _fuzz_streams(address: str, chance: random.Random, count: int) -> None:
    """Send random lines and FTP commands to the TCP ports."""
    for port in (at_commands.CONTROL_PORT, FTP_PORT, VIDEO_PORT):
        for _ in range(count):
            with socket.create_connection((address, port), PATIENCE_S) as stream:
                lines = [chance.randbytes(chance.randrange(700)) for _ in range(chance.randrange(4))]
                try:
                    stream.sendall(b"\r\n".join([*lines, b"PASV", b"RETR version.txt"[: chance.randrange(17)], b""]))
                except ConnectionError:
                    continue  # the server closed the connection after earlier input
