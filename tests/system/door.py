"""The gateway's doors as a program meets them: sockets and HTTP of the standard library, nothing of zsim."""

import http.client
import json
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from federation import Federation, Role, free_port
from wire import PATIENCE_S


class Answer(NamedTuple):
    """What HTTP answered."""

    status: int
    headers: dict[str, str]
    body: bytes

    def json(self) -> Any:
        return json.loads(self.body)


class Stream:
    """A connection to the lines door."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), PATIENCE_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._file = self._socket.makefile("rb")

    def send(self, line: bytes) -> None:
        self._socket.sendall(line + b"\n")

    def tell(self, op: str, **fields: Any) -> None:
        self.send(json.dumps({"op": op, **fields}).encode())

    def next(self, *ops: str) -> dict[str, Any]:
        """Return the next message, of some kinds; fail when the connection ends."""
        while True:
            line = self._file.readline()
            assert line, f"the gateway closed the connection; {ops} was waited for"
            message = json.loads(line)
            if not ops or message["op"] in ops:
                return message

    def ask(self, op: str, **fields: Any) -> dict[str, Any]:
        """Return the answer to a request: what has its id."""
        self.tell(op, id="asked", **fields)
        while (message := self.next()).get("id") != "asked":
            pass
        return message

    def is_closed(self) -> bool:
        """Read to the end of the connection."""
        while self._file.readline():
            pass
        return True

    def close(self) -> None:
        self._file.close()
        self._socket.close()

    def __enter__(self) -> "Stream":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Door:
    """A gateway as a process.

    Args:
        federation: of the world that it serves.
        options: of `zsim gateway`.
    """

    def __init__(self, federation: Federation, *options: str) -> None:
        self.folder = federation.folder
        self.http_port, self.lines_port = free_port(), free_port()
        ports = ("--http", str(self.http_port), "--lines", str(self.lines_port))
        self.role: Role = federation.role("gateway", *ports, *options)
        self.role.line("HTTP and WebSocket on")

    def in_run(self) -> "Door":
        """Wait until it is in a run."""
        self.role.line("let into run")
        return self

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.http_port}"

    def stream(self) -> Stream:
        return Stream(self.lines_port)

    def http(self, method: str, path: str, body: Any = None, headers: dict[str, str] | None = None) -> Answer:
        """Return what is answered to a request; what is no bytes is sent as JSON."""
        connection = http.client.HTTPConnection("127.0.0.1", self.http_port, timeout=PATIENCE_S)
        data = body if isinstance(body, bytes) or body is None else json.dumps(body).encode()
        try:
            connection.request(method, path, data, headers or {})
            response = connection.getresponse()
            return Answer(
                response.status, {name.lower(): value for name, value in response.getheaders()}, response.read()
            )
        finally:
            connection.close()

    @contextmanager
    def events(self, path: str, headers: dict[str, str] | None = None) -> Iterator[Iterator[tuple[str, Any]]]:
        """Yield (event, data) as the server sends them."""
        connection = http.client.HTTPConnection("127.0.0.1", self.http_port, timeout=PATIENCE_S)
        try:
            connection.request("GET", path, headers={"Accept": "text/event-stream", **(headers or {})})
            response = connection.getresponse()
            assert response.headers["Content-Type"] == "text/event-stream"
            yield _events(response)
        finally:
            connection.close()


def _events(response: http.client.HTTPResponse) -> Iterator[tuple[str, Any]]:
    kind = ""
    for line in response:
        name, _, text = line.decode().rstrip("\n").partition(": ")
        if name == "event":
            kind = text
        elif name == "data":
            yield kind, json.loads(text)
