"""Runs a world and its agents in one process on an in-memory bus.

The agents receive the same inputs in the same order as over Zenoh, so that the results are identical.
"""

import copy
import socket
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

from msgspec import Struct

from zsim.contract import keys, messages, run_messages
from zsim.contract.framing import GateMessages
from zsim.errors import RunError, UserCodeError
from zsim.runtime.agent import Agent, Output
from zsim.runtime.inbox import NEVER_NS, Inbox, RoutingTable, output_hold_ns
from zsim.runtime.membership import Membership
from zsim.scenario.faults import PROCESS_KILL

GATES_MAX = 10  # maximum number of gates that the world advances per turn; the command delay may limit it further


class SteppedWorld(Protocol):
    run_id: str

    @property
    def ended(self) -> str | None: ...
    def info(self) -> messages.Info: ...
    def handle(self, key: str, message: Any, wall_ns: int) -> None: ...
    def count_output(self, source: str) -> None: ...
    def may_advance(self) -> bool: ...
    def advance(self, wall_ns: int) -> None: ...
    def publish_end(self) -> None: ...
    def take_outbox(self) -> Sequence[tuple[str, Any]]: ...
    def waiting_for(self, wall_ns: int) -> Sequence[run_messages.Waiting]: ...


class _Route(NamedTuple):
    inboxes: tuple[Inbox, ...]  # inboxes of the agents that read the key
    is_counted: bool  # whether the world counts the key's messages as outputs of their sender
    is_relayed: bool  # whether the world only counts them


class Bus:
    """In-memory bus of one process; delivers every message to the sink, the world and the inboxes of its readers."""

    def __init__(
        self,
        coordinator: SteppedWorld,
        agents: Sequence[Agent],  # in the order in which they are stepped
        wall_ns: Callable[[], int],
        sink: Callable[[str, Any], None] = lambda key, message: None,  # receives every message in order of publication
        # receives the world's messages of each gate undecoded; if None, `sink` receives them decoded, one by one
        gate_sink: Callable[[GateMessages], None] | None = None,
    ) -> None:
        self._coordinator = coordinator
        self._wall_ns = wall_ns
        self._sink = sink
        self._gate_sink = gate_sink
        self._agents = [(agent, Inbox(agent.gate_keys, agent.counted, uncounted=agent.uncounted)) for agent in agents]
        self._readers = RoutingTable([agent.reads for agent in agents])
        self._routes: dict[str, _Route] = {}
        self._gate_route: tuple[Sequence[str], tuple[Inbox, ...]] = ((), ())  # a key table, and the readers of its keys
        host, run_id = socket.gethostname(), coordinator.run_id
        self._memberships = {
            agent.name: Membership(agent.name, host, run_id, agent.next_seq, agent.serves, agent.period_ns)
            for agent in agents
        }
        self._done_keys = {agent.name: keys.process(agent.name, "done") for agent in agents}
        self._t_ns = 0
        self._info: messages.Info | None = None
        self._failures: dict[str, UserCodeError] = {}  # by agent name, in order of failure

    def join(self) -> None:
        """Rehearse every agent and publish its join."""
        for agent, _ in self._agents:
            agent.rehearse()
            self._to_world(keys.process(agent.name, "join"), self._memberships[agent.name].join())
        if any(agent.overhears for agent, _ in self._agents):
            hold_ns = output_hold_ns(self._coordinator.info())
            for _, inbox in self._agents:
                inbox.hold_ns = hold_ns

    def turn(self, gates_max: int = GATES_MAX) -> bool:
        """Advance the world by up to `gates_max` gates, and step every agent; return whether the run continues.

        Stepping the world and each agent through several gates at a time keeps their code in the processor's caches.

        Raises:
            RunError: the world waits for a process that is not on this bus.
        """
        if not self._coordinator.may_advance():
            names = ", ".join(waiting.name for waiting in self._coordinator.waiting_for(self._wall_ns()))
            if self._coordinator.ended is None and names:
                raise RunError(f"the world waits for {names}, not run in-process; see `processes.expect`")
            return False
        gates = 0
        while gates < gates_max and self._coordinator.may_advance():
            self._coordinator.advance(self._wall_ns())
            gates += 1
        self._spread()
        while self._round():
            pass
        return True

    def _round(self) -> bool:
        """Step every agent through its complete gates and publish the outputs; return whether any agent stepped."""
        stepped = False
        for agent, inbox in self._agents:
            steps = []
            t_ns = inbox.next_gate_ns()
            while t_ns is not None and inbox.missing(t_ns) is None:
                self._t_ns = t_ns
                try:
                    outputs = agent.answer(t_ns, inbox.take(t_ns))
                except UserCodeError as failure:
                    self._failures[agent.name] = failure
                    break
                if outputs is not None:
                    steps.append((t_ns, outputs))
                t_ns = inbox.next_gate_ns()
            for t_ns, outputs in steps:
                self.publish(agent, t_ns, outputs)
            stepped = stepped or bool(steps)
            if agent.name in self._failures and inbox.taken_ns != NEVER_NS:
                inbox.start_after(NEVER_NS)  # a failed agent receives no further inputs
                self._leave(agent, str(self._failures[agent.name]), failed=True)
        return stepped

    def _leave(self, agent: Agent, reason: str, failed: bool = False) -> None:
        bye = self._memberships[agent.name].bye(self._t_ns, reason, failed)
        self._to_world(keys.process(agent.name, "bye"), bye)

    def snapshot(self) -> list[Inbox]:
        """Return copies of the agents' inboxes, for `restore`; must be called between turns."""
        return [copy.deepcopy(inbox) for _, inbox in self._agents]

    def restore(self, inboxes: Sequence[Inbox]) -> None:
        pairs = zip(self._agents, inboxes, strict=True)
        self._agents = [(agent, copy.deepcopy(inbox)) for (agent, _), inbox in pairs]
        self._routes, self._gate_route, self._failures = {}, ((), ()), {}

    def end(self) -> None:
        """Publish the world's last messages and the byes of the agents.

        Raises:
            UserCodeError: a user's class failed earlier; raised once everything is published.
        """
        self._coordinator.publish_end()
        self._spread()
        for agent, _ in self._agents:
            if agent.name not in self._failures:
                self._leave(agent, run_messages.RUN_ENDED)
        self._spread()
        for failure in self._failures.values():
            raise failure

    def _spread(self) -> None:
        for key, message in self._coordinator.take_outbox():
            if type(message) is GateMessages:
                if self._gate_sink is not None:
                    self._gate_sink(message)
                else:
                    for each_key, each in message.decoded():
                        self._sink(each_key, each)
                if message.table is not self._gate_route[0]:
                    readers = self._readers.readers_of_any(message.table)
                    self._gate_route = (message.table, tuple(self._agents[reader][1] for reader in readers))
                for inbox in self._gate_route[1]:
                    inbox.put(key, message)
                continue
            self._sink(key, message)
            if key == keys.FAULTS:
                self._update_faults(message)
            for inbox in self._route(key).inboxes:
                inbox.put(key, message)

    def _update_faults(self, faults: run_messages.Faults) -> None:
        if not faults.faults and self._info is None:
            return
        for fault in faults.faults:
            if fault.kind == PROCESS_KILL:
                raise RunError(
                    f"faults: {PROCESS_KILL} of {fault.target} needs separate processes, and this run has only one; "
                    f"leave it out, or fly with `zsim run` without --in-process"
                )
        info = self._info = self._info or self._coordinator.info()
        for agent, _ in self._agents:
            agent.update_faults(info, faults)

    def publish(self, agent: Agent, t_ns: int, outputs: Sequence[Output]) -> None:
        """Publish an agent's outputs of a gate and its done message."""
        sent, world, routes = 0, self._coordinator, self._routes
        for key, message in outputs:
            inboxes, is_counted, is_relayed = routes.get(key) or self._route(key)
            sent += is_counted
            for inbox in inboxes:
                inbox.put(key, message)
            self._sink(key, message)
            if is_relayed:
                world.count_output(agent.name)
            else:
                world.handle(key, message, self._wall_ns())
        done_key, done = self._done_keys[agent.name], self._memberships[agent.name].done(t_ns, sent)
        self._sink(done_key, done)
        world.handle(done_key, done, self._wall_ns())

    def _to_world(self, key: str, message: Struct) -> None:
        self._sink(key, message)
        self._coordinator.handle(key, message, self._wall_ns())

    def _route(self, key: str) -> _Route:
        route = self._routes.get(key)
        if route is None:
            inboxes = tuple(self._agents[reader][1] for reader in self._readers.readers(key))
            is_counted = messages.is_output(key)
            route = self._routes[key] = _Route(inboxes, is_counted, is_counted and not keys.is_command(key))
        return route
