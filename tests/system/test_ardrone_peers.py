"""On an address that other hosts can reach, only the host named by --peer is obeyed."""

import socket

from ardrone_clients import PlainPilot
from federation import ONE, Federation
from lab import Lab
from wire import PATIENCE_S

from zsim_bridges.ardrone import at_commands, navdata

PORTS = (5559, 5551, 5555)  # TCP


def test_only_the_named_peer_can_fly_the_drone(lab: Lab, federation: Federation) -> None:
    here = lab.prefix("h1")
    scenario = federation.write(ONE)
    federation.start(
        "world", scenario, "--listen", federation.endpoint, "--rate", "1", "--duration", "600", prefix=here
    )
    where = ("--connect", federation.endpoint, "--addresses", lab.address("h1"), "--peer", lab.address("h2"))
    server = federation.start("ardrone", "serve", *where, prefix=here)
    server.line(f"drone1 is an AR.Drone 2.0 at {lab.address('h1')}")
    with lab.inside("h3"), PlainPilot(lab.address("h1")) as stranger:
        stranger.request()
        stranger.send(at_commands.ref(0, takes_off=True))
        server.line(f"{lab.address('h3')} sends datagrams and is not a --peer")
        for port in PORTS:
            assert _is_closed(lab.address("h1"), port)
    with lab.inside("h2"), PlainPilot(lab.address("h1")) as peer:
        peer.request()
        peer.config("general:navdata_demo", "TRUE")
        packet = next(peer.packets())
        assert packet.options[0].ctrl_state >> 16 == navdata.ControlState.LANDED
        assert b"general:ardrone_name = drone1" in peer.configuration()
        peer.send(at_commands.ref(0, takes_off=True))
        flying = navdata.StateBit.FLYING
        peer.until(lambda packet: flying in packet.state, lambda: peer.send(at_commands.ResetWatchdog(0)))


def _is_closed(address: str, port: int) -> bool:
    """Return whether a connection is closed before any data arrive."""
    with socket.create_connection((address, port), PATIENCE_S) as stream:
        try:
            return stream.recv(1) == b""
        except ConnectionError:
            return True
