"""A process of a run that shows and commands, and gates only if it is to: its join, health and bye."""

import os
import secrets

from zsim.contract import keys, messages, run_messages
from zsim.contract.fingerprint import join_of
from zsim.errors import DecodeError
from zsim.runtime.health import HealthMeter
from zsim.transport.session import RawSample, Session

ANOTHER_RUN = "the world has begun another run"
JOIN_EVENTS = ("join", "restart", "superseded")  # kinds of events that report a process that joined


class ObserverProcess:
    """The process in one run.

    Args:
        link: an open session.
        info: of the run.
        name: process name, role.thing.
        serves: names of processes whose work it does; two that do the same are told of.
        slack_ns: by how much the world may be ahead of its dones; 0 for any.

    Attributes:
        now_ns: simulated time of the newest clock received.
        health: counters that it publishes.
        end_reason: why the process has nothing left to do in this run; empty while it goes on.
    """

    def __init__(
        self, link: Session, info: messages.Info, name: str, serves: tuple[str, ...] = (), slack_ns: int = 0
    ) -> None:
        self._link = link
        self._serves = tuple(each for each in serves if each != name)
        self._info = info
        self._slack_ns = slack_ns
        self._health_seq = self._done_seq = 0
        self._join_seq = -1
        self.name = name
        self.now_ns = 0
        self.health = HealthMeter(name.split(".", 1)[0], host=link.host, reads=link.reads)
        self.end_reason = ""
        self._process = link.host, os.getpid()
        self._incarnation = secrets.randbits(62)
        self._admitted = self._superseded = self._has_left = False
        self._must_join = self._was_link_lost = False
        self._done_ns = -1

    def announce(self) -> None:
        """Join the run."""
        self._link.declare_subscriber(keys.EVENT, self._on_event)
        self._link.on_link(self._on_link)
        self._link.declare_process(self.name)
        self._join()

    def _on_link(self, up: bool) -> None:
        self._must_join = up and self._was_link_lost
        self._was_link_lost = not up

    def _join(self) -> None:
        self._join_seq += 1
        host, run_id = self._link.host, self._info.run_id
        when = self._join_seq, self.now_ns
        join = join_of(self.name, host, run_id, self._incarnation, *when, serves=self._serves, slack_ns=self._slack_ns)
        self._link.put(keys.process(self.name, "join"), join)
        if self._done_ns >= 0:  # the last one may have been lost, or was of another incarnation
            self.done(self._done_ns)

    def update_clock(self, payload: bytes) -> run_messages.Clock | None:
        """Follow the run by a message on `clock`; return it, None where it cannot be decoded."""
        try:
            clock: run_messages.Clock = messages.decode(keys.CLOCK, payload)
        except DecodeError:
            self.health.refused += 1
            return None
        self.now_ns = clock.t_ns
        if clock.run_id != self._info.run_id:
            self.end_reason = ANOTHER_RUN
        elif clock.state == "stopped":
            self.end_reason = run_messages.RUN_ENDED
        return clock

    def tick(self) -> None:
        """Publish health once a wall second; to be called more often."""
        if self._must_join:  # the world took it for dead
            self._must_join = self._admitted = False
            self._incarnation = secrets.randbits(62)
            self._join()
        if self.health.due():
            health = self.health.message(self.now_ns, self._health_seq)
            self._health_seq += 1
            self._link.put(keys.process(self.name, "health"), health)

    @property
    def gates(self) -> bool:
        """Whether the world waits for it; it is then to announce itself when it has subscribed to all that it needs."""
        return self._slack_ns > 0

    def done(self, t_ns: int) -> None:
        """Publish that all up to a gate is done, if the world waits for it."""
        if self.gates:
            self._done_ns = t_ns
            done = run_messages.Done(t_ns, self._done_seq, self._info.run_id, self._incarnation, t_ns, 0)
            self._done_seq += 1
            self._link.put(keys.process(self.name, "done"), done)

    @property
    def superseded(self) -> bool:
        """Whether another process has taken over the name."""
        return self._superseded

    def leave(self, reason: str) -> None:
        """Publish bye once, unless another process has taken over the name."""
        if not (self._superseded or self._has_left):
            self._has_left = True
            of = {"run_id": self._info.run_id, "incarnation": self._incarnation}
            self._link.put(keys.process(self.name, "bye"), run_messages.Bye(self.now_ns, 0, reason, **of))

    def _on_event(self, sample: RawSample) -> None:
        try:
            event = messages.decode(keys.EVENT, sample.payload)
        except DecodeError:
            return  # not an event of the world
        if event.subject != self.name or event.kind not in JOIN_EVENTS:
            return
        is_own = event.data.get("incarnation") == self._incarnation
        self._admitted = self._admitted or is_own
        if self._admitted and not is_own and (event.data.get("host"), event.data.get("pid")) == self._process:
            self._must_join = True  # somebody else has joined as this process
        elif self._admitted and not is_own:
            self._superseded = True
            address = f"{event.data.get('host')} (pid {event.data.get('pid')})"
            self.end_reason = f"another process of this name joined from {address}"
