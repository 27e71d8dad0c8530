"""The states of a run that the gateway reports to its clients, and the limit of unauthenticated clients."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from zsim_bridges.gateway.client_messages import TooManyError
from zsim_bridges.gateway.client_streams import Outbox
from zsim_bridges.gateway.gateway_server import UNAUTHENTICATED_MAX, Gateway, GatewayPorts


class StateLog:
    """A client that records the states that it is sent."""

    def __init__(self) -> None:
        self.states: list[tuple[str, str]] = []

    def notify_run(self, state: str, run_id: str) -> None:
        self.states.append((state, run_id))


@pytest.fixture
def gateway() -> Iterator[Gateway]:
    gateway = Gateway(GatewayPorts("127.0.0.1", 0, 0), "gateway.main", None, dial=never, say=print)
    yield gateway
    gateway.loop.close()


@pytest.fixture
def log(gateway: Gateway) -> StateLog:
    log = StateLog()
    gateway._clients.add(log)  # type: ignore[arg-type]
    return log


def test_the_oldest_unauthenticated_client_makes_room_for_the_next(gateway: Gateway) -> None:
    outboxes = [Outbox(lambda: None, lambda count: b"") for _ in range(UNAUTHENTICATED_MAX + 1)]
    clients = [gateway._new_client(outbox, authenticated=False) for outbox in outboxes]
    lines = [gateway.loop.run_until_complete(outbox.take()) for outbox in (outboxes[0],)]
    assert b"hello" in lines[0][0]
    assert clients[0] not in gateway._clients
    assert set(clients[1:]) <= gateway._clients
    with pytest.raises(TooManyError):
        gateway.admit(clients[0])
    gateway.admit(clients[-1])


def test_a_world_that_leaves_after_the_end_of_its_run_is_not_lost(gateway: Gateway, log: StateLog) -> None:
    first = a_run("first")
    gateway._begin(first)
    for up in (True, False, True):  # a link that is up at the beginning is not reported
        gateway._notify_link(first, up)
    gateway._end(first)
    gateway._notify_link(first, False)
    gateway._begin(a_run("second"))
    gateway._notify_link(first, False)
    assert log.states == [
        ("begun", "first"),
        ("lost", "first"),
        ("back", "first"),
        ("ended", "first"),
        ("begun", "second"),
    ]


def test_a_lost_link_is_back_before_another_run_ends_its_run(gateway: Gateway, log: StateLog) -> None:
    first = a_run("first")
    gateway._begin(first)
    gateway._notify_link(first, False)
    gateway._end(first, has_successor=True)
    gateway._notify_link(first, True)  # the late report of the link itself
    assert [state for state, _ in log.states] == ["begun", "lost", "back", "ended"]


def test_a_link_lost_before_it_is_observed_is_reported(gateway: Gateway, log: StateLog) -> None:
    """A world may die between the beginning of a run and the first check of its link."""

    class DeadLink:
        def on_link(self, callback: Any) -> None:
            pass  # without a link, there is no event

        def links(self) -> int:
            return 0

    run = a_run("first", link=DeadLink())
    gateway._begin(run)
    gateway._observe_link(run)
    gateway.loop.call_soon(gateway.loop.stop)
    gateway.loop.run_forever()
    assert [state for state, _ in log.states] == ["begun", "lost"]


def a_run(run_id: str, link: Any = None) -> Any:
    return SimpleNamespace(link=link, unprefixed_link=None, info=SimpleNamespace(run_id=run_id))


def never(_: str) -> Any:
    raise AssertionError("nobody joins here")
