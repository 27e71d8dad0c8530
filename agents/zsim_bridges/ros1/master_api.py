"""A node's interface to its ROS master: XML-RPC calls, addresses, and a registration that survives master restarts."""

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

CALL_TIMEOUT_S = 3.0  # time limit of one call
BODY_MAX = 1_000_000  # size limit of a request [bytes]
SUCCESS = 1  # code of a successful answer
DEFAULT_MASTER = "http://127.0.0.1:11311"  # ROS's default
DEFAULT_PORT = 11311
CHECK_S = 1.0  # wall time between checks that the master still has the registration
UNREGISTER_TIMEOUT_S = 2.0  # time limit for unregistering


class ApiError(Exception):
    """An answer that is an error, or that does not have the form prescribed by ROS."""


CALL_ERRORS = (OSError, http.client.HTTPException, xmlrpc.client.Error, ExpatError, ValueError, TypeError, ApiError)
"""Errors of a call that yields no valid answer."""


class _Transport(xmlrpc.client.Transport):
    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = CALL_TIMEOUT_S
        return connection


def call_api(uri: str, method: str, *arguments: Any) -> Any:
    """Call a method of a master or a node, and return its answer's value.

    Raises:
        one of CALL_ERRORS: the peer does not answer, or refuses.
    """
    with xmlrpc.client.ServerProxy(uri, transport=_Transport()) as proxy:
        answer: Any = getattr(proxy, method)(*arguments)
    if not isinstance(answer, list) or len(answer) != 3:
        raise ApiError(f"{uri}: the answer to {method} is not [code, text, value]")
    code, text, value = answer
    if code != SUCCESS:
        raise ApiError(f"{uri}: {method}: {text}")
    return value


class _Handler(SimpleXMLRPCRequestHandler):
    timeout = 10.0  # s after which a client that sends nothing is disconnected
    protocol_version = "HTTP/1.1"

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing about clients that stay silent or do not send XML-RPC."""

    def do_POST(self) -> None:
        size = self.headers.get("content-length", "")
        if not size.isdecimal() or int(size) > BODY_MAX:
            self.close_connection = True
            self.send_error(413 if size.isdecimal() else 411)
            return
        super().do_POST()


class XmlRpcServer(ThreadingMixIn, SimpleXMLRPCServer):
    """Serves calls of an object's public methods, with one thread per connection."""

    daemon_threads = True

    def __init__(self, host: str, api: object) -> None:
        super().__init__((host, 0), _Handler, logRequests=False, allow_none=True)
        self.register_instance(api)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log nothing about a client that disconnected."""


def own_address(master_uri: str, environment: Mapping[str, str] = os.environ) -> str:
    """Return the name or address at which nodes of a master's graph reach this host.

    ROS's environment variables take precedence over the address from which this host reaches the master.

    Raises:
        RunError: the URI is invalid, its host is unknown, or there is no route to it.
    """
    try:
        parts = urlsplit(master_uri)
        scheme, host, port = parts.scheme, parts.hostname, parts.port or DEFAULT_PORT
    except ValueError:
        scheme, host, port = "", None, 0
    if host is None or scheme != "http":
        raise RunError(f"ROS master is {master_uri!r}; must be a URI such as {DEFAULT_MASTER}")
    configured = environment.get("ROS_HOSTNAME") or environment.get("ROS_IP")
    if configured:
        return configured
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((host, port))
            return probe.getsockname()[0]
    except OSError as error:
        raise RunError(
            f"ROS master {master_uri}: no route to {host} ({error}); correct --master or give --ros-host"
        ) from error


class GraphEntry(NamedTuple):
    """What a node registers: its name, the URIs of its slave API and services, its topics with types, its services."""

    caller: str
    slave_uri: str
    service_uri: str
    published: Sequence[tuple[str, str]]
    subscribed: Sequence[tuple[str, str]]
    services: Sequence[str]


class Registration:
    """Keeps a node registered from construction until `close`, or until it is displaced, in a separate thread.

    Args:
        on_publishers: called with each subscribed topic and its publishers, whenever the node has registered.
        on_displaced: called once if another node takes the name.
    """

    def __init__(
        self,
        master_uri: str,
        entry: GraphEntry,
        on_publishers: Callable[[str, list[str]], None],
        on_displaced: Callable[[str], None],
        say: Callable[[str], None],
    ) -> None:
        self._uri = master_uri
        self._entry = entry
        self._on_publishers = on_publishers
        self._on_displaced = on_displaced
        self._say = say
        self._registered = False
        self._was_registered = False
        self._may_be_registered = False
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="registration", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Unregister, if the master can be reached."""
        self._closed.set()
        self._thread.join(2 * CALL_TIMEOUT_S)
        if not self._may_be_registered:
            return
        entry, deadline_s = self._entry, time.monotonic() + UNREGISTER_TIMEOUT_S
        calls = [("unregisterService", service, entry.service_uri) for service in entry.services]
        calls += [("unregisterSubscriber", topic, entry.slave_uri) for topic, _ in entry.subscribed]
        calls += [("unregisterPublisher", topic, entry.slave_uri) for topic, _ in entry.published]
        for call in calls:
            if time.monotonic() > deadline_s:
                return
            try:
                self._call(*call)
            except ApiError:
                continue
            except CALL_ERRORS:
                return  # the master is gone, and its registrations with it

    def _run(self) -> None:
        last_success_s, next_report_s = time.monotonic(), 0.0
        while not self._closed.is_set():
            try:
                self._registered = self._registered and self._is_registered()
                if not self._registered and not self._closed.is_set():
                    self._register()
                last_success_s, next_report_s = time.monotonic(), 0.0
            except CALL_ERRORS as error:
                self._registered = False
                waited_s = time.monotonic() - last_success_s
                if waited_s >= next_report_s:
                    next_report_s = max(2 * next_report_s, 1.0)
                    self._say(f"waiting for a ROS master on {self._uri} ({waited_s:.0f} s): {error}")
            self._closed.wait(CHECK_S)

    def _is_registered(self) -> bool:
        try:
            uri = self._call("lookupNode", self._entry.caller)
        except ApiError:
            return False
        if uri != self._entry.slave_uri:
            self._closed.set()
            self._on_displaced(f"another node of this name is on {uri}")
        return True

    def _register(self) -> None:
        entry, self._may_be_registered = self._entry, True
        for topic, kind in entry.published:
            self._call("registerPublisher", topic, kind, entry.slave_uri)
        for service in entry.services:
            self._call("registerService", service, entry.service_uri, entry.slave_uri)
        for topic, kind in entry.subscribed:
            self._on_publishers(topic, self._call("registerSubscriber", topic, kind, entry.slave_uri))
        self._registered = True
        status_text = "registered again" if self._was_registered else "registered"
        self._was_registered = True
        self._say(f"{entry.caller}: {status_text} with the ROS master on {self._uri}")

    def _call(self, method: str, *arguments: Any) -> Any:
        return call_api(self._uri, method, self._entry.caller, *arguments)
