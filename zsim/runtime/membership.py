"""The messages of a process about itself (join, done, bye and health), on Zenoh and on the in-memory bus.

Also schedules garbage collection so that it does not delay gates.
"""

import gc
import os
import socket
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass

from msgspec import UNSET

from zsim import __version__
from zsim.contract.fingerprint import fingerprint
from zsim.contract.run_messages import Bye, Done, Health, Join
from zsim.runtime.rate_limit import RateLimit

PERIOD_S = 1.0  # interval of health messages; contract: 1 Hz wall
STEPS_KEPT = 1000
READS_MAX = 8  # maximum number of key expressions listed in a health message
ALLOCATIONS = 50_000  # allocations between collections, chosen: a gate allocates hundreds of objects, without cycles


@dataclass
class Membership:
    """The join, dones and bye of a process."""

    name: str  # name of the process, role.thing
    host: str  # host on which it runs
    run_id: str
    next_seq: Callable[[str], int]  # returns the sequence number of its next message of a kind, counted from 0
    serves: tuple[str, ...] = ()  # names of the processes that it replaces
    period_ns: int = 0  # interval of its dones; 0: none
    slack_ns: int = 0  # without a period: how far the world may be ahead of its dones; 0: any time
    calculates: bool = True  # whether its results depend on its arithmetic; otherwise it states no fingerprint
    incarnation: int = 0  # random number of the process; 0 if processes are never restarted

    def join(self, t_ns: int = 0) -> Join:
        return Join(
            t_ns=t_ns,
            seq=self.next_seq("join"),
            run_id=self.run_id,
            incarnation=self.incarnation,
            role=self.name.partition(".")[0],
            host=self.host,
            pid=os.getpid(),
            period_ns=self.period_ns,
            version=__version__,
            fingerprint=fingerprint() if self.calculates else "",
            serves=self.serves,
            slack_ns=self.slack_ns,
        )

    def done(self, t_ns: int, sent: int) -> Done:
        """Return the done of a gate, with the number of outputs sent since the last done."""
        return Done(t_ns, self.next_seq("done"), self.run_id, self.incarnation, t_ns, sent)

    def bye(self, t_ns: int, reason: str, failed: bool = False) -> Bye:
        return Bye(t_ns, self.next_seq("bye"), reason, failed or UNSET, self.run_id, self.incarnation)


class HealthMeter:
    """Counters of one process.

    Attributes:
        received, refused, dropped: messages received, undecodable messages, and gates stepped incomplete.
    """

    def __init__(
        self,
        role: str,
        wall_s: Callable[[], float] = time.monotonic,
        host: str | None = None,
        reads: Sequence[str] = (),  # the key expressions it subscribes to: the live list of its session
    ) -> None:
        self._role = role
        self._host = host or socket.gethostname()
        self._reads = reads
        self._steps_us: deque[float] = deque(maxlen=STEPS_KEPT)
        self._limit = RateLimit(PERIOD_S, now=wall_s)
        self._limit.spend()  # the first health message is due after one period
        self.received = self.refused = self.dropped = 0
        self.lag_ns = 0  # how far the newest gate is ahead of the gate just handled
        self.link_lost = False  # whether the world is currently unreachable

    def step(self, duration_ns: int) -> None:
        self._steps_us.append(duration_ns / 1000)

    def due(self) -> bool:
        """Whether a health message is due, once per wall second; the call counts as its publication."""
        return self._limit.spend()

    def message(self, t_ns: int, seq: int) -> Health:
        steps = sorted(self._steps_us) or [0.0]
        return Health(
            t_ns=t_ns,
            seq=seq,
            role=self._role,
            host=self._host,
            pid=os.getpid(),
            step_us={"p50": steps[len(steps) // 2], "p99": steps[int(len(steps) * 0.99)]},
            lag_ns=self.lag_ns,
            dropped=self.dropped,
            refused=self.refused,
            rss_bytes=resident_bytes(),
            received=self.received,
            reads=tuple(self._reads[:READS_MAX]),
        )


def resident_bytes() -> int:
    """Return the resident memory of this process [bytes]; 0 if the system does not report it."""
    if sys.platform == "linux":
        with suppress(OSError), open("/proc/self/statm", encoding="ascii") as statm:  # file descriptors may run out
            return int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return 0


@contextmanager
def rare_collections() -> Iterator[None]:
    """Within the block, collect garbage rarely and never examine the objects that already exist.

    By default Python collects after 700 allocations, every few gates, and occasionally examines all objects.
    """
    gc.collect()
    gc.freeze()
    thresholds = gc.get_threshold()
    gc.set_threshold(ALLOCATIONS, *thresholds[1:])
    try:
        yield
    finally:
        gc.set_threshold(*thresholds)
        gc.unfreeze()
