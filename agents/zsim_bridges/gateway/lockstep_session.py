"""A client's place in the lockstep: the seat, the gate that waits for an answer, and how it is answered."""

import asyncio
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import msgspec

from zsim.contract import messages
from zsim.errors import DecodeError
from zsim.runtime.agent import Output
from zsim.transport.session import check_expression
from zsim_bridges.gateway.key_policy import is_counted_key
from zsim_bridges.gateway.lines import stream_requests
from zsim_bridges.gateway.lockstep_agent import LockstepAgent
from zsim_bridges.gateway.message_defaults import MessageDefaults
from zsim_bridges.gateway.run_access import RunAccess

NO_GATE_NS = -1  # no gate waits for an answer
_encode = msgspec.json.Encoder().encode


class LockstepSession:
    """What a client has from its join until it leaves.

    Args:
        name: process name of the participant.
        asked: what it joined with.
        flight: the run that it sits in.
        loop: of the client.
        send: takes the line of a gate, on the loop.

    Attributes:
        flight: the run that it sits in.
        seat: the agent that keeps the lockstep.
        stamps: of what it says.

    Raises:
        DecodeError: name, period or a gate key is none.
        UnknownError: a gate key is about a drone or a cluster that the run does not have.
        SessionError: what it reads is no key expression.
    """

    def __init__(
        self,
        name: str,
        asked: stream_requests.JoinRequest,
        flight: RunAccess,
        loop: asyncio.AbstractEventLoop,
        send: Callable[[bytes], None],
    ) -> None:
        for key in (*asked.reads, *asked.gates):
            check_expression(key)
        period_ns = round(asked.period_s * 1e9)
        self.agent = LockstepAgent(
            name,
            flight.info,
            period_ns,
            asked.reads,
            asked.gates,
            hand_over=self._hand_over,
            now_ns=lambda: flight.now_ns,
            served=flight.required_processes,
        )
        for key in asked.gates:
            flight.check_known(key)
        self.defaults = MessageDefaults(name)
        self.run = flight
        self._loop = loop
        self._send = send
        self._gate_ns = NO_GATE_NS

    def _hand_over(self, t_ns: int, inputs: list[tuple[str, Any]]) -> None:
        """Send the inputs of a gate; in the seat's thread."""
        entries = [{"key": key, "value": message} for key, message in inputs]
        line = _encode({"op": "gate", "t_ns": t_ns, "inputs": entries}) + b"\n"
        with suppress(RuntimeError):  # the gateway has ended
            self._loop.call_soon_threadsafe(self._send_gate, t_ns, line)

    def _send_gate(self, t_ns: int, line: bytes) -> None:
        if not self.agent.has_left:
            self._gate_ns = t_ns
            self._send(line)

    def answer_gate(self, asked: stream_requests.DoneRequest) -> None:
        """Answer the gate that waits; a refusal touches nothing, and the gate goes on waiting.

        Raises:
            DecodeError: there is no such gate, or an output is none.
            ForbiddenError: somebody else speaks on an output's key.
        """
        if self._gate_ns == NO_GATE_NS:
            raise DecodeError("done: there is no gate to answer; wait for the next")
        if asked.t_ns != self._gate_ns:
            raise DecodeError(f"done: t_ns is {asked.t_ns}; must be {self._gate_ns}, the gate that came last")
        with self.defaults.transaction():
            said = [(each.key, self._payload(each)) for each in asked.outputs]
            counted = [Output(key, messages.decode(key, payload)) for key, payload in said if is_counted_key(key)]
        self.run.publish([(key, payload) for key, payload in said if not is_counted_key(key)])
        self._gate_ns = NO_GATE_NS
        self.agent.answer(counted)

    def _payload(self, said: stream_requests.GateOutput) -> bytes:
        """Return what goes out: what a done counts in the seat's own name, the rest in the gateway's."""
        if not is_counted_key(said.key):
            self.run.check_writable(said.key)
        return self.run.payload(said.key, self.defaults.fill(said.key, said.value, self._gate_ns))
