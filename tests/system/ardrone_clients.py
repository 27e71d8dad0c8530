"""Unmodified programs for the AR.Drone and a plain pilot of the tests, for drones that `zsim ardrone serve` offers."""

import fcntl
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from federation import Federation, Role
from wire import PATIENCE_S

from zsim_bridges.ardrone import at_commands, navdata
from zsim_bridges.ardrone.at_commands import Command
from zsim_bridges.ardrone.navdata import Navdata, StateBit

SCRIPTS = Path(__file__).parent / "ardrone_clients"
NODE_PACKAGES = ("ar-drone@0.3.3", "ardrone-autonomy@0.1.2")
AGAIN_S = 1.0  # wall time without navdata after which it is requested again, as in ARDroneLib
INSTALLS_S = 120.0  # greatest wall time for npm's installation, on a slow network


def addresses(count: int) -> list[str]:
    """Return loopback addresses that no other test worker uses."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    return [f"127.{64 + worker}.{os.getpid() % 250 + 1}.{2 + i}" for i in range(count)]


def serve(federation: Federation, first: str, *options: str) -> Role:
    """Offer a federation's drones at consecutive addresses from `first` on."""
    where = ("--connect", federation.endpoint, "--addresses", first)
    return federation.start("ardrone", "serve", *where, *options)


def leave_out(reason: str) -> None:
    """Skip a test for a reason outside it; fail in CI, where everything must be installed."""
    if os.environ.get("CI"):
        pytest.fail(reason)
    pytest.skip(reason)


@pytest.fixture(scope="session")
def node_modules() -> Path:
    """Return the folder in which npm has installed programs for the AR.Drone, once per machine."""
    if not (shutil.which("npm") and shutil.which("node")):
        leave_out("node or npm is not installed; on Debian: apt-get install nodejs npm")
    folder = Path(tempfile.gettempdir()) / f"zsim-tests-ardrone-npm-{os.getuid()}"
    folder.mkdir(exist_ok=True)
    with open(folder / "lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "node_modules" / ".complete").exists():
            _install(folder)
    return folder / "node_modules"


def _install(folder: Path) -> None:
    (folder / "package.json").write_text("{}")
    options = ("--no-audit", "--no-fund", "--ignore-scripts", "--fetch-retries", "1")
    try:
        done = subprocess.run(
            ["npm", "install", *options, *NODE_PACKAGES], cwd=folder, capture_output=True, text=True, timeout=INSTALLS_S
        )
    except subprocess.TimeoutExpired:
        leave_out(f"npm has installed nothing within {INSTALLS_S:g} s")
    else:
        if done.returncode:
            leave_out(f"npm cannot install {', '.join(NODE_PACKAGES)}: {done.stderr[-500:]}")
        (folder / "node_modules" / ".complete").touch()


class Program:
    """A running program that flies drones."""

    def __init__(self, *command: object, env: dict[str, str] | None = None) -> None:
        self.process = subprocess.Popen(
            [*map(str, command)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, **(env or {})},
            start_new_session=True,
        )

    def events(self) -> list[dict[str, Any]]:
        """Return the events that it has printed, once it has ended without an error."""
        try:
            output, errors = self.process.communicate(timeout=PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.close()
            return pytest.fail(f"{self.process.args} has not ended")
        assert self.process.returncode == 0, f"{self.process.args}:\n{output}\n{errors}"
        return [json.loads(line) for line in output.splitlines() if line.startswith("{")]

    def close(self) -> None:
        """Kill it and its child processes."""
        if self.process.poll() is None:
            os.killpg(self.process.pid, 9)
            self.process.wait()


def node(script: str, modules: Path, *arguments: str) -> Program:
    """Start a Node.js script with the packages that npm has installed."""
    return Program("node", SCRIPTS / script, *arguments, env={"NODE_PATH": str(modules)})


def python(script: str, *arguments: str) -> Program:
    """Start a Python script."""
    return Program(sys.executable, SCRIPTS / script, *arguments)


class PlainPilot:
    """A pilot's program that uses plain sockets."""

    def __init__(self, address: str) -> None:
        self.address = address
        self._sequence = 0
        self._at = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._navdata = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._navdata.settimeout(AGAIN_S)

    def __enter__(self) -> "PlainPilot":
        return self

    def __exit__(self, *_: object) -> None:
        self._at.close()
        self._navdata.close()

    def request(self) -> None:
        """Request navdata."""
        self._navdata.sendto(navdata.REQUEST_UNICAST, (self.address, navdata.PORT))

    def send(self, *commands: Command) -> None:
        """Send AT commands with this program's next sequence numbers."""
        datagram = b""
        for command in commands:
            datagram += at_commands.format_command(command._replace(sequence=self.next_sequence()))
        self.send_raw(datagram)

    def next_sequence(self) -> int:
        """Return this program's next sequence number."""
        self._sequence += 1
        return self._sequence

    def send_raw(self, datagram: bytes, port: int = at_commands.PORT) -> None:
        """Send a datagram of any bytes."""
        self._at.sendto(datagram, (self.address, port))

    def config(self, key: str, value: str) -> None:
        """Set an entry of the configuration; wait until it is acknowledged and the acknowledgement is cleared."""
        self.send(at_commands.Config(0, key, value))
        self.until(lambda packet: StateBit.COMMAND_ACK in packet.state)
        self.send(at_commands.Control(0, at_commands.ACKNOWLEDGE))
        self.until(lambda packet: StateBit.COMMAND_ACK not in packet.state)

    def receive(self) -> tuple[bytes, tuple[str, int]]:
        """Return the next navdata datagram and its sender's address; if none comes, request again, as the SDK does."""
        until_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < until_s:
            try:
                return self._navdata.recvfrom(65_536)
            except TimeoutError:
                self.request()
        return pytest.fail("no navdata comes")

    def until(self, wanted, act=lambda: None) -> Navdata:
        """Return the next packet for which `wanted` is true; call `act` after each packet before it."""
        for packet in self.packets():
            if wanted(packet):
                return packet
            act()
        raise AssertionError

    def packets(self) -> Iterator[Navdata]:
        """Yield navdata packets."""
        for _ in range(20_000):
            yield navdata.unpack(self.receive()[0])
        pytest.fail("no such packet among 20 000")

    def configuration(self, mode: int = at_commands.SEND_CONFIGURATION) -> bytes:
        """Return what the control port sends in reply to a CTRL command."""
        with socket.create_connection((self.address, at_commands.CONTROL_PORT), PATIENCE_S) as control:
            data = b""
            while not data.endswith(b"\0"):
                self.send(at_commands.Control(0, mode))  # repeated: it may arrive before the connection is accepted
                control.settimeout(0.5)
                try:
                    data += control.recv(65_536)
                except TimeoutError:
                    continue
            return data
