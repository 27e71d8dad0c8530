"""What the world publishes: encoded, kept in the history, put in one go, and handed to recorders with what passed."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

from zsim.contract import keys, messages
from zsim.contract.framing import BATCH_MAX, GateMessages, Pairs, encode_batch
from zsim.runtime.agent import Output
from zsim.transport.session import ReceivedSample, Session
from zsim_world.run.coordinator import Coordinator
from zsim_world.run.message_history import MessageHistory
from zsim_world.server.journal_entries import Kept
from zsim_world.server.run_journal import RunJournal


class WorldOutputs:
    """Publishes the outbox of a world on its link.

    Args:
        link: the listening session.
        world: whose outbox it is.
        history: keeps what is published.
        on_message: called with every key and message beside those of drones.
        journal: is written before anything is published.
    """

    def __init__(
        self,
        link: Session,
        world: Coordinator,
        history: MessageHistory,
        on_message: Callable[[str, Any], None],
        journal: RunJournal,
    ) -> None:
        self._journal = journal
        self._link = link
        self._world = world
        self._history = history
        self._on_message = on_message
        self._unsent: Pairs = []
        self._passed: Pairs = []
        self._gate_keys = [keys.gate(name) for name in world.names]

    def flush(self) -> None:
        """Publish the outbox."""
        self.gather()
        self.send()

    def gather(self) -> None:
        """Encode the outbox and keep it."""
        outbox = self._world.take_outbox()
        if not outbox:
            return
        encoded: Pairs = []
        for key, message in outbox:
            if type(message) is GateMessages:
                self._gather_gate(message)
                encoded += message.pairs
            else:
                pair = (key, messages.encode(message))
                if keys.is_picture(key):  # of a replay: whoever wants pictures reads their keys
                    self._unsent.append(pair)
                    continue
                encoded.append(pair)
                self._passed.append(pair)
        self._unsent += encoded
        self._history.add_all(encoded, self._world.now_ns)
        for key, message in outbox:
            if type(message) is not GateMessages:
                self._on_message(key, message)

    def _gather_gate(self, gate: GateMessages) -> None:
        """Keep the messages of a gate as one, of all drones and of each, where there is a subscriber to that."""
        whole = (keys.GATE, gate.pack())
        self._passed.append(whole)
        if self._link.has_subscribers(keys.GATE):
            self._unsent.append(whole)
        for key, (first, last) in zip(self._gate_keys, pairwise(gate.first), strict=True):
            if last > first and self._link.has_subscribers(key):
                self._unsent.append((key, gate.pack(first, last)))

    def send(self) -> None:
        """Put what was gathered in one go: readers wake once, and the transport sends few packets."""
        self._journal.commit()
        unsent, self._unsent = self._unsent, []
        self._link.put_all(unsent)
        self.put_batch()

    def publish(self, output: Output) -> None:
        """Publish one message beside the outbox."""
        payload = messages.encode(output.message)
        self._passed.append((output.key, payload))
        self._history.add(output.key, payload, self._world.now_ns)
        self._journal.note(Kept(output.key, payload))
        self._journal.commit()
        self._link.put_raw(output.key, payload)
        self.put_batch()

    def forget(self) -> None:
        """Publish nothing of what was gathered: an incarnation of the world before has."""
        self._unsent, self._passed = [], []

    def passed(self, sample: ReceivedSample) -> None:
        """Note a message that a participant or anyone else has published."""
        self._passed.append(sample)

    def put_batch(self) -> None:
        """Hand what has passed to the recorders, if there are any."""
        passed, self._passed = self._passed, []
        if self._link.has_subscribers(keys.BATCH):
            for first in range(0, len(passed), BATCH_MAX):
                self._link.put_raw(keys.BATCH, encode_batch(passed[first : first + BATCH_MAX]))
