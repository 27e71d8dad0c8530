"""The record that a replay plays: how far it goes, and what the page may do with its time."""

import math
import threading
from collections import deque
from typing import Any

from zsim_bridges.console.command_client import CommandClient, PastInstant
from zsim_bridges.console.monitoring.run_condition import RunCondition, run_refusals
from zsim_bridges.console.monitoring.time_monitor import TimeMonitor
from zsim_bridges.console.scene.variable_history import INTERVAL_S, SPAN_S

PIECE_S = 10.0  # simulated; of what is read at once: the replay stands meanwhile, 0.15 s with thirty drones
INSTANT_DRONES_MAX = 9_000  # in a piece; a replay answers fewer than 10 000
BEHIND_S, AHEAD_S = SPAN_S, SPAN_S / 2.0  # simulated; about the shown instant, as far as trails and curves reach
KEPT_S = 2.0 * SPAN_S  # simulated; of what was read, on both sides of the shown instant


class RecordPlayer:
    """Steers a replay.

    Args:
        client: sends requests.
        time_monitor: of the run's clock.
        is_replay: whether the run is one; a flight has no timeline, and is not steered from here.
        drones: how many there are.

    Attributes:
        timeline: from_s, to_s [s] and marks (t_s, kind, text); empty of a flight, and before `load`.
    """

    def __init__(self, client: CommandClient, time_monitor: TimeMonitor, is_replay: bool, drones: int = 1) -> None:
        self._client = client
        self._time_monitor = time_monitor
        self._is_replay = is_replay
        self.timeline: dict[str, Any] = {}
        self._every_s = max(INTERVAL_S, PIECE_S * drones / INSTANT_DRONES_MAX)
        self._lock = threading.Lock()
        self._shown_s = 0.0
        self._known: set[int] = set()  # numbers of the pieces that were read
        self._is_reading = False
        self._arrived: deque[list[PastInstant]] = deque()

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

    def fill(self, t_s: float) -> None:
        """Let the record around the shown instant be read where it was not, in another thread, the nearest first."""
        if "to_s" not in self.timeline:
            return
        with self._lock:
            self._shown_s = t_s
            self._known = {k for k in self._known if abs(self._middle_s(k) - t_s) < KEPT_S - PIECE_S}
            if self._is_reading or self._missing() is None:
                return
            self._is_reading = self._client.read(self._read_missing)

    def take(self) -> list[PastInstant]:
        """Return the instants of a piece that has been read, each piece once; empty where there is none."""
        return self._arrived.popleft() if self._arrived else []

    def _middle_s(self, piece: int) -> float:
        return self.timeline["from_s"] + (piece + 0.5) * PIECE_S

    def _missing(self) -> int | None:
        """Return the piece nearest to the shown instant that was not read, None where all were."""
        from_s, to_s = self.timeline["from_s"], self.timeline["to_s"]
        first_s, last_s = max(from_s, self._shown_s - BEHIND_S), min(to_s, self._shown_s + AHEAD_S)
        pieces = range(math.floor((first_s - from_s) / PIECE_S), math.floor((last_s - from_s) / PIECE_S) + 1)
        unread = [k for k in pieces if k not in self._known]
        return min(unread, key=lambda k: abs(self._middle_s(k) - self._shown_s), default=None)

    def _read_missing(self) -> None:
        """Read piece by piece until none is missing; what cannot be read is not tried again."""
        while True:
            with self._lock:
                piece = self._missing()
                if piece is None:
                    self._is_reading = False
                    return
                self._known.add(piece)
            begin_s = self.timeline["from_s"] + piece * PIECE_S
            end_s = min(begin_s + PIECE_S - self._every_s / 2.0, self.timeline["to_s"])
            instants = self._client.past_views(begin_s, end_s, self._every_s)
            if instants:
                self._arrived.append(instants)
