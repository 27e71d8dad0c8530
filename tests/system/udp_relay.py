"""A radio link between UDP ports with delay, jitter, loss and cuts.

    python udp_relay.py DELAY_MS JITTER_MS LOSS SEED HOST:PORT=HOST:PORT ...

Datagrams to the first address of a pair are relayed to the second; answers go back to the latest sender. The delay
varies slowly, so that datagrams keep their order, as on a radio that retransmits. A line `cut SECONDS` on standard
input blocks all traffic for that time; `done` on standard output reports its end.
"""

import asyncio
import random
import sys
from typing import Any

PERIOD_S = 0.1  # time between two draws of the delay


class Radio:
    """The delay and loss of datagrams."""

    def __init__(self, delay_ms: float, jitter_ms: float, loss: float, seed: int) -> None:
        self._delay_s, self._jitter_s, self._loss = delay_ms / 1e3, jitter_ms / 1e3, loss
        self._draw = random.Random(seed)
        self._from_s, self._a, self._b = 0.0, self._delay(), self._delay()
        self.is_cut = False

    def _delay(self) -> float:
        return self._delay_s + self._draw.uniform(-self._jitter_s, self._jitter_s)

    def delay_s(self, now_s: float) -> float | None:
        """Return the delay of a datagram, or None if it is lost."""
        while now_s - self._from_s > PERIOD_S:
            self._from_s = max(self._from_s + PERIOD_S, now_s - PERIOD_S)
            self._a, self._b = self._b, self._delay()
        share = (now_s - self._from_s) / PERIOD_S
        lost = self.is_cut or self._draw.random() < self._loss
        return None if lost else self._a + share * (self._b - self._a)


class Near(asyncio.DatagramProtocol):
    """The port to which one side sends; the other side has its own."""

    def __init__(self, radio: Radio) -> None:
        self._radio = radio
        self.far: asyncio.DatagramTransport | None = None
        self.near: Any = None
        self._last: Any = None

    def connection_made(self, transport: Any) -> None:
        self.near = transport

    def datagram_received(self, data: bytes, addr: Any) -> None:
        self._last = addr
        self._later(lambda: self.far.sendto(data) if self.far else None)

    def back(self, data: bytes) -> None:
        last = self._last
        if last is not None:
            self._later(lambda: self.near.sendto(data, last))

    def _later(self, send: Any) -> None:
        loop = asyncio.get_running_loop()
        delay_s = self._radio.delay_s(loop.time())
        if delay_s is not None:
            loop.call_later(delay_s, send)

    def error_received(self, exc: Exception) -> None:
        """Ignore that the other side does not listen yet."""


class Far(asyncio.DatagramProtocol):
    """The side to which datagrams are relayed."""

    def __init__(self, near: Near) -> None:
        self._near = near

    def datagram_received(self, data: bytes, addr: Any) -> None:
        self._near.back(data)

    def error_received(self, exc: Exception) -> None:
        """Ignore that the other side does not listen yet."""


def address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    return host, int(port)


async def run(radio: Radio, pairs: list[str]) -> None:
    loop = asyncio.get_running_loop()
    for pair in pairs:
        here, there = map(address, pair.split("="))
        _, near = await loop.create_datagram_endpoint(lambda: Near(radio), local_addr=here)
        near.far, _ = await loop.create_datagram_endpoint(lambda near=near: Far(near), remote_addr=there)
    print("ready", flush=True)
    while line := await asyncio.to_thread(sys.stdin.readline):
        radio.is_cut = True
        await asyncio.sleep(float(line.split()[1]))
        radio.is_cut = False
        print("done", flush=True)


if __name__ == "__main__":
    delay, jitter, loss, seed, *addresses = sys.argv[1:]
    asyncio.run(run(Radio(float(delay), float(jitter), float(loss), int(seed)), addresses))
