"""Bounds what one link of the hub holds back: who takes nothing, and is waited for by nobody, loses its link.

Zenoh knows two ways for a full link: drop what is for it, or block the sender and with it everybody, for all readers of
a key alike. Participants must lose nothing, so everything blocks; a reader that nobody waits for is therefore cut off
before its link is full, or at once if it comes back and does so again.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from zsim.transport.link_sockets import LinkSockets
from zsim.transport.peer_process import command, local_socket, owner
from zsim.transport.session import FarEnd, Session
from zsim.transport.session_tokens import SessionTokens

LOOK_S = 0.05  # wall time between two looks
# Zenoh's thread that closes links is also the one that passes on what participants publish. Once that is blocked by a
# full link, the link stays for HUB_CLOSE_AFTER_US: so it has to be closed before, while the kernel still takes more.
STALL_BYTES = 1 << 16  # unacknowledged, from which on a link is looked at; the kernel takes 0.4 MB at least (measured)
STALL_S = 0.1  # wall time in which a far end that lives acknowledges something, beside …
ROUND_TRIPS = 3.0  # … so many of its round trips
HELD_BYTES, HELD_S = 1 << 20, 1.0  # one that takes something all the time, but never catches up
FRESH_S = 0.2  # between two looks at who is at which far end
SPARED, SPARED_S = 3, 60.0  # times within so long that the link of a session is closed before it is kept out …
TOLD_S = 10.0  # between two reports of one session
KEPT_OUT_S = 30.0  # … for so long


class Awaited(NamedTuple):
    """A process that is waited for.

    Attributes:
        names: its own, and those whose work it does.
        pid: as it joined.
    """

    names: tuple[str, ...]
    pid: int


class ClosedLink(NamedTuple):
    """A link that was closed.

    Attributes:
        address: of its far end.
        process: at that end, by pid and command, if it is on this machine.
        names: of the processes that its session stands for.
        held_bytes: what it held back in the kernel.
        times: that a link of its session was closed so far.
    """

    address: str
    process: str
    names: tuple[str, ...]
    held_bytes: int
    times: int


@dataclass
class _Backlog:
    """Of one link: since when it takes nothing, and since when it has too much."""

    acknowledged: int
    moved_s: float
    low_s: float


class LinkWatch:
    """Watches the links of the hub, in a thread of its own while it is entered.

    Args:
        link: the listening session.
        tokens: of all processes.
        awaited: returns who takes part in a way that they must not lose anything.
        sockets: of this process.
        wall_s: monotonic.

    Attributes:
        closed: links that were closed, in order, one of a session in TOLD_S; to be taken from it.
    """

    def __init__(
        self,
        link: Session,
        tokens: SessionTokens,
        awaited: Callable[[], list[Awaited]],
        sockets: LinkSockets | None = None,
        wall_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._link = link
        self._tokens = tokens
        self._awaited = awaited
        self._sockets = sockets or LinkSockets()
        self._wall_s = wall_s
        self._backlogs: dict[str, _Backlog] = {}
        self._far_ends: dict[str, FarEnd] = {}
        self._refreshed_s = -FRESH_S
        self._times: dict[str, list[float]] = {}  # at which links of a session were closed
        self._told_s: dict[str, float] = {}  # when a link of a session was last reported
        self._kept_out_s: dict[str, float] = {}
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="links", daemon=True)
        self.closed: deque[ClosedLink] = deque()

    def __enter__(self) -> "LinkWatch":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._over.wait(LOOK_S):
            self.look()

    def look(self) -> None:
        """Look at all links once, and close those that have to be."""
        now_s, queued = self._wall_s(), self._sockets.queued()
        self._backlogs = {address: self._backlogs[address] for address in queued if address in self._backlogs}
        for address, held_bytes in queued.items():
            if self._holds_up(address, held_bytes, now_s) or self._is_kept_out(address, now_s):
                self._judge(address, held_bytes, now_s)

    def stuck(self) -> list[str]:
        """Return who is at the far end of the links that take nothing, the fullest first."""
        queued, before_s = self._sockets.queued(), self._wall_s() - STALL_S
        standing = [address for address, backlog in self._backlogs.copy().items() if backlog.moved_s <= before_s]
        full = sorted(standing, key=lambda address: -queued.get(address, 0))
        return [" ".join((*self._who(address), f"at {address}")) for address in full]

    def _holds_up(self, address: str, held_bytes: int, now_s: float) -> bool:
        if held_bytes < STALL_BYTES:
            self._backlogs.pop(address, None)
            return False
        acknowledged, round_trip_s = self._sockets.progress(address)
        backlog = self._backlogs.setdefault(address, _Backlog(acknowledged, now_s, now_s))
        if acknowledged != backlog.acknowledged:
            backlog.acknowledged, backlog.moved_s = acknowledged, now_s
        if held_bytes < HELD_BYTES:
            backlog.low_s = now_s
        stall_s = STALL_S + ROUND_TRIPS * round_trip_s
        return now_s - backlog.moved_s >= stall_s or now_s - backlog.low_s >= HELD_S

    def _is_kept_out(self, address: str, now_s: float) -> bool:
        if now_s >= max(self._kept_out_s.values(), default=now_s):
            return False
        far = self._far_end(address, now_s)
        return far is not None and now_s < self._kept_out_s.get(far.session, now_s)

    def _judge(self, address: str, held_bytes: int, now_s: float) -> None:
        """Close a link, unless somebody is, or may be, behind it who must lose nothing."""
        far, inode = self._far_end(address, now_s), local_socket(address)
        if far is None or far.is_router or self._may_be_awaited(far, inode):
            return
        pid = owner(inode)
        self._sockets.close(address)
        self._backlogs.pop(address, None)
        times = self._times.setdefault(far.session, [])
        times.append(now_s)
        if len(times) >= SPARED and now_s - times[-SPARED] < SPARED_S:
            self._kept_out_s[far.session] = now_s + KEPT_OUT_S
        if self._is_told(far.session, held_bytes, now_s):
            names = self._tokens.processes(far.session)
            self.closed.append(ClosedLink(address, command(pid), names, held_bytes, len(times)))

    def _is_told(self, session: str, held_bytes: int, now_s: float) -> bool:
        """Tell whether to report a link: not one that held nothing back, as of a session that is kept out."""
        if held_bytes < STALL_BYTES or now_s - self._told_s.get(session, -TOLD_S) < TOLD_S:
            return False
        self._told_s[session] = now_s
        return True

    def _may_be_awaited(self, far: FarEnd, inode: str) -> bool:
        """Tell whether a far end is waited for: by its tokens, or else by its pid, if that can be known."""
        awaited = self._awaited()
        if names := self._tokens.processes(far.session):
            return any(name in each.names for each in awaited for name in names)
        unknown = [each.pid for each in awaited if not any(map(self._tokens.sessions, each.names))]
        pid = owner(inode) if unknown else ""
        return int(pid) in unknown if pid else bool(unknown)

    def _who(self, address: str) -> tuple[str, ...]:
        """Return the processes at a far end, or else what is known of it."""
        far = self._far_ends.get(address)
        names = self._tokens.processes(far.session) if far else ()
        return names or ("a router" if far and far.is_router else "somebody",)

    def _far_end(self, address: str, now_s: float) -> FarEnd | None:
        if now_s - self._refreshed_s >= FRESH_S:
            self._refreshed_s = now_s
            self._far_ends = self._link.far_ends()
        return self._far_ends.get(address)
