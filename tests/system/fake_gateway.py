"""A gateway whose messages a test sends, line by line.

with FakeGateway() as fake:
    ...  # a program connects to fake.port
    fake.welcome()
    fake.answer(fake.receive("subscribe"))
    fake.send({"op": "value", "key": "clock", "value": 1})
"""

import json
import socket
from typing import Any

from wire import PATIENCE_S

HELLO = {
    "op": "hello", "name": "client.me", "run_id": "r1", "federation": "zsim", "mode": "lockstep", "gate_s": 0.02,
    "t_ns": 1_200_000_000, "drones": ["drone1"], "clusters": [],
}  # fmt: skip


class FakeGateway:
    """A gateway for one connection, controlled by the test."""

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.settimeout(PATIENCE_S)
        self._peer: socket.socket | None = None
        self._received = b""
        self.port: int = self._listener.getsockname()[1]

    def __enter__(self) -> "FakeGateway":
        return self

    def __exit__(self, *_: object) -> None:
        self.disconnect()
        self._listener.close()

    def receive(self, op: str) -> dict[str, Any]:
        """Return the next request, which must have the operation `op`."""
        while b"\n" not in self._received:
            received = self._connection().recv(65536)
            assert received, f"hung up before {op}"
            self._received += received
        line, _, self._received = self._received.partition(b"\n")
        request = json.loads(line)
        assert request["op"] == op, request
        return request

    def answer(self, request: dict[str, Any], **fields: Any) -> None:
        """Answer a request."""
        self.send({"op": request["op"], **fields, "id": request["id"]})

    def send(self, *messages: dict[str, Any] | bytes) -> None:
        """Send each message as a line; bytes are sent unchanged."""
        lines = [each if isinstance(each, bytes) else json.dumps(each).encode() + b"\n" for each in messages]
        self._connection().sendall(b"".join(lines))

    def welcome(self) -> None:
        """Answer `hello` with the information of a run."""
        self.send({**HELLO, "id": self.receive("hello")["id"]})

    def disconnect(self) -> None:
        """End the connection."""
        if self._peer is not None:
            self._peer.close()
            self._peer = None

    def _connection(self) -> socket.socket:
        if self._peer is None:
            self._peer, _ = self._listener.accept()
            self._peer.settimeout(PATIENCE_S)
        return self._peer
