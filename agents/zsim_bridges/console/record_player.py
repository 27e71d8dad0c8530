"""The record that a replay plays: how far it goes, and what the page may do with its time."""

from typing import Any

from zsim_bridges.console.command_client import CommandClient
from zsim_bridges.console.monitoring.run_condition import RunCondition, run_refusals
from zsim_bridges.console.monitoring.time_monitor import TimeMonitor


class RecordPlayer:
    """Steers a replay.

    Args:
        client: sends requests.
        time_monitor: of the run's clock.
        is_replay: whether the run is one; a flight has no timeline, and is not steered from here.

    Attributes:
        timeline: from_s, to_s [s] and marks (t_s, kind, text); empty of a flight, and before `load`.
    """

    def __init__(self, client: CommandClient, time_monitor: TimeMonitor, is_replay: bool) -> None:
        self._client = client
        self._time_monitor = time_monitor
        self._is_replay = is_replay
        self.timeline: dict[str, Any] = {}

    def load(self) -> None:
        """Request the timeline; where the replay stands, what it played last too, before anybody subscribed to it."""
        if not self._is_replay:
            return
        self.timeline = self._client.timeline()
        self._time_monitor.poll()
        clock = self._time_monitor.clock
        if clock is not None and clock.state == "paused":
            self.play("seek", clock.t_ns / 1e9)

    def state(self, run: RunCondition) -> dict[str, Any]:
        """Return the timeline, with why each operation of `play` would be refused; empty of a flight."""
        return {**self.timeline, "refusals": run_refusals(run)} if self.timeline else {}

    def play(self, op: str, value: float) -> None:
        """Seek [s], pause, resume, step [gates] or set the rate; do nothing in a flight."""
        if not self.timeline:
            return
        clock = self._time_monitor.clock
        if op == "seek":
            self._client.seek(value, step=clock is not None and clock.state == "paused")
        else:
            args = {"step": {"gates": int(value)}, "rate": {"value": value}}
            self._client.request_world(op, **args.get(op, {}))
