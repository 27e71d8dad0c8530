"""A flight in this process: world, agents and observers on an in-memory bus, without Zenoh."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

from msgspec import Struct
from msgspec.structs import replace

from zsim.contract import flight_messages, keys, messages, run_messages
from zsim.contract.framing import GateMessages
from zsim.contract.messages import Info
from zsim.contract.run_messages import ControlAnswer, ControlRequest
from zsim.contract.snapshot import State, pack, restore, unpack
from zsim.errors import RunError, UserCodeError
from zsim.record import RecordWriter
from zsim.runtime.agent import Agent, Output
from zsim.runtime.bus import Bus
from zsim.runtime.membership import rare_collections
from zsim.runtime.progress import PERIOD_S, HoldReasons, ProgressSink, SlowStart
from zsim.runtime.rate_limit import RateLimit
from zsim.scenario.roles import agent_names, check_alone, expected_processes, lets_drop
from zsim.scenario.scenario import Scenario
from zsim.schema.checker import show
from zsim_agents.hosting import hosted, own_agent, with_own_agents
from zsim_world.run.world import World

CALLER = "python.main"  # process name of the participant that steps a flight
OwnAgent = Agent | Callable[..., Agent]


def fly(
    scenario: Scenario,
    record: Path | None,
    stop_reason: Callable[[], str | None] = lambda: None,
    screen: ProgressSink | None = None,
    run_id: str | None = None,
    changed: Sequence[str] | None = None,
    own: Sequence[OwnAgent] = (),
) -> str:
    """Fly a resolved scenario and record it; return why it ended.

    Args:
        scenario: the resolved scenario.
        record: path of the record; None: no record.
        stop_reason: called at every gate; if it returns a text, the run ends.
        screen: shows progress.
        run_id: set only by tests that compare records.
        changed: as in `World`.
        own: as in `InProcessFlight`.

    Raises:
        RunError: a user's class failed or the state of a drone was no longer finite, which ended the run; the record
            is complete up to then.
    """
    progress = _Progress(scenario, screen) if screen else None
    writer = None
    try:
        flight = InProcessFlight(scenario, run_id, changed, own)
        writer = RecordWriter(record) if record else None  # last, so that a refused scenario leaves no record
        flight.run([each for each in (writer, progress) if each], stop_reason)
    finally:
        for each in (progress, writer):
            if each:
                each.close()
    if flight.world.failure:
        raise flight.world.failure
    return flight.world.ended or "ended"


def with_agents(scenario: Scenario, own: Sequence[OwnAgent]) -> tuple[Scenario, list[Agent]]:
    """Return a scenario whose run waits for a user's agents and ends if one fails, and these agents.

    Raises:
        RunError: `own` is not a sequence, or one of its elements is not an agent.
        UserCodeError: an agent's class raised an error.
    """
    if not sequence_of_agents(own):
        return scenario, []
    info = World(scenario).info()
    agents = [own_agent(each, info, scenario) for each in own]
    return with_own_agents(scenario, [agent.name for agent in agents]), agents


def sequence_of_agents(agents: Any, options: str = "") -> Sequence[Any]:
    """Return the given agents; raise RunError, which names `options` as also allowed, if they are not a sequence."""
    if isinstance(agents, str) or not isinstance(agents, Sequence):
        raise RunError(f"agents is {show(agents)}; must be {options}a sequence of agents")
    return agents


class FlightObserver(Protocol):
    """Receives the messages of a flight, like a record writer."""

    def add_message(self, key: str, message: Any, wall_ns: int) -> None: ...

    def add_gate(self, gate: GateMessages, wall_ns: int) -> None: ...


class InProcessFlight:
    """A world with its agents on a bus, flown to its end (`run`) or turn by turn (`start`, `turn`, `end`).

    Args:
        scenario: the resolved scenario.
        run_id, changed: as in `fly`.
        own: a user's agents, in addition to the scenario's: objects, or whatever `own_agent` accepts.
        stock: whether the estimators and controllers of the scenario take part.
        steered: whether `send` is used, so that the caller takes part as `python.main`.

    Raises:
        ScenarioError, RunError: the scenario cannot be flown.
        UserCodeError: an agent's class raised an error.
    """

    def __init__(
        self,
        scenario: Scenario,
        run_id: str | None = None,
        changed: Sequence[str] | None = None,
        own: Sequence[OwnAgent] = (),
        stock: bool = True,
        steered: bool = False,
    ) -> None:
        check_alone(scenario)
        if not stock:
            scenario = replace(scenario, processes=replace(scenario.processes, expect=[]))
        self.world = World(scenario, "lockstep", 0.0, time.monotonic_ns, run_id, changed)
        self.info = self.world.info()
        own_agents = [own_agent(each, self.info, scenario) for each in own]
        occupied_names = {name for agent in own_agents for name in (agent.name, *agent.serves)}
        stock_names, expected = agent_names(scenario), expected_processes(scenario)
        for name in set(expected) - set(stock_names) - occupied_names:
            if lets_drop(scenario.processes.on_overdue or {}, name):
                self.world.expired(name)  # no other process can join
        names = [name for name in expected if name in stock_names and name not in occupied_names]
        self.agents = [*own_agents]
        if names:
            self.agents.insert(0, hosted(self.info, scenario, names))
        self._caller = Caller(self.info) if steered else None
        if self._caller:
            self.agents.append(self._caller)

    def run(self, observers: Sequence[FlightObserver], stop_reason: Callable[[], str | None] = lambda: None) -> None:
        """Fly to the end; observers receive every message; `world.ended` or `world.failure` then gives the reason."""
        self.start(observers)
        try:
            with rare_collections():
                while self.turn():
                    if reason := stop_reason():
                        self.world.clock.stop(reason)
                self.end()
        except UserCodeError:
            if self.world.failure:  # otherwise the scenario lets the run go on without the failed agent
                raise

    def start(self, observers: Sequence[FlightObserver]) -> None:
        """Let the agents join."""
        takes_message = [observer.add_message for observer in observers]
        takes_gate = [observer.add_gate for observer in observers]

        def add_message(key: str, message: Any) -> None:
            wall_ns = time.time_ns()
            for take in takes_message:
                take(key, message, wall_ns)

        def add_gate(gate: GateMessages) -> None:
            wall_ns = time.time_ns()
            for take in takes_gate:
                take(gate, wall_ns)

        self.bus = Bus(self.world, self.agents, time.monotonic_ns, add_message, add_gate)
        self.turn, self.end = self.bus.turn, self.bus.end
        add_message(keys.INFO, self.info)
        self.bus.join()

    def send(self, commands: Sequence[tuple[str, Struct]]) -> None:
        """Publish the caller's commands for the newest gate, as pairs of drone and command; the world waits for them.

        Raises:
            RunError: one of them is not a command; nothing is sent.
        """
        caller, t_ns = self._caller, self.world.now_ns
        assert caller is not None
        for command in commands:
            messages.command_key(*command)
        self.bus.publish(caller, t_ns, [caller.command(t_ns, *command) for command in commands])

    def control(self, key: str, request: ControlRequest) -> ControlAnswer:
        """Answer a request to the world, a controller or a pilot, between two gates."""
        if key == keys.CONTROL:
            return self.world.control(request)
        for agent in self.agents:
            if key in agent.control_keys():
                return agent.control(key, request)
        control_keys = [keys.CONTROL, *(each for agent in self.agents for each in agent.control_keys())]
        return ControlAnswer(False, f"{key}: no process answers on it; must be one of {', '.join(control_keys)}")

    def snapshot(self) -> tuple[Any, ...]:
        """Return the state from which `restore` continues bit-identically.

        Raises:
            RunError: a user's agent has no `snapshot`.
        """
        states = [agent.checkpoint() for agent in self.agents]
        for agent, state in zip(self.agents, states, strict=True):
            if state is None:
                raise RunError(f"{agent.name} has no snapshot(); must return its state, or {{}} if it has none")
        world, agents = pack(self.world.checkpoint()), [pack(state) for state in states if state is not None]
        return world, agents, self.bus.snapshot(), self.world.truth_hash.snapshot()

    def restore(self, snapshot: tuple[Any, ...]) -> None:
        """Continue from a snapshot of this flight, or of another one of the same scenario."""
        world, agents, inboxes, truth_hash = snapshot
        restore(self.world, unpack(world))
        clock = self.world.clock  # the snapshot is of a flight that was not over
        clock.ended, clock.is_complete, self.world.failure = None, False, None
        self.world.truth_hash.restore(truth_hash)
        for agent, state in zip(self.agents, agents, strict=True):
            agent.resume(self.info, unpack(state))
        self.bus.restore(inboxes)


class Caller(Agent):
    """Takes part on behalf of the caller that steps a flight; `InProcessFlight.send` publishes its commands."""

    name, reads, gate_keys = CALLER, (), ()

    def __init__(self, info: Info) -> None:
        super().__init__()
        self.period_ns = info.gate_ns

    def receive(self, key: str, message: Any) -> None:
        """Ignore messages; the caller reads the flight's state itself."""

    def step(self, t_ns: int) -> list[Output]:
        return []

    def snapshot(self) -> State:
        return {}


class _Progress:
    """Shows clock, events and the controllers' reasons on a screen."""

    def __init__(self, scenario: Scenario, screen: ProgressSink) -> None:
        self._screen = screen
        self._throttle = RateLimit(PERIOD_S)
        self._reasons = HoldReasons()
        states = (keys.cluster_state(cluster.name) for cluster in scenario.clusters)
        self._watched = {keys.CLOCK, keys.EVENT, *states}
        self._phase = ""
        self._clock: run_messages.Clock | None = None  # the newest clock message, unless already shown
        self._start = SlowStart(screen.say)

    def close(self) -> None:
        self._start.over()
        self._show_clock()

    def add_gate(self, gate: GateMessages, wall_ns: int) -> None:
        """Show nothing, as a gate has only truth, status and sensor messages."""

    def add_message(self, key: str, message: Any, wall_ns: int) -> None:
        if key not in self._watched:
            return
        if isinstance(message, flight_messages.ClusterState):
            self._phase = message.phase
            if line := self._reasons.line(keys.thing(key), message):
                self._screen.say(line)
        elif isinstance(message, run_messages.Event):
            self._screen.event({"t_s": message.t_ns / 1e9, "kind": message.kind, "text": message.text})
        elif isinstance(message, run_messages.Clock):
            self._clock = message
            if self._throttle.spend():
                self._start.over()
                self._show_clock()

    def _show_clock(self) -> None:
        if (clock := self._clock) is not None:
            line = {"t_s": clock.t_ns / 1e9, "rate": clock.rate, "state": clock.state, "phase": self._phase}
            self._screen.clock({**line, "waiting_for": []})
            self._clock = None
