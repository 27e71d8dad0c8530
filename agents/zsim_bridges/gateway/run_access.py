"""Access to a run for the gateway's clients: last values of keys, shared subscriptions, requests, and the lockstep.

In the lockstep, a client is an agent whose step is executed at the other end of a socket.
"""

import asyncio
import queue
import threading
from collections import deque
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any

import msgspec

from zsim.contract import keys, messages
from zsim.contract.framing import GateMessages, run_key_table
from zsim.contract.messages import Info
from zsim.contract.run_messages import ControlAnswer
from zsim.errors import DecodeError, SessionError
from zsim.runtime.agent import Agent, Output
from zsim.runtime.participant import Participant
from zsim.scenario import roles, scenario_file
from zsim.scenario.roles import expected_processes
from zsim.sensors.camera import CAMERAS
from zsim.transport.session import RawSample, ReceivedSample, Session, check_expression
from zsim.transport.traffic import Traffic
from zsim_bridges.gateway.client_messages import (
    ClientLimit,
    DoneRequest,
    ForbiddenError,
    JoinRequest,
    MessageDefaults,
    TooManyError,
    UnknownError,
    check_not_reserved,
    is_client_key,
    is_control_key,
    is_counted_key,
    is_valid,
    json_to_payload,
)

TICK_S = 0.1  # wall; period at which health is published and a stop is noticed while nothing arrives
REQUESTS_MAX = 64  # concurrent requests; each has a thread that waits for Zenoh
ECHOES_MAX = 256  # number of expected echoes per key; a paused world returns none, but clients may publish meanwhile
DELETED = None
OWN_BYTES_MAX = 64_000_000  # total size of the values on clients' own keys [bytes]
KEYS_MAX = 200_000  # number of keys with a last value; 1000 drones make about 12 000
WAITING_MAX = 50_000  # by default, maximum number of an expression's messages that wait for the loop
DELIVER_MAX = 500  # messages delivered before other tasks of the loop run
EXPRESSIONS_MAX = 2_000  # number for all clients together; the world's session checks every subscription

Subscriber = Callable[[RawSample], None]
ANSWER_TIMEOUT_S = 10.0  # wall time after which, in real time, a client that does not answer a gate leaves the lockstep
LATE_PERIODS = 2  # in real time, a gate this many periods late is skipped: its inputs are sent with a newer gate
NO_GATE_NS = -1  # no gate waits for an answer
_encode = msgspec.json.Encoder().encode


class RunAccess:
    """Access to the current run.

    Args:
        link: an open session.
        info: description of the run.
        observer: the gateway's participant in the run.
        secured: whether access control restricts the keys on which the gateway may publish.

    Attributes:
        values: last values of keys.
        defaults: defaults for messages in the gateway's own name.
        required_processes: each process that the run needs in order to start, with the drone or cluster that it serves.
    """

    def __init__(self, link: Session, info: Info, observer: Participant, secured: bool) -> None:
        self.link = link
        self.info = info
        self.values = LastValues(run_key_table(info))
        self.defaults = MessageDefaults(observer.name)
        self.unprefixed_link = link.unprefixed()
        self._observer = observer
        self._prefix = f"{link.federation}/"
        self._threads = ThreadPoolExecutor(REQUESTS_MAX, thread_name_prefix="ask")
        self._pending = 0
        self._traffic: Traffic | None = None
        scenario = scenario_file.from_text(info.scenario)
        self._writable_keys = roles.rights_for(observer.name, scenario).writes if secured else None
        self.required_processes = [(name, name.partition(".")[2]) for name in expected_processes(scenario)]
        self._known_names = {"drone": [d.name for d in info.drones], "cluster": [c.name for c in info.clusters]}

    @property
    def now_ns(self) -> int:
        """Simulated time of the newest gate."""
        return self._observer.now_ns

    # Messages that pass through the world

    def open(self) -> None:
        """Subscribe to the messages that pass through the world, and read the current last values."""
        self._traffic = Traffic(self.link, run_key_table(self.info), self.count_refused)
        # Views do not pass through the world.
        self.link.declare_subscriber("view/**", lambda sample: self._store_valid(self.values.add, sample))
        for expression in roles.LAST_VALUES:
            for sample in self.link.get(expression):
                self._store_valid(self.values.add, sample)

    def receive_until_end(self, stopped: Callable[[], bool]) -> None:
        """Store the messages that pass through the world until the run is over or `stopped` returns true."""
        traffic, finished = self._traffic, threading.Event()
        assert traffic is not None

        def tick() -> None:
            while not finished.wait(TICK_S):
                traffic.wake()

        ticker = threading.Thread(target=tick, name="tick", daemon=True)
        ticker.start()
        try:
            while not self._observer.end_reason and not stopped():
                received = traffic.receive()
                self._observer.health.received += bool(received)
                for entry in received:
                    if isinstance(entry, GateMessages):
                        self.values.add_gate(entry)
                    else:
                        self._store_valid(self.values.add_forwarded, entry)
                self._observer.tick()
        finally:
            finished.set()
            ticker.join()

    def _store_valid(self, add: Callable[[str, bytes], None], sample: RawSample | ReceivedSample) -> None:
        """Store a last value; ignore, but count, an invalid message, since any process may publish one."""
        if is_valid(sample.key, sample.payload):
            add(sample.key, sample.payload)
        else:
            self.count_refused()
        if sample.key == keys.CLOCK:
            self._observer.update_clock(sample.payload)

    def close(self) -> None:
        """Abandon waiting requests."""
        self._threads.shutdown(wait=False, cancel_futures=True)

    # By keys without the federation's name

    def put(self, key: str, value: Any, defaults: MessageDefaults) -> None:
        """Publish plain data on a key, with missing fields filled in; for errors, see `encode` and `check_writable`."""
        self.check_writable(key)
        with defaults.transaction():
            payload = self.encode(key, defaults.fill(key, value, self.now_ns))
        self.publish(key, payload)

    def publish(self, key: str, payload: bytes, encoding: str = "") -> None:
        """Publish a checked payload, with the given encoding, or else the default of its key."""
        self.link.put_sample(key, payload, encoding or messages.encoding(key))
        if not keys.is_picture(key):  # pictures are too large to keep; the world keeps none either
            self.values.add_own(key, payload, encoding)

    def encode(self, key: str, value: Any) -> bytes:
        """Return plain data as the payload of a key on which clients may publish.

        Raises:
            DecodeError: the data is not a message of the key; the error states key, field, value and what is allowed.
            ForbiddenError: the key is reserved.
            UnknownError: the run has no such drone or cluster.
            SessionError: the key is invalid.
        """
        self._check_key(key)
        return json_to_payload(key, value)

    def _check_key(self, key: str) -> None:
        """Raise an error for a key of the federation that is reserved, invalid, or unknown to the run."""
        check_not_reserved(key)
        check_expression(key)
        self.check_known(key)
        if is_client_key(key) and messages.type_of(key) is None:
            raise DecodeError(f"{key[:80]}: is not a key of the contract; see docs/protocol.md")

    def check_writable(self, key: str) -> None:
        """Raise a ForbiddenError for a key on which access control drops the gateway's messages."""
        if self._writable_keys is not None and not roles.permits(self._writable_keys, key):
            raise ForbiddenError(
                f"{key[:80]}: the gateway's certificate lets it write on {', '.join(self._writable_keys)} only"
            )

    def check_known(self, key: str) -> None:
        """Raise an UnknownError for a key of the contract with an unknown drone, cluster or process name."""
        kind, thing, _ = keys.parts(key.removeprefix("view/"))
        names = self._known_names.get(kind)
        if names is not None and (messages.type_of(key) or is_control_key(key)) and thing not in names:
            allowed = f"must be one of {', '.join(names)}" if names else "the run has none"
            raise UnknownError(f"{key[:80]}: {kind} is {thing[:40]!r}; {allowed}")
        if kind == "estimates" and not keys.PROCESS_NAME.fullmatch(thing):
            raise UnknownError(f"{key[:80]}: process is {thing[:60]!r}; must be 1 to 48 characters of a-z 0-9 _ . -")

    def camera_key(self, drone: str, camera: str) -> str:
        """Return the key of a camera's pictures, or raise an UnknownError."""
        if camera not in CAMERAS:
            raise UnknownError(f"camera is {camera[:40]!r}; must be {' or '.join(CAMERAS)}")
        if drone not in self._known_names["drone"]:
            raise UnknownError(f"drone is {drone[:40]!r}; must be one of {', '.join(self._known_names['drone'])}")
        return keys.camera(drone, camera)

    def count_refused(self) -> None:
        self._observer.health.refused += 1

    async def request(
        self, key: str, op: str, args: dict[str, Any], source: str, timeout_s: float = 5.0
    ) -> ControlAnswer:
        """Send a control request to the process that answers on a key; TooManyError if REQUESTS_MAX are unanswered."""
        if "*" in key:
            raise DecodeError(f"{key[:80]!r}: is not a key; a request needs one without wildcards")
        self.check_known(key)
        return await self._in_thread(self.link.request, key, op, source, args, timeout_s)

    # By full keys, with the federation's name; also keys of other federations

    def last_samples(self, expression: str) -> list[RawSample]:
        return [
            RawSample("PUT", f"{self._prefix}{key}", payload, self.values.encoding(key), None)
            for key, payload in self.values.matching(expression, self._prefix)
        ]

    async def query(self, expression: str, parameters: str, payload: bytes, encoding: str) -> list[RawSample]:
        """Return the answers to a Zenoh get on a full expression; for errors, see `request`."""
        return await self._in_thread(self.unprefixed_link.query, expression, parameters, payload, encoding)

    def put_full_key(self, key: str, payload: bytes, encoding: str) -> None:
        """Publish a payload on a full key; raise a DecodeError if it is not a message of the key."""
        local_key = self._local_key(key)
        if local_key is None:
            self.unprefixed_link.put_sample(key, payload, encoding)
            return
        if messages.type_of(local_key) is not None:
            messages.decode(local_key, payload)
        self.publish(local_key, payload, encoding)

    def delete_full_key(self, key: str) -> None:
        """Publish that a full key no longer has a value."""
        local_key = self._local_key(key)
        self.unprefixed_link.delete(key)
        if local_key is not None:
            self.values.drop(local_key)

    def _local_key(self, key: str) -> str | None:
        """Return a full key without this federation's name; None for a key of no federation or of another one.

        Raises:
            DecodeError, ForbiddenError, UnknownError, SessionError: clients may not publish on this key.
        """
        local_key = key.removeprefix(self._prefix)
        if local_key != key:
            self._check_key(local_key)
            self.check_writable(local_key)
            return local_key
        check_not_reserved(key)
        check_not_reserved(key.partition("/")[2] or key)
        return None

    async def _in_thread(self, call: Callable[..., Any], *args: Any) -> Any:
        if self._pending >= REQUESTS_MAX:
            raise TooManyError(f"{REQUESTS_MAX} requests are already waiting for answers; try again later")
        self._pending += 1
        try:
            return await asyncio.get_running_loop().run_in_executor(self._threads, call, *args)
        finally:
            self._pending -= 1


class EchoFilter:
    """Recognises clients' values that the world echoes when a newer value is already stored.

    After two values in quick succession, the echo of the first arrives when the second is already stored; after a
    value and its deletion, the echo arrives when there should be no value. An echo that never arrives is forgotten
    when a later one arrives on its key. Echoes are expected for at most `keys_max` keys.
    """

    def __init__(self, keys_max: int) -> None:
        self._keys_max = keys_max
        self._waiting: dict[str, deque[int | None]] = {}

    def add(self, key: str, payload: bytes) -> None:
        """Expect the echo of a payload that was sent to the world."""
        if key in self._waiting or len(self._waiting) < self._keys_max:
            self._waiting.setdefault(key, deque(maxlen=ECHOES_MAX)).append(hash(payload))

    def add_deletion(self, key: str) -> None:
        """Record that a key whose echoes are expected no longer has a value."""
        if key in self._waiting:
            self._waiting[key].append(DELETED)

    def is_stale(self, key: str, payload: bytes) -> bool:
        """Return whether a payload from the world is an echo superseded by a newer value or deletion."""
        waiting = [*self._waiting.get(key, ())]
        if hash(payload) not in waiting:
            return False
        del self._waiting[key]
        newer = waiting[waiting.index(hash(payload)) + 1 :]
        if any(entry is not DELETED for entry in newer):
            self._waiting[key] = deque(newer, maxlen=ECHOES_MAX)
        return bool(newer)


class LastValues:
    """The last value of every key that passed through the world or was published by this gateway's clients.

    Args:
        table: keys of the world's messages about the drones of the run; see `run_key_table`.
    """

    def __init__(self, table: tuple[str, ...]) -> None:
        self._table = table
        self._indices = {key: index for index, key in enumerate(self._table)}
        self._payloads: dict[str, bytes] = {}
        self._own_bytes = 0
        self._lock = threading.Lock()  # clients and the world add values in different threads
        self._encodings: dict[str, tuple[bytes, str]] = {}
        self._echoes = EchoFilter(KEYS_MAX)
        self._gate_entries: dict[int, tuple[GateMessages, int]] = {}

    def add(self, key: str, payload: bytes) -> None:
        with self._lock:
            self._add(key, payload)

    def add_own(self, key: str, payload: bytes, encoding: str = "") -> None:
        """Store a message of a client, which the world will echo."""
        with self._lock:
            self._echoes.add(key, payload)
            self._add(key, payload, encoding)

    def add_forwarded(self, key: str, payload: bytes) -> None:
        """Store a message that has passed through the world."""
        with self._lock:
            if not self._echoes.is_stale(key, payload):
                self._add(key, payload)

    def _add(self, key: str, payload: bytes, encoding: str = "") -> None:
        has_room = key in self._payloads or len(self._payloads) < KEYS_MAX
        if messages.type_of(key) is None:
            added_bytes = len(payload) - len(self._payloads.get(key, b""))
            if not has_room or self._own_bytes + added_bytes > OWN_BYTES_MAX:
                self._drop(key)  # no value is better than an outdated one
                return
            self._own_bytes += added_bytes
        if has_room:
            self._payloads[key] = payload
            if encoding:
                self._encodings[key] = (payload, encoding)

    def drop(self, key: str) -> None:
        """Remove the value of a key that a client of this gateway deletes."""
        with self._lock:
            self._echoes.add_deletion(key)
            self._drop(key)

    def _drop(self, key: str) -> None:
        dropped = self._payloads.pop(key, b"")
        if messages.type_of(key) is None:
            self._own_bytes -= len(dropped)
        self._encodings.pop(key, None)

    def encoding(self, key: str) -> str:
        """Return the encoding of a key's last value."""
        payload, encoding = self._encodings.get(key, (None, ""))
        return encoding if encoding and payload == self._payloads.get(key) else messages.encoding(key)

    def add_gate(self, gate: GateMessages) -> None:
        """Store the world's messages of a gate, whose columns have already been checked."""
        for m, index in enumerate(gate.which.tolist()):
            self._gate_entries[index] = (gate, m)

    def matching(self, expression: str, prefix: str = "") -> list[tuple[str, bytes]]:
        """Return the keys that an expression matches, sorted, with their payloads.

        Args:
            expression: key expression with the prefix.
            prefix: prepended to each key for the comparison; the returned keys lack it.
        """
        if "*" not in expression:
            matching = [expression.removeprefix(prefix)] if expression.startswith(prefix) else []
        else:
            known_keys = {*self._payloads, *(self._table[index] for index in list(self._gate_entries))}  # a copy
            matching = sorted(key for key in known_keys if keys.matches(expression, prefix + key))
        return [(key, payload) for key in matching if (payload := self._payload(key)) is not None]

    def _payload(self, key: str) -> bytes | None:
        gate, m = self._gate_entries.get(self._indices.get(key, -1), (None, 0))
        return gate.payload(m) if gate else self._payloads.get(key)


class SharedSubscriptions:
    """Subscriptions that clients share, and that outlast the Zenoh session of a run.

    Args:
        loop: event loop on which everything but Zenoh's callbacks is called.
        limit: bounds the number of clients; a connection with a single subscription is one client.
        waiting_max: number of an expression's messages that may wait for the loop; beyond it, the oldest are dropped.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, limit: ClientLimit, waiting_max: int = WAITING_MAX) -> None:
        self._loop = loop
        self._limit = limit
        self._waiting_max = waiting_max
        self._link: Session | None = None
        self._by_expression: dict[str, _SharedSubscription] = {}

    def attach(self, link: Session) -> None:
        self._link = link
        for expression, shared in self._by_expression.items():
            with suppress(SessionError):  # without the right to read, nothing arrives, as on keys without publishers
                shared.undeclare = link.declare_subscriber(expression, shared.on_publication)

    def detach(self) -> None:
        """Receive nothing until the next `attach`, since the session is closing."""
        self._link = None
        for shared in self._by_expression.values():
            shared.undeclare = None

    def subscribe(self, expression: str, subscriber: Subscriber) -> Callable[[], None]:
        """Call a subscriber with every publication on an expression until the returned function is called.

        Raises:
            SessionError: the expression is invalid, or the gateway's certificate does not permit reading it.
            TooManyError: there are already EXPRESSIONS_MAX other expressions.
        """
        shared = self._by_expression.get(expression)
        if shared is None:
            check_expression(expression)
            if len(self._by_expression) >= EXPRESSIONS_MAX:
                raise TooManyError(f"subscribe: there are {EXPRESSIONS_MAX} expressions already; use one of them")
            shared = _SharedSubscription(self._loop, self._waiting_max)
            if self._link is not None:
                shared.undeclare = self._link.declare_subscriber(expression, shared.on_publication)
            self._by_expression[expression] = shared
        shared.subscribers[subscriber] = None

        def unsubscribe() -> None:
            shared = self._by_expression.get(expression)
            if shared is None:
                return
            shared.subscribers.pop(subscriber, None)
            if not shared.subscribers:
                del self._by_expression[expression]
                if shared.undeclare is not None:
                    shared.undeclare()

        return unsubscribe

    def subscribe_stream(self, expression: str, subscriber: Subscriber) -> Callable[[], None]:
        """Subscribe for a connection with a single subscription, and count it among the clients.

        Raises:
            SessionError: see `subscribe`.
            TooManyError: the limit of clients or of expressions is reached.
        """
        self._limit.enter()
        try:
            unsubscribe = self.subscribe(expression, subscriber)
        except BaseException:
            self._limit.leave()
            raise

        def leave() -> None:
            unsubscribe()
            self._limit.leave()

        return leave


class _SharedSubscription:
    """One subscription: publications that arrive close together are delivered together."""

    def __init__(self, loop: asyncio.AbstractEventLoop, waiting_max: int) -> None:
        self._loop = loop
        self._waiting: deque[RawSample] = deque(maxlen=waiting_max)
        self._scheduled = False
        self.subscribers: dict[Subscriber, None] = {}
        self.undeclare: Callable[[], None] | None = None

    def on_publication(self, sample: RawSample) -> None:
        """Store a publication; called in a Zenoh thread."""
        self._waiting.append(sample)
        if not self._scheduled:
            self._scheduled = True
            with suppress(RuntimeError):  # the loop is closed
                self._loop.call_soon_threadsafe(self._deliver)

    def _deliver(self) -> None:
        self._scheduled = False
        for _ in range(min(DELIVER_MAX, len(self._waiting))):
            sample = self._waiting.popleft()
            for subscriber in list(self.subscribers):
                subscriber(sample)
        if self._waiting and not self._scheduled:
            self._scheduled = True
            self._loop.call_soon(self._deliver)


class LockstepSession(Agent):
    """A client's session in the lockstep, from joining to leaving: sends each gate's inputs and waits for the outputs.

    The runner calls the methods of `Agent` in a separate thread; all others are called on the loop.

    Args:
        name: process name of the client, such as `client.myctrl`.
        loop: event loop of the client.
        send: sends the line of a gate; called on the loop.

    Attributes:
        connection_lost: whether the client disconnected without leaving, or did not answer in time, so that its process
            is considered dead.

    Raises:
        DecodeError: the period or a gate key is invalid.
        UnknownError: a gate key names a drone or cluster that the run does not have.
        SessionError: an entry of `reads` or `gates` is not a key expression.
    """

    def __init__(
        self,
        name: str,
        request: JoinRequest,
        run: RunAccess,
        loop: asyncio.AbstractEventLoop,
        send: Callable[[bytes], None],
    ) -> None:
        super().__init__()
        info, reads, gates = run.info, request.reads, request.gates
        for key in (*reads, *gates):
            check_expression(key)
        self.name = name
        self.period_ns = round(request.period_s * 1e9)
        if self.period_ns <= 0 or self.period_ns % info.gate_ns:
            must = f"must be a multiple of {info.gate_ns / 1e9:g}"
            raise DecodeError(f"join: period_s is {self.period_ns / 1e9:g}; {must}")
        if any("*" in key for key in gates):
            raise DecodeError("join: gates has a wildcard; must be keys, each with a message at every gate")
        for key in gates:
            run.check_known(key)
        self.gate_keys = tuple(gates) or gate_keys_of(info, reads, name, run.required_processes)
        # A key that matches two expressions would arrive twice.
        missing = [key for key in self.gate_keys if not any(keys.matches(each, key) for each in reads)]
        self.reads = tuple(dict.fromkeys((*reads, *missing)))
        self.counted = tuple(d.name for d in info.drones if any(_matches_sensors(each, d.name) for each in self.reads))
        self.run = run
        self.defaults = MessageDefaults(name)
        self.has_left = self.connection_lost = False
        self._loop = loop
        self._send = send
        self._late_ns = LATE_PERIODS * self.period_ns if info.mode == "realtime" else None
        self._inputs: list[tuple[str, Any]] = []
        self._answers: queue.SimpleQueue[list[Output]] = queue.SimpleQueue()
        self._gate_ns = NO_GATE_NS

    def receive(self, key: str, message: Any) -> None:
        self._inputs.append((key, message))

    def step(self, t_ns: int) -> list[Output]:
        if self.has_left or (self._late_ns is not None and self.run.now_ns - t_ns >= self._late_ns):
            return []
        inputs, self._inputs = self._inputs, []
        entries = [{"key": key, "value": message} for key, message in inputs]
        line = _encode({"op": "gate", "t_ns": t_ns, "inputs": entries}) + b"\n"
        with suppress(RuntimeError):  # the gateway has ended
            self._loop.call_soon_threadsafe(self._send_gate, t_ns, line)
        try:
            return self._answers.get(timeout=ANSWER_TIMEOUT_S if self._late_ns is not None else None)
        except queue.Empty:
            self.leave(connection_lost=True)
            return []

    def _send_gate(self, t_ns: int, line: bytes) -> None:
        if not self.has_left:
            self._gate_ns = t_ns
            self._send(line)

    def answer_gate(self, request: DoneRequest) -> None:
        """Answer the waiting gate; on an error nothing changes, and the gate keeps waiting.

        Raises:
            DecodeError: there is no such gate, or an output is not a message of its key.
            ForbiddenError: an output's key is reserved, or access control does not permit it.
            UnknownError, SessionError: see `RunAccess.encode`.
        """
        if self._gate_ns == NO_GATE_NS:
            raise DecodeError("done: there is no gate to answer; wait for the next")
        if request.t_ns != self._gate_ns:
            raise DecodeError(f"done: t_ns is {request.t_ns}; must be {self._gate_ns}, the last gate sent")
        counted: list[Output] = []  # counted in `done` messages: the runner publishes these, the gateway the others
        others: list[tuple[str, bytes]] = []
        with self.defaults.transaction():
            for key, value in ((output.key, output.value) for output in request.outputs):
                is_counted = is_counted_key(key)
                if not is_counted:
                    self.run.check_writable(key)
                payload = self.run.encode(key, self.defaults.fill(key, value, self._gate_ns))
                if is_counted:
                    counted.append(Output(key, messages.decode(key, payload)))
                else:
                    others.append((key, payload))
        for key, payload in others:
            self.run.publish(key, payload)
        self._gate_ns = NO_GATE_NS
        self._answers.put(counted)

    def leave(self, connection_lost: bool = False) -> None:
        """End the session, and any step that waits for an answer."""
        self.has_left, self.connection_lost = True, connection_lost
        self._answers.put([])


def gate_keys_of(info: Info, reads: Sequence[str], name: str, required: Collection[tuple[str, str]]) -> tuple[str, ...]:
    """Return the keys with a message at every gate that match an expression of `reads`; `clock` if there are none.

    The world sends a drone's status and truth at every gate. The estimate of a drone and the state of a cluster arrive
    at every gate if the run cannot start without a process, other than the joining one, that serves this drone or
    cluster.
    """
    served = {thing for process, thing in required if process != name}
    world_keys = [key(drone.name) for drone in info.drones for key in (keys.status, keys.truth)]
    estimates = [keys.estimate(drone.name) for drone in info.drones if drone.name in served]
    states = [keys.cluster_state(cluster.name) for cluster in info.clusters if cluster.name in served]
    gate_keys = [key for key in (*world_keys, *estimates, *states) if any(keys.matches(each, key) for each in reads)]
    return tuple(gate_keys) or (keys.CLOCK,)


def _matches_sensors(expression: str, drone: str) -> bool:
    return all(keys.matches(expression, keys.sensor(drone, kind)) for kind in (*keys.SENSORS, "status"))
