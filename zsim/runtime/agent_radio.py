"""The radio between the agents of drones: what a transmitter sends at a gate, and when it is received. Pure.

    agent ──messages──▶ Transmitter ──as many as its bandwidth lets out──▶ … ──▶ Receiver ──now, later, never──▶ agent

The world publishes the connectivity at every gate (`RadioLinks`). Loss and delay are drawn from the identity of the
message and its receiver, so neither the order of arrival nor a restart changes a draw.
"""

import math
from collections import deque
from collections.abc import Sequence
from typing import Any

import msgspec

from zsim.contract import keys, messages
from zsim.contract.agent_messages import AgentMessage
from zsim.contract.messages import Info, decode, encode
from zsim.contract.run_messages import RadioLinks
from zsim.contract.snapshot import State
from zsim.math.random_streams import uniform
from zsim.scenario.scenario import Radio

LISTS_KEPT = 50  # of links: a second of them, in realtime; in lockstep two are needed
NEVER = None  # as a delay: the message is lost
ENVELOPE = frozenset(AgentMessage.__struct_fields__)  # which a real radio would not carry


class Receiver:
    """Decides which messages of other agents reach one agent, and when.

    Args:
        process: name of the receiver.
    """

    def __init__(self, info: Info, radio: Radio, process: str) -> None:
        self._seed, self._radio, self._process = info.seed, radio, process
        self._places = {drone.name: place for place, drone in enumerate(info.drones)}
        self._place = self._place_of(process.partition(".")[2])
        self._lists: deque[RadioLinks] = deque(maxlen=LISTS_KEPT)

    def _place_of(self, thing: str) -> int | None:
        """Return the index of a drone or the ground station; None if the agent is wired to all."""
        station = None if self._radio.station_m is None else len(self._places)
        return self._places.get(thing, station)

    def take(self, links: RadioLinks) -> None:
        self._lists.append(links)

    def delay_ns(self, key: str, message: AgentMessage) -> int | None:
        """Return the delay of a message [ns]; NEVER if it is lost."""
        sender, radio = self._place_of(keys.thing(key)), self._radio
        if sender == self._place or sender is None or self._place is None:
            return 0
        links = next((each for each in reversed(self._lists) if each.t_ns <= message.t_ns), None)
        draw = (self._seed, self._process, key, message.t_ns, message.seq)
        if links is None or uniform("radio", *draw) >= (1.0 - radio.loss) * _reception(links, self._place, sender):
            return NEVER
        delay_ms = radio.delay_ms + (radio.jitter_ms * uniform("radio_jitter", *draw) if radio.jitter_ms else 0.0)
        return math.ceil(delay_ms * 1e6)

    def snapshot(self) -> State:
        return {"lists": [encode(each) for each in self._lists]}

    def restore(self, state: State) -> None:
        self._lists.clear()
        self._lists.extend(decode(keys.RADIO, payload) for payload in state["lists"])


def _reception(links: RadioLinks, receiver: int, sender: int) -> float:
    """Return the probability with which a message arrives, 0 where the receiver does not hear the sender."""
    hears = links.hears[receiver] if receiver < len(links.hears) else ()
    if sender not in hears:
        return 0.0
    chances = links.reception[receiver] if receiver < len(links.reception) else ()
    place = hears.index(sender)
    return chances[place] if place < len(chances) else 1.0


class Transmitter:
    """Sends the messages of an agent one after the other, within its bandwidth.

    A message whose transmission begins before the next gate is published at this one. Others wait for a later gate,
    whose stamp they get; beyond `queue_max` the oldest is lost.
    """

    def __init__(self, radio: Radio, gate_ns: int) -> None:
        self._gate_ns, self._queue_max, self._header_bytes = gate_ns, radio.queue_max, radio.header_bytes
        self._ns_per_byte = 8e6 / radio.bandwidth_kbit_s if radio.bandwidth_kbit_s else 0.0
        self._waiting: deque[tuple[str, AgentMessage]] = deque()
        self._free_ns = 0  # when the last message has been sent

    def send(self, t_ns: int, outputs: Sequence[tuple[str, Any]]) -> list[tuple[str, Any]]:
        """Return the outputs of an agent to publish at a gate; outputs other than messages do not wait."""
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
        """Return the transmitted size of a message [bytes]: a header, and the values of its fields in msgpack."""
        values = [getattr(message, name) for name in messages.fields(type(message)) if name not in ENVELOPE]
        return self._header_bytes + len(msgspec.msgpack.encode(values))

    def snapshot(self) -> State:
        return {"waiting": [[key, encode(message)] for key, message in self._waiting], "free_ns": self._free_ns}

    def restore(self, state: State) -> None:
        self._waiting = deque((key, decode(key, payload)) for key, payload in state["waiting"])
        self._free_ns = state["free_ns"]
