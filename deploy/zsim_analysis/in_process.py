"""`zsim run --in-process`: world, agents and record in one process on an in-memory bus."""

import gc
import time
from collections.abc import Callable
from pathlib import Path
from time import time_ns
from typing import Any

from msgspec import Struct

from zsim.contract import keys, messages
from zsim.contract.framing import GateMessages
from zsim.record import RecordWriter
from zsim.runtime.agent import Agent
from zsim.runtime.bus import Bus
from zsim.runtime.progress import HoldReasons, Screen, Throttle
from zsim.scenario.scenario import Scenario
from zsim_agents.hosting import hosted
from zsim_world.flight.world import World


def agents(world: World) -> list[Agent]:
    """Return the agents that a scenario expects as one, built from `world/info` as any process would."""
    roles = ("estimator.", "controller.")
    names = [name for name in world.scenario.expected() if name.startswith(roles)]
    return [hosted(world.info(), world.scenario, names)] if names else []


def fly(
    scenario: Scenario,
    record: Path | None,
    stopped: Callable[[], str | None] = lambda: None,
    screen: Screen | None = None,
    run_id: str | None = None,
) -> str:
    """Fly a scenario and record it; return why it ended.

    Args:
        scenario: resolved.
        record: path of the record, None for no record.
        stopped: asked at every gate; a text ends the run.
        screen: shows progress.
        run_id: given only by tests that compare records.

    Raises:
        DivergedError: the state of a drone was no longer finite; the record is complete to its end.
    """
    world = World(scenario, "lockstep", 0.0, time.monotonic_ns, run_id)
    team = agents(world)  # may refuse the scenario; a record that was begun could not be begun again
    writer = RecordWriter(record) if record else None
    show = _Show(world, writer, screen)
    bus = Bus(world, team, time.monotonic_ns, show.sink, show.gate_sink)
    try:
        show.sink(keys.INFO, world.info())
        bus.join()
        gc.collect()
        gc.freeze()
        while bus.turn():
            reason = stopped()
            if reason:
                world.stop(reason)
        bus.end()
    finally:
        if writer:
            writer.close()
    if world.diverged:
        raise world.diverged
    return world.ended or "ended"


class _Show:
    """Takes every message: into the record, and now and then onto the screen."""

    def __init__(self, world: World, writer: RecordWriter | None, screen: Screen | None) -> None:
        self._world = world
        self._add = writer.add_message if writer else None
        self._add_gate = writer.add_gate if writer else None
        self._screen = screen
        self._throttle = Throttle()
        self._reasons = HoldReasons()
        states = (keys.cluster_state(cluster.name) for cluster in world.scenario.clusters)
        self._watched = {keys.CLOCK, keys.EVENT, *states}
        self._phase = ""

    def gate_sink(self, gate: GateMessages) -> None:
        if self._add_gate is not None:
            self._add_gate(gate, time_ns())

    def sink(self, key: str, message: Any) -> None:
        if self._add is not None:
            self._add(key, message, time_ns())
        if self._screen is not None and key in self._watched:
            self._show(key, message, self._screen)

    def _show(self, key: str, message: Struct, screen: Screen) -> None:
        if isinstance(message, messages.ClusterState):
            self._phase = message.phase
            if line := self._reasons.line(keys.thing(key), message):
                screen.say(line)
        elif isinstance(message, messages.Event):
            screen.event({"t_s": message.t_ns / 1e9, "kind": message.kind, "text": message.text})
        elif isinstance(message, messages.Clock) and self._throttle.passes():
            line = {
                "t_s": message.t_ns / 1e9,
                "rate": message.rate,
                "state": message.state,
                "phase": self._phase,
            }
            screen.clock({**line, "waiting_for": []})
