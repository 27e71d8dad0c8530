"""Messages of a process about itself (join, done, bye, health), on Zenoh and on the in-memory bus.

Also makes garbage collection rare, so that it does not delay gates.
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
READS_MAX = 8  # maximum number of key expressions listed in a health message
ALLOCATIONS = 50_000  # allocations between garbage collections; a gate makes hundreds and leaves no reference cycles


@dataclass
class Membership:
    """Makes the join, done and bye messages of a process."""

    name: str  # name of the process, "role.thing"
    host: str  # host name of its machine
    run_id: str
    next_seq: Callable[[str], int]  # returns the next sequence number for a kind of message, from 0
    serves: tuple[str, ...] = ()  # names of the processes that it replaces
    period_ns: int = 0  # interval of an agent's done messages; 0 for other processes
    slack_ns: int = 0  # maximum lead of the world over a process without a period; 0: unlimited
    calculates: bool = True  # whether results depend on its arithmetic; if so, its join has a fingerprint
    incarnation: int = 0  # random number that identifies this start of the process; 0 if processes are never restarted

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
        """Return the done message of a gate, with the number of outputs sent since the previous one."""
        return Done(t_ns, self.next_seq("done"), self.run_id, self.incarnation, t_ns, sent)

    def bye(self, t_ns: int, reason: str, failed: bool = False) -> Bye:
        return Bye(t_ns, self.next_seq("bye"), reason, failed or UNSET, self.run_id, self.incarnation)


class HealthMeter:
    """Counters and step durations of one process, for its health messages.

    Attributes:
        received: messages received.
        refused: received messages that could not be decoded.
        dropped: lost inputs: dropped messages, skipped pictures, and gates stepped without all their inputs.
    """

    def __init__(
        self,
        role: str,
        wall_s: Callable[[], float] = time.monotonic,
        host: str | None = None,
        reads: Sequence[str] = (),  # key expressions that it subscribes to; the session extends this list
    ) -> None:
        self._role = role
        self._host = host or socket.gethostname()
        self._reads = reads
        self._steps_us: deque[float] = deque(maxlen=STEPS_KEPT)
        self._limit = RateLimit(PERIOD_S, clock=wall_s)
        self._limit.spend()  # so that the first message is due after one period
        self.received = self.refused = self.dropped = 0
        self.lag_ns = 0  # lead of the newest gate over the last one handled
        self.link_lost = False  # whether the world is currently unreachable

    def step(self, duration_ns: int) -> None:
        self._steps_us.append(duration_ns / 1000)

    def due(self) -> bool:
        """Return whether a health message is due; if so, the next is due a period later."""
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
    """Return the resident memory of this process [bytes]; 0 if unknown."""
    if sys.platform == "linux":
        with suppress(OSError), open("/proc/self/statm", encoding="ascii") as statm:  # file descriptors may run out
            return int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return 0


@contextmanager
def rare_collections() -> Iterator[None]:
    """Collect garbage rarely within the `with` block, and exempt objects that already exist.

    By default Python collects after 700 allocations, that is, every few gates, and sometimes examines all objects.
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
