"""All inputs of a world as journal entries: applied in the same order, they give the same world to the bit.

While a world runs, every input passes through `Run.enter`, which applies the entry and notes it in the journal. A
restarted world applies the entries in the journal. Messages of other processes are checked, kept, counted for their
senders, and passed to the world if it acts on them.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import Annotated, Any

import msgspec

from zsim.contract import flight_messages, keys, messages, run_messages
from zsim.contract.flight_messages import Command
from zsim.contract.framing import Pairs, pairs_of
from zsim.contract.messages import REFUSALS
from zsim.contract.run_messages import ControlAnswer, ControlRequest, Join
from zsim.errors import DecodeError
from zsim.runtime.membership import HealthMeter
from zsim.scenario import roles
from zsim.schema.message import Count
from zsim_world.run.coordinator import Coordinator

PHASE_EVERY = 10  # one in this many cluster states is read for the phase on display
CAMERA_MESSAGES = (flight_messages.CameraInfo, flight_messages.Sightings)  # relayed from every process with a camera
DRIVER_TOPICS = ("truth", "link")  # published by the driver of an external drone, besides its sensors

ProgressCallback = Callable[[str, Any, str], None]
"""Shows progress. Called with ("clock" or "event", message, phase of the clusters), ("health", message, process), every
tenth ("state", message, cluster), ("link", message, drone), and ("resumed", simulated time in ns, process)."""

Sample = tuple[str, bytes]  # key and payload

Handler = Callable[[Sample, int], None]
"""Handles a message that arrived at a monotonic wall time [ns]; raises a DecodeError if it is refused."""
CALLS: dict[str, Any] = {  # methods of the world that are inputs, with the types of their arguments
    "await_return": tuple[int, bool],
    "control": tuple[ControlRequest],
    "died": tuple[str, int],
    "expired": tuple[str],
    "falsely_joined": tuple[str, Join, str],
    "give_up_outputs": tuple[str],
    "join": tuple[str, Join, int],
    "not_shown": tuple[str, str, int],
    "reader_closed": tuple[str, dict[str, Any]],
    "silence_changed": tuple[str, int | None],
}
encode = msgspec.msgpack.Encoder().encode
KEEP_NS = 5_000_000_000  # simulated time kept for replays
KEEP_BYTES = 500_000_000  # limit on the kept payloads; 1000 drones produce about 300 MB in KEEP_NS
FOREIGN_BYTES = 50_000_000  # share of KEEP_BYTES for messages outside the contract
LAST_MAX = 200_000  # keys whose last value is kept: 1000 drones have about 12 000
PAGE_BYTES = 8_000_000  # limit on the payloads of one answer
EXPRESSIONS_MAX = 1000  # key expressions of one replay; a controller of hundreds of drones reads two keys of each
_Entry = tuple[int, int, Pairs, int, bool]
"""Messages kept together: the world's time at arrival, their stamp, keys and payloads, the size of the payloads
[bytes], and whether they are refused or outside the contract."""


class _Head(msgspec.Struct):
    """The fields that the world reads from messages that it only relays."""

    t_ns: int
    seq: int
    source: str = ""
    controller: str = ""  # of a ClusterRequest, whose source is the client


_decode_head = msgspec.msgpack.Decoder(_Head).decode


def _head(key: str, payload: bytes) -> _Head:
    try:
        return _decode_head(payload)
    except messages.REFUSALS as error:
        raise DecodeError(f"{key}: {error}; must be a map with t_ns and seq") from error


class Run:
    """A world with its inputs and its message history.

    Args:
        world: a flight, or a replay.
        health: counts what is received and refused.
        note: called with every entry that belongs in the journal.

    Attributes:
        on_done: called with name, incarnation and wall time of a done before the world handles it.
        on_health: called with the name of a process that has published its health.
        phase: phase of the cluster whose state was read last.
        handlers: message handlers by key, for the keys seen so far.
    """

    def __init__(
        self, world: Coordinator, health: HealthMeter, note: "Callable[[Entry], None]" = lambda entry: None
    ) -> None:
        self.world = world
        self.health = health
        self.history = MessageHistory()
        self.progress: ProgressCallback = lambda kind, message, about: None
        self.on_done: Callable[[str, int, int], None] = lambda name, incarnation, wall_ns: None
        self.on_health: Callable[[str], None] = lambda name: None
        self.phase = ""
        self.handlers: dict[str, Handler] = {}
        self._note = note
        self._clock = world.clock
        self._states: Counter[str] = Counter()

    def enter(self, entry: "Entry") -> Any:
        """Apply an input and note it in the journal; return the answer to a request.

        An input that ends the run early is not noted, nor is any later one: `zsim run --continue` undoes such an end.
        After the last gate only the world's own messages are noted, since their numbering continues.
        """
        answer = entry.apply(self)
        clock = self._clock
        is_complete = clock.is_complete and self.world.failure is None
        if clock.ended is None or (is_complete and isinstance(entry, Advanced | Published)):
            self._note(entry)
        return answer

    def call(self, method: str, *args: Any) -> Any:
        """Call one of the world's methods in CALLS as an input."""
        return self.enter(Called(method, args))

    # Messages of other processes

    def learn_handler(self, key: str) -> Handler:
        """Return the handler of a key's messages and cache it: the same keys recur at every gate."""
        kind, (group, name, topic) = messages.type_of(key), keys.parts(key)
        if messages.is_relayed(kind) or (kind in CAMERA_MESSAGES and not keys.is_sensor(key)):
            handler = self._relay
        elif (
            group == "drone" and name in self.world.external and (topic in DRIVER_TOPICS or topic.startswith("sensor/"))
        ):
            handler = self._handle_driver_message
        elif key.startswith("process/") or keys.is_command(key):
            handler = self._hand_over
        else:
            handler = self._keep_foreign if kind is None else self._refuse_world_key
        if len(self.handlers) >= messages.KEYS_KEPT:
            self.handlers.clear()
        self.handlers[key] = handler
        return handler

    def _refuse_world_key(self, sample: Sample, wall_ns: int) -> None:
        """Refuse a message that claims to be the world's; neither recorders nor replays get it."""
        self.refuse_sample(sample, DecodeError(f"{sample[0]}: only the world publishes here"))

    def _keep_foreign(self, sample: Sample, wall_ns: int) -> None:
        """Keep a message on a key outside the contract."""
        self.history.passed.append(sample)
        self.history.add_foreign(*sample)

    def _hand_over(self, sample: Sample, wall_ns: int) -> None:
        """Pass the world a message that it acts on; joins are admitted separately."""
        self.history.passed.append(sample)
        key, payload = sample
        message = messages.decode(key, payload)
        self.history.add(key, payload, message.t_ns)
        kind = type(message)
        if kind is run_messages.Done:
            self.on_done(keys.thing(key), message.incarnation, wall_ns)
        if kind is not Join:
            self.world.handle(key, message, wall_ns)
        if kind is run_messages.Health:
            self.on_health(keys.thing(key))
            self.progress("health", message, keys.thing(key))

    def _relay(self, sample: Sample, wall_ns: int) -> None:
        """Keep an output that the world does not act on, and count it for its sender."""
        self.history.passed.append(sample)
        key, payload = sample
        kind = messages.type_of(key)
        is_counted = messages.is_relayed(kind)
        head = _head(key, payload) if is_counted else messages.decode(key, payload)
        if head.t_ns > self.world.now_ns:
            raise DecodeError(f"{key}: t_ns is {head.t_ns}; must be <= {self.world.now_ns}, the newest gate")
        self.history.add(key, payload, head.t_ns)
        if kind is flight_messages.ClusterState:
            if self._states[key] % PHASE_EVERY == 0:
                state: flight_messages.ClusterState = messages.decode_as(flight_messages.ClusterState, payload, key)
                self.phase = state.phase
                self.progress("state", state, keys.thing(key))
            self._states[key] += 1
        source = head.controller if kind is run_messages.ClusterRequest else head.source
        if not source and is_counted:
            source = f"{'estimator' if kind is flight_messages.Estimate else 'controller'}.{keys.thing(key)}"
        self.world.count_output(source)

    def _handle_driver_message(self, sample: Sample, wall_ns: int) -> None:
        """Keep a message of a driver about its drone, unless the world refuses it."""
        self.history.passed.append(sample)
        key, payload = sample
        drone = keys.thing(key)
        try:
            message = messages.decode(key, payload)
            refusal = self.world.accept_from_driver(drone, message)
            if refusal is not None:
                raise DecodeError(refusal)
            self.history.add(key, payload, message.t_ns)
            if type(message) is flight_messages.LinkState:
                self.progress("link", message, drone)
        except DecodeError as error:
            self.history.add_foreign(key, payload)
            self.refuse(f"driver.{drone}", key, error)

    def refuse(self, source: str, key: str, error: DecodeError) -> None:
        """Count a refused message, and publish the reason."""
        self.health.refused += 1
        self.world.outbox.refuse(source, key[:80], messages.fault_at(key, error))

    def refuse_sample(self, sample: Sample, error: DecodeError) -> None:
        """Refuse a message; if its sender is known, still count it as an output, because the sender's done does."""
        key, payload = sample
        self.refuse("somebody", key, error)
        with suppress(DecodeError):
            head = _head(key, payload)
            self.world.count_output(head.controller or head.source)


# The entries; wall times are monotonic


class Entry(msgspec.Struct, array_like=True, tag_field="kind", tag=True):
    """One input."""

    def apply(self, run: Run) -> Any:
        """Apply the input to the world; return the answer to a request."""
        raise NotImplementedError


class Taken(Entry, tag=0):
    """A message of another process."""

    wall_ns: int
    sample: Sample

    def apply(self, run: Run) -> None:
        key, payload = sample = self.sample
        run.health.received += 1
        try:
            handle = run.handlers.get(key) or run.learn_handler(key)
            handle(sample, self.wall_ns)
        except DecodeError as error:
            run.history.add_foreign(key, payload)
            run.refuse_sample(sample, error)


class Advanced(Entry, tag=1):
    """An advance by one gate, and whether it came too late."""

    wall_ns: int
    late: bool

    def apply(self, run: Run) -> None:
        run.world.statistics.world_misses += self.late
        run.world.advance(self.wall_ns)


class Published(Entry, tag=2):
    """A message of the world that does not follow from other inputs, such as its clock while time stands still."""

    key: str
    seq: int
    payload: bytes

    def apply(self, run: Run) -> None:
        run.history.passed.append((self.key, self.payload))
        run.history.add(self.key, self.payload, run.world.now_ns)
        run.world.outbox.numbers[self.key] = self.seq + 1


class Called(Entry, tag=3):
    """A call of one of the world's methods in CALLS."""

    method: str
    args: tuple[Any, ...]

    def apply(self, run: Run) -> Any:
        return getattr(run.world, self.method)(*msgspec.convert(self.args, CALLS[self.method]))


decode = msgspec.msgpack.Decoder(list[Taken | Advanced | Published | Called]).decode


class _ReplayArgs(msgspec.Struct):
    """The arguments of a replay; `page` is the field `more` of the previous answer."""

    from_ns: int
    keys: Annotated[list[str], msgspec.Meta(max_length=EXPRESSIONS_MAX)]
    page: Count = 0


class MessageHistory:
    """Payloads by key: last values for queries, and the last seconds for processes that catch up.

    It keeps the messages of the world and of all participants, dead ones included.

    Args:
        keep_bytes: limit on the payloads kept for replays [bytes].
        page_bytes: limit on the payloads of one page [bytes].

    Attributes:
        passed: messages not yet sent to recorders, in order.
        last_values: last payload of every key.
    """

    def __init__(self, keep_bytes: int = KEEP_BYTES, page_bytes: int = PAGE_BYTES) -> None:
        self.passed: list[tuple[str, bytes]] = []
        self.last_values: dict[str, bytes] = {}
        self._recent: deque[_Entry] = deque()
        self._now_ns = 0
        self._bytes = self._foreign_bytes = 0
        self._keep_bytes = keep_bytes
        self._page_bytes = page_bytes
        self._forgotten = 0

    def add(self, key: str, payload: bytes, t_ns: int) -> None:
        """Keep a message; t_ns is its stamp.

        Its age is measured from the world's time at its arrival, because a sender's stamp may be wrong.
        """
        if key == keys.CLOCK:
            self._now_ns = t_ns
        if key in self.last_values or len(self.last_values) < LAST_MAX:
            self.last_values[key] = payload
        self._keep(t_ns, [(key, payload)], len(payload))

    def add_foreign(self, key: str, payload: bytes) -> None:
        """Keep, for recorders, a refused message or one outside the contract; it does not become a last value.

        FOREIGN_BYTES limits these, so that they do not displace messages that a participant may need.
        """
        if self._foreign_bytes + len(payload) <= FOREIGN_BYTES:
            self._foreign_bytes += len(payload)
            self._keep(self._now_ns, [(key, payload)], len(payload), foreign=True)

    def add_all(self, published: Pairs, t_ns: int) -> None:
        """Keep the messages of the world's newest gate, t_ns, as if all were stamped t_ns."""
        self._now_ns = t_ns
        self.last_values.update(published)
        self._keep(t_ns, published, sum([len(payload) for _, payload in published]))

    def _keep(self, t_ns: int, passed: Pairs, size: int, foreign: bool = False) -> None:
        recent, now_ns = self._recent, self._now_ns
        recent.append((now_ns, t_ns, passed, size, foreign))
        self._bytes += size
        while self._bytes > self._keep_bytes or recent[0][0] < now_ns - KEEP_NS:
            _, _, oldest, its_size, was_foreign = recent.popleft()
            self._bytes -= its_size
            self._foreign_bytes -= its_size * was_foreign
            self._forgotten += len(oldest)

    def last(self, expression: str) -> Pairs:
        """Return the last value of every key that matches an expression."""
        if expression in self.last_values:
            return [(expression, self.last_values[expression])]
        return [(key, payload) for key, payload in list(self.last_values.items()) if keys.matches(expression, key)]

    def _each(self) -> Iterator[tuple[int, str, bytes]]:
        for _, t_ns, passed, _, _ in self._recent:
            for key, payload in passed:
                yield t_ns, key, payload

    def page(self, from_ns: int, wanted: Callable[[str], bool], start: int = 0) -> tuple[Pairs, int | None]:
        """Return a page of the messages stamped after from_ns on wanted keys.

        Args:
            start: 0, or the position returned with the previous page.

        Returns:
            (key, payload) in order of arrival, and the position of the next page; None after the last page.
        """
        passed: list[tuple[str, bytes]] = []
        verdicts: dict[str, bool] = {}
        size = 0
        for number, (t_ns, key, payload) in enumerate(self._each(), self._forgotten):
            if number < start or t_ns <= from_ns:
                continue
            if key not in verdicts:
                verdicts[key] = wanted(key)
            if not verdicts[key]:
                continue
            size += len(payload)
            if passed and size > self._page_bytes:
                return passed, number
            passed.append((key, payload))
        return passed, None

    def replay(self, args: dict[str, Any], readable: Sequence[str]) -> ControlAnswer:
        """Answer a request for a replay with a page of the history.

        Args:
            args: arguments of the request: from_ns, keys and page.
            readable: key expressions that the requesting process may read.
        """
        try:
            replay = msgspec.convert(args, _ReplayArgs)
        except REFUSALS as error:
            return ControlAnswer(False, f"replay: needs from_ns (whole number) and keys (list of texts): {error}")
        passed, next_page = self.page(
            replay.from_ns,
            lambda key: roles.permits(replay.keys, key) and roles.permits(readable, key),
            replay.page,
        )
        return ControlAnswer(True, result=passed, more=next_page)

    def lost_outputs(self, kept: Any, done_ns: int) -> Pairs:
        """Return the outputs kept by a participant that have not arrived, for example after a cut link, each once.

        Outputs of gates after its newest done are left out: they are on their way, or its next done will count them.

        Args:
            kept: result of the participant's answer.
            done_ns: newest gate that the participant has completed.

        Raises:
            DecodeError: the result is not a list of [key, payload].
        """
        outputs: dict[Any, tuple[str, bytes]] = {}
        for key, payload in pairs_of(kept):
            identity = _identity(key, payload)
            if identity is not None and identity[1] <= done_ns:
                outputs[identity] = (key, payload)
        stamps = {(key, t_ns) for key, t_ns, _, _ in outputs}
        for t_ns, key, payload in self._each():
            if (key, t_ns) in stamps:
                outputs.pop(_identity(key, payload), None)
        return list(outputs.values())


def _identity(key: str, payload: bytes) -> tuple[str, int, int, str] | None:
    """Return (key, t_ns, seq, source), which identifies an output; None for messages that no done counts."""
    kind = messages.type_of(key)
    if kind is None or not issubclass(kind, (Command, *messages.RELAYED)):
        return None
    try:
        message = messages.decode(key, payload)
    except DecodeError:
        return None
    return key, message.t_ns, message.seq, message.source
