"""Simulated time of a run: gates, pausing and rate, the requests that change these, and statistics.

Statistics: real-time factor, age of commands, deadline misses, smallest distance between drones.
"""

import math
from array import array
from collections.abc import Callable, Iterable
from typing import Any, ClassVar

import numpy as np

from zsim.contract.run_messages import GATES_MAX, RATE_MAX, ControlAnswer, ControlRequest
from zsim.contract.snapshot import PART, Saved
from zsim.scenario.scenario import TimeSteps
from zsim_world.run.barrier import Participant
from zsim_world.run.outbox import Refusal

Operation = Callable[[ControlRequest], Refusal | ControlAnswer | None]
"""Carries out a request; returns why it is refused, an answer with a result, or None when done."""
GATES_KEPT = 256  # gates whose publication times are kept for command ages: 5 s, ten times the default maximum age
AGES_KEPT = 1_000_000  # ages kept for the percentiles; 8 MB
MARK_NS = 10_000_000  # wall time between marks from which the rate over the last second is computed


class RunClock:
    """Simulated time and its state.

    Attributes:
        rate: target pace, simulated seconds per wall second; 0: as fast as possible.
        delay_ns: command delay [ns].
        ahead_ns: how far the world may be ahead of the agents [ns].
        now_ns: the newest gate; also 0 before the start.
        next_ns: the next gate, from which the world waits for a newcomer.
        state: as in the message `clock`.
        steps_allowed: number of gates that may still follow while the run is paused.
        jumps: number of jumps of time to another gate.
        ended: why the run has ended; None while it continues.
        is_complete: whether the run reached its regular end, so that it cannot be continued.
    """

    SAVED: ClassVar[Saved] = {  # state of a run that has not ended
        "rate": float,
        "now_ns": int,
        "next_ns": int,
        "state": str,
        "steps_allowed": int,
        "jumps": int,
    }

    def __init__(self, time: TimeSteps, mode: str, rate: float) -> None:
        self.mode = mode
        self.rate = rate
        self.gate_ns = round(time.gate_ms * 1e6)
        self.delay_ns = self.ahead_ns = time.command_delay_gates * self.gate_ns
        self.now_ns = self.next_ns = 0
        self.state = "waiting"
        self.steps_allowed = self.jumps = 0
        self.ended: str | None = None
        self.is_complete = False

    @property
    def required_ns(self) -> int:
        """The gate whose dones are required before the world advances: `ahead_ns` before the newest."""
        return self.now_ns - self.ahead_ns

    @property
    def is_halted(self) -> bool:
        """Whether time stands still regardless of dones: the run has ended or is paused."""
        return self.ended is not None or (self.state == "paused" and self.steps_allowed == 0)

    def start(self, t_ns: int, paused: bool = False) -> None:
        """Begin with the first gate, and pause after it if `paused`."""
        self.state = "paused" if paused else "running"
        self.advance(t_ns)

    def advance(self, t_ns: int) -> None:
        """Advance to a gate; while the run is paused, this uses up one step."""
        self.steps_allowed = max(0, self.steps_allowed - 1)
        self.now_ns, self.next_ns = t_ns, t_ns + self.gate_ns

    def complete(self, reason: str) -> None:
        """End the run at its regular end."""
        self.is_complete = self.ended is None
        self.stop(reason)

    def stop(self, reason: str) -> None:
        """End the run after the current gate; the first reason is kept."""
        if self.ended is None:
            self.ended = reason

    def hold(self) -> None:
        """Pause until a request resumes or steps the run."""
        self.state, self.steps_allowed = "paused", 0

    # Requests

    def operations(self) -> dict[str, Operation]:
        """Return the handlers of the `op` values on `world/control` that concern time."""
        pausing = dict.fromkeys(("pause", "resume", "step"), self._pause_or_continue)
        return {**pausing, "rate": self._set_rate, "stop": self._stop}

    def _pause_or_continue(self, request: ControlRequest) -> Refusal | None:
        op, required_state = request.op, "running" if request.op == "pause" else "paused"
        gates = number(request.args.get("gates", 1)) if op == "step" else 1
        if gates is None or not 1 <= gates <= GATES_MAX or gates != int(gates):
            return refused_argument(request, "gates", f"a whole number from 1 to {GATES_MAX}")
        if self.state != required_state:
            return Refusal("the run", self.state, f"must be {required_state} for {op}")
        if op == "pause":
            self.hold()
        elif op == "resume":
            self.state = "running"
        else:
            self.steps_allowed += int(gates)
        return None

    def _set_rate(self, request: ControlRequest) -> Refusal | None:
        rate = number(request.args.get("value"))
        if rate is None or not 0 <= rate <= RATE_MAX or (self.mode == "realtime" and rate == 0):
            allowed = f"from 0 (as fast as possible, lockstep only) to {RATE_MAX:g}"
            return refused_argument(request, "value", allowed)
        self.rate = rate
        return None

    def _stop(self, request: ControlRequest) -> None:
        reason = str(request.args.get("reason", ""))[:200]
        source = request.source[:40] or "somebody"
        self.stop(f"stopped by {source}" + (f": {reason}" if reason else ""))


def refused_argument(request: ControlRequest, name: str, allowed: str) -> Refusal:
    """Return the refusal of a request because of one of its arguments."""
    return Refusal(name, repr(request.args.get(name))[:40], f"must be {allowed}")


def number(value: Any) -> float | None:
    """Return the value if it is a number other than NaN, else None."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool) and value == value
    return value if is_number else None


class CommandAges:
    """Wall times from a gate's publication to the arrival of a command that answers it."""

    SAVED: ClassVar[Saved] = {"_published": dict[int, int], "ages": bytes, "_oldest": int}

    def __init__(self) -> None:
        self._published: dict[int, int] = {}
        self._ages_ns = array("q")
        self._oldest = 0  # index of the oldest age once AGES_KEPT are kept

    @property
    def ages(self) -> bytes:
        return self._ages_ns.tobytes()

    @ages.setter
    def ages(self, ages: bytes) -> None:
        self._ages_ns = array("q", ages)

    def gate(self, t_ns: int, wall_ns: int) -> None:
        """Note when the gate t_ns was published."""
        self._published[t_ns] = wall_ns
        if len(self._published) > GATES_KEPT:
            del self._published[next(iter(self._published))]

    def command(self, t_ns: int, wall_ns: int) -> None:
        """Note when a command stamped t_ns arrived; it has no age if that gate's time is not kept."""
        published_wall_ns = self._published.get(t_ns)
        if published_wall_ns is None:
            return
        age_ns = wall_ns - published_wall_ns
        if len(self._ages_ns) < AGES_KEPT:
            self._ages_ns.append(age_ns)
        else:
            self._ages_ns[self._oldest] = age_ns
            self._oldest = (self._oldest + 1) % AGES_KEPT

    def summary_ms(self) -> dict[str, float] | None:
        """Return p50, p99 and max in milliseconds; None without commands."""
        if not self._ages_ns:
            return None
        ages = np.array(self._ages_ns) / 1e6
        p50, p99 = np.percentile(ages, [50, 99])
        return {"p50": float(p50), "p99": float(p99), "max": float(ages.max())}


class RealTimeFactor:
    """Simulated seconds per wall second, over the last wall second and over the run.

    Attributes:
        sim_ns: simulated time that has passed since the first gate, without jumps.
    """

    SAVED: ClassVar[Saved] = {
        "_marks": list[tuple[int, int]],
        "_start_wall_ns": int | None,
        "_last": tuple[int, int],
        "sim_ns": int,
    }

    def __init__(self) -> None:
        self._marks: list[tuple[int, int]] = []  # simulated and wall times within the last second
        self._start_wall_ns: int | None = None
        self._last = (0, 0)
        self.sim_ns = 0

    @property
    def wall_s(self) -> float:
        return 0.0 if self._start_wall_ns is None else (self._last[1] - self._start_wall_ns) / 1e9

    def gate(self, t_ns: int, wall_ns: int) -> None:
        """Note when the gate t_ns was published."""
        if self._start_wall_ns is None:
            self._start_wall_ns = wall_ns
        if self._marks:
            self.sim_ns += t_ns - self._last[0]
        self._last, marks = (t_ns, wall_ns), self._marks
        while len(marks) > 1 and wall_ns - marks[0][1] > 1_000_000_000:
            del marks[0]
        if not marks or wall_ns - marks[-1][1] >= MARK_NS:
            marks.append(self._last)

    def stand_still(self, wall_ns: int) -> None:
        """Exclude the time from the last gate to wall_ns from the run's wall time."""
        if self._start_wall_ns is not None:
            self._start_wall_ns += wall_ns - self._last[1]
            self._last = (self._last[0], wall_ns)
            self._marks = [self._last]

    def jump(self) -> None:
        """Note that simulated time jumps to the next gate."""
        self._marks.clear()

    def now(self) -> float:
        """Return the factor over the last wall second."""
        (t0, w0), (t1, w1) = self._marks[0] if self._marks else self._last, self._last
        return (t1 - t0) / (w1 - w0) if w1 > w0 else 0.0


class RunStatistics:
    """The statistics of a run for its event `end`.

    Attributes:
        world_misses: number of gates that the world published too late.
        closest_m: smallest distance between two drones so far, landed ones included [m]; inf for a single drone.
    """

    SAVED: ClassVar[Saved] = {
        "ages": PART,
        "rate": PART,
        "world_misses": int,
        "closest_m": float,
        "_deadline_count": int,
    }

    def __init__(self) -> None:
        self.ages = CommandAges()
        self.rate = RealTimeFactor()
        self.world_misses = 0
        self.closest_m = math.inf
        self._deadline_count = 0

    def gate(self, t_ns: int, wall_ns: int) -> None:
        """Note when the gate t_ns was published."""
        self.ages.gate(t_ns, wall_ns)
        self.rate.gate(t_ns, wall_ns)

    def deadlines(self, participants: Iterable[Participant], need_ns: int) -> None:
        """Count the participants whose done for need_ns was due, and those whose done is missing."""
        for participant in participants:
            if participant.gating and participant.required_ns(need_ns) is not None:
                self._deadline_count += 1
                participant.deadline_misses += participant.blocks(need_ns)

    def result(self, participants: Iterable[Participant]) -> dict[str, Any]:
        """Return the statistics of the run so far."""
        by_name = {p.name: p.deadline_misses for p in participants if p.gating}
        sim_s, wall_s = self.rate.sim_ns / 1e9, self.rate.wall_s
        return {
            "sim_s": sim_s,
            "wall_s": wall_s,
            "real_time_factor": sim_s / wall_s if wall_s > 0 else 0.0,
            "deadlines": self._deadline_count,
            "deadline_misses": sum(by_name.values()) + self.world_misses,
            "deadline_misses_by": {**by_name, "world": self.world_misses},
            "command_age_ms": self.ages.summary_ms(),
            "closest_m": self.closest_m if math.isfinite(self.closest_m) else None,
        }
