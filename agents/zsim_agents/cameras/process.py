"""Common parts of camera and detector processes: participation in a run, and waiting for messages."""

import threading
from collections.abc import Callable

from zsim.contract import keys
from zsim.runtime.participant import Participant
from zsim.transport.session import RawSample, Session

TICK_S = 0.1  # how often a stop is looked for while nothing arrives


class RunProcess:
    """A process that waits for messages from Zenoh's threads, and handles them in `turn`.

    Attributes:
        is_back: whether a lost link has been restored.
    """

    def __init__(self, link: Session, participant: Participant) -> None:
        self._link, self._participant = link, participant
        self._wake_event = threading.Event()
        self._was_lost = False
        self.is_back = False
        link.declare_subscriber(keys.CLOCK, self._on_clock)
        link.on_link(self._on_link)

    def turn(self) -> None:
        raise NotImplementedError

    def run(self, stopped: Callable[[], bool]) -> None:
        """Call `turn` until the run ends or the process is stopped."""
        while not (self._participant.end_reason or stopped()):
            self.turn()

    def wake(self) -> None:
        self._wake_event.set()

    def wait(self) -> None:
        """Return when a message has arrived, or after a tick."""
        self._wake_event.wait(TICK_S)
        self._wake_event.clear()
        self._participant.tick()

    def _on_clock(self, sample: RawSample) -> None:
        self._participant.update_clock(sample.payload)
        if self._participant.end_reason:
            self.wake()

    def _on_link(self, up: bool) -> None:
        self.is_back = self.is_back or (up and self._was_lost)
        self._was_lost = not up
        self.wake()
