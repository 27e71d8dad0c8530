"""What the world publishes: encoded, kept in the history, sent in one go, and passed on to recorders."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

from zsim.contract import keys, messages
from zsim.contract.framing import BATCH_MAX, GateMessages, Pairs, encode_batch
from zsim.runtime.agent import Output
from zsim.transport.session import Session
from zsim_world.run.inputs import Published, Run
from zsim_world.server.run_journal import RunJournal


class WorldOutputs:
    """Publishes the outbox of a world on its link.

    Args:
        on_message: called with every key and message beside those of drones.
        journal: is written before anything is published.
    """

    def __init__(self, link: Session, run: Run, on_message: Callable[[str, Any], None], journal: RunJournal) -> None:
        self._link = link
        self._run = run
        self._on_message = on_message
        self._journal = journal
        self._unsent: Pairs = []
        self._gate_keys = [keys.gate(name) for name in run.world.names]

    def gather(self) -> None:
        """Encode the outbox and keep it: the messages of a gate as one, as one of each drone that is read, and each."""
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
                if keys.is_picture(key):  # of a replay: whoever wants pictures reads their keys
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
        """Put what was gathered in one go: readers wake once, and the transport sends few packets."""
        self._journal.commit()
        unsent, self._unsent = self._unsent, []
        self._link.put_all(unsent)
        self.put_batch()

    def flush(self) -> None:
        self.gather()
        self.send()

    def publish(self, output: Output) -> None:
        """Publish one message beside the outbox."""
        message: Any = output.message
        payload = messages.encode(message)
        self._run.enter(Published(output.key, message.seq, payload))
        self._journal.commit()
        self._link.put_raw(output.key, payload)
        self.put_batch()
        self._on_message(output.key, message)

    def put_batch(self) -> None:
        """Send the recorders, if there are any, all messages since the last time."""
        history = self._run.history
        passed, history.passed = history.passed, []
        if self._link.has_subscribers(keys.BATCH):
            for first in range(0, len(passed), BATCH_MAX):
                self._link.put_raw(keys.BATCH, encode_batch(passed[first : first + BATCH_MAX]))

    def forget(self) -> None:
        """Drop what was gathered: the former process of the world has published it."""
        self._unsent, self._run.history.passed = [], []
