"""Servers of vehicle wires: one run's drones as aircraft for the programs of a wire; they command, and never gate."""

import asyncio
import contextlib
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

from zsim.contract import keys, messages
from zsim.contract.messages import Info
from zsim.errors import DecodeError, NoWorldError, RunError, without_figures
from zsim.runtime.participant import Participant
from zsim.transport.session import Session, Unanswered
from zsim_bridges.intake import TrafficIntake

POLL_S = 0.1  # how often a stop is looked for
REPORTED_MAX = 1000  # texts remembered, so that each is printed once
Say = Callable[[str], None]


class VehicleServer(ABC):
    """One run's drones on a wire.

    Args:
        link: an open session.
        info: of the run.
        observer: of this process in it.
        say: prints a line.
        options: of the wire; `rate` is the pace that is asked of the world, None for the run's own.
    """

    def __init__(self, link: Session, info: Info, observer: Participant, say: Say, options: Any) -> None:
        self.link = link
        self.info = info
        self.observer = observer
        self.options = options
        self._say = say
        self._reported: set[str] = set()

    @classmethod
    def serve(
        cls, link: Session, info: Info, observer: Participant, stopped: Callable[[], bool], say: Say, options: Any
    ) -> None:
        """Serve one run until it is over.

        Args:
            stopped: called now and then; True ends the run.

        Raises:
            RunError: the run keeps no pace, or a port or an address cannot be had.
        """
        set_pace(link, info, observer.name, options.rate)
        asyncio.run(cls(link, info, observer, say, options).run(stopped))

    async def run(self, stopped: Callable[[], bool]) -> None:
        """Carry messages both ways until the run is over or a stop is requested."""
        loop = asyncio.get_running_loop()
        async with contextlib.AsyncExitStack() as stack:
            await self.open(stack)
            intake = TrafficIntake(self.link, self.info, self.observer.health, loop)
            stack.callback(intake.close)
            while not (stopped() or self.observer.end_reason):
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(intake.news.wait(), POLL_S)
                await self.take_in(intake)
                self.observer.tick()

    @abstractmethod
    async def open(self, stack: contextlib.AsyncExitStack) -> None:
        """Open the ports, and have the stack close them."""

    @abstractmethod
    async def take_in(self, intake: TrafficIntake) -> None:
        """Hand on the messages that have arrived."""

    @abstractmethod
    def on_event(self, payload: bytes) -> None:
        """Take an event of the run."""

    def on_run(self, key: str, payload: bytes) -> bool:
        """Follow the run by its clock and events; return whether the message was one of these."""
        if key == keys.CLOCK:
            self.observer.update_clock(payload)
        elif key == keys.EVENT:
            self.on_event(payload)
        else:
            return False
        return True

    def decoded(self, key: str, payload: bytes) -> Any:
        """Return a message; None, and counted, if it cannot be decoded."""
        try:
            return messages.decode(key, payload)
        except DecodeError:
            self.observer.health.refused += 1
            return None

    def say(self, text: str) -> None:
        """Print a line."""
        self._say(f"{self.observer.name}: {text}")

    def refuse(self, reason: str) -> None:
        """Count what is not done, and print the reason, once."""
        self.observer.health.refused += 1
        self.say_once(reason)

    def say_once(self, text: str) -> None:
        """Print a text once, whatever its figures."""
        reason = without_figures(text)
        if reason not in self._reported and len(self._reported) < REPORTED_MAX:
            self._reported.add(reason)
            self.say(text)


def set_pace(link: Session, info: Info, name: str, rate: float | None) -> None:
    """Ask the world for a pace, if one is given; refuse a run that has none: programs go by the wall clock.

    Args:
        link: an open session.
        info: of the run.
        name: of this process.
        rate: simulated per wall seconds; None leaves the run's.

    Raises:
        RunError: the run goes as fast as possible, or the world refuses the pace.
        NoWorldError: the world went meanwhile.
    """
    if rate is None:
        if info.mode == "lockstep" and not info.rate:
            raise RunError(
                f"{name}: run {info.run_id} goes as fast as possible, and programs for real aircraft go by the wall "
                "clock; give --rate 1 here, or start the run with --rate 1 or --realtime"
            )
        return
    answer = link.request(keys.CONTROL, "rate", name, {"value": rate})
    if isinstance(answer, Unanswered):
        raise NoWorldError(f"{name}: the world of run {info.run_id} does not answer ({answer.error})")
    if not answer.ok:
        raise RunError(f"{name}: the world does not set the pace to --rate {rate:g}: {answer.error}")
