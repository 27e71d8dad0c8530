"""The link watch closes the link of a stalled reader that no process waits for, and no other."""

import os
import socket
import struct
import sys

import pytest
from fake_link import FakeLink

from zsim.contract import keys
from zsim.transport.link_watch import (
    BACKLOG_MAX_BYTES,
    CLOSURES_MAX,
    EXCLUSION_S,
    LOOK_S,
    REPORT_PERIOD_S,
    STALL_BYTES,
    STALL_S,
    Awaited,
    LinkSockets,
    LinkWatch,
    Progress,
    SessionTokens,
)
from zsim.transport.session import FarEnd

READER, RECORDER, ROUTER, ESTIMATOR = (f"10.0.0.{number}:{number}" for number in range(1, 5))
FAR_ENDS = {READER: FarEnd("r", False), RECORDER: FarEnd("rec", False), ROUTER: FarEnd("x", True)}


class Sockets:
    """Connections that hold back as many bytes as a test sets."""

    def __init__(self) -> None:
        self.held: dict[str, int] = {}
        self.taken: dict[str, int] = {}
        self.round_trip_s = 0.0
        self.closed: list[str] = []

    def queued(self) -> dict[str, int]:
        return dict(self.held)

    def progress(self, address: str) -> Progress:
        return Progress(self.taken.get(address, 0), self.round_trip_s)

    def close(self, address: str) -> None:
        self.closed.append(address)
        self.held.pop(address)


class Case:
    """A hub linked to a reader, to the recorder, which is waited for, and to a router."""

    def __init__(self) -> None:
        self.link, self.sockets, self.wall_s = FakeLink(), Sockets(), 100.0
        self.link.ends = dict(FAR_ENDS)
        self.awaited = [Awaited(("recorder",), 7)]
        tokens = SessionTokens(self.link)  # type: ignore[arg-type]
        tokens.watch()
        self.link.show(keys.session_token("recorder", "rec"))
        self.watch = LinkWatch(self.link, tokens, lambda: self.awaited, self.sockets, lambda: self.wall_s)  # type: ignore[arg-type]

    def passes(self, wall_s: float, taken: int = 0) -> None:
        """Let time pass in steps, with a check after each; each far end takes `taken` bytes per step."""
        for _ in range(round(wall_s / LOOK_S)):
            self.wall_s += LOOK_S
            self.sockets.taken = {each: self.sockets.taken.get(each, 0) + taken for each in FAR_ENDS}
            self.watch.look()


def test_a_stalled_reader_is_closed_and_an_awaited_process_only_reported():
    case = Case()
    case.sockets.held = {READER: STALL_BYTES, RECORDER: 100 * BACKLOG_MAX_BYTES, ROUTER: 100 * BACKLOG_MAX_BYTES}
    case.passes(STALL_S + 2 * LOOK_S)
    assert case.sockets.closed == [READER]
    (closed,) = case.watch.closed
    assert (closed.names, closed.held_bytes, closed.times) == ((), STALL_BYTES, 1)
    assert case.watch.stuck() == [f"recorder at {RECORDER}", f"a router at {ROUTER}"]


def test_of_two_awaited_processes_only_the_stalled_one_is_stuck():
    """After a host has vanished, for example, the others have much to read at that moment too, and read it."""
    case = Case()
    case.awaited.append(Awaited(("estimator.d1",), 8))
    case.link.ends[ESTIMATOR] = FarEnd("e", False)
    case.link.show(keys.session_token("estimator.d1", "e"))
    case.sockets.held = {RECORDER: 10 * BACKLOG_MAX_BYTES, ESTIMATOR: BACKLOG_MAX_BYTES}
    case.passes(2.0, taken=1)  # by the links that the case began with
    assert case.watch.stuck() == [f"estimator.d1 at {ESTIMATOR}"]
    assert case.sockets.closed == []


@pytest.mark.parametrize(("held_bytes", "closed"), [(STALL_BYTES, []), (BACKLOG_MAX_BYTES, [READER])])
def test_a_slow_reader_is_closed_only_if_it_never_catches_up(held_bytes: int, closed: list[str]):
    case = Case()
    case.sockets.held = {READER: held_bytes}
    case.passes(10.0, taken=1)
    assert case.sockets.closed == closed


def test_a_long_round_trip_is_allowed_for():
    case = Case()
    case.sockets.round_trip_s = 0.6
    case.sockets.held = {READER: STALL_BYTES}
    case.passes(1.0)
    assert case.sockets.closed == []
    case.passes(1.0)
    assert case.sockets.closed == [READER]


def test_no_link_is_closed_while_an_awaited_process_may_be_behind_any():
    case = Case()
    case.awaited.append(Awaited(("estimator.d1",), 8))  # a user's own program, which does not show its session
    case.sockets.held = {READER: BACKLOG_MAX_BYTES}
    case.passes(2.0)
    assert case.sockets.closed == []
    case.link.show(keys.session_token("estimator.d1", "e"))
    case.passes(2.0)
    assert case.sockets.closed == [READER]


def test_a_local_awaited_process_is_identified_by_its_pid():
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()) as reader:
        case, here = Case(), "{}:{}".format(*reader.getsockname())
        case.awaited.append(Awaited(("estimator.d1",), os.getpid()))
        case.link.ends[here] = FarEnd("r", False)
        case.sockets.held = {here: BACKLOG_MAX_BYTES}
        case.passes(2.0)
        assert case.sockets.closed == []
        case.awaited[-1] = Awaited(("estimator.d1",), os.getpid() + 1)
        case.passes(2.0)
        assert case.sockets.closed == [here]
        assert case.watch.closed[0].process.startswith(f"pid {os.getpid()} ")


def test_a_reader_that_stalls_repeatedly_is_kept_out_for_a_while():
    case = Case()
    for _ in range(CLOSURES_MAX):
        case.sockets.held = {READER: BACKLOG_MAX_BYTES}
        case.passes(2.0)
    assert len(case.sockets.closed) == CLOSURES_MAX
    case.sockets.held = {READER: 0}
    case.passes(2.0)
    assert len(case.sockets.closed) == CLOSURES_MAX + 1
    case.passes(2 * EXCLUSION_S)
    case.sockets.held = {READER: 0}
    case.passes(2.0)
    assert len(case.sockets.closed) == CLOSURES_MAX + 1


def test_a_reader_that_is_kept_out_loses_its_other_links_at_once():
    case, other = Case(), "192.168.1.2:41999"
    case.link.ends[other] = case.link.ends[READER]
    for number in range(CLOSURES_MAX):
        case.sockets.held = {READER: BACKLOG_MAX_BYTES, **({other: 0} if number == CLOSURES_MAX - 1 else {})}
        while READER in case.sockets.held:
            case.passes(LOOK_S)
    assert case.sockets.closed == [READER] * CLOSURES_MAX + [other]


def test_closed_links_of_a_session_are_reported_at_intervals_with_a_count():
    case = Case()
    for _ in range(CLOSURES_MAX - 1):
        case.sockets.held = {READER: BACKLOG_MAX_BYTES}
        case.passes(1.0)
    assert [closed.times for closed in case.watch.closed] == [1]
    case.passes(REPORT_PERIOD_S)
    case.sockets.held = {READER: BACKLOG_MAX_BYTES}
    case.passes(1.0)
    assert [closed.times for closed in case.watch.closed] == [1, CLOSURES_MAX]


def test_a_session_that_is_kept_out_is_reported_only_if_it_holds_data_back():
    case = Case()
    for _ in range(CLOSURES_MAX):
        case.sockets.held = {READER: BACKLOG_MAX_BYTES}
        case.passes(1.0)
    case.watch.closed.clear()
    case.passes(REPORT_PERIOD_S)
    case.sockets.held = {READER: STALL_BYTES - 1}
    case.passes(1.0)
    assert len(case.sockets.closed) == CLOSURES_MAX + 1
    assert list(case.watch.closed) == []


# Connections of this process as the kernel lists them


LINGER = struct.Struct("ii")  # socket(7): whether to linger, and for how many seconds


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux shows a process its connections")
def test_an_observed_connection_does_not_linger_when_closed() -> None:
    """Closing a connection that lingers blocks for that long while the far end reads nothing."""
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()) as near:
        near.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, LINGER.pack(1, 10))
        host, port = near.getpeername()
        assert f"{host}:{port}" in LinkSockets().queued()
        lingers, _ = LINGER.unpack(near.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, LINGER.size))
        assert not lingers
