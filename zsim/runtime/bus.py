"""Runs a world and its agents in one process on an in-memory bus.

The agents get the same inputs in the same order as on Zenoh, and so give the same bits.
"""

import os
import socket
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, Protocol

from msgspec import Struct

from zsim import __version__
from zsim.contract import batch, keys, messages
from zsim.contract.bundle import Bundle, Selection
from zsim.contract.fingerprint import fingerprint
from zsim.errors import RunError
from zsim.runtime.agent import Agent, Output
from zsim.runtime.inbox import Inbox
from zsim.scenario.fault_kinds import PROCESS_KILL

GATES_MAX = 10  # of the world in a row, where commands are delayed by as many


class Hub(Protocol):
    """What the bus needs of a world."""

    run_id: str

    def info(self) -> messages.Info:
        """Return the message of `world/info`."""
        ...

    def handle(self, key: str, message: Any, wall_ns: int) -> None:
        """Take what a process says to the world: join, done, bye, a command."""
        ...

    def count_output(self, source: str) -> None:
        """Count an output that is for others."""
        ...

    def may_advance(self) -> bool:
        """Tell whether all are done whose answers the next gate needs."""
        ...

    def advance(self, wall_ns: int) -> None:
        """Go to the next gate and put its messages into the outbox."""
        ...

    def publish_end(self) -> None:
        """Put the end of the run into the outbox: event `end`, clock `stopped`."""
        ...

    def take_outbox(self) -> Sequence[tuple[str, Any]]:
        """Return keys and messages to be published, in order, and forget them; on batch.GATE a Bundle of many."""
        ...

    def waiting_for(self, wall_ns: int) -> Sequence[messages.Waiting]:
        """Return whom the world waits for."""
        ...

    @property
    def ended(self) -> str | None:
        """Return why the run is over, None while it goes on."""
        ...


Sink = Callable[[str, Any], None]
OUTPUT, COMMAND = range(2)  # what an agent says: for whoever reads it, for the world


class _Way(NamedTuple):
    """Where the messages of a key go."""

    inboxes: tuple[Inbox, ...]
    kind: int


class Bus:
    """The keys of one process: every message goes to the sink, the world and the inboxes that read it.

    Args:
        hub: the world.
        agents: in the order in which they are asked.
        wall_ns: monotonic wall time.
        sink: takes every message in order of publication.
        whole: takes what the world says at a gate in place of the sink, which then need not be given objects of it.
    """

    def __init__(
        self,
        hub: Hub,
        agents: Sequence[Agent],
        wall_ns: Callable[[], int],
        sink: Sink = lambda key, message: None,
        whole: Callable[[Bundle], None] | None = None,
    ) -> None:
        self._hub = hub
        self._wall_ns = wall_ns
        self._sink = sink
        self._whole = whole
        self._agents = [(agent, Inbox(agent.gate_keys, agent.counted)) for agent in agents]
        self._selections = [Selection(agent.reads) for agent in agents]
        self._ways: dict[str, _Way] = {}
        self._done_keys = {agent.name: keys.process(agent.name, "done") for agent in agents}
        self._t_ns = 0
        self._info: messages.Info | None = None

    def join(self) -> None:
        """Let every agent make ready and join the run."""
        for agent, _ in self._agents:
            agent.rehearse()
            join = messages.Join(
                t_ns=0,
                seq=agent.next_seq("join"),
                run_id=self._hub.run_id,
                incarnation=0,
                role=agent.role,
                host=socket.gethostname(),
                pid=os.getpid(),
                period_ns=agent.period_ns,
                version=__version__,
                fingerprint=fingerprint(),
                serves=agent.serves,
            )
            self._to_hub(keys.process(agent.name, "join"), join)

    def turn(self) -> bool:
        """Let the world go as far as it may, and every agent answer; return whether the run goes on.

        Several gates in a row of the world, of each agent, and of what they say, keep the code of each in the
        processor's caches.

        Raises:
            RunError: the world waits for somebody who is not on this bus.
        """
        if not self._hub.may_advance():
            self._refuse_to_wait()
            return False
        gates = 0
        while gates < GATES_MAX and self._hub.may_advance():
            self._hub.advance(self._wall_ns())
            gates += 1
        self._spread()
        while self._round():
            pass
        return True

    def _refuse_to_wait(self) -> None:
        names = ", ".join(waiting.name for waiting in self._hub.waiting_for(self._wall_ns()))
        if self._hub.ended is None and names:
            raise RunError(f"the world waits for {names}, not run in-process; see `processes.expect`")

    def _round(self) -> bool:
        """Let every agent take all its complete gates, then publish what it says; return whether any had one."""
        stepped = False
        for agent, inbox in self._agents:
            said = list(self._steps(agent, inbox))
            for t_ns, outputs in said:
                self._publish(agent, t_ns, outputs)
            stepped = stepped or bool(said)
        return stepped

    def end(self) -> None:
        """Let every agent leave, and the world say its last words."""
        self._hub.publish_end()
        self._spread()
        for agent, _ in self._agents:
            bye = messages.Bye(self._t_ns, agent.next_seq("bye"), "the run ended")
            self._to_hub(keys.process(agent.name, "bye"), bye)
        self._spread()

    def _spread(self) -> None:
        for key, message in self._hub.take_outbox():
            if key == batch.GATE:
                self._hand_out(message)
                continue
            self._sink(key, message)
            if key == keys.FAULTS:
                self._tell_faults(message)
            for inbox in self._way(key).inboxes:
                inbox.put(key, message)

    def _tell_faults(self, faults: messages.Faults) -> None:
        if not faults.faults and self._info is None:
            return
        for fault in faults.faults:
            if fault.kind == PROCESS_KILL:
                raise RunError(
                    f"{PROCESS_KILL} of {fault.target}: must be left out in-process, where nobody is a process"
                )
        info = self._info = self._info or self._hub.info()
        for agent, _ in self._agents:
            agent.heed(info, faults)

    def _hand_out(self, bundle: Bundle) -> None:
        if self._whole:
            self._whole(bundle)
        else:
            for each in bundle.messages():
                self._sink(*each)
        for (agent, inbox), selection in zip(self._agents, self._selections, strict=True):
            for key, message in [(batch.GATE, bundle)] if agent.takes_bundles else selection.of(bundle):
                inbox.put(key, message)

    def _steps(self, agent: Agent, inbox: Inbox) -> Iterator[tuple[int, Sequence[Output]]]:
        """Hand an agent each complete gate; yield those at which it steps, with what it says."""
        t_ns = inbox.next_gate_ns()
        while t_ns is not None and inbox.missing(t_ns) is None:
            self._t_ns = t_ns
            agent.hear(t_ns, inbox.take(t_ns))
            if t_ns % agent.period_ns == 0:
                yield t_ns, agent.step(t_ns)
            t_ns = inbox.next_gate_ns()

    def _publish(self, agent: Agent, t_ns: int, outputs: Sequence[Output]) -> None:
        sent = 0
        for key, message in outputs:
            inboxes, kind = self._way(key)
            sent += 1
            for inbox in inboxes:
                inbox.put(key, message)
            if kind == OUTPUT:
                self._sink(key, message)
                self._hub.count_output(agent.name)
            else:
                self._to_hub(key, message)
        done = messages.Done(t_ns, agent.next_seq("done"), self._hub.run_id, 0, t_ns, sent)
        self._to_hub(self._done_keys[agent.name], done)

    def _to_hub(self, key: str, message: Struct) -> None:
        self._sink(key, message)
        self._hub.handle(key, message, self._wall_ns())

    def _way(self, key: str) -> _Way:
        way = self._ways.get(key)
        if way is None:
            readers = zip(self._agents, self._selections, strict=True)
            inboxes = tuple(inbox for (_, inbox), taken in readers if taken.takes(key))
            kind = OUTPUT if key.endswith(("/estimate", "/state", "/request")) else COMMAND
            way = self._ways[key] = _Way(inboxes, kind)
        return way
