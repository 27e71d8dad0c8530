"""What a process of cameras needs of its place in a run."""

import threading
from typing import Protocol

from zsim.contract import keys
from zsim.runtime.health import HealthMeter
from zsim.transport.session import RawSample, Session

TICK_S = 0.1  # how often a stop is looked for while nothing arrives


class Presence(Protocol):
    """The process in one run; zsim_bridges.observer_process has it."""

    name: str
    now_ns: int
    health: HealthMeter
    end_reason: str

    @property
    def gates(self) -> bool: ...
    def announce(self) -> None: ...
    def update_clock(self, payload: bytes) -> object: ...
    def tick(self) -> None: ...
    def done(self, t_ns: int) -> None: ...


class Bell:
    """Rung by Zenoh's threads when something has arrived; also after the link was lost and is back.

    Args:
        link: an open session.
        presence: of the process; it follows the clock.
    """

    def __init__(self, link: Session, presence: Presence) -> None:
        self._presence = presence
        self._rung = threading.Event()
        self._was_lost = False
        self.is_back = False
        link.declare_subscriber(keys.CLOCK, self._on_clock)
        link.on_link(self._on_link)

    def ring(self) -> None:
        """Let a waiting `wait` return."""
        self._rung.set()

    def wait(self) -> None:
        """Return when something has arrived, or after a tick."""
        self._rung.wait(TICK_S)
        self._rung.clear()
        self._presence.tick()

    def _on_clock(self, sample: RawSample) -> None:
        self._presence.update_clock(sample.payload)
        if self._presence.end_reason:
            self.ring()

    def _on_link(self, up: bool) -> None:
        self.is_back = self.is_back or (up and self._was_lost)
        self._was_lost = not up
        self.ring()
