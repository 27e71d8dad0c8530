"""What reaches the world: subscriptions, read on the loop's thread or on threads of their own; lost outputs."""

import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence

from zsim.contract import keys
from zsim.contract.framing import Pairs
from zsim.errors import DecodeError, SessionError
from zsim.scenario.roles import WORLD
from zsim.transport.session import ReceivedSample, Session, Subscription
from zsim_world.run.inputs import Run, Taken

TICK_S = 0.1  # how often a world that waits looks at the wall clock
RECOVERY_S = 1.0  # a publisher that lives answers a get for its outputs within milliseconds
REJOINED_NS = 10_000_000_000  # wall time after a rejoin in which it may take until a process can be asked
PROCESSES, VIEWS = "process/", "view/"  # the world does not read the last


class DirectInputs:
    """Reads on the loop's own thread, waiting for the last subscription: fastest without a wall clock."""

    def __init__(self, subscriptions: Sequence[Subscription]) -> None:
        self._subscriptions = subscriptions
        self._received: list[ReceivedSample] = []

    def wait(self, timeout_s: float | None) -> None:
        """Return when something has arrived, or after timeout_s; without a limit, now and then to look at the clock."""
        if timeout_s is not None and timeout_s < TICK_S:
            time.sleep(timeout_s)
            return
        sample = self._subscriptions[-1].receive()
        if sample is not None:
            self._received.append(sample)

    def wait_for(self, wanted: set[str]) -> None:
        """Wait until something has arrived on each of the wanted keys, or anything that is not a done."""
        while True:
            sample = self._subscriptions[-1].receive()
            if sample is None:
                return
            self._received.append(sample)
            wanted.discard(sample.key)
            if not wanted or not sample.key.endswith("/done"):
                return

    def drain(self) -> Iterator[tuple[int, ReceivedSample]]:
        """Yield what has arrived, with the monotonic wall time of its arrival [ns]."""
        last, self._received = [*self._received, *self._subscriptions[-1].drain()], []
        wall_ns = time.monotonic_ns()
        for subscription in self._subscriptions[:-1]:
            for sample in subscription.drain():
                yield wall_ns, sample
        for sample in last:
            yield wall_ns, sample

    def wake(self) -> None:
        self._subscriptions[-1].wake()

    def close(self) -> None:
        """Stop reading."""


class TimedInputs:
    """Reads on threads of their own, so that arrivals are stamped while the loop waits for its next gate."""

    def __init__(self, subscriptions: Sequence[Subscription]) -> None:
        self._fresh = threading.Event()
        self._arrived: list[tuple[Subscription, deque[tuple[int, ReceivedSample]]]] = [
            (s, deque()) for s in subscriptions
        ]
        self._threads = [threading.Thread(target=self._pump, args=each, daemon=True) for each in self._arrived]
        for thread in self._threads:
            thread.start()

    def _pump(self, subscription: Subscription, arrived: deque[tuple[int, ReceivedSample]]) -> None:
        while True:
            try:
                sample = subscription.receive()
            except SessionError:
                return
            if sample is not None:
                arrived.append((time.monotonic_ns(), sample))
                self._fresh.set()

    def wait(self, timeout_s: float | None) -> None:
        self._fresh.wait(TICK_S if timeout_s is None else timeout_s)
        self._fresh.clear()

    def wait_for(self, wanted: set[str]) -> None:
        self.wait(None)

    def drain(self) -> Iterator[tuple[int, ReceivedSample]]:
        for _, arrived in self._arrived:
            while arrived:
                yield arrived.popleft()

    def wake(self) -> None:
        self._fresh.set()

    def close(self) -> None:
        for (subscription, _), thread in zip(self._arrived, self._threads, strict=True):
            subscription.undeclare()
            thread.join(timeout=2.0)


def open_inputs(link: Session, realtime: bool) -> DirectInputs | TimedInputs:
    """Subscribe to what others publish.

    Outputs are drained first, dones last: who publishes a done has published its outputs before, on the same link.
    """
    subscriptions = [link.subscribe_remote((PROCESSES, VIEWS)), link.subscribe(f"{PROCESSES}**")]
    return TimedInputs(subscriptions) if realtime else DirectInputs(subscriptions)


def recover_lost(link: Session, run: Run) -> None:
    """Request outputs again that a participant counted and that have not arrived, as after a cut link."""
    world = run.world
    for participant in world.barrier.incomplete():
        if participant.away:
            continue
        if world.clock.mode == "realtime":
            participant.lost_done = False
            continue
        lost: Pairs | None = None
        key = keys.process(participant.name, "outputs")
        try:
            answer = link.request(key, "outputs", WORLD, timeout_s=RECOVERY_S)
            if answer.ok:
                lost = run.history.lost_outputs(answer.result, participant.done_ns)
        except DecodeError as error:
            run.refuse(participant.name, key, error)
            lost = []
        age_ns = time.monotonic_ns() - participant.joined_wall_ns
        if lost is None and participant.rejoined and age_ns < REJOINED_NS:
            continue  # it cannot be asked yet
        for sample in lost or ():
            run.enter(Taken(time.monotonic_ns(), sample))
        run.call("give_up_outputs", participant.name)
