"""An agent, alone or in a group: a plain object with inputs and outputs, independent of Zenoh and wall time.

    runner ──receive(key, message)──▶ agent          every input of a gate, in canonical order
    runner ──step(t_ns)────────────▶ agent ──▶ [(key, message), …]

`zsim.runtime.runner` runs it as a process on Zenoh, `zsim.runtime.bus` on an in-memory bus. Both pass the same inputs
in the same order, so that the outputs are bit-identical.
"""

import math
import re
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Sequence
from functools import cached_property
from graphlib import CycleError, TopologicalSorter
from types import FrameType
from typing import Any, NamedTuple

from msgspec import Struct
from msgspec.structs import replace

from zsim.contract import keys, messages
from zsim.contract.framing import GateMessages
from zsim.contract.messages import AgentMessage, Info, decode, encode
from zsim.contract.run_messages import ClusterRequest, ControlAnswer, ControlRequest, Faults
from zsim.contract.snapshot import State, checked
from zsim.errors import DecodeError, RunError, UserCodeError
from zsim.runtime.inbox import GateRouter, Input, RoutingTable, canonical, is_held
from zsim.runtime.links import Links, Transmitter
from zsim.scenario.roles import MAIN
from zsim.scenario.scenario import Radio
from zsim.schema import plugin
from zsim.schema.checker import show

_FILLED = ("name", "period_ns", "reads", "gate_keys")  # set by `Agent.bind` where a class does not define them


class Output(NamedTuple):
    """An outgoing message; the key is without the federation's prefix."""

    key: str
    message: Struct


class Agent(ABC):
    """Base class of all agents in the lockstep."""

    name: str  # process name `role.thing`, e.g. `estimator.drone1`
    period_ns: int  # interval of its steps and done messages; a multiple of the gate interval
    reads: tuple[str, ...]  # key expressions to which it subscribes
    gate_keys: tuple[str, ...]  # gate t closes once each of these keys has had a message stamped t, e.g. sensor/status
    # drones of which it reads all sensors: it waits for every message that their status counts
    counted: tuple[str, ...] = ()
    # keys whose messages belong to no gate: a late one is delivered with the next gate
    uncounted: tuple[str, ...] = ()
    writes: tuple[str, ...] = ()  # keys that it publishes at every gate, which other agents of its process may read
    serves: tuple[str, ...] = ()  # names of the processes that it replaces, besides its own
    # whether it takes the world's messages of a gate as columns and one buffer, in `receive_gate`
    takes_gates: bool = False
    repeats: tuple[str, ...] = ()  # keys of its outputs that record the requests it accepted, for `repeat`
    messages: tuple[type[AgentMessage], ...] = ()  # a user's message classes that it publishes
    thing = ""  # name of its drone or cluster: the second part of its own name
    _flies = ""  # the only drone that it may command; empty: any
    _links: Links | None = None
    _transmitter: Transmitter | None = None
    _answered_ns = 0  # the last gate of which it received the inputs

    def __init__(self) -> None:
        self._seq: defaultdict[str, int] = defaultdict(int)
        self._process = ""  # name of the group that it belongs to, under which it publishes

    def bind(self, info: Info, name: str = "", radio: Radio | None = None) -> None:
        """Fill in what a user's class does not define, before its agent joins the run of `info`.

        By default, the name is `agent.` and the class's name; the agent steps at every gate; `gate_keys` are the status
        of its own drone, or of every drone, and the estimates and cluster states in `reads`, which are published at
        every gate. In `reads`, `{drone}` and `{cluster}` stand for the name of the agent's drone or cluster.

        Args:
            name: name of the process, instead of the agent's own.
            radio: radio for messages between users' agents; None: all are delivered.
        """
        if not hasattr(self, "_process"):  # a class whose constructor does not call this one's
            Agent.__init__(self)
        own = vars(self)
        if "_declared" in own:  # bound for an earlier run
            for each in _FILLED:
                own.pop(each, None)
            own |= self._declared
        if name:
            own["name"] = name
        self._declared = {each: own[each] for each in _FILLED if each in own}
        self._seq.clear()
        drones = [drone.name for drone in info.drones]
        self.thing = (name or getattr(self, "name", default_name(type(self)))).partition(".")[2]
        self._flies = self.thing if self.thing in drones and self.thing != MAIN else ""
        statuses = [keys.status(drone) for drone in ([self.thing] if self.thing in drones else drones)]
        at_gates = [keys.estimate(drone.name) for drone in info.drones]
        at_gates += [keys.cluster_state(cluster.name) for cluster in info.clusters]
        self.name = getattr(self, "name", default_name(type(self)))
        self.period_ns = getattr(self, "period_ns", info.gate_ns)
        reads = getattr(self, "reads", ())
        self.reads = tuple(each.replace("{drone}", self.thing).replace("{cluster}", self.thing) for each in reads)
        if not hasattr(self, "gate_keys"):
            read = [key for key in at_gates if any(keys.matches(each, key) for each in self.reads)]
            self.gate_keys = (*statuses, *read)
            self.reads = tuple(dict.fromkeys((*self.reads, *statuses)))
        self._links, self._transmitter = None, radio and Transmitter(radio, info.gate_ns)
        things = (*drones, *(cluster.name for cluster in info.clusters), MAIN)
        exchanged = (each.key.replace("*", thing) for each in info.own_messages for thing in things)
        if radio and RoutingTable([self.reads]).readers_of_any(exchanged):
            self._links = Links(info, (self.name, *self.serves), radio)
            self.reads, self.gate_keys = (*self.reads, keys.RADIO), (*self.gate_keys, keys.RADIO)

    @property
    def role(self) -> str:
        """The first part of the name: `estimator` of `estimator.drone1`."""
        return self.name.split(".", 1)[0]

    @property
    def source(self) -> str:
        """Name of the process that publishes its outputs: its own, unless it is in a group."""
        return self._process or self.name

    @property
    def overhears(self) -> bool:
        """Whether it may read outputs of other agents that close none of its gates."""
        return any(not keys.is_sensor(key) and key not in self.gate_keys for key in self.reads)

    def update_faults(self, info: Info, faults: Faults) -> None:
        """Receive the injected faults of the run; called before each gate in which they change."""
        if self._links is None and faults.faults:
            self._links = Links(info, (self.name, *self.serves))
        if self._links is not None:
            self._links.update(faults)

    def answer(self, t_ns: int, inputs: Sequence[Input]) -> Sequence[Output] | None:
        """Process the inputs of a gate; return its outputs, or None at a gate at which it does not step.

        Outputs of a user's class are converted as they would be over Zenoh, to finite values of the contract's types.

        Raises:
            UserCodeError: a user's class raised an exception or returned an invalid value.
        """
        try:
            self._answered_ns = t_ns
            self.deliver(t_ns, inputs)
            if t_ns % self.period_ns:
                return None
            outputs = self.step(t_ns)
            if self._is_own:
                if not isinstance(outputs, list | tuple) or isinstance(outputs, Output):
                    context = f"{plugin.full_name(type(self))}.step returns {show(outputs)}"
                    raise UserCodeError(f"{context}; must return a list of outputs, which may be empty")
                outputs = [self._checked(t_ns, output) for output in outputs]
            return [Output(*sent) for sent in self._transmitter.send(t_ns, outputs)] if self._transmitter else outputs
        except plugin.RAISED as error:
            failure = self.failure(error, t_ns)
            if failure is None:
                raise
            raise failure from error

    @staticmethod
    def held_by(frame: FrameType | None) -> str:
        """Return a text naming the agent that has not returned, and its line, given a frame of its thread, or ""."""
        line = plugin.innermost_line(frame)
        while frame and frame.f_code is not Agent.answer.__code__:
            frame = frame.f_back
        if frame is None:
            return ""
        agent = frame.f_locals["self"]
        return f"; {agent.name} has not returned from its step at {agent._answered_ns / 1e9:.2f} s{line}"

    def failure(self, error: BaseException, t_ns: int) -> UserCodeError | None:
        """Return an error raised by user code, with the agent's name and the gate; None for other errors."""
        return plugin.user_code_error(error, f"{self.name} at {t_ns / 1e9:.2f} s")

    @cached_property
    def _is_own(self) -> bool:
        return plugin.is_own(type(self))

    def _checked(self, t_ns: int, output: Any) -> Output:
        """Return an output of a user's class as it would be received, with its source.

        A message of the class's own types may lack its key, stamp and sequence number.
        """
        try:
            if isinstance(output, AgentMessage):
                output = self.message(t_ns, output)
            if not (isinstance(output, tuple) and len(output) == 2 and isinstance(output[0], str)):
                allowed = "must be the result of self.command or self.message, or a zsim.Output"
                raise DecodeError(f"{show(output)}: is not an output; {allowed}")
            key, message = output
            if isinstance(message, AgentMessage) and type(message) not in self.messages:
                raise DecodeError(f"{key}: {type(message).__name__} is undeclared; must be in its class's `messages`")
            kind = messages.output_type(key)
            if isinstance(message, AgentMessage) and key != message.of(self.thing):
                raise DecodeError(f"{key}: belongs to another agent; must be {message.of(self.thing)}")
            if keys.is_command(key) and keys.thing(key) != self._flies and self._flies:
                raise DecodeError(f"{key}: commands another agent's drone; {self.name} may command {self._flies} only")
            if isinstance(message, AgentMessage) and message.seq < 0:
                message = self.message(t_ns, message).message
            if type(message) is not kind:
                raise DecodeError(f"{key}: message is a {type(message).__name__}; must be a {kind.__name__}")
            sent = messages.decode(key, encode(message))
            field = "controller" if isinstance(sent, ClusterRequest) else "source"
            own = self.name if isinstance(sent, AgentMessage) else self.source
            sender = getattr(sent, field)
            if sender not in ("", own):
                allowed = f"must be {own!r}, the agent's own name, or empty"
                raise DecodeError(f"{key}: {field} is {sender!r}; {allowed}")
            return Output(key, replace(sent, **{field: own}))
        except (DecodeError, *messages.REFUSALS) as error:
            raise UserCodeError(f"{plugin.full_name(type(self))}.step returns {error}") from error

    def deliver(self, t_ns: int, inputs: Sequence[Input]) -> None:
        """Receive the inputs of a gate in canonical order, after applying the agent's link faults and radio."""
        if self._links is not None and self._links.act_at(t_ns):
            inputs = self._links.delivered(t_ns, self._router.one_by_one(inputs))
        elif not self.takes_gates and not self._process:
            inputs = self._router.one_by_one(inputs)
        for key, message in inputs:
            if type(message) is GateMessages:
                self.receive_gate(message)
            else:
                self.receive(key, message)

    @cached_property
    def _router(self) -> GateRouter:
        return GateRouter(RoutingTable([self.reads]))

    @abstractmethod
    def receive(self, key: str, message: Any) -> None:
        """Receive one input; called in order of (t_ns, key, seq) just before `step`."""

    def receive_gate(self, gate: GateMessages) -> None:
        """Receive the world's messages of a gate before its other inputs; only called if it `takes_gates`."""
        for _, key, message in self._router.split(gate):
            self.receive(key, message)

    @abstractmethod
    def step(self, t_ns: int) -> Sequence[Output]:
        """Return the outputs of the gate t_ns."""

    def views(self, t_ns: int) -> Sequence[Output]:
        """Return the messages on `view/**` for displays at the gate t_ns, the last one stepped.

        Called at display rate, only after some gates, and never in the world's process: nothing may depend on it.
        """
        return ()

    def rehearse(self) -> None:
        """Load and compile the code of the first step before joining, so that no gate waits for it."""
        return

    def control_keys(self) -> tuple[str, ...]:
        """Return the keys on which `control` answers requests."""
        return ()

    def control(self, key: str, request: ControlRequest) -> ControlAnswer:
        """Answer a request; called between gates."""
        return ControlAnswer(ok=False, error=f"{key}: {self.name} answers no requests")

    def warm_start_keys(self) -> tuple[str, ...]:
        """Return the keys whose last values a new incarnation takes over through `warm_start`."""
        return ()

    def warm_start(self, key: str, message: Any) -> None:  # noqa: B027 - optional
        """Take over the last value that the predecessor published."""

    def snapshot(self) -> State | None:
        """Return the state after the last gate stepped, as plain values; None if not supported.

        A new agent given this state by `restore` continues with bit-identical outputs.
        """
        return None

    def restore(self, state: State) -> None:  # noqa: B027 - never called without a snapshot
        """Take over the state that a predecessor returned from `snapshot`; after an error the agent starts anew."""

    def repeat(self, key: str, message: Any) -> None:  # noqa: B027 - most agents answer no requests
        """Repeat a request that the predecessor published on a key of `repeats`; called before the message's gate."""

    def checkpoint(self) -> State | None:
        """Return the snapshot and the common state: sequence numbers and held messages; None without a snapshot."""
        own = self.snapshot()
        if self._is_own:
            try:
                own = checked(own, type(self))
            except UserCodeError as error:
                raise UserCodeError(error.text, f"{self.name} at {self._answered_ns / 1e9:.2f} s") from error
        if own is None:
            return None
        return {
            "own": own,
            "seq": dict(self._seq),
            "links": self._links.snapshot() if self._links else None,
            "transmitter": self._transmitter.snapshot() if self._transmitter else None,
        }

    def resume(self, info: Info, checkpoint: State) -> None:
        """Take over a checkpoint; one from another version of this agent may raise any error."""
        self.restore(checkpoint["own"])
        self._seq = defaultdict(int, checkpoint["seq"])
        if checkpoint["links"] is not None:
            self._links = self._links or Links(info, (self.name, *self.serves))
            self._links.restore(checkpoint["links"])
        if self._transmitter:
            self._transmitter.restore(checkpoint["transmitter"])

    def command(self, t_ns: int, drone: str, command: Struct) -> Output:
        """Return a command to a drone as an output of the gate t_ns, with stamp, sequence number and source.

        Args:
            command: result of `zsim.velocity` or a similar function.
        """
        key = messages.command_key(drone, command)
        stamp = {"t_ns": t_ns, "seq": self.next_seq(key), "source": self.source}
        return Output(key, replace(command, **stamp))

    def message(self, t_ns: int, message: AgentMessage) -> Output:
        """Return a message to agents as an output with stamp, sequence number and source; it is read a gate later."""
        key = message.of(self.thing)  # the source is the agent even in a group, since readers may depend on it
        return Output(key, replace(message, t_ns=t_ns, seq=self.next_seq(key), source=self.name))

    def next_seq(self, key: str) -> int:
        """Return the next sequence number for one of its keys, starting at 0."""
        count = self._seq[key]
        self._seq[key] = count + 1
        return count

    def resume_seq(self, key: str, last: int) -> None:
        """Continue numbering after `last`, so that messages after a restart are distinguishable."""
        self._seq[key] = last + 1


def default_name(factory: Any) -> str:
    """Return the process name of an agent without one, from its class or factory function."""
    letters = re.sub(r"[^a-z0-9_.-]", "", getattr(factory, "__name__", type(factory).__name__).lower())
    return f"agent.{letters or 'main'}"[:32]


class AgentGroup(Agent):
    """Several agents that share a process, its name, its join and its done; they step one after the other.

        AgentGroup([estimators, controller], output_hold_ns(info))     sensors in, estimates and commands out

    A process has more overhead than an agent: three estimators and a controller run about twice as fast in one process.

    A member receives each message at the gate at which a separate process would: outputs of other members that close
    its gate (in their `writes` and its `gate_keys`) immediately; all others through the transport, `hold_ns` after
    their stamp. The group takes the name of its last member, also the source of all messages but `AgentMessage`s.

    Args:
        members: the agents, in any order except the last, as above; each steps at the gates of its own period.
        hold_ns: `output_hold_ns` of the run.

    Raises:
        RunError: there are no members, or they wait for each other's outputs.
    """

    def __init__(self, members: Sequence[Agent], hold_ns: int) -> None:
        super().__init__()
        self._members = _in_order(members)
        self._hold_ns = hold_ns
        last = members[-1]
        self.name, self.period_ns = last.name, math.gcd(*(member.period_ns for member in members))
        served = [name for member in members for name in (member.name, *member.serves)]
        self.serves = tuple(name for name in served if name != self.name)
        self.writes = _joined(member.writes for member in members)
        self._inner = inner = frozenset(self.writes)
        self._closing = [frozenset(member.gate_keys) for member in self._members]
        relayed = [inner & closing for closing in self._closing]
        reads = zip(self._members, relayed, strict=True)
        self.reads = _joined([key for key in member.reads if key not in own] for member, own in reads)
        self.gate_keys = tuple(key for key in _joined(member.gate_keys for member in members) if key not in inner)
        self.counted = _joined(member.counted for member in members)
        self.uncounted = _joined(member.uncounted for member in members)
        self.repeats = _joined(member.repeats for member in members)
        self._waiting: list[list[Input]] = [[] for _ in members]
        self._delayed: list[tuple[int, int, Input]] = []  # time of release [ns], index of the member, input
        self._routes = RoutingTable([member.reads for member in self._members])
        self._destinations: dict[str, list[tuple[int, int]]] = {}  # by key: (receiving member, hold time [ns])
        self._relays = {key: [i for i, closing in enumerate(self._closing) if key in closing] for key in inner}
        self._gate_takers = [index for index, member in enumerate(self._members) if member.takes_gates]
        readers = [() if member.takes_gates else member.reads for member in self._members]
        self._gates = GateRouter(RoutingTable(readers))
        self.takes_gates = True  # and splits them for members that do not
        for member in members:
            member._process = self.name

    def update_faults(self, info: Info, faults: Faults) -> None:
        for member in self._members:  # each has links of its own
            member.update_faults(info, faults)

    def receive(self, key: str, message: Any) -> None:
        destinations = self._destinations.get(key)
        if destinations is None:
            destinations = self._destinations[key] = []
            for index in self._routes.readers(key):
                closing = self._closing[index]  # what closes one member's gate may be a plain input of another
                if key not in self._inner & closing:  # otherwise, it has been relayed
                    is_delayed = is_held(key, closing, self._members[index].uncounted)
                    destinations.append((index, self._hold_ns if is_delayed else 0))
        for index, hold_ns in destinations:
            if hold_ns:
                self._delayed.append((message.t_ns + hold_ns, index, (key, message)))
            else:
                self._waiting[index].append((key, message))

    def receive_gate(self, gate: GateMessages) -> None:
        for index in self._gate_takers:
            self._waiting[index].append((keys.GATE, gate))
        for readers, key, message in self._gates.split(gate):
            for index in readers:
                self._waiting[index].append((key, message))

    def step(self, t_ns: int) -> list[Output]:
        if self._delayed:
            for until_ns, index, entry in self._delayed:
                if until_ns <= t_ns:
                    self._waiting[index].append(entry)
            self._delayed = [delayed for delayed in self._delayed if delayed[0] > t_ns]
        outputs: list[Output] = []
        for index, member in enumerate(self._members):
            inputs, self._waiting[index] = self._waiting[index], []
            if len(inputs) > 1:
                inputs.sort(key=canonical)
            own = member.answer(t_ns, inputs) or ()
            for output in own:
                for reader in self._relays.get(output.key, ()):
                    self._waiting[reader].append(output)
            outputs += own
        return outputs

    def views(self, t_ns: int) -> list[Output]:
        return [output for member in self._members for output in member.views(t_ns)]

    def rehearse(self) -> None:
        for member in self._members:
            member.rehearse()

    def control_keys(self) -> tuple[str, ...]:
        return _joined(member.control_keys() for member in self._members)

    def control(self, key: str, request: ControlRequest) -> ControlAnswer:
        return next(m for m in self._members if key in m.control_keys()).control(key, request)

    def warm_start_keys(self) -> tuple[str, ...]:
        return _joined(member.warm_start_keys() for member in self._members)

    def warm_start(self, key: str, message: Any) -> None:
        self._owner(key).warm_start(key, message)

    def resume_seq(self, key: str, last: int) -> None:
        self._owner(key).resume_seq(key, last)

    def snapshot(self) -> State | None:
        members = [member.checkpoint() for member in self._members]
        if None in members:
            return None
        waiting = [[[key, encode(message)] for key, message in inputs] for inputs in self._waiting]
        delayed = [[until_ns, index, key, encode(message)] for until_ns, index, (key, message) in self._delayed]
        return {"members": members, "waiting": waiting, "held": delayed}

    def resume(self, info: Info, checkpoint: State) -> None:
        super().resume(info, checkpoint)
        own = checkpoint["own"]
        for member, its_own in zip(self._members, own["members"], strict=True):
            member.resume(info, its_own)
        self._waiting = [[(key, decode(key, payload)) for key, payload in inputs] for inputs in own["waiting"]]
        self._delayed = [
            (until_ns, index, (key, decode(key, payload))) for until_ns, index, key, payload in own["held"]
        ]

    def repeat(self, key: str, message: Any) -> None:
        next(member for member in self._members if key in member.repeats).repeat(key, message)

    def _owner(self, key: str) -> Agent:
        return next(member for member in self._members if key in member.warm_start_keys())


def _joined(parts: Any) -> tuple[str, ...]:
    return tuple(dict.fromkeys(each for part in parts for each in part))


def _in_order(members: Sequence[Agent]) -> tuple[Agent, ...]:
    """Return the members, each after those whose outputs close its gate; raise RunError if no such order exists."""
    if not members:
        raise RunError("a group has no members; must have at least one")
    writers = {key: index for index, member in enumerate(members) for key in member.writes}
    waits_for = {i: [writers[key] for key in m.gate_keys if writers.get(key, i) != i] for i, m in enumerate(members)}
    try:
        return tuple(members[index] for index in TopologicalSorter(waits_for).static_order())
    except CycleError as error:
        names = ", ".join(members[index].name for index in sorted(set(error.args[1])))
        conflict = f"gate_keys of a group's members {names} are outputs of each other"
        raise RunError(f"{conflict}; must not wait for each other: list one of them only in `reads`") from None
