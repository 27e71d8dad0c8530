"""Connections: what is reported if no world answers, silent connections, and failures to listen."""

import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import pytest
import zenoh
from free_ports import free_port
from refused import has_terms, refused

from zsim.errors import NoListenerError, NoWorldError, SessionError
from zsim.scenario.scenario import DRONES_MAX
from zsim.transport import connection, zenoh_settings
from zsim.transport.connection import find_world
from zsim.transport.tls import Identity, Permissions


class Silent:
    """A session to a hub that answers nothing."""

    process = "operator.eve"
    permissions = None

    def get(self, expression: str, timeout_s: float) -> list[Any]:
        return []


@contextmanager
def silent(*_: Any, **__: Any) -> Iterator[Silent]:
    yield Silent()


def nobody(endpoint: str, *_: Any, **__: Any) -> Any:
    raise NoListenerError(f"nobody listens on {endpoint}; start a world there (it did not answer)")


def said(endpoint: str, identity: Identity | None = None) -> str:
    with pytest.raises(NoWorldError) as caught, find_world(endpoint, "zsim", 0.0, identity=identity):
        pass
    start = f"no world of federation 'zsim' on {endpoint} within 0 s"
    assert str(caught.value).startswith(start)
    return str(caught.value).removeprefix(start)


EVE = Identity("h1", Path("certs/h1/operator.eve"))
LET_IN = Permissions("world", "operator.eve", {"read": ("zsim/**",)})


@pytest.mark.parametrize(
    ("endpoint", "identity", "permissions", "told", "not_told"),
    [
        ("tls/127.0.0.1:7447", EVE, None, ("another", "refuses", "--federation"), "start one"),
        ("tls/127.0.0.1:7447", EVE, LET_IN, ("another", "--federation"), "refuses"),
        ("tcp/127.0.0.1:7447", None, None, ("another",), "admit"),
    ],
    ids=["not let in", "let in", "without certificates"],
)
def test_an_unresponsive_hub_is_reported_with_possible_reasons(
    monkeypatch: pytest.MonkeyPatch,
    endpoint: str,
    identity: Identity | None,
    permissions: Permissions | None,
    told: tuple[str, ...],
    not_told: str,
) -> None:
    monkeypatch.setattr(connection, "connect", silent)
    monkeypatch.setattr(Silent, "permissions", permissions)
    text = said(endpoint, identity)
    assert has_terms(text, *told)
    assert not_told not in text


def test_an_open_port_that_refuses_the_session_is_reported_as_possibly_tls(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "connect", nobody)
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        text = said(f"tcp/127.0.0.1:{port}")
    assert has_terms(text, "TLS", "tls/", "--tls", "FOLDER")
    assert has_terms(said(f"tcp/127.0.0.1:{port}"), "zsim world")


@pytest.mark.parametrize("endpoint", ["udp/127.0.0.1:7447", "tcp/127.0.0.1:70000", "tcp/nowhere", "unixsock-stream/x"])
def test_an_endpoint_that_cannot_be_probed_counts_as_not_listening(
    monkeypatch: pytest.MonkeyPatch, endpoint: str
) -> None:
    monkeypatch.setattr(connection, "connect", nobody)
    assert has_terms(said(endpoint), "zsim world")


# Silent connections

SILENT_CONNECTIONS = 150  # by default Zenoh accepts 100 at a time
PATIENCE_S = 120.0


def test_silent_connections_keep_no_client_out(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(zenoh_settings, "ACCEPT_MS", round(10_000 * PATIENCE_S))  # none is dropped in the meantime
    port = free_port()
    endpoint = f"tcp/127.0.0.1:{port}"
    with connection.listen([endpoint], "zsim", "lockstep"), ExitStack() as left_open:
        for _ in range(SILENT_CONNECTIONS):
            left_open.enter_context(socket.create_connection(("127.0.0.1", port)))
        with connection.connect(endpoint, "zsim", wait_s=PATIENCE_S) as link:
            assert link.links() == 1


def test_a_port_in_use_is_refused_with_the_option_for_another() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(SessionError) as caught, connection.listen([endpoint], "zsim", "lockstep"):
            pass
    assert has_terms(str(caught.value), endpoint, "--listen")


def test_a_missing_listener_raises_a_distinct_error() -> None:
    with pytest.raises(NoListenerError), connection.connect(f"tcp/127.0.0.1:{free_port()}", "zsim"):
        pass


@pytest.mark.parametrize(
    ("endpoint", "terms"),
    [
        ("tcp/192.0.2.1:7447", ("not an address of this machine", "--listen")),
        ("tcp/no-such-host.invalid:7447", ("the name is not known", "--listen")),
        ("tcp/127.0.0.1:99999", ("from 1 to 65535", "--listen")),
        ("tcp/127.0.0.1:7447#iface=no-such", ("no such network interface",)),
    ],
)
def test_every_cause_of_a_failure_to_listen_is_reported(endpoint: str, terms: tuple[str, ...]) -> None:
    identity = Identity(insecure=True)
    with (
        refused(SessionError, f"cannot listen on {endpoint}: ", *terms),
        connection.listen([endpoint], "f", "lockstep", identity),
    ):
        pass


def test_every_known_error_number_has_a_message_of_its_own() -> None:
    texts = {
        number: str(connection.no_listening(["tcp/h:1"], f"no listener: [h:1: some words (os error {number}))"))
        for number in connection._LISTEN_FAULTS
    }
    assert len(set(texts.values())) == len(texts)
    assert not any("some words" in text for text in texts.values())
    assert "some words" in str(connection.no_listening(["tcp/h:1"], "some words (os error 5)"))


def test_a_panic_in_zenoh_is_reported_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    class PanicException(BaseException):
        """Like that of pyo3, which does not export it."""

    def fail(_: Any) -> None:
        raise PanicException("failed to spawn thread: no memory")

    monkeypatch.setattr(zenoh, "open", fail)
    with (
        refused(SessionError, "tcp/127.0.0.1:7447", "spawn", "thread"),
        connection.listen(["tcp/127.0.0.1:7447"], "f", "lockstep"),
    ):
        pass


def test_the_hub_adds_no_timestamp_and_has_room_for_the_largest_run() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    stamps: SimpleQueue[str | None] = SimpleQueue()
    with (
        connection.listen([endpoint], "f", "lockstep") as hub,
        connection.connect(endpoint, "f", wait_s=PATIENCE_S) as client,
    ):
        client.declare_subscriber("own", lambda sample: stamps.put(sample.timestamp))
        while not hub.has_subscribers("own"):
            time.sleep(0.01)
        hub.put_sample("own", b"1", "")
        assert stamps.get(timeout=PATIENCE_S) is None
    assert zenoh_settings.SESSIONS_MAX > DRONES_MAX + 100  # estimators and other participants
