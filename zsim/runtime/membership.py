"""The messages of a process about itself: join, done, bye and health, on Zenoh and on the in-memory bus.

Also makes garbage collections rare, so that they do not delay gates.
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

PERIOD_S = 1.0  # wall time between health messages, set by the contract
STEPS_KEPT = 1000
READS_MAX = 8  # key expressions listed per process
ALLOCATIONS = 50_000  # between collections; a gate allocates hundreds of objects and leaves no cycles


@dataclass
class Membership:
    """The join, dones and bye of a process."""

    name: str  # name of the process, "role.thing"
    host: str  # name of its host
    run_id: str
    next_seq: Callable[[str], int]  # returns the next sequence number of a kind of message, from 0
    serves: tuple[str, ...] = ()  # names of the processes that it replaces
    period_ns: int = 0  # interval of its dones; 0: sends none
    slack_ns: int = 0  # lead that the world may have over the dones of a process without a period; 0: any
    calculates: bool = True  # whether results depend on its arithmetic; if not, its join has no fingerprint
    incarnation: int = 0  # random number of this start of the process; 0 if processes are never restarted

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
        """Return the done of a gate, with the number of outputs sent since the previous done."""
        return Done(t_ns, self.next_seq("done"), self.run_id, self.incarnation, t_ns, sent)

    def bye(self, t_ns: int, reason: str, failed: bool = False) -> Bye:
        return Bye(t_ns, self.next_seq("bye"), reason, failed or UNSET, self.run_id, self.incarnation)


class HealthMeter:
    """Counters of one process.

    Attributes:
        received: messages received.
        refused: messages that could not be decoded.
        dropped: inputs lost: dropped messages and skipped pictures, or gates stepped without all their inputs.
    """

    def __init__(
        self,
        role: str,
        wall_s: Callable[[], float] = time.monotonic,
        host: str | None = None,
        reads: Sequence[str] = (),  # its subscribed key expressions; the session extends this list
    ) -> None:
        self._role = role
        self._host = host or socket.gethostname()
        self._reads = reads
        self._steps_us: deque[float] = deque(maxlen=STEPS_KEPT)
        self._limit = RateLimit(PERIOD_S, now=wall_s)
        self._limit.spend()  # so that the first is due after a period
        self.received = self.refused = self.dropped = 0
        self.lag_ns = 0  # lead of the newest gate over the one last handled
        self.link_lost = False  # whether the world is currently unreachable

    def step(self, duration_ns: int) -> None:
        self._steps_us.append(duration_ns / 1000)

    def due(self) -> bool:
        """Whether health is due, once per wall second."""
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
    """Return the resident memory of this process [bytes]; 0 where it is unknown."""
    if sys.platform == "linux":
        with suppress(OSError), open("/proc/self/statm", encoding="ascii") as statm:  # file descriptors may run out
            return int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return 0


@contextmanager
def rare_collections() -> Iterator[None]:
    """Collect garbage rarely within the block, and exempt the objects that already exist.

    By default Python collects after 700 allocations, which is every few gates, and sometimes examines all objects.
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
