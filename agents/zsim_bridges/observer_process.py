"""A process that looks and commands without gating, among the others of a run: joins, tells of its health, says bye."""

import secrets

from zsim.contract import keys, messages
from zsim.contract.fingerprint import join_of
from zsim.errors import DecodeError
from zsim.runtime.health import HealthMeter
from zsim.transport.session import Sample, Session

ENTRIES = ("join", "restart", "superseded")  # kinds of events that tell of a process that joined


class Presence:
    """One run's worth of it.

    Args:
        link: an open session.
        info: of the run.
        name: process name, role.thing.

    Attributes:
        now_ns: simulated time of the newest clock that it was shown.
        health: counters that it tells.
        over: why there is nothing left to do in this run; empty while there is.
    """

    def __init__(self, link: Session, info: messages.Info, name: str) -> None:
        self._link = link
        self._info = info
        self._healths = 0
        self._joins = -1
        self.name = name
        self.now_ns = 0
        self.health = HealthMeter(name.split(".", 1)[0], host=link.host)
        self.over = ""
        self._incarnation = secrets.randbits(62)
        self._taken_in = self._superseded = False
        self._must_join = self._was_cut = False

    def enter(self) -> None:
        """Join."""
        self._link.on_message(keys.EVENT, self._on_event)
        self._link.on_link(self._on_link)
        self._link.declare_token(keys.token(self.name))
        self._join()

    def _on_link(self, up: bool) -> None:
        self._must_join = up and self._was_cut
        self._was_cut = not up

    def _join(self) -> None:
        self._joins += 1
        host, run_id = self._link.host, self._info.run_id
        join = join_of(self.name, host, run_id, self._incarnation, self._joins, self.now_ns)
        self._link.put(keys.process(self.name, "join"), join)

    def heed(self, payload: bytes) -> messages.Clock | None:
        """Follow the run by a message on `clock`; return it, None where it is none."""
        try:
            clock: messages.Clock = messages.decode(keys.CLOCK, payload)
        except DecodeError:
            self.health.refused += 1
            return None
        self.now_ns = clock.t_ns
        if clock.run_id != self._info.run_id:
            self.over = "the world has begun another run"
        elif clock.state == "stopped":
            self.over = "the run ended"
        return clock

    def tick(self) -> None:
        """Tell of its health once a wall second; to be called more often."""
        if self._must_join:  # the world took it for dead
            self._must_join = self._taken_in = False
            self._incarnation = secrets.randbits(62)
            self._join()
        if self.health.due():
            health = self.health.message(self.now_ns, self._healths)
            self._healths += 1
            self._link.put(keys.process(self.name, "health"), health)

    @property
    def superseded(self) -> bool:
        """Whether another process has taken over the name."""
        return self._superseded

    def leave(self, reason: str) -> None:
        """Say bye, unless another has taken over the name."""
        if not self._superseded:
            self._link.put(keys.process(self.name, "bye"), messages.Bye(self.now_ns, 0, reason))

    def _on_event(self, sample: Sample) -> None:
        try:
            event = messages.decode(keys.EVENT, sample.payload)
        except DecodeError:
            return  # somebody else's garbage
        if event.subject != self.name or event.kind not in ENTRIES:
            return
        is_mine = event.data.get("incarnation") == self._incarnation
        self._taken_in = self._taken_in or is_mine
        if self._taken_in and not is_mine:
            self._superseded = True
            who = f"{event.data.get('host')} (pid {event.data.get('pid')})"
            self.over = f"another process of this name joined from {who}"
