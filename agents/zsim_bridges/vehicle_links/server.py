"""Servers that present one run's drones to clients as aircraft; they send commands, but no gate waits for them."""

import asyncio
import contextlib
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from zsim.contract import keys, messages
from zsim.contract.framing import run_key_table
from zsim.contract.messages import Info
from zsim.contract.run_messages import Event
from zsim.errors import DecodeError, NoWorldError, RunError, SessionError, without_numbers
from zsim.runtime.membership import HealthMeter
from zsim.runtime.participant import Participant
from zsim.transport.session import RawSample, ReceivedSample, Session, Unanswered
from zsim.transport.traffic import Passed, Traffic, samples

BACKLOG = 100  # batches kept for a slow reader, one or two seconds in realtime


class TrafficIntake:
    """Messages in the order in which they passed through the world; a slow reader continues with the newest.

    The messages that such a reader has not yet read are dropped, since acting on old messages is worse than missing
    some. `arrival_event` is set when there is something to read.
    """

    def __init__(self, link: Session, info: Info, health: HealthMeter, loop: asyncio.AbstractEventLoop) -> None:
        self._traffic = Traffic(link, run_key_table(info), self._count_refused)
        self._health = health
        self._loop = loop
        self._backlog: deque[Sequence[Passed]] = deque()
        self._thread = threading.Thread(target=self._run, name="intake", daemon=True)
        self.arrival_event = asyncio.Event()
        for sample in link.get(keys.CLOCK):  # a world that is stopped or has ended no longer publishes its clock
            self._backlog.append([sample])
        self.arrival_event.set()
        self._thread.start()

    def close(self) -> None:
        self._traffic.close()
        self._thread.join(1.0)

    def arrivals(self) -> Iterator[list[ReceivedSample]]:
        """Yield what has arrived so far, in the batches in which it arrived."""
        self.arrival_event.clear()
        for _ in range(len(self._backlog)):
            try:
                batch = self._backlog.popleft()
            except IndexError:  # dropped by the other thread in the meantime
                return
            yield list(samples(batch))

    def _run(self) -> None:
        while True:
            try:
                batch = self._traffic.receive()
            except SessionError:
                return
            if batch:
                if len(self._backlog) >= BACKLOG:
                    self._health.dropped += len(self._backlog)
                    self._backlog.clear()
                self._health.received += 1
                self._backlog.append(batch)
                with contextlib.suppress(RuntimeError):  # raised if the reader's loop is closed
                    self._loop.call_soon_threadsafe(self.arrival_event.set)

    def _count_refused(self) -> None:
        self._health.refused += 1


IMAGES_QUEUED_MAX = 10  # images waiting for the loop; beyond this, the oldest are dropped


class PictureIntake:
    """Receives the images of the cameras in use, with a subscription to each."""

    def __init__(self, link: Session, loop: asyncio.AbstractEventLoop, on_image: Callable[[str, bytes], None]) -> None:
        self._link = link
        self._loop = loop
        self._on_image = on_image
        self._queue: deque[RawSample] = deque(maxlen=IMAGES_QUEUED_MAX)
        self._undeclare: dict[str, Callable[[], None]] = {}

    def follow(self, followed_keys: Iterable[str]) -> None:
        """Subscribe to these keys, and unsubscribe from all others."""
        keys = set(followed_keys)
        for key in keys - set(self._undeclare):
            try:
                self._undeclare[key] = self._link.declare_subscriber(key, self._on_picture)
            except SessionError:  # no right to read it; as with a camera that is off, nothing arrives
                self._undeclare[key] = lambda: None
        for key in set(self._undeclare) - keys:
            self._undeclare.pop(key)()

    def _on_picture(self, sample: RawSample) -> None:
        """Pass on an image; called in a Zenoh thread."""
        self._queue.append(sample)
        with contextlib.suppress(RuntimeError):  # raised if the loop is closed
            self._loop.call_soon_threadsafe(self._deliver)

    def _deliver(self) -> None:
        while self._queue:
            sample = self._queue.popleft()
            self._on_image(sample.key, sample.payload)


POLL_S = 0.1  # period of checks for a stop request
REPORTED_MAX = 1000  # texts remembered, so that each is printed only once
Say = Callable[[str], None]


class VehicleServer(ABC):
    """Serves one run's drones over a wire protocol with its own `options`; `serve` requests the pace `options.rate`."""

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
        """Serve one run until it is over, or `stopped` returns True.

        Raises:
            RunError: the run has no pace, or a port or an address is unavailable.
            NoWorldError: the world does not answer, usually because it has ended.
        """
        set_pace(link, info, observer.name, options.rate)
        asyncio.run(cls(link, info, observer, say, options).run(stopped))

    async def run(self, stopped: Callable[[], bool]) -> None:
        loop = asyncio.get_running_loop()
        async with contextlib.AsyncExitStack() as stack:
            await self.open(stack)
            intake = TrafficIntake(self.link, self.info, self.observer.health, loop)
            stack.callback(intake.close)
            while not (stopped() or self.observer.end_reason):
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(POLL_S):
                        await intake.arrival_event.wait()
                await self.on_arrivals(intake)
                self.observer.tick()

    @abstractmethod
    async def open(self, stack: contextlib.AsyncExitStack) -> None:
        """Open the ports, and let the stack close them."""

    @abstractmethod
    async def on_arrivals(self, intake: TrafficIntake) -> None:
        """Forward the messages that have arrived."""

    @abstractmethod
    def on_event(self, event: Event) -> None:
        """Handle an event of the run."""

    def on_run(self, key: str, payload: bytes) -> None:
        """Handle the run's clock and events."""
        if key == keys.CLOCK:
            self.observer.update_clock(payload)
        elif key == keys.EVENT and (event := self.try_decode(key, payload)) is not None:
            self.on_event(event)

    def try_decode(self, key: str, payload: bytes) -> Any:
        """Decode a message; if this fails, count it and return None."""
        try:
            return messages.decode(key, payload)
        except DecodeError:
            self.observer.health.refused += 1
            return None

    def say(self, text: str) -> None:
        self._say(f"{self.observer.name}: {text}")

    def refuse(self, reason: str) -> None:
        """Count a refusal, and print its reason once."""
        self.observer.health.refused += 1
        self.say_once(reason)

    def say_once(self, text: str) -> None:
        """Print a text once; texts that differ only in numbers are treated as equal."""
        reason = without_numbers(text)
        if reason not in self._reported and len(self._reported) < REPORTED_MAX:
            self._reported.add(reason)
            self.say(text)


class PictureServer(VehicleServer):
    """A server that forwards all messages in order, and the images of the cameras that clients watch."""

    async def open(self, stack: contextlib.AsyncExitStack) -> None:
        self._pictures = PictureIntake(self.link, asyncio.get_running_loop(), self.on_picture)
        stack.callback(self._pictures.follow, ())

    async def on_arrivals(self, intake: TrafficIntake) -> None:
        for batch in intake.arrivals():
            for key, payload in batch:
                self.forward(key, payload)
                if keys.is_status(key):  # a gate of a large fleet takes long; let clients' commands go first
                    await asyncio.sleep(0)
            await asyncio.sleep(0)
        self._pictures.follow(self.watched_cameras())

    @abstractmethod
    def watched_cameras(self) -> Iterable[str]:
        """Return the keys of the cameras that clients watch."""

    @abstractmethod
    def forward(self, key: str, payload: bytes) -> None:
        """Forward a message that has passed through the world."""

    @abstractmethod
    def on_picture(self, key: str, payload: bytes) -> None:
        """Forward an image."""


def set_pace(link: Session, info: Info, name: str, rate: float | None) -> None:
    """Request a pace from the world, if one is given; refuse a run that has none, since programs use the wall clock.

    Raises:
        RunError: the run goes as fast as possible, or the world refuses the pace.
        NoWorldError: the world does not answer, usually because it has ended.
    """
    if rate is None:
        if info.mode == "lockstep" and not info.rate:
            raise RunError(
                f"{name}: run {info.run_id} goes as fast as possible, and programs for real aircraft use the wall "
                "clock; give --rate 1 here, or start the run with --rate 1 or --realtime"
            )
        return
    answer = link.request(keys.CONTROL, "rate", name, {"value": rate})
    if isinstance(answer, Unanswered):
        raise NoWorldError(f"{name}: the world of run {info.run_id} does not answer ({answer.error})")
    if not answer.ok:
        raise RunError(f"{name}: the world refuses --rate {rate:g}: {answer.error}")
