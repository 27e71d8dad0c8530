"""Simulated time of a run: its gates, whether and how fast it passes, and the requests that change this."""

from collections.abc import Callable
from typing import Any, ClassVar

from zsim.contract.run_messages import GATES_MAX, RATE_MAX, ControlAnswer, ControlRequest
from zsim.scenario.scenario import TimeSteps
from zsim_world.run.outbox import Refusal
from zsim_world.run_state import Saved

Operation = Callable[[ControlRequest], Refusal | ControlAnswer | None]
"""Does what a request asks for; returns why it is refused, an answer with a result, or None when done."""


class RunClock:
    """Simulated time, and whether it may pass.

    Attributes:
        rate: simulated per wall seconds to pace at; 0 = as fast as possible.
        delay_ns: of commands.
        ahead_ns: by how much the world may be ahead of the agents.
        now_ns: the newest gate; 0 before the start too.
        next_ns: the gate after it, from which a newcomer is waited for.
        state: as in the message `clock`.
        steps_allowed: gates that may still come while the run is paused.
        jumps: how often time was moved otherwise than gate by gate.
        ended: why the run is over, None while it goes on.
        is_complete: whether it is over by itself, so that nothing of it can be continued.
    """

    SAVED: ClassVar[Saved] = {  # of a run that has not ended
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
        """Return the gate whose dones are required for the next one: its commands answer that gate."""
        return self.now_ns - self.ahead_ns

    @property
    def is_halted(self) -> bool:
        """Tell whether time stands whatever dones arrive: the run has ended or is paused."""
        return self.ended is not None or (self.state == "paused" and self.steps_allowed == 0)

    def start(self, t_ns: int, paused: bool = False) -> None:
        """Begin with the first gate, and stand still after it if `paused`."""
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
        """End the run after the present gate; of several reasons the first is kept."""
        if self.ended is None:
            self.ended = reason

    def hold(self) -> None:
        """Stand still until a request lets time go on."""
        self.state, self.steps_allowed = "paused", 0

    # Requests

    def operations(self) -> dict[str, Operation]:
        """Return what each `op` on `world/control` that is about time does."""
        pausing = dict.fromkeys(("pause", "resume", "step"), self._pause_or_continue)
        return {**pausing, "rate": self._set_rate, "stop": self._stop}

    def _pause_or_continue(self, request: ControlRequest) -> Refusal | None:
        op, needed = request.op, "running" if request.op == "pause" else "paused"
        gates = number(request.args.get("gates", 1)) if op == "step" else 1
        if gates is None or not 1 <= gates <= GATES_MAX or gates != int(gates):
            return refused_argument(request, "gates", f"a whole number from 1 to {GATES_MAX}")
        if self.state != needed:
            return Refusal("the run", self.state, f"{op} needs a {needed} one")
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
        who = request.source[:40] or "somebody"
        self.stop(f"stopped by {who}" + (f": {reason}" if reason else ""))


def refused_argument(request: ControlRequest, name: str, allowed: str) -> Refusal:
    """Return the refusal of a request for one of its arguments."""
    return Refusal(name, repr(request.args.get(name))[:40], f"must be {allowed}")


def number(value: Any) -> float | None:
    """Return a number, None for anything that is none; NaN is none."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool) and value == value
    return value if is_number else None
