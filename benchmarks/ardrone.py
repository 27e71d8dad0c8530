"""The cost of `zsim ardrone serve`: processor time at full navdata, and the age of a command that passes through it.

    python -m benchmarks.ardrone [--drones 20] [--seconds 10]

The world runs in realtime; each drone has a pilot that receives full navdata and sends REF and PCMD every 30 ms, as the
SDK does. The age is measured from sending a PCMD that differs from the last one to the arrival of the command at a
Zenoh client; for comparison, a message of 100 bytes is timed from one Zenoh client to another.
"""

import argparse
import json
import math
import os
import selectors
import socket
import sys
import tempfile
import time
from pathlib import Path

import msgpack
import zenoh

from benchmarks.child import Server
from benchmarks.exchange.lap import free_port
from zsim_bridges.ardrone import at_commands, navdata

PERIOD_S = 0.03  # command period of the SDK
FIRST = "127.9.0.2"
TICKS_PER_S = os.sysconf("SC_CLK_TCK")
PROBE_S = 0.05  # wall time between timed messages
READY_S = 60.0
INDOOR_RAD = 0.20944  # rad; value of control:euler_angle_max


def scenario(drones: int) -> str:
    rows = "".join(f"  - {{name: drone{i + 1}, position_m: [{20 * i}, 0, 0]}}\n" for i in range(drones))
    return f"name: ardrones\nduration_s: 3600\ndrones:\n{rows}processes: {{expect: []}}\n"


class Pilots:
    """The pilots of all drones, in this process."""

    def __init__(self, addresses: list[str]) -> None:
        self.addresses = addresses
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        self._socket.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._socket, selectors.EVENT_READ)
        self._sequence = 0
        self.flies = False
        self.packets: dict[str, int] = dict.fromkeys(addresses, 0)
        self.states: dict[str, int] = {}

    def begin(self) -> None:
        for address in self.addresses:
            self._socket.sendto(navdata.REQUEST_UNICAST, (address, navdata.PORT))
            self._send(address, at_commands.Config(0, "general:navdata_demo", "FALSE"))

    def _send(self, address: str, *commands: at_commands.Command) -> None:
        datagram = b""
        for command in commands:
            self._sequence += 1
            datagram += at_commands.format_command(command._replace(sequence=self._sequence))
        self._socket.sendto(datagram, (address, at_commands.PORT))

    def steer(self, share: float = 0.0, only: str = "") -> None:
        """Send the REF and PCMD that the SDK sends every 30 ms; `share` is the pitch over its limit, from -1 to 1."""
        for address in [only] if only else self.addresses:
            pcmd = at_commands.Pcmd(0, int(share != 0.0), 0.0, share, 0.0, 0.0)
            self._send(address, at_commands.ref(0, self.flies), pcmd)

    def read(self, until_s: float) -> None:
        while (left_s := until_s - time.monotonic()) > 0:
            for _ in self._selector.select(left_s):
                self._drain()

    def _drain(self) -> None:
        try:
            while True:
                datagram, (address, _) = self._socket.recvfrom(4096)
                self.packets[address] += 1
                if len(datagram) > 24:
                    self.states[address] = int.from_bytes(datagram[20:24], "little") >> 16
        except BlockingIOError:
            return

    def hover_all(self) -> None:
        self.flies = True
        until_s = time.monotonic() + READY_S
        while any(self.states.get(address) != navdata.ControlState.HOVERING for address in self.addresses):
            if time.monotonic() > until_s:
                raise SystemExit(f"not all drones hover: {self.states}")
            self.steer()
            self.read(time.monotonic() + PERIOD_S)


def measure(drones: int, seconds: float) -> dict[str, float]:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    zsim = (sys.executable, "-m", "zsim_deploy.cli")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ardrones.yaml"
        path.write_text(scenario(drones))
        world = Server([*zsim, "world", str(path), "--listen", endpoint, "--realtime"])
        served = Server([*zsim, "ardrone", "serve", "--connect", endpoint, "--addresses", FIRST])
        try:
            return _measured(endpoint, served, drones, seconds)
        finally:
            served.close()
            world.close()


def _measured(endpoint: str, served: Server, drones: int, seconds: float) -> dict[str, float]:
    base, _, last = FIRST.rpartition(".")
    pilots = Pilots([f"{base}.{int(last) + i}" for i in range(drones)])
    _await_navdata(pilots)
    pilots.hover_all()
    with _client(endpoint) as one, _client(endpoint) as other:
        pid = served.pid
        packets, ticks, wall_s = dict(pilots.packets), _ticks(pid), time.monotonic()
        ages_ms = _ages_ms(one, pilots, seconds)
        spent_s = time.monotonic() - wall_s
        share = (_ticks(pid) - ticks) / TICKS_PER_S / spent_s
        rates = [(pilots.packets[address] - packets[address]) / spent_s for address in pilots.addresses]
        bare_ms = _bare_ms(one, other, pilots)
    return {
        "drones": drones,
        "cores": round(share, 3),
        "navdata_hz": round(sum(rates) / drones, 1),
        "commands": len(ages_ms),
        **{f"age_{name}_ms": value for name, value in _quantiles(ages_ms).items()},
        **{f"zenoh_{name}_ms": value for name, value in _quantiles(bare_ms).items()},
    }


def _await_navdata(pilots: Pilots) -> None:
    until_s = time.monotonic() + READY_S
    while len(pilots.states) < len(pilots.addresses):
        if time.monotonic() > until_s:
            raise SystemExit("no navdata arrived")
        pilots.begin()
        pilots.read(time.monotonic() + 0.3)


def _ages_ms(session: zenoh.Session, pilots: Pilots, seconds: float) -> list[float]:
    """Steer for `seconds`; return the times from sending each timed command to its arrival on its key [ms]."""
    sent_s: dict[float, float] = {}
    ages_ms: list[float] = []

    def take(sample: zenoh.Sample) -> None:
        arrived_s = time.monotonic()
        begun_s = sent_s.pop(round(msgpack.unpackb(sample.payload.to_bytes())["forward"], 5), None)
        if begun_s is not None:
            ages_ms.append(1e3 * (arrived_s - begun_s))

    subscriber = session.declare_subscriber("zsim/drone/drone1/cmd/ardrone", take)
    k, until_s = 0, time.monotonic() + seconds
    while time.monotonic() < until_s:
        k += 1
        share = 0.001 * (k % 97 + 1)
        pilots.steer()
        sent_s[round(_forward(share * INDOOR_RAD), 5)] = time.monotonic()
        pilots.steer(-share, only=pilots.addresses[0])
        pilots.read(time.monotonic() + PERIOD_S)
    subscriber.undeclare()
    return ages_ms


def _forward(tilt_rad: float) -> float:
    """Return the `forward` of a command, tan(tilt) / tan(zsim's tilt limit), by which the command is recognised."""
    sent = at_commands.bits_to_float(at_commands.float_to_bits(tilt_rad / INDOOR_RAD))
    return math.tan(sent * INDOOR_RAD) / math.tan(math.radians(20.0))


def _bare_ms(one: zenoh.Session, other: zenoh.Session, pilots: Pilots) -> list[float]:
    """Return the latencies from one Zenoh client to another [ms]."""
    begun_s: list[float] = [0.0]
    ages_ms: list[float] = []
    key = "zsim/bench/age"
    subscriber = other.declare_subscriber(key, lambda _: ages_ms.append(1e3 * (time.monotonic() - begun_s[0])))
    publisher = one.declare_publisher(key, express=True)
    for _ in range(100):
        pilots.steer()
        pilots.read(time.monotonic() + PROBE_S)
        begun_s[0] = time.monotonic()
        publisher.put(b"x" * 100)
    pilots.read(time.monotonic() + PROBE_S)
    subscriber.undeclare()
    return ages_ms


def _client(endpoint: str) -> zenoh.Session:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


def _ticks(pid: int) -> int:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return int(fields[11]) + int(fields[12])


def _quantiles(values_ms: list[float]) -> dict[str, float]:
    ordered = sorted(values_ms)
    return {
        "p50": round(ordered[len(ordered) // 2], 2),
        "p99": round(ordered[int(0.99 * (len(ordered) - 1))], 2),
    }


if __name__ == "__main__":
    options = argparse.ArgumentParser()
    options.add_argument("--drones", type=int, default=20)
    options.add_argument("--seconds", type=float, default=10.0)
    given = options.parse_args()
    print(json.dumps(measure(given.drones, given.seconds)))
