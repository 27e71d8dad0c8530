"""XML-RPC as ROS 1 uses it: calls that answer [code, text, value], and a server of them.

Where a ROS master is, and under which address it and its nodes reach us.

A node's place at its ROS master, taken again when the master has been restarted.
"""

import http.client
import os
import socket
import threading
import time
import xmlrpc.client
from collections.abc import Callable, Mapping, Sequence
from socketserver import ThreadingMixIn
from typing import Any, NamedTuple
from urllib.parse import urlsplit
from xml.parsers.expat import ExpatError
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

from zsim.errors import RunError

TIMEOUT_S = 3.0  # of one call
BODY_MAX = 1_000_000  # bytes of a request
DONE = 1  # code of an answer


class ApiError(Exception):
    """An answer that refuses, or is none of ROS."""


CALL_ERRORS = (OSError, http.client.HTTPException, xmlrpc.client.Error, ExpatError, ValueError, TypeError, ApiError)
"""What a call ends with where it is not answered."""


class _Transport(xmlrpc.client.Transport):
    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = TIMEOUT_S
        return connection


def call_api(uri: str, method: str, *arguments: Any) -> Any:
    """Return the value that a master or a node answers.

    Raises:
        one of FAULTS: it does not answer, or refuses.
    """
    with xmlrpc.client.ServerProxy(uri, transport=_Transport()) as proxy:
        answer: Any = getattr(proxy, method)(*arguments)
    if not isinstance(answer, list) or len(answer) != 3:
        raise ApiError(f"{uri}: {method} answers no [code, text, value]")
    code, text, value = answer
    if code != DONE:
        raise ApiError(f"{uri}: {method}: {text}")
    return value


class _Handler(SimpleXMLRPCRequestHandler):
    timeout = 10.0  # s, of a client that is silent
    protocol_version = "HTTP/1.1"

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing of clients that are silent or talk nonsense."""

    def do_POST(self) -> None:
        size = self.headers.get("content-length", "")
        if not size.isdecimal() or int(size) > BODY_MAX:
            self.close_connection = True
            self.send_error(413 if size.isdecimal() else 411)
            return
        super().do_POST()


class XmlRpcServer(ThreadingMixIn, SimpleXMLRPCServer):
    """Answers calls on an object's methods, each connection in a thread of its own."""

    daemon_threads = True

    def __init__(self, host: str, api: object) -> None:
        super().__init__((host, 0), _Handler, logRequests=False, allow_none=True)
        self.register_instance(api)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a client that broke off."""


DEFAULT_MASTER = "http://127.0.0.1:11311"  # ROS's own
DEFAULT_PORT = 11311


def own_address(master_uri: str, environment: Mapping[str, str] = os.environ) -> str:
    """Return the name or address under which nodes of a master's graph reach this host.

    ROS's own variables come first, then the address from which this host reaches the master.

    Raises:
        RunError: the URI is none, or its host is unknown.
    """
    host, port = master_address(master_uri)
    given = environment.get("ROS_HOSTNAME") or environment.get("ROS_IP")
    if given:
        return given
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((host, port))
            return probe.getsockname()[0]
    except OSError as error:
        raise RunError(
            f"ROS master {master_uri}: no way to {host} ({error}); correct --master or give --ros-host"
        ) from error


def master_address(uri: str) -> tuple[str, int]:
    """Return host and port of a master.

    Raises:
        RunError: it is no URI of a master.
    """
    try:
        parts = urlsplit(uri)
        scheme, host, port = parts.scheme, parts.hostname, parts.port or DEFAULT_PORT
    except ValueError:
        scheme, host, port = "", None, 0
    if host is None or scheme != "http":
        raise RunError(f"ROS master is {uri!r}; must be such as {DEFAULT_MASTER}")
    return host, port


CHECK_S = 1.0  # wall time between two looks whether the master still knows us
UNREGISTER_S = 2.0  # in which to take leave of a master


class GraphEntry(NamedTuple):
    """What a node is to be known for.

    Attributes:
        caller: its name.
        slave_uri: of its slave API.
        service_uri: where its services are.
        published, subscribed: topics and their types.
        services: names.
    """

    caller: str
    slave_uri: str
    service_uri: str
    published: Sequence[tuple[str, str]]
    subscribed: Sequence[tuple[str, str]]
    services: Sequence[str]


class Registration:
    """Runs in a thread of its own.

    Args:
        master_uri: of the master.
        place: what to be known for.
        found: takes a topic and those who publish it, whenever we have registered.
        displaced: called once when another node has taken our name.
        say: told what a person should know.
    """

    def __init__(
        self,
        master_uri: str,
        place: GraphEntry,
        found: Callable[[str, list[str]], None],
        displaced: Callable[[str], None],
        say: Callable[[str], None],
    ) -> None:
        self._uri = master_uri
        self._entry = place
        self._on_publishers = found
        self._on_displaced = displaced
        self._say = say
        self._known = False
        self._was_known = False
        self._may_be_known = False
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="registration", daemon=True)

    def start(self) -> None:
        """Begin to look for the master."""
        self._thread.start()

    def close(self) -> None:
        """Take leave of the master, if it is there."""
        self._closed.set()
        self._thread.join(2 * TIMEOUT_S)
        if self._may_be_known:
            self._unregister(time.monotonic() + UNREGISTER_S)

    def _run(self) -> None:
        since_s, next_say_s = time.monotonic(), 0.0
        while not self._closed.is_set():
            try:
                self._check()
                since_s, next_say_s = time.monotonic(), 0.0
            except CALL_ERRORS as error:
                self._known = False
                waited_s = time.monotonic() - since_s
                if waited_s >= next_say_s:
                    next_say_s = max(2 * next_say_s, 1.0)
                    self._say(f"waiting for a ROS master on {self._uri} ({waited_s:.0f} s): {error}")
            self._closed.wait(CHECK_S)

    def _check(self) -> None:
        """Register, or see whether the master still knows us."""
        if self._known and not self._is_known():
            self._known = False
        if not self._known and not self._closed.is_set():
            self._register()
            self._known = True
            again = "registered again" if self._was_known else "registered"
            self._was_known = True
            self._say(f"{self._entry.caller}: {again} with the ROS master on {self._uri}")

    def _is_known(self) -> bool:
        try:
            uri = self._call("lookupNode", self._entry.caller)
        except ApiError:
            return False
        if uri != self._entry.slave_uri:
            self._closed.set()
            self._on_displaced(f"another node of this name is on {uri}")
        return True

    def _register(self) -> None:
        place, self._may_be_known = self._entry, True
        for topic, kind in place.published:
            self._call("registerPublisher", topic, kind, place.slave_uri)
        for service in place.services:
            self._call("registerService", service, place.service_uri, place.slave_uri)
        for topic, kind in place.subscribed:
            self._on_publishers(topic, self._call("registerSubscriber", topic, kind, place.slave_uri))

    def _unregister(self, until_s: float) -> None:
        place = self._entry
        calls = [("unregisterService", service, place.service_uri) for service in place.services]
        calls += [("unregisterSubscriber", topic, place.slave_uri) for topic, _ in place.subscribed]
        calls += [("unregisterPublisher", topic, place.slave_uri) for topic, _ in place.published]
        for call in calls:
            if time.monotonic() > until_s:
                return
            try:
                self._call(*call)
            except ApiError:
                continue
            except CALL_ERRORS:
                return  # the master is gone, and with it what it knew

    def _call(self, method: str, *arguments: Any) -> Any:
        return call_api(self._uri, method, self._entry.caller, *arguments)
