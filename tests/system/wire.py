"""A foreign program that uses only zenoh and msgpack, according to docs/protocol.md.

with Client(endpoint) as client:
    clock = client.subscribe("clock")
    clock.until(lambda m: m["t_ns"] >= 2e9)          waits for a message, never for a fixed time
    me = client.join("tester.one", period_ns=20_000_000)
"""

import itertools
import os
import queue
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import msgpack
import pytest
import zenoh

PATIENCE_S = 120.0  # longest wait for anything, on a loaded machine
SHOWN = 6  # number of messages reported when a wait fails


class Received(NamedTuple):
    """One message as received: wall time (monotonic), key without the federation, content."""

    wall_s: float
    key: str
    message: dict[str, Any]


Wanted = Callable[[dict[str, Any]], Any]


class Subscription:
    """The messages received on one key expression, in order."""

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[Received] = queue.SimpleQueue()
        self.received: list[Received] = []

    def take(self, sample: zenoh.Sample, prefix: str) -> None:
        """Keep a message; called by Zenoh."""
        key = str(sample.key_expr).removeprefix(prefix)
        self._queue.put(Received(time.monotonic(), key, read(sample.payload.to_bytes())))

    def until(self, wanted: Wanted, within_s: float = PATIENCE_S) -> Received:
        """Return the next message that is wanted; fail if none arrives."""
        until_s = time.monotonic() + within_s
        while (left_s := until_s - time.monotonic()) > 0:
            try:
                received = self._queue.get(timeout=left_s)
            except queue.Empty:
                break
            self.received.append(received)
            if wanted(received.message):
                return received
        last = "\n".join(str(received)[:300] for received in self.received[-SHOWN:])
        return pytest.fail(f"no such message within {within_s:g} s; the last ones were\n{last}")

    def now(self) -> list[Received]:
        """Return everything received so far."""
        while not self._queue.empty():
            self.received.append(self._queue.get())
        return self.received


class Client:
    """The Zenoh session of a foreign program."""

    def __init__(self, endpoint: str, federation: str = "zsim") -> None:
        self.endpoint = endpoint
        self._prefix = f"{federation}/"
        self._kept: list[Any] = []
        self._seq: dict[str, int] = {}

    def __enter__(self) -> "Client":
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", f'["{self.endpoint}"]')
        config.insert_json5("connect/timeout_ms", str(int(1000 * PATIENCE_S)))
        config.insert_json5("connect/retry", "{period_init_ms: 50, period_max_ms: 100}")
        config.insert_json5("scouting/multicast/enabled", "false")
        self.session = zenoh.open(config)
        return self

    def __exit__(self, *_: object) -> None:
        self.session.close()

    def subscribe(self, expression: str) -> Subscription:
        """Subscribe to a key expression; messages are available in order of arrival, across all subscriptions.

        With indirect callbacks, each subscription would have its own thread, and one could lag behind another.
        """
        subscription = Subscription()

        def take(sample: zenoh.Sample) -> None:
            subscription.take(sample, self._prefix)

        direct = zenoh.handlers.Callback(take, indirect=False)
        self._kept.append(self.session.declare_subscriber(self._prefix + expression, direct))
        return subscription

    def get(self, expression: str, payload: bytes | None = None) -> dict[str, Any]:
        """Query a key expression and return the answered values by key."""
        replies = self.session.get(self._prefix + expression, payload=payload, timeout=PATIENCE_S)
        good = [reply.ok for reply in replies if reply.ok is not None]
        return {str(ok.key_expr).removeprefix(self._prefix): read(ok.payload.to_bytes()) for ok in good}

    def info(self) -> dict[str, Any]:
        """Return `world/info` of a world that may still be starting."""
        clock = self.subscribe("clock")
        found = self.get("world/info")
        if not found:
            clock.until(lambda _: True)  # a world whose time stands still publishes its clock once per second
            found = self.get("world/info")
        return found["world/info"]

    def request(self, key: str, op: str, source: str = "tester", **args: Any) -> dict[str, Any]:
        """Send a request and return its answer."""
        request = msgpack.packb({"op": op, "args": args, "source": source})
        return self.get(key, payload=request)[key]

    def put(self, key: str, **fields: Any) -> None:
        """Publish a message with the next `seq` of its key."""
        seq = self._seq.get(key, 0)
        self._seq[key] = seq + 1
        self.put_raw(key, self.pack({"seq": seq, **fields}))

    def put_raw(self, key: str, payload: bytes) -> None:
        """Publish any bytes."""
        self.session.put(self._prefix + key, payload, congestion_control=zenoh.CongestionControl.BLOCK)

    def answer(self, key: str, answer: dict[str, Any]) -> list[bytes]:
        """Answer every query on a key; return the list to which payloads of queries are appended."""
        payloads: list[bytes] = []

        def reply(query: zenoh.Query) -> None:
            payloads.append(query.payload.to_bytes() if query.payload is not None else b"")
            query.reply(self._prefix + key, msgpack.packb(answer))

        self._kept.append(self.session.declare_queryable(self._prefix + key, reply))
        return payloads

    @staticmethod
    def pack(fields: dict[str, Any]) -> bytes:
        """Return an encoded message."""
        return bytes(msgpack.packb(fields) or b"")

    def token(self, name: str) -> Any:
        """Declare the liveliness token of a process; `undeclare` it to simulate its death."""
        return self.session.liveliness().declare_token(f"{self._prefix}process/{name}")

    def join(
        self, name: str, info: dict[str, Any], period_ns: int, serves: tuple[str, ...] = (), **others: Any
    ) -> "Participant":
        """Join the run under a name, and serve other processes as well."""
        participant = Participant(self, name, {**info, **others}, period_ns)
        participant.join(serves)
        return participant


class Participant:
    """A process of the run, which a program in any language can be according to docs/protocol.md."""

    _incarnations = itertools.count(int.from_bytes(os.urandom(5), "big"))

    def __init__(self, client: Client, name: str, info: dict[str, Any], period_ns: int) -> None:
        self.client = client
        self.name = name
        self.period_ns = period_ns
        self.run = {"run_id": info["run_id"], "incarnation": next(self._incarnations)}
        self.done_ns = -period_ns
        self.sent = 0
        self.token = client.token(name)

    def join(self, serves: tuple[str, ...] = ()) -> None:
        role = self.name.split(".")[0]
        about = {"role": role, "host": "elsewhere", "pid": os.getpid(), "period_ns": self.period_ns, "serves": serves}
        self.client.put(f"process/{self.name}/join", **{"t_ns": 0, **self.run, **about})

    def done(self, t_ns: int, sent: int | None = None) -> None:
        """Publish done for a gate; unless given, `sent` is the count that the caller keeps in `self.sent`."""
        sent, self.sent, self.done_ns = self.sent if sent is None else sent, 0, t_ns
        self.client.put(f"process/{self.name}/done", t_ns=t_ns, **self.run, done_ns=t_ns, sent=sent)

    def bye(self, t_ns: int, reason: str = "shown") -> None:
        self.client.put(f"process/{self.name}/bye", t_ns=t_ns, **self.run, reason=reason)

    def die(self) -> None:
        """Undeclare the token without a bye, as if the process were killed."""
        self.token.undeclare()


def read(payload: bytes) -> dict[str, Any]:
    """Return the decoded payload, or mark it as unreadable."""
    try:
        return msgpack.unpackb(payload)
    except ValueError:
        return {"unreadable": payload}


def kinds(received: list[Received]) -> Iterator[str]:
    """Yield the kinds of the events received."""
    return (event.message["kind"] for event in received)
