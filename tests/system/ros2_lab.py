"""The ROS 2 side of a federation under test: third-party participants, and a router like rmw_zenohd."""

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

import pytest
from rosbags.typesys import Stores, get_typestore
from wire import PATIENCE_S

from zsim_bridges.ros2.rmw_zenoh import MESSAGES

HERE = Path(__file__).parent
TRIGGER = {
    "kind": "std_srvs/srv/Trigger",
    "request": "uint8 structure_needs_at_least_one_member",  # how an empty request is encoded
    "response": "bool success\nstring message",
    "fields": {"structure_needs_at_least_one_member": 0},
}
ROUTER = """
import sys, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"router"')
config.insert_json5("listen/endpoints", f'["tcp/127.0.0.1:{sys.argv[1]}"]')
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config):
    print("ready", flush=True)
    sys.stdin.read()
"""


def write_definitions(folder: Path) -> Path:
    """Write the definitions of all message types for participants, which otherwise fetch them from the network."""
    store = get_typestore(Stores.ROS2_JAZZY)
    texts = {name: store.gendefhash(name, {}, 2)[0] for name in store.fielddefs if "/msg/" in name}
    for name, text in {**texts, **MESSAGES}.items():
        path = folder / f"{name}.msg"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder


class Child:
    """A process that takes requests and prints messages as lines."""

    def __init__(self, *command: str, **env: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, *command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, **env},
        )
        self.lines: list[str] = []
        self.news = threading.Condition()
        self._readers = [threading.Thread(target=self._read, daemon=True), threading.Thread(target=self._listen)]
        self._errors: list[str] = []
        for reader in self._readers:
            reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with self.news:
                self.lines.append(line)
                self.news.notify_all()

    def _listen(self) -> None:
        assert self.process.stderr is not None
        self._errors.extend(self.process.stderr)

    def write_line(self, text: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(text + "\n")
        self.process.stdin.flush()

    def wait(self, met: Callable[[], Any], what: str, within_s: float = PATIENCE_S) -> Any:
        """Call `met` after each line and return its first result that is not None."""
        until_s = time.monotonic() + within_s
        with self.news:
            while (found := met()) is None:
                left_s = until_s - time.monotonic()
                if left_s <= 0 or self.process.poll() is not None:
                    break
                self.news.wait(left_s)
        if found is None:
            pytest.fail(f"{what}: nothing within {within_s:g} s\n{''.join(self.lines[-5:])}\n{''.join(self._errors)}")
        return found

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        for reader in self._readers:
            reader.join(PATIENCE_S)
        for pipe in (self.process.stdin, self.process.stdout, self.process.stderr):
            assert pipe is not None
            pipe.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Router(Child):
    """A Zenoh router on a port, with gossip, like rmw_zenohd."""

    def __init__(self, port: int) -> None:
        super().__init__("-c", ROUTER, str(port))
        self.wait(lambda: self.lines or None, "router")


class Peer(Child):
    """A participant (see ros2_peer.py): a Zenoh peer, as ROS nodes are by default, or a client.

    Attributes:
        received: messages by topic, in order of arrival.
    """

    def __init__(self, port: int, definitions: Path, mode: str) -> None:
        override = f'mode="{mode}"' + (";listen/endpoints=[]" if mode == "client" else "")
        super().__init__(str(HERE / "ros2_peer.py"), str(port), str(definitions), ZENOH_CONFIG_OVERRIDE=override)
        self.received: dict[str, list[Any]] = {}
        self._results: list[Any] = []
        self._seen = 0
        self._result("ready")

    def request(self, op: str, **args: Any) -> Any:
        """Request an operation of the participant, and return its result."""
        self.write_line(json.dumps({"op": op, **args}))
        return self._result(op)

    def _result(self, op: str) -> Any:
        return self.wait(self._taken, op)["result"]

    def _taken(self) -> Any:
        self._sort()
        return self._results.pop(0) if self._results else None

    def _sort(self) -> None:
        for line in self.lines[self._seen :]:
            message = json.loads(line)
            if "op" in message:
                self._results.append(message)
            else:
                self.received.setdefault(message["topic"], []).append(message["message"])
        self._seen = len(self.lines)

    def receive(self, topic: str, met: Callable[[Any], bool] = lambda message: True, fresh: bool = True) -> Any:
        """Return the first message on a topic that meets a condition; if `fresh`, ignore those already received."""
        with self.news:
            self._sort()
            first = len(self.received.get(topic, [])) if fresh else 0

        def found() -> Any:
            self._sort()
            return next((message for message in self.received.get(topic, [])[first:] if met(message)), None)

        return self.wait(found, topic)

    def until(self, op: str, met: Callable[[Any], bool], **args: Any) -> Any:
        """Repeat a request until its answer meets a condition."""
        until_s = time.monotonic() + PATIENCE_S
        while not met(answer := self.request(op, **args)):
            if time.monotonic() > until_s:
                pytest.fail(f"{op}: {answer}")
        return answer
