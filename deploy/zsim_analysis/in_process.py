"""A flight in this process: world, agents and observers on an in-memory bus, without Zenoh."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

from zsim.contract import flight_messages, keys, run_messages
from zsim.contract.framing import GateMessages
from zsim.errors import RunError, UserCodeError
from zsim.record import RecordWriter
from zsim.runtime.agent import Agent
from zsim.runtime.bus import Bus
from zsim.runtime.health import rare_collections
from zsim.runtime.progress import PERIOD_S, HoldReasons, Screen, SlowStart
from zsim.runtime.rate_limit import RateLimit
from zsim.scenario.roles import agent_names, expected_processes, lets_drop
from zsim.scenario.scenario import Scenario
from zsim_agents.hosting import hosted
from zsim_world.run.world import World


def fly(
    scenario: Scenario,
    record: Path | None,
    stop_reason: Callable[[], str | None] = lambda: None,
    screen: Screen | None = None,
    run_id: str | None = None,
    changed: Sequence[str] | None = None,
) -> str:
    """Fly a resolved scenario and record it; return why it ended.

    Args:
        record: path of the record, None for no record.
        stop_reason: called at every gate; a text ends the run.
        screen: shows progress.
        run_id: set only by tests that compare records.
        changed: as of `World`.

    Raises:
        RunError: a failure has ended the run, of a user's class, or because the state of a drone was no longer finite;
            the record is complete to its end.
    """
    progress = _Progress(scenario, screen) if screen else None
    writer = None
    try:
        flight = InProcessFlight(scenario, run_id, changed)
        writer = RecordWriter(record) if record else None  # after it: a refused scenario leaves no record in the way
        flight.run([each for each in (writer, progress) if each], stop_reason)
    finally:
        for each in (progress, writer):
            if each:
                each.close()
    if flight.world.failure:
        raise flight.world.failure
    return flight.world.ended or "ended"


class FlightObserver(Protocol):
    """Receives messages of a flight, as a record writer does."""

    def add_message(self, key: str, message: Any, wall_ns: int) -> None: ...

    def add_gate(self, gate: GateMessages, wall_ns: int) -> None: ...


class InProcessFlight:
    """A world with its agents, ready to be flown once; arguments as of `fly`.

    Raises:
        ScenarioError, RunError: the scenario cannot be flown.
    """

    def __init__(self, scenario: Scenario, run_id: str | None = None, changed: Sequence[str] | None = None) -> None:
        if scenario.gates("camera"):
            raise RunError(
                "processes.gating is [camera]; must be left out in one process, which has no cameras: "
                "fly it as processes, or with --set processes.gating=[]"
            )
        self.world = World(scenario, "lockstep", 0.0, time.monotonic_ns, run_id, changed)
        for name in set(expected_processes(scenario)) - set(agent_names(scenario)):
            if lets_drop(scenario.processes.on_overdue or {}, name):
                self.world.expired(name)  # no other process can join
        self._agents = agents(self.world)

    def run(self, observers: Sequence[FlightObserver], stop_reason: Callable[[], str | None] = lambda: None) -> None:
        """Fly to the end; observers receive every message; `world.ended` and `world.failure` then have the reason."""
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

        bus = Bus(self.world, self._agents, time.monotonic_ns, add_message, add_gate)
        add_message(keys.INFO, self.world.info())
        bus.join()
        try:
            with rare_collections():
                while bus.turn():
                    if reason := stop_reason():
                        self.world.clock.stop(reason)
                bus.end()
        except UserCodeError:
            if self.world.failure:  # otherwise the run goes on without the failed agent, as the scenario says
                raise


def agents(world: World) -> list[Agent]:
    """Return the agents expected by a scenario as one, built from `world/info` as by any process."""
    known = agent_names(world.scenario)
    names = [name for name in expected_processes(world.scenario) if name in known]
    return [hosted(world.info(), world.scenario, names)] if names else []


class _Progress:
    """Shows clock, events and the controllers' reasons on a screen."""

    def __init__(self, scenario: Scenario, screen: Screen) -> None:
        self._screen = screen
        self._throttle = RateLimit(PERIOD_S)
        self._reasons = HoldReasons()
        states = (keys.cluster_state(cluster.name) for cluster in scenario.clusters)
        self._watched = {keys.CLOCK, keys.EVENT, *states}
        self._phase = ""
        self._start = SlowStart(screen.say)

    def close(self) -> None:
        self._start.over()

    def add_gate(self, gate: GateMessages, wall_ns: int) -> None:
        """Show nothing: it holds truth, status and sensors only."""

    def add_message(self, key: str, message: Any, wall_ns: int) -> None:
        if key not in self._watched:
            return
        if isinstance(message, flight_messages.ClusterState):
            self._phase = message.phase
            if line := self._reasons.line(keys.thing(key), message):
                self._screen.say(line)
        elif isinstance(message, run_messages.Event):
            self._screen.event({"t_s": message.t_ns / 1e9, "kind": message.kind, "text": message.text})
        elif isinstance(message, run_messages.Clock) and self._throttle.spend():
            self._start.over()
            line = {"t_s": message.t_ns / 1e9, "rate": message.rate, "state": message.state, "phase": self._phase}
            self._screen.clock({**line, "waiting_for": []})
