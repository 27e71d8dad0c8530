"""Formations of which one drone is hardware: another world plays it, and its own wire joins the two."""

import signal
import socket
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from ardrone_clients import addresses
from federation import Federation, Role
from loop_truth import true_formation
from wire import Client, Subscription

FORMATION = """
name: mixed
seed: 4
duration_s: 600
sensors: {preset: paper}
environment: {wind: {gust_m_s: 0.3}}
drones:
  - {name: drone1, position_m: [0.0, 2.0, 0.0], yaw_deg: 90}
  - {name: drone2, position_m: [-2.0, -2.0, 0.0], yaw_deg: 90}
  - {name: drone3, position_m: [2.0, -2.0, 0.0], yaw_deg: 90BODY}
clusters:
  - {name: main, drones: [drone1, drone2, drone3], plan: {takeoff_s: 8}}
"""
"""Three drones that take off when the estimators know where they are."""
EXTERNAL, SIMULATED = FORMATION.replace("BODY", ", body: external"), FORMATION.replace("BODY", "")
PACE = ("--realtime", "--rate", "2")
SECOND_NS = 1_000_000_000
DRONES = 3


def udp_ports(count: int) -> int:
    """Return the first of so many UDP ports in a row that nobody has."""
    while True:
        with ExitStack() as stack:
            try:
                first = bound(stack, 0)
                for port in range(first + 1, first + count):
                    bound(stack, port)
                return first
            except (OSError, OverflowError):
                continue


def bound(stack: ExitStack, port: int) -> int:
    """Bind a UDP port until the stack is closed; return its number."""
    opened = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    opened.bind(("127.0.0.1", port))
    return opened.getsockname()[1]


class Hardware:
    """A world whose drones are offered on the wires of real aircraft, and its record."""

    def __init__(self, folder: Path) -> None:
        self.federation = Federation(folder)
        alone = ("--set", "clusters=[]", "--set", "processes.expect=[recorder]")
        self.world = self.federation.world(SIMULATED, *PACE, *alone)
        self.recorder = self.federation.role("record", "--out", str(self.federation.out))

    def mavlink(self, autopilot: str) -> tuple[str, ...]:
        """Serve MAVLink; return the arguments with which drone3 is driven."""
        api, gcs, api_local, gcs_local = (udp_ports(DRONES) for _ in range(4))
        ports = ("--api", f"127.0.0.1:{api}", "--gcs", f"127.0.0.1:{gcs}", "--autopilot", autopilot)
        local = ("--api-local", str(api_local), "--gcs-local", str(gcs_local))
        self.federation.role("mavlink", "serve", *ports, *local).line("programs: UDP")
        return "mavlink", "drive", "drone3", f"udp://127.0.0.1:{api_local + 2}"

    def ardrone(self) -> tuple[str, ...]:
        """Serve the AR.Drone's wire; return the arguments with which drone3 is driven."""
        (address,) = addresses(1)
        self.federation.role("ardrone", "serve", "--addresses", f"drone3={address}").line("drone3 is an AR.Drone")
        return "ardrone", "drive", "drone3", address


class Mixed:
    """The run with the hardware in it."""

    def __init__(self, federation: Federation) -> None:
        self.federation = federation
        self.run: Role = federation.run(EXTERNAL, *PACE)
        self.client: Client = federation.client()
        self.formation: Subscription = self.client.subscribe("cluster/main/state")
        self.status: Subscription = self.client.subscribe("drone/drone3/sensor/status")
        self.links: Subscription = self.client.subscribe("drone/drone3/link")

    def engaged_ns(self, after_ns: int = 0) -> int:
        """Wait until the formation is engaged; return when [ns]."""
        return self.formation.until(lambda m: m["phase"] == "engaged" and m["t_ns"] > after_ns).message["t_ns"]

    def until(self, state: str, after_ns: int = 0) -> int:
        """Wait for a state of drone3; return when [ns]."""
        return self.status.until(lambda m: m["state"] == state and m["t_ns"] > after_ns).message["t_ns"]

    def ends(self) -> None:
        assert self.client.request("cluster/main/control", "land")["ok"]
        self.until("landing")
        self.until("landed")
        assert self.client.request("world/control", "stop")["ok"]
        self.run.ends(with_code=0)


@pytest.fixture
def hardware(tmp_path: Path, compiled: None) -> Iterator[Hardware]:
    made = Hardware(tmp_path / "hardware")
    with made.federation:
        yield made


@pytest.fixture
def mixed(tmp_path: Path, compiled: None) -> Iterator[Mixed]:
    with Federation(tmp_path / "mixed") as federation:
        yield Mixed(federation)


def true_rms(mixed: Mixed, hardware: Hardware, window_s: tuple[float, float]) -> dict[str, float]:
    """Return the RMS errors in truth, drone3's being that of the hardware."""
    formation = true_formation(mixed.federation.out / "run.mcap", hardware.federation.out / "run.mcap", ["drone3"], 2.0)
    rows = formation.true_error[formation.within(window_s)]
    return dict(zip(formation.names, np.sqrt(np.mean(rows**2, axis=0)).tolist(), strict=True))


@pytest.mark.parametrize("wire", ["px4", "ardupilot", "ardrone"])
def test_two_simulated_drones_and_one_of_hardware_fly_in_formation(hardware: Hardware, mixed: Mixed, wire: str) -> None:
    drive = hardware.ardrone() if wire == "ardrone" else hardware.mavlink(wire)
    driver = mixed.federation.role(*drive, "--armed")
    engaged_ns = mixed.engaged_ns()
    until_ns = mixed.engaged_ns(engaged_ns + 20 * SECOND_NS)
    link = mixed.links.now()[-1].message
    assert (link["state"], link["source"]) == ("armed", "driver.drone3")
    assert link["loss_percent"] < 5
    mixed.ends()
    driver.line("left")
    assert hardware.federation.client().request("world/control", "stop")["ok"]
    hardware.recorder.ends(with_code=0)
    rms = true_rms(mixed, hardware, (engaged_ns / 1e9 + 8, until_ns / 1e9))
    assert max(rms["x_c"], rms["y_c"], rms["p"], rms["q"]) < 1.0  # m: the GPS alone has 2
    assert max(rms["z_c"], rms["yaw"], rms["beta"]) < 0.3


def test_a_driver_that_is_killed_in_flight_and_started_again_flies_on(hardware: Hardware, mixed: Mixed) -> None:
    drive = hardware.mavlink("px4")
    driver = mixed.federation.role(*drive, "--armed")
    engaged_ns = mixed.engaged_ns()
    driver.signal(signal.SIGKILL)
    held = mixed.formation.until(lambda m: m["phase"] != "engaged" or "drone3" in m["reason"]).message
    mixed.federation.role(*drive, "--armed")
    mixed.engaged_ns(max(held["t_ns"], engaged_ns) + 5 * SECOND_NS)
    mixed.ends()
