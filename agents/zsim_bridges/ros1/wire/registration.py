"""A node's place at its ROS master, taken again when the master has been restarted."""

import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from zsim_bridges.ros1.wire import xmlrpc

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
        self._thread.join(2 * xmlrpc.TIMEOUT_S)
        if self._may_be_known:
            self._unregister(time.monotonic() + UNREGISTER_S)

    def _run(self) -> None:
        since_s, next_say_s = time.monotonic(), 0.0
        while not self._closed.is_set():
            try:
                self._check()
                since_s, next_say_s = time.monotonic(), 0.0
            except xmlrpc.CALL_ERRORS as error:
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
        except xmlrpc.ApiError:
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
            except xmlrpc.ApiError:
                continue
            except xmlrpc.CALL_ERRORS:
                return  # the master is gone, and with it what it knew

    def _call(self, method: str, *arguments: Any) -> Any:
        return xmlrpc.call_api(self._uri, method, self._entry.caller, *arguments)
