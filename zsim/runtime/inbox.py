"""The inputs of an agent sorted by gate (`Inbox`), and the readers of each key (`RoutingTable`).

The order of arrival is irrelevant: a gate is complete once a message with its stamp has arrived on each closing key,
together with every counted sensor message. A gate that was lost entirely shows as a gap in the sequence numbers of a
drone's status.
"""

from bisect import bisect_right, insort
from collections import defaultdict
from collections.abc import Container, Iterable, Iterator, Sequence
from typing import Any

from zsim.contract import keys, messages
from zsim.contract.framing import GateMessages, PerPattern
from zsim.contract.messages import Info
from zsim.errors import DecodeError

GAP_MAX = 10  # maximum number of consecutive lost gates to request again; the world is never farther ahead of an agent
ALWAYS_NS = -1  # before every gate
NEVER_NS = 2**63 - 1  # after every gate
KEYS_MAX = 200_000  # limit on keys with cached readers; 1000 drones have about 15 000, and other programs may add more
Input = tuple[str, Any]
"""A key and its message, or `keys.GATE` and a `GateMessages`."""


def output_hold_ns(info: Info) -> int:
    """Return the time from the stamp of an output that closes no gate to its delivery [ns]; see `hold_ns` of `Inbox`.

    By then all agents have published their outputs with that stamp: the world is at most the command delay ahead of
    them, or not at all if agents exchange messages. In realtime, outputs are delivered on arrival.
    """
    if info.mode == "realtime":
        return 0
    return info.gate_ns + (0 if info.own_messages else info.command_delay_ns)


def is_held(key: str, gate_keys: Container[str], uncounted: Container[str]) -> bool:
    """Return whether a key's messages are outputs of other agents, to be delivered after the hold time."""
    return key not in gate_keys and key not in uncounted and messages.is_output(key)


def canonical(entry: Input) -> tuple[int, str, int]:
    key, message = entry
    return message.t_ns, key, message.seq


class Inbox:
    """Collects messages until their gate is complete."""

    def __init__(
        self,
        # closing keys: a gate t is complete once each of them has a message with t_ns == t
        gate_keys: Sequence[str],
        counted: Sequence[str] = (),  # drones whose `sensor/*` messages are all awaited, as counted in their status
        # whether a late message, unless older than one delivered on its key, is delivered with the next gate: in
        # realtime an old input is better than none
        keep_late: bool = False,
        # keys whose messages belong to no gate, such as detections in pictures; late ones are always delivered
        uncounted: Sequence[str] = (),
        # closing keys whose publishers, such as drivers of external drones, may skip gates; awaited until they do
        sparse: Sequence[str] = (),
        # delivery delay of agents' outputs on keys that close no gate, `output_hold_ns`: in lockstep, all have arrived
        # by then, so that the order of arrival is irrelevant
        hold_ns: int = 0,
    ) -> None:
        self._closing = dict.fromkeys(gate_keys)
        # stamps of the last two messages by key; initially earlier than any gate
        self._sparse = dict.fromkeys(sparse, (ALWAYS_NS - 1, ALWAYS_NS - 1))
        world_keys = dict.fromkeys(key for key in gate_keys if keys.is_status(key) and key not in self._sparse)
        self._other_keys = {key: None for key in gate_keys if key not in world_keys}  # not closed by `GateMessages`
        self._pulse = next(iter(world_keys), None)  # status whose sequence numbers reveal lost gates
        self._waiting: dict[int, dict[tuple[str, int], Input]] = {}  # by stamp plus hold time, then by key and seq
        self._stamps: list[int] = []
        self._lacking: dict[int, dict[str, None]] = {}  # closing keys still missing, by gate
        self._gates: list[int] = []
        self._expected_from_ns: dict[str, int] = {}
        self._meters = {keys.status(drone): _Meter() for drone in counted}
        self._arrivals: dict[str, list[int] | None] = {}
        self._beats: dict[int, int] = {}  # sequence number of the pulse, by gate
        self._last_beat: tuple[int, int] | None = None
        self.taken_ns = self._former_ns = -1  # the last two gates taken; -1 before the first
        self.hold_ns = hold_ns
        self._hold_of: dict[str, int] = {}
        self._holds = False
        self._keep_late = keep_late
        self._uncounted = frozenset(uncounted)
        self._belated: dict[tuple[str, int], Input] = {}
        self._newest: dict[str, int] = {}  # newest t_ns delivered per key, if late messages are kept
        # whether the publishers of all closing keys may skip gates
        self.may_skip = len(self._sparse) == len(self._closing)
        self.duplicates = 0  # messages that arrived again before their gate was taken
        self.late_count = 0  # messages that arrived after their gate was taken

    def put(self, key: str, message: Any) -> bool:
        """Store a message, or a `GateMessages` under `keys.GATE`; return False if it is a duplicate or too late."""
        t_ns = message.t_ns
        if key in self._sparse:
            _, newest_ns = last = self._sparse[key]
            self._sparse[key] = (newest_ns, t_ns) if t_ns > newest_ns else last
        hold_ns = self._hold_of.get(key)
        if hold_ns is None:
            hold_ns = self._hold_of[key] = self.hold_ns if is_held(key, self._closing, self._uncounted) else 0
            self._holds = self._holds or hold_ns > 0
        due_ns = t_ns + hold_ns
        if due_ns <= self.taken_ns:
            self.late_count += 1
            handed_ns = self._newest.get(key, ALWAYS_NS)  # if >= t_ns, this message or a newer one was delivered
            if (not self._keep_late or t_ns <= handed_ns) and key not in self._uncounted:
                return False
            self._belated[key, message.seq] = (key, message)
            return True
        stamped = self._waiting.get(due_ns)
        if stamped is None:
            stamped = self._waiting[due_ns] = {}
            _insert(self._stamps, due_ns)
        mark = (key, message.seq)
        if mark in stamped:
            self.duplicates += 1
            return False
        stamped[mark] = (key, message)
        if key not in self._arrivals:
            meter = self._meters.get(f"{key.rpartition('/')[0]}/status")
            self._arrivals[key] = meter.arrivals if meter else None
        arrivals = self._arrivals[key]
        if arrivals is not None:
            _insert(arrivals, due_ns)
        if key in self._closing:
            lacking = self._lacking.get(t_ns)
            if lacking is None:
                lacking = self._lacking[t_ns] = self._closing.copy()
                _insert(self._gates, t_ns)
            lacking.pop(key, None)
            if key == self._pulse:
                self._beats[t_ns] = message.seq
            if key in self._meters:
                self._meters[key].count(message)
        elif type(message) is GateMessages:  # it arrives as a unit: none of its messages can be missing
            if t_ns in self._lacking:
                self._lacking[t_ns] = {each: None for each in self._lacking[t_ns] if each in self._other_keys}
            else:
                self._lacking[t_ns] = self._other_keys.copy()
                _insert(self._gates, t_ns)
            if self._pulse is not None:
                self._beats[t_ns] = message.seq
        return True

    # Complete and missing gates

    def next_gate_ns(self) -> int | None:
        """Return the earliest gate not taken yet [ns], from closing messages and gaps in the pulse's sequence."""
        if not self._gates:
            return None
        t_ns = self._gates[0]
        if t_ns in self._beats and self._last_beat is not None:
            last_ns, last_seq = self._last_beat
            gates = self._beats[t_ns] - last_seq
            if 1 < gates <= GAP_MAX + 1:
                next_ns = last_ns + (t_ns - last_ns) // gates
                return next_ns if next_ns > self.taken_ns else t_ns
        return t_ns

    def latest_gate_ns(self) -> int | None:
        return self._gates[-1] if self._gates else None

    def missing(self, t_ns: int) -> str | None:
        """Return a missing closing key, or the status key of a drone with missing sensor messages; None if complete."""
        for key in self._lacking.get(t_ns, self._closing):
            if self._waits_for(key, t_ns):
                return key
        for key, meter in self._meters.items():
            if meter.counts and meter.is_short(t_ns) and t_ns >= self._expected_from_ns.get(key, ALWAYS_NS):
                return key
        return None

    def last_missing(self) -> str | None:
        """Return the last closing key that the next gate lacks, so that a waiting thread wakes up only once.

        If no closing key is missing, return the status key of a drone with missing sensor messages, or else None.
        """
        next_ns = self.next_gate_ns()
        t_ns = self.taken_ns + 1 if next_ns is None else next_ns
        for key in reversed(self._lacking.get(t_ns, self._closing)):
            if self._waits_for(key, t_ns):
                return key
        return self.missing(t_ns) if next_ns is not None else None

    def lost(self, t_ns: int) -> str | None:
        """Return the missing key if its message is lost; otherwise None.

        A closing message is lost if its publisher has moved on to a later gate; sensor messages are lost if the status
        that counts them has arrived without them.
        """
        key = self.missing(t_ns)
        if key is None or key not in self._lacking.get(t_ns, self._closing):
            return key
        return key if any(key not in self._lacking[gate] for gate in self._gates if gate > t_ns) else None

    def _waits_for(self, key: str, t_ns: int) -> bool:
        """Return whether a gate waits for a closing key.

        A key whose publisher may skip gates is awaited if messages arrived for both of the last two gates taken.
        """
        if t_ns < self._expected_from_ns.get(key, ALWAYS_NS):
            return False
        former_ns, newest_ns = self._sparse.get(key, (NEVER_NS, NEVER_NS))
        return newest_ns >= self.taken_ns and former_ns >= self._former_ns

    def expect(self, key: str, from_ns: int) -> None:
        """Wait for a key from the gate `from_ns` on, which is NEVER_NS if its publisher is dropped from the run."""
        self._expected_from_ns[key] = from_ns

    # Delivery

    def take(self, t_ns: int) -> list[Input]:
        """Remove and return all inputs stamped up to t_ns, in order of (t_ns, key, seq), late ones first."""
        ready: list[Input] = []
        for stamp in _pop_until(self._stamps, t_ns):
            stamped = self._waiting.pop(stamp)
            ready += stamped.values() if len(stamped) == 1 else map(stamped.__getitem__, sorted(stamped))
        if self._holds:
            ready.sort(key=canonical)
        if self._keep_late or self._belated:  # late messages come first
            ready = sorted(self._belated.values(), key=canonical) + ready
            self._belated.clear()
            for key, message in ready:
                self._newest[key] = max(self._newest.get(key, ALWAYS_NS), message.t_ns)
        for gate_ns in _pop_until(self._gates, t_ns):
            del self._lacking[gate_ns]
            if gate_ns in self._beats:
                self._last_beat = (gate_ns, self._beats.pop(gate_ns))
        for meter in self._meters.values():
            if meter.partial or meter.counts or meter.arrivals:
                meter.forget(t_ns)
        self._former_ns, self.taken_ns = self.taken_ns, t_ns
        return _once(ready) if len(ready) > 1 else ready

    def start_after(self, t_ns: int) -> None:
        """Ignore everything up to and including t_ns; the next gate must be complete."""
        self.take(t_ns)


def _once(ready: list[Input]) -> list[Input]:
    """Return the inputs without sensor messages that a `GateMessages` also contains: a replay sends them singly."""
    gates = [message for _, message in ready if type(message) is GateMessages]
    if not gates or not any(keys.is_sensor(key) for key, _ in ready):
        return ready
    covered = {gate.table[index] for gate in gates for index in set(gate.which.tolist()) if index < len(gate.table)}
    return [(key, message) for key, message in ready if key not in covered]


class _Meter:
    """Compares the number of sensor messages received from a drone with the count in its status.

    The first gate received is not compared, since it may have begun before the process joined, unless the seq of its
    status is 0.
    """

    def __init__(self) -> None:
        self.arrivals: list[int] = []  # stamps of the drone's pending sensor messages, sorted
        # stamps and counts of the drone's pending statuses; if empty, `is_short` is false
        self.counts: list[tuple[int, int]] = []
        self.partial = True  # whether the first status may count messages from before the join

    def count(self, status: Any) -> None:
        self.counts.append((status.t_ns, status.count))
        if status.seq == 0:
            self.partial = False

    def is_short(self, t_ns: int) -> bool:
        """Return whether sensor messages of the gates up to t_ns are missing."""
        if self.partial:
            return False
        return bisect_right(self.arrivals, t_ns) < sum(count for gate_ns, count in self.counts if gate_ns <= t_ns)

    def forget(self, t_ns: int) -> None:
        _pop_until(self.arrivals, t_ns)
        self.counts = [counted for counted in self.counts if counted[0] > t_ns]
        self.partial = False


def _insert(stamps: list[int], t_ns: int) -> None:
    """Insert a stamp into a sorted list; fast at the end, where nearly all belong."""
    if not stamps or t_ns >= stamps[-1]:
        stamps.append(t_ns)
    else:
        insort(stamps, t_ns)


def _pop_until(stamps: list[int], t_ns: int) -> list[int]:
    """Remove the stamps up to t_ns from a sorted list and return them."""
    index = bisect_right(stamps, t_ns)
    removed = stamps[:index]
    del stamps[:index]
    return removed


class RoutingTable:
    """Table of the readers of every key, which are determined once per key.

        routes = RoutingTable([["drone/*/truth"], ["drone/drone1/sensor/imu", "**"]])
        routes.readers("drone/drone1/truth")      (0, 1)

    Comparing every expression with every key would dominate the run time of a process with 1000 drones. Expressions
    with no wildcard but `*` are looked up by substituting `*` for chunks of the key; only those with `**` or `$*` are
    compared one by one.

    Args:
        expressions: key expressions of each reader; readers are identified by their index.
    """

    def __init__(self, expressions: Sequence[Sequence[str]]) -> None:
        self._filed: defaultdict[str, list[int]] = defaultdict(list)  # readers by expression with no wildcard but *
        self._starred: defaultdict[int, set[tuple[int, ...]]] = defaultdict(set)  # positions of *, by number of chunks
        self._compared: list[tuple[str, int]] = []
        self._cache: dict[str, tuple[int, ...]] = {}
        for reader, own in enumerate(expressions):
            for expression in own:
                chunks = expression.split("/")
                if "**" in chunks or "$*" in expression:
                    self._compared.append((expression, reader))
                    continue
                self._filed[expression].append(reader)
                if "*" in chunks:
                    starred = tuple(index for index, chunk in enumerate(chunks) if chunk == "*")
                    self._starred[len(chunks)].add(starred)

    def readers(self, key: str) -> tuple[int, ...]:
        cached = self._cache.get(key)
        if cached is not None:
            return cached
        matches = set(self._filed.get(key, ()))
        chunks = key.split("/")
        for starred in self._starred.get(len(chunks), ()):
            if not any(chunks[index].startswith("@") for index in starred):  # no wildcard matches such a chunk
                masked = ["*" if index in starred else chunk for index, chunk in enumerate(chunks)]
                matches.update(self._filed.get("/".join(masked), ()))
        matches.update(reader for expression, reader in self._compared if keys.matches(expression, key))
        readers = tuple(sorted(matches))
        if len(self._cache) < KEYS_MAX:
            self._cache[key] = readers
        return readers

    def readers_of_any(self, topic_keys: Iterable[str]) -> tuple[int, ...]:
        return tuple(sorted({reader for key in topic_keys for reader in self.readers(key)}))


class GateRouter:
    """Splits gates into messages; only messages that have readers are decoded, once for all readers."""

    def __init__(self, routes: RoutingTable) -> None:
        self._routes = routes
        self._read = PerPattern(self._read_of)

    def _read_of(self, gate: GateMessages) -> list[tuple[tuple[int, ...], str, int]]:
        """Return the readers, the key and the index in the gate of each message that has readers."""
        indices, readers_of = gate.which.tolist(), self._routes.readers
        if not indices or min(indices) < 0 or max(indices) >= len(gate.table):
            return []
        keys_of = map(gate.table.__getitem__, indices)
        return [(readers, key, index) for index, key in enumerate(keys_of) if (readers := readers_of(key))]

    def split(self, gate: GateMessages) -> Iterator[tuple[tuple[int, ...], str, Any]]:
        """Yield (readers, key, message) for each message that has readers, in order of publication.

        Messages that are not of their key's type are omitted, as are gates whose columns point outside their table.
        """
        for readers, key, index in self._read.of(gate):
            try:
                message = messages.decode(key, gate.payload(index))
            except DecodeError:
                continue  # not written by the world: treated as lost
            yield readers, key, message

    def one_by_one(self, inputs: Sequence[Input]) -> Sequence[Input]:
        """Return inputs in canonical order, with gates split into the messages that have readers."""
        if not any(type(message) is GateMessages for _, message in inputs):
            return inputs
        single: list[Input] = []
        for key, message in inputs:
            if type(message) is GateMessages:
                single += [(name, each) for _, name, each in self.split(message)]
            else:
                single.append((key, message))
        return sorted(single, key=canonical)
