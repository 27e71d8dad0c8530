"""Which page of the console is in control of what: a formation, or the run itself. One page at a time, all see it.

A page that uses a control of what is free has it; another one asks for it, and has it when it is granted or the page in
control is closed or lost. An emergency, a landing and a hold need no control. Pure.
"""

import threading
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

RUN = "run"  # the part of time, faults and drones of no formation; a formation of that name shares it
EVERY = ""  # of a control that acts on all parts
LOST_S = 10.0  # wall, without a look of a page that has looked before: its script stands, or its machine is gone
HERE = ("", "127.0.0.1", "::1")  # addresses of pages on the console's machine
OPERATOR, VIEWER = "operator", "viewer"
Tell = Callable[[int, str], None]


class Holding(NamedTuple):
    """Who is in control of a part, and who asks for it; empty for nobody. `mine` is of the page that looks."""

    part: str
    holder: str = ""
    silent_s: float = 0.0
    asker: str = ""
    mine: bool = False
    asked_by_me: bool = False


@dataclass
class _Page:
    number: int
    role: str = OPERATOR
    address: str = ""
    looked_s: float | None = None  # wall; None before the first look

    @property
    def name(self) -> str:
        return f"{self.role} {self.number}{f' ({self.address})' if self.address not in HERE else ''}"


class ControlDesk:
    """Keeps who is in control; used from several threads.

    Args:
        parts: what a page may be in control of: the formations, and RUN.
        tell: tells a page, by its number, a line.
        wall_s: monotonic.
    """

    def __init__(
        self, parts: Sequence[str], tell: Tell = lambda *_: None, wall_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._lock = threading.RLock()
        self._tell = tell
        self._wall_s = wall_s
        self._pages: dict[int, _Page] = {}
        self._count = 0
        self._holders: dict[str, int] = {}
        self._askers: dict[str, int] = {}
        self.parts = tuple(dict.fromkeys((*parts, RUN)))

    def open(self, page: int) -> None:
        """Note that a page is there."""
        with self._lock:
            if page not in self._pages:
                self._count += 1
                self._pages[page] = _Page(self._count)

    def close(self, page: int) -> None:
        """Note that a page is gone: what it was in control of is free, or of who has asked for it."""
        with self._lock:
            self._askers = {part: asker for part, asker in self._askers.items() if asker != page}
            for part in [part for part, holder in self._holders.items() if holder == page]:
                self._pass_on(part, f"{self.name_of(page)} is gone, and with it")
            self._pages.pop(page, None)

    def look(self, page: int, role: str, address: str) -> None:
        """Note that a page lives, in which role, and from where."""
        with self._lock:
            self.open(page)
            known = self._pages[page]
            known.role, known.address, known.looked_s = role, address, self._wall_s()

    def release_lost(self) -> None:
        """Give what is asked for to who asks for it, where the page in control looks no longer.

        A page whose socket is closed has released already. One that only stands still keeps what nobody wants.
        """
        with self._lock:
            for part in list(self._askers):
                holder = self._holders[part]
                if self._silent_s(holder) > LOST_S:
                    self._pass_on(part, f"{self.name_of(holder)} was silent for {LOST_S:.0f} s and has lost")
                    self._tell(holder, f"Control of {words(part)} was given away: this page was silent")

    def refusal(self, page: int, part: str) -> str:
        """Return why a page may not use a control of a part now; empty where it may."""
        with self._lock:
            for each in self.parts if part == EVERY else (part,):
                holder = self._holders.get(each, page)
                if holder != page:
                    return f"{self.name_of(holder)} is in control of {words(each)}; ask for it under Control"
        return ""

    def use(self, page: int, part: str) -> str:
        """Put a page in control of a part that is free; return why it may not use it, empty where it may."""
        with self._lock:
            refusal = self.refusal(page, part)
            if not refusal and part != EVERY and part not in self._holders:
                self.open(page)
                self._holders[part] = page
        return refusal

    def ask(self, page: int, part: str) -> None:
        """Ask for a part; who is in control of it is told."""
        with self._lock:
            holder = self._holders.get(part)
            if holder is None or holder == page:
                self.use(page, part)
                return
            self._askers[part] = page
            self._tell(holder, f"{self.name_of(page)} asks for control of {words(part)}: see Control")

    def answer(self, page: int, part: str, granted: bool) -> None:
        """Grant who asks for a part what the page is in control of, or keep it."""
        with self._lock:
            asker = self._askers.get(part)
            if self._holders.get(part) != page or asker is None:
                return
            del self._askers[part]
            if granted:
                self._holders[part] = asker
            done = "gives you control of" if granted else "keeps control of"
            self._tell(asker, f"{self.name_of(page)} {done} {words(part)}")

    def release(self, page: int, part: str) -> None:
        """Give up a part: it is free, or of who has asked for it."""
        with self._lock:
            if self._holders.get(part) == page:
                self._pass_on(part, f"{self.name_of(page)} has released")

    def holdings(self, page: int, parts: Collection[str]) -> list[Holding]:
        """Return who is in control of some parts, as a page sees it."""
        with self._lock:
            return [self._holding(page, part) for part in parts]

    def others(self, page: int) -> list[str]:
        """Return the other pages that are open, operators first, as far as they have looked."""
        with self._lock:
            known = [each for number, each in self._pages.items() if number != page and each.looked_s is not None]
            return [each.name for each in sorted(known, key=lambda each: (each.role == VIEWER, each.number))]

    def held_by_others(self, page: int) -> frozenset[str]:
        """Return the parts of whose controls a page may use none, EVERY among them."""
        with self._lock:
            held = frozenset(part for part, holder in self._holders.items() if holder != page)
        return held | {EVERY} if held else held

    def name_of(self, page: int) -> str:
        """Return the name of a page."""
        known = self._pages.get(page)
        return known.name if known else "a page"

    def _holding(self, page: int, part: str) -> Holding:
        holder, asker = self._holders.get(part), self._askers.get(part)
        if holder is None:
            return Holding(part)
        asking = "" if asker is None else self.name_of(asker)
        names = part, self.name_of(holder), self._silent_s(holder), asking
        return Holding(*names, mine=holder == page, asked_by_me=asker == page)

    def _silent_s(self, page: int) -> float:
        known = self._pages.get(page)
        return 0.0 if known is None or known.looked_s is None else self._wall_s() - known.looked_s

    def _pass_on(self, part: str, why: str) -> None:
        del self._holders[part]
        asker = self._askers.pop(part, None)
        if asker is not None:
            self._holders[part] = asker
            self._tell(asker, f"{why} the control of {words(part)}: it is yours now")


def words(part: str) -> str:
    """Return what a part is called."""
    return "time and faults" if part == RUN else part
