"""How a recorder takes part in a run: it joins, publishes how far it is, and leaves; and who else takes part."""

import contextlib
import os
import secrets
import time

from msgspec import UNSET

from zsim.contract import keys, messages, run_messages
from zsim.contract.fingerprint import join_of
from zsim.errors import DecodeError
from zsim.schema import message
from zsim.transport.session import Session

JOIN_S = 1.0  # wall time after which a join is repeated of which there was no event: it may have met no world
SLACK_NS = 4_000_000_000  # that the world may be ahead of it; its history has 5 s


class Participation:
    """Takes part under a name, without gating.

    Args:
        link: to the world.
        name: of this process.
        run_id: of the run.

    Attributes:
        successor: host and pid of another process that has taken its place, None while it has it.
    """

    def __init__(self, link: Session, name: str, run_id: str) -> None:
        self._link = link
        self._name = name
        self._run_id = run_id
        self.successor: str | None = None
        self._incarnation = secrets.randbits(62)
        self._incarnations = {self._incarnation}
        self._joined_s: float | None = None  # when it joined last, until the world has taken it in
        self._seq = {"join": 0, "done": 0, "bye": 0, "health": 0}
        self._others: dict[str, int] = {}  # incarnations that have joined and not left, by name

    # Of its own

    def join(self, now_ns: int, again: bool) -> None:
        """Join, `again` by a new incarnation: the newest counts."""
        if again:
            self._incarnation = secrets.randbits(62)
            self._incarnations.add(self._incarnation)
        name, host, seq = self._name, self._link.host, self.next("join")
        slack = {"calculates": False, "slack_ns": SLACK_NS}
        self.publish("join", join_of(name, host, self._run_id, self._incarnation, seq, now_ns, **slack))
        self._joined_s = time.monotonic()

    def is_to_be_repeated(self) -> bool:
        """Tell whether the world has had the time to take its join in, and has not."""
        return self._joined_s is not None and time.monotonic() - self._joined_s > JOIN_S

    def done(self, t_ns: int) -> None:
        """Publish how far the record is on disk."""
        self.publish("done", run_messages.Done(t_ns, self.next("done"), self._run_id, self._incarnation, t_ns, 0))

    def bye(self, now_ns: int, reason: str) -> None:
        seq, of = self.next("bye"), {"run_id": self._run_id, "incarnation": self._incarnation}
        self.publish("bye", run_messages.Bye(now_ns, seq, reason, **of))

    def publish(self, what: str, content: message.Message) -> None:
        self._link.put(keys.process(self._name, what), content)

    def next(self, what: str) -> int:
        """Return the number of the next message of a key."""
        self._seq[what] += 1
        return self._seq[what] - 1

    # What passes

    def is_own_join(self, payload: bytes) -> bool:
        """Tell whether an event is that of the newest join of this process."""
        event = self._event_of_own(payload)
        return event is not None and event.data.get("incarnation") == self._incarnation

    def event_received(self, payload: bytes) -> bool:
        """Take an event; return whether somebody else has joined as this process, which is to join again."""
        event = self._event_of_own(payload)
        if event is None:
            return False
        data = event.data
        if data.get("incarnation") == self._incarnation:
            self._joined_s = None
        if event.kind != "superseded":
            return False
        if (data.get("host"), data.get("pid")) == (self._link.host, os.getpid()):
            return data.get("incarnation") not in self._incarnations
        if data.get("former_pid") == os.getpid():
            self.successor = f"{data.get('host')} (pid {data.get('pid')})"
        return False

    def _event_of_own(self, payload: bytes) -> run_messages.Event | None:
        try:
            event = messages.decode(keys.EVENT, payload)
        except DecodeError:
            return None  # garbage by somebody else; recorded as it came
        return event if event.subject == self._name else None

    def passed(self, key: str, payload: bytes) -> None:
        """Take a message of a process."""
        name, kind = keys.thing(key), messages.type_of(key)
        if name == self._name or kind not in (run_messages.Join, run_messages.Bye):
            return
        with contextlib.suppress(DecodeError):  # garbage by somebody else; recorded as it came
            passed = messages.decode(key, payload)
            if isinstance(passed, run_messages.Join):
                self._others[name] = passed.incarnation
            elif passed.incarnation in (UNSET, self._others.get(name)):
                self._others.pop(name, None)

    def others_left(self) -> bool:
        """Tell whether every other process that joined has published bye."""
        return not self._others
