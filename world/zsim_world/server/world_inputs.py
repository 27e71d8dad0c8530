"""What reaches the world: received, checked, counted, kept, and requested again where it was lost."""

import contextlib
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec

from zsim.contract import camera_messages, flight_messages, keys, messages, run_messages
from zsim.errors import DecodeError, SessionError
from zsim.runtime.health import HealthMeter
from zsim.scenario.rights import WORLD
from zsim.transport.session import ReceivedSample, Session, Subscription
from zsim_world.run.barrier import Participant
from zsim_world.run.coordinator import Coordinator
from zsim_world.run.message_history import MessageHistory
from zsim_world.server.admission import Admission
from zsim_world.server.journal_entries import GivenUp, Taken
from zsim_world.server.liveliness import LivelinessMonitor
from zsim_world.server.run_journal import RunJournal
from zsim_world.server.world_outputs import WorldOutputs

TICK_S = 0.1  # how often a standing world looks at the wall clock
RECOVERY_S = 1.0  # a publisher that lives answers a get for its outputs within milliseconds
REJOINED_NS = 10_000_000_000  # wall time after a rejoin in which it may take until a process can be asked
PHASE_EVERY = 10  # states of a cluster between two of which the phase is read for the display
OF_CAMERAS = (camera_messages.CameraInfo, camera_messages.Sightings)  # relayed too, from whoever has a camera
OF_DRIVERS = ("truth", "link")  # what they publish of an external drone beside its sensors
PROCESSES, VIEWS = "process/", "view/"  # the last are nothing to the world
OWN = keys.process(WORLD, "")

ProgressCallback = Callable[[str, Any, str], None]
"""Called with ("clock" or "event", message, phase of the clusters), ("health", message, process), every tenth ("state",
message, cluster), ("link", message, drone), and ("resumed", simulated time in ns, process); shows progress."""


class WorldInputs(ABC):
    """The world's subscriptions: waited for with a limit or without, drained with the wall time of arrival."""

    @abstractmethod
    def wait(self, timeout_s: float | None) -> None:
        """Return when something has come, or after timeout_s; without a limit, now and then to look at the clock."""

    def wait_for(self, wanted: set[str]) -> None:
        """Wait until something has come on each of the wanted keys, or anything that is not a done."""
        self.wait(None)

    @abstractmethod
    def drain(self) -> Iterator[tuple[int, ReceivedSample]]:
        """Yield what has come, with the monotonic wall time of its arrival [ns]."""

    @abstractmethod
    def wake(self) -> None:
        """Let a `wait` of another thread return."""

    def close(self) -> None:  # noqa: B027 - not every one reads on threads of its own
        """Stop reading."""


class DirectInputs(WorldInputs):
    """Reads on the loop's own thread, waiting for the last subscription: fastest without a wall clock."""

    def __init__(self, subscriptions: Sequence[Subscription]) -> None:
        self._subscriptions = subscriptions
        self._received: list[ReceivedSample] = []

    def wait(self, timeout_s: float | None) -> None:
        if timeout_s is not None and timeout_s < TICK_S:
            time.sleep(timeout_s)
            return
        sample = self._subscriptions[-1].receive()
        if sample is not None:
            self._received.append(sample)

    def wait_for(self, wanted: set[str]) -> None:
        while True:
            sample = self._subscriptions[-1].receive()
            if sample is None:
                return
            self._received.append(sample)
            wanted.discard(sample.key)
            if not wanted or not sample.key.endswith("/done"):
                return

    def drain(self) -> Iterator[tuple[int, ReceivedSample]]:
        last, self._received = [*self._received, *self._subscriptions[-1].drain()], []
        wall_ns = time.monotonic_ns()
        for subscription in self._subscriptions[:-1]:
            for sample in subscription.drain():
                yield wall_ns, sample
        for sample in last:
            yield wall_ns, sample

    def wake(self) -> None:
        self._subscriptions[-1].wake()


class TimedSubscription:
    """A subscription read by a thread that stamps every message with the wall time of its arrival.

    Args:
        subscription: what to read.
        fresh: set whenever something has arrived.
    """

    def __init__(self, subscription: Subscription, fresh: threading.Event) -> None:
        self._subscription = subscription
        self._fresh = fresh
        self._arrived: deque[tuple[int, ReceivedSample]] = deque()
        self._thread = threading.Thread(target=self._pump, name="subscription", daemon=True)
        self._thread.start()

    def _pump(self) -> None:
        while True:
            try:
                sample = self._subscription.receive()
            except SessionError:
                return
            if sample is not None:
                self._arrived.append((time.monotonic_ns(), sample))
                self._fresh.set()

    def drain(self) -> Iterator[tuple[int, ReceivedSample]]:
        """Yield (wall_ns of arrival, sample) of what has arrived."""
        while self._arrived:
            yield self._arrived.popleft()

    def close(self) -> None:
        """Stop the reading thread."""
        self._subscription.undeclare()
        self._thread.join(timeout=2.0)


class TimedInputs(WorldInputs):
    """Reads on threads of their own, so that arrivals are stamped while the loop waits for its next gate."""

    def __init__(self, subscriptions: Sequence[Subscription]) -> None:
        self._fresh = threading.Event()
        self._subscriptions = [TimedSubscription(subscription, self._fresh) for subscription in subscriptions]

    def wait(self, timeout_s: float | None) -> None:
        self._fresh.wait(TICK_S if timeout_s is None else timeout_s)
        self._fresh.clear()

    def drain(self) -> Iterator[tuple[int, ReceivedSample]]:
        for subscription in self._subscriptions:
            yield from subscription.drain()

    def wake(self) -> None:
        self._fresh.set()

    def close(self) -> None:
        for subscription in self._subscriptions:
            subscription.close()


def open_inputs(link: Session, realtime: bool) -> WorldInputs:
    """Subscribe to what others publish.

    Outputs are drained first, dones last: who publishes a done has published its outputs before, on the same link.
    """
    subscriptions = [link.subscribe_remote((PROCESSES, VIEWS)), link.subscribe(f"{PROCESSES}**")]
    return TimedInputs(subscriptions) if realtime else DirectInputs(subscriptions)


class _Head(msgspec.Struct):
    """What the world reads of messages that it only relays."""

    t_ns: int
    seq: int
    source: str = ""
    controller: str = ""  # of a ClusterRequest, whose source is the client


_decode_head = msgspec.msgpack.Decoder(_Head).decode


Handler = Callable[[ReceivedSample, int], None]
"""Takes a message that came at a monotonic wall time [ns].

Raises:
    DecodeError: it is refused.
"""


@dataclass(eq=False)
class MessageIntake:
    """Takes what others publish: checks it, keeps it, counts it for its sender, and hands the world what is for it."""

    link: Session
    world: Coordinator
    outputs: WorldOutputs  # hands recorders what has passed
    history: MessageHistory
    liveliness: LivelinessMonitor
    admission: Admission  # hands the world the joins
    health: HealthMeter  # counts what is received and refused
    progress: ProgressCallback
    journal: RunJournal
    replaying: bool = False  # what another incarnation of the world has taken
    phase: str = ""  # of the cluster whose state was read last
    _states: Counter[str] = field(default_factory=Counter[str])
    _handlers: dict[str, Handler] = field(default_factory=dict[str, "Handler"])

    def take(self, wall_ns: int, sample: ReceivedSample) -> None:
        """Take one message, or refuse it, and keep it in the journal."""
        key = sample.key
        if key.startswith(OWN):
            return  # the world's own health, kept when it was published
        self.take_again(wall_ns, sample)
        if self.world.ended is None:
            self.journal.note(Taken(wall_ns, key, sample.payload))
        if messages.type_of(key) is run_messages.Join:
            self._take_join(key, sample.payload, wall_ns)

    def _take_join(self, key: str, payload: bytes, wall_ns: int) -> None:
        with contextlib.suppress(DecodeError):  # refused already
            join: run_messages.Join = messages.decode(key, payload)
            self.liveliness.before_join(keys.thing(key), join)
            self.admission.take(keys.thing(key), join, wall_ns)

    def take_again(self, wall_ns: int, sample: ReceivedSample) -> None:
        """Take one message, or refuse it, as another incarnation of the world has."""
        key = sample.key
        self.health.received += 1
        handle = self._handlers.get(key) or self._learn_handler(key)
        try:
            handle(sample, wall_ns)
        except DecodeError as error:
            self.history.add_foreign(key, sample.payload)
            self._refuse("somebody", key, error)
            self._count_refused(sample)

    def _learn_handler(self, key: str) -> Handler:
        """Return what takes the messages of a key, and remember it: the same keys come at every gate."""
        kind = messages.type_of(key)
        if kind in messages.RELAYED:
            handler = self._relay
        elif kind in OF_CAMERAS and not keys.is_sensor(key):
            handler = self._relay_of_camera
        elif self._is_of_driver(key):
            handler = self._take_of_driver
        elif key.startswith(PROCESSES) or keys.is_command(key):
            handler = self._hand_over
        elif kind is None:
            handler = self._keep_foreign
        else:
            handler = _refuse_key_of_world
        if len(self._handlers) >= messages.KEYS_KEPT:
            self._handlers.clear()
        self._handlers[key] = handler
        return handler

    def _keep_foreign(self, sample: ReceivedSample, wall_ns: int) -> None:
        """Keep a message on a key outside of the contract."""
        self.outputs.passed(sample)
        self.history.add_foreign(sample.key, sample.payload)

    def _hand_over(self, sample: ReceivedSample, wall_ns: int) -> None:
        """Hand the world a message that it acts on."""
        self.outputs.passed(sample)
        key, payload = sample
        message = messages.decode(key, payload)
        self.history.add(key, payload, message.t_ns)
        if type(message) is run_messages.Done:
            self.admission.done_received(keys.thing(key), message.incarnation, wall_ns)
        if type(message) is not run_messages.Join:  # that is for `take` to admit, or for the journal to repeat
            self.world.handle(key, message, wall_ns)
        if type(message) is run_messages.Health and not self.replaying:
            self.liveliness.health_received(keys.thing(key))
            self.progress("health", message, keys.thing(key))

    def _refuse(self, source: str, key: str, error: DecodeError) -> None:
        self.health.refused += 1
        self.world.outbox.refuse(source, key[:80], messages.fault_at(key, error))

    def _count_refused(self, sample: ReceivedSample) -> None:
        """Count an output that was refused, so that its sender's done is not taken to be short of it."""
        with contextlib.suppress(DecodeError):  # of an unknown sender
            head = _head(sample.key, sample.payload)
            self.world.count_output(head.controller or head.source)

    def _relay(self, sample: ReceivedSample, wall_ns: int) -> None:
        """Keep an output that the world only relays, and count it for the done of who sent it."""
        self.outputs.passed(sample)
        key, payload = sample
        head = _head(key, payload)
        if head.t_ns > self.world.now_ns:
            raise DecodeError(f"{key}: t_ns is {head.t_ns}; must be <= {self.world.now_ns}, the newest gate")
        self.history.add(key, payload, head.t_ns)
        kind = messages.type_of(key)
        if kind is flight_messages.ClusterState:
            self._read_phase(key, payload)
        role = "estimator" if kind is flight_messages.Estimate else "controller"
        source = head.controller if kind is run_messages.ClusterRequest else head.source
        self.world.count_output(source or f"{role}.{keys.thing(key)}")

    def _relay_of_camera(self, sample: ReceivedSample, wall_ns: int) -> None:
        """Keep what a camera or a detector says; who asks later how a camera sees gets nothing that is no answer."""
        self.outputs.passed(sample)
        key, payload = sample
        message = messages.decode(key, payload)
        if message.t_ns > self.world.now_ns:
            raise DecodeError(f"{key}: t_ns is {message.t_ns}; must be <= {self.world.now_ns}, the newest gate")
        self.history.add(key, payload, message.t_ns)
        self.world.count_output(message.source)

    def _is_of_driver(self, key: str) -> bool:
        """Tell whether the driver of an external drone publishes on a key, and not the world."""
        kind, drone, what = keys.parts(key)
        of_driver = what in OF_DRIVERS or what.startswith("sensor/")
        return of_driver and kind == "drone" and drone in self.world.external

    def _take_of_driver(self, sample: ReceivedSample, wall_ns: int) -> None:
        """Keep what a driver publishes of its drone, unless the world refuses it."""
        self.outputs.passed(sample)
        key, payload = sample
        drone = keys.thing(key)
        try:
            message = messages.decode(key, payload)
            refusal = self.world.take_of_driver(drone, message)
            if refusal is not None:
                raise DecodeError(refusal)
            self.history.add(key, payload, message.t_ns)
            if type(message) is flight_messages.LinkState:
                self.progress("link", message, drone)
        except DecodeError as error:
            self.history.add_foreign(key, payload)
            self._refuse(f"driver.{drone}", key, error)

    def _read_phase(self, key: str, payload: bytes) -> None:
        if self._states[key] % PHASE_EVERY == 0:
            state: flight_messages.ClusterState = messages.decode_as(flight_messages.ClusterState, payload, key)
            self.phase = state.phase
            self.progress("state", state, keys.thing(key))
        self._states[key] += 1

    # Outputs that were lost

    def recover_lost(self) -> None:
        """Request outputs again that a participant counted and that did not come, as after a cut link."""
        for participant in self.world.barrier.incomplete():
            if participant.away:
                continue
            if self.world.clock.mode == "realtime":
                participant.lost_done = False
                continue
            samples = self._lost_outputs(participant)
            age_ns = time.monotonic_ns() - participant.joined_wall_ns
            if samples is None and participant.rejoined and age_ns < REJOINED_NS:
                continue
            for sample in samples or ():
                self.take(time.monotonic_ns(), sample)
            self.world.give_up_outputs(participant.name)
            self.journal.note(GivenUp(participant.name))

    def _lost_outputs(self, participant: Participant) -> list[ReceivedSample] | None:
        """Return what a participant has kept of its outputs and that has not come; None if it does not answer."""
        key = keys.process(participant.name, "outputs")
        try:
            answer = self.link.request(key, "outputs", WORLD, timeout_s=RECOVERY_S)
            return self.history.lost_outputs(answer.result, participant.done_ns) if answer.ok else None
        except DecodeError as error:
            self._refuse(participant.name, key, error)
            return []


def _refuse_key_of_world(sample: ReceivedSample, wall_ns: int) -> None:
    raise DecodeError(f"{sample.key}: only the world publishes here")


def _head(key: str, payload: bytes) -> _Head:
    try:
        return _decode_head(payload)
    except messages.REFUSALS as error:
        raise DecodeError(f"{key}: {error}; must be a map with t_ns and seq") from error
