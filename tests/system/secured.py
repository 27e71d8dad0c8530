"""A secured federation on loopback: certificates, a hub with access control, and clients that try everything.

A refused client receives no error, so the receiving end shows what was allowed: every series of attempts ends with an
allowed message (a fence), and whatever has not arrived by then was refused.
"""

import itertools
import json
import queue
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zenoh
from federation import free_port
from rights_table import ROLES, SCENARIO
from wire import PATIENCE_S

from zsim.scenario import scenario_file
from zsim.transport import connection
from zsim.transport.tls import Identity
from zsim_deploy import certificates
from zsim_deploy.certificates import CertificateRequest, access_control

HOST = "lab"
SITE = "router.site"
PREFIX = "zsim/"
READY = b"ready"  # payload published to find out whether a subscriber receives it
SHORT_S = 1.0  # wait for a link that should be refused

_numbers = itertools.count()


class Certificates:
    """A certificate authority and the certificates that it has issued, in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._now = datetime.now(UTC)
        self._authority = certificates.authority(folder, self._now)

    def of(self, process: str, days: float = certificates.DAYS, host: str = HOST) -> Path:
        """Issue a new certificate for a process and return its folder."""
        return certificates.issue(self.folder, self._authority, CertificateRequest(host, process), self._now, days)

    def identity(self, process: str, rules: dict[str, Any] | None = None) -> Identity:
        """Return the identity of a process, with access control if rules are given."""
        access = None
        if rules is not None:
            access = self.folder / f"{process}.{next(_numbers)}.access.json"
            access.write_text(json.dumps(rules))
        return Identity(HOST, self.of(process), access)


def tls_endpoint(host: str = "127.0.0.1") -> str:
    return f"tls/{host}:{free_port(host)}"


@contextmanager
def hub(made: Certificates, clients: Iterable[str] = ROLES, behind: Iterable[str] = ()) -> Iterator[tuple[str, Any]]:
    """Yield the endpoint and the session of a world that admits clients, and a router with those behind it."""
    rules = access_control(scenario_file.from_text(SCENARIO), clients, {SITE: behind} if behind else {})
    endpoint = tls_endpoint()
    with connection.listen([endpoint], "zsim", "lockstep", made.identity("world", rules)) as link:
        yield endpoint, link


@contextmanager
def site(made: Certificates, upstream: str, clients: Iterable[str] = ROLES) -> Iterator[str]:
    """Yield the endpoint of a router once it is connected to a world."""
    rules = access_control(scenario_file.from_text(SCENARIO), clients, {}, ["world"])
    endpoint = tls_endpoint()
    with connection.route(endpoint, upstream, "zsim", "lockstep", made.identity(SITE, rules)) as link:
        up: queue.SimpleQueue[bool] = queue.SimpleQueue()
        link.on_link(up.put)
        assert up.get(timeout=PATIENCE_S)
        yield endpoint


class RawClient:
    """A program, with or without a certificate, that uses Zenoh directly."""

    def __init__(self, endpoint: str, tls: Path | None, within_s: float = PATIENCE_S) -> None:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([endpoint]))
        config.insert_json5("connect/timeout_ms", str(int(1000 * within_s)))
        config.insert_json5("connect/retry", "{period_init_ms: 50, period_max_ms: 100}")
        config.insert_json5("scouting/multicast/enabled", "false")
        for name, value in self._tls(tls).items():
            config.insert_json5(f"transport/link/tls/{name}", json.dumps(value))
        self.session = zenoh.open(config)
        self._kept: list[Any] = []

    @staticmethod
    def _tls(folder: Path | None) -> dict[str, Any]:
        if folder is None:
            return {}
        settings: dict[str, Any] = {"root_ca_certificate": str(folder / "ca.pem")}
        if (folder / "key.pem").exists():
            settings["enable_mtls"] = True
            settings["connect_certificate"] = str(folder / "certificate.pem")
            settings["connect_private_key"] = str(folder / "key.pem")
        return settings

    def __enter__(self) -> "RawClient":
        return self

    def __exit__(self, *_: object) -> None:
        self.session.close()

    def put(self, key: str) -> None:
        self.session.put(PREFIX + key, key.encode(), congestion_control=zenoh.CongestionControl.BLOCK)

    def publish(self, key: str) -> None:
        """Publish as zsim does, through a declared publisher."""
        publisher = self.session.declare_publisher(PREFIX + key, congestion_control=zenoh.CongestionControl.BLOCK)
        self._kept.append(publisher)
        publisher.put(key.encode())

    def subscribe(self, expression: str, received: "KeyLog") -> None:
        callback = zenoh.handlers.Callback(received.sample, indirect=False)
        self._kept.append(self.session.declare_subscriber(PREFIX + expression, callback))

    def ask(self, key: str, received: "KeyLog") -> None:
        """Send a get without waiting for an answer."""
        callback = zenoh.handlers.Callback(received.reply, indirect=False)
        self.session.get(PREFIX + key, callback, timeout=PATIENCE_S)

    def answer(self, key: str) -> None:
        def reply(query: zenoh.Query) -> None:
            with query:
                query.reply(query.key_expr, key.encode())

        self._kept.append(self.session.declare_queryable(PREFIX + key, zenoh.handlers.Callback(reply, indirect=False)))

    def token(self, key: str) -> None:
        self._kept.append(self.session.liveliness().declare_token(PREFIX + key))

    def subscribe_tokens(self, expression: str, received: "KeyLog") -> None:
        callback = zenoh.handlers.Callback(received.sample, indirect=False)
        self._kept.append(self.session.liveliness().declare_subscriber(PREFIX + expression, callback, history=True))

    def request(self, key: str, op: str, **args: Any) -> dict[str, Any]:
        """Return the answer to a request; fail if there is none."""
        payload = bytes(msgpack.packb({"op": op, "args": args, "source": "client"}) or b"")
        replies = self.session.get(PREFIX + key, payload=payload, timeout=PATIENCE_S)
        return msgpack.unpackb(next(reply.ok for reply in replies if reply.ok is not None).payload.to_bytes())

    def settle(self, key: str = "clock") -> None:
        """Wait until the hub answers a get: by then all earlier declarations on this link have arrived."""
        replies = [reply for reply in self.session.get(PREFIX + key, timeout=PATIENCE_S) if reply.ok is not None]
        assert replies, f"no answer on {key}"

    def until_answered(self, key: str) -> None:
        """Repeat a get until it is answered: a router may not know a new queryable at once."""
        until_s = time.monotonic() + PATIENCE_S
        while not any(reply.ok is not None for reply in self.session.get(PREFIX + key, timeout=1.0)):
            assert time.monotonic() < until_s, f"nobody answers on {key}"

    def publish_until_received(self, key: str, received: "KeyLog") -> None:
        """Publish until a sample is received: a router may not know a new subscriber at once."""
        until_s = time.monotonic() + PATIENCE_S
        while not received.take_one(within_s=0.1):
            assert time.monotonic() < until_s, f"nobody receives {key}"
            self.session.put(PREFIX + key, READY, congestion_control=zenoh.CongestionControl.BLOCK)


class KeyLog:
    """Received keys, in order of arrival.

    Args:
        only: payload of the samples to log; None for all samples.
    """

    def __init__(self, only: bytes | None = None) -> None:
        self._only = only
        self._queue: queue.SimpleQueue[str] = queue.SimpleQueue()

    def take(self, key: str) -> None:
        self._queue.put(key)

    def sample(self, sample: zenoh.Sample) -> None:
        if self._only in (None, sample.payload.to_bytes()):
            self.take(str(sample.key_expr).removeprefix(PREFIX))

    def reply(self, reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            self.sample(reply.ok)

    def take_one(self, within_s: float) -> bool:
        """Take one key; return whether one arrived in time."""
        try:
            self._queue.get(timeout=within_s)
        except queue.Empty:
            return False
        return True

    def until(self, done: Callable[[set[str]], bool]) -> set[str]:
        """Return the received keys once they are `done`; fail if they never are."""
        came: set[str] = set()
        while not done(came):
            try:
                came.add(self._queue.get(timeout=PATIENCE_S))
            except queue.Empty:
                pytest.fail(f"waited in vain; {len(came)} came: {sorted(came)}")
        return came

    def until_fence(self, fence: str) -> set[str]:
        return self.until(lambda came: fence in came)
