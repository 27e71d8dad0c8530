"""A client of a gateway or of a bare server: takes one measurement and prints it as a line of JSON.

.venv/bin/python -m benchmarks.doors.client get --port 8000 --seconds 2
"""

import argparse
import asyncio
import json
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

import aiohttp
import msgspec
import zenoh

CONNECTIONS = 4  # number of HTTP connections, kept open
KEY = "bench/value"
MESSAGE = {"t_ns": 0, "seq": 0, "accel_m_s2": [0.1, 0.2, 9.81], "gyro_rad_s": [0.01, 0.02, 0.03]}
AHEAD = 2_000  # maximum number of messages under way; the gateway's queue for a client holds about 20 000 of these
PACE_S = 0.002  # time between messages whose latency is measured, so that none waits for another


def quantiles(took_s: list[float]) -> dict[str, float]:
    took_s.sort()
    return {"p50": 1e3 * took_s[len(took_s) // 2], "p99": 1e3 * took_s[int(0.99 * len(took_s))]}


async def rest(port: int, seconds: float, method: str) -> dict[str, float]:
    """Send requests on several connections, then on one; return the former's rate [1/s], the latter's latency [ms]."""
    url = f"http://127.0.0.1:{port}/json/{KEY}"
    body = json.dumps(MESSAGE).encode()
    took_s: list[float] = []

    async def ask(until_s: float, taken: list[float]) -> None:
        while (start_s := time.perf_counter()) < until_s:
            async with session.request(method, url, data=body if method == "PUT" else None) as answer:
                assert answer.status == 200, await answer.text()
                await answer.read()
            taken.append(time.perf_counter() - start_s)

    async with aiohttp.ClientSession() as session:
        async with session.put(url, data=body) as answer:
            assert answer.status == 200, await answer.text()
        many: list[float] = []
        await asyncio.gather(*(ask(time.perf_counter() + seconds, many) for _ in range(CONNECTIONS)))
        await ask(time.perf_counter() + seconds, took_s)
    return {"rate": len(many) / seconds, **quantiles(took_s)}


def trip(port: int, seconds: float) -> dict[str, float]:
    """Request a last value on the gateway's port for lines, one request after another."""
    stream = Lines(port)
    stream.ask({"op": "put", "key": KEY, "value": MESSAGE})
    took_s: list[float] = []
    until_s = time.perf_counter() + seconds
    while (start_s := time.perf_counter()) < until_s:
        stream.ask({"op": "latest", "key": KEY})
        took_s.append(time.perf_counter() - start_s)
    return {"rate": len(took_s) / seconds, **quantiles(took_s)}


def zenoh_flow(port: int, endpoint: str, seconds: float) -> dict[str, float]:
    """Publish and receive on Zenoh; return messages per second, and their latency at a slow pace."""
    with zenoh.open(_config(endpoint)) as sender, zenoh.open(_config(endpoint)) as receiver:
        taker = Taker()
        declared = receiver.declare_subscriber(f"zsim/{KEY}", lambda sample: taker.take(sample.payload.to_bytes()))
        found = _flow(sender, taker, seconds)
        declared.undeclare()
    return found


def lines_flow(port: int, endpoint: str, seconds: float) -> dict[str, float]:
    """Publish on Zenoh, and receive on the gateway's port for lines; return the same quantities as `zenoh_flow`."""
    with zenoh.open(_config(endpoint)) as sender:
        taker, stream = Taker(), Lines(port)
        stream.ask({"op": "subscribe", "key": KEY})
        threading.Thread(target=stream.pump, args=(taker.take_line,), daemon=True).start()
        return _flow(sender, taker, seconds)


def _flow(sender: zenoh.Session, taker: "Taker", seconds: float) -> dict[str, float]:
    publisher = sender.declare_publisher(f"zsim/{KEY}", congestion_control=zenoh.CongestionControl.BLOCK)
    while not taker.came_s:
        _put(publisher, -1)
        time.sleep(PACE_S)
    return {**_latency(publisher, taker, seconds), "rate": _rate(publisher, taker, seconds)}


class Taker:
    def __init__(self) -> None:
        self.came_s: dict[int, float] = {}

    def take(self, payload: bytes) -> None:
        self.came_s[msgspec.msgpack.decode(payload)["seq"]] = time.perf_counter()

    def take_line(self, line: bytes) -> None:
        self.came_s[json.loads(line)["value"]["seq"]] = time.perf_counter()

    def until(self, count: int, timeout_s: float = 60.0) -> None:
        until_s = time.perf_counter() + timeout_s
        while len(self.came_s) < count:
            assert time.perf_counter() < until_s, f"{len(self.came_s)} of {count} messages arrived"
            time.sleep(PACE_S)


class Lines:
    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port))
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._file = self._socket.makefile("rb")

    def ask(self, request: dict[str, Any]) -> dict[str, Any]:
        self._socket.sendall(json.dumps(request).encode() + b"\n")
        return json.loads(self._file.readline())

    def pump(self, take: Callable[[bytes], None]) -> None:
        for line in self._file:
            take(line)


def _latency(publisher: zenoh.Publisher, taker: Taker, seconds: float) -> dict[str, float]:
    taker.came_s.clear()
    sent_s = []
    for seq in range(int(seconds / PACE_S)):
        sent_s.append(time.perf_counter())
        _put(publisher, seq)
        time.sleep(PACE_S)
    taker.until(len(sent_s))
    return quantiles([taker.came_s[seq] - sent for seq, sent in enumerate(sent_s)])


def _rate(publisher: zenoh.Publisher, taker: Taker, seconds: float) -> float:
    """Publish without pauses, never more than AHEAD messages ahead of the receiver; return messages per second."""
    taker.came_s.clear()
    start_s = time.perf_counter()
    sent = 0
    while time.perf_counter() < start_s + seconds:
        if sent - len(taker.came_s) < AHEAD:
            _put(publisher, sent)
            sent += 1
        else:
            time.sleep(PACE_S / 4)
    taker.until(sent)
    return sent / (time.perf_counter() - start_s)


def _put(publisher: zenoh.Publisher, seq: int) -> None:
    publisher.put(msgspec.msgpack.encode({**MESSAGE, "seq": seq}))


def _config(endpoint: str) -> zenoh.Config:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    return config


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=["get", "put", "trip", "lines", "zenoh"])
    parser.add_argument(
        "--port", type=int, required=True, help="port of HTTP for get and put, of lines otherwise; zenoh ignores it"
    )
    parser.add_argument("--endpoint", default="", help="endpoint of the world, for lines and zenoh")
    parser.add_argument("--seconds", type=float, default=2.0)
    given = parser.parse_args()
    if given.what in ("get", "put"):
        found = asyncio.run(rest(given.port, given.seconds, given.what.upper()))
    elif given.what == "trip":
        found = trip(given.port, given.seconds)
    else:
        flow = lines_flow if given.what == "lines" else zenoh_flow
        found = flow(given.port, given.endpoint, given.seconds)
    print(json.dumps(found))


if __name__ == "__main__":
    main()
