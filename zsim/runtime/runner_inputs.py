"""What reaches an agent's process: subscriptions, taken apart into an inbox, and what other threads of Zenoh bring."""

import contextlib
from collections import deque
from collections.abc import Callable, Container, Iterator
from operator import itemgetter
from typing import Any

from msgspec import UNSET

from zsim.contract import flight_messages, keys, messages, run_messages, world_events
from zsim.contract.framing import GateMessages, run_key_table
from zsim.contract.world_events import WorldEvent
from zsim.errors import DecodeError
from zsim.runtime.agent import Agent
from zsim.runtime.health import HealthMeter
from zsim.runtime.inbox import Inbox, RoutingTable, output_hold_ns
from zsim.transport.session import Query, RawSample, ReceivedSample, Session, Subscription


class RunnerInputs:
    """The subscriptions of one agent.

    Args:
        link: an open session.
        info: of the run.
        agent: whose inputs they are.
        health: counts what is received and refused.
        say: called with a line for the user.

    Attributes:
        inbox: the agent's inputs, by gate.
        notices, links, queries: what has come from other threads and is to be served in turn.
    """

    def __init__(
        self, link: Session, info: messages.Info, agent: Agent, health: HealthMeter, say: Callable[[str], None]
    ) -> None:
        self._link = link
        self._agent = agent
        self._health = health
        self._say = say
        self._is_realtime, self._gate_ns = info.mode == "realtime", info.gate_ns
        self._blocking: Subscription | None = None  # where `wait` waits
        self._external = frozenset(drone.name for drone in info.drones if drone.body is not UNSET)
        of_drivers = [key for key in agent.gate_keys if keys.parts(key)[1] in self._external]
        self.inbox = Inbox(
            agent.gate_keys, agent.counted, self._is_realtime, agent.uncounted, of_drivers, output_hold_ns(info)
        )
        estimates = (key for key in agent.gate_keys if key.endswith("/estimate"))
        self._stock = {key: f"estimator.{keys.thing(key)}" for key in estimates}
        self._estimated_by: dict[str, str] = {}
        self._subscriptions: dict[str, Subscription] = {}
        self._expressions = RoutingTable([[expression] for expression in agent.reads])
        self._table = run_key_table(info)
        self._gate_key = _gate_key(agent, self._external)
        self.notices: deque[WorldEvent] = deque()
        self.queries: deque[Query] = deque()
        self.links: deque[bool] = deque()
        self._fault_lists: deque[run_messages.Faults] = deque()
        self._repeated: dict[int, dict[tuple[str, int], Any]] = {}  # by gate, then by key and number

    def subscribe(self) -> None:
        """Subscribe to all that the agent reads, and answer its requests; show that the process lives."""
        closing = [self._agent.reads[place] for place in self._expressions.readers_of_any(self._agent.gate_keys)]
        for expression in dict.fromkeys([*closing, *self._agent.reads]):
            of_world = keys.is_sensor(expression) and keys.thing(expression) not in self._external
            subscribed = self._gate_key if self._gate_key and of_world else expression
            if subscribed not in self._subscriptions:
                self._subscriptions[subscribed] = self._link.subscribe(subscribed)
        self._link.declare_subscriber(keys.EVENT, self._on_event)
        self._link.declare_subscriber(keys.FAULTS, lambda sample: self._on_faults(sample.payload))
        if self._is_realtime:
            self._link.declare_subscriber(keys.CLOCK, self._on_clock)
        self._link.on_link(self._on_link)
        for key in self._agent.control_keys():
            self._link.declare_queryable(key, self._on_query)
        self._link.declare_queryable(keys.process(self._agent.name, "outputs"), self._on_query)
        self._link.declare_process(self._agent.name)

    def wait(self) -> None:
        """Wait for what completes the next gate, or until woken.

        Raises:
            SessionError: the session was closed meanwhile.
        """
        self._blocking = self._subscriptions[self._blocking_expression()]
        sample = self._blocking.receive()
        self._blocking = None
        if sample is not None:
            self._open(sample)

    def wake(self) -> None:
        """Let a `wait` of another thread return."""
        for subscription in list(self._subscriptions.values()):
            subscription.wake()

    def take_in_all(self) -> None:
        """Take in what has arrived: first what closes a gate, so that what came before it is found too."""
        for subscription in self._subscriptions.values():
            for sample in subscription.drain():
                self._open(sample)

    def _open(self, sample: ReceivedSample) -> None:
        """Take in a message, or the messages of a gate."""
        if sample.key != self._gate_key:
            self.take_in(sample)
            return
        try:
            gate = GateMessages.unpack(sample.payload, self._table)
            if not self._agent.takes_gates:
                gate.check()
        except DecodeError as error:
            self._refuse(error)
            return
        self._health.received += len(gate)
        self.inbox.put(keys.GATE, gate)

    def take_in(self, sample: ReceivedSample) -> None:
        """Take in one message."""
        if sample.key == keys.FAULTS:
            self._on_faults(sample.payload)
            return
        self._health.received += 1
        try:
            message = messages.decode(sample.key, sample.payload)
        except DecodeError as error:
            self._refuse(error)
            return
        if sample.key in self._agent.repeats:
            self._repeated.setdefault(message.t_ns, {})[sample.key, message.seq] = message
            return
        if type(message) is flight_messages.Estimate:
            self._estimated_by[sample.key] = message.source
        self.inbox.put(sample.key, message)

    def fault_lists_before(self, t_ns: int) -> list[run_messages.Faults]:
        """Return the lists of faults that were published before a gate, and forget them; an older one is of no use."""
        if not self._fault_lists:
            return []
        lists = [self._fault_lists.popleft() for _ in range(len(self._fault_lists))]
        self._fault_lists.extend(faults for faults in lists if faults.t_ns >= t_ns)
        return sorted((faults for faults in lists if faults.t_ns < t_ns), key=lambda faults: faults.seq)

    def repeated(self, t_ns: int) -> Iterator[tuple[str, Any]]:
        """Yield, and forget, the requests that a former incarnation took before a gate."""
        if self._repeated:
            for (key, _), request in sorted(self._repeated.pop(t_ns, {}).items(), key=itemgetter(0)):
                yield key, request

    def _refuse(self, error: DecodeError) -> None:
        self._health.refused += 1
        if self._health.refused == 1:
            self._say(str(error))

    def _blocking_expression(self) -> str:
        """Return the subscription from which the next missing message comes."""
        t_ns = self.inbox.next_gate_ns()
        missing = self.inbox.missing_last(t_ns) if t_ns is not None else self.inbox.awaited_last()
        wanted = missing or self._agent.gate_keys[-1]
        expression = self._agent.reads[self._expressions.readers(wanted)[0]]
        return expression if expression in self._subscriptions else self._gate_key

    def ignore_estimates(self, process: str) -> None:
        """Wait no longer for the estimates of a process: those that it published last, or has the name for."""
        for key, stock in self._stock.items():
            if process == (self._estimated_by.get(key) or stock):
                self.inbox.ignore(key)

    def expect_estimates(self, process: str, from_ns: int) -> None:
        """Wait again for the estimates of a process, from the gate `from_ns` on."""
        for key, stock in self._stock.items():
            if process in (self._estimated_by.get(key), stock):
                self.inbox.expect(key, from_ns)

    # From threads of Zenoh's

    def _on_event(self, sample: RawSample) -> None:
        try:
            read = world_events.read(sample.payload)
        except DecodeError:
            self._health.refused += 1  # somebody else's; the world's own events can be read
            return
        if read is not None:
            self.notices.append(read)
            self.wake()

    def _on_clock(self, sample: RawSample) -> None:
        """Wake who waits, in realtime, for a gate behind which the world is: what it lacks may never come."""
        blocking = self._blocking
        if blocking is None:
            return
        with contextlib.suppress(DecodeError):
            clock: run_messages.Clock = messages.decode(keys.CLOCK, sample.payload)
            if clock.t_ns >= self.inbox.taken_ns + 2 * self._gate_ns:
                blocking.wake()

    def _on_faults(self, payload: bytes) -> None:
        try:
            self._fault_lists.append(messages.decode(keys.FAULTS, payload))
        except DecodeError:
            self._health.refused += 1

    def _on_link(self, up: bool) -> None:
        self.links.append(up)
        self.wake()

    def _on_query(self, query: Query) -> None:
        self.queries.append(query)
        self.wake()


def _gate_key(agent: Agent, external: Container[str]) -> str:
    """Return on which key an agent takes the sensors of a gate as GateMessages; none for one that does not.

    What drivers publish of external drones comes on the keys of these.
    """
    of_world = [drone for drone in agent.counted if drone not in external]
    if of_world and len(agent.counted) > 1:
        return keys.GATE
    return keys.gate(of_world[0]) if of_world and agent.takes_gates else ""
