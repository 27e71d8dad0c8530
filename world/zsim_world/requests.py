"""What may be asked of the world on `world/control`, besides replay."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from zsim import keys
from zsim.messages import ControlAnswer, ControlRequest

if TYPE_CHECKING:
    from zsim_world.world import World

GATES_MAX = 1_000_000  # of one `step`: 5.5 hours at 20 ms
RATE_MAX = 1000.0  # simulated per wall second; beyond it nothing paces
PRIORITY_MAX = 100  # programs have 0, operators 10


class Requests:
    """Answers requests; each operation returns the reason of its refusal, None when it is done."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._operations: dict[str, Callable[[ControlRequest], str | None]] = {
            "pause": self._pause,
            "resume": self._resume,
            "step": self._step,
            "rate": self._rate,
            "stop": self._stop,
            "acquire": self._acquire,
            "release": self._release,
        }

    def answer(self, request: ControlRequest) -> ControlAnswer:
        """Do what is asked, or say why not."""
        if request.source and not keys.PROCESS_NAME.fullmatch(request.source):
            return ControlAnswer(False, f"source is {request.source[:48]!r}; must be 1 to 48 of a-z 0-9 _ . -")
        operation = self._operations.get(request.op)
        if operation is None:
            allowed = ", ".join([*self._operations, "replay"])
            return ControlAnswer(False, f"op is {request.op[:40]!r}; must be one of {allowed}")
        fault = operation(request)
        return ControlAnswer(fault is None, fault or "")

    def _pause(self, _: ControlRequest) -> str | None:
        if self._world.state != "running":
            return f"the run is {self._world.state}; pause needs a running one"
        self._world.state, self._world.steps_allowed = "paused", 0
        return None

    def _resume(self, _: ControlRequest) -> str | None:
        if self._world.state != "paused":
            return f"the run is {self._world.state}; resume needs a paused one"
        self._world.state = "running"
        return None

    def _step(self, request: ControlRequest) -> str | None:
        gates = _number(request.args.get("gates", 1))
        if gates is None or gates != int(gates) or not 1 <= gates <= GATES_MAX:
            return f"gates is {_shown(request, 'gates')}; must be a whole number from 1 to {GATES_MAX}"
        if self._world.state != "paused":
            return f"the run is {self._world.state}; step needs a paused one"
        self._world.steps_allowed += int(gates)
        return None

    def _rate(self, request: ControlRequest) -> str | None:
        value = _number(request.args.get("value"))
        realtime = self._world.mode == "realtime"
        if value is None or not 0 <= value <= RATE_MAX or (realtime and value == 0):
            allowed = f"from 0 (as fast as possible, lockstep only) to {RATE_MAX:g}"
            return f"value is {_shown(request, 'value')}; must be {allowed}"
        self._world.rate = value
        return None

    def _stop(self, request: ControlRequest) -> str | None:
        reason = str(request.args.get("reason", ""))[:200]
        who = request.source[:40] or "somebody"
        self._world.stop(f"stopped by {who}" + (f": {reason}" if reason else ""))
        return None

    def _acquire(self, request: ControlRequest) -> str | None:
        drone, priority = self._drone(request), _number(request.args.get("priority", 0))
        if drone is None:
            return self._no_drone(request)
        if priority is None or not 0 <= priority <= PRIORITY_MAX:
            return f"priority is {_shown(request, 'priority')}; must be from 0 to {PRIORITY_MAX}"
        if not request.source:
            return "source is empty; must be the name under which the commands will come"
        return self._world.commanders.acquire(drone, request.source, int(priority))

    def _release(self, request: ControlRequest) -> str | None:
        drone = self._drone(request)
        if drone is None:
            return self._no_drone(request)
        fault = self._world.commanders.release(drone, request.source)
        if fault is None:
            self._world.fleet.release(drone)
        return fault

    def _drone(self, request: ControlRequest) -> int | None:
        name = request.args.get("drone")
        return self._world.index.get(name) if isinstance(name, str) else None

    def _no_drone(self, request: ControlRequest) -> str:
        return f"drone is {_shown(request, 'drone')}; must be one of {', '.join(self._world.index)}"


def brief(args: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments short enough for an event."""
    pairs = list(args.items())[:8]
    return {str(name)[:40]: value if _number(value) is not None else str(value)[:80] for name, value in pairs}


def _shown(request: ControlRequest, name: str) -> str:
    return repr(request.args.get(name))[:40]


def _number(value: Any) -> float | None:
    """Return a number, None for anything that is none."""
    good = isinstance(value, int | float) and not isinstance(value, bool) and value == value
    return value if good else None
