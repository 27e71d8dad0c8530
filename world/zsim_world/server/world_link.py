"""The world's side of its links: subscriptions, recovery of lost outputs, and publication in batches."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import Any

from zsim.contract import keys, messages
from zsim.contract.framing import BATCH_MAX, GateMessages, Pairs, encode_batch
from zsim.errors import DecodeError, SessionError
from zsim.runtime.agent import Output
from zsim.scenario.roles import WORLD
from zsim.transport.session import ReceivedSample, Session, Subscription
from zsim_world.run.inputs import Published, Run, Taken
from zsim_world.server.run_journal import RunJournal

TICK_S = 0.1  # interval at which a waiting world checks the wall clock
RECOVERY_S = 1.0  # timeout of a request for outputs, which a living publisher answers within milliseconds
REJOINED_NS = 10_000_000_000  # wall time after a rejoin within which a process may not answer requests yet
PROCESSES, VIEWS = "process/", "view/"  # the world does not read views


class DirectInputs:
    """Reads on the loop's own thread, waiting on the last subscription: fastest without pacing."""

    def __init__(self, subscriptions: Sequence[Subscription]) -> None:
        self._subscriptions = subscriptions
        self._received: list[ReceivedSample] = []

    def wait(self, timeout_s: float | None) -> None:
        """Return when something has arrived, or after timeout_s; without a limit, return occasionally."""
        if timeout_s is not None and timeout_s < TICK_S:
            time.sleep(timeout_s)
            return
        sample = self._subscriptions[-1].receive()
        if sample is not None:
            self._received.append(sample)

    def wait_for(self, wanted: set[str]) -> None:
        """Wait until something has arrived on each wanted key, or anything other than a done."""
        while True:
            sample = self._subscriptions[-1].receive()
            if sample is None:
                return
            self._received.append(sample)
            wanted.discard(sample.key)
            if not wanted or not sample.key.endswith("/done"):
                return

    def drain(self) -> Iterator[tuple[int, ReceivedSample]]:
        """Yield the received samples with the monotonic wall time of their arrival [ns]."""
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
    """Reads on separate threads, so that arrivals are stamped while the loop waits for its next gate."""

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
    """Subscribe to the messages of other processes.

    Outputs are drained first, dones last: a process publishes its outputs before its done, on the same link.
    """
    subscriptions = [link.subscribe_remote((PROCESSES, VIEWS)), link.subscribe(f"{PROCESSES}**")]
    return TimedInputs(subscriptions) if realtime else DirectInputs(subscriptions)


def recover_lost(link: Session, run: Run) -> None:
    """Request outputs that a participant counted and that have not arrived, for example after a cut link."""
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
            continue  # it may not answer requests yet
        for sample in lost or ():
            run.enter(Taken(time.monotonic_ns(), sample))
        run.call("give_up_outputs", participant.name)


class WorldOutputs:
    """Publishes the outbox of a world.

    Args:
        on_message: called with every key and message except the messages of a gate.
        journal: written before anything is published.
    """

    def __init__(self, link: Session, run: Run, on_message: Callable[[str, Any], None], journal: RunJournal) -> None:
        self._link = link
        self._run = run
        self._on_message = on_message
        self._journal = journal
        self._unsent: Pairs = []
        self._gate_keys = [keys.gate(name) for name in run.world.names]

    def gather(self) -> None:
        """Encode the outbox for `send`; a gate as a whole and per drone, if subscribed, and as single messages."""
        outbox = self._run.world.take_outbox()
        if not outbox:
            return
        encoded: Pairs = []
        passed, has_subscribers = self._run.history.passed, self._link.has_subscribers
        for key, message in outbox:
            if type(message) is GateMessages:
                whole = (keys.GATE, message.pack())
                passed.append(whole)
                if has_subscribers(keys.GATE):
                    self._unsent.append(whole)
                for gate_key, (first, last) in zip(self._gate_keys, pairwise(message.first), strict=True):
                    if last > first and has_subscribers(gate_key):
                        self._unsent.append((gate_key, message.pack(first, last)))
                encoded += message.pairs
            else:
                pair = (key, messages.encode(message))
                if keys.is_picture(key):  # of a replay; not kept or batched, since pictures are large
                    self._unsent.append(pair)
                    continue
                encoded.append(pair)
                passed.append(pair)
        self._unsent += encoded
        self._run.history.add_all(encoded, self._run.world.now_ns)
        for key, message in outbox:
            if type(message) is not GateMessages:
                self._on_message(key, message)

    def send(self) -> None:
        """Publish the gathered messages together: readers wake once, and the transport sends few packets."""
        self._journal.commit()
        unsent, self._unsent = self._unsent, []
        self._link.put_all(unsent)
        self.put_batch()

    def flush(self) -> None:
        self.gather()
        self.send()

    def publish(self, output: Output) -> None:
        """Publish one message without the outbox."""
        message: Any = output.message
        payload = messages.encode(message)
        self._run.enter(Published(output.key, message.seq, payload))
        self._journal.commit()
        self._link.put_raw(output.key, payload)
        self.put_batch()
        self._on_message(output.key, message)

    def put_batch(self) -> None:
        """Send all messages since the last call to the recorders, if any."""
        history = self._run.history
        passed, history.passed = history.passed, []
        if self._link.has_subscribers(keys.BATCH):
            for first in range(0, len(passed), BATCH_MAX):
                self._link.put_raw(keys.BATCH, encode_batch(passed[first : first + BATCH_MAX]))

    def forget(self) -> None:
        """Drop the gathered messages, which the former world process has published."""
        self._unsent, self._run.history.passed = [], []
