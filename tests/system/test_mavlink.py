"""Unmodified programs fly drones through `zsim mavlink serve`: MAVSDK, DroneKit, MAVProxy and node-mavlink."""

import random
import socket
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import mavlink_programs as programs
import pytest
from federation import Federation, Role
from mavlink_programs import Program, free_udp_ports
from wire import Client

from zsim_bridges.mavlink import dialect
from zsim_bridges.mavlink.dialect import Link, Parser, Signing

DRONES = 6
FLEET = f"""
name: fleet
seed: 3
duration_s: 3600
sensors: {{preset: paper}}
drones:
{chr(10).join(f"  - {{name: drone{i + 1}, position_m: [{12 * i}, 0, 0], yaw_deg: 90}}" for i in range(DRONES))}
processes: {{expect: []}}
"""
PACE = ("--rate", "2")
ASKED_MAX = 60
LEAST_READ = 0.95  # share of the UDP datagrams sent to a busy process
KEY = bytes(range(32))
FRAMES, FRAMES_SOAK = 20_000, 1_000_000
CHUNK = 50  # datagrams that fit into a socket's buffer


class Vehicles:
    """The drones of a run as vehicles of one autopilot.

    Attributes:
        gcs, api: Ports of the ground station and of the first program.
        gcs_local, api_local: First ports of the vehicles for each.
    """

    def __init__(self, federation: Federation, name: str, *options: str) -> None:
        self.gcs, self.api = free_udp_ports(1), free_udp_ports(DRONES)
        self.gcs_local, self.api_local = free_udp_ports(DRONES), free_udp_ports(DRONES)
        where = ("--gcs", f"127.0.0.1:{self.gcs}", "--api", f"127.0.0.1:{self.api}")
        local = ("--gcs-local", str(self.gcs_local), "--api-local", str(self.api_local))
        arguments = ("serve", "--name", f"mavlink.{name}", *where, *local, *options)
        self.role: Role = federation.start("mavlink", *arguments, "--connect", federation.endpoint)
        self.role.line("programs: UDP")


class Fleet:
    """A run whose drones are served as vehicles of both autopilots."""

    def __init__(self, federation: Federation) -> None:
        self.federation = federation
        federation.world(FLEET, *PACE)
        self.px4 = Vehicles(federation, "px4")
        self.ardupilot = Vehicles(federation, "ardupilot", "--autopilot", "ardupilot")
        self.client: Client = federation.client()
        self.commands = self.client.subscribe("drone/*/cmd/*")
        self._programs: list[Program] = []
        ports = [str(self.px4.api + i) for i in range(2)]  # concurrently with the other programs, as they take long
        self.mavsdk = self.keep(programs.python("mavsdk_square.py", *ports))
        self.dronekit = self.keep(programs.python("dronekit_goto.py", f"udp:127.0.0.1:{self.ardupilot.api + 2}"))

    def keep(self, program: Program) -> Program:
        """Register a program to be ended with the fleet, and return it."""
        self._programs.append(program)
        return program

    def close(self) -> None:
        for program in self._programs:
            program.close()

    def truth(self, drone: str) -> dict:
        return self.client.get(f"drone/{drone}/truth")[f"drone/{drone}/truth"]

    def refused(self) -> int:
        """Return the number of frames that the PX4 vehicles have refused so far."""
        health = self.client.subscribe("process/mavlink.px4/health")
        return health.until(lambda _: True).message["refused"]

    def commands_to(self, drone: str) -> int:
        return sum(1 for each in self.commands.now() if each.key.startswith(f"drone/{drone}/"))


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> Iterator[Fleet]:
    """A run shared by the tests of this file, each with its own drones."""
    with Federation(tmp_path_factory.mktemp("mavlink")) as federation:
        fleet = Fleet(federation)
        try:
            yield fleet
        finally:
            fleet.close()


def test_node_mavlink_arms_takes_off_and_lands(fleet: Fleet) -> None:
    seen = fleet.keep(programs.node("node_takeoff.cjs", str(fleet.px4.api + 4), "5")).result()
    assert seen["acks"] == [[400, 0], [22, 0], [21, 0]]
    assert seen["height_m"] > 2.0
    assert seen["texts"] == ["Armed", "Landed; disarmed"]
    assert {"HEARTBEAT", "ATTITUDE", "GLOBAL_POSITION_INT", "SYS_STATUS"} <= set(seen["messages"])


def test_mavproxy_flies_by_typed_commands(fleet: Fleet, tmp_path: Path) -> None:
    port = fleet.ardupilot.api + 3
    pilot = fleet.keep(programs.mavproxy(tmp_path, f"--master=udpin:127.0.0.1:{port}"))
    pilot.line("Received [0-9]+ parameters")
    pilot.type("mode GUIDED")
    pilot.line("Mode GUIDED")
    pilot.type("arm throttle")
    pilot.line("^ARMED|> ARMED")
    pilot.type("takeoff 3")
    pilot.line("NAV_TAKEOFF: ACCEPTED")
    truths = fleet.client.subscribe("drone/drone4/truth")
    truths.until(lambda truth: truth["position_m"][2] > 2.6)
    pilot.type("mode LAND")
    pilot.line("DISARMED")
    assert "Refused" not in pilot.text()


def test_mavsdk_flies_two_vehicles_at_once_offboard(fleet: Fleet) -> None:
    flights = fleet.mavsdk.result()
    assert [flight["system"] for flight in flights] == [1, 2]
    for drone, flight in zip(("drone1", "drone2"), flights, strict=True):
        assert flight["corners"] == 4
        assert flight["top_m"] > 4.0
        x, y, z = fleet.truth(drone)["position_m"]
        assert abs(z) < 0.2
        assert abs(y) < 1.5
        assert abs(x - (0.0 if drone == "drone1" else 12.0)) < 1.5


def test_dronekit_flies_to_a_point_and_a_mission(fleet: Fleet) -> None:
    flight = fleet.dronekit.result()
    assert flight["parameters"] == {"SYSID_THISMAV": 3.0, "WPNAV_SPEED": 500.0}
    assert abs(flight["north_m"] - 4.4) < 0.8
    assert flight["items"] == 2
    assert flight["east"]
    assert abs(fleet.truth("drone3")["position_m"][2]) < 0.2


def malformed(rng: random.Random, link: Link) -> bytes:
    """Return random bytes, a truncated frame, a frame with a flipped bit, or random bytes after a start byte."""
    good = link.pack(dialect.CommandLong(param1=1.0, command=400, target_system=6, target_component=1))
    kind = rng.randrange(4)
    if kind == 0:
        return rng.randbytes(rng.randint(1, 300))
    if kind == 1:
        return good[: rng.randint(1, len(good) - 1)]
    place = rng.randrange(1, len(good))
    if kind == 2:
        return good[:place] + bytes([good[place] ^ 1 << rng.randrange(8)]) + good[place + 1 :]
    return rng.choice((b"\xfd", b"\xfe")) + rng.randbytes(rng.randint(0, 290))


def flood(fleet: Fleet, count: int) -> None:
    """Send malformed frames to both ports of a vehicle; check that it counts them, survives and sends no command."""
    rng, link = random.Random(17), Link(255, 190)
    ports = (fleet.px4.gcs_local + DRONES - 1, fleet.px4.api_local + DRONES - 1)
    before = fleet.refused()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.settimeout(1.0)
        for i in range(count // CHUNK):
            for _ in range(CHUNK):
                sender.sendto(malformed(rng, link), ("127.0.0.1", ports[i % 2]))
            until_answered(sender, link, ports[i % 2])
    assert fleet.commands_to("drone6") == 0
    health = fleet.client.subscribe("process/mavlink.px4/health")
    health.until(lambda each: each["refused"] >= before + LEAST_READ * count)
    fleet.px4.role.line("drone6: a frame with a wrong checksum; counted")


def until_answered(sender: socket.socket, link: Link, port: int) -> None:
    """Request the version until it arrives: everything sent earlier has then been read, or lost in a full buffer."""
    parser = Parser()
    ask = link.pack(dialect.CommandLong(param1=148.0, command=512, target_system=6, target_component=1))
    for _ in range(ASKED_MAX):
        sender.sendto(ask, ("127.0.0.1", port))
        with suppress(TimeoutError):
            while True:
                received = parser.feed(sender.recv(65_536))
                if any(isinstance(each.message, dialect.AutopilotVersion) for each in received):
                    return
    pytest.fail(f"no answer on port {port}")


def test_malformed_frames_are_counted_and_nothing_flies(fleet: Fleet) -> None:
    flood(fleet, FRAMES)


@pytest.mark.soak
def test_a_million_malformed_frames_are_counted_and_nothing_flies(fleet: Fleet) -> None:
    flood(fleet, FRAMES_SOAK)


def test_a_signing_key_admits_only_signed_messages(fleet: Fleet, tmp_path: Path) -> None:
    (tmp_path / "key").write_bytes(KEY)
    vehicles = Vehicles(fleet.federation, "signed", "--signing-key", str(tmp_path / "key"))
    port = vehicles.api_local + DRONES - 1
    ask = dialect.CommandLong(param1=148.0, command=512, target_system=6, target_component=1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.settimeout(60.0)
        sender.sendto(Link(255, 190).pack(ask), ("127.0.0.1", port))
        vehicles.role.line("drone6: a frame without a signature; counted")
        theirs = Parser(Signing(KEY))
        for received in theirs.feed(sender.recv(65_536)):
            assert received.signed
            assert not isinstance(received.message, dialect.AutopilotVersion)
        signing = Signing(KEY)
        signing.timestamp = max(theirs_timestamp(theirs), signing.timestamp)
        sender.sendto(Link(255, 190, signing).pack(ask), ("127.0.0.1", port))
        while not any(isinstance(m.message, dialect.AutopilotVersion) for m in theirs.feed(sender.recv(65_536))):
            pass
    assert not +theirs.refused


def theirs_timestamp(parser: Parser) -> int:
    """Return the timestamp of the vehicle's latest signature."""
    assert parser._signing is not None
    return parser._signing.timestamp


def test_a_run_as_fast_as_possible_is_refused_with_the_reason(federation: Federation) -> None:
    federation.world(FLEET, "--expect", "nobody.yet")
    role = federation.start("mavlink", "serve", "--connect", federation.endpoint)
    role.line("--rate 1")
    role.ends(with_code=2)
