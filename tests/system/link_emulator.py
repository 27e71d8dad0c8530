"""A link with delay, jitter and loss: a process that carries Ethernet frames between two interfaces.

    python link_emulator.py INTERFACE INTERFACE DELAY_MS JITTER_MS LOSS SEED

Each direction delays by DELAY_MS ± JITTER_MS and loses the share LOSS of its frames. The delay moves between random
draws PERIOD_NS apart, so that frames keep their order, as on a radio link that retransmits before it hands frames on.
The kernels of test machines often lack netem, which would do the same. The interfaces' offloads must be off, so that
the frames here are those on the wire.
"""

import random
import select
import socket
import sys
import time
from collections import deque

PERIOD_NS = 100_000_000  # between two draws of the delay; keeps the order of frames for jitters up to 50 ms
BUFFER_BYTES = 8 << 20  # socket buffer, for a burst that arrives while the other direction is served
FRAME_BYTES = 65_536  # larger than any frame
ETH_P_ALL = 0x0003  # linux/if_ether.h
PACKET_IGNORE_OUTGOING = 23  # linux/if_packet.h
SOL_PACKET = 263  # linux/socket.h
SO_RCVBUFFORCE = 33  # asm-generic/socket.h


class Direction:
    """Frames in transit from one interface to the other."""

    def __init__(
        self, source: socket.socket, sink: socket.socket, delay_ms: float, jitter_ms: float, loss: float, seed: str
    ) -> None:
        self.source, self._sink = source, sink
        self._delay_ns, self._jitter_ns, self._loss = delay_ms * 1e6, jitter_ms * 1e6, loss
        self._losses, self._delays = random.Random(f"{seed} loss"), random.Random(f"{seed} delay")
        self._under_way: deque[tuple[int, bytes]] = deque()
        self._from_ns, self._from, self._to = 0, self._draw(), self._draw()

    def receive(self) -> None:
        """Read the frames that have arrived."""
        while True:
            try:
                frame = self.source.recv(FRAME_BYTES)
            except BlockingIOError:
                return
            if self._losses.random() >= self._loss:
                now_ns = time.monotonic_ns()
                self._under_way.append((now_ns + self._delay(now_ns), frame))

    def send(self) -> None:
        """Forward the frames that are due."""
        while self._under_way and self._under_way[0][0] <= time.monotonic_ns():
            try:
                self._sink.send(self._under_way.popleft()[1])
            except OSError:
                continue  # the interface is full or down: the frame is lost, as on a radio link

    def due_ns(self) -> int | None:
        """Return the time at which the next frame is due, None if there is none."""
        return self._under_way[0][0] if self._under_way else None

    def _delay(self, now_ns: int) -> int:
        if now_ns - self._from_ns >= PERIOD_NS:
            idle = now_ns - self._from_ns >= 2 * PERIOD_NS
            self._from_ns = now_ns if idle else self._from_ns + PERIOD_NS
            self._from, self._to = self._to, self._draw()
        share = (now_ns - self._from_ns) / PERIOD_NS
        return round(self._from + share * (self._to - self._from))

    def _draw(self) -> float:
        return self._delay_ns + self._delays.uniform(-self._jitter_ns, self._jitter_ns)


def opened(interface: str) -> socket.socket:
    """Return a socket that receives every frame entering an interface."""
    made = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETH_P_ALL))
    made.setsockopt(SOL_PACKET, PACKET_IGNORE_OUTGOING, 1)
    made.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, BUFFER_BYTES)
    made.bind((interface, ETH_P_ALL))
    made.setblocking(False)
    return made


def carry(directions: list[Direction]) -> None:
    """Carry frames until the process is ended."""
    sources = {direction.source: direction for direction in directions}
    while True:
        due = [due_ns for direction in directions if (due_ns := direction.due_ns()) is not None]
        wait_s = max(0.0, (min(due) - time.monotonic_ns()) / 1e9) if due else None
        for source in select.select(list(sources), [], [], wait_s)[0]:
            sources[source].receive()
        for direction in directions:
            direction.send()


def main() -> None:
    here, there, *numbers, seed = sys.argv[1:]
    delay_ms, jitter_ms, loss = map(float, numbers)
    a, b = opened(here), opened(there)
    directions = [
        Direction(a, b, delay_ms, jitter_ms, loss, f"{seed} {here}"),
        Direction(b, a, delay_ms, jitter_ms, loss, f"{seed} {there}"),
    ]
    print("carrying", flush=True)
    carry(directions)


if __name__ == "__main__":
    main()
