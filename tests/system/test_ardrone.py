"""Unmodified AR.Drone programs fly the drones of a run through `zsim ardrone serve`."""

import ftplib
import io
import math
import socket
from collections.abc import Iterator

import pytest
from ardrone_clients import PlainPilot, addresses, node, node_modules, python, serve
from ardrone_readers import configuration_entries
from federation import ONE, Federation, Role
from meanwhile import meanwhile
from picture_pump import pumping
from wire import PATIENCE_S, Client

from zsim_bridges.ardrone import at_commands
from zsim_bridges.ardrone.navdata import StateBit

__all__ = ["node_modules"]

FLEET = """
name: fleet
seed: 3
duration_s: 3600
drones:
  - {name: drone1, position_m: [0, 0, 0], yaw_deg: 90}
  - {name: drone2, position_m: [20, 0, 0], yaw_deg: 0}
  - {name: drone3, position_m: [40, 0, 0], yaw_deg: 45}
  - {name: drone4, position_m: [60, 0, 0], yaw_deg: 180}
  - {name: drone5, position_m: [80, 0, 0], yaw_deg: 0}
  - {name: drone6, position_m: [100, 0, 0], yaw_deg: 0, limits: {tilt_deg: 5}}
processes: {expect: []}
"""
BOOTSTRAP_BYTES, DEMO_BYTES, FULL_BYTES, GPS_BYTES = 24, 500, 1904, 2120
DEMO_AND_TIME = 1 << 0 | 1 << 1
WITH_GPS = 65_537 | 1 << 27
FLOWN_AGAIN_S = 0.1  # wall time between setpoints; a drone hovers half a second after the last one


class Fleet:
    """A world in real time, a server that presents its drones as AR.Drones, and a client."""

    def __init__(self, federation: Federation) -> None:
        self.addresses = addresses(6)
        self.world = federation.world(FLEET, "--rate", "1")
        self.server: Role = serve(federation, self.addresses[0])
        self.client: Client = federation.client()
        self.server.line(f"drone6 is an AR.Drone 2.0 at {self.addresses[5]}")

    def states(self) -> dict[str, str]:
        """Return the state of each drone."""
        return {key.split("/")[1]: status["state"] for key, status in self.client.get("drone/*/sensor/status").items()}


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> Iterator[Fleet]:
    """A fleet that the tests of this file share; each test leaves the drones on the ground."""
    with Federation(tmp_path_factory.mktemp("ardrone")) as federation:
        yield Fleet(federation)


def test_programs_fly_five_drones_at_once(fleet: Fleet, node_modules) -> None:
    one, two, three, four, five, _ = fleet.addresses
    programs = [
        node("fly.js", node_modules, one, two),
        node("mission.js", node_modules, three),
        python("pyardrone_flies.py", four),
        python("ardrone_sdk_flies.py", five),
    ]
    try:
        with pumping(fleet.client, "drone/drone4/camera/front", (320, 180)):
            pair, mission, pyardrone, sdk = (program.events() for program in programs)
    finally:
        for program in programs:
            program.close()
    for address in (one, two):
        flown = {each["event"]: each for each in pair if each["ip"] == address}
        assert list(flown) == ["configured", "hovering", "flying", "stopped", "landed"]
        assert 0.9 < flown["hovering"]["altitude"] < 1.2
        assert flown["flying"]["state"] == "CTRL_FLYING"
        assert flown["flying"]["speed"] > 500.0
        assert -12.0 < flown["flying"]["pitch"] < -1.0
        assert abs(flown["stopped"]["speed"]) < 300.0
    arrived, landed = mission
    assert (abs(arrived["x"] - 1.0), abs(arrived["y"])) < (0.4, 0.4)
    assert abs(arrived["z"] - 1.5) < 0.2
    assert abs(arrived["yaw"] - math.pi / 2) < 0.2
    assert landed["event"] == "landed"
    assert [each["event"] for each in pyardrone] == ["connected", "hovering", "turned", "picture", "landed"]
    assert pyardrone[2]["altitude_mm"] > 1400
    assert pyardrone[3]["shape"] == [360, 640, 3]
    assert [each["event"] for each in sdk] == ["hovering", "flying", "landed"]
    assert set(fleet.states().values()) == {"landed"}
    assert "is landing" not in fleet.server.text()


def test_navdata_starts_with_bootstrap_and_follows_the_configuration(fleet: Fleet) -> None:
    with PlainPilot(fleet.addresses[5]) as pilot:
        pilot.request()
        datagram, sender = pilot.receive()
        assert len(datagram) == BOOTSTRAP_BYTES
        assert sender == (fleet.addresses[5], 5554)
        pilot.config("general:navdata_demo", "TRUE")
        assert len(pilot.receive()[0]) == DEMO_BYTES
        pilot.config("general:navdata_demo", "FALSE")
        assert len(pilot.receive()[0]) == FULL_BYTES
        pilot.config("general:navdata_options", str(WITH_GPS))
        packet = pilot.until(lambda packet: 27 in packet.options)
        assert abs(packet.options[27].latitude_deg + 34.603) < 0.01
        pilot.config("general:navdata_options", "65537")
        pilot.config("general:navdata_demo", "TRUE")


def test_demo_navdata_is_sent_at_15_hz_of_simulated_time(fleet: Fleet) -> None:
    with PlainPilot(fleet.addresses[5]) as pilot:
        pilot.request()
        pilot.config("general:navdata_options", str(DEMO_AND_TIME))
        pilot.config("general:navdata_demo", "TRUE")
        pilot.until(lambda packet: 1 in packet.options)
        times_s = [_seconds(next(pilot.packets()).options[1].time) for _ in range(20)]
        pilot.config("general:navdata_options", "65537")
    numbers = [math.floor(15 * t + 1e-6) for t in times_s]
    assert numbers == list(range(numbers[0], numbers[0] + 20))


def _seconds(time: int) -> float:
    return (time >> 21) + (time & 0x1FFFFF) / 1e6


def test_the_control_port_returns_the_configuration(fleet: Fleet) -> None:
    with PlainPilot(fleet.addresses[5]) as pilot:
        pilot.request()
        pilot.send(at_commands.ResetWatchdog(0))
        pilot.config("CONTROL:euler_angle_max", "0.3")
        entries = configuration_entries(pilot.configuration())
        assert entries["general:num_version_soft"] == "2.4.8"
        assert float(entries["control:euler_angle_max"]) == pytest.approx(
            math.radians(5.0), abs=1e-4
        )  # the drone's own limit
        assert b"[sessions]\r00000000,default\r" in pilot.configuration(at_commands.SEND_CUSTOM_LIST)


def test_the_version_is_served_by_ftp_and_authentication_is_answered(fleet: Fleet) -> None:
    address = fleet.addresses[5]
    with ftplib.FTP() as ftp:
        ftp.connect(address, 5551, PATIENCE_S)
        ftp.login()
        content = io.BytesIO()
        ftp.retrbinary("RETR version.txt", content.write)
        assert content.getvalue().strip() == b"2.4.8"
        assert ftp.nlst() == ["version.txt"]
        with pytest.raises(ftplib.error_perm, match="550"):
            ftp.retrbinary("RETR ../../etc/passwd", content.write)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asker:
        asker.settimeout(PATIENCE_S)
        asker.sendto(b"PARROT AUTH", (address, 5552))
        assert asker.recv(100) == b"PARROT AUTH OK"


def test_a_pilot_sees_but_cannot_command_a_drone_that_another_flies(fleet: Fleet) -> None:
    with PlainPilot(fleet.addresses[5]) as pilot:
        pilot.request()
        pilot.config("general:navdata_demo", "TRUE")
        statuses = fleet.client.subscribe("drone/drone6/sensor/status")
        fleet.client.put("drone/drone6/cmd/mode", t_ns=0, source="tester.one", mode="takeoff")
        statuses.until(lambda status: status["state"] == "hovering")
        still = {"velocity_m_s": [0.0, 0.0, 0.1], "yaw_rate_rad_s": 0.0, "frame": "world"}
        other = lambda: fleet.client.put("drone/drone6/cmd/velocity", t_ns=0, source="tester.one", **still)  # noqa: E731
        with meanwhile(other, FLOWN_AGAIN_S):
            statuses.until(lambda status: status["commander"] == "tester.one")
            pilot.request()  # navdata has stopped, because the pilot was silent
            flown = lambda packet: StateBit.FLYING in packet.state and packet.options[0].ctrl_state >> 16 == 3  # noqa: E731
            assert pilot.until(flown).options[0].altitude_mm > 500
            pilot.send(at_commands.ref(0, takes_off=False, emergency=True), at_commands.Pcmd(0, 1, 1.0, 0.0, 0.0, 0.0))
            fleet.server.line(r"drone6: REF is not obeyed: tester\.one flies the drone")
            fleet.server.line(r"drone6: PCMD is not obeyed: tester\.one flies the drone")
            packet = next(pilot.packets())
            assert not packet.state & (StateBit.EMERGENCY | StateBit.USER_EMERGENCY)
            assert fleet.states()["drone6"] in ("flying", "hovering")
        fleet.client.put("drone/drone6/cmd/mode", t_ns=0, source="tester.one", mode="land")
        statuses.until(lambda status: status["state"] == "landed")
        assert fleet.client.request("world/control", "release", source="tester.one", drone="drone6")["ok"]


def test_an_emergency_stops_the_motors_and_can_be_cleared(fleet: Fleet) -> None:
    emergency = StateBit.EMERGENCY | StateBit.USER_EMERGENCY
    with PlainPilot(fleet.addresses[5]) as pilot:

        def send(takes_off: bool, toggles: bool = False) -> None:
            pilot.send(at_commands.ref(0, takes_off, toggles), at_commands.Pcmd(0, 0, 0.0, 0.0, 0.0, 0.0))

        pilot.request()
        pilot.config("general:navdata_demo", "FALSE")
        send(takes_off=False)
        pilot.until(lambda packet: packet.options[0].altitude_mm > 300, lambda: send(takes_off=True))
        stopped = pilot.until(lambda packet: emergency in packet.state, lambda: send(takes_off=True, toggles=True))
        assert stopped.options[0].ctrl_state >> 16 == 0
        pilot.until(lambda packet: packet.options[9].motor == (0, 0, 0, 0), lambda: send(takes_off=False))
        pilot.until(lambda packet: packet.options[0].altitude_mm < 120, lambda: send(takes_off=False))
        left = pilot.until(
            lambda packet: StateBit.EMERGENCY not in packet.state, lambda: send(takes_off=False, toggles=True)
        )
        assert left.options[0].ctrl_state >> 16 == 2
        pilot.config("general:navdata_demo", "TRUE")


@pytest.mark.soak
def test_a_drone_hovers_and_lands_when_its_pilot_goes_silent(fleet: Fleet) -> None:
    statuses = fleet.client.subscribe("drone/drone6/sensor/status")
    with PlainPilot(fleet.addresses[5]) as pilot:
        pilot.request()
        pilot.config("general:navdata_demo", "TRUE")
        pilot.send(at_commands.ref(0, takes_off=True))
        pilot.until(
            lambda packet: packet.options[0].ctrl_state >> 16 == 4, lambda: pilot.send(at_commands.ResetWatchdog(0))
        )
        pilot.send(at_commands.Pcmd(0, 1, 0.0, -0.5, 0.0, 0.0))
        flying = statuses.until(lambda status: status["state"] == "flying").message
        hovering = statuses.until(lambda status: status["state"] == "hovering").message
        landing = statuses.until(lambda status: status["state"] == "landing").message
        statuses.until(lambda status: status["state"] == "landed")
    assert 1.9 < (hovering["t_ns"] - flying["t_ns"]) / 1e9 < 2.4
    assert 1.9 < (landing["t_ns"] - hovering["t_ns"]) / 1e9 < 2.4


def test_consecutive_runs_are_served(federation: Federation) -> None:
    first = addresses(30)[-1]
    server = serve(federation, first)
    for number in (1, 2):
        world = federation.world(ONE, "--rate", "1", "--duration", "3600")
        server.line(f"drone1 is an AR.Drone 2.0 at {first}", number=number)
        with PlainPilot(first) as pilot:
            pilot.request()
            pilot.config("general:navdata_demo", "TRUE")
            assert b"general:navdata_demo = TRUE" in pilot.configuration()
            assert federation.client().request("world/control", "stop")["ok"]
            world.ends(with_code=0)
    server.line("left, the run ended")


def test_an_unpaced_run_is_refused_unless_a_rate_is_given(federation: Federation) -> None:
    federation.world(ONE, "--expect", "nobody.yet")
    first = addresses(20)[-1]
    refused = serve(federation, first)
    refused.ends(with_code=2)
    refused.line("--rate 1")
    paced = serve(federation, first, "--rate", "2")
    paced.line(f"drone1 is an AR.Drone 2.0 at {first}")
    assert federation.client().get("clock")["clock"]["state"] == "waiting"


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (("--addresses", "192.0.2.1"), "192.0.2.1 .*--peer HOST"),
        (("--addresses", "192.0.2.1", "--peer", "192.0.2.9"), "the address is not this host's"),
        (("--addresses", "drone9=127.0.0.9"), "--addresses names 'drone9'; must be one of drone1"),
        (("--addresses", "here"), "must be an IPv4 address"),
    ],
)
def test_unusable_addresses_are_refused(fleet: Fleet, options: tuple[str, ...], reason: str) -> None:
    # a server next to the fleet's, under another name
    endpoint = fleet.server.arguments[fleet.server.arguments.index("--connect") + 1]
    role = Role(["ardrone", "serve", "--connect", endpoint, "--name", "ardrone.other", *options])
    try:
        role.ends(with_code=2)
        role.line(reason)
    finally:
        role.close()


def test_a_second_server_on_the_same_addresses_is_refused(fleet: Fleet) -> None:
    endpoint = fleet.server.arguments[fleet.server.arguments.index("--connect") + 1]
    where = ("--addresses", fleet.addresses[0], "--name", "ardrone.other")
    role = Role(["ardrone", "serve", "--connect", endpoint, *where])
    try:
        role.ends(with_code=2)
        role.line("UDP port 5554 of .* cannot be opened: another program uses it")
    finally:
        role.close()
