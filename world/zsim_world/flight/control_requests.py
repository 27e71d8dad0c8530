"""What may be asked of the hub on `world/control`, besides replay: of any run, and of a flight."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import msgspec

from zsim.contract import keys
from zsim.contract.messages import GATES_MAX, PRIORITY_MAX, RATE_MAX, ControlAnswer, ControlRequest

if TYPE_CHECKING:
    from zsim_world.flight.coordinator import Hub
    from zsim_world.flight.world import World

ARGS_BYTES_MAX = 4000  # of arguments that are told as they are; what is done on a request needs far fewer


class TimeRequests:
    """Answers requests about time; each operation returns the reason of its refusal, None when done, or an answer."""

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._operations: dict[str, Callable[[ControlRequest], str | ControlAnswer | None]] = {
            "pause": self._pause,
            "resume": self._resume,
            "step": self._step,
            "rate": self._rate,
            "stop": self._stop,
        }

    def answer(self, request: ControlRequest) -> ControlAnswer:
        """Do what is asked, or say why not."""
        if request.source and not keys.PROCESS_NAME.fullmatch(request.source):
            return ControlAnswer(False, f"source is {request.source[:48]!r}; must be 1 to 48 of a-z 0-9 _ . -")
        operation = self._operations.get(request.op)
        if operation is None:
            allowed = ", ".join([*self._operations, "replay"])
            return ControlAnswer(False, f"op is {request.op[:40]!r}; must be one of {allowed}")
        done = operation(request)
        return done if isinstance(done, ControlAnswer) else ControlAnswer(done is None, done or "")

    def _pause(self, _: ControlRequest) -> str | None:
        if self._hub.state != "running":
            return f"the run is {self._hub.state}; pause needs a running one"
        self._hub.state, self._hub.steps_allowed = "paused", 0
        return None

    def _resume(self, _: ControlRequest) -> str | None:
        if self._hub.state != "paused":
            return f"the run is {self._hub.state}; resume needs a paused one"
        self._hub.state = "running"
        return None

    def _step(self, request: ControlRequest) -> str | None:
        gates = _number(request.args.get("gates", 1))
        if gates is None or gates != int(gates) or not 1 <= gates <= GATES_MAX:
            return f"gates is {_shown(request, 'gates')}; must be a whole number from 1 to {GATES_MAX}"
        if self._hub.state != "paused":
            return f"the run is {self._hub.state}; step needs a paused one"
        self._hub.steps_allowed += int(gates)
        return None

    def _rate(self, request: ControlRequest) -> str | None:
        value = _number(request.args.get("value"))
        realtime = self._hub.mode == "realtime"
        if value is None or not 0 <= value <= RATE_MAX or (realtime and value == 0):
            allowed = f"from 0 (as fast as possible, lockstep only) to {RATE_MAX:g}"
            return f"value is {_shown(request, 'value')}; must be {allowed}"
        self._hub.rate = value
        return None

    def _stop(self, request: ControlRequest) -> str | None:
        reason = str(request.args.get("reason", ""))[:200]
        who = request.source[:40] or "somebody"
        self._hub.stop(f"stopped by {who}" + (f": {reason}" if reason else ""))
        return None


class Requests(TimeRequests):
    """Answers requests about a flight too."""

    def __init__(self, world: World) -> None:
        super().__init__(world)
        self._world = world
        self._operations |= {
            "acquire": self._acquire,
            "release": self._release,
            "fault_add": world.faults.add,
            "fault_clear": world.faults.clear,
        }

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
    """Return the arguments for an event: as they are, since a run is flown again by them, or shortened if too long."""
    if len(msgspec.msgpack.encode(args)) <= ARGS_BYTES_MAX:
        return args
    pairs = list(args.items())[:8]
    return {str(name)[:40]: value if _number(value) is not None else str(value)[:80] for name, value in pairs}


def _shown(request: ControlRequest, name: str) -> str:
    return repr(request.args.get(name))[:40]


def _number(value: Any) -> float | None:
    """Return a number, None for anything that is none."""
    good = isinstance(value, int | float) and not isinstance(value, bool) and value == value
    return value if good else None
