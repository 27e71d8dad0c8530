"""A gateway in a process of its own, and its clients, which use sockets and HTTP of the standard library, not zsim."""

import http.client
import json
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple

from federation import Federation, Role, free_port
from wire import PATIENCE_S


class Response(NamedTuple):
    """An HTTP response."""

    status: int
    headers: dict[str, str]
    body: bytes

    def json(self) -> Any:
        return json.loads(self.body)


class LineConnection:
    """A connection to the gateway's port for lines of JSON."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), PATIENCE_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._file = self._socket.makefile("rb")

    def send_line(self, line: bytes) -> None:
        self._socket.sendall(line + b"\n")

    def send(self, op: str, **fields: Any) -> None:
        """Send a request without waiting for its response."""
        self.send_line(json.dumps({"op": op, **fields}).encode())

    def next(self, *ops: str) -> dict[str, Any]:
        """Return the next message, of any or of the given kinds; fail if the connection ends."""
        while True:
            line = self._file.readline()
            assert line, f"the gateway closed the connection; {ops} was waited for"
            message = json.loads(line)
            if not ops or message["op"] in ops:
                return message

    def request(self, op: str, **fields: Any) -> dict[str, Any]:
        """Send a request; return the response, which is the message with the same id."""
        self.send(op, id="requested", **fields)
        while (message := self.next()).get("id") != "requested":
            pass
        return message

    def is_at_end(self) -> bool:
        """Read until the connection ends, possibly by a reset because the gateway closed it with requests unread."""
        with suppress(ConnectionError):
            while self._file.readline():
                pass
        return True

    def close(self) -> None:
        self._file.close()
        self._socket.close()

    def __enter__(self) -> "LineConnection":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class GatewayProcess:
    """A gateway that runs as a process.

    Args:
        federation: federation of the world that it serves.
        options: options of `zsim gateway`.
    """

    def __init__(self, federation: Federation, *options: str) -> None:
        self.folder = federation.folder
        self.http_port, self.lines_port = free_port(), free_port()
        ports = ("--http", str(self.http_port), "--lines", str(self.lines_port))
        self.role: Role = federation.role("gateway", *ports, *options)
        self.role.line("HTTP and WebSocket on")

    def in_run(self) -> "GatewayProcess":
        """Wait until it takes part in a run; return it."""
        self.role.line("may use run")
        return self

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.http_port}"

    def connect(self) -> LineConnection:
        return LineConnection(self.lines_port)

    def http(self, method: str, path: str, body: Any = None, headers: dict[str, str] | None = None) -> Response:
        """Return the response to a request; a body that is not bytes is sent as JSON."""
        connection = http.client.HTTPConnection("127.0.0.1", self.http_port, timeout=PATIENCE_S)
        data = body if isinstance(body, bytes) or body is None else json.dumps(body).encode()
        try:
            connection.request(method, path, data, headers or {})
            response = connection.getresponse()
            names = {name.lower(): value for name, value in response.getheaders()}
            return Response(response.status, names, response.read())
        finally:
            connection.close()

    @contextmanager
    def events(self, path: str, headers: dict[str, str] | None = None) -> Iterator[Iterator[tuple[str, Any]]]:
        """Yield an iterator over (event, data) as the server sends them."""
        connection = http.client.HTTPConnection("127.0.0.1", self.http_port, timeout=PATIENCE_S)
        try:
            connection.request("GET", path, headers={"Accept": "text/event-stream", **(headers or {})})
            response = connection.getresponse()
            assert response.headers["Content-Type"] == "text/event-stream"
            yield _events(response)
        finally:
            connection.close()


def _events(response: http.client.HTTPResponse) -> Iterator[tuple[str, Any]]:
    event = ""
    for line in response:
        name, _, text = line.decode().rstrip("\n").partition(": ")
        if name == "event":
            event = text
        elif name == "data":
            yield event, json.loads(text)
