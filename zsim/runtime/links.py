"""Effects of links on the messages of a gate: the radio's bandwidth at the sender, all others at the receiver.

    agent ──messages──▶ Transmitter ──within its bandwidth──▶ … ──▶ Links ──now, later or never──▶ agent

The radio acts on messages between users' agents, according to the connectivity that the world publishes at every gate
(`RadioLinks`); injected link faults act on all messages.

Lockstep counts every message on arrival regardless; only the agent receives it late or never. The loss and delay of a
message are drawn from its link's random stream by the message's identity (key, t_ns, seq), so that neither the order of
arrival nor a restart of the receiver changes a draw.
"""

import math
from collections import deque
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from typing import Any

import msgspec

from zsim.contract import keys, messages
from zsim.contract.flight_messages import Estimate
from zsim.contract.messages import AgentMessage, Info, decode, encode
from zsim.contract.run_messages import Fault, Faults, RadioLinks
from zsim.contract.snapshot import State
from zsim.math import elementary as el
from zsim.math.randomness import uniform
from zsim.runtime.inbox import Input, canonical
from zsim.scenario import faults as fault_kinds
from zsim.scenario.roles import ROLES
from zsim.scenario.scenario import Radio

LISTS_KEPT = 50  # number of `RadioLinks` kept: those of one second, for realtime; lockstep needs two
NEVER = None  # as a delay: the message is lost
ENVELOPE = frozenset(AgentMessage.__struct_fields__)  # fields that a real radio would not carry


WORLD, RADIO = "world", "radio"
KINDS = frozenset(name for name, kind in fault_kinds.KINDS.items() if kind.strikes in ("link", RADIO))
Point = Sequence[float]


class Links:
    """Delays or drops the messages of a gate to one receiver.

    Args:
        names: names of the receiver; an estimator for several drones has one name per drone.
        radio: radio between users' agents; None if all of them receive all messages.
    """

    def __init__(self, info: Info, names: Sequence[str], radio: Radio | None = None) -> None:
        self._names = tuple(names)
        self._radio = radio and Receiver(info, radio, self._names[0])
        self._seed, self._gate_ns = info.seed, info.gate_ns
        self._roles = {each.key: each.role for each in info.own_messages}
        self._drones = frozenset(drone.name for drone in info.drones)
        self._clusters = {cluster.name: cluster.drones for cluster in info.clusters}
        self._list: Faults | None = None  # newest list of faults
        self._faults: list[Fault] = []
        self._later: list[tuple[int, str, Any]] = []  # gate of delivery, key, message
        self._positions: dict[str, Point] = {}

    def update(self, faults: Faults) -> None:
        if self._list and faults.seq <= self._list.seq:
            return
        self._list = faults

        def concerned(fault: Fault) -> bool:
            return fault.kind == RADIO or any(name in fault.target.split("/") for name in self._names)

        self._faults = [fault for fault in faults.faults if fault.kind in KINDS and concerned(fault)]

    def act_at(self, t_ns: int) -> bool:
        """Return whether links may change the inputs of a gate."""
        return bool(self._radio or self._later) or any(fault_kinds.acts(fault, t_ns) for fault in self._faults)

    def delivered(self, t_ns: int, inputs: Sequence[Input]) -> list[Input]:
        """Return the messages delivered at the gate t_ns, in canonical order.

        `inputs` are the individual messages received for that gate.
        """
        acting = [fault for fault in self._faults if fault_kinds.acts(fault, t_ns)]
        if acting:
            positions = {keys.thing(key): message.position_m for key, message in inputs if type(message) is Estimate}
            self._positions |= positions
        handed = [(key, message) for gate_ns, key, message in self._later if gate_ns <= t_ns]
        self._later = [entry for entry in self._later if entry[0] > t_ns]
        for key, message in inputs:
            if self._radio and key == keys.RADIO:
                self._radio.take(message)
                continue
            late_ns = self._delay_ns(key, message, acting)
            if late_ns is None:
                continue
            gate_ns = -(-(message.t_ns + late_ns) // self._gate_ns) * self._gate_ns
            if late_ns == 0 or gate_ns <= t_ns:
                handed.append((key, message))
            else:
                self._later.append((gate_ns, key, message))
        return sorted(handed, key=canonical)

    def _delay_ns(self, key: str, message: Any, acting: Sequence[Fault]) -> int | None:
        """Return the delay of a message [ns]; NEVER if it is lost.

        If this process is the estimator of several drones, a sensor message is addressed to the estimator of the drone
        in its key. A radio fault affects messages of its drones to processes that are not on the same drone.
        """
        over_radio_ns = self._radio.delay_ns(key, message) if self._radio and isinstance(message, AgentMessage) else 0
        if over_radio_ns is None:
            return None
        sources, (kind, thing, _) = senders(key, message, self._roles), keys.parts(key)
        to = stock if keys.is_sensor(key) and (stock := f"estimator.{thing}") in self._names else self._names[0]

        aboard = drone_of(to, self._drones)

        def acts(fault: Fault) -> bool:
            if fault.kind != RADIO:
                return joins(fault, sources, to)
            drones = self._clusters.get(fault.target)
            return kind == "drone" and aboard != thing and (drones is None or thing in drones)

        def distance_m(fault: Fault) -> float | None:
            position_m = position_of(to, fault.parameters["place"], self._drones, self._positions.get)
            return distance_between(self._positions.get(thing), position_m)

        fault_delay_ns = total_delay_ns(filter(acts, acting), self._seed, to, key, message, distance_m)
        return None if fault_delay_ns is None else over_radio_ns + fault_delay_ns

    def snapshot(self) -> State:
        later = [[gate_ns, key, messages.encode(message)] for gate_ns, key, message in self._later]
        positions = {drone: list(position) for drone, position in self._positions.items()}
        return {
            "later": later,
            "positions": positions,
            "list": messages.encode(self._list) if self._list else None,
            "radio": self._radio.snapshot() if self._radio else None,
        }

    def restore(self, state: State) -> None:
        if state["list"]:
            self.update(messages.decode(keys.FAULTS, state["list"]))
        self._later = [(gate_ns, key, messages.decode(key, payload)) for gate_ns, key, payload in state["later"]]
        self._positions = state["positions"]
        if self._radio:
            self._radio.restore(state["radio"])


def total_delay_ns(
    faults: Iterable[Fault],  # those acting on the link
    seed: int,  # of the scenario
    link: str,  # name of the receiver, which selects the link's random stream
    key: str,
    message: Any,
    # returns the distance between sender and receiver for a radio fault [m]; None if unknown
    distance_m: Callable[[Fault], float | None] = lambda fault: None,
) -> int | None:
    """Return the total delay that several faults cause a message [ns]; NEVER if it is lost.

    Under a radio fault, a message sent over distance d arrives with probability 1 / (1 + exp((d - range) / spread)).
    """
    total_ns = 0
    for fault in faults:
        p, stream = fault.parameters, (fault.kind, fault.target, fault.from_ns, fault.rank)
        draw = uniform(seed, link, *stream, key, message.t_ns, message.seq)
        if fault.kind == "link_delay":
            total_ns += math.ceil(p["delay_ms"] * 1e6)
        elif fault.kind == "link_jitter":
            total_ns += math.ceil(draw * p["jitter_ms"] * 1e6)
        elif fault.kind == "link_loss":
            if draw < p["probability"]:
                return NEVER
        elif fault.kind == RADIO:
            d_m = distance_m(fault)
            if d_m is not None:
                exponent = min((d_m - p["range_m"]) / p["spread_m"], 700.0)  # exp(710) overflows
                if draw >= 1.0 / (1.0 + el.exp(exponent)):
                    return NEVER
        else:  # link_cut
            return NEVER
    return total_ns


def joins(fault: Fault, froms: Sequence[str], to: str) -> bool:
    """Return whether a fault affects the link from one of the senders `froms` to the receiver `to`."""
    first, _, second = fault.target.partition("/")
    if second == to and first in froms:
        return True
    return first == to and second in froms and not fault.parameters["one_way"]


def position_of(
    process: str, places: Mapping[str, Any], drones: Container[str], lookup: Callable[[str], Point | None]
) -> Point | None:
    """Return the position of a process [m; W]: that in `places`, otherwise that of its drone, otherwise the origin.

    In `places`, a drone's name stands for its position. `lookup` returns that of a drone [m; W], None if unknown.
    """
    position = places.get(process, drone_of(process, drones) or fault_kinds.ORIGIN)
    return lookup(position) if isinstance(position, str) else position


def distance_between(a: Point | None, b: Point | None) -> float | None:
    return el.distance(a, b) if a is not None and b is not None else None


def drone_of(process: str, drones: Container[str]) -> str | None:
    """Return the drone that carries a process; None for roles, users' included, without one process per drone."""
    role, _, thing = process.partition(".")
    about = ROLES[role].about if role in ROLES else "drone"
    return thing if about == "drone" and thing in drones else None


def senders(key: str, message: Any, roles: Mapping[str, str] = {}) -> tuple[str, ...]:
    """Return the names of the processes to treat as senders of a message.

    Agents that share a process, and thus its name, are named after the drone or cluster in the key.

    Args:
        roles: roles of users' agents, by the shape of their messages' keys.
    """
    if role := roles.get(messages.shape_of(key)):
        return (f"{role}.{keys.thing(key)}",)
    kind, owner, topic = keys.parts(key)
    source = getattr(message, "source", "")
    if kind == "drone" and topic.startswith("cmd/"):
        return (source,)
    if kind == "drone" and topic == "estimate":
        implied = f"estimator.{owner}"
    elif kind == "drone" and topic in ("reference", "request"):
        implied = f"reference.{owner}"
    elif kind == "cluster":
        implied = f"controller.{owner}"
    else:
        return (owner,) if kind == "process" else (WORLD,)
    is_shared = source.partition(".")[0] in ("estimator", "controller", "reference")
    return (implied,) if is_shared or not source else (implied, source)  # `source` may have replaced the agent


class Receiver:
    """Decides which messages of other agents reach one agent by radio, and when.

    Args:
        process: name of the receiver.
    """

    def __init__(self, info: Info, radio: Radio, process: str) -> None:
        self._seed, self._radio, self._process = info.seed, radio, process
        self._indices = {drone.name: index for index, drone in enumerate(info.drones)}
        self._index = self._index_of(process.partition(".")[2])
        self._lists: deque[RadioLinks] = deque(maxlen=LISTS_KEPT)

    def _index_of(self, thing: str) -> int | None:
        """Return the index of a drone or of the ground station; None if the agent is wired to all others."""
        station = None if self._radio.station_m is None else len(self._indices)
        return self._indices.get(thing, station)

    def take(self, links: RadioLinks) -> None:
        self._lists.append(links)

    def delay_ns(self, key: str, message: AgentMessage) -> int | None:
        """Return the delay of a message [ns]; NEVER if it is lost."""
        sender, radio = self._index_of(keys.thing(key)), self._radio
        if sender == self._index or sender is None or self._index is None:
            return 0
        links = next((each for each in reversed(self._lists) if each.t_ns <= message.t_ns), None)
        draw = (self._seed, self._process, key, message.t_ns, message.seq)
        if links is None or uniform("radio", *draw) >= (1.0 - radio.loss) * _reception(links, self._index, sender):
            return NEVER
        delay_ms = radio.delay_ms + (radio.jitter_ms * uniform("radio_jitter", *draw) if radio.jitter_ms else 0.0)
        return math.ceil(delay_ms * 1e6)

    def snapshot(self) -> State:
        return {"lists": [encode(each) for each in self._lists]}

    def restore(self, state: State) -> None:
        self._lists.clear()
        self._lists.extend(decode(keys.RADIO, payload) for payload in state["lists"])


def _reception(links: RadioLinks, receiver: int, sender: int) -> float:
    """Return the probability that a message arrives; 0 if the receiver cannot hear the sender."""
    hears = links.hears[receiver] if receiver < len(links.hears) else ()
    if sender not in hears:
        return 0.0
    chances = links.reception[receiver] if receiver < len(links.reception) else ()
    index = hears.index(sender)
    return chances[index] if index < len(chances) else 1.0


class Transmitter:
    """Sends an agent's messages one after another within the radio's bandwidth.

    A message whose transmission begins before the next gate is published at the current one. Others wait for a later
    gate and receive its stamp; if more than `queue_max` wait, the oldest are lost.
    """

    def __init__(self, radio: Radio, gate_ns: int) -> None:
        self._gate_ns, self._queue_max, self._header_bytes = gate_ns, radio.queue_max, radio.header_bytes
        self._ns_per_byte = 8e6 / radio.bandwidth_kbit_s if radio.bandwidth_kbit_s else 0.0
        self._waiting: deque[tuple[str, AgentMessage]] = deque()
        self._free_ns = 0  # time at which the last transmission ends

    def send(self, t_ns: int, outputs: Sequence[tuple[str, Any]]) -> list[tuple[str, Any]]:
        """Return the outputs to publish at a gate; only messages to other agents may have to wait."""
        if not self._ns_per_byte:
            return [*outputs]
        published = []
        for key, message in outputs:
            if isinstance(message, AgentMessage):
                self._waiting.append((key, message))
            else:
                published.append((key, message))
        while len(self._waiting) > self._queue_max:
            self._waiting.popleft()
        while self._waiting and self._free_ns < t_ns + self._gate_ns:
            key, message = self._waiting.popleft()
            self._free_ns = max(self._free_ns, t_ns) + math.ceil(self.size_bytes(message) * self._ns_per_byte)
            published.append((key, msgspec.structs.replace(message, t_ns=t_ns)))
        return published

    def size_bytes(self, message: AgentMessage) -> int:
        """Return the transmitted size of a message [bytes]: the header and the values of its fields in msgpack."""
        values = [getattr(message, name) for name in messages.fields(type(message)) if name not in ENVELOPE]
        return self._header_bytes + len(msgspec.msgpack.encode(values))

    def snapshot(self) -> State:
        return {"waiting": [[key, encode(message)] for key, message in self._waiting], "free_ns": self._free_ns}

    def restore(self, state: State) -> None:
        self._waiting = deque((key, decode(key, payload)) for key, payload in state["waiting"])
        self._free_ns = state["free_ns"]
