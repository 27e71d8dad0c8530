"""A client in the lockstep: an agent whose step is executed at the other end of a socket."""

import asyncio
import queue
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from typing import Any

import msgspec

from zsim.contract import keys, messages
from zsim.contract.messages import Info
from zsim.errors import DecodeError
from zsim.runtime.agent import Agent, Output
from zsim.transport.session import check_expression
from zsim_bridges.gateway.client_messages import DoneRequest, JoinRequest, MessageDefaults, is_counted_key
from zsim_bridges.gateway.run_access import RunAccess

ANSWER_TIMEOUT_S = 10.0  # wall time after which a client that answers nothing in realtime leaves the lockstep
LATE_PERIODS = 2  # in realtime, a gate older by this many is sent together with a newer one
NO_GATE_NS = -1  # no gate waits for an answer
_encode = msgspec.json.Encoder().encode


class LockstepSession(Agent):
    """A client's session in the lockstep, from joining to leaving: sends each gate's inputs, waits for its outputs.

    The runner calls its methods in a separate thread; all others are called on the loop.

    Args:
        name: process name of the participant, role.thing.
        loop: of the client.
        send: sends the line of a gate; called on the loop.

    Attributes:
        connection_lost: whether its client disconnected without leaving, so that its process counts as dead.

    Raises:
        DecodeError: name, period or a gate key is invalid.
        UnknownError: a gate key names a drone or cluster that the run does not have.
        SessionError: an entry of `reads` is not a key expression.
    """

    def __init__(
        self,
        name: str,
        request: JoinRequest,
        run: RunAccess,
        loop: asyncio.AbstractEventLoop,
        send: Callable[[bytes], None],
    ) -> None:
        super().__init__()
        info, reads, gates = run.info, request.reads, request.gates
        for key in (*reads, *gates):
            check_expression(key)
        self.name = name
        self.period_ns = round(request.period_s * 1e9)
        if not keys.PROCESS_NAME.fullmatch(name) or "." not in name.strip("."):
            raise DecodeError(f"join: name is {name[:60]!r}; must be a role, a dot and a name of a-z 0-9 _ . -")
        if self.period_ns <= 0 or self.period_ns % info.gate_ns:
            must = f"must be a multiple of {info.gate_ns / 1e9:g}"
            raise DecodeError(f"join: period_s is {self.period_ns / 1e9:g}; {must}")
        if any("*" in key for key in gates):
            raise DecodeError(
                "join: gates has a wildcard; must be keys, of each of which a message comes at every gate"
            )
        for key in gates:
            run.check_known(key)
        self.gate_keys = tuple(gates) or gate_keys_of(info, reads, name, run.required_processes)
        # A key that matches two expressions would arrive twice.
        missing = [key for key in self.gate_keys if not any(keys.matches(each, key) for each in reads)]
        self.reads = tuple(dict.fromkeys((*reads, *missing)))
        self.counted = tuple(d.name for d in info.drones if any(_matches_sensors(each, d.name) for each in self.reads))
        self.run = run
        self.defaults = MessageDefaults(name)
        self.has_left = self.connection_lost = False
        self._loop = loop
        self._send = send
        self._late_ns = LATE_PERIODS * self.period_ns if info.mode == "realtime" else None
        self._inputs: list[tuple[str, Any]] = []
        self._answers: queue.SimpleQueue[list[Output]] = queue.SimpleQueue()
        self._gate_ns = NO_GATE_NS

    def receive(self, key: str, message: Any) -> None:
        self._inputs.append((key, message))

    def step(self, t_ns: int) -> list[Output]:
        if self.has_left or (self._late_ns is not None and self.run.now_ns - t_ns >= self._late_ns):
            return []
        inputs, self._inputs = self._inputs, []
        entries = [{"key": key, "value": message} for key, message in inputs]
        line = _encode({"op": "gate", "t_ns": t_ns, "inputs": entries}) + b"\n"
        with suppress(RuntimeError):  # the gateway has ended
            self._loop.call_soon_threadsafe(self._send_gate, t_ns, line)
        try:
            return self._answers.get(timeout=ANSWER_TIMEOUT_S if self._late_ns is not None else None)
        except queue.Empty:
            self.leave(connection_lost=True)
            return []

    def _send_gate(self, t_ns: int, line: bytes) -> None:
        if not self.has_left:
            self._gate_ns = t_ns
            self._send(line)

    def answer_gate(self, request: DoneRequest) -> None:
        """Answer the waiting gate; on an error nothing changes, and the gate keeps waiting.

        Raises:
            DecodeError: there is no such gate, or an output is not a message of its key.
            ForbiddenError: an output's key is reserved.
        """
        if self._gate_ns == NO_GATE_NS:
            raise DecodeError("done: there is no gate to answer; wait for the next")
        if request.t_ns != self._gate_ns:
            raise DecodeError(f"done: t_ns is {request.t_ns}; must be {self._gate_ns}, the gate that came last")
        counted: list[Output] = []  # counted by a done: the runner publishes these, the gateway the rest
        others: list[tuple[str, bytes]] = []
        with self.defaults.transaction():
            for key, value in ((output.key, output.value) for output in request.outputs):
                is_counted = is_counted_key(key)
                if not is_counted:
                    self.run.check_writable(key)
                payload = self.run.encode(key, self.defaults.fill(key, value, self._gate_ns))
                if is_counted:
                    counted.append(Output(key, messages.decode(key, payload)))
                else:
                    others.append((key, payload))
        for key, payload in others:
            self.run.publish(key, payload)
        self._gate_ns = NO_GATE_NS
        self._answers.put(counted)

    def leave(self, connection_lost: bool = False) -> None:
        """End a waiting step: the client is gone."""
        self.has_left, self.connection_lost = True, connection_lost
        self._answers.put([])


def gate_keys_of(info: Info, reads: Sequence[str], name: str, required: Collection[tuple[str, str]]) -> tuple[str, ...]:
    """Return the keys with a message at every gate that match some expression; `clock` if there are none.

    A drone's status and truth come from the world. Its estimate and the state of a cluster arrive at every gate if the
    run does not start without a process for it, other than the one that joins.
    """
    served = {thing for process, thing in required if process != name}
    of_world = [key(drone.name) for drone in info.drones for key in (keys.status, keys.truth)]
    estimates = [keys.estimate(drone.name) for drone in info.drones if drone.name in served]
    states = [keys.cluster_state(cluster.name) for cluster in info.clusters if cluster.name in served]
    gate_keys = [key for key in (*of_world, *estimates, *states) if any(keys.matches(each, key) for each in reads)]
    return tuple(gate_keys) or (keys.CLOCK,)


def _matches_sensors(expression: str, drone: str) -> bool:
    return all(keys.matches(expression, keys.sensor(drone, kind)) for kind in (*keys.SENSORS, "status"))
