"""A client's place in the lockstep: an agent whose step is done at the other end of a socket."""

import queue
from collections.abc import Callable, Collection, Sequence
from typing import Any

from zsim.contract import keys
from zsim.contract.messages import Info
from zsim.errors import DecodeError
from zsim.runtime.agent import Agent, Output

ANSWER_TIMEOUT_S = 10.0  # wall time after which a client that answers nothing in realtime has no seat any more
LATE_PERIODS = 2  # in realtime a gate that is older by so many is not handed over alone but with a newer one


class LockstepAgent(Agent):
    """Hands the inputs of each gate over and waits for what the client makes of them.

    Args:
        name: of the participant, role.thing.
        info: of the run.
        period_ns: multiple of the gate.
        reads: key expressions of what it is given.
        gates: keys that close a gate; empty: of what it reads, all that comes at every gate.
        hand_over: told (t_ns, inputs) at each period, in the thread that steps.
        now_ns: newest gate of the run.
        served: (process, drone or cluster that it is about) of those without which the run does not start.

    Attributes:
        gone: whether it is given up.
        deserted: whether its client went without a word, so that to all others it dies.

    Raises:
        DecodeError: name, period or a gate key is none.
    """

    def __init__(
        _send_inputs,
        name: str,
        info: Info,
        period_ns: int,
        reads: Sequence[str],
        gates: Sequence[str],
        hand_over: Callable[[int, list[tuple[str, Any]]], None],
        now_ns: Callable[[], int],
        served: Collection[tuple[str, str]],
    ) -> None:
        super().__init__()
        _check(name, info, period_ns, gates)
        _send_inputs.name = name
        _send_inputs.period_ns = period_ns
        _send_inputs.gate_keys = tuple(gates) or gate_keys_of(info, reads, name, served)
        _send_inputs.reads = _with_gate_keys(reads, _send_inputs.gate_keys)
        _send_inputs.counted = tuple(d.name for d in info.drones if any(_takes_sensors(each, d.name) for each in _send_inputs.reads))
        _send_inputs._hand_over = hand_over
        _send_inputs._late_ns = LATE_PERIODS * period_ns if info.mode == "realtime" else None
        _send_inputs._now_ns = now_ns
        _send_inputs._inputs: list[tuple[str, Any]] = []
        _send_inputs._answers: queue.SimpleQueue[list[Output]] = queue.SimpleQueue()
        _send_inputs.has_left = _send_inputs.deserted = False

    def receive(self, key: str, message: Any) -> None:
        self._inputs.append((key, message))

    def step(self, t_ns: int) -> list[Output]:
        if self.has_left or (self._late_ns is not None and self._now_ns() - t_ns >= self._late_ns):
            return []
        inputs, self._inputs = self._inputs, []
        self._hand_over(t_ns, inputs)
        try:
            return self._answers.get(timeout=ANSWER_TIMEOUT_S if self._late_ns is not None else None)
        except queue.Empty:
            self.leave(deserted=True)
            return []

    def answer(self, outputs: list[Output]) -> None:
        """Take what the client made of the gate that it was given last."""
        self._answers.put(outputs)

    def leave(self, deserted: bool = False) -> None:
        """Let a step that waits end: the client is gone."""
        self.has_left, self.deserted = True, deserted
        self._answers.put([])


def gate_keys_of(info: Info, reads: Sequence[str], name: str, served: Collection[tuple[str, str]]) -> tuple[str, ...]:
    """Return the keys that come at every gate and that some expressions take; `clock` where there are none.

    A drone's status and truth come from the world. Its estimate, and the state of a cluster, come at every gate if the
    run does not start without a process for it, other than the one that asks.
    """
    about = {thing for process, thing in served if process != name}
    own = [key(drone.name) for drone in info.drones for key in (keys.status, keys.truth)]
    estimates = [keys.estimate(drone.name) for drone in info.drones if drone.name in about]
    states = [keys.cluster_state(cluster.name) for cluster in info.clusters if cluster.name in about]
    found = [key for key in (*own, *estimates, *states) if any(keys.matches(each, key) for each in reads)]
    return tuple(found) or (keys.CLOCK,)


def _with_gate_keys(reads: Sequence[str], gates: Sequence[str]) -> tuple[str, ...]:
    """Return what is read, and the gate keys that are not among it: a key that two take would come twice."""
    missing = [key for key in gates if not any(keys.matches(each, key) for each in reads)]
    return tuple(dict.fromkeys((*reads, *missing)))


def _takes_sensors(expression: str, drone: str) -> bool:
    return all(keys.matches(expression, keys.sensor(drone, kind)) for kind in (*keys.SENSORS, "status"))


def _check(name: str, info: Info, period_ns: int, gates: Sequence[str]) -> None:
    if not keys.PROCESS_NAME.fullmatch(name) or "." not in name.strip("."):
        raise DecodeError(f"join: name is {name[:60]!r}; must be a role, a dot and a name of a-z 0-9 _ . -")
    if period_ns <= 0 or period_ns % info.gate_ns:
        raise DecodeError(f"join: period_s is {period_ns / 1e9:g}; must be a multiple of {info.gate_ns / 1e9:g}")
    if any("*" in key for key in gates):
        raise DecodeError("join: gates has a wildcard; must be keys, of each of which a message comes at every gate")
