"""The join, done and bye messages of a process, for Zenoh and the in-memory bus."""

import os
from collections.abc import Callable
from dataclasses import dataclass

from msgspec import UNSET

from zsim import __version__
from zsim.contract.fingerprint import fingerprint
from zsim.contract.run_messages import Bye, Done, Join


@dataclass
class Membership:
    """The join, dones and bye of a process."""

    name: str  # of the process, role.thing
    host: str  # that it runs on
    run_id: str
    next_seq: Callable[[str], int]  # returns the number of its next message of a kind, from 0
    serves: tuple[str, ...] = ()  # names of processes whose work it does
    period_ns: int = 0  # how often it says done; 0 for never
    slack_ns: int = 0  # by how much the world may be ahead of the dones of one without a period; 0 for any
    calculates: bool = True  # whether its results depend on its arithmetic; else it states no fingerprint
    incarnation: int = 0  # a random number of the process; 0 where none is ever restarted

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
        """Return the done of a gate, with the number of outputs sent since the last one."""
        return Done(t_ns, self.next_seq("done"), self.run_id, self.incarnation, t_ns, sent)

    def bye(self, t_ns: int, reason: str, failed: bool = False) -> Bye:
        return Bye(t_ns, self.next_seq("bye"), reason, failed or UNSET, self.run_id, self.incarnation)
