"""A world of a few drones that expects no process, and the events that it publishes."""

from typing import Any

from zsim.contract.run_messages import Event
from zsim.scenario.scenario_file import resolve
from zsim_world.run.coordinator import Coordinator
from zsim_world.run.world import World

GATE_NS = 20_000_000


def small_world(mode: str = "lockstep", drones: int = 1, processes: Any = None, **fields: Any) -> World:
    """Return the world of run `run1` with drones d1, d2, … 5 m apart; `processes` and `fields` go into the scenario."""
    placed = [{"name": f"d{k + 1}", "position_m": [5 * k, 0, 0]} for k in range(drones)]
    expecting = {"expect": [], **(processes or {})}
    return World(
        resolve({"name": "one", "duration_s": 1, "drones": placed, "processes": expecting, **fields}),
        mode,
        run_id="run1",
    )


def events_of(world: Coordinator, *kinds: str) -> list[Event]:
    """Empty the outbox; return its events, of all kinds unless some are given."""
    events = [message for _, message in world.take_outbox() if isinstance(message, Event)]
    return [event for event in events if not kinds or event.kind in kinds]
