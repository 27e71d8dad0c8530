"""CPU load of `zsim mavlink serve`, and the delay it adds to a command.

.venv/bin/python -m benchmarks.mavlink_vehicles [--drones 20] [--seconds 10]

All drones of a realtime run fly as ArduPilot vehicles that send full-rate telemetry, each to a ground station and a
program. A setpoint's age is the time from sending its datagram to the arrival of its command at a Zenoh subscriber; for
comparison, a plain put on another key is timed to a subscriber of the same session. The difference is the
delay added.
"""

import argparse
import os
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import zenoh

from benchmarks.child import Server
from benchmarks.exchange.lap import free_port
from zsim_bridges.mavlink import dialect
from zsim_bridges.mavlink.dialect import Link, Parser

HEIGHT_M = 3.0
SETPOINTS_HZ = 20.0  # setpoint rate of MAVSDK
PATIENCE_S = 60.0
GUIDED, ARM, TAKEOFF, SET_MODE = 4, 400, 22, 176
VELOCITY_ONLY = 0xFC7 | 0x200
TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")


class Ports(NamedTuple):
    world: int
    gcs: int
    api: int
    gcs_local: int
    api_local: int


class Figures(NamedTuple):
    """The measurements: cores used, messages and bytes per second to one client, sorted ages [ms]."""

    cores: float
    messages_hz: float
    bytes_hz: float
    mavlink_ms: list[float]
    zenoh_ms: list[float]


def scenario(drones: int) -> str:
    places = "\n".join(f"  - {{name: drone{i + 1}, position_m: [{4 * i}, 0, 0]}}" for i in range(drones))
    return (
        f"name: vehicles\nduration_s: 3600\nsensors: {{preset: paper}}\ndrones:\n{places}\nprocesses: {{expect: []}}\n"
    )


class Program:
    def __init__(self, ports: Ports, index: int) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", ports.api + index))
        self.socket.settimeout(PATIENCE_S)
        self._to = ("127.0.0.1", ports.api_local + index)
        self._system = index + 1
        self._link, self._parser = Link(255, 190), Parser()

    def take_off(self) -> None:
        """Switch to guided mode, arm and take off; return once within 0.3 m of HEIGHT_M."""
        self.until(lambda message: isinstance(message, dialect.LocalPositionNed))
        for command, params in ((SET_MODE, (1.0, GUIDED)), (ARM, (1.0,)), (TAKEOFF, (0,) * 6 + (HEIGHT_M,))):
            values = (*params, *(0.0,) * (7 - len(params)))
            self.send(dialect.CommandLong(self._system, 1, command, 0, *values))
        self.until(lambda message: isinstance(message, dialect.LocalPositionNed) and message.z < 0.3 - HEIGHT_M)

    def steer(self, speed_m_s: float) -> None:
        self.send(dialect.SetPositionTargetLocalNed(0, self._system, 1, 1, VELOCITY_ONLY, vz=speed_m_s))

    def send(self, message: dialect.CommandLong | dialect.SetPositionTargetLocalNed) -> None:
        self.socket.sendto(self._link.pack(message), self._to)

    def until(self, true: Callable[[Any], bool]) -> None:
        """Read messages until one satisfies `true`."""
        while not any(true(each.message) for each in self._parser.feed(self.socket.recv(65_536))):
            pass

    def read_for(self, seconds: float) -> tuple[int, int]:
        """Return the number of messages and of bytes received in `seconds`."""
        messages = size = 0
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            data = self.socket.recv(65_536)
            messages += len(self._parser.feed(data))
            size += len(data)
        return messages, size


@contextmanager
def served(drones: int) -> Iterator[tuple[Ports, int]]:
    """Run a world and its MAVLink server; yield their ports and the server's process id."""
    ports = Ports(free_port(), free_port(), 41_000, 42_000, 43_000)
    zsim, endpoint = (sys.executable, "-m", "zsim_deploy.cli"), f"tcp/127.0.0.1:{ports.world}"
    where = ("--gcs", f"127.0.0.1:{ports.gcs}", "--api", f"127.0.0.1:{ports.api}")
    local = ("--gcs-local", str(ports.gcs_local), "--api-local", str(ports.api_local))
    options = ("--autopilot", "ardupilot", "--telemetry", "full", "--connect", endpoint)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "vehicles.yaml"
        path.write_text(scenario(drones))
        world = Server([*zsim, "world", str(path), "--realtime", "--listen", endpoint])
        serve = Server([*zsim, "mavlink", "serve", *where, *local, *options])
        try:
            yield ports, serve.pid
        finally:
            serve.close()
            world.close()


def cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) * TICK_S


def subscribed(endpoint: str, arrivals: dict[str, list[float]]) -> zenoh.Session:
    """Return a session that appends arrival times to `arrivals`, by key."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    session = zenoh.open(config)

    def note(sample: zenoh.Sample) -> None:
        arrivals.setdefault(str(sample.key_expr), []).append(time.perf_counter())

    session.declare_subscriber("zsim/drone/drone1/cmd/*", zenoh.handlers.Callback(note, indirect=False))
    session.declare_subscriber("zsim/echo/setpoint", zenoh.handlers.Callback(note, indirect=False))
    return session


def age_ms(arrived: list[float], send: Callable[[], None]) -> list[float]:
    """Send a message; return its age on arrival [ms], or an empty list if it is not there when the next is due."""
    arrived.clear()
    sent_s = time.perf_counter()
    send()
    time.sleep(0.5 / SETPOINTS_HZ)  # half a period, as two kinds of message alternate
    return [1e3 * (arrived[0] - sent_s)] if arrived else []


def ages_ms(program: Program, ports: Ports, count: int) -> tuple[list[float], list[float]]:
    """Return the sorted ages [ms], at a subscriber, of setpoints sent by MAVLink, and of plain Zenoh messages."""
    arrivals: dict[str, list[float]] = {}
    endpoint = f"tcp/127.0.0.1:{ports.world}"
    with subscribed(endpoint, arrivals), subscribed(endpoint, {}) as other:
        publisher = other.declare_publisher("zsim/echo/setpoint", congestion_control=zenoh.CongestionControl.BLOCK)
        ways = {
            "zsim/drone/drone1/cmd/velocity": lambda i: program.steer(0.1 if i % 2 else -0.1),
            "zsim/echo/setpoint": lambda _: publisher.put(b"x" * 120),
        }
        ages: dict[str, list[float]] = {key: [] for key in ways}
        for i in range(count):
            for key, send in ways.items():
                ages[key] += age_ms(arrivals.setdefault(key, []), lambda i=i, send=send: send(i))
    mavlink, alone = (sorted(each) for each in ages.values())
    return mavlink, alone


def measure(drones: int, seconds: float) -> Figures:
    with served(drones) as (ports, pid):
        programs = [Program(ports, i) for i in range(drones)]
        threads = [threading.Thread(target=program.take_off) for program in programs]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        before_s, start_s = cpu_s(pid), time.monotonic()
        messages, size = programs[0].read_for(seconds)
        elapsed_s = time.monotonic() - start_s
        cores = (cpu_s(pid) - before_s) / elapsed_s
        found = ages_ms(programs[0], ports, int(seconds * SETPOINTS_HZ))
    return Figures(cores, messages / elapsed_s, size / elapsed_s, *found)


def quantile(values: list[float], share: float) -> float:
    """Return the `share` quantile (0 to 1) of sorted values."""
    return values[min(len(values) - 1, int(share * len(values)))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--drones", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=10.0)
    args = parser.parse_args()
    found = measure(args.drones, args.seconds)
    print(f"{args.drones} vehicles: {found.cores:.3f} cores; each sends {found.messages_hz:.0f} messages, ", end="")
    print(f"{found.bytes_hz / 1e3:.1f} kB a second to each of two clients")
    for name, ages in (("MAVLink to the key", found.mavlink_ms), ("Zenoh to the key", found.zenoh_ms)):
        print(f"{name}: p50 {quantile(ages, 0.5):.2f} ms, p99 {quantile(ages, 0.99):.2f} ms of {len(ages)}")
    added = quantile(found.mavlink_ms, 0.99) - quantile(found.zenoh_ms, 0.99)
    print(f"added: p50 {quantile(found.mavlink_ms, 0.5) - quantile(found.zenoh_ms, 0.5):.2f} ms, p99 {added:.2f} ms")


if __name__ == "__main__":
    main()
